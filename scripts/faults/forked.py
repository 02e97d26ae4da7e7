"""A process that has imported everything and used nothing of JAX, and forks those that faults end.

A process of `codesign` imports for seconds, and none of its files is touched meanwhile. A fork of
this process begins after that. It is made before JAX has a backend and before any thread of JAX's:
to fork later is what JAX forbids.
"""

import ctypes
import json
import os
import signal
import socket
import sys
import time
import traceback
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
    """A process that the zygote forked."""

    def __init__(self, zygote: "Zygote", pid: int, log: Path):
        """Refers to a running process, whose output goes to `log`."""
        self._zygote, self.pid, self._log = zygote, pid, log
        self._code: int | None = None

    def send(self, number: int) -> None:
        """Sends a signal; nothing happens if it has ended: its number is its own until `wait`."""
        if self._code is None:
            os.kill(self.pid, number)

    def wait(self, limit: float) -> int | None:
        """Exit status, negative for a signal; None if it goes on after `limit` seconds."""
        if self._code is None:
            self._code = self._zygote.ask({"wait": self.pid, "limit": limit})
        return self._code

    def text(self) -> str:
        """What it has written to stdout and stderr."""
        return self._log.read_text(encoding="utf-8", errors="replace")


class Zygote:
    """This process's fork, see the module; nothing of JAX may have been used before."""

    def __init__(self) -> None:
        """Forks it."""
        from jax._src import xla_bridge

        assert not xla_bridge._backends, "JAX has a backend: too late to fork"
        ours, theirs = socket.socketpair()
        self._pid = os.fork()
        if not self._pid:
            ours.close()
            _serve(theirs)
        theirs.close()
        self._lines = ours.makefile("rw", encoding="utf-8")

    def ask(self, request: dict[str, Any]) -> Any:
        """Sends a request and returns the answer."""
        self._lines.write(json.dumps(request) + "\n")
        self._lines.flush()
        return json.loads(self._lines.readline())["answer"]

    def start(
        self,
        arguments: list[str],
        log: Path,
        *,
        environment: dict[str, str],
        arm: list[Any] | None = None,
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
        request = {"start": arguments, "log": str(log), "environment": environment, "arm": arm}
        request |= {"real": real, "folder": os.getcwd()}
        return Forked(self, self.ask(request), log)


def _serve(lines: socket.socket) -> None:
    """Answers requests until the other end is closed, then ends what is left; never returns."""
    end_with_parent()
    running: dict[int, int | None] = {}
    stream = lines.makefile("rw", encoding="utf-8")
    for line in stream:
        request = json.loads(line)
        if "start" in request:
            answer = os.fork()
            if not answer:
                _command(request)
            running[answer] = None
        else:
            answer = _wait(request["wait"], request["limit"])
            if answer is not None:
                running.pop(request["wait"], None)
        stream.write(json.dumps({"answer": answer}) + "\n")
        stream.flush()
    for pid in running:
        os.kill(pid, signal.SIGKILL)
    os._exit(0)


def _wait(pid: int, limit: float) -> int | None:
    until = time.monotonic() + limit
    while True:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            return None
        time.sleep(0.005)


def _command(request: dict[str, Any]) -> None:
    """Runs the command in a fork and ends it as the program does; never returns."""
    end_with_parent()
    log = os.open(request["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    if request["real"]:
        os.execv(sys.executable, [sys.executable, "-m", "codesign_jax.cli", *request["start"]])
    code, begun = 1, False
    try:
        if request["arm"] is not None:
            from scripts.faults.shim import Mode, Shim

            library, folder, at, mode = request["arm"]
            Shim(Path(library)).arm(Path(folder), at, Mode(mode))
        from codesign_jax import cli

        sys.argv = ["codesign", *request["start"]]
        begun = True
        code = cli.main(request["start"])
    except SystemExit as stop:  # how the parser refuses
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException as error:  # as the interpreter would say it
        if begun or not isinstance(error, KeyboardInterrupt):
            traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
