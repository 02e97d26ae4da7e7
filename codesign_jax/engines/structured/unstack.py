"""Slices of single items rewritten, so that their derivative is one array and not many to add."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core

_CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr"}


def unstacked(function: Callable) -> Callable:
    """The same function, in which x[0], x[1], ... come from one `unstack` of x.

    The transpose of a slice is an array of the operand's size, zero but for the slice: the
    derivative of code written component by component adds up dozens of them.  The transpose of
    `unstack` is one `stack`.

    Args:
      function: From pytrees of arrays to pytrees of arrays.
    """

    def run(*args: Any) -> Any:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        out = _evaluate(closed.jaxpr, closed.consts, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shapes), out)

    return run


def _evaluate(jaxpr: Any, consts: Any, args: list) -> list:
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))
    parts: dict[Any, tuple] = {}
    items: dict[Any, tuple] = {}

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, core.Literal) else values[atom]

    for equation in jaxpr.eqns:
        name, params = equation.primitive.name, equation.params
        axis = _single(equation) if name == "slice" else None
        if axis is not None:
            whole = equation.invars[0]
            if (whole, axis) not in parts:
                parts[whole, axis] = jnp.unstack(read(whole), axis=axis)
            item = parts[whole, axis][params["start_indices"][axis]]
            items[equation.outvars[0]] = item, axis
            out = [item.reshape(equation.outvars[0].aval.shape)]
        elif name == "squeeze" and _is_item(equation, items):
            out = [items[equation.invars[0]][0]]
        elif name in _CALLS:
            inner = params[_CALLS[name]]
            out = _evaluate(inner.jaxpr, inner.consts, [read(v) for v in equation.invars])
        else:
            given = equation.primitive.get_bind_params(params)
            out = equation.primitive.bind(*map(read, equation.invars), **given)
            out = out if equation.primitive.multiple_results else [out]
        values.update(zip(equation.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _is_item(equation: Any, items: dict) -> bool:
    """Whether an equation removes just the axis of which an item was taken."""
    (whole,) = equation.invars
    found = None if isinstance(whole, core.Literal) else items.get(whole)
    return found is not None and tuple(equation.params["dimensions"]) == (found[1],)


def _single(equation: Any) -> int | None:
    """The axis of which a slice takes one item, if it takes all of the others."""
    before, after = equation.invars[0].aval.shape, equation.outvars[0].aval.shape
    cut = [k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a != b]
    if len(cut) != 1 or after[cut[0]] != 1 or isinstance(equation.invars[0], core.Literal):
        return None
    return cut[0]
