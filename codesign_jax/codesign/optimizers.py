"""Optimisers over a design space."""

import dataclasses

import jax

from codesign_jax import optimize, user_code
from codesign_jax.optimize import Optimizer, ParticleFilter, Space
from codesign_jax.scene.parameters import DesignSpace


@dataclasses.dataclass(frozen=True)
class _Projection:
    """`DesignSpace.project`, equal for spaces of one structure: their filters share programs."""

    space: DesignSpace

    def __call__(self, design: jax.Array) -> jax.Array:
        return self.space.project(design)


def make_filter(space: DesignSpace, *, sigma: float = 0.05, alpha: float = 0.2) -> ParticleFilter:
    """Returns the particle filter over a design space, by default with the paper's constants.

    Args:
      space: Free parameters with bounds and pressure limit.
      sigma: Standard deviation of a move as a fraction of the parameter's range.
      alpha: Cost offset of the weight 1 / (alpha + cost).
    """
    return ParticleFilter(_box(space), sigma=sigma, alpha=alpha)


def make_optimizer(name: str, space: DesignSpace, *, num_particles: int | None = None) -> Optimizer:
    """Returns an optimiser over a design space; see `optimize.make_optimizer`.

    Args:
      name: One of `optimize.NAMES`, or MODULE:NAME of a class of your own.
      space: Free parameters with bounds and pressure limit.
      num_particles: Particles of a run, with which one of your own is tried.

    Raises:
      ValueError: If there is no such optimiser, or your own is not as `optimize.Optimizer` says.
    """
    if user_code.is_user_code(name):
        return user_code.make_optimizer(name, _box(space), num_particles)
    return optimize.make_optimizer(name, _box(space))


def _box(space: DesignSpace) -> Space:
    return Space(*space.box, _Projection(space.structure))
