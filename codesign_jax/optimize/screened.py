"""Random designs first, then an evolution strategy from the best, whose means are averaged.

Grasps are noisy: a design that loses none of three objects may lose one in ten.  So no single
particle is believed.  The mean of an evolution strategy moves where particles keep their objects on
the whole; the average of these means over the episodes, recent ones weighing more, has less noise
still, and no trial chose it.  Each average is simulated as particle 0 of the next episode, and the
final test takes the newest one and two earlier ones.

The strategy is OpenAI's.  Its draws come in mirrored pairs and designs of equal cost have equal
weight, so that its mean stays where it is while all particles keep all of their objects; that of
CMA-ES wanders then, as it follows whichever of them stand first.

Sources: Salimans et al. (2017), "Evolution strategies as a scalable alternative to reinforcement
learning", arXiv:1703.03864, by evosax; Shamir and Zhang (2013), "Stochastic gradient descent for
non-smooth optimization", arXiv:1212.1824, section 4 (polynomial-decay averaging).
docs/notes/search.md has what each part is worth.
"""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from codesign_jax.optimize.bounds import Space, reflect
from codesign_jax.optimize.evolution import OPEN_SIGMA, Strategy, arrays, build
from codesign_jax.optimize.protocol import (
    Info,
    OptimizerState,
    check_start,
    check_told,
    episode_key,
    first_memory,
    first_state,
    summarize,
)
from codesign_jax.optimize.resampling import MAX_PARTICLES
from codesign_jax.reuse import quickly_compiled

# Four ASCII letters each, as the particle filter's.
STREAM_SCREEN = 0x72616E64
"""Stream of the random designs ("rand")."""
STREAM_MOVE = 0x636D6173
"""Stream of the strategy's draws in `ask` ("cmas")."""
STREAM_TELL = 0x636D6174
"""Stream of its draws in `tell` ("cmat")."""
LEAST = 3
"""Fewest particles: the average, and two for the strategy to rank."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Screened:
    """An evolution strategy from the best of random designs; its answer is an average of means.

    The first episodes simulate random designs, uniform in the parameters that the schedule opens,
    and the next ones the best of these again, in other trials: a start in the wrong place costs
    more than they do.  Later ones simulate the average so far, as particle 0, and draws of the
    strategy.  Particles 1 and 2 of the state are the averages after a third and two thirds of
    these, at most as many ago as there are particles: a guard against a mean that has left a good
    place.  All others are the newest average, and the final test takes these first three alone: so
    few are compared in many trials.  When a schedule opens other parameters, strategy and average
    start anew at particle 0.

    Attributes:
      keeps_best: True: the final test counts new trials only; see `Optimizer.keeps_best`.
      screens: True: it looks for its start by itself, so that a run needs no poor seed particle.
      finalists: Averages that the final test takes.
      space: Bounds and constraint of the parameters.
      screening: Episodes of random designs; without any it starts at the seed particle.
      retests: Episodes that simulate the best of them again.
      sigma: Standard deviation of the strategy's draws as a fraction of the parameter range.
      recency: After `t` episodes of the strategy its mean has weight `recency / (t + recency
        - 1)` in the average: 1 is the plain average, more forgets the first means sooner.
    """

    keeps_best = True
    screens = True
    finalists = 3

    space: Space
    screening: int = dataclasses.field(default=3, metadata={"static": True})
    retests: int = dataclasses.field(default=2, metadata={"static": True})
    sigma: float = dataclasses.field(default=OPEN_SIGMA, metadata={"static": True})
    recency: float = dataclasses.field(default=4.0, metadata={"static": True})

    def __post_init__(self) -> None:
        if not (min(self.screening, self.retests) >= 0 < self.sigma and self.recency >= 1):
            raise ValueError(f"need recency >= 1, screening and retests >= 0, sigma > 0: {self}")

    @property
    def begins(self) -> int:
        """Episode in which the strategy begins; before it all particles are random designs."""
        return self.screening + self.retests

    def init(self, key: jax.Array, seed_particle: ArrayLike, num_particles: int) -> OptimizerState:
        # The seed particle gives the parameters that a schedule closes from the start.
        seed = check_start(self.space, key, seed_particle, num_particles, MAX_PARTICLES)
        if num_particles < LEAST:
            raise ValueError(f"{num_particles=}: a screened search needs at least {LEAST}")
        return _init(self, key, seed, num_particles)

    def ask(self, state: OptimizerState, mask: ArrayLike) -> jax.Array:
        # The space's constraint may change a closed parameter, as with the particle filter.
        key = episode_key(state, STREAM_SCREEN)
        shape = state.particles.shape
        drawn = jax.random.uniform(key, shape, state.particles.dtype)
        unit = jnp.where(self._screens(state), drawn, self._asked(state, mask)[0])
        kept = jnp.where(jnp.any(mask), state.particles[:1], state.particles)
        population = jnp.where(mask, self._design(unit), kept).astype(state.particles.dtype)
        again = (state.episode >= self.screening) & self._screens(state)
        return self.space.constrain(jnp.where(again, state.particles, population))

    def tell(
        self, state: OptimizerState, population: jax.Array, cost: ArrayLike, mask: ArrayLike = True
    ) -> tuple[OptimizerState, Info]:
        assert state.memory is not None
        cost = check_told(state, population, cost)
        ranked = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        screens = self._screens(state)
        # Screening keeps the best so far, best first; newer ones win among equal costs.  Simulated
        # again, a design has the mean of its costs, and what it was before does not count.
        tests = jnp.maximum(state.episode - self.screening + 1, 0)
        known = state.memory["cost"]
        ranked = jnp.where((tests > 0) & screens, known + (ranked - known) / (tests + 1), ranked)
        costs = jnp.concatenate([ranked, jnp.where(tests > 0, jnp.inf, known)])
        best = jnp.argsort(costs)[: len(cost)]
        screened = jnp.concatenate([population, state.particles])[best]
        unit, strategy_state, memory = self._asked(state, mask)
        algorithm, params = self._strategy(state)
        points = slice(1, 1 + algorithm.population_size)
        fitness = ranked[points].astype(unit.dtype)
        key = episode_key(state, STREAM_TELL)
        new, _ = algorithm.tell(key, unit[points], fitness, strategy_state, params)
        weight = self.recency / (memory["averaged"] + self.recency)
        average = memory["average"] + weight * (new.mean - memory["average"])
        averaged = memory["averaged"] + 1
        now = {"average": average, "averaged": averaged, "strategy": arrays(new)}
        # The averages that were simulated, newest first, and which of them the final test takes.
        way = jnp.concatenate([population[:1], state.memory["way"][:-1]])
        rows = jnp.arange(len(cost))
        third = averaged // 3
        ago = jnp.where(rows < self.finalists, jnp.array([0, 2, 1])[rows % 3] * third, 0)
        finalists = way[jnp.minimum(ago, len(cost) - 1)]
        following = jax.tree.map(partial(jnp.where, screens), memory, now) | {
            "way": jnp.where(screens, state.memory["way"], way),
            "mask": jnp.broadcast_to(mask, state.memory["mask"].shape),
            "cost": jnp.where(screens, costs[best], state.memory["cost"]),
        }
        copied = jnp.where(
            screens, jnp.where(best < len(cost), best, -1), jnp.where(ago > 0, -1, 0)
        )
        particles = jnp.where(screens, screened, finalists)
        next_state = OptimizerState(particles, state.episode + 1, state.key, following)
        return next_state, summarize(cost, jnp.ones_like(cost), copied.astype(jnp.int32))

    def _screens(self, state: OptimizerState) -> jax.Array:
        """Whether the episode is one of random designs, drawn or simulated again."""
        return state.episode < self.begins

    def _asked(
        self, state: OptimizerState, mask: ArrayLike
    ) -> tuple[jax.Array, Any, dict[str, Any]]:
        """The average and the strategy's points, its state with them, and what was remembered."""
        assert state.memory is not None
        begun = jnp.all(mask == state.memory["mask"]) & (state.episode > self.begins)
        first = self.start(state)
        memory = jax.tree.map(
            partial(jnp.where, begun), {name: state.memory[name] for name in first}, first
        )
        algorithm, params = self._strategy(state)
        strategy = algorithm.init(state.key, memory["average"], params).replace(
            **memory["strategy"]
        )
        points, strategy = algorithm.ask(episode_key(state, STREAM_MOVE), strategy, params)
        rest = jnp.tile(strategy.mean, (len(state.particles) - 1 - len(points), 1))
        return jnp.concatenate([memory["average"][None], points, rest]), strategy, memory

    def start(self, state: OptimizerState) -> dict[str, Any]:
        """Average and strategy as they start, at particle 0."""
        algorithm, params = self._strategy(state)
        low = jnp.asarray(self.space.low)
        high = jnp.asarray(self.space.high)
        unit = (state.particles[0] - low) / jnp.where(high > low, high - low, 1)
        strategy = arrays(algorithm.init(state.key, unit, params))
        return {"average": unit, "averaged": jnp.zeros((), jnp.int32), "strategy": strategy}

    def _design(self, unit: jax.Array) -> jax.Array:
        """Designs at unit coordinates, mirrored at the bounds."""
        low = jnp.asarray(self.space.low)
        high = jnp.asarray(self.space.high)
        return reflect(low + unit * (high - low), low, high)

    def _strategy(self, state: OptimizerState) -> Strategy:
        n, width = state.particles.shape
        dtype = str(state.particles.dtype)
        # Its draws come in pairs; the last one of an even number of particles is its mean.
        return build("open-es", 2 * ((n - 1) // 2), width, self.sigma, dtype)


@partial(quickly_compiled, static_argnums=3)  # one program, not one an operation
def _init(
    optimizer: Screened, key: jax.Array, seed: jax.Array, num_particles: int
) -> OptimizerState:
    state = first_state(key, seed, num_particles)
    memory = first_memory(state) | {"way": state.particles} | optimizer.start(state)
    return state._replace(memory=memory)
