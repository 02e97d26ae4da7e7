"""Random designs, the best of which are simulated again in every other episode.

For few parameters: random designs come close to the best there, so that finding them is easy and
telling them apart is not.  Grasps are noisy, and a design that loses none of three objects may lose
one in ten.  Simulated again, it has the mean of all its costs.  docs/notes/search.md compares this
with an evolution strategy in two dimensions.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from codesign_jax.optimize.bounds import Space
from codesign_jax.optimize.protocol import (
    Info,
    OptimizerState,
    check_start,
    check_told,
    episode_key,
    summarize,
)
from codesign_jax.optimize.resampling import MAX_PARTICLES

STREAM_DRAW = 0x72616E64
"""Stream of the random designs ("rand")."""
PRIOR = 1.0
"""Cost of an episode that each design is ranked as if it had met besides: without it one lucky
episode would stand before many good ones."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Retested:
    """Random designs in even episodes, and the best so far again in odd ones.

    The state's first `finalists` particles are the best so far, best first; the others are copies
    of the first.  Closed parameters have the values of the best design.

    Attributes:
      keeps_best: True: the final test counts new trials only; see `Optimizer.keeps_best`.
      screens: True: a run needs no poor seed particle.
      finalists: Particles that the final test takes.
      space: Bounds and constraint of the parameters.
    """

    keeps_best = True
    screens = True
    finalists = 3

    space: Space

    def init(self, key: jax.Array, seed_particle: ArrayLike, num_particles: int) -> OptimizerState:
        # The seed particle gives the parameters that a schedule closes from the start.
        seed = check_start(self.space, key, seed_particle, num_particles, MAX_PARTICLES)
        particles = jnp.tile(seed, (num_particles, 1))
        memory = {
            "designs": particles,
            "cost": jnp.full(num_particles, jnp.inf, seed.dtype),  # mean over its episodes
            "episodes": jnp.ones(num_particles, jnp.int32),
        }
        return OptimizerState(particles, jnp.zeros((), jnp.int32), key, memory)

    def ask(self, state: OptimizerState, mask: ArrayLike) -> jax.Array:
        assert state.memory is not None
        low = jnp.asarray(self.space.low)
        high = jnp.asarray(self.space.high)
        shape = state.particles.shape
        dtype = state.particles.dtype
        unit = jax.random.uniform(episode_key(state, STREAM_DRAW), shape, dtype)
        drawn = jnp.where(mask, low + unit * (high - low), state.particles[:1]).astype(dtype)
        proposal = jnp.where(self._again(state), state.memory["designs"], drawn)
        return self.space.constrain(jnp.where(jnp.any(mask), proposal, state.particles))

    def tell(
        self, state: OptimizerState, population: jax.Array, cost: ArrayLike, mask: ArrayLike = True
    ) -> tuple[OptimizerState, Info]:
        assert state.memory is not None
        cost = check_told(state, population, cost)
        again = self._again(state)
        known = state.memory["cost"]
        count = state.memory["episodes"]
        costs_now = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        costs_now = jnp.where(again, known + (costs_now - known) / (count + 1), costs_now)
        costs = jnp.concatenate([costs_now, jnp.where(again, jnp.inf, known)])
        counts = jnp.concatenate([jnp.where(again, count + 1, 1), count])
        # Newer designs come first among equal ones; what failed once is out.
        order = jnp.argsort(costs + (PRIOR - costs) / (counts + 1))[: len(cost)]
        memory = {
            "designs": jnp.concatenate([population, state.memory["designs"]])[order],
            "cost": costs[order],
            "episodes": counts[order],
        }
        rows = jnp.arange(len(cost))
        best = jnp.where(rows < self.finalists, rows, 0)
        copied = jnp.where(order < len(cost), order, -1)[best].astype(jnp.int32)
        new = OptimizerState(memory["designs"][best], state.episode + 1, state.key, memory)
        return new, summarize(cost, jnp.ones_like(cost), copied)

    def _again(self, state: OptimizerState) -> jax.Array:
        """Whether the episode simulates the best designs again."""
        return state.episode % 2 == 1
