"""The command in forks of a process that has imported everything and used nothing of JAX.

A process of `codesign` imports for seconds, and none of its files is touched meanwhile. A fork
begins after that. multiprocessing's fork server has no backend and no thread of JAX's: to fork
later is what JAX forbids.
"""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Iterable
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

_SET_PDEATHSIG, _CAPBSET_DROP = 1, 24
_DAC_OVERRIDE, _DAC_READ_SEARCH = 1, 2


def end_with_parent() -> None:
    """Lets the kernel end this process when the one that started it ends."""
    ctypes.CDLL(None).prctl(_SET_PDEATHSIG, signal.SIGKILL)


def obey_permissions() -> None:
    """Gives up root's right to read and write what a file's permissions forbid, for good."""

    class Header(ctypes.Structure):
        _fields_ = [("version", ctypes.c_uint32), ("pid", ctypes.c_int)]

    class Data(ctypes.Structure):
        _fields_ = [(name, ctypes.c_uint32) for name in ("effective", "permitted", "inherited")]

    library, header, data = ctypes.CDLL(None), Header(0x20080522, 0), (Data * 2)()
    for capability in (_DAC_OVERRIDE, _DAC_READ_SEARCH):
        library.prctl(_CAPBSET_DROP, capability, 0, 0, 0)  # or the next program has it again
    library.capget(ctypes.byref(header), data)
    keep = ~((1 << _DAC_OVERRIDE) | (1 << _DAC_READ_SEARCH)) & 0xFFFFFFFF
    for name in ("effective", "permitted", "inherited"):
        setattr(data[0], name, getattr(data[0], name) & keep)
    library.capset(ctypes.byref(header), data)


class Forked:
    """The command in a process of its own."""

    def __init__(self, process: Any, log: Path):
        """Takes a process of multiprocessing's that runs, whose output goes to `log`."""
        self._process, self._log = process, log

    def send(self, number: int) -> None:
        """Sends a signal; nothing happens if it has ended."""
        if self._process.exitcode is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, number)

    def wait(self, limit: float) -> int | None:
        """Exit status, negative for a signal; None if it goes on after `limit` seconds."""
        self._process.join(limit)
        return self._process.exitcode

    def text(self) -> str:
        """What it has written to stdout and stderr."""
        return self._log.read_text(encoding="utf-8", errors="replace")


class Server:
    """Starts commands in forks of a process that has imported modules."""

    def __init__(self, modules: Iterable[str]):
        """Takes the names of the modules; the first fork waits until they are imported."""
        self._context: ForkServerContext = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([*modules])

    def start(
        self,
        arguments: list[str],
        log: Path,
        *,
        environment: dict[str, str],
        arm: tuple[Path, Path, int, int] | None = None,
        real: bool = False,
    ) -> Forked:
        """Starts the command in a fork, in this process's working directory.

        Args:
          arguments: Arguments of `codesign`.
          log: File for its output.
          environment: Variables to change.
          arm: Arguments of `Shim.arm`, with the library before them; None: no fault.
          real: Whether the fork becomes a new interpreter, as a user's, which imports by itself.
        """
        log.touch()
        given = arguments, log, environment, arm, real
        process = self._context.Process(target=_command, args=given, daemon=True)
        process.start()
        return Forked(process, log)


def _command(
    arguments: list[str],
    log: Path,
    environment: dict[str, str],
    arm: tuple[Path, Path, int, int] | None,
    real: bool,
) -> None:
    """Runs the command in a fork and ends it as the program does; never returns."""
    end_with_parent()
    output = os.open(log, os.O_WRONLY | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.environ.update(environment)
    if real:
        os.execv(sys.executable, [sys.executable, "-m", "codesign_jax.cli", *arguments])
    code, begun = 1, False
    try:
        if arm is not None:
            from scripts.faults.shim import Mode, Shim

            library, folder, at, mode = arm
            Shim(library).arm(folder, at, Mode(mode))
        from codesign_jax import cli

        sys.argv = ["codesign", *arguments]
        begun = True
        code = cli.main(arguments)
    except SystemExit as stop:  # how the parser refuses
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException as error:  # as the interpreter would say it
        if begun or not isinstance(error, KeyboardInterrupt):
            traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
