"""A wave: coarse landscapes of many sets of constants, all in one compiled program."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.batch import LIMIT
from codesign_jax.codesign import stream_key
from codesign_jax.engines import Engine
from codesign_jax.scene import Constants, Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, failed
from scripts.calibration import sets
from scripts.experiments.landscape import STREAM_GRID, grid
from scripts.shared import record as records
from scripts.shared.record import Arrays


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
    """Landscapes of sets, some sets a step; `shared.driver.drive` runs and resumes it.

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
          SceneError: If the sets do not fit the scene.
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

    def start(self) -> Arrays:
        """Returns the record before the first step."""
        shape = (len(self.units), self.size.points, self.size.points, self.size.trials)
        return {
            "step": np.int64(0),
            "units": np.asarray(self.units),
            "lost_step": np.zeros(shape, np.uint16),
            "status": np.zeros(shape, np.uint8),
        }

    def step(self, record: Arrays) -> str:
        """Simulates the landscapes of the next sets."""
        first = int(record["step"]) * self.size.sets
        # Filled up with the last set, so that every call has the compiled size.
        index = np.minimum(np.arange(first, first + self.size.sets), len(self.units) - 1)
        part: Constants = jax.tree.map(
            lambda v: jnp.asarray(v[index] if np.ndim(v) else v, jnp.float32), self.numbers
        )
        root = jax.random.key(self.seed)
        keys = jax.vmap(lambda i: stream_key(root, STREAM_GRID, i))(jnp.asarray(index))
        outcome = jax.tree.map(np.asarray, self._simulate(part, keys))
        lost, status = records.pack(self.scene, outcome)
        count = min(self.size.sets, len(self.units) - first)
        shape = (self.size.sets, *record["lost_step"].shape[1:])
        record["lost_step"][first : first + count] = lost.reshape(shape)[:count]
        record["status"][first : first + count] = status.reshape(shape)[:count]
        record["step"] = record["step"] + 1
        kept = (outcome.cost == 0).mean()
        return f"kept {100 * kept:.0f} %  failed {failed(outcome.status).sum()}"

    def grasps(self, step: int) -> int:
        """Grasps of one step."""
        return min(self.size.sets, len(self.units) - step * self.size.sets) * self.size.worlds

    def done(self, record: Arrays) -> int:
        """Number of sets whose landscapes are known."""
        return min(int(record["step"]) * self.size.sets, len(self.units))


def keep(wave: Wave, record: Arrays) -> Arrays:
    """What is kept of a wave, also of one that was cut short: the sets that are done.

    Returns:
      `units`, `lost_step` and `status` of the record, `first_axis` and `second_axis` in the
      parameters' units, the cost's `window` and the `timestep` [s].
    """
    done, space = wave.done(record), wave.space
    designs = space.in_units(wave.designs)
    return {
        "units": record["units"][:done],
        "lost_step": record["lost_step"][:done],
        "status": record["status"][:done],
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
    lost = np.where(kept["lost_step"] == records.KEPT, end, kept["lost_step"] * kept["timestep"])
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
