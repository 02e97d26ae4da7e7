"""How far each parameter of a design may drift before grasps fail, from simulated grasps.

Every parameter is moved alone, down and up, by steps that grow by a constant factor to the end of
its range, and every design so made meets the same trials.  On each side the tolerance ends between
the last step of an unbroken row of steps with at least `WANTED` successes and the step after it;
steps further out are not simulated.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from codesign_jax import statistics, verdict
from codesign_jax.model import morphology
from codesign_jax.scene import Scene
from codesign_jax.scene.hand import UNITS
from codesign_jax.scene.parameters import DesignSpace, design_space, fingers_of
from codesign_jax.statistics import Interval
from codesign_jax.types import Outcome

WANTED = 0.9
"""Share of successful grasps below which a design has drifted too far."""
NEAREST = 1 / 32
"""The first step, as a share of the way to the end of the range."""
TRIALS = 36
"""Trials of each step: if all succeed, the share is above 90 % with 95 % confidence."""
_MARGIN = 1e-6  # of a range: a float32 of a bound is no room for a step


class Step(NamedTuple):
    """A value that a parameter was moved to, in the hand file's unit, and its successes."""

    value: float
    share: Interval


class Side(NamedTuple):
    """What was found in one direction."""

    good: Step | None  # the last step with enough successes, or None if the first one has too few
    bad: Step | None  # the first step with too few, or None if there is none up to the limit
    limit: float  # the end of the range [hand file's unit]
    room: bool  # whether the range goes on in this direction at all


class Tolerance(NamedTuple):
    """Tolerance of a parameter."""

    name: str  # the parameter
    unit: str  # the hand file's unit, of all values
    value: float  # the design's value
    down: Side  # what was found below it
    up: Side  # what was found above it


class Study(NamedTuple):
    """Designs to simulate."""

    space: DesignSpace
    # The design, then its steps [SI units], shape (1 + parameter * 2 * step, parameter)
    designs: np.ndarray
    low: np.ndarray  # ends of the ranges downwards [SI units], shape (parameter,)
    high: np.ndarray  # ends upwards

    @property
    def steps(self) -> int:
        """Steps on each side of a parameter."""
        return (len(self.designs) - 1) // (2 * self.space.num_parameters)

    @property
    def room(self) -> np.ndarray:
        """Whether the range goes on downwards and upwards, bool, shape (parameter, 2)."""
        ends = np.stack([self.low, self.high], 1)
        margin = _MARGIN * (self.high - self.low)
        return abs(ends - self.designs[0][:, None]) > margin[:, None]

    @property
    def most(self) -> int:
        """Designs that `search` asks for at most."""
        return 1 + int(self.room.sum()) * self.steps


def study(scene: Scene, space: DesignSpace, design: np.ndarray, steps: int, *, free: bool) -> Study:
    """Plans the steps."""
    whole = space if free else design_space(scene.hand)
    centre = np.asarray(design, float)
    source = np.asarray(space.source)
    if not free:
        centre = np.where(source >= 0, centre[np.maximum(source, 0)], space.base)
    low, high = _limits(whole, space, centre)
    shares = np.geomspace(NEAREST, 1.0, steps) if steps > 1 else np.ones(1)
    designs = [centre]
    for i in range(whole.num_parameters):
        for end in (low[i], high[i]):
            moved = np.repeat(centre[None], steps, 0)
            moved[:, i] += shares * (end - centre[i])
            designs += [*moved]
    moving = dataclasses.replace(whole, bounds=(tuple(low.tolist()), tuple(high.tolist())))
    return Study(moving, np.array(designs), low, high)


def _limits(
    whole: DesignSpace, space: DesignSpace, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the ranges: the table's or, where they are wider, the design space's own.

    A wall ends where its pressure meets the pressure limit, and a pressure likewise.
    """
    low = np.array(whole.low)
    high = np.array(whole.high)
    if space is not whole:
        for j, name in enumerate(space.names):
            for i in np.nonzero([n.split("[")[0] == name.split("[")[0] for n in whole.names])[0]:
                low[i] = min(low[i], space.low[j])
                high[i] = max(high[i], space.high[j])
    limit = whole.hand.pressure_limit
    params = whole.params(centre)
    caps = morphology.pressure_limits(whole.hand, params)
    floors = np.asarray(params.pressure) / limit.per_wall
    for i, name in enumerate(whole.names):
        row = name.partition("[")[0]
        fingers = fingers_of(name) or slice(None)
        if row == "pressure":
            high[i] = min(high[i], caps[fingers].min())
        if row in ("wall", "tip_wall"):
            low[i] = max(low[i], floors[fingers].max())
    return np.minimum(low, centre), np.maximum(high, centre)


def shares(outcomes: Outcome) -> list[Interval]:
    """Share of successful grasps of each design, with its 95 % interval.

    A success keeps the object and lets go of it; a trial that failed, for whatever reason, is none.
    """
    kept = verdict.kept(outcomes)
    return [statistics.wilson(int(n), kept.shape[1]) for n in kept.sum(1)]


def search(planned: Study, shares_of: Callable[[list[int]], list[Interval]]) -> dict[int, Interval]:
    """Shares of successful grasps by index of the design, of each side up to its end.

    Of a design with too few successes itself, those of the first steps alone.
    """
    steps = planned.steps
    found = {}
    sides = [int(side) for side in np.flatnonzero(planned.room)]
    for step in range(steps):
        asked = [0] * (step == 0) + [1 + side * steps + step for side in sides]
        found |= zip(asked, shares_of(asked), strict=True)
        sides = [side for side in sides if found[1 + side * steps + step].value >= WANTED]
        if found[0].value < WANTED or not sides:
            break
    return found


def tolerances(planned: Study, found: Mapping[int, Interval]) -> list[Tolerance]:
    """Reads the tolerances off what `search` found."""
    space = planned.space
    results = []
    steps = planned.steps
    for i, (name, unit) in enumerate(zip(space.names, space.units, strict=True)):
        factor = UNITS[unit][1]
        sides = []
        for s, end in enumerate((planned.low[i], planned.high[i])):
            first = 1 + (2 * i + s) * steps
            known = [k for k in range(first, first + steps) if k in found]
            moved = [Step(float(planned.designs[k, i] / factor), found[k]) for k in known]
            sides.append(_side(moved, float(end / factor), bool(planned.room[i, s])))
        results.append(Tolerance(name, unit, float(planned.designs[0, i] / factor), *sides))
    return results


def _side(moved: list[Step], limit: float, room: bool) -> Side:
    count = next((k for k, step in enumerate(moved) if step.share.value < WANTED), len(moved))
    good = moved[:count][-1:]
    bad = moved[count : count + 1]
    return Side(good[0] if good else None, bad[0] if bad else None, limit, room)
