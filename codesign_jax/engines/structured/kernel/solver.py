"""Newton's method with exact line search: what of it depends on no layout of memory.

A step minimises over the accelerations a
  1/2 (a - a_s)' M (a - a_s) + sum_c s_c(J_c a - aref_c),
MuJoCo's contact problem, M with armature and implicit terms.
"""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import dot

FAR = 3e38
"""No upper end of a bracket yet; finite, as a GPU kernel has no test for infinity."""


def tree_add_scaled(alpha: jax.Array, value: Any, step: Any) -> Any:
    """A tree of arrays moved by alpha times another one."""
    return jax.tree.map(lambda v, s: v + alpha * s, value, step)


def refine(
    alpha: jax.Array, low: jax.Array, high: jax.Array, first: jax.Array, second: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Next step length and bracket from the derivatives at alpha: Newton, else bisection."""
    low, high = jnp.where(first <= 0, alpha, low), jnp.where(first > 0, alpha, high)
    guess = alpha - first / jnp.maximum(second, 1e-30)
    inside = (guess >= low) & (guess <= high)
    middle = jnp.where(high > 1e30, 2.0 * low, 0.5 * (low + high))
    return jnp.where(inside, guess, middle), low, high


def scale(mass: jax.Array, palm: jax.Array, motion: jax.Array) -> jax.Array:
    """Typical size of the objective: object and palm at g, plus the object's present motion.

    Args:
      mass: Mass of the object.
      palm: Mass of the palm.
      motion: Spatial acceleration of the object, shape (6, ...).
    """
    return 100.0 * (mass + palm) + mass * dot(motion[3:], motion[3:])
