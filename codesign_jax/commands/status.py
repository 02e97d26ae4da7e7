"""Exit statuses.  Nothing heavy is imported here: `--help` is to be quick."""

import os
import signal
import sys
from collections.abc import Callable
from typing import NoReturn

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of a command that Ctrl-C ended."""


def of(run: Callable[[], int]) -> int:
    """Runs a parsed command and returns its exit status.

    Wrong input, files that can no longer be written or read, and Ctrl-C are said on stderr.
    """
    try:
        return run()
    except ValueError as error:
        from codesign_jax.scene.schema import SceneError

        if not isinstance(error, SceneError):
            raise
        for problem in error.problems:
            print(f"error: {problem}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # Who read the output, such as `head`, has enough. The interpreter would complain when it
        # flushes what is left: Python's documentation, library "signal", note on SIGPIPE.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        if error.filename is None:
            raise
        print(f"error: {error.filename}: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        # Commands with something to save have saved it, and said so, before this.
        print("stopped", file=sys.stderr)
        return INTERRUPTED


def leave(code: int) -> NoReturn:
    """Ends the process at once, without waiting for threads.

    A simulation or a compilation may go on in one, and the interpreter's shutdown would take away
    what it uses: jaxlib 0.10 then waits for seconds, or crashes.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
