"""From what was simulated to what is kept: small arrays, and where they come from."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Status, failed
from scripts.experiments.plan import Strategies
from scripts.experiments.strategies import Arrays
from scripts.shared import output, provenance

BITS = tuple(s for s in Status if s)
"""Status bits in the order of the `failed` arrays' last axis."""


def both_means(scene: Scene, cost: np.ndarray, status: np.ndarray) -> dict[str, np.ndarray]:
    """Mean cost over the last axis by either rule for failed trials; see `cost.particle_cost`."""
    good = ~failed(status)
    total = np.where(good, cost, 0).sum(-1, dtype=np.float64)
    count = good.sum(-1)
    exclude = np.where(count > 0, total / np.maximum(count, 1), scene.cost.maximum)
    worst = (total + scene.cost.maximum * (~good).sum(-1)) / good.shape[-1]
    return {"exclude": exclude.astype(np.float32), "worst": worst.astype(np.float32)}


def failures(status: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """Counts of each status bit over some axes; the last axis is that of `BITS`."""
    return np.stack([((status & bit) != 0).sum(axes) for bit in BITS], -1).astype(np.int32)


def of_strategies(plan: Strategies, scene: Scene, space: DesignSpace, found: Arrays) -> Arrays:
    """What is kept of `strategies.gather`; docs/notes/results.md says what each array is."""
    cost, status = found["cost"], found["status"]
    quartiles = np.quantile(cost, [0.25, 0.5, 0.75], axis=-1).astype(np.float32)
    means = both_means(scene, found["trial_cost"], status)
    if "test_cost" in found:
        test = both_means(scene, found["test_cost"], found["test_status"])
        test_status = found["test_status"]
    else:  # not a number: the final test is not complete
        test = {rule: np.full(found["particles"].shape[:3], np.nan, np.float32) for rule in means}
        test_status = np.zeros((*found["particles"].shape[:3], 1), np.uint8)
    return {
        "strategies": np.array(plan.strategies),
        "first": np.array(plan.first()),
        "parameters": np.array(space.names),
        "seeds": found["seeds"],
        "seed_cost": found["seed_cost"],
        "seed_candidates": found["seed_candidates"],
        "mean": cost.mean(-1),
        "best": cost.min(-1),
        "quartiles": np.moveaxis(quartiles, 0, -1),
        "mean_exclude": means["exclude"].mean(-1),
        "mean_worst": means["worst"].mean(-1),
        "failed": failures(status, (3, 4)),
        # Enough for Fig. 6; half precision is finer than the costs' own steps matter in a plot.
        "particle_cost": cost[-1].astype(np.float16),
        "final_particles": found["particles"],
        "test_exclude": test["exclude"],
        "test_worst": test["worst"],
        "test_failed": failures(test_status, (3,)).astype(np.int16),
    }


def of_landscape(scene: Scene, space: DesignSpace, found: Arrays) -> Arrays:
    """What is kept of `landscape.simulate`."""
    cost, status = found["trial_cost"], found["status"]
    means = both_means(scene, cost, status)
    designs = space.in_units(found["designs"])
    return {
        "parameters": np.array(space.names),
        "units": np.array(space.units),
        "first_axis": designs[:, 0, 0],
        "second_axis": designs[0, :, 1],
        "exclude": means["exclude"],
        "worst": means["worst"],
        "success_ratio": ((cost == 0) & ~failed(status)).mean(-1),
        "failed": failures(status, (2,)).astype(np.int16),
    }


def settings_of(plan: Any, scene: Scene, engine: str, seed: int) -> dict[str, object]:
    """What determines the numbers of an experiment, beside code, versions and device."""
    return {
        "plan": dataclasses.asdict(plan),
        "scene": scene.name,
        "scene_sha256": provenance.scene_hash(scene),
        "failure": scene.cost.failure,
        "engine": engine,
        "seed": seed,
    }


def write(folder: Path, name: str, arrays: Arrays, notes: dict[str, object]) -> None:
    """Writes NAME.npz and NAME.json."""
    output.write_arrays(folder / f"{name}.npz", arrays)
    output.write_json(folder / f"{name}.json", notes, indent=2)
