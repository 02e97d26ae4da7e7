"""Arrays in files that are known to be what was written, and results that a command goes on from.

The checksums of zip leave out names and lengths, and what reads them has an error of its own for
each damage; here there is one.  A reader says which arrays a file has: their names, shapes and
types are compared with the heads of the arrays before one is read.
"""

import hashlib
import io
import json
import math
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from codesign_jax import files, reuse, terminal

MOST = 2**30
"""Most bytes of arrays that a file may unpack to."""
MOST_TEXTS = 10_000
"""Most texts of an array; a file has a few dozen."""
MOST_LETTERS = 10_000
"""Most letters of such a text."""
SCHEMA = 2
"""Layout of results, in which their arrays have names and shapes."""
_DIGEST = "digest"

Arrays = Mapping[str, Any]


class Array(NamedTuple):
    """What an array of a file is."""

    kinds: str  # of NumPy's types: f is real, i and u are whole, U is text
    shape: tuple[int | str, ...]  # lengths of its axes; those of one name are equal
    optional: bool = False


Layout = Mapping[str, Array]
"""Arrays of a file by name."""
Described = Mapping[str, tuple[np.dtype, tuple[int, ...]]]
"""Types and shapes of a file's arrays by name, as their heads say."""
_HEAD: Layout = {"about": Array("U", ()), "code": Array("U", ()), "schema": Array("iu", ())}


class ArrayFileError(ValueError):
    """A file is not what was written, or not of this kind; the message says so of the file."""


def save(path: Path, arrays: Arrays) -> None:
    """Writes arrays by name, as a whole or not at all."""
    with files.atomically(path) as part:
        part.write_bytes(packed(arrays))


def load(path: Path, layout: Layout | None = None) -> dict[str, np.ndarray]:
    """Reads the arrays of a file; texts in them are one line each.

    Args:
      layout: The arrays that it has; None for any numbers and texts, not too large to be read.

    Raises:
      OSError: If there is no file that can be opened; see `files.opened`.
      ArrayFileError: If it is damaged, or has other arrays than the layout.
    """
    with files.opened(path) as file:
        return unpacked(file, path, layout)


def packed(arrays: Arrays) -> bytes:
    """Arrays by name, without those that are None, and the digest of all of them."""
    stored: dict[str, Any] = {n: np.asarray(v) for n, v in arrays.items() if v is not None}
    stored[_DIGEST] = np.array(_digest(stored))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **stored)
    return buffer.getvalue()


def unpacked(file: BinaryIO, path: Path, layout: Layout | None) -> dict[str, np.ndarray]:
    """The arrays that `packed` had; `path` is for the error."""
    try:
        with zipfile.ZipFile(file) as archive:
            described = dict(_heads(archive))
        if layout is None:
            layout = {name: Array("biufU", shape) for name, (_, shape) in described.items()}
        wrong = problem(described, {**layout, _DIGEST: Array("U", ())})
        if not wrong:
            file.seek(0)
            with np.load(file, allow_pickle=False) as stored:
                arrays = {name: np.asarray(stored[name]) for name in stored.files}
            if str(arrays.pop(_DIGEST)) == _digest(arrays):
                return {name: _lines(value) for name, value in arrays.items()}
    except Exception as error:  # zip, zlib and NumPy have a dozen kinds for what damage they find
        raise ArrayFileError(
            f"{path} is damaged, or another version wrote it: {error!r}"
        ) from error
    if wrong:
        raise ArrayFileError(f"{path} is of another kind, or another version wrote it: {wrong}")
    raise ArrayFileError(f"{path} is damaged: it does not hold what was written")


def _heads(archive: zipfile.ZipFile) -> Iterator[tuple[str, tuple[np.dtype, tuple[int, ...]]]]:
    """Types and shapes of the arrays of a file, by name; nothing of them is read."""
    for entry in archive.infolist():
        with archive.open(entry) as array:
            version = np.lib.format.read_magic(array)
            read = np.lib.format.read_array_header_1_0
            if version != (1, 0):
                read = np.lib.format.read_array_header_2_0
            shape, _, dtype = read(array)
        if entry.file_size - dtype.itemsize * math.prod(shape) not in range(1 << 16):
            raise ValueError(f"{entry.filename} is not as long as its head says")
        yield entry.filename.removesuffix(".npy"), (dtype, shape)


def problem(described: Described, layout: Layout) -> str:
    """Which array is none of a layout, or too large to be read; nothing if each is one."""
    lengths: dict[int | str, int] = {}
    missing = [name for name, array in layout.items() if not array.optional]
    if lacking := [name for name in missing if name not in described]:
        return f"it has no array {lacking[0]!r}"
    for name, (dtype, shape) in described.items():
        if name not in layout:
            return f"it has an array {name!r}"
        array = layout[name]
        # What has no numbers has the type of none: NumPy calls no texts real numbers.
        if dtype.kind not in array.kinds and math.prod(shape):
            return f"its array {name!r} has the type {dtype}"
        fits = len(shape) == len(array.shape) and all(
            length == (axis if isinstance(axis, int) else lengths.setdefault(axis, length))
            for axis, length in zip(array.shape, shape, strict=True)
        )
        if not fits:
            return f"its array {name!r} has the shape {shape}"
        if dtype.kind == "U" and (
            math.prod(shape) > MOST_TEXTS or not 0 < dtype.itemsize <= 4 * MOST_LETTERS
        ):
            return f"its array {name!r} has too many texts or letters"
    if sum(dtype.itemsize * math.prod(shape) for dtype, shape in described.values()) > MOST:
        return f"it has more than {MOST >> 20:,} MiB"
    return ""


def _lines(value: np.ndarray) -> np.ndarray:
    """An array, of texts the lines that `terminal.line` makes of them."""
    if value.dtype.kind != "U" or all(map(str.isprintable, value.flat)):
        return value
    return np.array([terminal.line(text) for text in value.flat]).reshape(value.shape)


def _digest(arrays: Arrays) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {value.dtype.str} {arrays[name].shape}\n".encode())
        digest.update(value.tobytes())
    return digest.hexdigest()


def head(about: Any) -> dict[str, np.ndarray]:
    """Arrays that say of what results are, for `refusal`."""
    # Results of code that is not known are nobody's: nothing is equal to this.
    code = reuse.code_digest() or f"unknown {uuid.uuid4()}"
    text = json.dumps(about, sort_keys=True)
    return dict(zip(_HEAD, map(np.array, (text, code, SCHEMA)), strict=True))


def refusal(arrays: Arrays, about: Any) -> str:
    """Why results are not taken for those of `about`, with the file as subject; else nothing."""
    different = [name for name, value in head(about).items() if str(arrays.get(name)) != str(value)]
    if not different:
        return ""
    difference = "design or other settings" if different == ["about"] else "version of the code"
    return f"is of another {difference}"


def save_results(path: Path, about: Any, results: Arrays) -> None:
    """Writes results that `load_results` finds again, see `head`."""
    save(path, {**head(about), **results})


def load_results(
    path: Path, about: Any, layout: Layout, *, any_code: bool = False
) -> tuple[dict[str, Any] | None, str]:
    """Results of `about` that are in a file, or None; and what is amiss with them, if anything is.

    Args:
      path: The file; without it there is nothing amiss.
      about: As of `save_results`.
      layout: The arrays beside those of `head`.
      any_code: Whether results of another version of the code are returned, to be shown as such
        and not to go on from.
    """
    try:
        arrays = load(path, {**_HEAD, **layout})
    except FileNotFoundError:
        return None, ""
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    except ArrayFileError:
        return None, "is damaged, or of another version of the code"
    why = refusal(arrays, about)
    same_case = str(arrays.get("about")) == str(head(about)["about"])
    if why and not (any_code and same_case):
        return None, why
    return {name: value for name, value in arrays.items() if name not in _HEAD}, why
