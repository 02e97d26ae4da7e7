"""Statistics that commands and studies share, by SciPy."""

from typing import NamedTuple


class Interval(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float


def wilson(successes: int, total: int) -> Interval:
    """Share of successes with Wilson's score interval (Wilson 1927).

    Args:
      successes: Number of successes.
      total: Number of trials, at least one.
    """
    from scipy import stats  # takes half a second to import: commands do so once they are done

    found = stats.binomtest(successes, total).proportion_ci(0.95, method="wilson")
    return Interval(successes / total, float(found.low), float(found.high))
