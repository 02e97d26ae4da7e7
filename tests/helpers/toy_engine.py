"""A toy engine: grasps whose outcome is known without any physics."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from codesign_jax import scene
from codesign_jax.scene import parameters
from codesign_jax.types import Trace

TINY = Path(__file__).parents[1] / "data" / "tiny.toml"


class ToyEngine:
    """Loses the object at a time that grows with the fingers' length and the grasp's height.

    `traced`: how often a caller compiled its rollout.
    """

    name = "toy"

    def __init__(self, the_scene, *, failing=()):
        """Takes the worlds of a batch that come out as not finite."""
        self.scene = the_scene
        self.failing = list(failing)
        self.traced = 0

    def rollout(self, fields, ctrl, *, trajectory=False):
        """See `Engine.rollout`."""
        self.traced += 1
        worlds, steps = ctrl.shape[:2]
        length = 2 * self.scene.discretization.links * fields.offset[:, 0, 0]
        # From the start of the window at 0.5 s to past its end at 1.0 s, and a little noise.
        noise = 20 * fields.qpos[:, -7]
        lost = 0.5 + 8 * (length - 0.03) + 0.3 * ctrl[:, 20, 2] + noise
        time = np.arange(steps) * self.scene.discretization.timestep
        distance = jnp.where(time >= lost[:, None], 1.0, 0.0).astype(ctrl.dtype)
        bad = np.isin(np.arange(worlds), self.failing)
        speed = jnp.where(bad[:, None], jnp.nan, jnp.zeros((worlds, steps), ctrl.dtype))
        return Trace(distance, jnp.full_like(distance, 0.5), speed, jnp.zeros((worlds, steps, 0)))


def tiny(**overrides):
    """The tiny scene, its two-parameter design space, and a toy engine."""
    the_scene = scene.load(TINY, overrides=overrides)
    return the_scene, parameters.design_space(the_scene.hand, "2d"), ToyEngine(the_scene)


def frozen(optimizer, population, key):
    """State and mask of an episode that moves nothing: it simulates particles as they are.

    Its trials are those of the first episode of a run with this root key.
    """
    state = optimizer.init(key, population[0], len(population))
    mask = np.zeros(np.shape(optimizer.space.low), bool)
    return state._replace(particles=jnp.asarray(population)), mask
