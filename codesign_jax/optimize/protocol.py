"""The interface of optimisers: `init`, `ask` and `tell`, a state and a report.

One episode of any of them is

    population = optimizer.ask(state, mask)
    state, info = optimizer.tell(state, population, cost, mask)

with the simulation in between. All three functions are pure and work under `jit`, `vmap` over
a leading run axis of state, mask and cost, and `lax.scan`.
"""

from typing import Any, NamedTuple, Protocol

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from codesign_jax.optimize.bounds import Space
from codesign_jax.types import random_key_problem


class OptimizerState(NamedTuple):
    """State of an optimiser between two episodes.

    Attributes:
      particles: What the run has found so far, which the final test takes: the particles after
        resampling of the particle filter, the best ones so far of other optimisers; shape
        (particle, parameter).
      episode: Number of finished episodes, int32, scalar.
      key: Root key. It never changes: draws fold in stream and episode, so they do not depend on
        the point of resumption.
      memory: What else the optimiser remembers, as nested dictionaries of arrays, so that it can
        be saved as it is; None if there is nothing.
    """

    particles: jax.Array
    episode: jax.Array
    key: jax.Array
    memory: dict[str, Any] | None = None


class Info(NamedTuple):
    """The optimiser's report of an episode.

    Attributes:
      cost: Costs as given, shape (particle,).
      weight: Normalised weights, shape (particle,); equal where no cost is finite, and for an
        optimiser that does not weigh.
      ancestors: Row of the population that each new particle of the state copies, -1 if it is
        from an earlier episode; int32, shape (particle,).
      best_index: Row of the population with the lowest finite cost, int32, scalar.
      best_cost: Lowest finite cost, inf if there is none, scalar.
      mean_cost: Mean of the finite costs, inf if there are none, scalar.
      effective_sample_size: `1 / sum(weight**2)`, between 1 and the number of particles.
    """

    cost: jax.Array
    weight: jax.Array
    ancestors: jax.Array
    best_index: jax.Array
    best_cost: jax.Array
    mean_cost: jax.Array
    effective_sample_size: jax.Array


class Optimizer(Protocol):
    """Interface of an optimiser, yours included, for `Task.episode` and `Task.run`.

    It is an argument of jitted programs and so has to be a pytree, such as a dataclass registered
    with `jax.tree_util.register_dataclass`: arrays as leaves, everything else static.
    """

    @property
    def space(self) -> Space:
        """Bounds and constraint of the parameters."""
        ...

    @property
    def keeps_best(self) -> bool:
        """Whether the state's particles are the best of all episodes, chosen by their costs.

        A class attribute is enough. The outcomes that chose such particles are better than the
        particles are, so the final test of a run (`runs.loop`) counts new trials only. Otherwise
        it also counts the outcomes of the last episode, as in the paper.
        """
        ...

    # An attribute `screens` that is True says that the optimiser finds its start by itself: a run
    # then simulates nothing before its first episode, and the seed particle is any random one.
    # An attribute `finalists` says how many of a run's final particles differ, if it went on long
    # enough: the final test then simulates so many, and not their copies.

    def init(self, key: jax.Array, seed_particle: ArrayLike, num_particles: int) -> OptimizerState:
        """The state before episode 0.

        Args:
          key: Typed key from `jax.random.key`; the root of all draws of this run.
          seed_particle: Parameters to start from, shape (parameter,).
          num_particles: Particles that every episode evaluates.

        Raises:
          TypeError: If `key` is not one typed key.
          ValueError: If the shape of the seed particle or the number of particles is wrong, or the
            seed particle lies far outside the box.
        """
        ...

    def ask(self, state: OptimizerState, mask: ArrayLike) -> jax.Array:
        """Particles to evaluate, shape (particle, parameter), inside the space.

        Args:
          state: Current state.
          mask: True where a parameter is open, bool, shape (parameter,). Closed parameters have
            values of the state's particles. Where all are closed, the result is these
            particles: that is how particles are tested by an episode's own program.
        """
        ...

    def tell(
        self, state: OptimizerState, population: jax.Array, cost: ArrayLike, mask: ArrayLike = True
    ) -> tuple[OptimizerState, Info]:
        """The state of the next episode and what happened in this one.

        Args:
          state: OptimizerState that `population` was asked from.
          population: Evaluated particles, shape (particle, parameter).
          cost: Mean cost over the trials of each particle, shape (particle,); lower is better,
            and what is not finite has failed.
          mask: Mask that `population` was asked with.
        """
        ...


def check_start(
    space: Space, key: jax.Array, seed_particle: ArrayLike, num_particles: int, most: int
) -> jax.Array:
    """Checks the arguments of `init`; returns the seed particle as an array of floats."""
    if problem := random_key_problem(key):
        raise TypeError(problem)
    if isinstance(seed_particle, jax.core.Tracer):
        particle = jnp.asarray(seed_particle, float)
    else:  # JAX would compile a program to convert it
        particle = jax.device_put(np.asarray(seed_particle, jnp.result_type(float)))
    if particle.shape != jnp.shape(space.low):
        raise ValueError(f"seed_particle.shape={particle.shape}, expected {jnp.shape(space.low)}")
    _refuse_far(space, particle)
    if not 1 <= num_particles <= most:
        raise ValueError(f"{num_particles=}, expected 1 to {most}")
    return particle


def first_state(key: jax.Array, seed_particle: jax.Array, num_particles: int) -> OptimizerState:
    """All particles at the seed particle."""
    particles = jnp.tile(seed_particle, (num_particles, 1))
    return OptimizerState(particles, jnp.zeros((), jnp.int32), key)


def first_memory(state: OptimizerState) -> dict[str, jax.Array]:
    """Memory of what was told to a new optimiser: every parameter is free, and no cost known."""
    particles = state.particles
    return {
        "mask": jnp.ones(particles.shape[1:], bool),
        "cost": jnp.full(len(particles), jnp.inf, particles.dtype),
    }


def _refuse_far(space: Space, particle: jax.Array) -> None:
    values = particle, space.low, space.high
    if any(isinstance(v, jax.core.Tracer) or np.ndim(v) != 1 for v in values):
        return
    x, low, high = (np.asarray(v) for v in values)
    for i in np.flatnonzero((x < low - 50 * (high - low)) | (x > high + 50 * (high - low))):
        raise ValueError(
            f"seed_particle[{i}] = {x[i]:g} is far outside its bounds, {low[i]:g} to {high[i]:g}: "
            "is it in another unit?"
        )


def check_told(state: OptimizerState, population: jax.Array, cost: ArrayLike) -> jax.Array:
    """Checks the arguments of `tell`; returns the costs as an array of the population's type."""
    cost = jnp.asarray(cost, population.dtype)
    if population.shape != state.particles.shape or cost.shape != population.shape[:1]:
        raise ValueError(
            f"{population.shape=}, {cost.shape=} do not match {state.particles.shape=}"
        )
    return cost


def episode_key(state: OptimizerState, stream: int) -> jax.Array:
    """Key of one stream of draws in the state's episode."""
    return jax.random.fold_in(jax.random.fold_in(state.key, stream), state.episode)


def summarize(cost: jax.Array, weight: jax.Array, ancestors: jax.Array) -> Info:
    """The report of an episode.

    Args:
      cost: Costs, shape (particle,).
      weight: Weights, not necessarily normalised, shape (particle,).
      ancestors: See `Info`.
    """
    finite = jnp.isfinite(cost)
    ranked = jnp.where(finite, cost, jnp.inf)
    best = jnp.argmin(ranked).astype(jnp.int32)
    mean = jnp.where(finite, cost, 0).sum() / jnp.maximum(finite.sum(), 1)
    weight = weight / weight.sum()
    return Info(
        cost=cost,
        weight=weight,
        ancestors=ancestors,
        best_index=best,
        best_cost=ranked[best],
        mean_cost=jnp.where(finite.any(), mean, jnp.inf),
        effective_sample_size=1 / (weight**2).sum(),
    )
