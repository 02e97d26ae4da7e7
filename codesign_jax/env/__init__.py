"""Grasps as an environment for reinforcement learning: `reset` and `step` as pure functions.

A `GraspEnv` has the names of Brax's and MuJoCo Playground's environments, and their trainers take
it: it is one world, which `jax.vmap` makes a batch of, that one kernel simulates.  An action scales
the pressures of the scene's key frames over a period, whose arm moves as they say: zeros make the
grasp of the key frames.  What an agent observes, does and is rewarded for are methods that a class
of one's own replaces.  `env.vector` is a vector environment of Gymnasium, an extra.

>>> import jax
>>> import jax.numpy as jnp
>>> from codesign_jax import env, scene
>>> grasping = env.GraspEnv(scene.load("paper"), period=0.1)
>>> grasping.observation_size, grasping.action_size
(22, 4)
>>> keys = jax.random.split(jax.random.key(0), 8)
>>> state = jax.jit(jax.vmap(grasping.reset))(keys)
>>> state = jax.jit(jax.vmap(grasping.step))(state, jnp.zeros((8, 4)))  # as the key frames say
>>> state.obs.shape, state.reward.shape
((8, 22), (8,))
"""

from codesign_jax.env.grasp import Data, GraspEnv, State

__all__ = ["Data", "GraspEnv", "State"]
