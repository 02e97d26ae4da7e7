"""What is kept on disk: limits, the switch, and damage of any kind, which is found and mended."""

import os
import warnings
import zlib
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from codesign_jax import archives, caches, cli, files, kept_programs
from codesign_jax.archives import Store
from codesign_jax.compiler import cache
from codesign_jax.runs import failures
from codesign_jax.scene.meshes import grid
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Trial


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The folder of all caches; JAX's is not chosen yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    previous = jax.config.jax_compilation_cache_dir, jax.config.jax_enable_compilation_cache
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield tmp_path / "codesign-jax"
    jax.config.update("jax_compilation_cache_dir", previous[0])
    jax.config.update("jax_enable_compilation_cache", previous[1])
    compilation_cache.reset_cache()


@pytest.mark.parametrize("variable", [caches.PROGRAMS, caches.KERNELS, caches.MESHES])
@pytest.mark.parametrize("text", ["abc", "", "-1", "1e9", "9" * 400, "\u0661"])
def test_a_wrong_limit_is_refused_before_anything_is_done(variable, text, monkeypatch, capsys):
    monkeypatch.setenv(variable, text)
    assert cli.main(["scenes", "hands"]) == 2
    said = capsys.readouterr()
    assert f"error: {variable} = " in said.err and "must be a number of bytes" in said.err
    assert not said.out
    with pytest.raises(ValueError, match=variable):
        caches.use_compilation_cache()


def test_a_wrong_switch_is_refused_and_all_that_is_wrong_is_said(monkeypatch, capsys):
    monkeypatch.setenv(caches.SWITCH, "maybe")
    monkeypatch.setenv(caches.MESHES, "many")
    assert cli.main(["scenes", "hands"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2
    assert caches.problems()[0] == "CODESIGN_CACHE = 'maybe' must be on or off"


def cube():
    """Vertices and faces of a cube of 2 cm."""
    import trimesh

    box = trimesh.creation.box((0.02, 0.02, 0.02))
    return np.asarray(box.vertices), np.asarray(box.faces)


def use_all(monkeypatch):
    """Uses every cache once."""
    caches.use_compilation_cache()
    jax.jit(lambda v: v * 3.25)(jnp.ones(7))
    cache.kept("kernel", lambda: b"code")
    monkeypatch.setattr(grid, "WORTH_KEEPING", 0.0)
    grid.cached("cube", *cube(), 1e-3)


def test_one_switch_turns_all_caches_off(place, monkeypatch):
    monkeypatch.setenv(caches.SWITCH, "off")
    use_all(monkeypatch)
    assert not place.exists() and not jax.config.jax_enable_compilation_cache


def test_caches_are_on_by_default(place, monkeypatch):
    monkeypatch.setenv(caches.SWITCH, "on")
    use_all(monkeypatch)
    found = {p.suffix or "-cache" for p in place.rglob("*") if p.is_file()}
    assert found >= {"-cache", ".kernel", ".npz"}


def test_the_oldest_go_first(tmp_path):
    """The newest stays whatever its size; so do other files, but not what nobody will finish."""
    for k in range(5):
        (tmp_path / f"{k}.x").write_bytes(bytes(100))
        os.utime(tmp_path / f"{k}.x", (k, k))
    for name, age in (("old.1.tmp", 0), ("new.2.tmp", None), ("other", 0)):
        (tmp_path / name).touch()
        if age is not None:
            os.utime(tmp_path / name, (age, age))
    caches.used(tmp_path / "0.x")
    caches.evict(tmp_path, ".x", 250)
    assert {p.name for p in tmp_path.iterdir()} == {"0.x", "4.x", "new.2.tmp", "other"}
    caches.evict(tmp_path, ".x", 0, tmp_path / "4.x")
    assert {p.name for p in tmp_path.glob("*.x")} == {"4.x"}
    caches.evict(tmp_path / "none", ".x", 0)


def test_a_grid_and_a_kernel_in_the_place_of_another_are_not_taken(place, monkeypatch):
    monkeypatch.setattr(grid, "WORTH_KEEPING", 0.0)
    vertices, faces = cube()
    first = grid.cached("a", vertices, faces, 1e-3)
    grid.cached("b", 0.5 * vertices, faces, 1e-3)
    one, other = sorted((place / "meshes").iterdir(), key=lambda p: p.stat().st_size)
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    np.testing.assert_array_equal(grid.cached("a", vertices, faces, 1e-3).values, first.values)
    jax.config.update("jax_compilation_cache_dir", str(place))
    cache.kept("a", lambda: b"a")
    cache.kept("b", lambda: b"b")
    (place / "kernels" / "a.kernel").write_bytes((place / "kernels" / "b.kernel").read_bytes())
    assert cache.kept("a", lambda: b"new") == b"new"


# JAX's programs


def entries(folder, count=6):
    """Files as JAX writes them."""
    folder.mkdir(exist_ok=True)
    paths = [folder / f"jit_f-{k}{kept_programs.ENDING}" for k in range(count)]
    for k, path in enumerate(paths):
        path.write_bytes(zlib.compress(bytes([k]) * 1000))
    return paths


def flipped(content, place=30):
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


DAMAGE = {
    "empty": lambda c: b"",
    "torn": lambda c: c[:-1],
    "half": lambda c: c[: len(c) // 2],
    "zeros": lambda c: bytes(len(c)),
    "bit": lambda c: flipped(c, len(c) // 2),
    "last": lambda c: flipped(c, len(c) - 1),
    "more": lambda c: c + b"x",
    "text": lambda c: b"nothing",
}


@pytest.mark.parametrize("listed", [True, False])
@pytest.mark.parametrize("damage", sorted(set(DAMAGE) - {"more"}))
def test_damaged_programs_go_and_sound_ones_stay(tmp_path, damage, listed):
    """Also those that a killed process did not list, and those that a full disk left."""
    paths = entries(tmp_path)
    if listed:
        kept_programs.note(tmp_path)
    for path in paths[:2]:
        path.write_bytes(DAMAGE[damage](path.read_bytes()))
    kept_programs.check(tmp_path)
    assert sorted(tmp_path.glob("jit*")) == paths[2:]
    kept_programs.check(tmp_path)
    assert sorted(tmp_path.glob("jit*")) == paths[2:]


def test_programs_in_the_place_of_each_other_go(tmp_path):
    paths = entries(tmp_path)
    kept_programs.note(tmp_path)
    a, b = (path.read_bytes() for path in paths[:2])
    paths[0].write_bytes(b)
    paths[1].write_bytes(a)
    kept_programs.check(tmp_path)
    assert sorted(tmp_path.glob("jit*")) == paths[2:]


@pytest.mark.parametrize("text", ["", "[]", "{", '{"jit_f-0-cache": 3}', "[" * 10**5])
def test_a_damaged_list_is_made_again(tmp_path, text):
    paths = entries(tmp_path)
    kept_programs.check(tmp_path)
    good = (tmp_path / kept_programs.LIST).read_bytes()
    (tmp_path / kept_programs.LIST).write_text(text)
    kept_programs.check(tmp_path)
    left = sorted(tmp_path.glob("jit*"))
    assert left in (paths, paths[1:])  # one that the list names with nonsense is not believed
    if left == paths:
        assert (tmp_path / kept_programs.LIST).read_bytes() == good


def test_jax_compiles_again_what_was_damaged_and_keeps_it(place):
    """Two programs exchanged and one torn: right results, no warning, and sound files after."""

    def run():
        compilation_cache.reset_cache()  # a new process
        jax.config.update("jax_compilation_cache_dir", None)
        caches.use_compilation_cache()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = [float(jax.jit(lambda v, k=k: v * 1.25 + k)(2.0)) for k in range(3)]
        kept_programs.note(place / "jax")  # its end
        return found

    want = run()
    paths = sorted((place / "jax").glob(f"*{kept_programs.ENDING}"))
    contents = [path.read_bytes() for path in paths]
    assert want == [2.5, 3.5, 4.5] and len(paths) >= 3
    for path, content in zip(paths, [*contents[1::-1], b"", *contents[3:]], strict=True):
        path.write_bytes(content)
    assert run() == want
    assert sorted((place / "jax").glob(f"*{kept_programs.ENDING}")) == paths
    assert all(path.read_bytes() for path in paths)


# Arrays


def one_failure():
    trial = Trial(*[np.float32(k) for k in range(len(Trial._fields))])
    arrays = {"design": np.arange(3.0), "state": np.zeros(4), "status": np.int32(1)}
    arrays |= {"bad_step": np.int32(2), "place": np.array([1, 2, 3])}
    return arrays | {f"trial_{k}": v for k, v in trial._asdict().items()}


def damaged(content, count):
    """Contents with one byte changed, at every place of the directory and some others, or torn."""
    random = np.random.default_rng(0)
    places = {*random.integers(0, len(content), count).tolist()}
    places |= {*range(content.index(b"PK\1\2"), len(content), 3)}
    for place in sorted(places):
        yield place, flipped(content, place)
        if place % 5 == 0:
            yield place, content[:place]
            yield place, content[:place] + content[place + 1 :]


@pytest.mark.parametrize("compressed", [True, False])
def test_any_damage_of_arrays_is_one_error(tmp_path, compressed):
    path, arrays = tmp_path / "x.npz", {"a": np.arange(50.0), "name": np.array("text")}
    archives.save(path, arrays, compressed=compressed)
    content, refused = path.read_bytes(), 0
    for place, other in damaged(content, 150):
        path.write_bytes(other)
        try:
            found = archives.load(path)
        except archives.ArchiveError:
            refused += 1
        else:  # a byte of a date, say
            assert found.keys() == arrays.keys(), place
            for name, value in arrays.items():
                np.testing.assert_array_equal(found[name], value)
    assert refused > 100
    for other in (b"", b"PK", b"nothing", np.zeros(3).tobytes()):
        path.write_bytes(other)
        with pytest.raises(archives.ArchiveError, match="x.npz is damaged"):
            archives.load(path)


def test_arrays_of_another_make_are_refused(tmp_path, monkeypatch):
    """Without a digest; a single array; and what unpacks to more than is ever written."""
    path = tmp_path / "x.npz"
    np.savez(path, a=np.zeros(3))
    with pytest.raises(archives.ArchiveError):
        archives.load(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(archives.ArchiveError):
        archives.load(path)
    archives.save(path, {"a": np.zeros(10**5)}, compressed=True)
    assert archives.load(path)["a"].shape == (10**5,)
    monkeypatch.setattr(archives, "MOST", 10**5)
    with pytest.raises(archives.ArchiveError):
        archives.load(path)


def test_a_failed_world_with_any_damage_is_refused_or_whole(tmp_path):
    path = tmp_path / "failures" / "x.npz"
    archives.save(path, one_failure())
    content, want, refused = path.read_bytes(), failures.load(path), 0
    for _, other in damaged(content, 50):
        path.write_bytes(other)
        try:
            found = failures.load(path)
        except InputError as error:
            assert "is not a failed world of a run" in str(error)
            refused += 1
        else:
            jax.tree.map(np.testing.assert_array_equal, found, want)
    assert refused > 100
    for name in ("trial_friction", "place", "status"):
        assert name in one_failure()
        archives.save(path, {k: v for k, v in one_failure().items() if k != name})
        with pytest.raises(InputError, match="is not a failed world"):
            failures.load(path)


def over_two(content):
    """Three parts of equal length, the second of which claims to reach to the end."""
    third = len(content) // 3
    length = (2 * third - 8).to_bytes(8, "little")
    return content[:third] + length + content[third + 8 :]


def test_parts_are_added_and_a_torn_one_is_left_out(tmp_path):
    path = tmp_path / "new" / "x.part"
    parts = archives.Parts(path)
    for k in range(3):
        parts.append({"k": np.array(k)})
    content = path.read_bytes()
    assert [int(p["k"]) for p in archives.Parts(path).found] == [0, 1, 2]
    third = len(content) // 3
    for other, left in (
        (content[:-1], 2),
        (content[: third + 3], 1),
        (content + b"\xff" * 9, 3),
        (flipped(content, third + third // 2), 1),
        (flipped(content, third + 7), 1),  # a length of many bytes
        (over_two(content), 1),
        (b"", 0),
    ):
        path.write_bytes(other)
        again = archives.Parts(path)
        assert [int(p["k"]) for p in again.found] == [*range(left)]
        again.append({"k": np.array(7)})
        assert [int(p["k"]) for p in archives.Parts(path).found] == [*range(left), 7]
    path.write_bytes(content)
    again = archives.Parts(path)
    again.go_on(1)
    again.append({"k": np.array(8)})
    assert [int(p["k"]) for p in archives.Parts(path).found] == [0, 8]


def test_results_are_those_of_one_case_and_one_code(tmp_path, monkeypatch):
    path = tmp_path / "x.part"

    def found(key="a"):
        store = Store(path, key)
        assert not (store.found and store.refused)
        return [int(part["k"]) for part in store.found], store.refused

    store = Store(path, "a")
    for k in range(2):
        store.append({"k": np.array(k)})
    assert found() == ([0, 1], "")
    assert found("b") == ([], "is of another design or other settings")
    for name, value in (("SCHEMA", 0), ("sources", SimpleNamespace(digest=lambda: "other"))):
        with monkeypatch.context() as patch:
            patch.setattr(archives, name, value)
            assert found() == ([], "is of another version of the code")
    with monkeypatch.context() as patch:  # code that is not known is nobody's, not even its own
        patch.setattr(archives, "sources", SimpleNamespace(digest=lambda: None))
        Store(tmp_path / "y.part", "a").append({"k": np.array(0)})
        assert Store(tmp_path / "y.part", "a").refused
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    assert found() == ([0], ""), "the last part is torn"
    path.write_bytes(content)
    Store(path, "b").append({"k": np.array(7)})
    assert found("b") == ([7], "")


def test_two_writers_of_one_file_do_not_share_a_temporary_file(tmp_path):
    path = tmp_path / "x"
    with files.atomically(path) as one, files.atomically(path) as other:
        assert one != other
        one.write_text("one")
        other.write_text("other")
    assert path.read_text() == "one" and [*tmp_path.iterdir()] == [Path(path)]
