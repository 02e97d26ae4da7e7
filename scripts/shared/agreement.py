"""Statistics of costs: agreement of verdicts, rank correlation, distributions."""

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike

from codesign_jax.codesign import SUCCESS_COST


def spearman(a: ArrayLike, b: ArrayLike) -> float | None:
    """Spearman's rank correlation; None if one of the two does not vary."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(scipy.stats.spearmanr(a, b).statistic)


def agreement(cost: ArrayLike, reference: ArrayLike, trials: int) -> dict:
    """Compares costs of the same worlds, trials of a design following each other.

    Args:
      cost: Costs of worlds, shape (world,).
      reference: Costs of the same worlds, or of more of them, shape (>= world,).
      trials: Trials of a design; an incomplete last design is left out of the correlation.

    Returns:
      Counts and shares by name: the verdicts are cost < `SUCCESS_COST`.
    """
    a = np.asarray(cost, float)
    b = np.asarray(reference, float)[: a.size]
    a = a[: b.size]
    whole = a.size // trials * trials
    means = [x[:whole].reshape(-1, trials).mean(1) for x in (a, b)]
    kept, expected = a < SUCCESS_COST, b < SUCCESS_COST
    return {
        "worlds": int(a.size),
        "same_verdict": float((kept == expected).mean()),
        "success": float(kept.mean()),
        "success_reference": float(expected.mean()),
        "mean_abs_cost_difference": float(np.abs(a - b).mean()),
        "designs": int(whole // trials),
        "spearman": spearman(*means) if whole >= 3 * trials else None,
    }


def paired_difference(a: ArrayLike, b: ArrayLike) -> dict:
    """Difference of two success shares over the same worlds with its 95 % interval.

    The variance of the mean of the differences -1, 0 and 1, with one pseudo-count in each cell of
    discordant pairs (Agresti and Min 2005), so that an interval is never empty.

    Args:
      a: Whether each world succeeded, bool, shape (world,).
      b: The same of the other engine.
    """
    a, b = np.asarray(a, bool), np.asarray(b, bool)
    n = a.size
    only_a, only_b = int((a & ~b).sum()), int((b & ~a).sum())
    difference = (only_a - only_b) / n
    up, down, total = only_a + 0.5, only_b + 0.5, n + 2.0
    centre = (up - down) / total
    half = 1.96 * np.sqrt(up + down - (up - down) ** 2 / total) / total
    return {
        "difference": difference,
        "interval_95": [float(centre - half), float(centre + half)],
        "only_first": only_a,
        "only_second": only_b,
    }


def kolmogorov_smirnov(a: ArrayLike, b: ArrayLike) -> dict:
    """Two-sample Kolmogorov-Smirnov test with the asymptotic p-value.

    With ties, of which costs have many, the p-value is too large rather than too small.

    Args:
      a: Sample, shape (n,).
      b: Sample, shape (m,).
    """
    x, y = np.asarray(a, float), np.asarray(b, float)
    distance = float(scipy.stats.ks_2samp(x, y, method="asymp").statistic)
    # The limiting law: SciPy's own p-value is that of an exact test of n m / (n + m) values.
    scaled = distance * np.sqrt(x.size * y.size / (x.size + y.size))
    return {"distance": distance, "p": float(scipy.stats.kstwobign.sf(scaled))}
