"""Flat batches of worlds: one compiled program, called chunk by chunk, on one or more devices."""

from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from codesign_jax import rollout
from codesign_jax.engines import Engine
from codesign_jax.parameters import DesignSpace
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Trial

LIMIT = 16_384
"""Default of the largest number of worlds in one call."""


class Chunking(NamedTuple):
    """How a batch is cut.

    Attributes:
      size: Worlds of one call.
      calls: Calls of a whole step.
    """

    size: int
    calls: int


def chunking(worlds: int, limit: int = LIMIT, devices: int = 1) -> Chunking:
    """Cuts a step's worlds into the fewest equal chunks under a limit.

    Equal chunks waste nothing: a short last one would be filled up with worlds nobody reads.

    Args:
      worlds: Worlds of a step.
      limit: Largest number of worlds in one call.
      devices: Devices that share a call; the size is a multiple of it.
    """
    calls = -(-worlds // max(limit - limit % devices, devices))
    each = -(-worlds // calls)
    return Chunking(-(-each // devices) * devices, calls)


class Worlds:
    """Simulates worlds of one scene in chunks of one size.

    The engine sees one flat batch, never a vmap: on a GPU it is one kernel without a batching
    rule.  The same chunk gives the same bits; another one may round differently.
    """

    def __init__(
        self, scene: Scene, engine: Engine, space: DesignSpace, *, chunk: int, devices: int = 1
    ):
        """Compiles nothing yet.

        Args:
          scene: The scene.
          engine: Engine that simulates.
          space: Design space of the particles.
          chunk: Worlds of one call, a multiple of `devices`.
          devices: Devices that share a call.

        Raises:
          ValueError: If the chunk cannot be shared equally or there are fewer devices.
        """
        available = jax.devices()
        if chunk % devices or devices > len(available):
            raise ValueError(f"{chunk=} worlds do not fit {devices=}; {len(available)} available")
        self.scene, self.space, self.chunk, self.devices = scene, space, chunk, devices
        self.grasps = 0

        def simulate(designs: jax.Array, trials: Trial) -> Outcome:
            params = jax.vmap(space.params)(designs)
            return rollout.simulate(scene, engine, params, trials)[0]

        if devices > 1:
            mesh, split = Mesh(np.array(available[:devices]), ("world",)), PartitionSpec("world")
            # The kernel says nothing about replication, so there is nothing to check.
            simulate = jax.shard_map(
                simulate, mesh=mesh, in_specs=split, out_specs=split, check_vma=False
            )
        self._simulate = jax.jit(simulate)

    def evaluate(self, designs: np.ndarray, trials: Trial) -> Outcome:
        """Simulates every particle of every run in all trials of that run.

        Args:
          designs: Designs [SI units], shape (strategy, run, particle, parameter).
          trials: Trials with leading axes (run, trial): shared by strategies and particles.

        Returns:
          Outcomes as NumPy arrays, shape (strategy, run, particle, trial).
        """
        strategies, runs, particles, _ = designs.shape
        shape = (strategies, runs, particles, np.shape(trials.yaw)[1])
        trials = jax.tree.map(np.asarray, trials)
        flat = np.asarray(designs).reshape(-1, designs.shape[-1])
        total, parts = int(np.prod(shape)), []
        for start in range(0, total, self.chunk):
            # Filled up with the last world, so that every call has the compiled size.
            world = np.minimum(np.arange(start, start + self.chunk), total - 1)
            _, run, particle, trial = np.unravel_index(world, shape)
            del particle
            part = self._simulate(
                flat[world // shape[3]], jax.tree.map(lambda v, r=run, t=trial: v[r, t], trials)
            )
            parts.append(jax.tree.map(np.asarray, part))
        self.grasps += total
        return jax.tree.map(lambda *v: np.concatenate(v)[:total].reshape(shape), *parts)
