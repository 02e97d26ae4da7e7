"""Particle filter optimisation behind `init`, `ask` and `tell`.

Source: Deimel, Irmisch, Wall, Brock (2017), section VI.1 and Fig. 5. One episode is

    population = filter.ask(state, mask)                    # step 1: move
    state, info = filter.tell(state, population, cost)      # steps 3 and 4: weight, resample

with the simulation, step 2, in between; see `protocol`. The draws of a particle depend neither on
the number of particles nor on the point of resumption.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from codesign_jax.optimize.bounds import Space, reflect
from codesign_jax.optimize.protocol import (
    Info,
    OptimizerState,
    check_start,
    check_told,
    episode_key,
    first_state,
    summarize,
)
from codesign_jax.optimize.resampling import MAX_PARTICLES, stochastic_universal
from codesign_jax.reuse import quickly_compiled

# Four ASCII letters each, so that they do not meet the small numbers others fold in.
STREAM_MOVE = 0x6D6F7665
"""Stream of the moves ("move")."""
STREAM_RESAMPLE = 0x72736D70
"""Stream of the resampling ("rsmp")."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class ParticleFilter:
    """Configuration of the particle filter optimisation.

    Can be closed over or passed through `jit`: the bounds are leaves, the rest is static.

    Attributes:
      keeps_best: False: resampling replaces all particles; see `Optimizer.keeps_best`.
      space: Bounds and constraint of the parameters.
      sigma: Standard deviation of a move as a fraction of the parameter range. The paper writes
        "variance sigma = 0.05 x parameter range"; only the reading as a standard deviation has
        the unit of the parameter.
      alpha: Cost offset of the weight; keeps one perfect episode from taking over all particles.
    """

    keeps_best = False

    space: Space
    sigma: float = dataclasses.field(default=0.05, metadata={"static": True})
    alpha: float = dataclasses.field(default=0.2, metadata={"static": True})

    def __post_init__(self) -> None:
        if not self.sigma >= 0 or not self.alpha > 0:
            raise ValueError(f"need sigma >= 0 and alpha > 0: {self.sigma=}, {self.alpha=}")

    def init(self, key: jax.Array, seed_particle: ArrayLike, num_particles: int) -> OptimizerState:
        """All particles at the seed particle."""
        seed_particle = check_start(self.space, key, seed_particle, num_particles, MAX_PARTICLES)
        return _init(key, seed_particle, num_particles)

    def ask(self, state: OptimizerState, mask: ArrayLike) -> jax.Array:
        """Move the particles: step 1 of Fig. 5.

        Open parameters move by N(0, (sigma * range)**2) and are reflected at the bounds; closed
        ones keep their value bitwise. Then the constraint of the space is applied, and
        feasibility wins: it may change a closed parameter, for example lower a closed pressure
        under a limit that sank with an open wall thickness. A particle that satisfies the
        constraint is not changed by it.
        """
        low = jnp.asarray(self.space.low)
        high = jnp.asarray(self.space.high)
        n, width = state.particles.shape
        key = episode_key(state, STREAM_MOVE)
        keys = jax.vmap(lambda particle: jax.random.fold_in(key, particle))(jnp.arange(n))
        noise = jax.vmap(lambda k: jax.random.normal(k, (width,), state.particles.dtype))(keys)
        proposal = reflect(state.particles + self.sigma * (high - low) * noise, low, high)
        return self.space.constrain(jnp.where(mask, proposal, state.particles))

    def tell(
        self, state: OptimizerState, population: jax.Array, cost: ArrayLike, mask: ArrayLike = True
    ) -> tuple[OptimizerState, Info]:
        """Weight and resample the population: steps 3 and 4 of Fig. 5.

        `weight = 1 / (alpha + cost)` (section VI.1), with alpha = 0.2 by default (the optimiser's
        `alpha`); then stochastic universal sampling with one uniform number. A cost that is not
        finite gets weight zero; where none is finite, every particle survives once. The weight
        needs costs of at least zero; lower ones count as zero.
        """
        cost = check_told(state, population, cost)
        finite = jnp.isfinite(cost)
        weight = finite / (self.alpha + jnp.where(finite, jnp.maximum(cost, 0), 0))
        u = jax.random.uniform(episode_key(state, STREAM_RESAMPLE))
        ancestors = stochastic_universal(u, weight)
        next_state = OptimizerState(population[ancestors], state.episode + 1, state.key)
        return next_state, summarize(cost, jnp.where(finite.any(), weight, 1), ancestors)


_init = quickly_compiled(first_state, static_argnums=2)
"""One program, not one an operation."""
