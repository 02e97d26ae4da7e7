"""A wave: coarse landscapes of many sets of constants, all in one compiled program."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.archives import Store
from codesign_jax.batch import LIMIT
from codesign_jax.codesign import stream_key
from codesign_jax.engines import Engine
from codesign_jax.scene import Constants, Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, failed
from scripts.experiments.landscape import STREAM_GRID, grid
from scripts.experiments.strategies import Arrays
from scripts.shared import sets

KEPT = np.iinfo(np.uint16).max
"""`lost_step` of a trial in which the object was not lost."""


@dataclasses.dataclass(frozen=True)
class Size:
    """Sizes of a wave.

    Attributes:
      points: Grid points along either parameter of the landscape, bounds included.
      trials: Trials of each point, every object equally often.
      chunk: Most worlds of a call; a call simulates whole sets, one at the least.
    """

    points: int = 12
    trials: int = 6
    chunk: int = LIMIT

    @property
    def worlds(self) -> int:
        """Grasps of one set."""
        return self.points**2 * self.trials

    @property
    def sets(self) -> int:
        """Sets of a call."""
        return max(1, self.chunk // self.worlds)


class Wave:
    """Landscapes of sets, some sets a step.

    Set i meets trials of the key (seed, number of the set); all designs of a set meet the same ones
    and a set's result does not depend on the others.

    Attributes:
      steps: Calls of the program.
    """

    def __init__(
        self,
        scene: Scene,
        engine: Engine,
        space: DesignSpace,
        units: np.ndarray,
        size: Size,
        *,
        seed: int = 0,
    ):
        """Compiles nothing yet.

        Args:
          scene: The scene, whose fingers have base points of their own.
          engine: Engine that simulates.
          space: Design space of two parameters.
          units: Sets in the unit cube, shape (set, constant).
          size: Sizes.
          seed: Seed of the trials.

        Raises:
          InputError: If the sets do not fit the scene.
          ValueError: If the trials are no multiple of the objects, or there is no set.
        """
        shapes = len(scene.objects.object)
        if size.trials % shapes or not len(units):
            raise ValueError(
                f"{size.trials} trials: must be a multiple of {shapes}; {len(units)} sets"
            )
        self.scene, self.space, self.size = scene, space, size
        self.units, self.seed = units, seed
        self.numbers = sets.numbers(scene, sets.values(units))
        self.designs = grid(space, size.points)
        self.steps = -(-len(units) // size.sets)
        flat = self.designs.reshape(-1, self.designs.shape[-1])

        def simulate(constants: Constants, keys: jax.Array) -> Outcome:
            draw = jax.vmap(
                lambda k: rollout.sample_trials(scene, k, size.trials)  # noise is no open constant
            )
            count = keys.shape[0]
            params = jax.tree.map(_tile(count, size.trials), jax.vmap(space.params)(flat))
            trials = jax.tree.map(_repeat_designs(len(flat)), draw(keys))
            worlds = jax.tree.map(
                lambda v: jnp.repeat(v, size.worlds) if jnp.ndim(v) else v, constants
            )
            return rollout.simulate(scene, engine, params, trials, constants=worlds)[0]

        self._simulate = jax.jit(simulate)

    def step(self, number: int) -> Arrays:
        """Simulates the landscapes of some sets.

        Args:
          number: Which of the steps.

        Returns:
          `lost_step` and `status`, shape (set, point, point, trial).
        """
        first = number * self.size.sets
        # Filled up with the last set, so that every call has the compiled size.
        index = np.minimum(np.arange(first, first + self.size.sets), len(self.units) - 1)
        part: Constants = jax.tree.map(
            lambda v: jnp.asarray(v[index] if np.ndim(v) else v, jnp.float32), self.numbers
        )
        root = jax.random.key(self.seed)
        keys = jax.vmap(lambda i: stream_key(root, STREAM_GRID, i))(jnp.asarray(index))
        outcome = jax.tree.map(np.asarray, self._simulate(part, keys))
        count = min(self.size.sets, len(self.units) - first)
        shape = (self.size.sets, self.size.points, self.size.points, self.size.trials)
        return {
            "lost_step": _lost_step(self.scene, outcome).reshape(shape)[:count],
            "status": outcome.status.astype(np.uint8).reshape(shape)[:count],
        }

    def run(self, store: Store, say: Callable[[str], None]) -> int:
        """Simulates the steps that are left; returns the grasps of this process.

        Args:
          store: What is done; each step is a part of it.
          say: Told one line a step.

        Raises:
          KeyboardInterrupt: If Ctrl-C came; what is done is stored.
        """
        begin, grasps, done = time.perf_counter(), 0, len(store.found)
        for number in range(done, self.steps):
            part = self.step(number)
            store.append(part)
            store.found.append(part)
            grasps += part["status"].size
            kept = (part["lost_step"] == KEPT).mean()
            rate = grasps / (time.perf_counter() - begin)
            say(
                f"{number + 1:>3}/{self.steps}  {rate:,.0f} grasps/s  kept {100 * kept:.0f} %  "
                f"failed {failed(part['status']).sum()}"
            )
        return grasps


def _lost_step(scene: Scene, outcome: Outcome) -> np.ndarray:
    """Step in which each trial lost its object, uint16; `KEPT` if it did not."""
    lost = np.asarray(outcome.lost_time, np.float64) / scene.discretization.timestep
    return np.where(np.isfinite(lost), np.round(np.nan_to_num(lost)), KEPT).astype(np.uint16)


def keep(wave: Wave, parts: Sequence[Arrays]) -> Arrays:
    """What is kept of a wave, also of one that was cut short: the sets that are done.

    Args:
      wave: The wave.
      parts: What its steps returned, one at the least.

    Returns:
      `units`, `lost_step` and `status`, `first_axis` and `second_axis` in the parameters' units,
      the cost's `window` and the `timestep` [s].
    """
    lost, status = (np.concatenate([part[n] for part in parts]) for n in ("lost_step", "status"))
    designs = wave.space.in_units(wave.designs)
    return {
        "units": np.asarray(wave.units)[: len(status)],
        "lost_step": lost,
        "status": status,
        "first_axis": designs[:, 0, 0],
        "second_axis": designs[0, :, 1],
        "window": np.array(wave.scene.window),
        "timestep": np.array(wave.scene.discretization.timestep),
    }


def trial_costs(kept: Arrays) -> np.ndarray:
    """Costs of every trial, shape (set, point, point, trial); NaN where it failed.

    Args:
      kept: What `keep` returns.
    """
    start, end = kept["window"]
    maximum = sets.values(kept["units"])["cost_maximum"]
    lost = np.where(kept["lost_step"] == KEPT, end, kept["lost_step"] * kept["timestep"])
    cost = maximum[:, None, None, None] * (end - lost) / (end - start)
    return np.where(failed(kept["status"]), np.nan, cost)


def _tile(sets: int, trials: int):
    """Designs in the order (set, design, trial)."""

    def order(v: Any) -> jax.Array:
        return jnp.tile(jnp.repeat(v, trials, axis=0), (sets,) + (1,) * (v.ndim - 1))

    return order


def _repeat_designs(designs: int):
    """Trials of shape (set, trial, ...) in the order (set, design, trial)."""

    def order(v: Any) -> jax.Array:
        every = jnp.broadcast_to(v[:, None], (v.shape[0], designs, *v.shape[1:]))
        return every.reshape(-1, *v.shape[2:])

    return order
