"""Statistics that verdicts, commands and studies share, by SciPy.

>>> from codesign_jax import statistics
>>> share = statistics.wilson(3, 3)  # three of three trials kept: how sure is that?
>>> round(share.low, 2), share.high
(0.44, 1.0)
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


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


def clustered(successes: ArrayLike, totals: ArrayLike) -> Interval:
    """Share of successes in the trials of several designs, with an interval over both.

    Trials of a design are alike, so that they tell less than as many independent ones.  The
    interval is Wilson's, of as many independent trials as have the standard error between designs
    (Korn, Graubard, Survey Methodology 24, 1998; Dean, Pagano, J. Survey Statistics and Methodology
    3, 2015).  One design tells nothing of others: its interval is that of its trials.

    Args:
      successes: Successes of each design, shape (design,).
      totals: Trials of each design, which no other design meets, shape (design,).
    """
    from scipy import stats

    kept, trials = (np.asarray(v, float) for v in (successes, totals))
    total = trials.sum()
    share = kept.sum() / total
    designs = len(trials)
    alone = share * (1 - share) / total  # variance if all trials were independent
    if designs < 2 or not alone:
        return wilson(int(kept.sum()), int(total))
    normal, student = stats.norm.ppf(0.975), stats.t.ppf(0.975, designs - 1)
    variance = designs / (designs - 1) * ((kept - share * trials) ** 2).sum() / total**2
    effect = max(variance / alone * (student / normal) ** 2, 1.0)
    weight = normal**2 * effect / total
    middle = (share + weight / 2) / (1 + weight)
    half = math.sqrt(weight * share * (1 - share) + weight**2 / 4) / (1 + weight)
    return Interval(float(share), float(middle - half), float(middle + half))


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
    return float(gains(by.mean(1), truth.mean(1)))


def gains(by: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """`gain` by kept shares of designs instead of grasps, shape (..., design, half)."""
    from scipy import stats

    designs = by.shape[-2]
    # Designs that keep less, less those that keep more: each pair counts its difference once.
    beaten = 2 * stats.rankdata(by, axis=-2) - (designs + 1)
    pairs = (beaten * truth[..., ::-1]).sum(-2)
    return pairs.mean(-1) / (designs * (designs - 1))
