"""Statistics of costs: agreement of verdicts, rank correlation, distributions."""

import numpy as np
from numpy.typing import ArrayLike

from codesign_jax.codesign import SUCCESS_COST


def ranks(values: ArrayLike) -> np.ndarray:
    """Ranks from 1, ties at their mean rank, shape as the values'."""
    values = np.asarray(values, float)
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2.0)[inverse]


def spearman(a: ArrayLike, b: ArrayLike) -> float | None:
    """Spearman's rank correlation; None if one of the two does not vary."""
    x, y = ranks(a), ranks(b)
    if x.std() == 0 or y.std() == 0:
        return None
    return float(np.corrcoef(x, y)[0, 1])


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
    x, y = np.sort(np.asarray(a, float)), np.sort(np.asarray(b, float))
    every = np.concatenate([x, y])
    shares = [np.searchsorted(v, every, side="right") / v.size for v in (x, y)]
    distance = float(np.abs(shares[0] - shares[1]).max())
    scaled = distance * np.sqrt(x.size * y.size / (x.size + y.size))
    k = np.arange(1, 101)
    p = 2.0 * np.sum((-1.0) ** (k - 1) * np.exp(-2.0 * (k * scaled) ** 2))
    return {"distance": distance, "p": float(np.clip(p, 0.0, 1.0)) if scaled > 0.2 else 1.0}
