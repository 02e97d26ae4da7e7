"""Many designs in calls of one size: small enough for a device, and for progress to be seen."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.codesign import Task
from codesign_jax.types import Outcome

LIMIT = 16_384
"""Most worlds of one device in one call."""
WORLDS = {"cpu": 512}
"""Most worlds of a call of `evaluate` by platform: few enough to see progress, enough to fill the
cores."""


def size(designs: int, trials: int, *, most: int | None = None, devices: int = 1) -> int:
    """Designs of each of equal calls of so many devices: a short last one would be filled up."""
    worlds = devices * (most or WORLDS.get(jax.default_backend(), LIMIT))
    at_most = min(max(1, worlds // trials), designs)
    return -(-designs // -(-designs // at_most))


def evaluate(
    task: Task,
    key: jax.Array,
    designs: np.ndarray,
    size: int,
    advance: Callable[[int], Any] = lambda worlds: None,
) -> Outcome:
    """Outcomes of designs [SI units] in a task's trials, arrays of shape (design, trial).

    So many designs at a time, and `advance` is told the worlds of each call.
    """

    def run(rows: np.ndarray) -> Outcome:
        return task.evaluate(jnp.asarray(designs[rows], jnp.float32), key)

    parts = []
    for outcome in in_chunks(run, len(designs), size):
        parts.append(outcome)
        advance(outcome.cost.size)
    return jax.tree.map(lambda *v: np.concatenate(v), *parts)


def in_chunks(run: Callable[[np.ndarray], Any], count: int, size: int) -> Iterator[Any]:
    """What run(rows) returns of rows 0 to count, as NumPy arrays, in their order.

    Each call has `size` rows, so that there is one program: the last is filled up with its last
    row, and cut.
    """
    for start in range(0, count, size):
        rows = np.minimum(np.arange(start, start + size), count - 1)
        length = min(size, count - start)
        yield jax.tree.map(lambda v, n=length: np.asarray(v)[:n], run(rows))
