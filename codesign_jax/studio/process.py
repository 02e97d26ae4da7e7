"""A command of `codesign` that the page starts: one at a time, in a process of its own."""

import contextlib
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from codesign_jax.scene.schema import InputError

RUNNING = "\n..."
"""End of what is told of a command while it runs."""
MOST = 3000
"""Most letters of either output that are told."""
_BUSY = "a command is under way; another one may follow when it has ended"
_under_way = threading.Lock()
"""Held while a command runs, whichever tab started it: a command takes all processors."""


def under_way() -> bool:
    """Whether a command runs."""
    return _under_way.locked()


def check() -> None:
    """Refuses a command, as an InputError, while another one runs."""
    if under_way():
        raise InputError.of("conflict", _BUSY)


def start(words: Sequence[str], tell: Callable[[str], None]) -> None:
    """Starts `codesign words`; tells the line at once, and with what it printed at its end."""
    if not _under_way.acquire(blocking=False):
        raise InputError.of("conflict", _BUSY)
    tell(shlex.join(["codesign", *words]) + RUNNING)
    threading.Thread(target=_run, args=(words, tell), daemon=True).start()


def _run(words: Sequence[str], tell: Callable[[str], None]) -> None:
    # -P: the working directory, which may be a stranger's, has no modules for this command.
    line = [sys.executable, "-P", "-m", "codesign_jax.cli", *words]
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "capture_output": True, "text": True}
    try:
        try:
            ended = subprocess.run(line, check=False, errors="replace", **pipes)
            printed = ended.stdout[-MOST:] + ended.stderr[-MOST:]
        except OSError as error:
            printed = f"error: {error}"
        if "--out" in words:  # a folder that was made to keep its name, if nothing came into it
            with contextlib.suppress(OSError):
                Path(words[words.index("--out") + 1]).rmdir()
        tell(f"{shlex.join(['codesign', *words])}\n{printed.rstrip()}\n")
    finally:
        _under_way.release()
