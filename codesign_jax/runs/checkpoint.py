"""Checkpoints: orbax in, orbax out; the only module that imports it, and where it is used only.

It takes half a second to import, for which commands without a run folder need not wait.

Orbax 0.12 restores a flipped byte as a wrong number and keeps calling a truncated step its latest.
So every step has a file of SHA-256 digests beside it: of its files, as `sha256sum -c` reads them,
and of its arrays (names, types, shapes, bytes).  That file is written last: a step without it was
cut short.  The newest step whose digests match is used.
"""

import hashlib
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codesign_jax import files

_TEMPORARY = ".orbax-checkpoint-tmp"
"""Mark in the name of a step that orbax is writing."""

Arrays = dict[str, Any]
"""Nested dictionaries of NumPy arrays; orbax stores none of size zero."""


class Restored(NamedTuple):
    """What was found on disk.

    Attributes:
      step: Step restored, or None if there is none.
      arrays: Its arrays, or an empty dictionary.
      damaged: Newer steps that were passed over, newest first, with the reason of each.
    """

    step: int | None
    arrays: Arrays
    damaged: tuple[tuple[int, str], ...]


class Checkpoints:
    """Numbered steps of one run in a folder; use as a context manager.

    One process at a time may have a folder open, but for those that open it read-only.
    """

    def __init__(
        self,
        folder: Path,
        *,
        keep: int = 3,
        tell: Callable[[str], None] = warnings.warn,
        read_only: bool = False,
    ):
        """Opens the folder, and makes it if it is missing.

        Args:
          folder: Folder of the steps.
          keep: Newest steps to keep.
          tell: Called when the folder is closed, with a message, if a step could not be deleted;
            from then on orbax deletes none.
          read_only: Opens a folder that exists and changes nothing in it, not even what a process
            that was killed left of a step: another process may be saving that step now.
        """
        import orbax.checkpoint as ocp

        self.folder = folder.resolve()  # orbax takes absolute paths only
        # Synchronous: an episode counts as saved when the command says so.
        # A thread of orbax's deletes old steps: on a slow file system a step may take a tenth of a
        # second, and a batch of thirty runs, which are saved in turn, would wait for thirty.
        writing = {"max_to_keep": keep, "enable_background_delete": True}
        reading = {"create": False}  # orbax's own read_only warns that the folder is read-only
        options = ocp.CheckpointManagerOptions(
            enable_async_checkpointing=False, **(reading if read_only else writing)
        )
        if not read_only:
            # Not by orbax, which begins a thread for it and does not wait for that when it closes.
            for left in self.folder.glob(f"*{_TEMPORARY}*"):
                shutil.rmtree(left)
        self._args, self._tell = ocp.args, tell
        self._manager = ocp.CheckpointManager(self.folder, options=options)

    def __enter__(self) -> "Checkpoints":
        """Returns itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Closes orbax's manager, which waits until old steps are deleted."""
        try:
            self._manager.close()
        except OSError as error:  # the newest steps are saved all the same
            self._tell(f"old checkpoints in {self.folder} could not be deleted: {error}")

    def save(self, step: int, arrays: Arrays) -> None:
        """Writes a step; it becomes visible at once and as a whole, or not at all.

        Args:
          step: Number of the step, above every saved one.
          arrays: What to save.

        Raises:
          OSError: If it cannot be written, for example on a full disk; older steps stay intact.
        """
        try:
            saved = self._manager.save(step, args=self._args.StandardSave(arrays))
        except ValueError as error:  # how tensorstore says that the disk is full
            raise OSError(f"checkpoint {step} could not be written: {error}") from error
        if not saved:
            raise OSError(f"checkpoint {step} was not written: {self.folder} holds a newer step")
        lines = [f"# arrays {digest(arrays)}"]
        for path in sorted((self.folder / str(step)).rglob("*")):
            if path.is_file():
                name = path.relative_to(self.folder).as_posix()
                lines.append(f"{_file_digest(path)}  {name}")
        with files.atomically(self._digests(step)) as part:
            part.write_text("\n".join(lines) + "\n")
        self._forget_old_digests()

    def restore(self) -> Restored:
        """Reads the newest step whose digest matches; changes nothing on disk."""
        damaged: list[tuple[int, str]] = []
        for step in sorted(self._manager.all_steps(), reverse=True):
            arrays, reason = self._read(step)
            if not reason:
                return Restored(step, arrays, tuple(damaged))
            damaged.append((step, reason))
        return Restored(None, {}, tuple(damaged))

    def discard(self, steps: Iterator[int] | list[int]) -> None:
        """Deletes damaged steps, so that their numbers can be saved again."""
        for step in steps:
            # Not the manager's delete: it fails on a step whose files are missing.
            shutil.rmtree(self.folder / str(step), ignore_errors=True)
            self._digests(step).unlink(missing_ok=True)
        self._manager.reload()

    def _read(self, step: int) -> tuple[Arrays, str]:
        """Returns a step's arrays, or why they cannot be trusted."""
        try:
            lines = self._digests(step).read_text().splitlines()
            expected = lines[0].removeprefix("# arrays ")
            for expected_file, name in (line.split("  ", 1) for line in lines[1:]):
                if _file_digest(self.folder / name) != expected_file:
                    return {}, f"the SHA-256 digest of {name} differs"
            arrays: Any = self._manager.restore(step, args=self._args.StandardRestore())
        except FileNotFoundError as error:
            return {}, f"{Path(error.filename or '').name or 'a file'} is missing"
        except Exception as error:  # damaged files raise whatever the parser at that byte raises
            return {}, f"it cannot be read ({type(error).__name__})"
        return (arrays, "") if digest(arrays) == expected else ({}, "its arrays' digest differs")

    def _digests(self, step: int) -> Path:
        return self.folder / f"{step}.sha256"

    def _forget_old_digests(self) -> None:
        kept = set(self._manager.all_steps())
        for path in self.folder.glob("*.sha256"):
            if path.stem.isdigit() and int(path.stem) not in kept:
                path.unlink(missing_ok=True)


def newest(folder: Path) -> int:
    """Number of the newest step in a folder, good or damaged, by its files alone; -1 for none."""
    steps = (path.stem for path in folder.glob("*.sha256"))
    return max((int(stem) for stem in steps if stem.isdigit()), default=-1)


def digest(arrays: Arrays) -> str:
    """Returns the SHA-256 digest of nested arrays: names, types, shapes and bytes."""
    total = hashlib.sha256()
    for name, value in _leaves(arrays):
        value = np.ascontiguousarray(value)
        total.update(f"{name} {value.dtype.str} {value.shape}\n".encode())
        total.update(value.tobytes())
    return total.hexdigest()


def _file_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _leaves(arrays: Arrays, prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    for name in sorted(arrays):
        value = arrays[name]
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", np.asarray(value)
