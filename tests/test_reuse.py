"""What is reused belongs to the code that this process imported, and is what was kept."""

import gc
import os
import types
import warnings
import weakref
import zlib
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from codesign_jax import cli, reuse, rollout
from codesign_jax.compiler.ffi import KernelUnavailable
from codesign_jax.engines.structured import lanewise
from codesign_jax.scene.meshes import grid
from tests.helpers import grasps, kernels, planted_faults


@pytest.fixture
def code(tmp_path, monkeypatch):
    """A package of two files that was just imported, in the place of this one."""
    root = tmp_path / "code"
    for name in ("a.py", "deep/b.py", "report/c.py"):
        (root / name).parent.mkdir(exist_ok=True, parents=True)
        (root / name).write_text(name)
    monkeypatch.setattr(reuse, "ROOT", root)
    imported(monkeypatch)
    yield root
    reuse._content_digest.cache_clear()


def imported(monkeypatch):
    """A process begins."""
    monkeypatch.setattr(reuse, "at_import", reuse._state())
    reuse._content_digest.cache_clear()


@pytest.fixture
def folder(tmp_path):
    """A folder where kernels are kept."""
    previous = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    yield tmp_path / "jax"
    jax.config.update("jax_compilation_cache_dir", previous)


def set_back(path):
    """Another text of the same length, with the time of the old one, as rsync and tar leave it."""
    old = path.stat()
    path.write_text(path.read_text().swapcase())
    os.utime(path, ns=(old.st_atime_ns, old.st_mtime_ns))


@pytest.mark.parametrize(
    "edit",
    [
        lambda root: (root / "a.py").write_text("edited"),
        lambda root: set_back(root / "deep" / "b.py"),
        lambda root: (root / "a.py").unlink(),
        lambda root: (root / "deep" / "new.py").write_text(""),
    ],
    ids=["edited", "same size and time", "deleted", "added"],
)
def test_code_that_changed_after_the_import_has_no_digest(code, edit):
    """Before the first kernel, and between two."""
    edit(code)
    assert reuse.code_digest() is None


def kept_kernels(folder):
    """When each file of a kernel was written or found."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("kernels/*.kept")}


def test_a_kernel_of_code_that_changed_is_neither_kept_nor_found(code, folder, monkeypatch):
    """The next process, which imports what the disk says, must not run this one's kernel."""
    run = partial(kernels.run, rounds=7)
    x, table = kernels.numbers(2)
    jax.jit(run)(x, table)
    first = kept_kernels(folder)
    assert len(first) == 2  # the kernel, and the handler that calls it
    text = (code / "a.py").read_text()
    (code / "a.py").write_text("edited")
    got = jax.jit(lambda *v: run(*v))(x, table)
    assert kept_kernels(folder) == first
    np.testing.assert_array_equal(got, jax.jit(run)(x, table))
    imported(monkeypatch)  # the next process builds a kernel of its own
    jax.jit(lambda *v: run(*v))(x, table)
    assert len(kept_kernels(folder)) == 4
    (code / "a.py").write_text(text)
    imported(monkeypatch)
    jax.jit(lambda *v: run(*v))(x, table)
    assert len(kept_kernels(folder)) == 4


def test_a_planted_fault_finds_no_sound_kernel_and_leaves_none(folder):
    """In a folder that is kept from one session to the next."""
    run = partial(kernels.run, rounds=8)
    x, table = kernels.numbers(2)
    jax.jit(run)(x, table)
    sound = kept_kernels(folder)
    names = [reuse.key("kernel")]
    with planted_faults.planted({}):
        names.append(reuse.key("kernel"))
        jax.jit(lambda *v: run(*v))(x, table)
    assert kept_kernels(folder) == sound
    assert len(sound) == 2 and names[0] != names[1]


def test_nothing_traced_is_found_once_the_code_is_not_known(monkeypatch):
    """A function's key does not have the functions that it calls."""
    space = types.SimpleNamespace(structure="s")
    built = []
    find = reuse.shared(lambda *arguments: built.append(arguments) or (lambda v: v))
    first = find("engine", space, None)
    assert find("engine", space, None) is first
    lanewise.of_code("a")
    lanewise._program.cache_clear()
    keep = lanewise._program.cache_info
    monkeypatch.setattr(reuse, "code_digest", lambda: None)
    assert find("engine", space, None) is not first and len(built) == 2

    half = lanewise.lanes([np.float32(3)], (), wide=False)
    jax.make_jaxpr(lambda: lanewise.lanewise(lambda v: v * 2, half).lane)()
    assert keep().currsize == 1
    lanewise.of_code("a")
    assert keep().currsize == 1
    for other in ("b", None, None):
        jax.make_jaxpr(lambda: lanewise.lanewise(lambda v: v * 2, half).lane)()
        lanewise.of_code(other)
        assert keep().currsize == 0


def full(monkeypatch, share):
    """The process has this share of the maps that it may have."""
    monkeypatch.setattr(reuse, "memory_maps", lambda: (int(share * 65_530), 65_530))


def test_programs_go_when_many_maps_are_taken(monkeypatch):
    """All that nobody holds; a program that is held works on."""
    cleared = []
    built = []
    monkeypatch.setattr(reuse, "forgetters", [])
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(1))
    find = reuse.shared(lambda *arguments: built.append(arguments) or (lambda v: v + 1))

    def get(number):
        return find("engine", types.SimpleNamespace(structure=number), None)

    full(monkeypatch, 0.29)
    first = get(0)
    assert get(0) is first and get(1) is not first and not cleared
    full(monkeypatch, 0.31)
    assert get(0) is first and not cleared  # nothing new is made
    get(2)
    assert cleared == [1]
    full(monkeypatch, 0.1)
    assert get(0) is not first and get(2) is get(2) and cleared == [1]
    assert first(1) == 2


def test_programs_of_few_structures_are_kept(monkeypatch):
    """Those of more go with their memory, first the ones not used for the longest time."""
    monkeypatch.setattr(reuse, "forgetters", [])
    built = []

    def build(engine, structure, number):
        built.append(number)
        return lambda v: v + number

    find = reuse.shared(build)

    def get(number):
        return find("engine", types.SimpleNamespace(structure=number), number)

    first = weakref.ref(get(0))
    assert get(0)(1) == 1
    for number in range(1, reuse.STRUCTURES):
        get(number)
    assert get(0) is first() and built == [*range(reuse.STRUCTURES)]
    for number in range(reuse.STRUCTURES, 2 * reuse.STRUCTURES):
        get(number)
    gc.collect()
    assert first() is None and get(0)(1) == 1 and built[-1] == 0


def test_a_kernel_is_refused_before_the_limit(monkeypatch):
    full(monkeypatch, 0.91)
    with pytest.raises(KernelUnavailable, match=r"memory maps that Linux allows.*clear_caches"):
        jax.jit(lambda *v: kernels.run(*v, rounds=3))(*kernels.numbers(2))
    full(monkeypatch, 0.89)
    jax.jit(lambda *v: kernels.run(*v, rounds=3))(*kernels.numbers(2))


def test_a_forked_process_says_that_it_would_wait_for_ever(monkeypatch):
    """Only of a process that had simulated; its own first call is then an error at once."""
    program = reuse.SceneProgram(grasps.pinch("sphere", 2), lambda *_: 3)
    monkeypatch.setattr(reuse, "process", {"begun": False, "forked": False})
    assert program(0, 0) == 3 and reuse.process["begun"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of processes with threads
        child = os.fork()
    if not child:
        os._exit(3 if reuse.process["forked"] else 4)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    scene = grasps.pinch("sphere", 2)
    key = jax.random.key(0)
    monkeypatch.setitem(reuse.process, "forked", True)
    for call in (lambda: program(0, 0), lambda: rollout.sample_trials(scene, key, 3)):
        with pytest.raises(RuntimeError, match="forked from one that had simulated.*spawn"):
            call()


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The folder of all caches; JAX's is not chosen yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names = [
        "jax_compilation_cache_dir",
        "jax_enable_compilation_cache",
        "jax_persistent_cache_min_compile_time_secs",
    ]
    previous = [getattr(jax.config, name) for name in names]
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    yield tmp_path / "codesign-jax"
    for name, value in zip(names, previous, strict=True):
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.mark.parametrize("text", ["", "-1", "9" * 400])
def test_a_wrong_limit_is_refused_before_anything_is_done(text, monkeypatch, capsys):
    monkeypatch.setenv("CODESIGN_CACHE_BYTES", text)
    assert cli.main(["scenes", "hands"]) == 2
    output = capsys.readouterr()
    assert (
        "error: CODESIGN_CACHE_BYTES = " in output.err and "must be a number of bytes" in output.err
    )
    assert not output.out
    with pytest.raises(ValueError, match="CODESIGN_CACHE_BYTES"):
        reuse.use_compilation_cache()


def cube():
    """Vertices and faces of a cube of 2 cm."""
    import trimesh

    box = trimesh.creation.box((0.02, 0.02, 0.02))
    return np.asarray(box.vertices), np.asarray(box.faces)


def use_all(monkeypatch):
    """Uses every cache once."""
    reuse.use_compilation_cache()
    jax.jit(lambda v: v * 3.25)(jnp.ones(7))
    reuse.kept(reuse.kernel_file("kernel"), lambda: b"code")
    monkeypatch.setattr(grid, "WORTH_KEEPING", 0.0)
    return grid.cached("cube", *cube(), 1e-3, 0.03)


def test_one_switch_turns_all_caches_off(place, monkeypatch):
    monkeypatch.setenv("CODESIGN_CACHE", "off")
    mesh_grid = use_all(monkeypatch)
    assert not place.exists() and not jax.config.jax_enable_compilation_cache
    np.testing.assert_allclose(mesh_grid.origin, -0.04)  # as far out as asked for
    monkeypatch.setenv("CODESIGN_CACHE", "on")
    jax.config.update("jax_enable_compilation_cache", True)
    compilation_cache.reset_cache()  # another process
    np.testing.assert_array_equal(mesh_grid.values, use_all(monkeypatch).values)
    np.testing.assert_array_equal(mesh_grid.values, use_all(monkeypatch).values)
    names = {(p.parent.name, p.name.rpartition("-")[2]) for p in place.rglob("*") if p.is_file()}
    assert {("jax", "cache"), ("jax", "digest")} <= names
    assert len([*place.glob("meshes/*.kept")]) == len([*place.glob("jax/kernels/*.kept")]) == 1


def test_what_is_kept_is_found_and_damage_is_seen(folder):
    """One file a kernel; a damaged one is built again; without a folder nothing is written."""
    built = []

    def build():
        built.append(1)
        return b"code"

    def kept():
        return reuse.kept(reuse.kernel_file("a"), build)

    for count in (1, 1):
        assert kept() == b"code" and len(built) == count
    (path,) = folder.rglob("*.kept")
    for damage in (path.read_bytes()[:-1], b"", path.read_bytes()[:-1] + b"f"):
        path.write_bytes(damage)
        before = len(built)
        assert kept() == b"code" and len(built) == before + 1
    path.unlink()
    path.mkdir()  # where nothing could be kept
    assert kept() == b"code" and path.is_file()
    for place in (None, "gs://bucket/cache"):
        jax.config.update("jax_compilation_cache_dir", place)
        before = len(built)
        assert kept() == b"code" and len(built) == before + 1
    assert [p for p in folder.rglob("*") if p.is_file()] == [path] and not Path("gs:").exists()


def test_what_is_not_used_goes(folder, monkeypatch):
    """Ten kernels of 100 bytes under a limit of 532: four stay, the used one among them."""
    monkeypatch.setenv("CODESIGN_CACHE_BYTES", str(4 * 132 + 4))
    abandoned = folder / "kernels" / "x.tmp"
    for k in range(10):
        reuse.kept(reuse.kernel_file(f"k{k}"), lambda: bytes(100))
        for n in range(k + 1):  # files of one instant have an order all the same
            path = folder / "kernels" / f"k{n}.kept"
            if path.exists() and n:
                os.utime(path, ns=(10**9 * n, 10**9 * n))
        reuse.kept(reuse.kernel_file("k0"), lambda: pytest.fail("gone"))
        if not k:
            abandoned.write_bytes(b"part")
            os.utime(abandoned, (0, 0))
    assert {p.name for p in (folder / "kernels").iterdir()} == {f"k{k}.kept" for k in (0, 7, 8, 9)}


def test_the_oldest_programs_go_when_a_process_begins(place, monkeypatch):
    """Of four programs the two that fit into the limit, and nobody's limit but this one."""

    def begin():
        compilation_cache.reset_cache()
        jax.config.update("jax_compilation_cache_dir", None)
        reuse.use_compilation_cache()
        return sorted((place / "jax").glob("*-cache"), key=lambda path: path.stat().st_mtime_ns)

    begin()
    for k in range(4):
        jax.jit(lambda v, k=k: v * 7.5 + k)(2.0)
    paths = begin()
    for k, path in enumerate(paths):
        os.utime(path, (k, k))
    sizes = [path.stat().st_size for path in paths]
    assert len(paths) >= 4
    monkeypatch.setenv("CODESIGN_CACHE_BYTES", str(sum(sizes[-2:])))
    assert begin() == paths[-2:]
    assert jax.config.jax_compilation_cache_max_size == -1


@pytest.mark.parametrize("damage", [b"", b"nothing", zlib.compress(b"program" * 99)[:-9]])
def test_jax_compiles_again_what_was_damaged_and_keeps_it(damage, place):
    """Right results, no warning, and sound files after."""

    def run():
        compilation_cache.reset_cache()  # a new process
        jax.config.update("jax_compilation_cache_dir", None)
        reuse.use_compilation_cache()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return [float(jax.jit(lambda v, k=k: v * 1.25 + k)(2.0)) for k in range(3)]

    want = run()
    paths = sorted((place / "jax").glob("*-cache"))
    assert want == [2.5, 3.5, 4.5] and len(paths) >= 3
    for path in paths[:2]:
        path.write_bytes(damage)
    assert run() == want
    assert sorted((place / "jax").glob("*-cache")) == paths
    assert all(reuse._is_sound(path) for path in paths)


@pytest.mark.parametrize("way", ["flipped", "no digest", "another's", "cut short", "a folder"])
@pytest.mark.parametrize("checksum", [True, False])
def test_a_program_that_is_not_as_it_was_written_is_not_used(way, checksum, place, monkeypatch):
    """Also one that can be unpacked: zstd, as JAX calls it, has no checksum."""
    if not checksum:
        monkeypatch.setattr(reuse, "_unzstd", lambda: lambda content: content)
    reuse.use_compilation_cache()
    folder = Path(jax.config.jax_compilation_cache_dir)
    assert folder.name == ("jax" if checksum else "jax-zstd")
    jax.jit(lambda v: v * 5.25 + len(way))(2.0)
    paths = sorted(folder.glob("*-cache"))
    assert paths and all(reuse._digest_beside(path).exists() for path in paths)
    path = paths[0]
    content = path.read_bytes()
    assert reuse.check_programs(folder) and path.read_bytes() == content
    if way == "flipped":
        middle = len(content) // 2
        path.write_bytes(content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :])
    elif way == "no digest":
        reuse._digest_beside(path).unlink()
    elif way == "another's":
        other = path.with_name("other-cache")
        path.rename(other)
        reuse._digest_beside(path).rename(reuse._digest_beside(other))
        path = other
    elif way == "cut short":
        path.write_bytes(content[:-9])
    else:
        path.unlink()
        path.mkdir()
    os.utime(path, (0, 0))  # whatever its times say
    assert reuse.check_programs(folder)
    # By its checksum a whole program is known again.
    assert path.exists() == (checksum and way == "no digest")
    assert path.exists() == reuse._digest_beside(path).exists()


def test_damage_that_cannot_be_deleted_turns_the_cache_off(place, monkeypatch):
    (place / "jax").mkdir(parents=True)
    (place / "jax" / "x-cache").write_bytes(b"damaged")

    def refuse(path, **options):
        raise PermissionError

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.warns(UserWarning, match="damaged programs that cannot be deleted"):
        reuse.use_compilation_cache()
    assert not jax.config.jax_enable_compilation_cache


@pytest.mark.parametrize("inner", ["", "jax", "jax/kernels"])
@pytest.mark.parametrize("way", ["mode", "owner"])
def test_programs_that_others_may_have_written_are_not_used(inner, way, place, monkeypatch):
    use_all(monkeypatch)
    if not (place / "jax").exists():  # where JAX compresses by zstd
        (place / "jax-zstd").rename(place / "jax")
        monkeypatch.setattr(reuse, "_unzstd", lambda: None)
    jax.config.update("jax_compilation_cache_dir", None)
    (place / inner).chmod(0o775)  # a group's
    reuse.use_compilation_cache()
    assert jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    if way == "mode":
        (place / inner).chmod(0o777)
    elif os.getuid() == 0:
        os.chown(place / inner, 4711, -1)
    else:
        monkeypatch.setattr(os, "getuid", lambda: 4711)
    with pytest.warns(UserWarning, match="may be changed by others"):
        reuse.use_compilation_cache()
    assert not jax.config.jax_enable_compilation_cache
    assert reuse.kernel_file("kernel") is None


def test_a_folder_of_jax_that_nobody_meant_is_refused(monkeypatch, capsys):
    """JAX makes a folder named ~ in each working directory."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "~/cache")
    assert cli.main(["scenes"]) == 2
    assert "error: JAX_COMPILATION_CACHE_DIR = '~/cache' begins with ~" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["cache", "~/.cache", "./x", "$HOME/.cache", ""])
def test_a_cache_that_is_no_absolute_path_is_ignored(text, monkeypatch, tmp_path):
    """As the XDG Base Directory Specification asks for."""
    monkeypatch.setenv("XDG_CACHE_HOME", text)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert reuse.folder() == tmp_path / ".cache" / "codesign-jax"
