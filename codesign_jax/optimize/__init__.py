"""Optimisers behind `init`, `ask` and `tell`; they know arrays and costs, no physics.

>>> import jax, numpy as np
>>> from codesign_jax import optimize
>>> optimize.schedule("switch-1", [True, False], 4)  # length, then arm height
array([[ True, False],
       [ True, False],
       [False,  True],
       [False,  True]])
>>> space = optimize.Space(np.array([0.0, 0.0]), np.array([1.0, 1.0]))
>>> optimizer = optimize.ParticleFilter(space)
>>> state = optimizer.init(jax.random.key(0), [0.5, 0.9], 3)
>>> population = optimizer.ask(state, np.array([True, False]))
>>> population.shape, bool((population[:, 1] == state.particles[:, 1]).all())
((3, 2), True)
>>> state, info = optimizer.tell(state, population, np.array([2.0, 0.1, 3.0]))
>>> int(info.best_index), int(state.episode)
(1, 1)
"""

from codesign_jax.optimize.bounds import Space, reflect, strictly_below
from codesign_jax.optimize.evolution import EVOSAX, Evolution
from codesign_jax.optimize.names import DEFAULT, FEW, NAMES, PAPER, make_optimizer, problem
from codesign_jax.optimize.particle_filter import ParticleFilter
from codesign_jax.optimize.protocol import Info, Optimizer, OptimizerState
from codesign_jax.optimize.resampling import MAX_PARTICLES, stochastic_universal
from codesign_jax.optimize.retested import Retested
from codesign_jax.optimize.schedule import schedule
from codesign_jax.optimize.screened import Screened
from codesign_jax.optimize.seeding import (
    NoSeed,
    candidates,
    rejection,
)

__all__ = [
    "DEFAULT",
    "FEW",
    "EVOSAX",
    "MAX_PARTICLES",
    "NAMES",
    "PAPER",
    "Evolution",
    "Info",
    "NoSeed",
    "Optimizer",
    "ParticleFilter",
    "Retested",
    "Screened",
    "Space",
    "OptimizerState",
    "candidates",
    "make_optimizer",
    "problem",
    "reflect",
    "rejection",
    "schedule",
    "stochastic_universal",
    "strictly_below",
]
