"""Ways to damage a file."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path


def _cut(keep: Callable[[int], int]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        os.truncate(path, max(keep(path.stat().st_size), 0))

    return change


def _flip(place: Callable[[int], int]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        content = bytearray(path.read_bytes())
        if content:
            content[place(len(content))] ^= 1
            path.write_bytes(content)

    return change


def _zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def _append(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\n\x00more")


def _rename(path: Path) -> None:
    path.rename(path.with_name(f"{path.name}.old"))


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _link(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.parent / "nowhere")


def _other(path: Path) -> None:
    path.write_bytes(bytes(range(256)) * 4)


WAYS: dict[str, Callable[[Path], None]] = {
    "emptied": _cut(lambda n: 0),
    "half": _cut(lambda n: n // 2),
    "without its last byte": _cut(lambda n: n - 1),
    "first byte flipped": _flip(lambda n: 0),
    "middle byte flipped": _flip(lambda n: n // 2),
    "last byte flipped": _flip(lambda n: n - 1),
    "zeros": _zeros,
    "deleted": Path.unlink,
    "longer": _append,
    "renamed": _rename,
    "a folder": _folder,
    "a link to nowhere": _link,
    "other bytes": _other,
}
"""What is done to a file, by name."""


def content(path: Path) -> bytes | None:
    """What a reader finds at a path; None if it finds no file."""
    try:
        return path.read_bytes()
    except OSError:
        return None


def apply(path: Path, way: str, older: Path | None = None) -> bool:
    """Damages a file; returns whether a reader finds anything else than before.

    Args:
      path: The file.
      way: A name of `WAYS`, or `older` to put another file in its place.
      older: That file.
    """
    before = content(path)
    if way == "older":
        assert older is not None
        shutil.copyfile(older, path)
    else:
        WAYS[way](path)
    return content(path) != before
