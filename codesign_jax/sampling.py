"""Many grasps at random: designs and trials that follow from a key, and what becomes of them.

Design i and its trials follow from the key and i alone.  So any part of a data set can be drawn
again, or simulated somewhere else; where outcomes are known, nothing but the key is needed for the
rest of its rows.

>>> import jax
>>> from codesign_jax import parameters, sampling, scene
>>> grasping = scene.load("paper")
>>> space = parameters.design_space(grasping.hand, "2d")
>>> drawn = sampling.draw(grasping, space, jax.random.key(0), first=1000, n=4, num_trials=3)
>>> drawn.designs.shape, drawn.trials.position.shape  # (design, parameter), (design, trial, axis)
((4, 2), (4, 3, 2))
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax import axes, rollout
from codesign_jax.engines import Engine
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, Trial

_DESIGNS = 0
_TRIALS = 1
"""Folded into the key for designs and for trials."""


class Drawn(NamedTuple):
    """Designs and what each of them is to grasp.

    Attributes:
      designs: Design vectors [SI], shape (design, parameter).
      trials: Trials of its own for each design, leading axes (design, trial).
    """

    designs: jax.Array
    trials: Trial


def draw(
    scene: Scene, space: DesignSpace, key: jax.Array, *, first: Any, n: int, num_trials: int
) -> Drawn:
    """Draws legal designs (`DesignSpace.sample`) and trials (`rollout.sample_trials`) for each.

    Trial t of design i is of the object i * num_trials + t, counted round the scene's set, so that
    objects are equally frequent, and has noise of its own: that of trial t of the key of i.

    Args:
      space: Space of the designs.
      key: Typed key.
      first: Index of the first design; may be traced.
      n: Number of designs.
      num_trials: Trials of each design.

    Returns:
      Designs first to first + n - 1 with their trials.

    Raises:
      InputError: If `key` is not one typed key, or a number is no whole number or below 1.
    """
    axes.refuse_draws(key, num_trials)
    return _drawn(space, n, num_trials, key, first, scene.bare)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _drawn(
    space: DesignSpace, n: int, num_trials: int, key: jax.Array, first: Any, scene: Scene
) -> Drawn:
    """`draw` for any scene of a structure; one program for a number of designs and trials."""
    designs = space.sample(jax.random.fold_in(key, _DESIGNS), n, first=first)
    root = jax.random.fold_in(key, _TRIALS)
    shapes = len(scene.objects.object)

    def trials(i: jax.Array) -> Trial:
        design_key = jax.random.fold_in(root, i)
        sampled = rollout.sample_trials(scene, design_key, num_trials)
        # Remainders first: the product itself may be larger than an int32.
        turn = (i % shapes) * (num_trials % shapes) + jnp.arange(num_trials)
        return sampled._replace(shape=turn % shapes)

    return Drawn(designs, jax.vmap(trials)(first + jnp.arange(n)))


def make_simulate(
    scene: Scene, engine: Engine, space: DesignSpace
) -> Callable[[jax.Array, Trial], Outcome]:
    """Returns a function (designs, trials) -> outcomes of shape (design, trial); one program.

    Its arguments are those of `Drawn`; another number of designs or trials compiles again.

    Args:
      engine: Engine that simulates.
      space: Space of the designs.
    """
    return SceneProgram(scene, _simulation(engine, space, rollout.Options()))


@shared
def _simulation(
    engine: Engine, space: DesignSpace, options: rollout.Options
) -> Callable[[jax.Array, Trial, Scene], Outcome]:
    def simulate(designs: jax.Array, trials: Trial, scene: Scene) -> Outcome:
        shape = trials.yaw.shape
        hands = jax.vmap(space.params)(jnp.repeat(designs, shape[1], axis=0))
        flat = jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), trials)
        outcomes, _ = rollout.simulate(scene, engine, hands, flat, **options._asdict())
        return rollout.grid(outcomes, shape)

    return jax.jit(simulate)  # thousands of grasps
