"""What a coarse landscape of the 2D experiment says, in numbers."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

LOW, DEEP = 0.5, 0.3
"""Mean costs below which a design belongs to a region of low cost (Fig. 8's light areas)."""
SADDLE = 1.0
"""Two regions are separate where every way between them rises above this mean cost."""
SMALLEST = 0.01
"""Part of the plane below which a region is a speck: one or two points of a coarse grid."""
LADDER = np.arange(0.5, 3.01, 0.125)
"""Costs tried as saddles."""
_NEIGHBOURS = np.ones((3, 3), bool)
"""Points that meet at a corner are neighbours: fewer regions than with edges alone."""


class Summary(NamedTuple):
    """Numbers of one landscape.

    Attributes:
      lossless: Share of designs with a mean cost below 0.01.
      below_half: Share below 0.5.
      below_one: Share below 1.
      above_two: Share above 2, from which the seeds are drawn.
      untouched: Share at the scale of the cost: lost from the beginning in every trial.
      failed: Share of trials that failed numerically.
      regions: Number of separate regions below `LOW`.
      deep_regions: The same below `DEEP`.
      sizes: Shares of the plane of the two largest regions below `LOW`, largest first, shape (2,).
      centres: Their centres in the parameters' units, NaN where there is none, shape (2, 2).
      saddle: Highest cost of `LADDER` above which all ways between two regions rise, 0 where there
        is at most one region.
    """

    lossless: float
    below_half: float
    below_one: float
    above_two: float
    untouched: float
    failed: float
    regions: int
    deep_regions: int
    sizes: np.ndarray
    centres: np.ndarray
    saddle: float


def mean_costs(trials: np.ndarray, maximum: np.ndarray) -> np.ndarray:
    """Mean cost without failed trials, the maximum where all failed.

    Args:
      trials: Costs, NaN where a trial failed, shape (set, point, point, trial).
      maximum: Scale of the cost, shape (set,).
    """
    good = np.isfinite(trials)
    total = np.where(good, trials, 0.0).sum(-1)
    mean = total / np.maximum(good.sum(-1), 1)
    return np.where(good.any(-1), mean, maximum[:, None, None])


def regions(cost: np.ndarray, below: float, saddle: float) -> list[np.ndarray]:
    """Regions of low cost that are separate, largest first, bool, each (point, point).

    Two points below `below` belong to one region if a way between them stays below `saddle`.

    Args:
      cost: Mean costs, shape (point, point).
      below: Cost of the points that make a region.
      saddle: Cost that separates regions, at least `below`.
    """
    basins, count = ndimage.label(cost < saddle, structure=_NEIGHBOURS)  # type: ignore[misc]
    low = cost < below
    found = [low & (basins == label) for label in range(1, count + 1)]
    found = [points for points in found if points.mean() >= SMALLEST]
    return sorted(found, key=lambda points: -points.sum())


def saddle_height(cost: np.ndarray, below: float = LOW) -> float:
    """Highest cost of `LADDER` that separates two regions; 0 where there are not two."""
    apart = [s for s in LADDER if len(regions(cost, below, s)) > 1]
    return float(apart[-1]) if apart else 0.0


def summarize(
    trials: np.ndarray, maximum: float, first_axis: np.ndarray, second_axis: np.ndarray
) -> Summary:
    """Returns the numbers of one landscape.

    Args:
      trials: Costs, NaN where a trial failed, shape (point, point, trial).
      maximum: Scale of the cost.
      first_axis: Values of the first parameter in its unit, shape (point,).
      second_axis: Values of the second one.
    """
    cost = mean_costs(trials[None], np.array([maximum]))[0]
    found = regions(cost, LOW, SADDLE)
    sizes, centres = np.zeros(2), np.full((2, 2), np.nan)
    for i, points in enumerate(found[:2]):
        sizes[i] = points.mean()
        centres[i] = [
            first_axis[points.nonzero()[0]].mean(),
            second_axis[points.nonzero()[1]].mean(),
        ]
    return Summary(
        lossless=float((cost < 0.01).mean()),
        below_half=float((cost < LOW).mean()),
        below_one=float((cost < SADDLE).mean()),
        above_two=float((cost > 2.0).mean()),
        # A loss as the lift begins costs the whole scale: half precision would do to tell.
        untouched=float((cost > 0.999 * maximum).mean()),
        failed=float(np.isnan(trials).mean()),
        regions=len(found),
        deep_regions=len(regions(cost, DEEP, SADDLE)),
        sizes=sizes,
        centres=centres,
        saddle=saddle_height(cost),
    )


def stack(found: list[Summary]) -> dict[str, np.ndarray]:
    """Arrays by name with the leading axis (set,)."""
    return {name: np.array([getattr(s, name) for s in found]) for name in Summary._fields}
