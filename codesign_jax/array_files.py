"""Arrays in files that are known to be what was written, and results that a command goes on from.

The checksums of zip leave out names and lengths, and what reads them has an error of its own for
each damage; here there is one.
"""

import hashlib
import io
import json
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from codesign_jax import files, reuse, terminal

MOST = 2**30
"""Most bytes of arrays that a file may unpack to."""
SCHEMA = 2
"""Layout of results, in which their arrays have names and shapes."""
_DIGEST = "digest"
_HEADS = ("about", "code", "schema")

Arrays = Mapping[str, Any]


class ArrayFileError(ValueError):
    """A file is not what was written, or not of this kind; the message says so of the file."""


def save(path: Path, arrays: Arrays) -> None:
    """Writes arrays by name, as a whole or not at all."""
    with files.atomically(path) as part:
        part.write_bytes(packed(arrays))


def load(path: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of a file; texts in them are one line each."""
    if path.exists() and not path.is_file():  # a FIFO would be waited for
        raise ArrayFileError(f"{path} is no file")
    with path.open("rb") as file:
        return unpacked(file, path)


def packed(arrays: Arrays) -> bytes:
    """Arrays by name, without those that are None, and the digest of all of them."""
    stored: dict[str, Any] = {n: np.asarray(v) for n, v in arrays.items() if v is not None}
    stored[_DIGEST] = np.array(_digest(stored))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **stored)
    return buffer.getvalue()


def unpacked(file: BinaryIO, path: Path) -> dict[str, np.ndarray]:
    """The arrays that `packed` had; `path` is for the error."""
    try:
        with zipfile.ZipFile(file) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size <= MOST:
            with np.load(file, allow_pickle=False) as stored:
                arrays = {name: np.asarray(stored[name]) for name in stored.files}
            if str(arrays.pop(_DIGEST)) == _digest(arrays):
                return {name: _lines(value) for name, value in arrays.items()}
    except Exception as error:  # zip, zlib and NumPy have a dozen kinds for what damage they find
        raise ArrayFileError(
            f"{path} is damaged, or another version wrote it: {error!r}"
        ) from error
    raise ArrayFileError(f"{path} is damaged: it does not hold what was written")


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
    return dict(zip(_HEADS, map(np.array, (text, code, SCHEMA)), strict=True))


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
    path: Path, about: Any, *, any_code: bool = False
) -> tuple[dict[str, Any] | None, str]:
    """Results of `about` that are in a file, or None; and what is amiss with them, if anything is.

    Args:
      path: The file; without it there is nothing amiss.
      about: As of `save_results`.
      any_code: Whether results of another version of the code are returned, to be shown as such
        and not to go on from.
    """
    try:
        arrays = load(path)
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
    return {name: value for name, value in arrays.items() if name not in _HEADS}, why
