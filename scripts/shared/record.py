"""What an experiment has so far, as one file that can travel: save, load, fingerprint."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.scene_files import scene_texts
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome
from scripts.shared import output

Arrays = dict[str, Any]
"""NumPy arrays by name, `step` (the steps done) among them."""

KEPT = np.iinfo(np.uint16).max
"""`lost_step` of a trial in which the object was not lost."""


class StateError(ValueError):
    """A state file cannot be used."""


def pack(scene: Scene, outcome: Outcome) -> tuple[np.ndarray, np.ndarray]:
    """Returns the step of loss (uint16) and the status (uint8) of trials, three bytes each."""
    lost = np.asarray(outcome.lost_time, np.float64) / scene.discretization.timestep
    step = np.where(np.isfinite(lost), np.round(np.where(np.isfinite(lost), lost, 0)), KEPT)
    return step.astype(np.uint16), np.asarray(outcome.status).astype(np.uint8)


def scene_hash(scene: Scene) -> str:
    """SHA-256 of the resolved scene with hand and objects."""
    texts = scene_texts(scene)
    return hashlib.sha256("\n".join(texts[n] for n in sorted(texts)).encode()).hexdigest()


FREE = ("chunk",)
"""Settings that may change while an experiment goes on: like another device, another size of a call
moves the last bits and nothing else, and a continued experiment needs no bits of an earlier one."""


def settings(plan: Any, scene: Scene, engine: str, seed: int, chunk: int) -> dict[str, object]:
    """What determines the numbers of an experiment, beside code, versions and device.

    The chunk is kept with it, but may change on the way, see `load`.

    Args:
      plan: Sizes of the experiment, a dataclass of numbers and names.
      scene: The scene.
      engine: Name of the engine.
      seed: Root of all random numbers.
      chunk: Worlds of a call.
    """
    return {
        "plan": dataclasses.asdict(plan),
        "scene": scene.name,
        "scene_sha256": scene_hash(scene),
        "failure": scene.cost.failure,
        "engine": engine,
        "seed": seed,
        "chunk": chunk,
    }


def save(path: Path, record: Arrays, settings: dict[str, object]) -> None:
    """Writes a record with the settings it belongs to and a digest; as a whole or not at all."""
    notes = {"_settings": np.array(json.dumps(settings, sort_keys=True))}
    output.write_arrays(path, record | notes | {"_digest": np.array(digest(record))})


def load(path: Path, settings: dict[str, object]) -> Arrays:
    """Reads a record.

    Args:
      path: File written by `save`.
      settings: What it must belong to, but for `FREE`.

    Raises:
      StateError: If the file is damaged or belongs to something else.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            record = {name: arrays[name] for name in arrays.files}
        expected, found = str(record.pop("_digest")), json.loads(str(record.pop("_settings")))
    except Exception as error:  # damaged files raise whatever the parser at that byte raises
        raise StateError(f"{path} cannot be read ({type(error).__name__})") from error
    if digest(record) != expected:
        raise StateError(f"{path} is damaged: its digest differs")
    wanted = json.loads(json.dumps(settings))
    names = {*found, *wanted}.difference(FREE)
    different = [k for k in names if found.get(k) != wanted.get(k)]
    if different:
        text = "; ".join(f"{k}: {found.get(k)} there, {wanted.get(k)} here" for k in different)
        raise StateError(f"{path} belongs to another experiment ({text}); delete it to start anew")
    return record
