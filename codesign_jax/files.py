"""Writes files as a whole or not at all, and says which files of a folder are to be opened."""

import contextlib
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
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


def append(path: Path, text: str) -> None:
    """Adds text to a file of this name alone; makes the file if there is none.

    A link is not followed (OSError), and a FIFO is not waited for. Of a file that has other names
    too, such as of a copy by `cp -al`, the others stay as they are.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    how = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    with naming(path), os.fdopen(os.open(path, how, 0o666), "ab") as file:
        if os.fstat(file.fileno()).st_nlink == 1:
            file.write(text.encode())
            return
    with atomically(path) as part:
        part.write_bytes(path.read_bytes() + text.encode())


def special(folder: Path, names: Iterable[str]) -> list[str]:
    """What lies under these names in a folder and is neither a file nor a folder.

    A link leads out of the folder, a FIFO has its reader wait for ever; archives may hold both.
    Folders are looked into. A name that is not there is none of them.

    Returns:
      Paths relative to the folder, sorted.
    """
    found, left = [], [*names]
    while left:
        name = left.pop()
        try:
            mode = os.lstat(folder / name).st_mode
            inside = os.listdir(folder / name) if stat.S_ISDIR(mode) else []
        except OSError:  # it is not there, or no longer; or it cannot be read, as its reader says
            continue
        left += [f"{name}/{other}" for other in inside]
        if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
            found.append(name)
    return sorted(found)


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
