"""Exit statuses.  Nothing heavy is imported here: `--help` is to be quick."""

import contextlib
import errno
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

from codesign_jax.terminal import say

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of a command that Ctrl-C ended."""
TERMINATED = 128 + signal.SIGTERM
"""Exit status of a command that SIGTERM ended."""


_REMEDIES = dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "make room")
_REMEDIES[errno.EIO] = "the disk or the network to it fails; when it works"


def words(error: Exception) -> str:
    """An error as one line for the user, with advice if a disk is full or broken."""
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error)
    name = os.fsdecode(error.filename or "a file").encode("utf-8", "backslashreplace").decode()
    text = f"{name}: {error.strerror}"
    if remedy := _REMEDIES.get(error.errno or 0):
        text += f"; {remedy}, and give the same command again: what was saved is whole"
    return text


class Terminated(KeyboardInterrupt):
    """SIGTERM, as of a scheduler whose time is over: ends a command as Ctrl-C does."""


_DEFAULTS = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Has Ctrl-C raise KeyboardInterrupt also where Python's own handler would lose it.

    SIGTERM raises `Terminated`.  A handler that somebody else has set stays.
    """
    numbers = [
        number
        for number, default in _DEFAULTS.items()
        if threading.current_thread() is threading.main_thread()
        and signal.getsignal(number) is default
    ]
    for number in numbers:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, _DEFAULTS[number])


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt, and later where a callback of garbage collection runs.

    Python ignores the exceptions of such a callback, and JAX has one.
    """
    callbacks = {getattr(function, "__code__", None) for function in gc.callbacks}
    while frame is not None:
        if frame.f_code in callbacks:
            threading.Timer(0.05, os.kill, (os.getpid(), number)).start()
            return
        frame = frame.f_back
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


def of(run: Callable[[], int]) -> int:
    """Runs a parsed command and returns its exit status.

    Wrong input, files that can no longer be written or read, and Ctrl-C are said on stderr.
    """
    try:
        with _interruptible():
            return run()
    except ValueError as error:
        from codesign_jax.scene.schema import InputError

        if not isinstance(error, InputError):
            raise
        for problem in error.problems:
            say(f"error: {problem}", error=True)
        return 2
    except (RuntimeError, AssertionError) as error:
        problem = _known(error)
        if problem is None:
            raise
        say(f"error: {problem}", error=True)
        return 1
    except BrokenPipeError:
        # Who read the output, such as `head`, has enough. The interpreter would complain when it
        # flushes what is left: Python's documentation, library "signal", note on SIGPIPE.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        if error.errno is None:
            raise
        say(f"error: {words(error)}", error=True)
        return 2 if error.errno == errno.ENAMETOOLONG else 1
    except KeyboardInterrupt as stop:
        # Commands with something to save have saved it, and said so, before this.
        say("stopped", error=True)
        return TERMINATED if isinstance(stop, Terminated) else INTERRUPTED


def _known(error: Exception) -> str | None:
    """What an error says to a user who can do something about it; None of any other."""
    from codesign_jax.compiler.ffi import KernelUnavailable
    from codesign_jax.runs.errors import RunError

    if isinstance(error, RunError | KernelUnavailable):
        return str(error)
    return _lacking_platform()


def _lacking_platform() -> str | None:
    """Why JAX has no device where one was asked for; None if it has one."""
    import jax

    platforms = jax.config.jax_platforms  # type: ignore[attr-defined]
    if not platforms:
        return None
    try:
        jax.devices()
    except Exception as error:  # each of JAX's plugins has its own
        why = f" ({error})" if str(error) else ""
        return (
            f"JAX_PLATFORMS={platforms} asks for a device that JAX has not got here{why}: leave it "
            "out, or give cpu"
        )
    return None


def leave(code: int) -> NoReturn:
    """Ends the process at once, without waiting for threads.

    A simulation or a compilation may go on in one, and the interpreter's shutdown would take away
    what it uses: jaxlib 0.10 then waits for seconds, or crashes.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
