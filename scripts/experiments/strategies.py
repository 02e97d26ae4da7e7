"""All strategies and runs of an experiment: run folders, which `runs.optimize` fills in one batch.

Run r of every strategy has the seed `seed + r`: what `codesign optimize --seed` makes of it.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax import runs
from codesign_jax.runs import Record
from codesign_jax.scene import Scene
from scripts.experiments.plan import Strategies

Arrays = dict[str, Any]
"""NumPy arrays by name."""


def folders(plan: Strategies, folder: Path, seed: int) -> dict[str, list[Path]]:
    """Folders of each strategy's runs."""
    numbers = range(seed, seed + plan.runs)
    return {name: [folder / name / f"seed-{n}" for n in numbers] for name in plan.strategies}


def plans(
    plan: Strategies, scene: Scene, engine: str, folder: Path, seed: int
) -> dict[Path, runs.Plan]:
    """Every run by its folder."""
    sizes = {n: getattr(plan, n) for n in ("particles", "trials", "episodes", "test_trials")}
    how = plan.preset, plan.strategies[0], plan.first()[0], engine
    base = runs.prepare(scene, runs.make_settings(*how, seed, **sizes))
    found = {}
    for name, places in folders(plan, folder, seed).items():
        for r, (place, first) in enumerate(zip(places, plan.first(), strict=True)):
            changed = {"schedule": name, "first": first, "seed": seed + r}
            found[place] = runs.variant(base, dataclasses.replace(base.settings, **changed))
    return found


def gather(plan: Strategies, folder: Path, seed: int) -> Arrays | None:
    """What the runs of an experiment have so far.

    Returns:
      Arrays that begin with the axes (strategy, run): `particles`, and of the episodes that every
      run has `cost` (episode, particle), `trial_cost`, `status` and `lost_time` (episode, particle,
      trial); `test_cost` and `test_status` (particle, trial) if every run has its final test; and
      `seeds`, `seed_cost`, `seed_candidates` of the first strategy, which begin with the axis
      (run,). None if a run has not begun.
    """
    every = [
        [runs.load_record(place) for place in places]
        for places in folders(plan, folder, seed).values()
    ]
    records = [record for row in every for record in row if record is not None]
    if len(records) < plan.num_runs:
        return None
    done = min(record.done for record in records)
    tested = all(record.test is not None for record in records)
    rows, shape = [_one(record, done, tested) for record in records], (len(every), plan.runs)
    found = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    found = {name: values.reshape(*shape, *values.shape[1:]) for name, values in found.items()}
    starts = [record.start for record in records[: plan.runs] if record.start is not None]
    names = {"design": "seeds", "cost": "seed_cost", "candidates": "seed_candidates"}
    return found | {new: np.array([getattr(s, old) for s in starts]) for old, new in names.items()}


def _one(record: Record, done: int, tested: bool) -> Arrays:
    """Arrays of a run."""
    history, trials = record.history, record.history.outcomes
    found = {
        "particles": np.asarray(record.state.particles),
        "cost": history.cost[:done],
        "trial_cost": trials.cost[:done],
        "status": trials.status[:done].astype(np.uint8),
        "lost_time": trials.lost_time[:done],
    }
    if tested:
        assert record.test is not None
        test = {"cost": record.test.cost, "status": record.test.status}
        found |= {
            "test_cost": np.asarray(test["cost"]),
            "test_status": np.asarray(test["status"]).astype(np.uint8),
        }
    return found
