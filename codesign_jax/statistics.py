"""Statistics that verdicts, commands and studies share, by SciPy.

>>> from codesign_jax import statistics
>>> share = statistics.wilson(3, 3)  # three of three trials kept: how sure is that?
>>> round(share.low, 2), share.high
(0.44, 1.0)
"""

import math
from typing import NamedTuple


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
