"""evosax's CMA-ES, OpenAI-ES, particle swarm and random search as optimisers of a design space.

The strategies work on unit coordinates, 0 at a parameter's lower and 1 at its upper bound. They are
told the points that they asked for, while what is evaluated is their mirror image inside the bounds
with the constraint applied, so that they see a periodic landscape without walls (as in Hansen's
pycma, `BoundTransform`).

Sources: Hansen (2016), "The CMA evolution strategy: a tutorial", arXiv:1604.00772; Salimans et al.
(2017), "Evolution strategies as a scalable alternative to reinforcement learning",
arXiv:1703.03864; Kennedy and Eberhart (1995), "Particle swarm optimization"; Lange (2022),
"evosax", arXiv:2212.04180.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from codesign_jax.optimize.bounds import Space, reflect
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
STREAM_ASK = 0x61736B20
"""Stream of the strategy's draws in `ask` ("ask ")."""
STREAM_TELL = 0x74656C6C
"""Stream of its draws in `tell` ("tell")."""
STREAM_START = 0x73747274
"""Stream of a swarm's first positions ("strt")."""

LEAST = {"cma-es": 2, "open-es": 2, "pso": 1, "random": 1}
"""The strategies, and the fewest particles that each can rank."""
OPEN_SIGMA = 0.15
"""Standard deviation of OpenAI-ES as a fraction of the parameter range; docs/notes/search.md."""
GAIN = 2 / 3
"""Share of the way to the minimum of a bowl that the mean of OpenAI-ES goes in an episode."""
EVOSAX = tuple(LEAST)
"""Names of the optimisers that are evosax's."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Evolution:
    """A strategy of evosax behind `init`, `ask` and `tell`.

    The state's particles are the best ones so far, best first; among equal costs newer ones come
    first. Closed parameters have the values of the best one. When a schedule opens other parameters
    the strategy starts anew around the best one: what it had learnt is about other parameters, and
    the selection says nothing about closed ones.

    Attributes:
      keeps_best: True: the state's particles are the best so far; see `Optimizer.keeps_best`.
      space: Bounds and constraint of the parameters.
      name: "cma-es" and "open-es", from the seed particle; "pso", a swarm over the whole box that
        the seed particle attracts first; "random", uniform in the box.
      sigma: First standard deviation of CMA-ES, and that of OpenAI-ES, as a fraction of the
        parameter range; pycma's documentation advises a quarter of the domain.
    """

    keeps_best = True

    space: Space
    name: str = dataclasses.field(metadata={"static": True})
    sigma: float = dataclasses.field(default=0.25, metadata={"static": True})

    def __post_init__(self) -> None:
        if self.name not in LEAST or not self.sigma > 0:
            raise ValueError(f"need a name of {', '.join(LEAST)} and sigma > 0: {self}")

    def init(self, key: jax.Array, seed_particle: ArrayLike, num_particles: int) -> OptimizerState:
        seed = check_start(self.space, key, seed_particle, num_particles, MAX_PARTICLES)
        if num_particles < LEAST[self.name]:
            raise ValueError(f"{num_particles=}: {self.name} needs at least {LEAST[self.name]}")
        if self.name == "open-es" and num_particles % 2:
            raise ValueError(f"{num_particles=}: open-es draws pairs, and needs an even number")
        return _init(self, key, seed, num_particles)

    def ask(self, state: OptimizerState, mask: ArrayLike) -> jax.Array:
        # The space's constraint may change a closed parameter, as with the particle filter.
        low = jnp.asarray(self.space.low)
        high = jnp.asarray(self.space.high)
        unit, _ = self._asked(state, mask)
        proposal = reflect(low + unit * (high - low), low, high)
        kept = jnp.where(jnp.any(mask), state.particles[:1], state.particles)
        return self.space.constrain(jnp.where(mask, proposal, kept).astype(state.particles.dtype))

    def tell(
        self, state: OptimizerState, population: jax.Array, cost: ArrayLike, mask: ArrayLike = True
    ) -> tuple[OptimizerState, Info]:
        assert state.memory is not None
        cost = check_told(state, population, cost)
        ranked = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        # CMA-ES knows ranks only.  evosax gives equal costs a common weight below their share,
        # which shrinks steps on a plateau such as "every grasp is lost"; rows are a fair draw.
        values = jnp.argsort(jnp.argsort(ranked)) if self.name == "cma-es" else ranked
        strategy = self._strategy(state)
        unit, strategy_state = self._asked(state, mask)
        key = episode_key(state, STREAM_TELL)
        new, _ = strategy.algorithm.tell(
            key, unit, values.astype(unit.dtype), strategy_state, strategy.params
        )
        # Newer particles come first, so that they win among equal costs.
        costs = jnp.concatenate([ranked, state.memory["cost"]])
        best = jnp.argsort(costs)[: cost.shape[0]]
        memory = {
            "mask": jnp.broadcast_to(mask, state.memory["mask"].shape),
            "cost": costs[best],
            "strategy": arrays(new),
        }
        particles = jnp.concatenate([population, state.particles])[best]
        ancestors = jnp.where(best < cost.shape[0], best, -1).astype(jnp.int32)
        next_state = OptimizerState(particles, state.episode + 1, state.key, memory)
        return next_state, summarize(cost, jnp.ones_like(cost), ancestors)

    def _asked(self, state: OptimizerState, mask: ArrayLike) -> tuple[jax.Array, Any]:
        """Points of the strategy in unit coordinates, and the strategy's state with them."""
        assert state.memory is not None
        strategy = self._strategy(state)
        start = self.start(state)
        same = jnp.all(mask == state.memory["mask"])
        kept = jax.tree.map(
            lambda old, new: jnp.where(same, old, new), state.memory["strategy"], arrays(start)
        )
        key = episode_key(state, STREAM_ASK)
        return strategy.algorithm.ask(key, start.replace(**kept), strategy.params)

    def start(self, state: OptimizerState) -> Any:
        """The strategy's state as it starts around the best particle."""
        algorithm, params = self._strategy(state)
        low = jnp.asarray(self.space.low)
        high = jnp.asarray(self.space.high)
        best = (state.particles[0] - low) / jnp.where(high > low, high - low, 1)
        key = episode_key(state, STREAM_START)
        if self.name != "pso":
            return algorithm.init(key, best, params)
        swarm = jax.random.uniform(key, state.particles.shape, best.dtype).at[0].set(best)
        # Nothing of it is evaluated yet. Among equal fitness the first is the swarm's best.
        return algorithm.init(key, swarm, jnp.full(len(swarm), jnp.inf, best.dtype), params)

    def _strategy(self, state: OptimizerState) -> "Strategy":
        return build(self.name, *state.particles.shape, self.sigma, str(state.particles.dtype))


@functools.partial(quickly_compiled, static_argnums=3)  # one program, not one an operation
def _init(
    optimizer: Evolution, key: jax.Array, seed: jax.Array, num_particles: int
) -> OptimizerState:
    state = first_state(key, seed, num_particles)
    strategy = arrays(optimizer.start(state))
    return state._replace(memory=first_memory(state) | {"strategy": strategy})


class Strategy(NamedTuple):
    """A strategy of evosax: its functions and its numbers."""

    algorithm: Any
    params: Any


@functools.lru_cache(maxsize=32)
def build(name: str, particles: int, width: int, sigma: float, dtype: str) -> Strategy:
    """A strategy; one for each size, as JAX tells them apart by identity."""
    import optax
    from evosax.algorithms import CMA_ES, PSO, Open_ES, RandomSearch

    # Its numbers must not be tracers of the program that happens to ask for it first.
    with jax.ensure_compile_time_eval():
        point = jnp.zeros(width, dtype)
        if name == "random":
            uniform = functools.partial(jax.random.uniform, shape=(width,), dtype=dtype)
            algorithm = RandomSearch(particles, point, uniform)
        elif name == "open-es":
            std = jnp.asarray(sigma, dtype)
            descent = optax.sgd(learning_rate(sigma, width))
            algorithm = Open_ES(particles, point, optimizer=descent, std_schedule=lambda _: std)
        else:
            algorithm = (CMA_ES if name == "cma-es" else PSO)(particles, point)
        params = algorithm.default_params
        if name == "cma-es":
            params = params.replace(std_init=jnp.asarray(sigma, dtype))
        return Strategy(algorithm, params)


def learning_rate(sigma: float, width: int) -> float:
    """Step of OpenAI-ES along its gradient, `sqrt(2 pi width) GAIN sigma**2`.

    The strategy's gradient is the mean of `rank z / sigma` over draws `mean + sigma z`, with
    ranks from -1/2 to 1/2.  At the distance `d` from the minimum of a bowl, `d` far below
    `sigma`, costs are `2 d sigma z_1` beside `sigma**2 |z|**2`, whose standard deviation is
    `sigma**2 sqrt(2 width)`; a rank has the correlation `sqrt(2 / width) d / sigma` with the
    draw along `d`, and their mean product is that over `2 sqrt(pi)`.

    Args:
      sigma: Standard deviation of the draws.
      width: Number of parameters.
    """
    return float(np.sqrt(2 * np.pi * width) * GAIN * sigma**2)


def arrays(state: Any) -> dict[str, jax.Array]:
    """A strategy's state as arrays by name; their types do not depend on where they come from."""
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    # What has no arrays, such as the state of a plain gradient descent, never changes.
    fields = {n: jnp.asarray(value) for n, value in fields.items() if jax.tree.leaves(value)}
    return {name: jax.lax.convert_element_type(v, v.dtype) for name, v in fields.items()}
