"""Texts on their way to people: everything that is printed, logged or put on a sheet passes here.

A text may be a stranger's, of a run folder or a file's name: a terminal would take control
characters of it for commands, and an end of a line would begin a line of the stranger's own.
Nothing else of the package prints (ruff's T20 and TID251).
"""

import sys
import unicodedata
from typing import Any, TextIO

import rich.console
import rich.text

CONTROL = {"Cc", "Cs", "Zl", "Zp"}
"""Unicode categories of what is no text: control characters, halves of a pair, ends of lines."""


_ORDER = {*map(chr, (*range(0x202A, 0x202F), *range(0x2066, 0x206A)))}
"""Characters that show the letters behind them in another order."""


def line(text: str) -> str:
    r"""A text as one line: what a terminal would take for a command, or could not show, is escaped.

    >>> print(line(f"red: {chr(27)}[31m, and{chr(10)}another line"))
    red: \x1b[31m, and\nanother line
    """
    if text.isprintable():
        return text
    return "".join(
        ascii(c)[1:-1] if c in _ORDER or unicodedata.category(c) in CONTROL else c for c in text
    )


_AS_THEY_ARE: dict[str, Any] = {"highlight": False, "markup": False, "emoji": False}
_AS_THEY_ARE["soft_wrap"] = True


class Console(rich.console.Console):
    """Prints each text as one line, as it is and as long as it is, and so the cells of tables."""

    def __init__(self, **options: Any):
        """Takes rich's arguments."""
        tolerate(options.get("file") or sys.stdout)
        super().__init__(**_AS_THEY_ARE | options)

    def render_str(self, text: str, **options: Any) -> rich.text.Text:
        """The one way of a text through rich's console."""
        return super().render_str(line(text), **options)


def say(*lines: str, error: bool = False) -> None:
    """Prints lines to the standard output, or to the standard error."""
    stream = sys.stderr if error else sys.stdout
    tolerate(stream)
    print(*map(line, lines), sep="\n", file=stream, flush=error)


def wait(text: str) -> None:
    """Says what takes a while, where a command has asked for it; in the library nothing is said."""
    if waits:
        say(f"{text} ...", error=True)


waits: list[bool] = []
"""Not empty in a process that is a command: then what takes a while is said."""


def tolerate(stream: TextIO) -> None:
    """Has a stream write what its encoding lacks as escapes, in place of an error.

    Python's way with a stream is `strict`, and in the C locale `surrogateescape`.
    """
    reconfigure = getattr(stream, "reconfigure", None)
    if reconfigure is not None and stream.errors in ("strict", "surrogateescape"):
        reconfigure(errors="backslashreplace")
