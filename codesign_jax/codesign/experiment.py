"""Start, end and measures of the paper's experiments (section VI.4)."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax.codesign.episode import stream_key
from codesign_jax.cost import particle_cost
from codesign_jax.optimize import Optimizer, rejection
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
    """Results of particles in the final test.

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
    evaluate: Callable[[jax.Array, jax.Array], Outcome],
    *,
    batch: int,
    threshold: float = SEED_COST,
) -> tuple[jax.Array, float, int]:
    """Draws the particle that a run starts from by rejection sampling (section VI.4).

    Args:
      optimizer: Optimiser whose space is sampled.
      key: Root key of the run.
      evaluate: From candidates and the root key of an episode that moves nothing to their outcomes.
      batch: Candidates of one call.
      threshold: Cost above which a candidate is poor enough.

    Returns:
      The seed particle [SI units], shape (parameter,), its cost and the number of candidates drawn.

    Raises:
      NoSeed: If no candidate is poor enough.
    """
    noise = stream_key(key, STREAM_SCREEN)

    def cost(candidates: jax.Array) -> jax.Array:
        return particle_cost(scene, evaluate(candidates, noise))

    options = {"threshold": threshold, "batch": batch}
    seeds, costs, drawn = rejection(key, optimizer.space, 1, cost, **options)
    return seeds[0], float(costs[0]), drawn


def test_key(key: jax.Array, index: int) -> jax.Array:
    """Root key of a round of the final test of a run, an episode that moves nothing.

    The paper's test is 36 more trials of the final particles in 2D, which makes 42 with the last
    episode's 6, and 72 more in 23D, which makes 78; a round is as many trials as an episode's.
    """
    return stream_key(key, STREAM_TEST, index)


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
