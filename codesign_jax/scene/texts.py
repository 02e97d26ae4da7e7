"""Texts of files and messages: what may stand in them, and how they are shown."""

import codecs
import re
import unicodedata
from collections.abc import Sequence
from typing import Any

from codesign_jax.terminal import CONTROL

MOST_LETTERS = 1000
"""Most characters of a text."""
FEW = 3
"""Items of a long list that a message names."""
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""How a formula begins in a spreadsheet."""
SHOWN = 120
"""Most characters of a value in a message."""
CODES = {
    "conflict": "values that exclude or contradict one another, or a name given twice",
    "damaged": "a file of a run that is not what the run wrote, or another run's",
    "file": "a file or folder that cannot be read or written there",
    "geometry": "a body, a surface or a mould that cannot be",
    "invalid": "anything else",
    "missing": "a value, a name or a file that is not there",
    "order": "values that must grow from one to the next",
    "range": "a number outside of its range, or too many of something",
    "size": "an array of another shape or length",
    "syntax": "a text that cannot be read as what it stands for",
    "type": "a value of another kind",
    "unknown": "a name that there is not",
    "unsupported": "what the scene, the hand or the engine does not do",
    "user_code": "code of the user that fails or breaks its contract",
}
"""Kinds of bad input."""
_ABOUT = re.compile(
    r"(?P<key>(?:--)?[\w./\[\]-]+(?: '?[\w./\[\]-]+'?){0,2}?)"
    r"(?=:| = | (?:is|are|was|has|have|must|cannot|needs|names|leaves|gives|lacks|takes|asks|stands"
    r"|holds|compares)\b)"
)


class Problem(str):
    """A sentence about bad input; it begins with the key path, flag or file that it is about.

    Attributes:
      code: Its kind, one of `CODES`.

    >>> problem = Problem("range", "hand.palm.mass = 250.0 is outside [0.01, 10] kg")
    >>> problem.code, problem.key
    ('range', 'hand.palm.mass')
    """

    code: str

    def __new__(cls, code: str, text: str) -> "Problem":
        """A sentence with its kind."""
        if code not in CODES:
            raise ValueError(f"{code!r} is no kind of problem")
        problem = super().__new__(cls, text)
        problem.code = code
        return problem

    def __getnewargs__(self) -> tuple[str, str]:
        """What a copy or a pickle of it is made of."""
        return self.code, str(self)

    @staticmethod
    def of(text: str) -> "Problem":
        """A text as a problem, of no particular kind if it is none yet."""
        return text if isinstance(text, Problem) else Problem("invalid", text)

    @property
    def key(self) -> str:
        """Key path, flag or file that it is about; empty if it names none."""
        about = _ABOUT.match(self)
        return about["key"] if about else ""

    def told(self, text: str) -> "Problem":
        """The same problem in other words, such as with the file before its key."""
        return Problem(self.code, text)


_TYPESET = str.maketrans(
    dict.fromkeys("\u2010\u2011\u2012\u2013\u2014\u2212\ufe63\uff0d", "-")
    | dict.fromkeys("\u00b7\u00d7\u2217\u22c5", "*")
    | dict.fromkeys("\u00a0\u2007\u2009\u202f", " ")
    | {"\u00f7": "/", "\u2215": "/", "\uff0b": "+"}
)
"""Signs that editors and web pages make of those of a keyboard: minus, times, narrow blanks."""


def typed(text: str) -> str:
    """A formula with the signs of a keyboard in place of typographic ones."""
    return text.translate(_TYPESET)


def shown(value: Any) -> str:
    """A value as in Python's source, for a message; a long one is cut short."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an int of thousands of digits, lists in lists
        return f"({type(value).__name__} too long to show)"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}... ({len(text):,} characters)"


def problem(path: str, text: str, *, lines: bool = False) -> Problem | None:
    """Returns why a text is none that a file, a table or a terminal could hold, or None."""
    if len(text) > MOST_LETTERS:
        return Problem("range", f"{path} has {len(text):,} characters, more than {MOST_LETTERS:,}")
    allowed = "\n\r\t" if lines else ""
    for c in text:
        if unicodedata.category(c) in CONTROL and c not in allowed:
            words = f"has a character that is no text, U+{ord(c):04X}"
            return Problem("syntax", f"{path} = {shown(text)} {words}")
    return None


def some(items: Sequence[str], between: str = ", ") -> str:
    """The first items of a list and the number of the others."""
    rest = len(items) - FEW
    return between.join(items[:FEW]) + (f" and {rest:,} more" if rest > 0 else "")


def cell(value: Any) -> Any:
    r"""A cell of a table: a text that a spreadsheet would take for a formula gets an apostrophe.

    >>> cell('=HYPERLINK("http://a", "b")'), cell("-0.5"), cell(-3)
    ('\'=HYPERLINK("http://a", "b")', '-0.5', -3)
    """
    if not isinstance(value, str) or not value.startswith(_FORMULA):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def foreign(content: bytes) -> str | None:
    """Why a file's bytes are not what its name says, if they begin as other files do."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "is text in UTF-16; save it as UTF-8"
    if content.startswith(b"version https://git-lfs"):
        return "is a Git LFS pointer in place of the file: `git lfs pull` fetches it"
    if content[:200].lstrip().lower().startswith((b"<!doctype html", b"<html")):
        return "is a web page (HTML), most likely of an error, in place of the file"
    return None
