"""Files of a wave: its grasps, and the scores that stay in the repository."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.optimize import ParticleFilter
from codesign_jax.scene import InputError, Scene
from codesign_jax.types import Status
from scripts.calibration import score, summary
from scripts.calibration.surrogate import Plan, filled, make_runs
from scripts.calibration.wave import Size, trial_costs
from scripts.experiments.strategies import Arrays
from scripts.shared import provenance, sets

SCORES = "_scores"
"""What follows a wave's name in the names of its scores."""


class Scored(NamedTuple):
    """The scores of a wave.

    Attributes:
      name: Its name.
      data: Arrays: `units`, `landscape` (half precision, (set, point, point)), `distances`
        ((set, target)), `capped` (share of trials in which the contact solver met its limit), the
        axes, and the fields of `summary.Summary` and `score.measures`.
      notes: Provenance of wave and scores.
    """

    name: str
    data: Arrays
    notes: dict[str, Any]

    @property
    def plausible(self) -> np.ndarray:
        """Which sets no target rules out, bool, shape (set,)."""
        return sets.plausible(self.data["distances"])

    @property
    def fidelity(self) -> str:
        """What was simulated, in words."""
        return self.notes["wave"]["settings"]["fidelity"]


def settings(scene: Scene, size: Size, units: np.ndarray, seed: int, fidelity: str) -> dict:
    """What determines the numbers of a wave, beside code, versions and device."""
    return {
        "scene_sha256": provenance.scene_hash(scene),
        "fidelity": fidelity,
        "points": size.points,
        "trials": size.trials,
        "chunk": size.chunk,
        "seed": seed,
        "sets": len(units),
        "sets_sha256": hashlib.sha256(np.ascontiguousarray(units, float).tobytes()).hexdigest(),
    }


def read(path: Path) -> tuple[Arrays, dict[str, Any]]:
    """Reads arrays and notes of NAME.npz and NAME.json.

    Raises:
      InputError: If a file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {key: file[key] for key in file.files}
        return data, json.loads(path.with_suffix(".json").read_text())
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError([f"{path} and its .json cannot be read: {error}"]) from error


def read_scores(paths: Sequence[Path]) -> list[Scored]:
    """Reads scores of waves.

    Raises:
      InputError: If a file is missing, damaged or holds no scores.
    """
    found = []
    for path in paths:
        data, notes = read(path)
        missing = {"units", "distances", "landscape"} - set(data)
        if missing or data["units"].shape[1:] != (len(sets.OPEN),):
            raise InputError([f"{path} holds no scores of a wave with {len(sets.OPEN)} constants"])
        found.append(Scored(path.stem.removesuffix(SCORES), data, notes))
    return found


def score_wave(
    kept: Arrays,
    optimizer: ParticleFilter,
    is_morphology: Sequence[bool],
    plan: Plan,
    *,
    seed: int = 0,
    batch: int = 32,
) -> Arrays:
    """Summaries, surrogate runs and implausibilities of a wave's sets.

    Args:
      kept: What `wave.keep` returned.
      optimizer: Particle filter over the two parameters.
      is_morphology: Domain of each parameter.
      plan: Sizes of the surrogate's runs.
      seed: Seed of run 0.
      batch: Sets of a call; memory only.
    """
    trials = trial_costs(kept)
    maximum = sets.values(kept["units"])["cost_maximum"]
    mean = summary.mean_costs(trials, maximum)
    axes = kept["first_axis"], kept["second_axis"]
    found = [summary.summarize(t, m, *axes) for t, m in zip(trials, maximum, strict=True)]
    keys = jax.vmap(jax.random.key)(np.arange(seed, seed + plan.runs))
    run = make_runs(optimizer, is_morphology, plan)
    runs = {
        noise: _in_batches(run, filled(trials, mean), keys, noise == "shared", batch)
        for noise in ("shared", "own")
    }
    measured = summary.stack(found) | score.measures(runs, plan)
    return {
        "units": kept["units"],
        "landscape": mean.astype(np.float16),
        "first_axis": kept["first_axis"],
        "second_axis": kept["second_axis"],
        "distances": score.implausibility(measured),
        "capped": ((kept["status"] & int(Status.SOLVER_CAP)) != 0).mean((1, 2, 3)),
        **measured,
    }


def _in_batches(runs, landscapes: np.ndarray, keys: jax.Array, shared: bool, batch: int):
    """Runs on all landscapes, some at a time, the last ones filled up with the last landscape."""
    parts = []
    for first in range(0, len(landscapes), batch):
        index = np.minimum(np.arange(first, first + batch), len(landscapes) - 1)
        parts.append(jax.tree.map(np.asarray, runs(landscapes[index], keys, shared)))
    return jax.tree.map(lambda *v: np.concatenate(v)[: len(landscapes)], *parts)


def next_sets(waves: Sequence[Scored], count: int, seed: int, keep: int) -> tuple[np.ndarray, str]:
    """Sets of the next wave, around those that no target rules out, and a line about them.

    Args:
      waves: Scores of all waves so far.
      count: Number of sets.
      seed: Seed of the draws.
      keep: If fewer sets are left, as many of the best take their place.
    """
    units = np.concatenate([w.data["units"] for w in waves])
    distances = np.concatenate([w.data["distances"] for w in waves])
    left = np.flatnonzero(sets.plausible(distances))
    text = f"around {len(left)} of {len(units)} sets that no target rules out"
    if len(left) < keep:
        left = score.best(distances, keep)
        text = f"around the {len(left)} best of {len(units)} sets, as fewer are not ruled out"
    return sets.around(units[left], count, seed), text
