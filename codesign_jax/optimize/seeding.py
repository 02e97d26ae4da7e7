"""Seed particles by rejection sampling."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from codesign_jax.optimize.bounds import Space
from codesign_jax.reuse import quickly_compiled

STREAM_SEED = 0x73656564
"""Stream of the candidates ("seed")."""


class NoSeed(RuntimeError):
    """Too few candidates were poor enough to start from."""


def candidates(key: jax.Array, space: Space, indices: ArrayLike) -> jax.Array:
    """Uniform particles of the box, projected; candidate j depends on `key` and j alone.

    Args:
      key: Typed key from `jax.random.key`.
      space: Bounds and constraint of the parameters.
      indices: Numbers of the candidates, int, shape (particle,).

    Returns:
      Particles, shape (particle, parameter).
    """
    numbers = indices if isinstance(indices, jax.Array) else np.asarray(indices)
    unit = _uniform(key, numbers, jnp.shape(space.low)[0])
    arrays = unit, space.low, space.high
    traced = any(isinstance(v, Tracer) for v in arrays)
    numpy: Any = jnp if traced else np  # NumPy's operations compile nothing
    unit, low, high = (numpy.asarray(v, unit.dtype) for v in arrays)
    return space.constrain(jax.device_put(numpy.clip(low + unit * (high - low), low, high)))


@functools.partial(quickly_compiled, static_argnums=2)
def _uniform(key: jax.Array, indices: Any, size: int) -> jax.Array:
    """Numbers between 0 and 1, shape (index, size)."""
    key = jax.random.fold_in(key, STREAM_SEED)

    def draw(index: jax.Array) -> jax.Array:
        return jax.random.uniform(jax.random.fold_in(key, index), (size,))

    return jax.vmap(draw)(indices)


def rejection(
    key: jax.Array,
    space: Space,
    num_seeds: int,
    cost: Callable[[jax.Array], ArrayLike],
    *,
    threshold: float = 2.0,
    batch: int = 64,
    max_batches: int = 100,
) -> tuple[jax.Array, jax.Array, int]:
    """Draws seed particles that are not solutions yet.

    Deimel et al. (2017), section VI.4: seeds are drawn with cost > 2.0 to avoid runs whose initial
    particles already contain a solution. Candidates are accepted in the order of their number, so
    the result is the same for every `batch` as far as costs are those of particles alone.

    Args:
      key: Typed key from `jax.random.key`.
      space: Bounds and constraint of the parameters.
      num_seeds: Number of seed particles to find.
      cost: From candidates, shape (particle, parameter), to their costs, shape (particle,). A cost
        that is not finite is never accepted.
      threshold: Cost above which a candidate is accepted.
      batch: Candidates of one call of `cost`.
      max_batches: Calls after which to give up.

    Returns:
      Seeds, shape (seed, parameter), their costs, shape (seed,), and the number of candidates
      drawn up to and with the last seed.

    Raises:
      ValueError: If a count is below 1 or the costs have another shape.
      NoSeed: If `max_batches` did not hold enough seeds.
    """
    if min(num_seeds, batch, max_batches) < 1:
        raise ValueError(f"counts must be at least 1: {num_seeds=}, {batch=}, {max_batches=}")
    drawn = []
    costs = np.empty(0)
    accepted = np.empty(0, int)
    for start in range(0, batch * max_batches, batch):
        drawn.append(candidates(key, space, np.arange(start, start + batch)))
        more = np.asarray(cost(drawn[-1]))
        if more.shape != (batch,):
            raise ValueError(f"costs have shape {more.shape} for {batch} particles")
        costs = np.concatenate([costs, more])
        accepted = np.flatnonzero(np.isfinite(costs) & (costs > threshold))[:num_seeds]
        if accepted.size == num_seeds:
            seeds = jnp.concatenate(drawn)[accepted]
            return seeds, jnp.asarray(costs[accepted], float), int(accepted[-1]) + 1
    raise NoSeed(
        f"accepted {accepted.size} of {num_seeds} seed particles (cost > {threshold}) from "
        f"{costs.size} candidates; the highest finite cost was "
        f"{np.max(costs, initial=-np.inf, where=np.isfinite(costs)):g}"
    )
