"""Writes files as a whole or not at all."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomically(path: Path) -> Iterator[Path]:
    """Replaces a file as a whole: readers find the old one or the new one, at any time.

    Yields a path beside it; a killed process leaves that behind, with a name in .tmp.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Of this call alone: threads may write the same file, and so may hosts that share a disk.
    temporary = path.with_name(f"{path.name}.{secrets.randbits(64)}.tmp")
    try:
        with naming(path):
            yield temporary
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Gives an error of writing to a file, such as of a full disk, the file's name."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Fills a folder as a whole: what is written to the yielded one appears there at the end.

    New files replace those of the same names, others stay.
    """
    path = path.resolve()
    part = path.with_name(f".{path.name}.part")
    remove(part)
    part.mkdir(parents=True)
    try:
        yield part
    except BaseException:
        shutil.rmtree(part)
        raise
    try:
        os.replace(part, path)  # where there is no folder, or an empty one
    except OSError:
        shutil.copytree(part, path, dirs_exist_ok=True)
        shutil.rmtree(part)


def clear_place(path: Path) -> None:
    """Deletes a folder that lies where a file of a cache belongs: nothing could be kept there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)


def remove(path: Path) -> None:
    """Deletes a file or a folder; of a link the link alone."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
