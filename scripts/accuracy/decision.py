"""What a co-design run sees: verdicts, costs and ranks of particles over the same trials."""

import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.scene import Scene, parameters
from codesign_jax.types import failed
from scripts.accuracy import worlds
from scripts.accuracy.settings import Setting
from scripts.shared import work

KEPT, FAILED = -1, -2
"""Marks in place of the time of loss: kept to the end, and failed."""
SEED = 5
"""Seed of the trials; no run of the reproduction tested its particles on it."""


def populations(data: Path, count: int) -> dict[str, np.ndarray]:
    """Final particles of the 23-parameter experiment [SI], each shape (count, 23), float32.

    "spread" takes every strategy's, at equal steps of rank of their test costs, as an optimiser
    meets them from start to end; "late" those of the concurrent run whose median cost is the
    median of the runs, which differ little.

    Args:
      data: Folder with 23d.npz.
      count: Particles of a population.
    """
    with np.load(data / "23d.npz", allow_pickle=False) as file:
        particles, cost = file["final_particles"], file["test_exclude"]
    flat, order = particles.reshape(-1, particles.shape[-1]), np.argsort(cost.ravel())
    rank = (np.arange(count) + 0.5) / count * len(flat)
    middle = np.median(cost[-1], axis=1)
    run = int(np.argsort(middle)[len(middle) // 2])
    late = particles[-1, run][np.linspace(0, particles.shape[2] - 1, count).round().astype(int)]
    return {"spread": flat[order[rank.astype(int)]], "late": late}


def simulate(
    setting: Setting, designs: np.ndarray, first: int, trials: int, *, moved: bool = False
) -> dict[str, Any]:
    """Time of loss of every trial [ms], or `KEPT` or `FAILED`, particle by particle.

    Args:
      setting: The setting.
      designs: Particles, shape (particle, 23).
      first: Number of the first trial.
      trials: Number of trials.
      moved: Whether the objects are displaced by `work.NUDGE`.
    """
    with worlds.floats(setting.wide) as dtype:
        scene = setting.scene()
        space = parameters.design_space(scene.hand)
        drawn = worlds.trials(scene, first + trials, seed=SEED)
        drawn = worlds.cast(jax.tree.map(lambda x: x[first:], drawn), dtype)
        if moved:
            drawn = work.nudged(drawn)
        engine = setting.make(scene)

        @jax.jit
        def run(particles, trials):
            return rollout.evaluate(scene, engine, jax.vmap(space.params)(particles), trials)

        start = time.perf_counter()
        found = jax.tree.map(np.asarray, run(jnp.asarray(designs, dtype), drawn))
        seconds = time.perf_counter() - start
    lost = np.where(np.isfinite(found.lost_time), 1e3 * found.lost_time, KEPT)
    lost = np.where(failed(found.status), FAILED, np.round(lost)).astype(int)
    status = found.status[found.status != 0]
    return {
        "particles": len(designs),
        "first": first,
        "trials": trials,
        "lost_ms": lost.ravel().tolist(),
        "status": {str(s): int((status == s).sum()) for s in np.unique(status)},
        "seconds_with_compile": round(seconds, 2),
    }


def costs(scene: Scene, record: dict[str, Any]) -> np.ndarray:
    """Costs of a record's trials, shape (particle, trial); NaN where a trial failed."""
    lost = np.array(record["lost_ms"], float).reshape(record["particles"], record["trials"])
    start, end = scene.window
    cost = scene.cost.maximum * (end - np.where(lost == KEPT, 1e3 * end, lost) * 1e-3)
    return np.where(lost == FAILED, np.nan, cost / (end - start))
