"""Grasps as a vector environment of Stable-Baselines3; needs that package and `gymnasium`.

Its trainers take a batch by a class of their own, and one program simulates this one.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from codesign_jax.env import vector
from codesign_jax.env.grasp import GraspEnv, State


class BatchEnv(VecEnv):
    """Several grasps at once; see `stable_baselines3.common.vec_env.VecEnv`.

    A grasp that has ended begins anew in the same step, in another random trial; what was observed
    last stands in `terminal_observation` of its info. `VecMonitor` records the episodes' rewards.
    """

    def __init__(self, env: GraspEnv, num_envs: int, *, seed: int = 0):
        """Takes the environment, how many of it there are, and the seed of the first.

        Args:
          seed: Seed of the first environment; the others count on from it.
        """
        self.env = env
        self._keys = vector.seed_keys([seed + i for i in range(num_envs)])

        def reset(keys: jax.Array) -> tuple[jax.Array, State]:
            return vector.begin(env, keys)

        def step(
            keys: jax.Array, state: State, action: jax.Array
        ) -> tuple[jax.Array, State, State]:
            after = jax.vmap(env.step)(state, action)
            keys, fresh = vector.begin(env, keys)
            return keys, after, vector.where_done(after, fresh, after)

        self._reset = jax.jit(reset)
        self._step = jax.jit(step)
        self._state: State | None = None
        self._actions = np.zeros((num_envs, env.action_size), np.float32)
        super().__init__(num_envs, *vector.spaces(env))

    def reset(self) -> np.ndarray:
        """Begins all grasps anew; after `seed`, with its seeds."""
        if any(seed is not None for seed in self._seeds):
            self._keys = vector.seed_keys([seed or 0 for seed in self._seeds])
            self._reset_seeds()
        self._keys, state = self._reset(self._keys)
        self._state = state
        return vector.observed(state)

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions, shape (environment, action)."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations, rewards, ends and infos after the actions of `step_async`."""
        if self._state is None:
            raise RuntimeError("call reset before step")
        actions = jnp.asarray(self._actions)
        self._keys, after, begun = self._step(self._keys, self._state, actions)
        self._state = begun
        done = np.asarray(after.done) > 0
        last = vector.observed(after)
        metrics = vector.metrics(after)
        infos: list[dict[str, Any]] = []
        for i in range(self.num_envs):
            info = {name: float(value[i]) for name, value in metrics.items()}
            ending = {"terminal_observation": last[i], "TimeLimit.truncated": False}
            infos.append(info | ending if done[i] else info)
        return vector.observed(begun), np.asarray(after.reward, np.float32), done, infos

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, which is the same for all."""
        return [getattr(self.env, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: the program has been compiled with the environment as it was."""
        raise NotImplementedError("make another environment in place of changing this one")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """What a method of the environment returns, once for each."""
        method = getattr(self.env, method_name)
        return [method(*method_args, **method_kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Sequence[bool]:
        """No environment is wrapped."""
        return [False for _ in self._get_indices(indices)]
