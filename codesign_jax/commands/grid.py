"""Axes of a grid: parameters of the design, and numbers of the scene by their key paths."""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.commands import common
from codesign_jax.commands.flags import Landscape as Options
from codesign_jax.judge.cases import Case
from codesign_jax.scene import Scene, design_files, schema
from codesign_jax.scene.schema import InputError, Problem


class Axis(NamedTuple):
    """Values of one number."""

    name: str  # of the parameter, or the key path
    unit: str
    values: np.ndarray  # in the unit, shape (n,)
    column: int | None  # index of the parameter; None for a key path
    scenes: tuple[Scene, ...] = ()  # of a key path the scene of each value


def axes(case: Case, options: Options) -> tuple[Axis, Axis]:
    """The two axes that --parameters names.

    Raises:
      InputError: If they are not two, or one of them is neither a parameter of the design nor a
        number of the scene with its range.
    """
    known = case.space.names
    words = options.parameters or (known if len(known) == 2 else ())
    problems = [problem for word in words if (problem := _problem(word, case))]
    common.refuse(problems)
    names = {word.partition("=")[0] for word in words}
    if len(words) != 2 or len(names) != 2:
        text = f"--parameters must name two of {', '.join(known)}, or keys with their ranges"
        raise InputError.of("syntax", f"{text}, such as objects.object.mass=0.05:0.5")
    first, second = (_axis(word, case, options) for word in words)
    return first, second


def _problem(word: str, case: Case) -> Problem | None:
    name, equals, text = word.partition("=")
    ends = _range(text)
    if equals and not ends:
        words = f"--parameters {word!r} must be NAME=LOW:HIGH, two numbers, the lower one first"
        return Problem("syntax", words)
    if name in case.space.names:
        k = case.space.names.index(name)
        limits = [case.space.in_units(np.array(v))[k] for v in (case.space.low, case.space.high)]
        bounds = [round(float(limit), 9) for limit in limits]
        for value in ends:
            if problem := schema.range_problem(name, value, case.space.units[k], *bounds):
                return problem.told(f"--parameters {problem}")
        return None
    by_finger = any(n.startswith(f"{name}[") for n in case.space.names)
    if by_finger or not equals:
        words = f"--parameters {name!r} is not a parameter; {_meant(name, case.space.names)}"
        return Problem("unknown", words)
    return None


def _range(text: str) -> list[float]:
    """The two numbers of LOW:HIGH, or nothing."""
    low, _, high = text.partition(":")
    first = design_files.number(low)
    last = design_files.number(high)
    return [first, last] if first is not None and last is not None and first < last else []


def _meant(name: str, known: tuple[str, ...]) -> str:
    fingers = [n for n in known if n.split("[")[0] == name]
    if fingers:
        return f"there is one for each finger: {fingers[0]} to {fingers[-1]}"
    if "." in name:
        return f"a key of the scene needs its range: {name}=LOW:HIGH"
    return schema.nearest(name, known)


def _axis(word: str, case: Case, options: Options) -> Axis:
    name, _, text = word.partition("=")
    ends = _range(text)
    if name in case.space.names:
        k = case.space.names.index(name)
        space = case.space
        low, high = ends or (space.in_units(np.array(v))[k] for v in (space.low, space.high))
        return Axis(name, space.units[k], np.linspace(low, high, options.points), k)
    values = np.linspace(ends[0], ends[1], options.points)
    paths = [*_entries(case.scene, tuple(name.split(".")))]
    for end in ends:  # what is wrong with them is said of the numbers that were given
        _changed(case, options, paths, end)
    scenes = tuple(_changed(case, options, paths, value) for value in values)
    return Axis(name, _unit(case.scene, paths[0]), values, None, scenes)


def _changed(case: Case, options: Options, paths: list[tuple[str, ...]], value: float) -> Scene:
    """The scene with another number, as --set makes it, with its checks."""
    pairs = tuple(f"{'.'.join(path)}={float(value)!r}" for path in paths)
    changed_options = dataclasses.replace(options, overrides=(*options.overrides, pairs))
    scene = common.find_case(changed_options, tell=lambda text: None).scene
    if scene.structure != case.scene.structure:
        key = ".".join(paths[0])
        raise InputError.of(
            "unsupported", f"--parameters {key} is structure, not a number: --set changes it"
        )
    return scene


def _entries(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """A key path for every entry of a list that it does not choose from: all objects' masses."""
    if not path:
        yield ()
        return
    part = path[0]
    rest = path[1:]
    if not isinstance(value, tuple):
        inside = getattr(value, part, None)
        yield from ((part, *more) for more in _entries(inside, rest))
        return
    names = [getattr(entry, "name", "") for entry in value]
    if part.isdigit() or part in names:
        chosen = value[int(part)] if part.isdigit() and int(part) < len(value) else None
        entry = value[names.index(part)] if part in names else chosen
        yield from ((part, *more) for more in _entries(entry, rest))
        return
    if not any(hasattr(entry, part) for entry in value):
        yield path  # of which whoever reads it says what there is
        return
    for k, entry in enumerate(value):
        yield from ((str(k), *more) for more in _entries(entry, path))


def _unit(value: Any, path: tuple[str, ...]) -> str:
    for part in path[:-1]:
        if isinstance(value, tuple):
            names = [getattr(entry, "name", "") for entry in value]
            value = value[names.index(part) if part in names else int(part)]
        else:
            value = getattr(value, part)
    units = {field.name: field.metadata.get("unit", "") for field in dataclasses.fields(value)}
    return units.get(path[-1], "")


def numbers(scene: Scene, pair: tuple[Axis, Axis]) -> np.ndarray | None:
    """The scene's numbers at every point of a grid, shape (point, leaf), the first axis slowest.

    None if no axis is a number of the scene.
    """
    if not any(axis.scenes for axis in pair):
        return None
    base = np.array(jax.tree.leaves(scene), float)
    leaves = [
        np.array([jax.tree.leaves(variant) for variant in axis.scenes], float) for axis in pair
    ]
    rows = []
    for point in np.ndindex(*(len(axis.values) for axis in pair)):
        row = base.copy()
        for k, every in zip(point, leaves, strict=True):
            if every.size:
                row = np.where(every[k] != base, every[k], row)
        rows.append(row)
    return np.array(rows)
