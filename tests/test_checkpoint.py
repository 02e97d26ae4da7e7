"""Checkpoints and results to go on from: bit for bit, and damage never passes for data."""

import hashlib
import io
import re
import shutil
import sys
import threading
import types
import zipfile

import numpy as np
import orbax.checkpoint
import pytest

from codesign_jax import array_files
from codesign_jax.runs import RunError, checkpoint
from codesign_jax.runs.checkpoint import Checkpoints, digest
from scripts import faults


def arrays(step):
    """Arrays of the kinds that a run saves, different at every step."""
    rng = np.random.default_rng(step)
    return {
        "state": {
            "particles": rng.random((10, 2)).astype(np.float32),
            "key": rng.integers(0, 2**32, 2, np.uint32),
            "episode": np.array(step, np.int32),
        },
        "history": {"cost": rng.random((8, 10, 6)).astype(np.float32), "flag": np.ones(3, bool)},
    }


def equal(a, b):
    """Whether nested arrays agree in names, types, shapes and bytes."""
    return digest(a) == digest(b)


@pytest.fixture
def folder(tmp_path):
    """A folder with steps 1 to 4, of which the last three are kept."""
    with Checkpoints(tmp_path / "checkpoints", keep=3) as store:
        for step in range(1, 5):
            store.save(step, arrays(step))
    return tmp_path / "checkpoints"


def restore(folder):
    with Checkpoints(folder, read_only=True) as store:
        return store.restore()


def test_round_trip_is_bitwise(folder):
    restored = restore(folder)
    assert restored.step == 4 and restored.damaged == ()
    assert equal(restored.arrays, arrays(4))
    assert restored.arrays["state"]["particles"].dtype == np.float32
    assert restored.arrays["state"]["episode"].shape == ()


@pytest.mark.parametrize(
    "name",
    ["exp[1]", "lr=[1,2],x", "[!a]", r"C:\runs\a", "a*b?", "~", "$HOME", "a b\n", "\u00e9%20#"],
)
def test_any_name_of_a_folder_can_be_read_back(name, tmp_path):
    """Libraries take some for patterns, backslashes for slashes; a moved folder is read as well."""
    folder = tmp_path / name
    folder.mkdir()
    with Checkpoints(folder / "checkpoints") as store:
        for step in (1, 2):
            store.save(step, arrays(step))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    plain = tmp_path / "plain"
    for before, place in ((folder, folder), (folder, plain), (plain, folder)):
        restored = restore(before.rename(place) / "checkpoints")
        assert restored.step == 2 and equal(restored.arrays, arrays(2))


@pytest.mark.parametrize("way", ["pattern", "misread", "fails"])
def test_what_cannot_be_read_back_is_refused_at_the_first_save(way, tmp_path, monkeypatch):
    """Nothing is left of it: the same command begins anew in a folder that can be read."""
    folder = tmp_path / "exp[1]"
    folder.mkdir()
    if way == "pattern":  # a system without /proc
        monkeypatch.setattr(checkpoint, "_DESCRIPTORS", tmp_path / "none")
    else:

        def read(manager, step, args):
            if way == "fails":
                raise ValueError("NOT_FOUND")
            return arrays(step + 1)

        monkeypatch.setattr(orbax.checkpoint.CheckpointManager, "restore", read)
    with (
        Checkpoints(folder / "checkpoints") as store,
        pytest.raises(RunError, match=re.escape(str(folder)) + ".* cannot be read back"),
    ):
        store.save(1, arrays(1))
    assert list((folder / "checkpoints").iterdir()) == []


def test_a_folder_that_is_replaced_while_it_is_open_stays_as_it_is(tmp_path):
    """Steps go to the folder that was opened, wherever it is; another's digests are not deleted."""
    for name in ("mine", "others"):
        with Checkpoints(tmp_path / name) as store:
            for step in range(1, 4 if name == "others" else 2):
                store.save(step, arrays(step))
    before = sorted(p.relative_to(tmp_path) for p in (tmp_path / "others").rglob("*"))
    with Checkpoints(tmp_path / "mine", keep=1) as store:
        store.save(2, arrays(2))
        (tmp_path / "mine").rename(tmp_path / "moved")
        (tmp_path / "others").rename(tmp_path / "mine")
        stray = tmp_path / "moved" / "77.sha256"  # of a step that this process does not know
        stray.touch()
        store.save(4, arrays(4))
    (tmp_path / "mine").rename(tmp_path / "others")
    assert sorted(p.relative_to(tmp_path) for p in (tmp_path / "others").rglob("*")) == before
    names = {path.name for path in (tmp_path / "moved").iterdir()}
    assert names == {"4", "4.sha256", stray.name}


def test_no_save_waits_for_the_deletion_of_old_steps_or_fails_with_it(tmp_path, monkeypatch):
    """Deletions begin when all saves are done, and are refused then."""
    saved = threading.Event()
    messages = []

    def refuse(path, *rest, **more):
        assert saved.wait(60), "a save waits for this"
        raise PermissionError(f"{path} is not ours")

    with Checkpoints(tmp_path, keep=2, tell=messages.append) as store:
        monkeypatch.setattr(shutil, "rmtree", refuse)
        for step in range(1, 6):
            store.save(step, arrays(step))
        saved.set()
    (words,) = messages
    assert words.startswith(f"old checkpoints in {tmp_path} could not be deleted: ")
    assert words.endswith("1 is not ours")
    restored = restore(tmp_path)
    assert restored.step == 5 and equal(restored.arrays, arrays(5)) and restored.damaged == ()


def test_after_a_failed_save_its_threads_are_silent_and_no_others(tmp_path, monkeypatch):
    """Tensorstore's threads report to an event loop that the failure has closed."""
    reports = []
    monkeypatch.setattr(sys, "unraisablehook", reports.append)
    folder = tmp_path / "checkpoints"
    store = Checkpoints(folder)
    store.save(1, arrays(1))
    assert sys.unraisablehook == reports.append
    shutil.rmtree(folder)
    folder.write_text("no folder")
    with pytest.raises(OSError, match="checkpoint 2 could not be written"):
        store.save(2, arrays(2))
    loop_error = types.SimpleNamespace(exc_value=RuntimeError("Event loop is closed"))
    other = types.SimpleNamespace(exc_value=RuntimeError("another"))
    for unraisable in (loop_error, other):
        sys.unraisablehook(unraisable)
    assert reports == [other]


@pytest.mark.parametrize(("number", "step"), [(99, 4), (150, None)])
def test_of_any_number_of_steps_the_newest_are_tried(number, step, folder):
    for k in range(number):
        (folder / str(1000 + k)).mkdir()
    restored = restore(folder)
    assert restored.step == step and len(restored.damaged) == min(number, 100)


@pytest.mark.parametrize("way", ["flipped", "longer", "deleted"])
def test_damage_of_any_file_falls_back_to_the_step_before(folder, way):
    for path in [p for p in sorted((folder / "4").rglob("*")) if p.is_file()]:
        content = path.read_bytes()
        faults.damage(path, way)
        restored = restore(folder)
        assert restored.step == 3, path
        assert equal(restored.arrays, arrays(3))
        [(step, reason)] = restored.damaged
        assert step == 4 and path.name in reason
        path.write_bytes(content)
    assert restore(folder).step == 4, "putting the bytes back heals it"


def test_arrays_that_differ_from_what_was_saved_are_refused(folder):
    # As if orbax had cast or misread: the files are intact, the arrays are not those saved.
    digests = folder / "4.sha256"
    text = digests.read_text()
    digests.write_text(re.sub(r"# arrays \w+", f"# arrays {digest(arrays(9))}", text))
    restored = restore(folder)
    assert restored.step == 3 and restored.damaged == ((4, "its arrays' digest differs"),)


def flipped(content, place=30):
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


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


def test_any_damage_of_arrays_is_one_error(tmp_path):
    path = tmp_path / "x.npz"
    arrays = {"a": np.arange(50.0), "name": np.array("text")}
    layout = {"a": array_files.Array("f", (50,)), "name": array_files.Array("U", ())}
    array_files.save(path, arrays)
    content = path.read_bytes()
    refused = 0
    for place, other in damaged(content, 150):
        path.write_bytes(other)
        try:
            loaded = array_files.load(path, layout)
        except array_files.ArrayFileError:
            refused += 1
        else:  # a byte of a date, say
            assert loaded.keys() == arrays.keys(), place
            for name, value in arrays.items():
                np.testing.assert_array_equal(loaded[name], value)
    assert refused > 100
    for other in (b"", b"PK", b"nothing", np.zeros(3).tobytes()):
        path.write_bytes(other)
        with pytest.raises(array_files.ArrayFileError, match="x.npz is damaged"):
            array_files.load(path, layout)


def test_results_are_those_of_one_case_and_one_code(tmp_path, monkeypatch):
    path = tmp_path / "x.npz"
    layout = {"k": array_files.Array("i", ())}
    assert array_files.load_results(path, "a", layout) == (None, "")
    array_files.save_results(path, {"seed": 1}, {"k": np.array(3)})
    assert array_files.load_results(path, {"seed": 1}, layout) == ({"k": 3}, "")
    assert array_files.load_results(path, "b", layout) == (
        None,
        "is of another design or other settings",
    )
    for owner, name, value in (
        (array_files, "SCHEMA", 0),
        (array_files.reuse, "code_digest", lambda: "other"),
        (array_files.reuse, "code_digest", lambda: None),  # code that is not known is nobody's
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            assert array_files.load_results(path, {"seed": 1}, layout) == (
                None,
                "is of another version of the code",
            )
    with monkeypatch.context() as patch:  # not even its own
        patch.setattr(array_files.reuse, "code_digest", lambda: None)
        array_files.save_results(path, "a", {"k": np.array(3)})
        assert array_files.load_results(path, "a", layout)[0] is None
    path.write_bytes(path.read_bytes()[:-1])
    assert array_files.load_results(path, "a", layout) == (
        None,
        "is damaged, or of another version of the code",
    )


def bare(path, heads):
    """A file of arrays of which there are heads alone, and the digest of such ones."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, (kind, shape) in heads.items():
            head = io.BytesIO()
            fields = {"descr": kind, "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(head, fields)
            archive.writestr(f"{name}.npy", head.getvalue())
        total = hashlib.sha256("".join(f"{n} {k} {s}\n" for n, (k, s) in heads.items()).encode())
        digest = io.BytesIO()
        np.save(digest, np.array(total.hexdigest()))
        archive.writestr("digest.npy", digest.getvalue())


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        ("<U0", (10**12,)),
        ("<U0", ()),
        ("|S0", (10**12,)),
        ("|V0", (10**9, 10**9)),
        ("<U1000000000", ()),
        ("<f4", (10**15,)),
        ("<f4", (2**62, 2**62)),
        ("<f4", (0, 10**12)),
        ("<f4", (7, 7, 7)),
        ("|O", (3,)),
        ("<M8[s]", (3,)),
        ([("a", "<f4")], (3,)),
    ],
)
def test_no_array_is_read_that_a_file_of_its_kind_does_not_have(kind, shape, tmp_path):
    """Neither what takes no room nor what takes all of it, whoever made the digest."""
    path = tmp_path / "x.npz"
    bare(path, {"about": (kind, shape)})
    for layout in (
        {"about": array_files.Array("U", ())},
        {"about": array_files.Array("f", ("n",))},
    ):
        with pytest.raises(array_files.ArrayFileError):
            array_files.load(path, layout)


LAYOUT = {
    "names": array_files.Array("U", ("n",)),
    "values": array_files.Array("f", ("n", 2)),
    "seed": array_files.Array("iu", (), True),
}


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"names": np.array(["a"] * 4)}, "values"),
        ({"values": np.zeros((3, 3))}, "values"),
        ({"values": np.zeros(3)}, "values"),
        ({"values": np.zeros((3, 2), int)}, "values"),
        ({"values": None}, "values"),
        ({"seed": np.zeros(1, int)}, "seed"),
        ({"seed": np.array(1.5)}, "seed"),
        ({"more": np.zeros(3)}, "more"),
        ({"names": np.array(["a" * 10_001] * 3)}, "names"),
        ({"names": np.array(["a"] * 10_001), "values": np.zeros((10_001, 2))}, "names"),
    ],
)
def test_the_arrays_of_a_file_have_declared_names_shapes_and_types(change, word, tmp_path):
    path = tmp_path / "x.npz"
    whole = {"names": np.array(["a"] * 3), "values": np.zeros((3, 2)), "seed": np.array(3)}
    array_files.save(path, whole)
    assert array_files.load(path, LAYOUT).keys() == whole.keys()
    array_files.save(path, whole | change)
    with pytest.raises(array_files.ArrayFileError, match=f"array '{word}'"):
        array_files.load(path, LAYOUT)


def test_types_and_shapes_of_a_step_are_known_before_it_is_read(folder, monkeypatch):
    """As they are on disk: 10^12 numbers of a value that is written once take no room there."""
    seen = []

    def refuse(described):
        seen.append(described)
        raise RunError("none of this run")

    manager = orbax.checkpoint.CheckpointManager
    monkeypatch.setattr(manager, "restore", lambda *a, **k: pytest.fail("it was read"))
    with Checkpoints(folder, read_only=True) as store, pytest.raises(RunError, match="none of"):
        store.restore(refuse)
    assert seen == [
        {
            "state/particles": (np.float32, (10, 2)),
            "state/key": (np.uint32, (2,)),
            "state/episode": (np.int32, ()),
            "history/cost": (np.float32, (8, 10, 6)),
            "history/flag": (np.bool_, (3,)),
        }
    ]
