"""Design files: numbers of a design by name, with the names of scene and hand.

`codesign studio` writes such a file, and whatever takes a run takes one. `parameters.read_design`
reads one with its scene.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.scene import library, schema, texts
from codesign_jax.scene.schema import InputError, Problem

SCENE = "paper"
PRESET = "2d"
"""Scene and design space where none is named."""


@dataclasses.dataclass(frozen=True)
class DesignFile:
    """A design file: the design, and what it is simulated in where nothing else is said."""

    preset: str  # design space that the names belong to
    # Numbers by name in the hand file's units, or arrays with one for each finger
    design: dict[str, Any]
    scene: str = SCENE
    hand: str = ""
    objects: str = ""
    control: str = ""

    @property
    def pairs(self) -> list[str]:
        """NAME=VALUE for each number of the design."""
        pairs = []
        for name, value in self.design.items():
            if isinstance(value, list):
                pairs += [f"{name}[{k}]={v}" for k, v in enumerate(value)]
            else:
                pairs.append(f"{name}={value}")
        return pairs


def read(path: Path) -> DesignFile:
    """Reads a design file.

    Raises:
      InputError: With every problem of the file; what its names are belongs to its scene.
    """
    problems: list[str] = []
    file = schema.parse(DesignFile, library.read(path), path.name, problems)
    if file is None:
        raise InputError(problems)
    return file


def parse(
    space: Any, pairs: Sequence[str], base: np.ndarray, where: str = "--design"
) -> np.ndarray:
    """A design after NAME=VALUE in the hand file's units; base and result in SI, (parameter,)."""
    values = dict(zip(space.names, space.in_units(base), strict=True))
    lows = dict(zip(space.names, space.in_units(np.array(space.low)), strict=True))
    highs = dict(zip(space.names, space.in_units(np.array(space.high)), strict=True))
    units = dict(zip(space.names, space.units, strict=True))
    entries = [pair.partition("=") for pair in pairs]
    # A name without an index is all fingers' parameter: one value for each of them.
    entries = [(each, v) for name, _, v in entries for each in members(name, space)]
    given: dict[str, list[str]] = {}
    for name, text in entries:
        given.setdefault(name, []).append(text)
    problems = [
        Problem("conflict", f"{where} {name!r} is given more than once: {', '.join(each)}")
        for name, each in given.items()
        if len(each) > 1
    ]
    for name, text in entries:
        if name in dict(space.idle):
            words = f"{where} {name!r} has no effect: {dict(space.idle)[name]}; leave it out"
            problems.append(Problem("unsupported", words))
            continue
        if name not in values:
            problems.append(
                schema.Problem(
                    "unknown",
                    f"{where} {name!r} is not a parameter; {schema.nearest(name, values)}",
                )
            )
            continue
        value = number(text)
        # Bounds went to SI and back; the last bit of that is no reason to refuse one.
        low, high = (round(float(b[name]), 9) for b in (lows, highs))
        if value is None:
            problems.append(
                schema.Problem(
                    "type", f"{where} {name} = {text!r} must be a number in {units[name]}"
                )
            )
        elif problem := schema.range_problem(f"{where} {name}", value, units[name], low, high):
            problems.append(problem)
        else:
            values[name] = value
    if problems:
        raise InputError(problems)
    return np.clip(space.from_units(np.array(list(values.values()))), space.low, space.high)


def members(name: str, space: Any) -> list[str]:
    """The parameters that a name means: its own, or without an index those of all fingers."""
    each = [n for n in space.names if n.split("[")[0] == name]
    return each if name not in space.names and each else [name]


def number(text: str) -> float | None:
    """A number as people type it; None if a text is none."""
    try:
        value = float(texts.typed(text))
    except ValueError:
        return None
    return value if math.isfinite(value) else None
