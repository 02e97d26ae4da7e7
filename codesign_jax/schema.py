"""TOML tables to frozen dataclasses, with every error found at once.

A dataclass field made by `quantity` carries its unit and allowed range; `parse` checks types,
ranges and names and reports the key path, the value, the unit, the range and, where one fits, the
unit slip that would explain it.
"""

import dataclasses
import difflib
import math
import types
import typing
from typing import Any, TypeVar

T = TypeVar("T")

# Factors between units that people mix up, tried in this order when a value is out of range.
_UNIT_SLIPS = (
    (1e-3, "milli-unit given where the base unit is expected"),
    (1e3, "kilo-unit given where the base unit is expected"),
    (180.0 / math.pi, "radians given where degrees are expected"),
    (1e-6, "mega-scale slip"),
    (1e6, "micro-scale slip"),
)
_ANGLE_SLIPS = ((math.pi / 180.0, "degrees given where radians are expected"),)


class SceneError(ValueError):
    """Bad input, with all of its problems.

    Attributes:
      problems: One message for each problem found.
    """

    def __init__(self, problems: list[str]):
        """Joins the problems into one message, a line each."""
        self.problems = list(problems)
        super().__init__("\n".join(self.problems))


def quantity(unit: str, low: float, high: float, **kwargs: Any) -> Any:
    """Declares a numeric dataclass field with its unit and closed range [low, high]."""
    return dataclasses.field(metadata={"unit": unit, "low": low, "high": high}, **kwargs)


def choice(*options: str, **kwargs: Any) -> Any:
    """Declares a string dataclass field restricted to the given options."""
    return dataclasses.field(metadata={"options": options}, **kwargs)


def nearest(name: str, names: typing.Iterable[str]) -> str:
    """Returns a hint naming the valid name closest to a misspelt one, or the whole list."""
    names = list(names)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else "valid: " + ", ".join(sorted(names))


def unit_slip(value: float, unit: str, low: float, high: float) -> tuple[float, str] | None:
    """The factor between units, and what was mixed up, that would bring a value into its range."""
    if low <= value <= high or value == 0 or not math.isfinite(value):
        return None
    slips = _ANGLE_SLIPS if unit == "rad" else _UNIT_SLIPS
    return next(((f, why) for f, why in slips if low <= value * f <= high), None)


def range_problem(path: str, value: float, unit: str, low: float, high: float) -> str | None:
    """Returns why a value lies outside its range, or None.

    Args:
      path: Key path shown to the user.
      value: The number read.
      unit: Its unit.
      low: Smallest allowed value.
      high: Largest allowed value.
    """
    if low <= value <= high:
        return None
    message = f"{path} = {value!r} is outside [{low:g}, {high:g}] {unit}".rstrip()
    slip = unit_slip(value, unit, low, high)
    return f"{message}; did you mean {value * slip[0]:g}? ({slip[1]})" if slip else message


def parse(cls: type[T], table: Any, path: str, problems: list[str]) -> T | None:
    """Builds a frozen dataclass from a TOML table, appending every problem to `problems`.

    Args:
      cls: Dataclass to build; fields may be numbers, strings, booleans, dataclasses or tuples of
        these.
      table: The parsed TOML value.
      path: Key path of the table, for messages.
      problems: List that collects the messages.

    Returns:
      The dataclass, or None if this table has a problem.
    """
    if not isinstance(table, dict):
        problems.append(f"{path} must be a table, not {type(table).__name__}")
        return None
    before = len(problems)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(cls)
    for key in table:
        if key not in fields:
            problems.append(f"{path}.{key} is not a known key; {nearest(key, fields)}")
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _value(hints[name], table[name], f"{path}.{name}", field, problems)
        elif _required(field):
            unit = field.metadata.get("unit", "")
            problems.append(f"{path}.{name} is missing" + (f" (unit {unit})" if unit else ""))
    return cls(**values) if len(problems) == before else None


def _required(field: dataclasses.Field) -> bool:
    missing = dataclasses.MISSING
    return field.default is missing and field.default_factory is missing


def _value(hint: Any, value: Any, path: str, field: dataclasses.Field, problems: list[str]) -> Any:
    """Checks one value against its type hint and its field's metadata."""
    if isinstance(hint, types.UnionType):  # "X | None": TOML has no null, so a given value is an X
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list):
            problems.append(f"{path} must be an array, not {type(value).__name__}")
            return None
        item = typing.get_args(hint)[0]
        return tuple(_value(item, v, f"{path}[{i}]", field, problems) for i, v in enumerate(value))
    if dataclasses.is_dataclass(hint):
        return parse(hint, value, path, problems)  # type: ignore[arg-type]
    if hint is dict:
        if not isinstance(value, dict):
            problems.append(f"{path} must be a table, not {type(value).__name__}")
        return value
    return _scalar(hint, value, path, field, problems)


def _scalar(hint: Any, value: Any, path: str, field: dataclasses.Field, problems: list[str]) -> Any:
    accepted = (int, float) if hint is float else hint
    if not isinstance(value, accepted) or (isinstance(value, bool) and hint is not bool):
        problems.append(f"{path} = {value!r} must be of type {hint.__name__}")
        return None
    options = field.metadata.get("options")
    if options and value not in options:
        problems.append(f"{path} = {value!r} is not valid; {nearest(value, options)}")
    if "low" in field.metadata:
        m = field.metadata
        problem = range_problem(path, value, m["unit"], m["low"], m["high"])
        if problem:
            problems.append(problem)
    return float(value) if hint is float else value
