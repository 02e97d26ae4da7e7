"""Many designs in the same trials, some at a time: progress, and a file from which to go on."""

import itertools
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import batch, codesign
from codesign_jax.codesign import Task
from codesign_jax.engines import Engine
from codesign_jax.runs import scene_files
from codesign_jax.runs.progress import Meter
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.store import Store
from codesign_jax.types import Outcome

WORLDS = {"cpu": 512}
"""Most worlds of one call by platform: few enough to see progress, enough to fill the cores."""


class Trials(NamedTuple):
    """What every design meets.

    Attributes:
      scene: The scene.
      engine: Name of the engine that simulates, and of a policy.
      space: Design space of the designs.
      count: Trials of each design.
      seed: Root of the trials' noise.
      stream: What `codesign.stream_key` folds into the root; none for the root itself.
    """

    scene: Scene
    engine: str
    space: DesignSpace
    count: int
    seed: int
    stream: tuple[int, ...] = ()

    @property
    def key(self) -> jax.Array:
        """Key of the trials' noise."""
        root = jax.random.key(self.seed)
        return codesign.stream_key(root, *self.stream) if self.stream else root


def most_designs(trials: Trials) -> int:
    """Designs that one call simulates at most."""
    return max(1, WORLDS.get(jax.default_backend(), batch.LIMIT) // trials.count)


def equal(designs: int, most: int) -> int:
    """Designs of each of equal calls: a short last one would be filled up."""
    return -(-designs // -(-designs // most))


def in_turn(
    task: Task, key: jax.Array, designs: np.ndarray, size: int, *, devices: int | None = 1
) -> Iterator[Outcome]:
    """Outcomes of designs, some at a time in their order, of shape (design, trial)."""
    places, running = batch.take(devices), deque()

    def arrived() -> Outcome:
        count, found = running.popleft()
        return jax.tree.map(lambda v: np.asarray(v)[:count], found)

    for start, place in zip(range(0, len(designs), size), itertools.cycle(places), strict=False):
        if len(running) == len(places):
            yield arrived()
        part = designs[start : start + size]
        rows = np.minimum(np.arange(size), len(part) - 1)
        given = jax.device_put((jnp.asarray(part[rows], jnp.float32), key), place)
        running.append((len(part), task.evaluate(*given)))
    while running:
        yield arrived()


class Calls:
    """Simulates designs in calls of one size, and keeps the outcomes in a file.

    Asked for the same designs in the same order, another process finds there what was simulated:
    so the same command goes on.

    Attributes:
      found: Designs whose outcomes were there.
      refused: Why outcomes that were there are not taken, in words of which the file is the
        subject; empty if they are.
    """

    def __init__(
        self,
        trials: Trials,
        engine: Engine,
        size: int,
        part: Path,
        designs: np.ndarray,
        *,
        devices: int | None = 1,
    ):
        """Compiles nothing yet.

        Args:
          trials: What every design meets.
          engine: The engine of that name.
          size: Most designs of a call.
          part: The file; the caller deletes it at the end.
          designs: All designs that may be asked for, shape (design, parameter), which with `trials`
            and `size` determine the outcomes: calls of another size round differently.
          devices: Devices that calls are dealt to; None for all.
        """
        numbers = trials.count, trials.seed, size, *trials.stream
        about = scene_files.digest(trials.scene, trials.engine, designs, *numbers)
        self._trials, self._size, self._part = trials, size, Store(part, about)
        self.refused = self._part.refused
        kept = [Outcome(**arrays) for arrays in self._part]  # a part has no fields that are None
        self._kept = joined(kept) if kept else None
        self.found = sum(len(outcome.cost) for outcome in kept)
        self._next, self._simulated = 0, False
        self._task = Task(trials.scene, trials.space, trials.count, engine)
        self._devices = devices

    def __call__(self, designs: np.ndarray, meter: Meter) -> Outcome:
        """Outcomes of designs [SI units], arrays of shape (design, trial)."""
        first, self._next, count = self._next, self._next + len(designs), self._trials.count
        done, parts = min(max(self.found - first, 0), len(designs)), []
        if done:
            meter.found(done * count)
            parts.append(jax.tree.map(lambda v: v[first : first + done], self._kept))
        left = self._trials.key, designs[done:], self._size
        for outcome in in_turn(self._task, *left, devices=self._devices):
            self._part.append(outcome._asdict())
            parts.append(outcome)
            meter.advance(outcome.cost.size)
            if not self._simulated:
                meter.compiled()
            self._simulated = True
        return joined(parts)


def joined(parts: list[Outcome]) -> Outcome:
    """Outcomes of several calls, one after the other."""
    return jax.tree.map(lambda *v: np.concatenate(v), *parts)
