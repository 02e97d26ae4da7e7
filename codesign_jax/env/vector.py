"""Grasps as environments of Gymnasium, for its trainers; needs the extra `gymnasium`.

`VectorEnv` is a batch of grasps that one program simulates, `SingleEnv` one grasp, which trainers
of single environments take. `env.stable_baselines` has the batch of Stable-Baselines3.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from codesign_jax.env.grasp import GraspEnv, State
from codesign_jax.scene.schema import InputError


class VectorEnv(gymnasium.vector.VectorEnv):
    """Several grasps at once, which one program simulates; see `gymnasium.vector.VectorEnv`.

    A grasp that has ended begins anew, in another random trial, in the step after its last one.
    Each environment draws from its own seed: what the others do changes none of its trials.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, env: GraspEnv, num_envs: int, *, seed: int = 0):
        """Takes the environment, how many of it there are, and the seed of the first.

        Args:
          seed: Seed of the first environment until `reset` has one; the others count on from it.
        """
        self.env = env
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = spaces(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._keys = seed_keys([seed + i for i in range(num_envs)])
        self._state: State | None = None

        def step(keys: jax.Array, state: State, action: jax.Array) -> tuple[jax.Array, State]:
            keys, fresh = begin(env, keys)
            after = jax.vmap(env.step)(state, action)
            return keys, where_done(state, fresh, after)

        self._reset = jax.jit(partial(begin, env))
        self._step = jax.jit(step)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins all grasps anew; see Gymnasium.

        Args:
          seed: A seed for each environment, None of one that draws on; or that of the first, from
            which the others count on.

        Raises:
          InputError: If there is another number of seeds than of environments, or one is no
            whole number.
        """
        if seed is not None:
            self._seed(seed)
        self._keys, state = self._reset(self._keys)
        self._state = state
        return observed(state), metrics(state)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Observations, rewards, terminations, truncations (never) and metrics; see Gymnasium.

        Raises:
          InputError: If the actions have another shape than (environment, action).
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        shape = np.shape(actions)
        expected = self.action_space.shape
        if shape != expected:
            words = f"{self.num_envs} environments take actions of shape {expected}, not {shape}"
            raise InputError.of("size", words)
        self._keys, state = self._step(self._keys, self._state, jnp.asarray(actions))
        self._state = state
        reward = np.asarray(state.reward, np.float64)
        over = np.asarray(state.done) > 0
        return observed(state), reward, over, np.zeros(self.num_envs, bool), metrics(state)

    def _seed(self, seed: Any) -> None:
        count = self.num_envs
        single = isinstance(seed, int | np.integer)
        seeds = [int(seed) + i for i in range(count)] if single else list(seed)
        if len(seeds) != count:
            raise InputError.of("size", f"seed has {len(seeds)} entries for {count} environments")
        drawn = jnp.array([s is None for s in seeds])
        self._keys = jnp.where(drawn, self._keys, seed_keys([s or 0 for s in seeds]))


class SingleEnv(gymnasium.Env):
    """A single grasp as a `gymnasium.Env`."""

    metadata = {"render_modes": []}

    def __init__(self, env: GraspEnv):
        """Takes the environment."""
        self.env = env
        self.observation_space, self.action_space = spaces(env)
        self._state: State | None = None
        self._reset = jax.jit(env.reset)
        self._step = jax.jit(env.step)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins a grasp in a random trial; see Gymnasium."""
        super().reset(seed=seed)
        [key] = seed_keys([self.np_random.integers(2**32)])
        self._state = state = self._reset(key)
        return observed(state), metrics(state)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Observation, reward, termination, truncation (never) and metrics; see Gymnasium.

        Raises:
          InputError: If the action has another shape than (action,).
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state = state = self._step(self._state, jnp.asarray(action))
        return observed(state), float(state.reward), bool(state.done > 0), False, metrics(state)


def begin(env: GraspEnv, keys: jax.Array) -> tuple[jax.Array, State]:
    """The beginning of a grasp for each key, shape (environment,), and the keys of the next."""
    pairs = jax.vmap(jax.random.split)(keys)
    return pairs[:, 0], jax.vmap(env.reset)(pairs[:, 1])


def where_done(state: State, fresh: State, other: State) -> State:
    """Fresh grasps in the environments whose grasp has ended in `state`, and those of `other`."""

    def either(new: jax.Array, old: jax.Array) -> jax.Array:
        done = state.done.reshape(-1, *[1] * (new.ndim - 1)) > 0
        return jnp.where(done, new, old)

    return jax.tree.map(either, fresh, other)


def spaces(env: GraspEnv) -> tuple[Box, Box]:
    """Spaces of observations and actions, of float32 whatever precision JAX has."""
    observation = Box(-np.inf, np.inf, (env.observation_size,), np.float32)
    return observation, Box(-1.0, 1.0, (env.action_size,), np.float32)


def seed_keys(seeds: Sequence[Any]) -> jax.Array:
    """A key of each seed, any whole number; of 32 bits, so that x64 draws the same."""
    if bad := [s for s in seeds if isinstance(s, bool) or not isinstance(s, int | np.integer)]:
        raise InputError.of("type", f"a seed is a whole number, not {bad[0]!r:.60}")
    return jax.vmap(jax.random.key)(np.array([int(s) % 2**32 for s in seeds], np.uint32))


def observed(state: State) -> np.ndarray:
    """What the agents observe, shape (environment, observation)."""
    return np.asarray(state.obs, np.float32)


def metrics(state: State) -> dict[str, Any]:
    """Numbers to watch by name, shape (environment,)."""
    return {name: np.asarray(value) for name, value in state.metrics.items()}
