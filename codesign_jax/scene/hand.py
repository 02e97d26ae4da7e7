"""Hand files: read, and checked as a whole; `hand_tables` has what is in them.

>>> from codesign_jax import hand
>>> tripod = hand.load("tripod3")
>>> len(tripod.finger), tripod.material.shear_modulus  # Pa
(3, 56000.0)
>>> hand.load("tripod")
Traceback (most recent call last):
codesign_jax.scene.schema.SceneError: hands: 'tripod' unknown; did you mean 'tripod3'?
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codesign_jax.scene import keypaths, library, schema
from codesign_jax.scene.hand_tables import (
    PARAMETERS,
    UNITS,
    Finger,
    Free,
    Hand,
    Kind,
    Material,
    Palm,
    Parameter,
    Preset,
    PressureLimit,
    Section,
    Wrist,
)


def structure(hand: Hand) -> Hand:
    """The hand without what no program depends on; its numbers are left to `schema.typical`."""
    return dataclasses.replace(
        hand,
        name="",
        description="",
        parameter=(),
        preset=(),
        pressure_limit=PressureLimit(0.0),
    )


def load(name: str | Path, *, overrides: Mapping[Any, Any] | None = None) -> Hand:
    """Reads and checks a hand.

    Args:
      name: Name of a built-in hand, or a path ending in .toml.
      overrides: Values by key path that replace the file's; see `keypaths`.

    Raises:
      SceneError: with every problem in the file.
    """
    path = library.find("hands", name)
    problems: list[str] = []
    table = library.read(path)
    changes = keypaths.flatten(overrides or {})
    places = keypaths.apply(table, changes, path.name, problems, root="hand")
    hand = schema.parse(Hand, table, path.name, problems)
    if hand is not None:
        _check_mounts(hand, path.name, problems)
        _check_table(hand, path.name, problems)
        _check_presets(hand, path.name, problems)
        if not problems:
            _check_sections(hand, path.name, problems)
    if problems or hand is None:
        raise schema.SceneError(keypaths.as_given(problems, places))
    return hand


def _check_mounts(hand: Hand, where: str, problems: list[str]) -> None:
    for i, finger in enumerate(hand.finger):
        path = f"{where}.finger[{i}]"
        if finger.base is None and finger.radius is None:
            problems.append(
                f"{path} has no base point: give base = [x, y] in the palm's frame (unit m), "
                "or the radius of the circle on which the base point lies (unit m)"
            )
        elif finger.base is not None and finger.radius is not None:
            problems.append(
                f"{path} gives its base point twice: leave out base = {list(finger.base)} "
                f"or radius = {finger.radius:g}"
            )
        if finger.base is not None and len(finger.base) != 2:
            problems.append(
                f"{path}.base = {list(finger.base)} must have two entries, x and y in the palm's "
                f"frame [m], not {len(finger.base)}"
            )


def _check_table(hand: Hand, where: str, problems: list[str]) -> None:
    names = [p.name for p in hand.parameter]
    if not hand.finger:
        problems.append(f"{where}.finger must name at least one finger")
    for name in PARAMETERS:
        if names.count(name) != 1:
            problems.append(
                f"{where}.parameter {name!r} must be given once, not {names.count(name)} times"
            )
    for p in hand.parameter:
        path, kind = f"{where}.parameter {p.name}", PARAMETERS[p.name]
        unit, factor = UNITS[p.unit]
        if p.per != kind.per:
            problems.append(f"{path}.per must be {kind.per!r}")
        if unit != kind.unit:
            fitting = ", ".join(repr(u) for u, (si, _) in UNITS.items() if si == kind.unit)
            problems.append(f"{path}.unit = {p.unit!r} does not fit; valid: {fitting}")
            continue
        for name in ("low", "high"):
            _check_range(f"{path}.{name}", getattr(p, name), p.unit, kind, factor, problems)
        if p.low >= p.high:
            problems.append(f"{path}: low {p.low:g} must be below high {p.high:g} {p.unit}")
        problem = schema.range_problem(f"{path}.default", p.default, p.unit, p.low, p.high)
        if problem:
            problems.append(problem)


def _check_range(
    path: str, value: float, unit: str, kind: Kind, factor: float, problems: list[str]
) -> None:
    problem = schema.range_problem(path, value, unit, kind.low / factor, kind.high / factor)
    if problem:
        problems.append(problem)


def _check_presets(hand: Hand, where: str, problems: list[str]) -> None:
    table = {p.name: p for p in hand.parameter}
    names = [p.name for p in hand.preset]
    for preset in hand.preset:
        path = f"{where}.preset {preset.name}"
        if names.count(preset.name) > 1 or preset.name == "full":
            problems.append(f"{path}: the name is taken")
        if len(preset.fixed) > schema.MOST_ENTRIES:
            problems.append(f"{path}.fixed has {len(preset.fixed):,} keys")
            continue
        for key, value in preset.fixed.items():
            if key not in table:
                problems.append(
                    f"{path}.fixed.{key} is not a parameter; {schema.nearest(key, table)}"
                )
                continue
            p = table[key]
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                given = schema.shown(value)
                problems.append(f"{path}.fixed.{key} = {given} must be a number [{p.unit}]")
                continue
            problem = schema.range_problem(f"{path}.fixed.{key}", value, p.unit, p.low, p.high)
            if problem:
                problems.append(problem)
        free = [f.name for f in preset.free]
        if not free:
            problems.append(f"{path} leaves no parameter free")
        for f in preset.free:
            if f.name in preset.fixed:
                problems.append(f"{path}: {f.name} is both free and fixed")
            if free.count(f.name) > 1:
                problems.append(f"{path}: {f.name} is free more than once")
            if f.name in table:
                _check_free(f, table[f.name], path, problems)


def _check_free(free: Free, row: Parameter, path: str, problems: list[str]) -> None:
    """A preset may go beyond the table's bounds (the paper's 2D one does) but must make sense."""
    factor = UNITS[row.unit][1]
    for name, value in (("low", free.low), ("high", free.high)):
        if value is not None:
            _check_range(
                f"{path}.free {free.name}.{name}",
                value,
                row.unit,
                PARAMETERS[free.name],
                factor,
                problems,
            )
    low = row.low if free.low is None else free.low
    high = row.high if free.high is None else free.high
    if low >= high:
        problems.append(f"{path}.free {free.name}: low {low:g} must be below high {high:g}")


def _check_sections(hand: Hand, where: str, problems: list[str]) -> None:
    """Every section that the table or a preset allows needs an air chamber and a legal pressure."""
    everything = Preset("full", tuple(Free(p.name) for p in hand.parameter))
    for preset in (everything, *hand.preset):
        path = where if preset is everything else f"{where}.preset {preset.name}"
        lowest = {p.name: _bounds(p, preset)[0] for p in hand.parameter}
        wall = next(_bounds(p, preset)[1] for p in hand.parameter if p.name == "wall")
        for name, size in (("height", lowest["height"]), ("section.width", hand.section.width)):
            if size <= 2 * wall:
                problems.append(
                    f"{path}: a {name} of {size:g} m leaves no air chamber "
                    f"between walls of {wall:g} m"
                )
        limit = hand.pressure_limit.per_wall * lowest["wall"]
        if not lowest["pressure"] < limit:
            problems.append(
                f"{path}: a pressure of {lowest['pressure']:g} Pa is not below the limit of "
                f"{limit:g} Pa for walls of {lowest['wall']:g} m"
            )


def _bounds(row: Parameter, preset: Preset) -> tuple[float, float]:
    """Lowest and highest value [SI] that a preset gives a parameter."""
    factor = UNITS[row.unit][1]
    free = next((f for f in preset.free if f.name == row.name), None)
    if free is None:
        value = preset.fixed.get(row.name, row.default) * factor
        return value, value
    low = row.low if free.low is None else free.low
    high = row.high if free.high is None else free.high
    return low * factor, high * factor


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
    "Wrist",
    "load",
    "structure",
]
