"""What two versions did in the same grasps, judged: flips of verdicts, rates, traces, gradients."""

import math
from typing import NamedTuple

import numpy as np
import scipy.stats

from codesign_jax.statistics import Interval, wilson
from scripts.shared.statistics import two_way

SLOWEST = 0.97
"""Least share of the older rate: a smaller loss is not told from noise on a shared machine."""
RESAMPLES = 2000


class Row(NamedTuple):
    """A line of the table: what was compared, the figures, and whether they are as they must be."""

    name: str
    figures: str
    passed: bool


class Expected(NamedTuple):
    """The range in which a change of the physics was expected to flip verdicts, shares."""

    low: float
    high: float


def flips(
    old: np.ndarray, new: np.ndarray, moved: np.ndarray
) -> tuple[Interval, Interval, Interval]:
    """Shares of flipped verdicts, with intervals of 95 % over designs and trials at once.

    Args:
      old: Whether the older version kept the object, shape (design, trial).
      new: The same of the present version.
      moved: The same of the older version with objects a micrometre aside.

    Returns:
      Flips from the older version to the present one, flips by the micrometre, and the excess of
      the first over the second.
    """

    def shares(old: np.ndarray, new: np.ndarray, moved: np.ndarray) -> list[float]:
        changed = float((old != new).mean())
        chance = float((old != moved).mean())
        return [changed, chance, changed - chance]

    changed, chance, excess = two_way(shares, old, new, moved, resamples=RESAMPLES)
    return changed, chance, excess


def same(name: str, old: np.ndarray, new: np.ndarray, moved: np.ndarray) -> Row:
    """Whether no more verdicts flip than a micrometre flips.

    More do if the interval of the excess lies above zero: the bound of the micrometre's flips
    alone would refuse one equal pair in twelve, because both counts vary.  The excess that cannot
    be excluded is the resolution of the comparison.
    """
    changed, chance, excess = flips(old, new, moved)
    # Where nothing flips, resamples do not either: the bound of no flip in so many grasps.
    most = max(excess.high, wilson(0, old.size).high)
    figures = f"{_share(changed)} flip, by a micrometre {_share(chance)}; excess at most {most:.2%}"
    return Row(name, figures, excess.low <= 0)


def physics(
    name: str, old: np.ndarray, new: np.ndarray, moved: np.ndarray, expected: Expected
) -> Row:
    """Whether as many verdicts flip as was stated before the run."""
    changed, chance, _ = flips(old, new, moved)
    figures = (
        f"{_share(changed)} flip, expected {expected.low:.2%} to {expected.high:.2%}; "
        f"by a micrometre {_share(chance)}; "
        f"kept {old.mean():.1%} before, {new.mean():.1%} now"
    )
    return Row(name, figures, changed.low <= expected.high and changed.high >= expected.low)


def rate(old: list[float], new: list[float]) -> Row:
    """Rate as a share of the older one, by pairs of calls [s]; fails if it is surely too low."""
    logarithms = np.log(np.array(old) / np.array(new))
    middle = float(logarithms.mean())
    error = float(logarithms.std(ddof=1)) / math.sqrt(len(logarithms))
    half = float(scipy.stats.t.ppf(0.975, len(logarithms) - 1)) * error
    ratio = Interval(*(math.exp(v) for v in (middle, middle - half, middle + half)))
    figures = (
        f"{ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}] of the older rate, "
        f"{len(logarithms)} pairs"
    )
    return Row("rate", figures, ratio.high >= SLOWEST)


def trace(ours: np.ndarray, theirs: np.ndarray, bound: float) -> Row:
    """Whether paths agree, shape (world, time, nq): the largest difference of each world."""
    apart = np.abs(ours - theirs).max((1, 2))
    figures = f"largest difference {apart.max():.1e} (median world {np.median(apart):.1e})"
    return Row("traces, MuJoCo C", f"{figures}, bound {bound:.0e}", bool(apart.max() <= bound))


def gradient(derivative: np.ndarray, difference: np.ndarray, bound: float) -> Row:
    """Whether derivatives equal differences, relative to the largest of the differences."""
    error = float(np.abs(derivative - difference).max() / np.abs(difference).max())
    return Row("gradients", f"largest error {error:.1e}, bound {bound:.0e}", bool(error <= bound))


def _share(interval: Interval) -> str:
    return f"{interval.value:.2%} [{interval.low:.2%}, {interval.high:.2%}]"
