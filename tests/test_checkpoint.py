"""Checkpoints and results to go on from: bit for bit, and damage never passes for data."""

import re
import shutil
import sys
import threading
import types

import numpy as np
import pytest

from codesign_jax import array_files
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
    array_files.save(path, arrays)
    content = path.read_bytes()
    refused = 0
    for place, other in damaged(content, 150):
        path.write_bytes(other)
        try:
            loaded = array_files.load(path)
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
            array_files.load(path)


def test_results_are_those_of_one_case_and_one_code(tmp_path, monkeypatch):
    path = tmp_path / "x.npz"
    assert array_files.load_results(path, "a") == (None, "")
    array_files.save_results(path, {"seed": 1}, {"k": np.array(3)})
    assert array_files.load_results(path, {"seed": 1}) == ({"k": 3}, "")
    assert array_files.load_results(path, "b") == (None, "is of another design or other settings")
    for owner, name, value in (
        (array_files, "SCHEMA", 0),
        (array_files.reuse, "code_digest", lambda: "other"),
        (array_files.reuse, "code_digest", lambda: None),  # code that is not known is nobody's
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            assert array_files.load_results(path, {"seed": 1}) == (
                None,
                "is of another version of the code",
            )
    with monkeypatch.context() as patch:  # not even its own
        patch.setattr(array_files.reuse, "code_digest", lambda: None)
        array_files.save_results(path, "a", {"k": np.array(3)})
        assert array_files.load_results(path, "a")[0] is None
    path.write_bytes(path.read_bytes()[:-1])
    assert array_files.load_results(path, "a") == (
        None,
        "is damaged, or of another version of the code",
    )
