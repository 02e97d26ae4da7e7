"""What a benchmark simulates: designs in trials, and the fields and controls of these worlds."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import control, model, rollout
from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene, parameters
from codesign_jax.types import Params, Trial

TRIALS = 6
"""Trials of a design, as in the paper's episodes."""
GOOD = {"length": (64.0, 8.0), "arm_z": (0.0, 8.0)}
"""Middle and half range [mm] of 2D designs that hold their objects, by parameter."""
SEED = 2017
NUDGE = 1e-6
"""Displacement of the objects that shows how much of a difference chaos alone makes [m]."""


WINNERS = Path(__file__).parents[2] / "docs/data/search/buildable.npz"
"""Designs that searches at one accuracy recommended at the end of each of 100 seeds."""


def winners(path: Path = WINNERS) -> np.ndarray:
    """Designs of a search's .npz at its last mark, 23 parameters in SI units, (seed, 23)."""
    with np.load(path, allow_pickle=False) as stored:
        marks = [int(name.removeprefix("designs")) for name in stored if name.startswith("designs")]
        return stored[f"designs{max(marks)}"]


class Worlds(NamedTuple):
    """Hands and trials of a batch, every array with leading axis (world,)."""

    params: Params
    trials: Trial


def hands(chosen: Scene, count: int) -> Params:
    """Hands of in turn random designs of the whole table and good ones.

    Hand i does not depend on the count, so that a small batch is the start of a large one.

    Returns:
      Parameters, every array with a leading axis (design,).
    """
    rng = np.random.default_rng(SEED)
    table, plane = (parameters.design_space(chosen.hand, p) for p in ("full", "2d"))
    low = np.array(table.low)
    high = np.array(table.high)
    unit = rng.random((count, len(low) + len(GOOD)))
    random = jax.vmap(table.of_table.project)(jnp.asarray(low + (high - low) * unit[:, : len(low)]))
    middle = np.array([GOOD[n][0] for n in plane.names])
    half = np.array([GOOD[n][1] for n in plane.names])
    turn = 2.0 * unit[:, len(low) :] - 1.0
    turn[:2] = 0.0  # the first good design is the middle itself
    good = jnp.asarray(plane.from_units(middle + half * turn))
    even = np.arange(count) % 2 == 0

    def in_turn(first: jax.Array, second: jax.Array) -> jax.Array:
        mask = even.reshape(-1, *[1] * (first.ndim - 1))
        return jnp.where(mask, first, second).astype(jnp.float32)

    both = parameters.params_of(table, random), parameters.params_of(plane, good)
    return jax.tree.map(in_turn, *both)


def make_worlds(chosen: Scene, count: int) -> Worlds:
    """The first worlds of designs x trials, design by design, every design in the same trials."""
    params = hands(chosen, -(-count // TRIALS))
    trials = rollout.sample_trials(chosen, jax.random.key(SEED), TRIALS)
    index = np.arange(count)
    return Worlds(
        jax.tree.map(lambda x: np.asarray(x)[index // TRIALS], params),
        jax.tree.map(lambda x: np.asarray(x)[index % TRIALS], trials),
    )


def nudged(trials: Trial) -> Trial:
    """The trials with every object displaced by `NUDGE`."""
    return trials._replace(position=trials.position + np.asarray(NUDGE, trials.position.dtype))


def inputs(chosen: Scene, worlds: Worlds) -> tuple[ModelFields, jax.Array]:
    """Model fields and controls, shape (world, time, nu), of worlds."""
    return _inputs(chosen, *worlds)


@partial(jax.jit, static_argnums=0)
def _inputs(chosen: Scene, params: Params, trials: Trial) -> tuple[ModelFields, jax.Array]:
    return (
        jax.vmap(partial(model.model_fields, chosen))(params, trials),
        jax.vmap(partial(control.commands, chosen))(params, trials),
    )
