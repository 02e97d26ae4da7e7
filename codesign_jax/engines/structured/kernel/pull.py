"""Reverse-mode derivatives of functions that are evaluated lane by lane.

JAX differentiates the program of components that `lanewise` makes of a function: values over the
lanes and elementwise operations only, so that the derivative is such a program too.  A number that
belongs to a world gets one cotangent on each of its fingers' lanes, to be summed by the caller.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.components import FINGER, is_number, splat
from codesign_jax.engines.structured.lanewise import Lanes, lanewise


def pull(function: Callable, args: tuple, fixed: tuple, bars: Any) -> Any:
    """Cotangents of args: the transposed derivative of function(*args, *fixed) times bars.

    Args:
      function: As in `lanewise`.
      args: Trees of lanes by which to differentiate.
      fixed: Further arguments.
      bars: Cotangents of the function's results, a tree of lanes of the same structure.

    Returns:
      A tree as `args`, all of it lanes of a finger each.
    """
    leaves, tree = jax.tree.flatten(args, is_leaf=_is_lanes)
    spots = [
        (n, at)
        for n, leaf in enumerate(leaves)
        for at, part in np.ndenumerate(leaf.parts)
        if not is_number(part) and jnp.issubdtype(part.dtype, jnp.floating)
    ]
    results: list[Lanes] = []

    def run(values: list[jax.Array]) -> list[jax.Array]:
        filled = [Lanes(leaf.parts.copy(), leaf.shape, leaf.dtype) for leaf in leaves]
        for (n, at), value in zip(spots, values, strict=True):
            filled[n].parts[at] = value
        out = lanewise(function, *jax.tree.unflatten(tree, filled), *fixed)
        results[:] = jax.tree.leaves(out, is_leaf=_is_lanes)
        return [part for leaf in results for part in leaf.parts.ravel() if not is_number(part)]

    primals, back = jax.vjp(run, [leaves[n].parts[at] for n, at in spots])
    seeds = [
        bar
        for leaf, given in zip(results, jax.tree.leaves(bars, is_leaf=_is_lanes), strict=True)
        for part, bar in zip(leaf.parts.ravel(), given.parts.ravel(), strict=True)
        if not is_number(part)
    ]
    seeds = [splat(s, p.shape, p.dtype) for s, p in zip(seeds, primals, strict=True)]
    (found,) = back(seeds)
    shells = [_nothing(leaf) for leaf in leaves]
    for (n, at), bar in zip(spots, found, strict=True):
        shells[n].parts[at] = bar
    return jax.tree.unflatten(tree, shells)


def plus(one: Any, other: Any) -> Any:
    """Sum of two trees of lanes."""
    return lanewise(_sum, one, other)


def only_on(mask: Lanes, tree: Any) -> Any:
    """A tree of lanes, zero on the lanes where the mask is false."""
    return lanewise(_where, mask, tree)


def _sum(one: Any, other: Any) -> Any:
    return jax.tree.map(jnp.add, one, other)


def _where(mask: jax.Array, tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.where(mask, x, jnp.zeros_like(x)), tree)


def _is_lanes(x: Any) -> bool:
    return isinstance(x, Lanes)


def _nothing(leaf: Lanes) -> Lanes:
    """Zeros in the shape of lanes, of a finger each."""
    parts = np.empty(leaf.parts.shape, object)
    parts.fill(np.zeros((), leaf.dtype)[()])
    return Lanes(parts, (*leaf.shape[:-2], FINGER, leaf.shape[-1]), leaf.dtype)
