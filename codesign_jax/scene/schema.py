"""TOML tables to frozen dataclasses, with every error found at once.

A dataclass field made by `quantity` carries its unit and allowed range; `parse` checks types,
ranges and names and reports the key path, the value, the unit, the range and, where one fits, the
unit slip that would explain it.
"""

import dataclasses
import difflib
import functools
import math
import operator
import re
import types
import typing
from typing import Any, TypeVar

import jax
import jax.core
import numpy as np

from codesign_jax import terminal
from codesign_jax.scene import texts
from codesign_jax.scene.texts import SHOWN, shown
from codesign_jax.scene.texts import Problem as Problem

T = TypeVar("T")

_ANGLES = {
    "rad": (math.pi / 180.0, "degrees given where radians are expected"),
    "deg": (180.0 / math.pi, "radians given where degrees are expected"),
}
_PREFIXES = {-6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
_SLIPS = (-3, 3, -6, 6)
"""Powers of ten between units that people mix up, tried in this order."""
_SMALLER = (1e-3, 1e-6, 1e-2)
"""Factors from a smaller unit to the right one."""
_CENTI = -2
"""Power of ten of the centimetre, which people use besides; of nothing else."""
_FAR = 1.5
"""How many times a value lies outside its range before centimetres explain it."""
_UNIT = re.compile(r"(µ|m|k|M)?(m|s|g|N|Pa|Hz)(?![A-Za-z])(.*)")
_COMMON = {"Mg/m^3": "g/cm^3"}
"""What a unit is usually called."""
MOST_ENTRIES = 1000
"""Most entries of an array."""
_UNKNOWN = 20
"""Most unknown keys of a table that are named."""


class InputError(ValueError):
    """Bad input, with all of its problems.

    Attributes:
      problems: Each problem that was found, a sentence with `code` and `key`, see `Problem`.

    >>> from codesign_jax import InputError, scene
    >>> try:
    ...     scene.load("paper", overrides={"gravity": -1, "discretization.links": 0})
    ... except InputError as error:
    ...     print(error)
    discretization.links = 0 is outside [1, 200]
    gravity = -1 is outside [0, 100] m/s^2
    """

    def __init__(self, problems: typing.Sequence[str]):
        """Joins the problems into one message, a line each."""
        every = map(Problem.of, problems)
        self.problems = [problem.told(terminal.line(problem)) for problem in every]
        super().__init__("\n".join(self.problems))

    def __reduce__(self) -> tuple[type, tuple[list[Problem]]]:
        """What a copy or a pickle of it is made of."""
        return type(self), (self.problems,)

    @classmethod
    def of(cls, code: str, problem: str) -> "InputError":
        """The error of one problem, by its kind (`texts.CODES`)."""
        return cls([Problem(code, problem)])


@dataclasses.dataclass(frozen=True)
class Range:
    """Unit and closed range [low, high] of a number."""

    unit: str
    low: float
    high: float


def quantity(
    unit: str,
    low: float,
    high: float,
    *,
    structure: bool = False,
    typical: float | None = None,
    **kwargs: Any,
) -> Any:
    """Declares a numeric dataclass field with its unit and closed range [low, high].

    Programs are compiled for a number of the `structure`; others are leaves, see `table`.
    """
    if typical is None:
        typical = math.sqrt(low * high) if low > 0 else 0.01 * high
    metadata = {"unit": unit, "low": low, "high": high}
    metadata |= {"structure": structure, "typical": typical}
    return dataclasses.field(metadata=metadata, **kwargs)


def choice(*options: str, **kwargs: Any) -> Any:
    """Declares a string dataclass field restricted to the given options."""
    return dataclasses.field(metadata={"options": options}, **kwargs)


def nearest(name: str, names: typing.Iterable[str]) -> str:
    """Returns a hint naming the valid name closest to a misspelt one, or the whole list."""
    names = list(names)
    close = difflib.get_close_matches(name[:SHOWN], names, n=1, cutoff=0.65)
    return f"did you mean {close[0]!r}?" if close else "valid: " + ", ".join(sorted(names))


def unit_slip(value: float, unit: str, low: float, high: float) -> tuple[float, str] | None:
    """The factor between units, and what was mixed up, that would bring a value into its range.

    None for a value in its range, for a number without a unit, and where a guess would be far from
    what people write: micrometres for millimetres, or a tenth of a millisecond for seconds.

    >>> unit_slip(18.0, "m", 0.005, 0.1)
    (0.001, 'mm given where m is expected')
    >>> unit_slip(141.0, "Pa", 1e3, 1e6)
    (1000.0, 'kPa given where Pa is expected')
    >>> unit_slip(9.5, "mm", 20, 200)
    (10.0, 'cm given where mm is expected')
    """
    if low <= value <= high or not 0 < abs(value) < 1e300:
        return None
    return next(
        (
            (f, why)
            for f, why in _slips(unit)
            # In a unit a thousand times smaller than the right one, numbers are large.
            if low <= value * f <= high
            and (abs(value) >= 1 or f not in _SMALLER)
            # Where a range begins at zero, next to nothing is in it and not what is meant.
            and (low > 0 or abs(value * f) >= 0.01 * high)
            # What lies just outside its range is no slip by a factor of 10 or 100.
            and (f not in (10.0, 1e-2) or not low / _FAR < value < high * _FAR)
        ),
        None,
    )


def _slips(unit: str) -> typing.Iterator[tuple[float, str]]:
    """Factors from other units to a unit, and what was mixed up; none for other than SI units."""
    if unit in _ANGLES:
        yield _ANGLES[unit]
    match = _UNIT.fullmatch(unit)
    if match is None:
        return
    prefix, base, rest = match.groups()
    power_of_unit = next(power for power, name in _PREFIXES.items() if name == (prefix or ""))
    for power in _SLIPS:
        other = _PREFIXES.get(power_of_unit + power)
        if other is not None and other != "µ":
            name = f"{other}{base}{rest}"
            yield 10.0**power, f"{_COMMON.get(name, name)} given where {unit} is expected"
    if base == "m" and not rest.startswith("^"):
        yield 10.0 ** (_CENTI - power_of_unit), f"cm{rest} given where {unit} is expected"


def range_problem(path: str, value: float, unit: str, low: float, high: float) -> Problem | None:
    """Returns why a value lies outside its range, or None."""
    words = range_words(value, unit, low, high)
    return Problem("range", f"{path} = {shown(value)} {words}") if words else None


def range_words(value: float, unit: str, low: float, high: float) -> str | None:
    """That a value "is outside" its range, with the unit that would explain it; None if it is."""
    if low <= value <= high:
        return None
    message = f"is outside [{low:g}, {high:g}] {unit}".rstrip()
    slip = unit_slip(value, unit, low, high)
    return f"{message}; did you mean {value * slip[0]:g}? ({slip[1]})" if slip else message


def field_problem(path: str, value: float, cls: type, name: str) -> str | None:
    """Why a value lies outside the range of a field of a table, without a guess, or None."""
    limits = next(_range(field) for field in dataclasses.fields(cls) if field.name == name)
    if limits.low <= value <= limits.high:
        return None
    words = f"is outside [{limits.low:g}, {limits.high:g}] {limits.unit}".rstrip()
    return Problem("range", f"{path} = {value:g} {words}")


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    """Types of a dataclass's fields, which take a seventh of the time to read a file."""
    return typing.get_type_hints(cls)


def parse(cls: type[T], table: Any, path: str, problems: list[str]) -> T | None:
    """Builds a frozen dataclass from a TOML table, appending every problem to `problems`."""
    if not isinstance(table, dict):
        problems.append(Problem("type", f"{path} must be a table, not {type(table).__name__}"))
        return None
    before = len(problems)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    hints = _hints(cls)
    unknown = [key for key in table if key not in fields]
    for key in unknown[:_UNKNOWN]:
        problems.append(
            Problem("unknown", f"{path}.{key[:SHOWN]} is not a known key; {nearest(key, fields)}")
        )
    if len(unknown) > _UNKNOWN:
        problems.append(
            Problem("unknown", f"{path} has {len(unknown) - _UNKNOWN:,} more unknown keys")
        )
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _value(hints[name], table[name], f"{path}.{name}", field, problems)
        elif _required(field):
            unit = field.metadata.get("unit", "")
            problems.append(
                Problem(
                    "missing", f"{path}.{name} is missing" + (f" (unit {unit})" if unit else "")
                )
            )
    return cls(**values) if len(problems) == before else None


_tables: set[type] = set()


def table(cls: type[T]) -> type[T]:
    """Registers a frozen dataclass as a pytree whose numbers a program may trace.

    Its leaves are its numbers that are not structure, also those of tables in it, under the names
    of the file; all else is static.  Whoever makes one, or another one by `dataclasses.replace`, is
    refused what a file is refused, as far as a number is known: a tracer's is not.  JAX, which
    makes trees of anything, is refused nothing.
    """
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    data = tuple(f.name for f in fields if _is_leaf(f) or _holds_tables(f.type))
    static = tuple(f.name for f in fields if f.name not in data)

    leaves_of = _getter(data)
    rest_of = _getter(static)
    keys = tuple(map(jax.tree_util.GetAttrKey, data))

    def parts(value: T) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return leaves_of(value), rest_of(value)

    def named_parts(value: T) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return tuple(zip(keys, leaves_of(value), strict=True)), rest_of(value)

    def whole(rest: tuple[Any, ...], leaves: typing.Iterable[Any]) -> T:
        instance = object.__new__(cls)
        instance.__dict__.update(zip(static, rest, strict=True))
        instance.__dict__.update(zip(data, leaves, strict=True))
        return instance

    jax.tree_util.register_pytree_with_keys(cls, named_parts, whole, parts)
    _tables.add(cls)
    _check_when_made(cls)
    return cls


def _getter(names: tuple[str, ...]) -> typing.Callable[[Any], tuple[Any, ...]]:
    """A function to the attributes of these names, as a tuple."""
    if len(names) > 1:
        return operator.attrgetter(*names)
    return lambda value: tuple(getattr(value, name) for name in names)


def _check_when_made(cls: type) -> None:
    make = cls.__init__
    name = cls.__name__.lower()
    numbers = [field for field in dataclasses.fields(cls) if _is_leaf(field)]

    @functools.wraps(make)
    def checked(self: Any, *arguments: Any, **named: Any) -> None:
        make(self, *arguments, **named)
        checks = (_known_problem(f"{name}.{f.name}", getattr(self, f.name), f) for f in numbers)
        if problems := [problem for problem in checks if problem]:
            raise InputError(problems)

    cls.__init__ = checked


def _known_problem(path: str, value: Any, field: dataclasses.Field[Any]) -> str | None:
    """The problem with the numbers of a field of a table, as far as they are known."""
    if isinstance(value, tuple):
        entry_problems = (_known_problem(f"{path}[{i}]", v, field) for i, v in enumerate(value))
        return next(filter(None, entry_problems), None)
    if isinstance(value, bool | str):
        return Problem("type", f"{path} = {shown(value)} must be {_kind(float, field)}")
    known = isinstance(value, int | float | np.number | np.ndarray)
    if isinstance(value, jax.Array) and not isinstance(value, jax.core.Tracer):
        known = value.is_fully_addressable
    if not known or np.asarray(value).dtype.kind not in "fiuV":  # V: bfloat16
        return None
    every = np.unique(np.asarray(value, float))
    return next(filter(None, (near_problem(path, float(v), _range(field)) for v in every)), None)


def near_problem(path: str, value: float, expected: Range) -> str | None:
    """Like `range_problem` for former float32 numbers: the one nearest to a bound is inside."""
    low, high = (b + side * 1e-6 * abs(b) for b, side in ((expected.low, -1), (expected.high, 1)))
    if low <= value <= high:
        return None
    return range_problem(path, value, expected.unit, expected.low, expected.high)


def replaced(table: T, /, **changes: Any) -> T:
    """Like `dataclasses.replace`, for computed numbers, which may leave their ranges."""
    instance = object.__new__(type(table))
    instance.__dict__.update({f.name: getattr(table, f.name) for f in dataclasses.fields(table)})  # type: ignore[arg-type]
    instance.__dict__.update(changes)
    return instance


def _is_leaf(field: dataclasses.Field[Any]) -> bool:
    return "low" in field.metadata and not field.metadata["structure"]


def _holds_tables(hint: Any) -> bool:
    return hint in _tables or any(map(_holds_tables, typing.get_args(hint)))


def each(table: T, leaf: typing.Callable[[dataclasses.Field[Any]], Any]) -> T:
    """The table with leaf(field) in place of each of its leaves."""
    changes: dict[str, Any] = {}
    for field in dataclasses.fields(table):  # type: ignore[arg-type]
        value = getattr(table, field.name)
        several = isinstance(value, tuple)
        entries = value if isinstance(value, tuple) else (value,)
        if value is None or not (_is_leaf(field) or type(entries[:1] and entries[0]) in _tables):
            continue
        new = tuple(leaf(field) if _is_leaf(field) else each(v, leaf) for v in entries)
        changes[field.name] = new if several else new[0]
    return dataclasses.replace(table, **changes)  # type: ignore[type-var]


def ranges(table: T) -> T:
    """The table with a `Range` in place of each of its leaves."""
    return each(table, _range)


def typical(table: T) -> T:
    """The table with a fixed value for each of its leaves."""
    return each(table, lambda field: field.metadata["typical"])


def _range(field: dataclasses.Field[Any]) -> Range:
    return Range(*(field.metadata[key] for key in ("unit", "low", "high")))


def _required(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is missing and field.default_factory is missing


def _value(
    hint: Any, value: Any, path: str, field: dataclasses.Field[Any], problems: list[str]
) -> Any:
    if isinstance(hint, types.UnionType):
        # "X | None": TOML has no null, so a given value is an X. "X | tuple[X, ...]": one or many.
        kinds = [a for a in typing.get_args(hint) if a is not type(None)]
        many = [a for a in kinds if typing.get_origin(a) is tuple]
        hint = many[0] if many and isinstance(value, list) else kinds[0]
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list):
            problems.append(Problem("type", f"{path} must be an array, not {type(value).__name__}"))
            return None
        if len(value) > MOST_ENTRIES:
            problems.append(
                Problem("range", f"{path} has {len(value):,} entries, more than {MOST_ENTRIES:,}")
            )
            return None
        item = typing.get_args(hint)[0]
        return tuple(_value(item, v, f"{path}[{i}]", field, problems) for i, v in enumerate(value))
    if dataclasses.is_dataclass(hint):
        return parse(hint, value, path, problems)  # type: ignore[arg-type]
    if typing.get_origin(hint) is dict:
        if not isinstance(value, dict):
            problems.append(Problem("type", f"{path} must be a table, not {type(value).__name__}"))
        return value
    return _scalar(hint, value, path, field, problems)


def _scalar(
    hint: Any, value: Any, path: str, field: dataclasses.Field[Any], problems: list[str]
) -> Any:
    accepted = (int, float) if hint is float else hint
    if not isinstance(value, accepted) or (isinstance(value, bool) and hint is not bool):
        problems.append(Problem("type", f"{path} = {shown(value)} must be {_kind(hint, field)}"))
        return None
    if isinstance(value, str):
        problem = texts.problem(path, value, lines=field.name == "description")
        if problem:
            problems.append(problem)
            return None
    options = field.metadata.get("options")
    if options and value not in options:
        problems.append(
            Problem(
                "unknown", f"{path} = {shown(value)} is not valid; {nearest(str(value), options)}"
            )
        )
    if "low" in field.metadata and not isinstance(value, str):
        problem = range_problem(path, value, *dataclasses.astuple(_range(field)))
        if problem:
            problems.append(problem)
            return None
    try:
        return float(value) if hint is float else value
    except OverflowError:
        problems.append(Problem("range", f"{path} = {shown(value)} is too large"))
        return None


def _kind(hint: type, field: dataclasses.Field[Any]) -> str:
    if hint is bool:
        return "true or false"
    if hint is str:
        options = field.metadata.get("options")
        return f"one of {', '.join(options)}" if options else "text"
    words = "a whole number" if hint is int else "a number"
    if "low" in field.metadata:
        limits = _range(field)
        words = f"{words} in [{limits.low:g}, {limits.high:g}] {limits.unit}".rstrip()
    return words
