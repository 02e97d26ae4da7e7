"""Optimisers by name."""

import difflib
from collections.abc import Callable, Mapping

import numpy as np

from codesign_jax.optimize import screened
from codesign_jax.optimize.bounds import Space
from codesign_jax.optimize.evolution import EVOSAX, LEAST, OPEN_SIGMA, Evolution
from codesign_jax.optimize.particle_filter import ParticleFilter
from codesign_jax.optimize.protocol import Optimizer
from codesign_jax.optimize.retested import Retested
from codesign_jax.optimize.screened import Screened

DEFAULT = "screened-es"
"""The optimiser of a run that names no other."""
PAPER = "particle-filter"
"""The paper's optimiser."""

FEW = 3
"""Most parameters with which the default is `Retested`: random designs come close to the best
there, and a strategy's mean does not."""

OWN: Mapping[str, Callable[[Space], Optimizer]] = {
    DEFAULT: lambda space: (Retested if np.size(space.low) <= FEW else Screened)(space),
    PAPER: ParticleFilter,
}
"""The optimisers that this package implements itself, by name: what makes each over a space."""

NAMES = (*OWN, *EVOSAX)
"""All optimisers: the package's own, and evosax's strategies."""


def make_optimizer(name: str, space: Space) -> Optimizer:
    """An optimiser with its default constants; those of the particle filter are the paper's.

    Args:
      name: One of `NAMES`.
      space: Bounds and constraint of the parameters.

    Raises:
      ValueError: If there is no such optimiser.
    """
    if name not in NAMES:
        raise ValueError(problem(name))
    if name in EVOSAX:
        return Evolution(space, name, **({"sigma": OPEN_SIGMA} if name == "open-es" else {}))
    return OWN[name](space)


def problem(name: str, num_particles: int | None = None) -> str | None:
    """The reason why an optimiser cannot be used, in words; None if there is none.

    Args:
      name: Its name.
      num_particles: Particles of a run, to be checked as well.
    """
    if name not in NAMES:
        near = difflib.get_close_matches(name, NAMES, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        return f"unknown optimizer {name!r}; {hint}Valid: {', '.join(NAMES)}"
    least = screened.LEAST if name == DEFAULT else LEAST.get(name, 1)
    if num_particles is not None and num_particles < least:
        return f"{name} ranks its particles: it needs at least {least}, got {num_particles}"
    if name == "open-es" and num_particles is not None and num_particles % 2:
        return f"{name} draws pairs of particles: it needs an even number, got {num_particles}"
    return None
