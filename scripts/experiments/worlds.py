"""Flat batches of worlds: one program, called chunk by chunk, on one or more devices."""

import itertools
from collections import deque
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax import rollout
from codesign_jax.batch import LIMIT
from codesign_jax.engines import Engine
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, Trial


class Chunking(NamedTuple):
    """How a batch is cut.

    Attributes:
      size: Worlds of one call.
      calls: Calls of a whole step.
    """

    size: int
    calls: int


def chunking(worlds: int, limit: int = LIMIT, devices: int = 1) -> Chunking:
    """Cuts a step's worlds into the fewest equal chunks under a limit, at least one a device.

    Equal chunks waste nothing: a short last one would be filled up with worlds nobody reads.  A
    chunk found for several devices is found for one as well if it is the limit.

    Args:
      worlds: Worlds of a step.
      limit: Largest number of worlds in one call.
      devices: Devices that the calls are dealt to.
    """
    calls = max(-(-worlds // limit), min(devices, worlds))
    return Chunking(-(-worlds // calls), calls)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _simulate(
    scene: Scene, engine: Engine, space: DesignSpace, designs: jax.Array, trials: Trial
) -> Outcome:
    params = jax.vmap(space.params)(designs)
    return rollout.simulate(scene, engine, params, trials)[0]


class Worlds:
    """Simulates worlds of one scene in chunks of one size.

    The engine sees one flat batch, never a vmap: on a GPU it is one kernel without a batching
    rule.  The same chunk gives the same bits, on however many devices; another one may round
    differently.
    """

    def __init__(
        self, scene: Scene, engine: Engine, space: DesignSpace, *, chunk: int, devices: int = 1
    ):
        """Compiles nothing yet.

        Args:
          scene: The scene.
          engine: Engine that simulates.
          space: Design space of the particles.
          chunk: Worlds of one call.
          devices: Devices that calls are dealt to in turn.

        Raises:
          ValueError: If there are fewer devices.
        """
        available = jax.devices()
        if not 1 <= devices <= len(available):
            raise ValueError(f"{devices=}; {len(available)} available")
        self.scene, self.space, self.chunk = scene, space, chunk
        self.devices = available[:devices] if devices > 1 else [None]
        self.grasps = 0
        # Each of several devices has its next call waiting while the host reads the last one's.
        self._ahead = 2 * devices if devices > 1 else 1
        # A program of its own on each device instead of one over all: its shapes, and with them
        # its bits, are those of a single device.
        self._simulate = partial(_simulate, scene, engine, space)

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
        total = int(np.prod(shape))
        starts = list(range(0, total, self.chunk))
        order = dealt(len(flat), shape[3], len(starts))
        if self.grasps == 0:  # every device compiles now, also those with nothing to do yet
            starts += starts[-1:] * (len(self.devices) - len(starts))
        parts, running = [], deque()
        for start, device in zip(starts, itertools.cycle(self.devices), strict=False):
            if len(running) == self._ahead:
                parts.append(jax.tree.map(np.asarray, running.popleft()))
            # Filled up with the last world, so that every call has the compiled size.
            world = order[np.minimum(np.arange(start, start + self.chunk), total - 1)]
            running.append(self._call(flat, trials, shape, world, device))
        parts += [jax.tree.map(np.asarray, part) for part in running]
        self.grasps += total

        def in_place(*values: np.ndarray) -> np.ndarray:
            joined = np.concatenate(values)[:total]
            sorted_ = np.empty_like(joined)
            sorted_[order] = joined
            return sorted_.reshape(shape)

        return jax.tree.map(in_place, *parts)

    def _call(self, flat, trials: Trial, shape: tuple[int, ...], world, device) -> Outcome:
        """Begins to simulate some worlds."""
        _, run, _, trial = np.unravel_index(world, shape)
        chosen = flat[world // shape[3]], jax.tree.map(lambda v: v[run, trial], trials)
        return self._simulate(*jax.device_put(chosen, device))


def dealt(particles: int, trials: int, calls: int) -> np.ndarray:
    """Order of the worlds, in which particles are dealt to the calls like cards.

    Some runs' hands touch and hold more than others', and take longer: so dealt, calls that run
    side by side on several devices take about the same time.

    Args:
      particles: Number of particles of all strategies and runs.
      trials: Trials of each; a particle's worlds stay together.
      calls: Number of calls.

    Returns:
      Numbers of the worlds, particle by particle, shape (particles * trials,).
    """
    order = np.concatenate([np.arange(call, particles, calls) for call in range(calls)])
    return (order[:, None] * trials + np.arange(trials)).ravel()
