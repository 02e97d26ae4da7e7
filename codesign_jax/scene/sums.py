"""Sums of numbers and names, which key frames have for values: "zero_height + 0.5 * arm_z - 0.01".

A term is a number, a name, or a name with factors before or behind it.  A sum stays a sum: its
numbers are data, as those of other files.

>>> from codesign_jax.scene import sums
>>> sums.read("zero_height + arm_z / 2", "m").term
(Term(name='zero_height', factor=None), Term(name='arm_z', factor=0.5))
>>> sums.read("arm_z * arm_x", "m")
"multiplies 'arm_z' by 'arm_x', but a term has one name, as 0.5 * arm_z"
"""

import dataclasses
import math
import re
import unicodedata
from typing import Any

from codesign_jax.scene import schema, texts
from codesign_jax.scene.schema import quantity, table

RANGES = {"s": (-60, 60), "m": (-2, 2), "deg": (-360, 360), "Pa": (-1e6, 1e6)}
"""Smallest and largest number of a sum, by its unit."""
_FACTOR = 100.0
"""Largest factor of a name."""
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[A-Za-z]\w*)|(?P<operator>[-+*/]))",
    re.ASCII,
)
_NO_SUM = "is no sum of numbers and names, each with a factor if need be"
_WRITTEN = {
    "Pa": ("Pa", 1.0),
    "hPa": ("Pa", 1e2),
    "kPa": ("Pa", 1e3),
    "MPa": ("Pa", 1e6),
    "mbar": ("Pa", 1e2),
    "bar": ("Pa", 1e5),
    "psi": ("Pa", 6894.757293168),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "m": ("m", 1.0),
    "deg": ("deg", 1.0),
    "rad": ("deg", 180.0 / math.pi),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "min": ("s", 60.0),
}
"""Units that people write behind a number: the unit of a sum, and how many of it they are."""


@table
@dataclasses.dataclass(frozen=True)
class Term:
    """A named number times a factor."""

    name: str  # a parameter of the design, or a number of the scene
    # What it is multiplied by; None for 1
    factor: float | None = quantity("", -_FACTOR, _FACTOR, default=None)


@table
@dataclasses.dataclass(frozen=True)
class Sum:
    """A number and named terms."""

    unit: str  # unit of the number, of `RANGES`; the names stand for SI units
    number: float | None = quantity("", -1e6, 1e6, default=None)  # the number; None for none
    term: tuple[Term, ...] = ()


def read(value: Any, unit: str) -> Sum | str:
    """A value of a file as a sum whose numbers are in a unit, or what is wrong with it."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        wrong = schema.range_words(value, unit, *RANGES[unit])
        return wrong or Sum(unit, float(value))
    if not isinstance(value, str) or not value.strip():
        return 'must be a number, or a sum of numbers and names such as "zero_height + arm_z"'
    try:
        number, factors = _Reader(value).total()
    except ValueError as error:
        return str(error)
    if number is not None and (wrong := schema.range_words(number, unit, *RANGES[unit])):
        return f"has the number {number:g}, which {wrong}"
    for name, factor in factors.items():
        if wrong := schema.range_words(factor, "", -_FACTOR, _FACTOR):
            if with_unit := unit_words(name, factor, unit):
                return with_unit
            return f"has the factor {factor:g} of {name!r}, which {wrong}"
    terms = (Term(name, None if f == 1.0 else f) for name, f in factors.items())
    return Sum(unit, number, tuple(terms))


def text(total: Sum) -> str | float:
    """A sum as the value of a file that `read` takes for it."""
    if not total.term:
        return float(total.number or 0.0)
    parts = [t.name if t.factor is None else f"{float(t.factor)!r} * {t.name}" for t in total.term]
    parts += [] if total.number is None else [repr(float(total.number))]
    return " + ".join(parts).replace("+ -", "- ")


def unit_words(name: str, factor: float | None, unit: str) -> str | None:
    """The problem with a term whose name is a unit, as in "50 kPa"; None if it is no unit."""
    if name not in _WRITTEN:
        return None
    kind, size = _WRITTEN[name]
    factor = 1.0 if factor is None else factor
    words = f"has the unit {name!r}, but numbers there are in {unit} and have no unit"
    if kind != unit:
        return words
    return f"{words}; did you mean {factor * size:.10g} for {factor:g} {name}?"


class _Reader:
    """Reads the text of one sum; a ValueError says what is wrong with it."""

    def __init__(self, expression: str):
        self.tokens = self._tokens(texts.typed(expression))
        self.place = 0

    @staticmethod
    def _tokens(expression: str) -> list[tuple[str, str]]:
        tokens = []
        position = 0
        expression = expression.rstrip()
        while position < len(expression):
            match = _TOKEN.match(expression, position)
            if match is None:
                raise ValueError(_foreign(expression[position:].lstrip()[0]))
            kind = str(match.lastgroup)
            tokens.append((kind, match[kind]))
            position = match.end()
        return tokens

    def total(self) -> tuple[float | None, dict[str, float]]:
        """The number, None for none, and the factors of the names."""
        number = None
        factors = {}
        first = True
        while first or self.place < len(self.tokens):
            sign = self._sign(first)
            factor, name = self._term()
            if name in factors:
                raise ValueError(f"has {name!r} twice")
            if name:
                factors[name] = sign * factor
            else:
                number = sign * factor + (number or 0.0)
            first = False
        return number, factors

    def _next(self) -> tuple[str, str]:
        return self.tokens[self.place] if self.place < len(self.tokens) else ("end", "")

    def _sign(self, first: bool) -> float:
        _, token = self._next()
        if token in ("+", "-"):
            self.place += 1
        elif not first:
            raise ValueError(f"{_NO_SUM}: there is no operator before {token!r}")
        return -1.0 if token == "-" else 1.0

    def _term(self) -> tuple[float, str]:
        """Factor and name, empty for none, of a product."""
        factor, name = self._factor(1.0, "", "*")
        while True:
            before = self.tokens[self.place - 1][0]
            kind, token = self._next()
            if token in ("*", "/"):
                self.place += 1
                factor, name = self._factor(factor, name, token)
            elif kind == "name" and before == "number" and not name:  # 0.5 pressure
                factor, name = self._factor(factor, name, "*")
            else:
                return factor, name

    def _factor(self, factor: float, name: str, operator: str) -> tuple[float, str]:
        """The product with one more number or name."""
        kind, token = self._next()
        if kind not in ("number", "name"):
            where = f"before {token!r}" if token else "at its end"
            raise ValueError(f"{_NO_SUM}: a number or a name is missing {where}")
        self.place += 1
        if kind == "number":
            value = float(token)
            if operator == "/" and not value:
                raise ValueError("divides by 0")
            return (factor / value if operator == "/" else factor * value), name
        if operator == "/":
            raise ValueError(f"divides by {token!r}, but only numbers divide")
        if name:
            words = f"but a term has one name, as 0.5 * {name}"
            raise ValueError(f"multiplies {name!r} by {token!r}, {words}")
        return factor, token


def _foreign(character: str) -> str:
    """The problem with a character that is not allowed in a sum."""
    if character == ",":
        return f"{_NO_SUM}: it has a comma; the decimal sign is a point"
    if character in "()[]{}":
        return f"{_NO_SUM}: it has brackets; write each term out"
    code = f"U+{ord(character):04X}"
    name = unicodedata.name(character, "")
    return f"{_NO_SUM}: it has the character {character!r} ({' '.join([code, name]).strip()})"
