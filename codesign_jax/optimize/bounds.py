"""The box of feasible parameters and how a move stays inside it."""

import dataclasses
from collections.abc import Callable

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike


def reflect(x: ArrayLike, low: ArrayLike, high: ArrayLike) -> jax.Array:
    """Fold values into [low, high] as if both bounds were mirrors.

    A triangle wave of period `2 (high - low)`, so any number of reflections costs the same.
    Values inside are returned bitwise. Clipping would pile particles on the bounds instead.

    Args:
      x: Finite values, any shape.
      low: Lower bounds, broadcastable to `x`.
      high: Upper bounds, not below `low`; where equal, the result is that bound.

    Returns:
      Values in [low, high], shape of `x`.
    """
    x = jnp.asarray(x)
    low = jnp.asarray(low)
    high = jnp.asarray(high)
    width = high - low
    # The wave is symmetric about low, so the distance from low is all that matters.
    phase = jnp.abs(x - low) % jnp.where(width > 0, 2 * width, 1)
    folded = jnp.clip(low + jnp.minimum(phase, 2 * width - phase), low, high)
    return jnp.where((x >= low) & (x <= high), x, folded)


def strictly_below(x: ArrayLike, limit: ArrayLike) -> jax.Array:
    """Lower values to the largest float under a limit; keep those already under it bitwise.

    For projections with a strict limit, such as the chamber pressure of Table I. One step of the
    float grid also covers the rounding of a limit that is one product of exact factors.

    Args:
      x: Values, any shape.
      limit: Exclusive upper limits, broadcastable to `x`.

    Returns:
      Values below `limit`, shape of `x`.
    """
    x = jnp.asarray(x)
    limit = jnp.asarray(limit, x.dtype)
    return jnp.minimum(x, jnp.nextafter(limit, jnp.full_like(limit, -jnp.inf)))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Space:
    """A box of parameters with an optional extra constraint.

    A pytree: bounds are leaves, so that another box of the same size does not recompile;
    `project` is static and compared by identity, so make it once.

    Attributes:
      low: Lower bounds in the unit of each parameter, shape (parameter,).
      high: Upper bounds, not below `low`, shape (parameter,).
      project: Maps one particle inside the box, shape (parameter,), to one that also satisfies
        the constraint and is still in the box. Must return a feasible particle unchanged.
    """

    low: ArrayLike
    high: ArrayLike
    project: Callable[[jax.Array], jax.Array] | None = dataclasses.field(
        default=None, metadata={"static": True}
    )

    def __post_init__(self) -> None:
        """Check bounds that are values; tracers and tree placeholders pass.

        Raises:
          ValueError: If the bounds differ in shape, are not finite, or are in the wrong order.
        """
        if not all(_is_value(bound) for bound in (self.low, self.high)):
            return
        low = np.asarray(self.low)
        high = np.asarray(self.high)
        if low.shape != high.shape or low.ndim < 1:
            raise ValueError(f"low {low.shape} and high {high.shape} must both be (parameter,)")
        wrong = np.argwhere(~(np.isfinite(low) & np.isfinite(high) & (low <= high)))
        if wrong.size:
            at = tuple(wrong[0])
            raise ValueError(f"parameter {at[-1]} has low {low[at]} and high {high[at]}")

    def constrain(self, particles: jax.Array) -> jax.Array:
        """Apply `project` to each particle, shape (particle, parameter)."""
        return particles if self.project is None else jax.vmap(self.project)(particles)


def _is_value(x: object) -> bool:
    return isinstance(x, (np.ndarray, jax.Array)) and not isinstance(x, jax.core.Tracer)
