"""Hands, trials and their model fields, the same numbers for every setting and float type."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np

from codesign_jax import rollout
from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene, parameters
from codesign_jax.types import Params, Trial
from scripts.shared import work
from scripts.shared.work import Worlds


@contextmanager
def floats(wide: bool) -> Iterator[type]:
    """JAX in float64 or float32 inside; gives the type."""
    with jax.enable_x64(wide):
        yield np.float64 if wide else np.float32


def designs(scene: Scene, count: int, *, good: bool = False) -> Params:
    """Hands of the benchmark, see `work.designs`: in turn random and good ones, or good ones only.

    Args:
      scene: A scene with the hand.
      count: Number of hands.
      good: Leaves the random ones out.
    """
    key = (scene.hand, count, good)
    if key not in _DRAWN:
        with floats(False):
            vectors = np.asarray(work.designs(scene, 2 * count if good else count))
            chosen = vectors[1::2] if good else vectors
            params = jax.vmap(lambda v: parameters.unflatten(scene.hand, v))(chosen)
        _DRAWN[key] = jax.tree.map(np.asarray, params)
    return _DRAWN[key]


def trials(scene: Scene, count: int, seed: int = work.SEED) -> Trial:
    """Trials drawn in float32: float64 would draw others."""
    key = (scene.objects, count, seed)
    if key not in _DRAWN:
        with floats(False):
            drawn = rollout.sample_trials(scene, jax.random.key(seed), count)
        _DRAWN[key] = jax.tree.map(np.asarray, drawn)
    return _DRAWN[key]


# Hands and trials do not depend on a setting: what was drawn for one serves all.
_DRAWN: dict[tuple, Any] = {}


def paired(params: Params, drawn: Trial) -> Worlds:
    """Hand i in trial i, trials repeating."""
    hands, count = params.length.shape[0], drawn.yaw.shape[0]
    index = np.arange(hands) % count
    return Worlds(params, jax.tree.map(lambda x: x[index], drawn))


def cast(tree, dtype: type):
    """Arrays of floats in a float type; integers stay."""
    return jax.tree.map(lambda x: x.astype(dtype) if np.asarray(x).dtype.kind == "f" else x, tree)


def inputs(scene: Scene, worlds: Worlds, dtype: type) -> tuple[ModelFields, np.ndarray]:
    """Model fields and controls, shape (world, time, nu), as NumPy arrays.

    Args:
      scene: The scene.
      worlds: The worlds.
      dtype: Float type; JAX must be in the same mode, see `floats`.
    """
    made = work.inputs(scene, cast(worlds, dtype))
    return jax.tree.map(np.asarray, made)
