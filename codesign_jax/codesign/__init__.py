"""Co-design: one episode, that is ask, simulate and tell, as one jitted program.

Source: Deimel, Irmisch, Wall, Brock (2017), section VI.1 and Fig. 5; the measures are those of
section VI.4.  Everything here is a pure function of arrays; files and progress are the caller's.

The front page has an optimisation in ten lines; `notebooks/` go on from there.

>>> from codesign_jax import codesign, parameters, scene
>>> space = parameters.design_space(scene.load("paper").hand, "2d")
>>> codesign.make_filter(space).sigma  # of a move, as a share of the parameter's range
0.05
>>> codesign.convergence_episode([3.0, 0.5, 1.2, 0.9])  # below 1 from then on
3
"""

from codesign_jax.codesign.episode import (
    STREAM_TRIAL,
    EpisodeInfo,
    Task,
    episode_trials,
    stream_key,
)
from codesign_jax.codesign.experiment import (
    CONVERGED_COST,
    SEED_COST,
    STREAM_SCREEN,
    STREAM_TEST,
    SUCCESS_COST,
    FinalTest,
    convergence_episode,
    seed_search,
    summarize_test,
    test_key,
)
from codesign_jax.codesign.optimizers import make_filter, make_optimizer
from codesign_jax.cost import particle_cost

__all__ = [
    "CONVERGED_COST",
    "SEED_COST",
    "STREAM_SCREEN",
    "STREAM_TEST",
    "STREAM_TRIAL",
    "SUCCESS_COST",
    "EpisodeInfo",
    "FinalTest",
    "Task",
    "convergence_episode",
    "episode_trials",
    "make_filter",
    "make_optimizer",
    "particle_cost",
    "seed_search",
    "stream_key",
    "summarize_test",
    "test_key",
]
