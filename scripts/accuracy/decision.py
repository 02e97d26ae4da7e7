"""What a co-design run sees: verdicts, costs and ranks of particles over the same trials."""

import base64
import time
import zlib
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.scene import Scene, parameters
from codesign_jax.types import Outcome, Status, failed
from scripts.accuracy import worlds
from scripts.accuracy.settings import Setting
from scripts.shared import work

KEPT, FAILED, _PARTS = 255, 254, 250
"""Marks in place of the time of loss: kept to the end, and failed; parts of the time."""
SEED = 5
"""Seed of the trials; no run of the reproduction tested its particles on it."""


def populations(data: Path, count: int) -> dict[str, np.ndarray]:
    """Final particles of the 23-parameter experiment [SI], each shape (count, 23), float32.

    "spread" takes every strategy's, at equal steps of rank of their test costs, as an optimiser
    meets them from start to end; "late" distinct ones of all concurrent runs, as many of each as
    of any other: what a design run ends with.

    Args:
      data: Folder with 23d.npz.
      count: Particles of a population.
    """
    with np.load(data / "23d.npz", allow_pickle=False) as file:
        particles, cost = file["final_particles"], file["test_exclude"]
    flat, order = particles.reshape(-1, particles.shape[-1]), np.argsort(cost.ravel())
    rank = (np.arange(count) + 0.5) / count * len(flat)
    return {"spread": flat[order[rank.astype(int)]], "late": _distinct(particles[-1], count)}


def _distinct(runs: np.ndarray, count: int) -> np.ndarray:
    """Particles of runs, shape (run, particle, 23), in turn one of each, no two alike."""
    rng = np.random.default_rng(SEED)
    every = [rng.permutation(np.unique(run, axis=0)) for run in runs]
    depth = max(len(run) for run in every)
    chosen = [run[i] for i in range(depth) for run in every if i < len(run)][:count]
    if len(chosen) < count:
        raise ValueError(f"{count} particles asked for, the runs end with {len(chosen)} distinct")
    return np.array(chosen)


class Request(NamedTuple):
    """What is simulated: a population's name, its particles, and a number of trials.

    Attributes:
      name: Name of the population.
      designs: Particles, shape (particle, 23).
      trials: Number of trials, the first ones of all.
      moved: Whether the objects are displaced by `work.NUDGE`.
    """

    name: str
    designs: np.ndarray
    trials: int
    moved: bool = False


def simulate(setting: Setting, requests: list[Request], block: int) -> dict[str, Any]:
    """Verdicts and times of loss of every trial, particle by particle; see `encode`.

    Args:
      setting: The setting.
      requests: What to simulate.
      block: Trials of a call: calls of one size share a program.

    Returns:
      Under "populations" a record for each request, beside seconds with compilation.
    """
    start, found = time.perf_counter(), []
    with worlds.floats(setting.wide) as dtype:
        scene = setting.scene()
        space = parameters.design_space(scene.hand)
        engine = setting.make(scene)

        @jax.jit
        def run(particles, trials):
            return rollout.evaluate(scene, engine, jax.vmap(space.params)(particles), trials)

        for request in requests:
            drawn = worlds.cast(worlds.trials(scene, request.trials, seed=SEED), dtype)
            drawn = work.nudged(drawn) if request.moved else drawn
            particles = jnp.asarray(request.designs, dtype)
            size = min(block, request.trials)
            results = []
            for i in range(0, request.trials, size):
                part = jax.tree.map(partial(_rows, i, i + size), drawn)
                results.append(jax.tree.map(np.asarray, run(particles, part)))
            found.append(_record(scene, request, results))
    return {"populations": found, "seconds_with_compile": round(time.perf_counter() - start, 2)}


def _rows(first: int, last: int, array: np.ndarray) -> np.ndarray:
    return array[first:last]


def _record(scene: Scene, request: Request, results: list[Outcome]) -> dict[str, Any]:
    lost, status = (
        np.concatenate([getattr(r, n) for r in results], 1) for n in ("lost_time", "status")
    )
    causes = {str(b.name): int((status & b.value != 0).sum()) for b in Status if b.value}
    return {
        "name": request.name,
        "moved": request.moved,
        "particles": len(request.designs),
        "trials": request.trials,
        "lost": encode(lost, failed(status), scene.window),
        "status": {name: count for name, count in causes.items() if count},
    }


def encode(lost: np.ndarray, bad: np.ndarray, window: tuple[float, float]) -> str:
    """Times of loss as text: a byte a trial, compressed, in base 64.

    Args:
      lost: Times of loss [s], infinite where the object is kept, shape (particle, trial).
      bad: Whether the trial failed, same shape.
      window: Start and end of the time in which a loss costs [s]; a byte counts its 250th parts.
    """
    start, end = window
    share = np.clip((np.where(np.isfinite(lost), lost, end) - start) / (end - start), 0, 1)
    code = np.where(np.isfinite(lost), np.round(_PARTS * share), KEPT)
    code = np.where(bad, FAILED, code).astype(np.uint8)
    return base64.b64encode(zlib.compress(code.tobytes(), 9)).decode()


def costs(scene: Scene, record: dict[str, Any]) -> np.ndarray:
    """Costs of a record's trials, shape (particle, trial); NaN where a trial failed."""
    code = np.frombuffer(zlib.decompress(base64.b64decode(record["lost"])), np.uint8)
    code = code.reshape(record["particles"], record["trials"])
    cost = np.where(code == KEPT, 0.0, scene.cost.maximum * (1 - code / _PARTS))
    return np.where(code == FAILED, np.nan, cost)
