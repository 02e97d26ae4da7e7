"""From the record of an experiment to what is kept: small arrays, and where they come from."""

import datetime
from pathlib import Path

import numpy as np

from codesign_jax.scene import Scene
from codesign_jax.types import Status, failed
from scripts.experiments.batch import Batch
from scripts.experiments.landscape import Grid
from scripts.shared import output, provenance
from scripts.shared.driver import Drive
from scripts.shared.record import KEPT, Arrays

BITS = tuple(s for s in Status if s)
"""Status bits in the order of the `failed` arrays' last axis."""


def costs(scene: Scene, lost_step: np.ndarray, status: np.ndarray) -> np.ndarray:
    """Cost of each trial from its packed form, float32; the maximum where it failed."""
    start, end = scene.window
    lost = np.where(lost_step == KEPT, end, lost_step * scene.discretization.timestep)
    cost = scene.cost.maximum * (end - lost) / (end - start)
    return np.where(failed(status), scene.cost.maximum, cost).astype(np.float32)


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


def summarize(experiment: Batch | Grid, record: Arrays) -> Arrays:
    """Returns what is kept of a record; docs/notes/results.md says what each array is."""
    return (
        _batch(experiment, record) if isinstance(experiment, Batch) else _grid(experiment, record)
    )


def _batch(batch: Batch, record: Arrays) -> Arrays:
    plan, scene, space = batch.plan, batch.scene, batch.worlds.space
    done = min(int(record["step"]), plan.episodes)
    cost, status = record["cost"][:, :, :done], record["status"][:, :, :done]
    trial_cost = costs(scene, record["lost_step"][:, :, :done], status)
    quartiles = np.quantile(cost, [0.25, 0.5, 0.75], axis=-1).astype(np.float32)
    means = both_means(scene, trial_cost, status)
    test = both_means(scene, record["test_cost"], record["test_status"])
    if int(record["step"]) < batch.steps:  # not a number: the final test is not complete
        test = {rule: np.full_like(v, np.nan) for rule, v in test.items()}
    return {
        "strategies": np.array(plan.strategies),
        "first": np.array(plan.first()),
        "parameters": np.array(space.names),
        "seeds": record["seeds"],
        "seed_cost": record["seed_cost"],
        "seed_candidates": record["seed_candidates"],
        "mean": cost.mean(-1),
        "best": cost.min(-1),
        "quartiles": np.moveaxis(quartiles, 0, -1),
        "mean_exclude": means["exclude"].mean(-1),
        "mean_worst": means["worst"].mean(-1),
        "failed": failures(status, (3, 4)),
        # Enough for Fig. 6; half precision is finer than the costs' own steps matter in a plot.
        "particle_cost": cost[-1].astype(np.float16),
        "final_particles": record["particles"],
        "test_exclude": test["exclude"],
        "test_worst": test["worst"],
        "test_failed": failures(record["test_status"], (3,)).astype(np.int16),
    }


def _grid(grid: Grid, record: Arrays) -> Arrays:
    done = grid.plan.block * int(record["step"])
    status = record["status"][..., :done]
    means = both_means(grid.scene, record["trial_cost"][..., :done], status)
    space = grid.worlds.space
    return {
        "parameters": np.array(space.names),
        "units": np.array(space.units),
        "first_axis": space.in_units(record["designs"])[:, 0, 0],
        "second_axis": space.in_units(record["designs"])[0, :, 1],
        "exclude": means["exclude"],
        "worst": means["worst"],
        "success_ratio": ((record["trial_cost"][..., :done] == 0) & ~failed(status)).mean(-1),
        "failed": failures(status, (2,)).astype(np.int16),
    }


def describe(
    settings: dict[str, object],
    done: Drive,
    grasps: int,
    *,
    commit: str | None = None,
) -> dict[str, object]:
    """Returns what a result depends on, and what it took.

    Args:
      settings: See `record.settings`.
      done: The drive that finished the experiment.
      grasps: Grasps of the experiment.
      commit: Commit of the code, for a machine without git.
    """
    return {
        **provenance.results(commit),
        "settings": settings,
        "grasps": grasps,
        "grasps_that_screened_seeds": done.screened,
        "wall_seconds": round(done.total_seconds, 1),
        "processes": done.processes,
        "last_process": {
            "grasps": done.grasps,
            "seconds": round(done.seconds, 1),
            "seconds_before_the_second_step": round(done.first_seconds, 1),
            "grasps_per_s": round(done.rate, 1),
        },
    }


def write(folder: Path, name: str, arrays: Arrays, notes: dict[str, object]) -> list[Path]:
    """Writes NAME.npz and NAME.json; returns their paths."""
    made = {"written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")}
    return [
        output.write_arrays(folder / f"{name}.npz", arrays),
        output.write_json(folder / f"{name}.json", notes | made, indent=2),
    ]
