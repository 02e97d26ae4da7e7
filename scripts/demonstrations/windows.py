"""Held grasps of the default scene, and the states at which windows of them begin."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.engines import Engine
from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene, parameters
from codesign_jax.types import Params, Trial, failed


class Grasps(NamedTuple):
    """Grasps with a leading axis (world,).

    Attributes:
      params: Their hands.
      trials: Their trials.
      fields: Their model fields.
      ctrl: Their controls.
    """

    params: Params
    trials: Trial
    fields: ModelFields
    ctrl: jax.Array

    def __getitem__(self, index: Any) -> "Grasps":
        """Some of the worlds."""
        return jax.tree.map(lambda v: v[index], self)


def held(scene: Scene, engine: Engine, count: int, seed: int = 0) -> Grasps:
    """Grasps that keep their object: designs around the 2D default, random trials.

    Args:
      scene: The scene.
      engine: The engine.
      count: Number of grasps.
      seed: Of designs and trials.

    Raises:
      RuntimeError: If fewer of three times as many are held.
    """
    space = parameters.design_space(scene.hand, "2d")
    factors = np.random.default_rng(seed).uniform(0.9, 1.1, (3 * count, space.num_parameters))
    params = jax.vmap(space.params)(jnp.asarray(factors * space.default(), jnp.float32))
    trials = rollout.sample_trials(scene, jax.random.key(seed), 3 * count)
    outcome, _ = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t))(params, trials)
    [good] = np.nonzero(~np.isfinite(outcome.lost_time) & ~failed(np.asarray(outcome.status)))
    if len(good) < count:
        raise RuntimeError(f"{len(good)} of {3 * count} grasps are held, {count} are needed")
    fields, ctrl, _ = rollout.prepare(scene, params, trials, scene.constants())
    return Grasps(params, trials, fields, ctrl)[good[:count]]


def states(engine: Engine, grasps: Grasps, steps: list[int]) -> list[jax.Array]:
    """States before some steps, arrays of shape (world, nq + nv)."""
    run, begin, found = jax.jit(engine.rollout), 0, []
    fields = grasps.fields
    for step in steps:
        last = run(fields, grasps.ctrl[:, begin:step]).last
        assert last is not None
        fields, begin = fields._replace(start=last), step
        found.append(last)
    return found


def timed(function: Callable, *args: Any) -> tuple[Any, float]:
    """The result, and the time that it took [s]: of all the CPU's threads, or of the GPU."""
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    begin = clock()
    found = jax.block_until_ready(function(*args))
    return found, clock() - begin


def cosine(a: Any, b: Any) -> float:
    """Cosine of the angle between two arrays taken as vectors."""
    a, b = np.ravel(a), np.ravel(b)
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))
