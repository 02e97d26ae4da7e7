"""Statistics that verdicts, commands and studies share, by SciPy.

>>> from codesign_jax import statistics
>>> share = statistics.wilson(3, 3)  # three of three trials kept: how sure is that?
>>> round(share.low, 2), share.high
(0.44, 1.0)
"""

import math
from typing import NamedTuple

import numpy as np


class Interval(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float


def wilson(successes: int, total: int) -> Interval:
    """Share of successes with Wilson's score interval (Wilson 1927)."""
    from scipy import stats  # takes half a second to import: commands do so once they are done

    interval = stats.binomtest(successes, total).proportion_ci(0.95, method="wilson")
    return Interval(successes / total, float(interval.low), float(interval.high))


def paired(both: int, first: int, second: int, total: int) -> Interval:
    """Difference of two shares of the same trials, by Newcombe's method 10 (Newcombe 1998).

    It joins Wilson's intervals of the two shares by their correlation: with no trial in which the
    two differ it has a width, unlike Wald's and the bootstrap's.
    """
    share = wilson(both + first, total)
    other = wilson(both + second, total)
    neither = total - both - first - second
    product = (both + first) * (second + neither) * (both + second) * (first + neither)
    together = both * neither - first * second
    if together > 0:
        together = max(together - total / 2, 0)
    phi = together / math.sqrt(product) if product else 0.0

    def width(a: float, b: float) -> float:
        return math.sqrt(max(a * a - 2 * phi * a * b + b * b, 0.0))

    value = share.value - other.value
    low = value - width(share.value - share.low, other.high - other.value)
    high = value + width(share.high - share.value, other.value - other.low)
    return Interval(value, low, high)


def mcnemar(first: int, second: int) -> float:
    """McNemar's exact test of two shares of the same trials: the p-value, two-sided.

    Args:
      first: Trials in which the first alone succeeded.
    """
    from scipy import stats

    return float(stats.binomtest(first, first + second).pvalue) if first + second else 1.0


def halves(kept: np.ndarray) -> np.ndarray:
    """Kept grasps (design, trial) as (design, trial of a half, half)."""
    most = kept.shape[1] // 2
    return np.stack([kept[:, :most], kept[:, most : 2 * most]], axis=-1).astype(float)


def gain(by: np.ndarray, truth: np.ndarray) -> float:
    """What choosing between two designs gains, a share of grasps, over a toss of a coin.

    A design is chosen by half of the trials and valued by the other half, so that no trial counts
    on both sides; the mean is over all pairs of designs.

    Args:
      by: Kept grasps at the setting that chooses, (design, trial of a half, half).
      truth: At the setting that values; each half of the trials is valued by the other one.
    """
    chooses = by.mean(1)
    values = truth.mean(1)[:, ::-1]
    first, second = np.triu_indices(len(by), 1)
    choice = np.sign(chooses[first] - chooses[second])
    return float((choice * (values[first] - values[second]) / 2).mean())
