"""Checkpoints: orbax in, orbax out; the only module that imports it, and where it is used only.

It takes half a second to import, for which commands without a run folder need not wait.

Orbax 0.12 restores a flipped byte as a wrong number and keeps calling a truncated step its latest.
So every step has a file of SHA-256 digests beside it: of its files, as `sha256sum -c` reads them,
and of its arrays (names, types, shapes, bytes).  That file is written last: a step without it was
cut short.  The newest step whose digests match is used.  A step that is whole, but of another run
or another step of this one, is refused, and so is one that cannot be read for a reason that may
pass: neither is damaged, and only what is damaged may be deleted.  Orbax opens no step whose
digests were not compared.

The first step that a process saves is read back before the run goes on.  Orbax 0.12 saves nothing
that can be read below a path with [ ], which it takes for a pattern, or with a backslash, which it
takes for a slash; so it gets the folder as its descriptor's name, /proc/self/fd/N.  That name also
stays this folder's when somebody moves it.
"""

import errno
import functools
import hashlib
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codesign_jax import array_files, files, terminal
from codesign_jax.array_files import Array, Described
from codesign_jax.runs.errors import RunError
from codesign_jax.runs.manifest import SCHEMA

_DAMAGE = {errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EINVAL, errno.ELOOP, errno.ENAMETOOLONG}
"""Errors of files that are gone or replaced; all others may pass, such as missing permission."""
_DESCRIPTORS = Path("/proc/self/fd")
_MOST_STEPS = 100
"""Newest steps that are tried: a run keeps three, a stranger's folder may have any number."""
_CAUSES = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EACCES, errno.EFBIG)
"""Causes that Orbax's and TensorStore's errors name as the system does."""
_LABEL = "run"
"""Name of the arrays that say whose a step is."""
_LABEL_LAYOUT = {
    f"{_LABEL}/id": Array("u", (16,)),
    **dict.fromkeys((f"{_LABEL}/step", f"{_LABEL}/schema"), Array("iu", ())),
}
_TEMPORARY = ".orbax-checkpoint-tmp"
"""Mark in the name of a step that orbax is writing."""

_MOST_LOGGED = 300
"""Most characters of a message that Orbax logs: it quotes files as a whole."""


def _logged(record: logging.LogRecord) -> bool:
    """Has a message of Orbax's in one line; whether it is to be logged."""
    text = record.getMessage()
    record.msg = terminal.line(text)[:_MOST_LOGGED]
    record.args = None
    # Its threads log the traceback of an error that `Checkpoints.save` raises.
    return "_SignalingThread" not in text


logging.getLogger("absl").addFilter(_logged)

Arrays = dict[str, Any]
"""Nested dictionaries of NumPy arrays; orbax stores none of size zero."""


class Restored(NamedTuple):
    """What was found on disk."""

    step: int | None  # step restored, or None if there is none
    arrays: Arrays  # its arrays, or an empty dictionary
    # Newer steps that were passed over, newest first, with the reason of each
    damaged: tuple[tuple[int, str], ...]


class Checkpoints:
    """Numbered steps of one run in a folder; use as a context manager.

    One process at a time may have a folder open, but for those that open it read-only.
    """

    def __init__(
        self,
        folder: Path,
        *,
        run: str | None = None,
        keep: int = 3,
        tell: Callable[[str], None] = warnings.warn,
        read_only: bool = False,
    ):
        """Opens the folder, and makes it if it is missing."""
        self.folder = folder.resolve()  # for messages, and where there is no /proc
        # Synchronous: an episode counts as saved when the command says so.
        # A thread of orbax's deletes old steps: on a slow file system a step may take a tenth of a
        # second, and a batch of thirty runs, which are saved in turn, would wait for thirty.
        writing = {"max_to_keep": keep, "enable_background_delete": True}
        reading = {"create": False}  # orbax's own read_only warns that the folder is read-only
        self._options: dict[str, Any] = reading if read_only else writing
        if not read_only:
            self.folder.mkdir(exist_ok=True)
        self._descriptor = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
        by_descriptor = _DESCRIPTORS / str(self._descriptor)
        self._place = by_descriptor if by_descriptor.is_dir() else self.folder
        if not read_only:
            # Not by orbax, which begins a thread for it and does not wait for that when it closes.
            for path in self._place.glob(f"*{_TEMPORARY}*"):
                files.remove(path)
        self._tell = tell
        self._run = run
        self._opened: Any = None
        self._read_back = False
        self._own = {*self._steps(), *self._digested()}

    @property
    def _manager(self) -> Any:
        """Orbax's manager, made when it is first needed: it looks at all steps that are there."""
        import orbax.checkpoint as ocp

        if self._opened is None:
            options = ocp.CheckpointManagerOptions(
                enable_async_checkpointing=False, lightweight_initialize=True, **self._options
            )
            handler = ocp.StandardCheckpointHandler()  # named, as its metadata are asked for
            self._opened = ocp.CheckpointManager(
                self._place, options=options, item_handlers=handler
            )
        return self._opened

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *exception: object) -> None:
        """Closes orbax's manager, which waits until old steps are deleted."""
        self._close()
        os.close(self._descriptor)

    def _close(self) -> None:
        opened = self._opened
        self._opened = None
        try:
            if opened is not None:
                opened.close()
        except OSError as error:  # the newest steps are saved all the same
            self._tell(
                f"old checkpoints in {self.folder} could not be deleted: {self._words(error)}"
            )

    def save(self, step: int, arrays: Arrays) -> None:
        """Writes a step; it becomes visible at once and as a whole, or not at all."""
        import orbax.checkpoint as ocp

        labelled = arrays if self._run is None else arrays | {_LABEL: _label(self._run, step)}
        before = sys.unraisablehook
        sys.unraisablehook = functools.partial(_without_closed_loops, before)
        try:
            saved = self._manager.save(step, args=ocp.args.StandardSave(labelled))
            if saved:
                self._write_digests(step, labelled)
        except (OSError, ValueError) as error:  # the latter is how tensorstore says it
            raise self._unsaved(step, error) from error  # its threads go on
        if not saved:
            raise OSError(f"checkpoint {step} was not written: {self.folder} holds a newer step")
        self._own.add(step)
        if not self._read_back:
            self._refuse_unreadable(step, digest(labelled))
        sys.unraisablehook = before
        self._forget_old_digests()

    def _refuse_unreadable(self, step: int, expected: str) -> None:
        """Reads a step back, once: a file system or a path may be one that Orbax cannot bear."""
        import orbax.checkpoint as ocp

        try:
            arrays = self._manager.restore(step, args=ocp.args.StandardRestore())
            why = "" if digest(arrays) == expected else "other arrays are read than were saved"
        except Exception as error:  # orbax and tensorstore have many
            why = self._words(error)[:200]
        if why:
            self.discard([step])
            raise RunError(
                f"what is saved in {self.folder} cannot be read back ({why}): nothing that is "
                "computed there would be kept. Choose another folder by --out"
            )
        self._read_back = True

    def _words(self, error: Exception) -> str:
        """An error's text with the folder by its name."""
        return str(error).replace(str(self._place), str(self.folder))

    def _write_digests(self, step: int, arrays: Arrays) -> None:
        lines = [f"# arrays {digest(arrays)}"]
        for path in sorted((self._place / str(step)).rglob("*")):
            if path.is_file():
                name = path.relative_to(self._place).as_posix()
                lines.append(f"{file_digest(path)}  {name}")
        with files.atomically(self._digests(step)) as part:
            part.write_text("\n".join(lines) + "\n")

    def restore(self, refuse: Callable[[Described], None] = lambda described: None) -> Restored:
        """Reads the newest step whose digest matches; changes nothing on disk.

        Args:
          refuse: Is called with types and shapes of a step's arrays before they are read, by names
            such as `state/key`; raises a `RunError` if they are not the run's.
        """
        damaged: list[tuple[int, str]] = []
        for step in sorted(self._steps(), reverse=True)[:_MOST_STEPS]:
            arrays, reason = self._read(step, refuse)
            if not reason:
                self._check_label(step, arrays.pop(_LABEL, None))
                return Restored(step, arrays, tuple(damaged))
            damaged.append((step, reason))
        return Restored(None, {}, tuple(damaged))

    def _steps(self) -> list[int]:
        """Numbers of the steps that are there, whole or not."""
        names = [path.name for path in self._place.iterdir() if path.is_dir()]
        return [int(name) for name in names if re.fullmatch("0|[1-9][0-9]{0,8}", name)]

    def _digested(self) -> list[int]:
        """Numbers of the steps whose digests are there."""
        return [int(p.stem) for p in self._place.glob("*.sha256") if p.stem.isdecimal()]

    def discard(self, steps: Iterable[int]) -> None:
        """Deletes damaged steps, so that their numbers can be saved again."""
        for step in steps:
            # Not the manager's delete: it fails on a step whose files are missing.
            names = str(step), self._digests(step).name
            try:
                for name in names:
                    files.remove(self._place / name)
            except OSError as error:
                raise RunError(
                    f"checkpoint {step} is damaged, and cannot be deleted ({error.strerror}): "
                    f"delete {names[0]} and {names[1]} in {self.folder} by hand. The same command "
                    "then goes on from the checkpoint before"
                ) from error
        self._close()  # orbax remembers the steps that it met

    def _read(self, step: int, refuse: Callable[[Described], None]) -> tuple[Arrays, str]:
        try:
            expected, reason = self._compare(step)
            if reason:
                return {}, reason
            import orbax.checkpoint as ocp

            refuse(self._described(step))
            arrays: Any = self._manager.restore(step, args=ocp.args.StandardRestore())
        except RunError:
            raise
        except OSError as error:
            name = Path(error.filename or "").name or "a file"
            if error.errno not in _DAMAGE:
                raise self._unreadable(step, f"{name}: {error.strerror}") from error
            missing = error.errno in (errno.ENOENT, errno.ENOTDIR)
            return {}, f"{name} is missing" if missing else f"{name}: {error.strerror}"
        except Exception as error:  # the files are those that were saved, so they are not damaged
            problem = f"{type(error).__name__}: {self._words(error)[:200]}"
            raise self._unreadable(
                step, f"its files are whole, but orbax fails: {problem}"
            ) from error
        return (arrays, "") if digest(arrays) == expected else ({}, "its arrays' digest differs")

    def _described(self, step: int) -> Described:
        """Types and shapes of a step's arrays, but for the label's, whose are checked here."""
        tree = self._manager.item_metadata(step).tree
        described = {name: (np.dtype(v.dtype), tuple(v.shape)) for name, v in _leaves(tree)}
        label = {n: described.pop(n) for n in [*described] if n.startswith(f"{_LABEL}/")}
        if label and (wrong := array_files.problem(label, _LABEL_LAYOUT)):
            raise self._foreign(step, f"no step of a run ({wrong})")
        return described

    def _compare(self, step: int) -> tuple[str, str]:
        """Compares a step's files with their digests; returns the arrays' one and what is wrong."""
        path = self._digests(step)
        try:
            lines = files.read(path).decode().splitlines()
            expected = lines[0].removeprefix("# arrays ")
            pairs = [line.split("  ", 1) for line in lines[1:]]
            named = [(self._place / name, digest, name) for digest, name in pairs]
        except (ValueError, IndexError):
            return "", f"{path.name} is damaged"
        steps = {name.split("/")[0] for _, _, name in named}
        if len(steps) == 1 and steps != {str(step)} and steps.copy().pop().isdigit():
            raise self._foreign(step, f"step {steps.pop()} under another name")
        for file, expected_file, name in named:
            if not name.startswith(f"{step}/") or ".." in name.split("/") or "\0" in name:
                return "", f"{path.name} is damaged"
            if file_digest(file) != expected_file:
                return "", f"the SHA-256 digest of {name} differs"
        return expected, ""

    def _check_label(self, step: int, label: Arrays | None) -> None:
        if label is None and self._run is None:
            return
        try:
            run = bytes(label["id"]).hex()  # type: ignore[index]
            labelled = int(label["step"])  # type: ignore[index]
        except (KeyError, TypeError, ValueError):
            run = None
            labelled = step
        if run != self._run:
            raise self._foreign(step, "of another run")
        if labelled != step:
            raise self._foreign(step, f"step {labelled} under another name")

    def _foreign(self, step: int, state: str) -> RunError:
        return RunError(
            f"{self.folder / str(step)} is {state}, and nothing was changed. Move it and "
            f"{self._digests(step).name} to where they belong"
        )

    def _unreadable(self, step: int, problem: str) -> RunError:
        return RunError(
            f"checkpoint {step} in {self.folder} cannot be read ({problem}), and nothing was "
            "changed. Make it readable and give the command again; or, to lose it and go on from "
            f"the one before, delete {step} and {step}.sha256 there"
        )

    def _digests(self, step: int) -> Path:
        return self._place / f"{step}.sha256"

    def _forget_old_digests(self) -> None:
        """Deletes the digests of steps that this process knows and Orbax has deleted."""
        for step in self._own - {*self._manager.all_steps()}:
            self._digests(step).unlink(missing_ok=True)
            self._own.discard(step)

    def _unsaved(self, step: int, error: Exception) -> OSError:
        text = self._words(error)
        name = f"checkpoint {step} could not be written"
        for number in _CAUSES:
            if getattr(error, "errno", None) == number or os.strerror(number) in text:
                return OSError(number, f"{name}: {os.strerror(number)}", str(self.folder))
        problem = text.splitlines()[0][:200] if text else type(error).__name__
        return OSError(f"{name} to {self.folder}: {problem}")


def digest(arrays: Arrays) -> str:
    """Returns the SHA-256 digest of nested arrays: names, types, shapes and bytes."""
    total = hashlib.sha256()
    for name, value in _leaves(arrays):
        value = np.ascontiguousarray(value)
        total.update(f"{name} {value.dtype.str} {value.shape}\n".encode())
        total.update(value.tobytes())
    return total.hexdigest()


def file_digest(path: Path) -> str:
    with files.opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]


def _label(run: str, step: int) -> Arrays:
    return {
        "id": np.frombuffer(bytes.fromhex(run), np.uint8),
        "step": np.array(step, np.int32),
        "schema": np.array(SCHEMA, np.int32),
    }


def _without_closed_loops(hook: Callable[[Any], Any], unraisable: Any) -> None:
    """A hook for unraisable exceptions without those of tensorstore's threads after a failure.

    Where one file of a step cannot be written, the threads that write the others find the event
    loop closed that they report to, and each would print that.
    """
    if not (
        isinstance(unraisable.exc_value, RuntimeError)
        and "Event loop is closed" in str(unraisable.exc_value)
    ):
        hook(unraisable)


def _leaves(arrays: Arrays, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name in sorted(arrays):
        value = arrays[name]
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", value
