"""From records to errors: against the reference, with intervals, orders of convergence, fronts."""

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.scene import load as load_scene
from scripts.accuracy import decision, impulse, tip
from scripts.accuracy.settings import HULL, Setting
from scripts.shared.statistics import slope, spearman, two_way

Records = list[dict[str, Any]]

RESAMPLES = 500
ALPHA = 0.2
"""The particle filter's cost offset: its weights are 1 / (0.2 + cost)."""


def load(files: Iterable[Path]) -> tuple[Records, list[dict[str, Any]]]:
    """Records of files, the last file's of a case, and the runs that made them."""
    found: dict[str, dict[str, Any]] = {}
    runs: list[dict[str, Any]] = []
    for file in files:
        data = json.loads(file.read_text())
        for key, record in data["records"].items():
            values = dict(record["setting"])
            values["extra"] = tuple(values["extra"])
            # A file counts its own runs.
            found[key] = record | {"of": Setting(**values), "run": len(runs) + record["run"]}
        runs += data["runs"]
    return list(found.values()), runs


def measured(records: Records, part: str) -> Records:
    """Records of a part that hold a measurement."""
    return [r for r in records if r["part"] == part and not bad(r)]


def bad(record: dict[str, Any]) -> str | None:
    """Why a setting has no measurement."""
    return record.get("refused") or record.get("failed")


def tips(record: dict[str, Any]) -> np.ndarray:
    """Tips of a record [m], shape (hand, time, finger, 3)."""
    return 1e-3 * np.reshape(record["tips_mm"], record["shape"])


def _comparison(part: str, reference: dict[str, Any]) -> Callable[[dict], dict]:
    """Function from a record to its errors; the reference's long lists are read once."""
    if part == "impulse":
        return lambda record: impulse.compare(record, reference)
    finest = tips(reference)
    return lambda record: tip.compare(tips(record), finest)


def against_reference(records: Records, part: str) -> Records:
    """Records of the part tip or impulse with their errors; none without a reference."""
    every = measured(records, part)
    reference = next((r for r in every if "reference" in r["more"]), None)
    if reference is None:
        return []
    errors = _comparison(part, reference)
    return [r | errors(r) for r in every if r is not reference]


def order(points: Iterable[tuple[float, float]]) -> float | None:
    """Slope of log error over log size; None with fewer than three points."""
    x, y = np.array([p for p in points if p[1] > 0]).reshape(-1, 2).T
    return slope(x, y) if x.size > 2 else None


def orders(records: Records) -> dict[str, float | None]:
    """Measured orders of convergence, by what is refined and what is measured."""
    rows = against_reference(records, "tip")
    by_time = [r for r in rows if "at the reference's links" in r["more"]]
    by_links = [r for r in rows if "at the reference's time step" in r["more"]]
    found = {
        f"finger tip, time step, {kind} damping": order(
            (r["of"].timestep, r["tip_rms_mm"]) for r in by_time if r["of"].damping == kind
        )
        for kind in ("added", "least")
    }
    found |= {
        "finger tip, length of a link": order(
            (1 / r["of"].links, r["tip_rms_mm"]) for r in by_links
        ),
    }
    beams = measured(records, "beam")
    for name in sorted({k for r in beams for k in r if k.startswith(("elastica", "arc"))}):
        found[f"{name}, length of a link"] = order((1 / r["of"].links, r[name]) for r in beams)
    found["contact impulse, time step"] = order(by_step(records))
    return found


def by_step(records: Records) -> list[tuple[float, float]]:
    """Time steps and errors of the contact impulse, ten links."""
    return [
        (r["of"].timestep, r["impulse_error"])
        for r in against_reference(records, "impulse")
        if not r["more"] and r["of"] == Setting(timestep=r["of"].timestep)
    ]


Grasps = dict[tuple[Setting, bool, str], np.ndarray]


def decisions(records: Records) -> Grasps:
    """Costs by setting, whether the objects were moved, and population, (particle, trial).

    Not a number where a trial failed.
    """
    scene = load_scene("paper")
    return {
        (r["of"], each["moved"], each["name"]): decision.costs(scene, each)
        for r in measured(records, "decision")
        for each in r["populations"]
    }


def warned(records: Records, population: str) -> dict[Setting, dict[str, float]]:
    """Share of a population's trials by status bit, by setting."""
    return {
        r["of"]: {k: n / (p["particles"] * p["trials"]) for k, n in p["status"].items()}
        for r in measured(records, "decision")
        for p in r["populations"]
        if p["name"] == population and not p["moved"]
    }


def finest(grasps: Grasps, population: str) -> Setting | None:
    """The setting that stands for the truth: shortest step, float64, then most links."""
    known = [s for s, moved, name in grasps if name == population and not moved]
    usual = [s for s in known if s.engine == "structured" and s.iterations is None]
    usual = [s for s in usual if s.axes == 3 and not s.extra and s.surface == HULL]
    return min(usual, key=lambda s: (s.timestep, not s.wide, -s.links), default=None)


def means(cost: np.ndarray) -> np.ndarray:
    """Mean cost of every particle over the trials that did not fail, the maximum if all did."""
    good = np.isfinite(cost)
    total = np.where(good, cost, 0.0).sum(-1)
    return np.where(good.any(-1), total / np.maximum(good.sum(-1), 1), 3.0)


def compare(a: np.ndarray, b: np.ndarray) -> dict[str, Any]:
    """Decisions of a setting beside the reference's over the same particles and trials.

    Args:
      a: Costs, shape (particle, trial), NaN where a trial failed.
      b: The reference's; of more or fewer trials the first ones.
    """
    trials = min(a.shape[1], b.shape[1])
    a, b = a[:, :trials], b[:, :trials]
    mine, theirs = means(a), means(b)
    weights = [1 / (ALPHA + m) for m in (mine, theirs)]
    shares = [w / w.sum() for w in weights]

    intervals = two_way(_compared, a, b, resamples=RESAMPLES)
    return {
        "particles": len(a),
        "trials": trials,
        **dict(zip(COMPARED, intervals, strict=True)),
        # Share of the next generation that would come from another particle.
        "offspring_moved": float(0.5 * np.abs(shares[0] - shares[1]).sum()),
        "failed": float((~np.isfinite(a)).mean()),
    }


COMPARED = ("success", "success_reference", "success_difference", "flipped", "rank")
"""What `_compared` calculates: each with an interval over particles and trials."""


def _compared(a: np.ndarray, b: np.ndarray) -> list[float]:
    kept, expected = a < SUCCESS_COST, b < SUCCESS_COST
    success, right, flips = kept.mean(), expected.mean(), (kept != expected).mean()
    return [success, right, success - right, flips, spearman(means(a), means(b))]  # type: ignore[list-item]


def differ(kept: np.ndarray, moved: np.ndarray) -> float:
    """Share of verdicts that differ."""
    trials = min(kept.shape[1], moved.shape[1])
    verdicts = [cost[:, :trials] < SUCCESS_COST for cost in (kept, moved)]
    return float((verdicts[0] != verdicts[1]).mean())


def trial_noise(cost: np.ndarray, trials: int = 6) -> float | None:
    """Rank correlation of a setting with itself over other trials: what an episode's trials give.

    Args:
      cost: Costs, shape (particle, trial).
      trials: Trials of an episode.
    """
    blocks = [cost[:, i : i + trials] for i in range(0, cost.shape[1] - trials + 1, trials)]
    if len(blocks) < 2:
        return None
    each = [means(b) for b in blocks]
    return float(np.mean([spearman(a, b) for a, b in zip(each, each[1:], strict=False)]))


def times(records: Records) -> dict[tuple[str, Setting], dict[str, Any]]:
    """Times by engine's name and setting, whose own engine and float type say nothing."""
    found = {}
    for r in measured(records, "time"):
        for name, values in r["engines"].items():
            found[name, replace(r["of"], engine="structured")] = values
    return found


def front(points: list[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other one beats in cost and error, cheapest first."""
    best, chosen = np.inf, []
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if points[i][1] < best:
            best = points[i][1]
            chosen.append(i)
    return chosen
