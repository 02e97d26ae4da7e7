"""Outcomes of trials in a file, with what determines them: simulated once, and found again."""

import zipfile
from pathlib import Path

import numpy as np

from codesign_jax import files
from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.scene_files import scene_texts
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome


def key(scene: Scene, engine: str, designs: np.ndarray, trials: int, seed: int) -> str:
    """Digest of what determines outcomes, beside code, versions and device.

    Args:
      scene: The scene.
      engine: Name of the engine.
      designs: Designs [SI units], shape (design, parameter).
      trials: Trials of each design.
      seed: Root of the trials' noise.
    """
    texts = {name: np.array(text) for name, text in scene_texts(scene).items()}
    how = {"engine": np.array(engine), "trials": np.array(trials), "seed": np.array(seed)}
    return digest({"scene": texts, "designs": np.asarray(designs)} | how)


def save(path: Path, outcomes: Outcome, key: str) -> None:
    """Writes outcomes, arrays of any shape, and their `key`."""
    with files.atomically(path) as part, part.open("wb") as file:
        np.savez(file, key=np.array(key), **outcomes._asdict())


def load(path: Path, key: str) -> Outcome | None:
    """Reads outcomes; None if there are none, of another key, or the file is damaged."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            if str(stored["key"]) != key:
                return None
            return Outcome(**{name: stored[name] for name in Outcome._fields})
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        return None


def count(path: Path) -> int:
    """Number of trials of the outcomes in a file, whatever their key; 0 if there are none."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return stored["cost"].size
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        return 0
