"""Statistics that studies share: verdicts, ranks, distributions, paired tests, bootstraps.

SciPy's where it has them; the rest says why it does not use SciPy's.
"""

from collections.abc import Callable

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike

from codesign_jax.statistics import Interval

RESAMPLES = 10_000
_CONFIDENCE = 0.95


def spearman(a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """Spearman's rank correlation along the last axis; NaN where one side does not vary.

    SciPy's takes one pair of samples at a time, and bootstraps need thousands.
    """
    x, y = (scipy.stats.rankdata(v, axis=-1) for v in (a, b))
    x, y = (v - v.mean(-1, keepdims=True) for v in (x, y))
    norm = np.sqrt((x**2).sum(-1) * (y**2).sum(-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (x * y).sum(-1) / norm


def quantile(values: np.ndarray, q: float) -> np.ndarray:
    """Quantile over the last axis, also where numbers are infinite.

    The median of an even count is the mean of two, elsewhere it is one of the numbers: NumPy's
    "averaged_inverted_cdf", whose interpolation turns two infinite neighbours into nan.
    """
    rank = values.shape[-1] * q
    first = max(int(np.ceil(rank)) - 1, 0)
    second = min(int(rank), values.shape[-1] - 1)
    ordered = np.sort(values, axis=-1)
    return (ordered[..., first] + ordered[..., second]) / 2


def bootstrap(
    statistic: Callable[[np.ndarray], np.ndarray],
    count: int,
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap; infinite values take part, undefined ones are left out.

    SciPy's interpolates between resamples, which makes two infinite neighbours not a number.
    """
    rows = np.random.default_rng(seed).integers(0, count, (resamples, count))
    drawn = np.asarray(statistic(rows), float)
    drawn = drawn[~np.isnan(drawn)]
    tail = (1 - _CONFIDENCE) / 2
    low, high = (float(quantile(drawn, q)) if drawn.size else np.nan for q in (tail, 1 - tail))
    return Interval(float(np.squeeze(statistic(np.arange(count)))), low, high)


def two_way(
    statistics: Callable[..., list[float]],
    *tables: np.ndarray,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> list[Interval]:
    """Percentile bootstrap over rows and columns at once: particles and the trials they share.

    Trials are common to all particles, so that resampling particles alone would call what one
    unlucky trial does to all of them certain (Owen 2007, "The pigeonhole bootstrap").

    Returns:
      An interval for each value; resamples in which it is NaN are left out, and its ends are NaN if
      it is in all of them.
    """
    rng = np.random.default_rng(seed)
    rows, columns = tables[0].shape[:2]
    drawn = []
    for _ in range(resamples):
        index = np.ix_(rng.integers(0, rows, rows), rng.integers(0, columns, columns))
        drawn.append(statistics(*(t[index] for t in tables)))
    tail = (1 - _CONFIDENCE) / 2
    resampled = np.array(drawn, float)
    low, high = np.full((2, resampled.shape[1]), np.nan)
    some = ~np.isnan(resampled).all(0)
    low[some], high[some] = np.nanquantile(resampled[:, some], [tail, 1 - tail], axis=0)
    return [Interval(*map(float, v)) for v in zip(statistics(*tables), low, high, strict=True)]


def two_way_means(*tables: np.ndarray, resamples: int = RESAMPLES, seed: int = 0) -> list[Interval]:
    """`two_way` of the means of tables, by matrix products over how often rows and columns come."""
    rng = np.random.default_rng(seed)
    rows, columns = (
        rng.multinomial(n, np.full(n, 1 / n), resamples) / n for n in tables[0].shape[:2]
    )
    tail = (1 - _CONFIDENCE) / 2
    intervals = []
    for table in tables:
        drawn = ((rows @ table) * columns).sum(1)
        low, high = np.quantile(drawn, [tail, 1 - tail])
        intervals.append(Interval(float(table.mean()), float(low), float(high)))
    return intervals


def median(values: np.ndarray) -> Interval:
    """Median over runs with its bootstrap interval; values have shape (run,)."""
    return bootstrap(lambda i: quantile(values[i], 0.5), len(values))


def ratio_of_medians(a: np.ndarray, b: np.ndarray) -> Interval:
    """Median of a over that of b, of independent runs, with its bootstrap interval."""
    draws = np.random.default_rng(0)
    drawn = [quantile(v[draws.integers(0, v.size, (RESAMPLES, v.size))], 0.5) for v in (a, b)]
    with np.errstate(invalid="ignore"):
        ratios = np.nan_to_num(drawn[0] / drawn[1], nan=np.inf, posinf=np.inf)
        value = float(quantile(a, 0.5) / quantile(b, 0.5))
    low, high = (float(quantile(ratios, q)) for q in (0.025, 0.975))
    return Interval(value, low, high)


def mcnemar(a: np.ndarray, b: np.ndarray) -> float:
    """Exact two-sided McNemar test of paired successes, shape (run,): the p-value."""
    only_a = int((a & ~b).sum())
    only_b = int((b & ~a).sum())
    if only_a + only_b == 0:
        return 1.0
    return float(scipy.stats.binomtest(only_a, only_a + only_b).pvalue)


def wilcoxon(a: np.ndarray, b: np.ndarray, episodes: int) -> float:
    """Two-sided signed rank test of paired episodes to convergence: the p-value."""
    a, b = (np.minimum(v, episodes + 1) for v in (a, b))
    if (a == b).all():
        return 1.0
    return float(np.asarray(scipy.stats.wilcoxon(a, b, method="approx", zero_method="pratt"))[1])


def holm(p: ArrayLike) -> np.ndarray:
    """P-values of several comparisons, adjusted by Holm's step-down method.

    S. Holm, A simple sequentially rejective multiple test procedure, Scand. J. Statist. 6, 1979.
    """
    values = np.asarray(p, float)
    order = np.argsort(values)
    scaled = values[order] * np.arange(values.size, 0, -1)
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return adjusted


def trend(values: np.ndarray) -> float:
    """Page's test that values grow along the strategies: the one-sided p-value."""
    if (values == values[:1]).all():
        return 1.0
    return float(scipy.stats.page_trend_test(values.T, method="asymptotic").pvalue)
