"""Arrays in files and results to go on from: damage of any kind is found."""

from pathlib import Path

import jax
import numpy as np
import pytest

from codesign_jax import files, store
from codesign_jax.runs import failures
from codesign_jax.scene.schema import InputError
from codesign_jax.store import Store
from codesign_jax.types import Trial


def flipped(content, place=30):
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


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


def test_any_damage_of_arrays_is_one_error(tmp_path):
    path, arrays = tmp_path / "x.npz", {"a": np.arange(50.0), "name": np.array("text")}
    store.save(path, arrays)
    content, refused = path.read_bytes(), 0
    for place, other in damaged(content, 150):
        path.write_bytes(other)
        try:
            found = store.load(path)
        except store.StoreError:
            refused += 1
        else:  # a byte of a date, say
            assert found.keys() == arrays.keys(), place
            for name, value in arrays.items():
                np.testing.assert_array_equal(found[name], value)
    assert refused > 100
    for other in (b"", b"PK", b"nothing", np.zeros(3).tobytes()):
        path.write_bytes(other)
        with pytest.raises(store.StoreError, match="x.npz is damaged"):
            store.load(path)


def test_arrays_of_another_make_are_refused(tmp_path, monkeypatch):
    """Without a digest; a single array; and what unpacks to more than is ever written."""
    path = tmp_path / "x.npz"
    np.savez(path, a=np.zeros(3))
    with pytest.raises(store.StoreError):
        store.load(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(store.StoreError):
        store.load(path)
    store.save(path, {"a": np.zeros(10**5)})
    assert store.load(path)["a"].shape == (10**5,)
    monkeypatch.setattr(store, "MOST", 10**5)
    with pytest.raises(store.StoreError):
        store.load(path)


def test_a_failed_world_with_any_damage_is_refused_or_whole(tmp_path):
    path = tmp_path / "failures" / "x.npz"
    store.save(path, one_failure())
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
        store.save(path, {k: v for k, v in one_failure().items() if k != name})
        with pytest.raises(InputError, match="is not a failed world"):
            failures.load(path)


def over_two(content, first):
    """Three parts of equal length, the second of which claims to reach to the end."""
    third = (len(content) - first) // 3
    length = (2 * third - 8).to_bytes(8, "little")
    return content[: first + third] + length + content[first + third + 8 :]


def numbers(path, about="a"):
    """What the parts of a file hold, and why they are not taken."""
    found = Store(path, about)
    return [int(part["k"]) for part in found], found.refused


def test_parts_are_added_and_a_torn_one_is_left_out(tmp_path):
    path = tmp_path / "new" / "x.part"
    parts = Store(path, "a")
    for k in range(3):
        parts.append({"k": np.array(k)})
    content = path.read_bytes()
    assert numbers(path) == ([0, 1, 2], "") and len(Store(path, "a")) == 3
    first = 8 + int.from_bytes(content[:8], "little")  # what the results are of
    third = (len(content) - first) // 3
    for other, left in (
        (content[:-1], 2),
        (content[: first + third + 3], 1),
        (content + b"\xff" * 9, 3),
        (flipped(content, first + third + third // 2), 1),
        (flipped(content, first + third + 7), 1),  # a length of many bytes
        (over_two(content, first), 1),
        (b"", 0),
    ):
        path.write_bytes(other)
        again = Store(path, "a")
        assert [int(p["k"]) for p in again] == [*range(left)]
        again.append({"k": np.array(7)})
        assert numbers(path) == ([*range(left), 7], "")


def test_results_are_those_of_one_case_and_one_code(tmp_path, monkeypatch):
    path = tmp_path / "x.part"
    parts = Store(path, "a")
    for k in range(2):
        parts.append({"k": np.array(k)})
    assert numbers(path) == ([0, 1], "")
    assert numbers(path, "b") == ([], "is of another design or other settings")
    assert Store(path, {"seed": 1}).about == "a"
    for owner, name, value in (
        (store, "SCHEMA", 0),
        (store.reuse, "code_digest", lambda: "other"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            assert numbers(path) == ([], "is of another version of the code")
    with monkeypatch.context() as patch:  # code that is not known is nobody's, not even its own
        patch.setattr(store.reuse, "code_digest", lambda: None)
        Store(tmp_path / "y.part", "a").append({"k": np.array(0)})
        assert Store(tmp_path / "y.part", "a").refused
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    assert numbers(path) == ([0], ""), "the last part is torn"
    path.write_bytes(content)
    Store(path, "b").append({"k": np.array(7)})
    assert numbers(path, "b") == ([7], "")


def test_one_process_has_a_file(tmp_path):
    one, other = (Store(tmp_path / "x.part", "a") for _ in range(2))
    with one.alone() as free, other.alone() as again:
        assert free and not again
    with other.alone() as free:
        assert free


def test_two_writers_of_one_file_do_not_share_a_temporary_file(tmp_path):
    path = tmp_path / "x"
    with files.atomically(path) as one, files.atomically(path) as other:
        assert one != other
        one.write_text("one")
        other.write_text("other")
    assert path.read_text() == "one" and [*tmp_path.iterdir()] == [Path(path)]
