"""Arrays in files that are known to be what was written: .npz with a digest of all that they hold.

The checksums of zip leave out names and lengths, and what reads them has an error of its own for
each damage; here there is one.  Results that another process may go on from say as well of which
case they are, by which code and in which layout: `head`, `Store`.
"""

import contextlib
import hashlib
import io
import os
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from codesign_jax import files, sources

DIGEST = "digest"
"""Name of the array that holds the digest of the others."""
MOST = 2**30
"""Most bytes of arrays that a file may unpack to."""
SCHEMA = 1
"""Layout of results, in which their arrays have names and shapes."""
_NUMBER = "number of the part"
_HEAD = 8  # bytes of a part's length


class ArchiveError(ValueError):
    """A file is not what was written, or not of this kind; the message says so of the file."""


def save(path: Path, arrays: Mapping[str, Any], *, compressed: bool = False) -> None:
    """Writes arrays by name, as a whole or not at all.

    Raises:
      OSError: If the file cannot be written.
    """
    with files.atomically(path) as part:
        part.write_bytes(_packed(arrays, compressed))


def load(path: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of a file.

    Raises:
      OSError: If the file cannot be opened.
      ArchiveError: If it is not what `save` wrote.
    """
    with path.open("rb") as file:
        return _unpacked(file, path)


class Parts:
    """A file that grows by arrays, part by part: what is in it is not written again.

    Attributes:
      found: The arrays of each part that was there before, up to the first damaged one.
    """

    def __init__(self, path: Path):
        """Reads what is there; a file that cannot be read counts as none."""
        self._path, self._ends = path, [0]
        self.found: list[dict[str, np.ndarray]] = []
        with contextlib.suppress(OSError, ArchiveError), path.open("rb") as file:
            while size := int.from_bytes(file.read(_HEAD), "little"):
                content = file.read(size) if size <= MOST else b""
                part = _unpacked(io.BytesIO(content), path)
                # A damaged length may reach over a whole part: a zip file is read from its end.
                if part.pop(_NUMBER, None) != len(self.found):
                    break
                self.found.append(part)
                self._ends.append(file.tell())

    def go_on(self, count: int) -> None:
        """Takes only so many of the parts that were found; the next one comes after them."""
        self.found, self._ends = self.found[:count], self._ends[: count + 1]

    def append(self, arrays: Mapping[str, Any]) -> None:
        """Adds a part after the others; a process that is killed leaves these.

        Raises:
          OSError: If the file cannot be written.
        """
        number = np.array(len(self._ends) - 1)
        content = _packed({**arrays, _NUMBER: number}, compressed=False)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("r+b" if self._path.exists() else "wb") as file:
            file.truncate(self._ends[-1])  # without what a killed process began
            file.seek(self._ends[-1])
            file.write(len(content).to_bytes(_HEAD, "little") + content)
            file.flush()
            os.fsync(file.fileno())
        self._ends.append(self._ends[-1] + _HEAD + len(content))


def head(key: str) -> dict[str, np.ndarray]:
    """Arrays that say whose results are; see `refusal`.

    Args:
      key: What determines the results, beside code, versions and device.
    """
    # Results of code that is not known are nobody's: nothing is equal to this.
    code = sources.digest() or f"unknown {uuid.uuid4()}"
    return {"key": np.array(key), "code": np.array(code), "schema": np.array(SCHEMA)}


def refusal(arrays: Mapping[str, np.ndarray], key: str) -> str:
    """Why results must not be taken for those of a key, with the file as subject; else nothing.

    Args:
      arrays: Arrays, among which a `head` is wanted.
      key: The key.
    """
    found = {name: str(arrays.get(name)) for name in ("key", "code", "schema")}
    if found["schema"] == str(SCHEMA) and found["key"] != key:
        return "is of another design or other settings"
    same = found["schema"] == str(SCHEMA) and found["code"] == sources.digest()
    return "" if same else "is of another version of the code"


class Store(Parts):
    """Results of a case that grow part by part, and are found again by the same case and code.

    Attributes:
      found: As of `Parts`: the results.
      refused: Why results that are there are not taken, with the file as subject; empty if they
        are. The next part then takes their place.
    """

    def __init__(self, path: Path, key: str):
        """Reads what is there; a file that cannot be read counts as none.

        Args:
          path: The file.
          key: See `head`.
        """
        super().__init__(path)
        self._key, self.refused = key, refusal(self.found[0], key) if self.found else ""
        if self.refused:
            self.go_on(0)
        self.found = self.found[1:]

    def append(self, arrays: Mapping[str, Any]) -> None:
        """As of `Parts`."""
        if len(self._ends) == 1:
            super().append(head(self._key))
        super().append(arrays)


def _packed(arrays: Mapping[str, Any], compressed: bool) -> bytes:
    found: dict[str, Any] = {n: np.asarray(v) for n, v in arrays.items() if v is not None}
    found[DIGEST] = np.array(_digest(found))
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **found)
    return buffer.getvalue()


def _unpacked(file: BinaryIO, path: Path) -> dict[str, np.ndarray]:
    try:
        with zipfile.ZipFile(file) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size <= MOST:
            with np.load(file, allow_pickle=False) as stored:
                arrays = {name: np.asarray(stored[name]) for name in stored.files}
            if str(arrays.pop(DIGEST)) == _digest(arrays):
                return arrays
    except Exception as error:  # zip, zlib and NumPy have a dozen kinds for what damage they find
        raise ArchiveError(f"{path} is damaged, or another version wrote it: {error!r}") from error
    raise ArchiveError(f"{path} is damaged: it does not hold what was written")


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    found = hashlib.sha256()
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {value.dtype.str} {arrays[name].shape}\n".encode())
        found.update(value.tobytes())
    return found.hexdigest()
