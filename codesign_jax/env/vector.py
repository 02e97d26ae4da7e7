"""Grasps as a vector environment of Gymnasium, for its trainers; needs the extra `gymnasium`."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from codesign_jax.env.grasp import GraspEnv


class VectorEnv(gymnasium.vector.VectorEnv):
    """Several grasps at once, which one program simulates; see `gymnasium.vector.VectorEnv`.

    A grasp that has ended begins anew, in another random trial, in the step after its last one.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, env: GraspEnv, num_envs: int, *, seed: int = 0):
        self.env, self.num_envs = env, num_envs
        size = env.observation_size, env.action_size
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, size[:1], np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, size[1:], np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._key, self._state = jax.random.key(seed), None

        def reset(key: jax.Array) -> tuple[jax.Array, Any]:
            key, draw = jax.random.split(key)
            return key, jax.vmap(env.reset)(jax.random.split(draw, num_envs))

        def step(key: jax.Array, state: Any, action: jax.Array) -> tuple[jax.Array, Any]:
            key, fresh = reset(key)
            after = jax.vmap(env.step)(state, action)

            def either(new: jax.Array, old: jax.Array) -> jax.Array:
                done = state.done.reshape(-1, *[1] * (new.ndim - 1)) > 0
                return jnp.where(done, new, old)

            return key, jax.tree.map(either, fresh, after)

        self._reset, self._step = jax.jit(reset), jax.jit(step)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins all grasps anew; see Gymnasium."""
        if seed is not None:
            self._key = jax.random.key(seed)
        self._key, self._state = self._reset(self._key)
        return np.asarray(self._state.obs), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Observations, rewards, terminations, truncations (never) and metrics; see Gymnasium."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._key, self._state = self._step(self._key, self._state, jnp.asarray(actions))
        state = self._state
        obs, reward, over = np.asarray(state.obs), np.asarray(state.reward), np.asarray(state.done)
        return obs, reward, over > 0, np.zeros(self.num_envs, bool), self._info()

    def _info(self) -> dict[str, Any]:
        assert self._state is not None
        return {name: np.asarray(value) for name, value in self._state.metrics.items()}
