"""Outcomes of trials in a file, with what determines them: simulated once, and found again."""

from pathlib import Path

import numpy as np

from codesign_jax import store
from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.scene_files import scene_texts
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome


def key(scene: Scene, engine: str, designs: np.ndarray, trials: int, seed: int) -> str:
    """Digest of what determines outcomes, beside code, versions and device."""
    texts = {name: np.array(text) for name, text in scene_texts(scene).items()}
    how = {"engine": np.array(engine), "trials": np.array(trials), "seed": np.array(seed)}
    return digest({"scene": texts, "designs": np.asarray(designs)} | how)


def save(path: Path, outcomes: Outcome, key: str) -> None:
    """Writes outcomes, arrays of any shape, their `key` and the code that simulated them."""
    store.save(path, store.head(key) | outcomes._asdict())


def load(path: Path, key: str) -> tuple[Outcome | None, str]:
    """Reads outcomes.

    Returns:
      The outcomes, or None; and why there are none, in words of which the file is the subject:
      it is of another key, of other code, or damaged. Empty if there is no such file.
    """
    try:
        arrays = store.load(path)
        why = store.refusal(arrays, key)
        if why:
            return None, why
        return Outcome(**{name: arrays[name] for name in Outcome._fields if name in arrays}), ""
    except FileNotFoundError:
        return None, ""
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    except store.StoreError:
        return None, "is damaged, or of another version of the code"


def count(path: Path) -> int:
    """Number of trials of the outcomes in a file, whatever their key; 0 if there are none."""
    try:
        return store.load(path)["cost"].size
    except (OSError, store.StoreError, KeyError):
        return 0
