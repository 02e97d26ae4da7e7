"""The cost on a grid of two parameters, a few trials of every point in a step."""

import jax
import numpy as np

from codesign_jax import rollout
from codesign_jax.codesign import stream_key
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import failed
from scripts.experiments.plan import Landscape
from scripts.experiments.worlds import Worlds
from scripts.shared.record import Arrays, pack

STREAM_GRID = 0x67726964
"""Stream of the noise of the grid's trials ("grid")."""


def grid(space: DesignSpace, points: int) -> np.ndarray:
    """Returns the designs of a regular grid, shape (points, points, 2), first parameter first.

    Args:
      space: A design space of two parameters.
      points: Points along either parameter, bounds included.

    Raises:
      ValueError: If the space has another number of parameters.
    """
    if space.num_parameters != 2:
        raise ValueError(f"a landscape needs two parameters, got {space.names}")
    axes = [np.linspace(a, b, points) for a, b in zip(space.low, space.high, strict=True)]
    designs = np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)
    return np.asarray(jax.vmap(jax.vmap(space.project))(designs))


class Grid:
    """The landscape as steps; the interface of `Batch`.

    Attributes:
      steps: Steps of at most `plan.block` trials of every point.
    """

    def __init__(self, plan: Landscape, scene: Scene, worlds: Worlds, *, seed: int = 0):
        """Takes the experiment and what simulates it; see `Batch`."""
        self.plan, self.scene, self.worlds, self.steps = plan, scene, worlds, plan.steps
        self.designs = grid(worlds.space, plan.points)
        key = stream_key(jax.random.key(seed), STREAM_GRID)
        trials = jax.jit(lambda k: rollout.sample_trials(scene, k, plan.trials))(key)
        self.trials = jax.tree.map(np.asarray, trials)

    def start(self) -> Arrays:
        """Returns the record before the first step."""
        shape = (self.plan.points, self.plan.points, self.plan.trials)
        return {
            "step": np.int64(0),
            "designs": self.designs,
            "lost_step": np.zeros(shape, np.uint16),
            "status": np.zeros(shape, np.uint8),
            "trial_cost": np.zeros(shape, np.float32),
        }

    def step(self, record: Arrays) -> str:
        """Simulates the next trials of every point."""
        part = self._part(int(record["step"]))
        trials = jax.tree.map(lambda v: v[None, part], self.trials)
        flat = self.designs.reshape(1, 1, -1, self.designs.shape[-1])
        outcome = self.worlds.evaluate(flat, trials)
        shape = (self.plan.points, self.plan.points, -1)
        lost_step, status = pack(self.scene, outcome)
        record["lost_step"][..., part] = lost_step.reshape(shape)
        record["status"][..., part] = status.reshape(shape)
        record["trial_cost"][..., part] = outcome.cost.reshape(shape)
        record["step"] = record["step"] + 1
        return f"mean cost {outcome.cost.mean():.3f}  failed {failed(outcome.status).sum()}"

    def grasps(self, step: int) -> int:
        """Grasps of one step."""
        part = self._part(step)
        return self.plan.points**2 * (part.stop - part.start)

    def _part(self, step: int) -> slice:
        first = step * self.plan.block
        return slice(first, min(first + self.plan.block, self.plan.trials))
