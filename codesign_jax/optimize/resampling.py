"""Stochastic universal sampling in exact integer arithmetic."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

MAX_PARTICLES = 2**15
"""Most particles for which no intermediate value leaves 32-bit integers."""

_TOTAL = 2**30


def stochastic_universal(u: ArrayLike, weights: ArrayLike) -> jax.Array:
    """Draw as many ancestors as there are weights with one uniform number.

    Baker (1987), "Reducing bias and inefficiency in the selection algorithm"; step 4 of Fig. 5 in
    Deimel et al. (2017). `n` equally spaced pointers `(i + u) / n` are looked up in the
    cumulative weights.

    The weights are first rounded to integers that sum to about 2**30, and everything after that
    is exact. So each count is the floor or ceiling of `n * w` (`w` the normalised weight, to
    a relative `n / 2**31`), the counts sum to `n`, equal weights give the identity for every
    `u`, a weight of zero is never drawn, and the result does not depend on the order in which a
    device sums. A float32 cumulative sum guarantees none of these but the second.

    Weights that are negative or not finite count as zero. Where no positive weight is left, the
    result is the identity: every particle survives once.

    Args:
      u: Uniform number in [0, 1), scalar.
      weights: Weights, not necessarily normalised, shape (particle,). Subnormal numbers may
        count as zero; so do weights below about `2**-31` of the sum.

    Returns:
      Ancestor indices in ascending order, int32, shape (particle,).

    Raises:
      ValueError: If `weights` is not a vector of 1 to `MAX_PARTICLES` numbers.
    """
    weights = jnp.asarray(weights, jnp.float32)
    if weights.ndim != 1 or not 1 <= weights.shape[0] <= MAX_PARTICLES:
        raise ValueError(
            f"weights must have shape (particle,) with 1 to {MAX_PARTICLES} particles, "
            f"got shape {weights.shape}"
        )
    n = weights.shape[0]
    cumulative = jnp.cumsum(_to_integers(weights))
    total = cumulative[-1]
    # The last pointer must stay below the total, also where u * total rounds up.
    offset = jnp.minimum((jnp.asarray(u, jnp.float32) * total).astype(jnp.int32), total - 1)
    index = jnp.arange(n, dtype=jnp.int32)
    # floor((index * total + offset) / n), split so that no product overflows.
    pointers = index * (total // n) + (index * (total % n) + offset) // n
    ancestors = jnp.searchsorted(cumulative, pointers, side="right").astype(jnp.int32)
    return jnp.where(total > 0, ancestors, index)


def _to_integers(weights: jax.Array) -> jax.Array:
    """Round weights to integers with a sum of at most 2**30 + n / 2; keep zeros and ties."""
    n = weights.shape[0]
    usable = jnp.where(jnp.isfinite(weights) & (weights > 0), weights, 0)
    # Scaling the largest to [0.5, 1) by a power of two is exact and keeps every sum finite. A
    # division would not do: compilers turn it into a product with a reciprocal that underflows.
    share = jnp.ldexp(usable, -jnp.frexp(usable.max())[1])
    # An integer sum is the same in any order; rounding up makes it a bound for the true sum.
    bound = jnp.ceil(share * (_TOTAL / n)).astype(jnp.int32).sum()
    scale = _TOTAL / jnp.maximum(bound, 1).astype(jnp.float32) * (_TOTAL / n)
    return jnp.round(share * scale).astype(jnp.int32)
