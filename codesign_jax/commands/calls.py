"""Many designs in the same trials, some at a time, so that progress can be seen."""

import itertools
from collections import deque
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import batch
from codesign_jax.codesign import Task
from codesign_jax.runs.progress import Meter
from codesign_jax.types import Outcome

WORLDS = {"cpu": 512}
"""Most worlds of one call by platform: few enough to see progress, enough to fill the cores."""


def size(designs: int, trials: int, *, most: int | None = None, devices: int = 1) -> int:
    """Designs of each of equal calls for so many devices: a short last one would be filled up."""
    worlds = most or WORLDS.get(jax.default_backend(), batch.LIMIT)
    at_most = min(max(1, worlds // trials), -(-designs // devices))
    return -(-designs // -(-designs // at_most))


def simulate(
    task: Task,
    key: jax.Array,
    designs: np.ndarray,
    size: int,
    meter: Meter,
    *,
    devices: int | None = 1,
) -> Outcome:
    """Outcomes of designs [SI units] in a task's trials, arrays of shape (design, trial)."""
    found = []
    for outcome in _in_turn(task, key, designs, size, devices):
        found.append(outcome)
        meter.advance(outcome.cost.size)
    return jax.tree.map(lambda *v: np.concatenate(v), *found)


def _in_turn(
    task: Task, key: jax.Array, designs: np.ndarray, size: int, devices: int | None
) -> Iterator[Outcome]:
    """Outcomes of so many designs at a time, in their order, from all devices."""
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
