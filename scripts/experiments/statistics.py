"""Success, convergence and their uncertainty (paper Sec. VI.3), paired over the shared seeds."""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

from codesign_jax.codesign import SUCCESS_COST, convergence_episode
from codesign_jax.statistics import Interval

RULES = ("exclude", "worst")
"""Rules for failed trials under which results are evaluated; see `cost.particle_cost`."""

_CONFIDENCE = 0.95
_RESAMPLES = 10_000


@dataclasses.dataclass(frozen=True)
class Study:
    """The committed results of an experiment on strategies.

    Attributes:
      plan: Sizes; see `plan.Strategies`.
      notes: Provenance.
      data: Arrays; see `results.summarize`.
    """

    plan: dict[str, Any]
    notes: dict[str, Any]
    data: dict[str, np.ndarray]

    @property
    def strategies(self) -> list[str]:
        """Names of the strategies."""
        return [str(s) for s in self.data["strategies"]]

    @property
    def per_episode(self) -> int:
        """Simulations of one run in one episode."""
        return self.plan["particles"] * self.plan["trials"]

    def success(self, rule: str = "exclude") -> np.ndarray:
        """Whether any final particle's mean test cost is below 0.01, bool, (strategy, run)."""
        return np.any(self.data[f"test_{rule}"] < SUCCESS_COST, axis=-1)

    def convergence(self, rule: str = "exclude") -> np.ndarray:
        """Episodes simulated when the mean cost is below 1.0 for good, (strategy, run).

        The episode that converged is counted; infinite where a run did not converge.
        """

        def count(means: np.ndarray) -> float:
            episode = convergence_episode(means)
            return np.inf if episode is None else episode + 1.0

        return np.apply_along_axis(count, -1, self.data[f"mean_{rule}"])


def load(folder: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """Reads NAME.npz and NAME.json of a folder; None where there are none."""
    path = folder / f"{name}.npz"
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as file:
        data = {key: file[key] for key in file.files}
    return data, json.loads((folder / f"{name}.json").read_text())


def load_study(folder: Path, name: str) -> Study | None:
    """Reads an experiment on strategies; None where its files are missing."""
    found = load(folder, name)
    if found is None:
        return None
    data, notes = found
    return Study(notes["settings"]["plan"], notes, data)


def quantile(values: np.ndarray, q: float) -> np.ndarray:
    """Quantile over the last axis, also where numbers are infinite.

    The median of an even count is the mean of two, elsewhere it is one of the numbers: NumPy's
    "averaged_inverted_cdf", whose interpolation turns two infinite neighbours into nan.
    """
    rank = values.shape[-1] * q
    first, second = (max(int(np.ceil(rank)) - 1, 0), min(int(rank), values.shape[-1] - 1))
    ordered = np.sort(values, axis=-1)
    return (ordered[..., first] + ordered[..., second]) / 2


def bootstrap(values: np.ndarray, statistic, *, seed: int = 0) -> Interval:
    """Percentile bootstrap over the last axis; runs never converged take part as infinite.

    SciPy's interpolates between resamples, which makes two infinite neighbours not a number.

    Args:
      values: Numbers of the runs, shape (..., run): leading rows are resampled together, which
        keeps their pairing.
      statistic: Function of resampled values, (..., resample, run) -> (resample,).
      seed: Seed of the resampling.
    """
    runs = values.shape[-1]
    rows = np.random.default_rng(seed).integers(0, runs, (_RESAMPLES, runs))
    drawn = np.asarray(statistic(values[..., rows]), float)
    tail = (1 - _CONFIDENCE) / 2
    value = float(np.squeeze(statistic(values[..., None, :])))
    low, high = (float(quantile(drawn, q)) for q in (tail, 1 - tail))
    return Interval(value, low, high)


def median(values: np.ndarray, *, seed: int = 0) -> Interval:
    """Median over runs with its bootstrap interval; values have shape (run,)."""
    return bootstrap(values, lambda v: quantile(v, 0.5), seed=seed)


def ratio_of_medians(a: np.ndarray, b: np.ndarray) -> Interval:
    """Median of a over that of b, of independent runs, with its bootstrap interval."""
    draws = np.random.default_rng(0)
    drawn = [quantile(v[draws.integers(0, v.size, (_RESAMPLES, v.size))], 0.5) for v in (a, b)]
    with np.errstate(invalid="ignore"):
        ratios = np.nan_to_num(drawn[0] / drawn[1], nan=np.inf, posinf=np.inf)
        value = float(quantile(a, 0.5) / quantile(b, 0.5))
    low, high = (float(quantile(ratios, q)) for q in (0.025, 0.975))
    return Interval(value, low, high)


def mcnemar(a: np.ndarray, b: np.ndarray) -> float:
    """Exact two-sided McNemar test of paired successes, shape (run,): the p-value."""
    only_a, only_b = int((a & ~b).sum()), int((b & ~a).sum())
    if only_a + only_b == 0:
        return 1.0
    return float(scipy.stats.binomtest(only_a, only_a + only_b).pvalue)


def wilcoxon(a: np.ndarray, b: np.ndarray, episodes: int) -> float:
    """Two-sided signed rank test of paired episodes to convergence: the p-value.

    Args:
      a: Episodes, shape (run,); infinite where a run did not converge.
      b: Episodes of the other strategy.
      episodes: Episodes of a run; a run that did not converge counts as one more.
    """
    a, b = (np.minimum(v, episodes + 1) for v in (a, b))
    if (a == b).all():
        return 1.0
    return float(scipy.stats.wilcoxon(a, b, method="approx", zero_method="pratt").pvalue)


def trend(values: np.ndarray) -> float:
    """Page's test that values grow along the strategies: the one-sided p-value.

    Args:
      values: Finite numbers, shape (strategy, run); runs are the paired blocks.
    """
    if (values == values[:1]).all():
        return 1.0
    return float(scipy.stats.page_trend_test(values.T, method="asymptotic").pvalue)


class Region(NamedTuple):
    """A connected region of the landscape.

    Attributes:
      share: Its part of the grid's points.
      centre: Mean of its points in the parameters' units, shape (2,).
      low: Lower ends, shape (2,).
      high: Upper ends, shape (2,).
      mean: Mean cost in it.
      points: Its points, bool, shape (point, point).
    """

    share: float
    centre: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mean: float
    points: np.ndarray


def regions(
    data: dict[str, np.ndarray], threshold: float, rule: str = "exclude", smallest: float = 0.005
) -> list[Region]:
    """Connected components with cost below a threshold, largest first; points meet at edges.

    Args:
      data: Arrays of the landscape.
      threshold: Cost.
      rule: Rule for failed trials.
      smallest: Part of the grid below which a component counts as a speck and is left out.
    """
    from scipy import ndimage

    cost = data[rule]
    labels, count = ndimage.label(cost < threshold)  # type: ignore[misc]
    axes = np.meshgrid(data["first_axis"], data["second_axis"], indexing="ij")
    found = []
    for label in range(1, count + 1):
        points = labels == label
        where = np.stack([a[points] for a in axes])
        mean = float(cost[points].mean())
        found.append(
            Region(float(points.mean()), where.mean(1), where.min(1), where.max(1), mean, points)
        )
    return sorted((r for r in found if r.share >= smallest), key=lambda r: -r.share)
