"""How the paper's experiments begin, end and are measured (section VI.4)."""

from collections.abc import Generator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.codesign.episode import stream_key
from codesign_jax.cost import particle_cost
from codesign_jax.optimize import Optimizer, rejection, translated
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome

# Four ASCII letters each, see `episode.STREAM_TRIAL`.
STREAM_SCREEN = 0x7363726E
"""Stream of the noise with which seed candidates are screened ("scrn")."""
STREAM_TEST = 0x74657374
"""Stream of the noise of the final test ("test")."""

SUCCESS_COST = 0.01
"""Mean test cost below which a particle has solved the task by the paper's rule (section VI.4); the
verdict of a run is `verdict.judge`."""
CONVERGED_COST = 1.0
"""Mean particle cost of an episode below which a run counts as converged (section VI.4)."""
SEED_COST = 2.0
"""Cost that a seed particle must exceed, so that no run starts with a solution (section VI.4)."""


class FinalTest(NamedTuple):
    """How particles did in the final test.

    Attributes:
      outcomes: Arrays of shape (particle, trial).
      cost: Mean cost of each particle by the scene's failure rule, shape (particle,).
      paper_success: Whether the cost is below `SUCCESS_COST`, bool, shape (particle,).
    """

    outcomes: Outcome
    cost: jax.Array
    paper_success: jax.Array


def seed_search(
    scene: Scene,
    optimizer: Optimizer,
    key: jax.Array,
    *,
    batch: int,
    threshold: float = SEED_COST,
) -> Generator[tuple[jax.Array, jax.Array], Outcome, tuple[jax.Array, float, int]]:
    """Draws the particle that a run starts from by rejection sampling (section VI.4).

    A generator: it yields (population, key), and is sent their outcomes; see `optimize.answer`.

    Args:
      optimizer: Optimiser whose space is sampled.
      key: Root key of the run.
      batch: Candidates of one request.
      threshold: Cost above which a candidate is poor enough.

    Returns:
      The seed particle [SI units], shape (parameter,), its cost and the number of candidates drawn.

    Raises:
      NoSeed: If no candidate is poor enough.
    """
    noise = stream_key(key, STREAM_SCREEN)
    seeds, costs, drawn = yield from translated(
        rejection(key, optimizer.space, 1, threshold=threshold, batch=batch),
        lambda population: (population, noise),
        lambda outcomes: particle_cost(scene, outcomes),
    )
    return seeds[0], float(costs[0]), drawn


def testing(
    scene: Scene,
    particles: jax.Array,
    key: jax.Array,
    *,
    num_trials: int,
    previous: Outcome | None = None,
) -> Generator[tuple[jax.Array, jax.Array], Outcome, FinalTest]:
    """Tests final particles on new trials, together with the trials they had already.

    The paper's test: 36 more trials in 2D, which makes 42 with the last episode's 6, and 72 more
    in 23D, which makes 78.  A generator: it yields (population, key), and is sent their outcomes.

    Args:
      particles: Particles [SI units], shape (particle, parameter).
      key: Root key of the run.
      num_trials: Further trials of each particle; requests go on until there are as many, so that a
        multiple of an answer's trials gives exactly that many.
      previous: Outcomes that count as well, shape (particle, trial), such as the last episode's.
    """
    parts = [] if previous is None else [previous]
    done = 0
    chunk = 0
    while done < num_trials:
        parts.append((yield particles, stream_key(key, STREAM_TEST, chunk)))
        done = done + parts[-1].cost.shape[1]
        chunk = chunk + 1
    return summarize_test(scene, jax.tree.map(lambda *v: jnp.concatenate(v, axis=1), *parts))


def summarize_test(scene: Scene, outcomes: Outcome) -> FinalTest:
    """Returns cost and the paper's success of particles from the outcomes of their test.

    Args:
      outcomes: Arrays of shape (particle, trial).
    """
    cost = particle_cost(scene, outcomes)
    return FinalTest(outcomes, cost, cost < SUCCESS_COST)


def convergence_episode(
    mean_cost: np.typing.ArrayLike, *, threshold: float = CONVERGED_COST
) -> int | None:
    """Returns the first episode from which the mean particle cost stays below the threshold.

    Args:
      mean_cost: Mean particle cost of each episode, shape (episode,).
      threshold: The paper's c_convergence.

    Returns:
      Zero-based episode, or None if the last episode is not below the threshold.
    """
    above = np.flatnonzero(~(np.asarray(mean_cost) < threshold))
    first = int(above[-1]) + 1 if above.size else 0
    return first if first < np.size(mean_cost) else None
