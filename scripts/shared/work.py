"""What a benchmark simulates: designs, trials, start states in contact, and variants of a scene."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import control, model, rollout, scene
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene, hand, parameters
from codesign_jax.types import Params, Trial

TRIALS = 6
"""Trials of a design, as in the paper's episodes."""
GOOD = {"length": (64.0, 8.0), "arm_z": (0.0, 8.0)}
"""Middle and half range [mm] of 2D designs that hold their objects, by parameter."""
SEED = 2017
NUDGE = 1e-6
"""Displacement of the objects that shows how much of a difference chaos alone makes [m]."""


class Worlds(NamedTuple):
    """Hands and trials of a batch, every array with leading axis (world,)."""

    params: Params
    trials: Trial


def variant(
    *,
    hand_name: str | None = None,
    fingers: int | None = None,
    links: int | None = None,
    spheres: int | None = None,
    solver: dict[str, Any] | None = None,
) -> Scene:
    """The scene `paper_spheres` with parts of it changed."""
    sizes = {"links": links, "spheres_per_link": spheres}
    table = {k: v for k, v in sizes.items() if v is not None}
    chosen = scene.load(
        "paper_spheres",
        hand_name=hand_name,
        overrides={"discretization": table, "solver": solver or {}},
    )
    return chosen if fingers is None else _with_fingers(chosen, fingers)


def _with_fingers(chosen: Scene, count: int) -> Scene:
    first = chosen.hand.finger[0]
    azimuths = 45.0 + np.arange(count) * 360.0 / count
    ring = {"spread": 0.0, "radius": first.base_distance, "tilt": first.tilt}
    mounts = tuple(hand.Finger(azimuth=float(a), **ring) for a in azimuths)
    changed = dataclasses.replace(chosen.hand, name=f"{chosen.hand.name}-{count}", finger=mounts)
    return dataclasses.replace(chosen, hand=changed)


def designs(chosen: Scene, count: int) -> jax.Array:
    """Full parameter vectors, in turn random ones of the whole table and good ones.

    Vector i does not depend on the count, so that a small batch is the start of a large one.

    Returns:
      Vectors in SI units, shape (design, full).
    """
    rng = np.random.default_rng(SEED)
    table, plane = (parameters.design_space(chosen.hand, p) for p in ("full", "2d"))
    low, high = np.array(table.low), np.array(table.high)
    unit = rng.random((count, len(low) + len(GOOD)))
    random = jax.vmap(table.project)(jnp.asarray(low + (high - low) * unit[:, : len(low)]))
    middle = np.array([GOOD[n][0] for n in plane.names])
    half = np.array([GOOD[n][1] for n in plane.names])
    turn = 2.0 * unit[:, len(low) :] - 1.0
    turn[:2] = 0.0  # the first good design is the middle itself
    good = jnp.asarray(plane.from_units(middle + half * turn))
    every = jax.vmap(table.expand)(random), jax.vmap(plane.expand)(good)
    return jnp.where((jnp.arange(count) % 2 == 0)[:, None], *every).astype(jnp.float32)


def make_worlds(chosen: Scene, count: int, *, repeat: int | None = None) -> Worlds:
    """The first worlds of designs x trials, design by design, every design in the same trials."""
    distinct = min(count, repeat or count)
    vectors = designs(chosen, -(-distinct // TRIALS))
    params = jax.vmap(lambda v: parameters.unflatten(chosen.hand, v))(vectors)
    trials = rollout.sample_trials(chosen, jax.random.key(SEED), TRIALS)
    index = np.arange(count) % distinct
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


def window(
    chosen: Scene, count: int, steps: int, *, distinct: int
) -> tuple[ModelFields, jax.Array]:
    """Model fields and controls of short rollouts that begin with inflated fingers.

    The start states are those of MuJoCo C at the end of the inflation, at rest.  A rollout of less
    than the time to the cost window decides no world, so that every engine simulates every step.

    Returns:
      Fields, whose start states are in contact, and controls, shape (world, steps, nu).
    """
    first = round(chosen.phases.inflate / chosen.discretization.timestep)
    some = make_worlds(chosen, min(count, distinct))
    fields, ctrl = inputs(chosen, some)
    engine = MujocoEngine(chosen)
    run = jax.jit(lambda f, c: engine.rollout(f, c, trajectory=True).qpos[:, -1])
    fields = fields._replace(start=run(fields, ctrl[:, :first]))
    index = np.arange(count) % min(count, distinct)
    return jax.tree.map(lambda x: x[index], (fields, ctrl[:, first : first + steps]))
