"""Hand files: read, and checked as a whole; `hand_tables` has what is in them.

>>> from codesign_jax import hand
>>> tripod = hand.load("tripod3")
>>> len(tripod.finger), tripod.material.shear_modulus  # Pa
(3, 88000.0)
>>> hand.load("tripod")
Traceback (most recent call last):
codesign_jax.scene.schema.InputError: hands: 'tripod' unknown; did you mean 'tripod3'?
"""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from codesign_jax.scene import keypaths, schema, silicones
from codesign_jax.scene.hand_tables import (
    PARAMETERS,
    TIP,
    UNITS,
    Finger,
    Free,
    Hand,
    Kind,
    Material,
    Numbers,
    Palm,
    Parameter,
    Preset,
    PressureLimit,
    Section,
    Valves,
    Wrist,
    highest_pressure,
    per_finger,
)


def structure(hand: Hand) -> Hand:
    """The hand without what no program depends on."""
    return dataclasses.replace(
        hand,
        name="",
        description="",
        parameter=(),
        preset=(),
        valves=Valves(),
        buildable=None,
        pressure_limit=PressureLimit(0.0),
        material=dataclasses.replace(hand.material, silicone=None, law=None),
    )


def load(name: str | Path, *, overrides: Mapping[Any, Any] | None = None) -> Hand:
    """Reads and checks a hand.

    Args:
      name: Name of a built-in hand, or a path ending in .toml.
      overrides: Values by key path that replace the file's; see `keypaths`.

    Raises:
      InputError: with every problem in the file.
    """
    problems: list[str] = []
    table, path, key_paths = keypaths.read("hands", name, overrides, problems, silicones.prepare)
    silicones.complete(table, path.name, problems)
    hand = schema.parse(Hand, table, path.name, problems)
    if hand is not None and not hand.finger:
        problems.append(
            schema.Problem("missing", f"{path.name}.finger must name at least one finger")
        )
    elif hand is not None:
        _check_mounts(hand, path.name, problems)
        problems += valve_problems(hand.valves, len(hand.finger), f"{path.name}.valves")
        rows = _check_table(hand, path.name, problems)
        _check_presets(hand, rows, path.name, problems)
        if not problems:
            _check_sections(hand, path.name, problems)
    if problems or hand is None:
        raise schema.InputError(keypaths.as_given(problems, key_paths))
    return hand


def _check_mounts(hand: Hand, where: str, problems: list[str]) -> None:
    for i, finger in enumerate(hand.finger):
        path = f"{where}.finger[{i}]"
        if finger.base is None and finger.radius is None:
            sentence = (
                f"{path} has no base point: give base = [x, y] in the palm's frame (unit m), "
                "or the radius of the circle on which the base point lies (unit m)"
            )
            problems.append(schema.Problem("missing", sentence))
        elif finger.base is not None and finger.radius is not None:
            sentence = (
                f"{path} gives its base point twice: leave out base = {list(finger.base)} "
                f"or radius = {finger.radius:g}"
            )
            problems.append(schema.Problem("conflict", sentence))
        if finger.base is not None and len(finger.base) != 2:
            sentence = (
                f"{path}.base = {list(finger.base)} must have two entries, x and y in the palm's "
                f"frame [m], not {len(finger.base)}"
            )
            problems.append(schema.Problem("size", sentence))


def _check_table(hand: Hand, where: str, problems: list[str]) -> dict[str, Parameter]:
    """Checks the parameter table; returns by name the rows whose values may be looked at."""
    names = [p.name for p in hand.parameter]
    rows = {}
    for name in PARAMETERS:
        if name in TIP and not hand.section.tapered:
            if name in names:
                problems.append(
                    schema.Problem(
                        "unsupported", f"{where}.parameter {name!r} needs section.tapered = true"
                    )
                )
        elif names.count(name) != 1:
            problems.append(
                schema.Problem(
                    "conflict",
                    f"{where}.parameter {name!r} must be given once, not {names.count(name)} times",
                )
            )
    for p in hand.parameter:
        path = f"{where}.parameter {p.name}"
        kind = PARAMETERS[p.name]
        unit, factor = UNITS[p.unit]
        if p.per != kind.per:
            problems.append(schema.Problem("type", f"{path}.per must be {kind.per!r}"))
        keys = ("low", "high", "default")
        fits = all([_fits(f"{path}.{key}", getattr(p, key), p, hand, problems) for key in keys])
        if fits:
            rows[p.name] = p
        if unit != kind.unit:
            fitting = ", ".join(repr(u) for u, (si, _) in UNITS.items() if si == kind.unit)
            problems.append(
                schema.Problem(
                    "unknown", f"{path}.unit = {p.unit!r} does not fit; valid: {fitting}"
                )
            )
        if not fits or unit != kind.unit:
            continue
        for name in ("low", "high"):
            _check_range(f"{path}.{name}", getattr(p, name), p.unit, kind, factor, problems)
        for finger, (low, high, default) in _by_finger(p.low, p.high, p.default):
            if low >= high:
                problems.append(
                    schema.Problem(
                        "order", f"{path}{finger}: low {low:g} must be below high {high:g} {p.unit}"
                    )
                )
            name = f"{path}.default{finger}"
            if problem := schema.range_problem(name, default, p.unit, low, high):
                problems.append(problem)
    return rows


def _fits(path: str, value: Numbers, row: Parameter, hand: Hand, problems: list[str]) -> bool:
    if not isinstance(value, tuple) or (row.per == "finger" and len(value) == len(hand.finger)):
        return True
    if row.per != "finger":
        why = f"must be a number [{row.unit}]: the hand has one {row.name}"
    else:
        why = (
            f"must be a number [{row.unit}] for all fingers or {len(hand.finger)}, one for each, "
            f"not {len(value)}"
        )
    problems.append(schema.Problem("size", f"{path} = {list(value)} {why}"))
    return False


def _by_finger(*values: Numbers) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Index in brackets and values of each finger; where all have the same, those without index."""
    count = max(len(per_finger(v, 0)) for v in values)
    rows = zip(*(per_finger(v, count or 1) for v in values), strict=True)
    yield from ((f"[{i}]" if count else "", row) for i, row in enumerate(rows))


def _check_range(
    path: str, value: Numbers, unit: str, kind: Kind, factor: float, problems: list[str]
) -> None:
    low = kind.low / factor
    high = kind.high / factor
    for finger, (number,) in _by_finger(value):
        if problem := schema.range_problem(path + finger, number, unit, low, high):
            problems.append(problem)


def _check_presets(
    hand: Hand, rows: Mapping[str, Parameter], where: str, problems: list[str]
) -> None:
    table = {p.name: p for p in hand.parameter}
    names = [p.name for p in hand.preset]
    for preset in hand.preset:
        path = f"{where}.preset {preset.name}"
        if names.count(preset.name) > 1 or preset.name == "full":
            problems.append(schema.Problem("conflict", f"{path}: the name is taken"))
        if len(preset.fixed) > schema.MOST_ENTRIES:
            problems.append(schema.Problem("size", f"{path}.fixed has {len(preset.fixed):,} keys"))
            continue
        for key, value in preset.fixed.items():
            if key not in table:
                problems.append(
                    schema.Problem(
                        "unknown",
                        f"{path}.fixed.{key} is not a parameter; {schema.nearest(key, table)}",
                    )
                )
                continue
            if key in rows:
                _check_fixed(f"{path}.fixed.{key}", value, rows[key], hand, problems)
        free = [f.name for f in preset.free]
        if not free and preset.fixed:
            problems.append(schema.Problem("missing", f"{path} leaves no parameter free"))
        for f in preset.free:
            if f.name in preset.fixed:
                problems.append(
                    schema.Problem("conflict", f"{path}: {f.name} is both free and fixed")
                )
            if free.count(f.name) > 1:
                problems.append(
                    schema.Problem("conflict", f"{path}: {f.name} is free more than once")
                )
            if f.name in rows:
                _check_free(f, rows[f.name], f"{path}.free {f.name}", hand, problems)


def _check_fixed(path: str, value: Any, row: Parameter, hand: Hand, problems: list[str]) -> None:
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, bool) or not isinstance(number, int | float):
            numbers = list(value) if isinstance(value, tuple) else value
            many = ", or one for each finger" if row.per == "finger" else ""
            problems.append(
                schema.Problem(
                    "type", f"{path} = {schema.shown(numbers)} must be a number [{row.unit}]{many}"
                )
            )
            return
    if _fits(path, value, row, hand, problems):
        for finger, (number, low, high) in _by_finger(value, row.low, row.high):
            if problem := schema.range_problem(path + finger, number, row.unit, low, high):
                problems.append(problem)


def _check_free(free: Free, row: Parameter, path: str, hand: Hand, problems: list[str]) -> None:
    """A preset may go beyond the table's bounds (the paper's 2D one does) but must make sense."""
    kind = PARAMETERS[free.name]
    factor = UNITS[row.unit][1]
    for name, value in (("low", free.low), ("high", free.high)):
        if value is None:
            continue
        if not _fits(f"{path}.{name}", value, row, hand, problems):
            return
        _check_range(f"{path}.{name}", value, row.unit, kind, factor, problems)
        if free.tied is True and isinstance(value, tuple):
            sentence = (
                f"{path}.{name} = {list(value)} must be a number [{row.unit}]: "
                "tied = true gives all fingers one value"
            )
            problems.append(schema.Problem("type", sentence))
    width = hand.width(row)
    if width == 1 and not isinstance(free.tied, bool):
        problems.append(
            schema.Problem(
                "unsupported",
                f"{path}.tied: {free.name} is one value, which no groups of fingers share",
            )
        )
        return
    if not isinstance(free.tied, bool) and (problem := group_problem(free.tied, width)):
        problems.append(schema.Problem("size", f"{path}.tied: {problem}"))
        return
    for low, high in dict.fromkeys(zip(*free.bounds(row, hand.width(row)), strict=True)):
        if low >= high:
            problems.append(
                schema.Problem("order", f"{path}: low {low:g} must be below high {high:g}")
            )


def valve_problems(valves: Valves, fingers: int, where: str) -> list[str]:
    """What is wrong with the pressure lines of a hand with so many fingers."""
    problems = []
    if valves.lines is not None and valves.groups is not None:
        problems.append(
            schema.Problem(
                "conflict", f"{where}: give the number of lines, or the groups of fingers, not both"
            )
        )
    if valves.lines is not None and valves.lines > fingers:
        problems.append(
            schema.Problem(
                "conflict", f"{where}.lines = {valves.lines} must be at most {fingers}, the fingers"
            )
        )
    if valves.groups is not None and (problem := group_problem(valves.groups, fingers)):
        problems.append(schema.Problem("size", f"{where}.groups: {problem}"))
    return problems


def group_problem(groups: tuple[tuple[int, ...], ...], count: int) -> str:
    """Why groups among `count` fingers that share something are none, or nothing."""
    members = [k for group in groups for k in group]
    if any(len(group) < 2 for group in groups):
        return "a group has two or more fingers"
    if any(not 0 <= k < count for k in members):
        return f"fingers are numbered from 0 to {count - 1}"
    if len({*members}) < len(members):
        return "a finger is in one group only"
    return ""


def _check_sections(hand: Hand, where: str, problems: list[str]) -> None:
    preset_places = [f"{where}.preset {preset.name}" for preset in hand.preset if not preset.whole]
    paths = [where, *preset_places]
    for path, bounds in zip(paths, all_bounds(hand), strict=True):
        lowest = {name: low for name, (low, _) in bounds.items()}
        width = (hand.section.width,) * len(hand.finger)
        ends = [("", "section.width", width)]
        if hand.section.tapered:
            ends.append(("tip_", "tip_width", lowest["tip_width"]))
        # Equal fingers have the same problems, which are told once.
        fingers = dict.fromkeys(
            (prefix, across, *numbers)
            for prefix, across, widths in ends
            for numbers in zip(
                lowest[f"{prefix}height"],
                widths,
                bounds[f"{prefix}wall"][1],
                lowest[f"{prefix}wall"],
                lowest["pressure"],
                strict=True,
            )
        )
        for prefix, across, height, width, wall, thinnest, pressure in fingers:
            for name, size in ((f"{prefix}height", height), (across, width)):
                if size <= 2 * wall:
                    sentence = (
                        f"{path}: a {name} of {size:g} m leaves no air chamber "
                        f"between walls of {wall:g} m"
                    )
                    problems.append(schema.Problem("geometry", sentence))
            limit = hand.pressure_limit.per_wall * thinnest
            if not pressure < limit:
                sentence = (
                    f"{path}: a pressure of {pressure:g} Pa is not below the limit of "
                    f"{limit:g} Pa for walls of {thinnest:g} m"
                )
                problems.append(schema.Problem("range", sentence))


def all_bounds(hand: Hand) -> Iterator[dict[str, tuple[tuple[float, ...], tuple[float, ...]]]]:
    """Lowest and highest values [SI] of every parameter, of the table and of other presets."""
    everything = Preset("full", tuple(Free(p.name) for p in hand.parameter))
    for preset in (everything, *(p for p in hand.preset if not p.whole)):
        yield {p.name: _bounds(p, preset, hand) for p in hand.parameter}


def _bounds(
    row: Parameter, preset: Preset, hand: Hand
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lowest and highest values [SI] that a preset gives a parameter, for each finger."""
    factor = UNITS[row.unit][1]
    width = hand.width(row)
    free = next((f for f in preset.free if f.name == row.name), None)
    if free is None:
        low = high = per_finger(preset.fixed.get(row.name, row.default), width)
    else:
        low, high = free.bounds(row, width)
    return tuple(v * factor for v in low), tuple(v * factor for v in high)


__all__ = [
    "PARAMETERS",
    "UNITS",
    "Finger",
    "Free",
    "Hand",
    "Kind",
    "Material",
    "Palm",
    "Parameter",
    "Preset",
    "PressureLimit",
    "Section",
    "Valves",
    "Wrist",
    "highest_pressure",
    "load",
    "structure",
]


def lacking(hand: Hand, values: Mapping[str, Any], fingers: tuple[int, ...]) -> Hand:
    """The hand without some of its fingers, and with a design as the defaults of its table.

    The other fingers are counted anew; there is no preset, so that "full" is its design space.

    Args:
      values: Values of the table's rows by name, in their units; an array of all fingers' for those
        that each finger has of its own.
      fingers: Numbers of the fingers that leave.
    """
    count = len(hand.finger)
    left = [f for f in range(count) if f not in fingers]
    rows = []
    for row in hand.parameter:
        entries = values[row.name]
        if row.per == "finger":
            numbers = [[per_finger(v, count)[f] for f in left] for v in (row.low, row.high)]
            default = [float(entries[f]) for f in left]
            low = tuple(map(min, numbers[0], default))
            high = tuple(map(max, numbers[1], default))
            rows.append(dataclasses.replace(row, low=low, high=high, default=tuple(default)))
        else:
            value = float(entries)
            ends = {"low": min(row.low, value), "high": max(row.high, value)}
            rows.append(dataclasses.replace(row, **ends, default=value))
    number = {f: k for k, f in enumerate(left)}
    groups = [tuple(number[f] for f in group if f in number) for group in hand.valves.groups or ()]
    lines = hand.valves.lines and min(hand.valves.lines, len(left))
    some = tuple(group for group in groups if len(group) > 1) or None
    return dataclasses.replace(
        hand,
        name=f"{hand.name} without finger {', '.join(map(str, fingers))}",
        finger=tuple(hand.finger[f] for f in left),
        parameter=tuple(rows),
        preset=(),
        valves=Valves(lines=lines, groups=some),
    )
