"""Optimisers behind ``init``, ``ask`` and ``tell``; they know arrays and costs, no physics."""

from codesign_jax.optimize.bounds import Space, reflect, strictly_below
from codesign_jax.optimize.evolution import Evolution
from codesign_jax.optimize.names import NAMES, make_optimizer, problem
from codesign_jax.optimize.particle_filter import ParticleFilter
from codesign_jax.optimize.protocol import Info, Optimizer, State
from codesign_jax.optimize.resampling import MAX_PARTICLES, stochastic_universal
from codesign_jax.optimize.schedule import schedule
from codesign_jax.optimize.seeding import answer, candidates, rejection, rejection_sample

__all__ = [
    "MAX_PARTICLES",
    "NAMES",
    "Evolution",
    "Info",
    "Optimizer",
    "ParticleFilter",
    "Space",
    "State",
    "answer",
    "candidates",
    "make_optimizer",
    "problem",
    "reflect",
    "rejection",
    "rejection_sample",
    "schedule",
    "stochastic_universal",
    "strictly_below",
]
