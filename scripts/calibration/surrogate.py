"""The 2D experiment on a landscape that was simulated before, in place of new grasps.

A trial of a design is one of the landscape's trials, drawn with the object whose turn it is, its
cost interpolated linearly between the grid's points.  Their mean is the interpolated mean cost, and
their spread that of the simulation.  Everything else is the package's own: seed candidates,
particle filter, schedules.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from codesign_jax.codesign import CONVERGED_COST, SEED_COST, SUCCESS_COST, stream_key
from codesign_jax.optimize import ParticleFilter, State, candidates, schedule

STREAM_LANDSCAPE = 0x6C616E64
"""Stream of the trials that are drawn from a landscape ("land")."""
CANDIDATES = 64
"""Seed candidates of a run; if none costs more than 2 the run does not count."""
SCREEN, TEST = 1_000_000, 1_000_001
"""Numbers of the draws that belong to no episode: more than a run has."""


class Plan(NamedTuple):
    """Sizes of the paper's 2D experiment, or of fewer runs.

    Attributes:
      strategies: Names for `optimize.schedule`.
      runs: Runs of each.
      particles: Particles of a run.
      episodes: Episodes of a run.
      trials: Trials of a particle in an episode.
      test: Trials of a final particle in the test.
      shapes: Objects, which take turns.
    """

    strategies: tuple[str, ...] = ("single", "switch-4", "concurrent")
    runs: int = 30
    particles: int = 10
    episodes: int = 64
    trials: int = 6
    test: int = 42
    shapes: int = 3


class Runs(NamedTuple):
    """What runs on a landscape did; leading axes (strategy, run).

    Attributes:
      mean: Mean particle cost of each episode, shape (..., episode).
      success: Whether a final particle has a test cost below 0.01.
      seeded: Whether the run found a seed that costs more than 2.
    """

    mean: jax.Array
    success: jax.Array
    seeded: jax.Array


def trial_cost(
    landscape: jax.Array, low: jax.Array, high: jax.Array, design: jax.Array, trial: jax.Array
) -> jax.Array:
    """Cost of a design in a trial of the landscape, linear between the grid's points.

    Args:
      landscape: Costs, shape (point, point, trial).
      low: Lower ends of the parameters, shape (2,).
      high: Their upper ends.
      design: The design, shape (2,).
      trial: Index of the trial, shape ().
    """
    points = jnp.array(landscape.shape[:2])
    place = (design - low) / (high - low) * (points - 1)
    corner = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, points - 2)
    a, b = place - corner
    i, j = corner
    square = jax.lax.dynamic_slice(landscape, (i, j, trial), (2, 2, 1))[..., 0]
    return jnp.array([1 - a, a]) @ square @ jnp.array([1 - b, b])


def _draw(key: jax.Array, count: int, stored: int, shapes: int) -> jax.Array:
    """Indices of stored trials, shape (count,): trial t has the object t modulo their number."""
    turn = jax.random.randint(key, (count,), 0, stored // shapes)
    return turn * shapes + jnp.arange(count) % shapes


def make_runs(
    optimizer: ParticleFilter, is_morphology: Sequence[bool], plan: Plan
) -> Callable[[ArrayLike, jax.Array, bool], Runs]:
    """Returns the jitted function (landscapes, keys, shared) -> runs.

    Landscapes are trial costs, shape (set, point, point, trial), without NaN, in which trial t has
    the object t modulo the number of objects; keys are typed, shape (run,); `shared` says whether
    all particles of an episode meet the same trials, or each its own; results have the leading axis
    (set,).

    Args:
      optimizer: The particle filter over a space of two parameters.
      is_morphology: Domain of each parameter.
      plan: Sizes.
    """
    domain = np.asarray(is_morphology)
    low, high = (jnp.asarray(v) for v in (optimizer.space.low, optimizer.space.high))
    first = ["morphology" if r % 2 == 0 else "control" for r in range(plan.runs)]
    masks = jnp.array(
        [
            [schedule(s, domain, plan.episodes, f) for f in first]  # type: ignore[arg-type]
            for s in plan.strategies
        ]
    )

    def costs(landscape: jax.Array, particles: jax.Array, key: jax.Array, number, shared, trials):
        own = stream_key(key, STREAM_LANDSCAPE, jnp.asarray(number, jnp.int32))
        particle = jnp.where(shared, 0, jnp.arange(particles.shape[0]))
        keys = jax.vmap(lambda i: jax.random.fold_in(own, i))(particle)
        stored = landscape.shape[-1]
        drawn = jax.vmap(lambda k: _draw(k, trials, stored, plan.shapes))(keys)
        of_trials = jax.vmap(trial_cost, (None, None, None, None, 0))
        every = jax.vmap(of_trials, (None, None, None, 0, 0))
        return every(landscape, low, high, particles, drawn).mean(-1)

    def run(landscape: jax.Array, key: jax.Array, mask: jax.Array, shared: jax.Array) -> Runs:
        drawn = candidates(key, optimizer.space, np.arange(CANDIDATES))
        poor = costs(landscape, drawn, key, SCREEN, shared, plan.trials) > SEED_COST
        seed = drawn[jnp.argmax(poor)]
        start = State(jnp.tile(seed, (plan.particles, 1)), jnp.int32(0), key)

        def episode(state: State, mask: jax.Array) -> tuple[State, jax.Array]:
            moved = optimizer.ask(state, mask)
            cost = costs(landscape, moved, key, state.episode, shared, plan.trials)
            new, info = optimizer.tell(state, moved, cost)
            return new, info.mean_cost

        end, mean = jax.lax.scan(episode, start, mask)
        test = costs(landscape, end.particles, key, TEST, shared, plan.test)
        return Runs(mean, (test < SUCCESS_COST).any(), poor.any())

    over_runs = jax.vmap(run, (None, 0, 0, None))
    over_strategies = jax.vmap(over_runs, (None, None, 0, None))
    over_sets = jax.vmap(over_strategies, (0, None, None, None))

    @jax.jit
    def runs(landscapes: ArrayLike, keys: jax.Array, shared: ArrayLike) -> Runs:
        return over_sets(jnp.asarray(landscapes), keys, masks, jnp.asarray(shared))

    return runs


def episodes_to_converge(mean: np.ndarray, *, stays: bool) -> np.ndarray:
    """Episodes up to and with the one that converged, infinite where none did.

    Args:
      mean: Mean particle cost of each episode, shape (..., episode).
      stays: Whether the cost must stay below 1.0 from that episode on, as the paper writes, or be
        below for the first time.
    """
    below = np.asarray(mean) < CONVERGED_COST
    episodes = below.shape[-1]
    if stays:
        count = episodes - np.minimum.accumulate(below[..., ::-1], -1).sum(-1) + 1.0
    else:
        count = np.argmax(below, -1) + np.where(below.any(-1), 1.0, np.inf)
    return np.where(count > episodes, np.inf, count)


def filled(trials: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Trial costs with the design's mean where a trial failed, float32.

    Args:
      trials: Costs, NaN where a trial failed, shape (..., trial).
      mean: Mean cost without those, shape (...,).
    """
    return np.where(np.isnan(trials), mean[..., None], trials).astype(np.float32)
