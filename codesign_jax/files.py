"""Writes files as a whole or not at all, and opens none that is a link, a FIFO or a device."""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def atomically(path: Path) -> Iterator[Path]:
    """Replaces a file as a whole: readers find the old one or the new one, at any time.

    Yields a path beside it; a killed process leaves that behind, with a name in .tmp. The folder
    must exist: one that was moved while a command runs is not made again under its old name.
    """
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
    too, such as of a copy by `cp -al`, the others stay as they are. The folder must exist.
    """
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    with naming(path), os.fdopen(os.open(path, flags, 0o666), "ab") as file:
        if os.fstat(file.fileno()).st_nlink == 1:
            file.write(text.encode())
            return
    with atomically(path) as part:
        part.write_bytes(path.read_bytes() + text.encode())


def make_folder_of(path: Path) -> None:
    """Makes the folder of a file that a flag names, and those above it."""
    path.parent.mkdir(parents=True, exist_ok=True)


def opened(path: Path) -> BinaryIO:
    """Opens a regular file for reading.

    Raises:
      OSError: If it cannot be opened, or is a folder, a FIFO or a device: the reader of a FIFO
        waits until somebody writes to it, and some devices have no end.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "is no file but a FIFO or a device", str(path))
        return os.fdopen(descriptor, "rb")
    except OSError:
        os.close(descriptor)
        raise


def read(path: Path) -> bytes:
    """Content of a regular file; errors as of `opened`."""
    with opened(path) as file:
        return file.read()


def special(folder: Path, names: Iterable[str]) -> list[str]:
    """Entries of these names in a folder that are neither files nor folders.

    A link leads out of the folder, a FIFO has its reader wait for ever; archives may hold both.
    Folders are looked into. A name that is not there is none of them.

    Returns:
      Paths relative to the folder, sorted.
    """
    names_found = []
    pending = [*names]
    while pending:
        name = pending.pop()
        try:
            mode = os.lstat(folder / name).st_mode
            inside = os.listdir(folder / name) if stat.S_ISDIR(mode) else []
        except OSError:  # it is not there, or no longer; or it cannot be read, as its reader says
            continue
        pending += [f"{name}/{other}" for other in inside]
        if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
            names_found.append(name)
    return sorted(names_found)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Gives an error of writing to a file, such as of a full disk, the file's name."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


MANIFEST = "manifest.json"
"""File of a folder from `whole_folder` that lists its files."""
_ABOUT = "Files of this folder with their SHA-256. Writing it again replaces these and no others."


@contextlib.contextmanager
def whole_folder(
    path: Path, *, replace: bool = True, facts: Mapping[str, str] | None = None
) -> Iterator[Path]:
    """Fills a folder as a whole: what is written to the yielded one appears there at the end.

    `MANIFEST` lists what was written.  Where the folder has one already, the files that it lists
    are replaced whole: those that were not written again go, unless somebody changed them.  Files
    that it does not list stay; `foreign` has them.

    Args:
      path: The folder.
      replace: Whether it may have files by the time that the new ones are complete.
      facts: What `MANIFEST` says of the folder beside its files, by other names than those.

    Raises:
      OSError: Also if another call is filling the same folder, and if it has files that are not to
        be replaced.
    """
    path = path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    part, lock = _begin(path)
    try:
        yield part
        _write_manifest(part, _digests(part), facts=facts)
        _move(part, path, replace=replace)
    finally:
        os.close(lock)
        remove(part)


def foreign(path: Path) -> list[str]:
    """Files below a folder that its `MANIFEST` does not list, by their paths in it."""
    listed = {MANIFEST, *_listed(path)}
    return [name for name in _names(path) if name not in listed]


def _begin(path: Path) -> tuple[Path, int]:
    """Makes the folder in which `path` is prepared, of this call alone, and locks it."""
    with _mutex(path.parent) as exclusive:
        pattern = re.compile(rf"\.{re.escape(path.name)}\.([0-9a-f]{{16}}\.)?part")
        for other in path.parent.iterdir():
            if not pattern.fullmatch(other.name):
                continue
            if _in_use(other):
                why = "another export is writing to it; wait for that one, or choose another folder"
                raise BlockingIOError(errno.EAGAIN, why)
            if exclusive:  # otherwise nobody can say that it is a killed process's
                remove(other)
        part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
        part.mkdir()
        lock = os.open(part, os.O_RDONLY)
        with contextlib.suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return part, lock


@contextlib.contextmanager
def _mutex(folder: Path) -> Iterator[bool]:
    """Lets one process at a time in; yields whether the file system can do that."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        exclusive = True
    except OSError:
        exclusive = False
    try:
        yield exclusive
    finally:
        os.close(descriptor)


def _in_use(folder: Path) -> bool:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False


def _move(part: Path, path: Path, *, replace: bool) -> None:
    if not path.is_dir() or not any(path.iterdir()):
        with contextlib.suppress(OSError):  # an empty mount point cannot be replaced, but filled
            os.replace(part, path)
            return
    if not replace and any(path.iterdir()):
        raise FileExistsError(errno.EEXIST, "has files that were not there when this call began")
    before = _listed(path)
    after = _listed(part)
    # A process that is killed in between leaves a list of both, so that the next call finds all.
    path.mkdir(exist_ok=True)
    with atomically(path / MANIFEST) as temporary:
        _write_manifest(temporary.parent, before | after, temporary.name)
    for name in after:
        target = path / name
        if target.is_dir() and not target.is_symlink():
            raise IsADirectoryError(errno.EISDIR, f"{name} is a folder where a file belongs")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(part / name, target)
    for name in before.keys() - after.keys():
        _remove_listed(path, name, before[name])
    shutil.move(part / MANIFEST, path / MANIFEST)


def _remove_listed(path: Path, name: str, digest: str) -> None:
    """Deletes a file of an earlier manifest if it is within the folder and as it was written."""
    file = path / name
    inside = file.parent.resolve().is_relative_to(path)
    if not inside or file.is_symlink() or not file.is_file() or _digest(file) != digest:
        return
    file.unlink()
    for parent in file.parents:
        if parent == path or any(parent.iterdir()):
            break
        parent.rmdir()


def _names(path: Path) -> list[str]:
    """Paths of the files below a folder, relative to it."""
    paths = (Path(folder, name) for folder, _, names in os.walk(path) for name in names)
    return sorted(file.relative_to(path).as_posix() for file in paths)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digests(path: Path) -> dict[str, str]:
    return {name: _digest(path / name) for name in _names(path)}


def _write_manifest(
    folder: Path,
    digests: dict[str, str],
    name: str = MANIFEST,
    facts: Mapping[str, str] | None = None,
) -> None:
    content = {"about": _ABOUT, **(facts or {}), "files": digests}
    text = json.dumps(content, indent=1, ensure_ascii=False)
    (folder / name).write_text(text + "\n", encoding="utf-8")


def _listed(path: Path) -> dict[str, str]:
    """Files that a folder's manifest lists; none if it has no manifest, or one that is damaged."""
    try:
        listed = json.loads((path / MANIFEST).read_text(encoding="utf-8"))["files"]
        return {str(name): str(digest) for name, digest in listed.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


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
