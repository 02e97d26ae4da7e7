"""What cases work with: scratch folders, and the command in this process and in others."""

import contextlib
import fcntl
import gc
import os
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from scripts.faults import shim
from scripts.faults.forked import Forked, Server

LIMIT = 300.0
"""Time that a process may take on a busy machine [s]; the longest take 30 s on an idle one."""


class Said(NamedTuple):
    """How the command ended: its exit status and what it wrote to stdout and stderr."""

    code: int
    text: str

    @property
    def traceback(self) -> bool:
        """Whether an exception of Python's got out, or one was never fetched."""
        return "Traceback (most recent call last)" in self.text

    @property
    def refused(self) -> bool:
        """Whether the command said in words that it does not do it."""
        return self.code in (1, 2) and "error: " in self.text and not self.traceback


class Hung(Exception):
    """A process did not end within its time; it was killed."""


class Bench:
    """A worker's place: one process, what starts others, one folder.

    Attributes:
      folder: Folder of finished runs and of what cases leave, until their end.
      shim: The preloaded library.
    """

    def __init__(self, folder: Path, library: Path, server: Server):
        """Takes the worker's folder, the preloaded library and what starts processes."""
        self.folder, self._library, self._server = folder, library, server
        self.shim = shim.Shim(library)
        self.scratch_folders = Path(tempfile.mkdtemp(prefix="case-", dir=folder))
        self._log = self.scratch_folders / "output"

    @contextlib.contextmanager
    def making(self, path: Path) -> Iterator[bool]:
        """Whether what all workers share has to be made; no other worker makes it meanwhile.

        Args:
          path: A file or folder that is there once it is made.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            yield False
            return
        with path.with_name(f"{path.name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield not path.exists()

    @contextlib.contextmanager
    def scratch(self) -> Iterator[Path]:
        """An empty folder for one case, which is the working directory meanwhile."""
        place = Path(tempfile.mkdtemp(prefix="", dir=self.scratch_folders))
        before = Path.cwd()
        os.chdir(place)
        try:
            yield place
        finally:
            os.chdir(before)
            _delete(place)

    def close(self) -> None:
        """Deletes what cases left."""
        _delete(self.scratch_folders)

    def command(self, *arguments: object) -> Said:
        """Runs the command in this process, whose compiled programs are kept."""
        from codesign_jax import cli

        words = [str(a) for a in arguments]
        sys.argv = ["codesign", *words]
        with _output(self._log):
            try:
                code = cli.main(words)
            except SystemExit as stop:  # how the parser refuses
                code = stop.code if isinstance(stop.code, int) else 1
            except BaseException:
                traceback.print_exc()
                code = 1
            gc.collect()  # a task whose exception nobody fetched says so when it is collected
            gc.freeze()  # what is left is not searched again
        return Said(code, self._log.read_text(encoding="utf-8", errors="replace"))

    def start(
        self,
        *arguments: object,
        environment: dict[str, str] | None = None,
        armed: tuple[Path, int, shim.Mode] | None = None,
        real: bool = False,
    ) -> Forked:
        """Starts the command in a process of its own.

        Args:
          *arguments: Arguments of `codesign`.
          environment: Variables to change.
          armed: Arguments of `Shim.arm`.
          real: Whether to start a new interpreter instead of a fork.
        """
        log = self.scratch_folders / f"output-{time.monotonic_ns()}"
        changed, arm = dict(environment or {}), None
        if armed is not None and real:
            changed |= shim.environment(self._library, *armed)
        elif armed is not None:
            arm = self._library, armed[0].absolute(), armed[1], int(armed[2])
        words = [str(a) for a in arguments]
        return self._server.start(words, log, environment=changed, arm=arm, real=real)

    def finish(self, process: Forked, limit: float = LIMIT) -> Said:
        """Waits for a process.

        Raises:
          Hung: If it does not end in time; it is killed then.
        """
        code = process.wait(limit)
        if code is None:
            process.send(9)
            process.wait(limit)
            raise Hung(process.text())
        return Said(code, process.text())


@contextlib.contextmanager
def _output(log: Path) -> Iterator[None]:
    """Sends what this process writes to stdout and stderr, libraries in C included, to a file."""
    kept = [os.dup(1), os.dup(2)]
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    try:
        os.dup2(file, 1)
        os.dup2(file, 2)
        os.close(file)
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        for number, old in enumerate(kept, 1):
            os.dup2(old, number)
            os.close(old)


def _delete(folder: Path) -> None:
    """Deletes a folder whatever its permissions are."""
    for place, folders, _ in os.walk(folder):
        for name in folders:
            path = os.path.join(place, name)
            if not os.path.islink(path):
                os.chmod(path, 0o700)
    shutil.rmtree(folder, ignore_errors=True)
