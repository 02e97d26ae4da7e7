"""Evaluates a jaxpr with every component of its arrays as a separate value over the lanes.

Rearranging of components and arithmetic on numbers happen here, at trace time; what is left is
arithmetic on lanes.
"""

import functools
import math
import operator
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend import core

from codesign_jax.compiler.straight_line import Symbol

# Stand for the lane axes while a function is traced: sizes that no other axis has.
FINGER = 1009
WORLD = 1013


def _small(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(1 if n in (FINGER, WORLD) else n for n in shape)


def _constant(value: Any) -> np.ndarray:
    array = np.asarray(value)
    parts = np.empty(_small(array.shape), object)
    for index in np.ndindex(parts.shape):
        parts[index] = array[index]
    return parts


def evaluate(jaxpr: Any, consts: Any, args: list[np.ndarray]) -> list[np.ndarray]:
    """The results of a jaxpr whose arguments are given as components.

    Args:
      args: Object arrays, see `lanewise.Lanes.parts`.

    Raises:
      NotImplementedError: If an operation is neither arithmetic nor rearranging of components.
    """
    values: dict[Any, np.ndarray] = {}

    def read(atom: Any) -> np.ndarray:
        return _constant(atom.val) if isinstance(atom, core.Literal) else values[atom]

    values.update(zip(jaxpr.constvars, map(_constant, consts), strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))
    for equation in jaxpr.eqns:
        inputs = [read(v) for v in equation.invars]
        outputs = _apply(equation, inputs)
        for variable, value in zip(equation.outvars, outputs, strict=True):
            assert value.shape == _small(variable.aval.shape), (equation, value.shape)
            values[variable] = value
    return [read(v) for v in jaxpr.outvars]


def _apply(equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    name = equation.primitive.name
    params = equation.params
    for key in ("jaxpr", "call_jaxpr"):
        if name in ("jit", "pjit", "closed_call", "custom_jvp_call", "remat2", "checkpoint"):
            if key in params:
                inner = params[key]
                consts = getattr(inner, "consts", ())
                return evaluate(getattr(inner, "jaxpr", inner), consts, inputs)
    if name in ("optimization_barrier", "copy", "copy_p", "stop_gradient"):
        return inputs
    shape = _small(equation.outvars[0].aval.shape)
    if name in _REARRANGE:
        return _REARRANGE[name](inputs, params, shape)
    if name in _REDUCE:
        if any(equation.invars[0].aval.shape[a] in (FINGER, WORLD) for a in params["axes"]):
            raise NotImplementedError(f"{name} over the lanes")
        return [_reduce(_REDUCE[name], inputs[0], params["axes"])]
    rule = _SIMPLIFY.get(name)
    options = {"y": params["y"]} if name == "integer_pow" else {}
    types = [v.aval.dtype for v in equation.invars]

    def each(*parts: Any) -> Any:
        if all(map(is_number, parts)):
            return _fold(equation, parts, types)
        if rule is not None:
            simple = rule(*parts, **options)
            if simple is not None:
                return simple
        return _bind(equation, parts, types)

    return [_each(each, inputs, shape)]


def _each(function: Callable, inputs: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    columns = [(x if x.shape == shape else np.broadcast_to(x, shape)).ravel() for x in inputs]
    result = np.empty(math.prod(shape), object)
    for k, parts in enumerate(zip(*columns, strict=True)):
        result[k] = function(*parts)
    return result.reshape(shape)


_NUMBERS = (bool, int, float, np.generic)


def is_number(x: Any) -> bool:
    """Whether a component is a number that is known at trace time."""
    if type(x) is Symbol:  # most are
        return False
    return isinstance(x, _NUMBERS) or (isinstance(x, np.ndarray) and x.ndim == 0)


_EXACT: dict[str, Callable] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "max": np.maximum,
    "min": np.minimum,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.invert,
}
"""NumPy's functions with JAX's bits, but for quotients of integers; JAX would compile programs."""


def _fold(equation: Any, parts: tuple, types: list) -> Any:
    name = equation.primitive.name
    arrays = [np.asarray(p, t) for p, t in zip(parts, types, strict=True)]
    if name == "convert_element_type":
        return arrays[0].astype(equation.params["new_dtype"])[()]
    if name in _EXACT and not (name == "div" and np.issubdtype(types[0], np.integer)):
        return _EXACT[name](*arrays)
    with jax.ensure_compile_time_eval():
        return np.asarray(equation.primitive.bind(*arrays, **equation.params))[()]


def _bind(equation: Any, parts: tuple, types: list) -> Any:
    for part in parts:
        if type(part) is Symbol:
            return part.program.record(equation, parts, types, equation.outvars[0].aval.dtype)
    shape = next(p.shape for p in parts if not is_number(p))
    arrays = [splat(p, shape, kind) for p, kind in zip(parts, types, strict=True)]
    return equation.primitive.bind(*arrays, **equation.params)


def splat(part: Any, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    """A number as lanes; lanes as they are."""
    return jax.lax.full(shape, np.asarray(part, dtype)) if is_number(part) else part


def _reduce(function: Callable, x: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    for axis in sorted(axes, reverse=True):
        columns = [np.take(x, k, axis=axis) for k in range(x.shape[axis])]
        total = columns[0]
        for column in columns[1:]:
            total = _each(function, [total, column], total.shape)
        x = np.asarray(total, object)
    return x


def _broadcast(inputs: list[np.ndarray], params: dict, shape: tuple[int, ...]) -> list[np.ndarray]:
    aligned = [1] * len(shape)
    for axis, size in zip(params["broadcast_dimensions"], inputs[0].shape, strict=True):
        aligned[axis] = size
    return [np.broadcast_to(inputs[0].reshape(aligned), shape)]


def _slice(inputs: list[np.ndarray], params: dict, shape: tuple[int, ...]) -> list[np.ndarray]:
    strides = params["strides"] or (1,) * len(shape)
    limits = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [inputs[0][tuple(slice(a, b, c) for a, b, c in limits)]]


def _iota(inputs: list[np.ndarray], params: dict, shape: tuple[int, ...]) -> list[np.ndarray]:
    numbers = np.arange(shape[params["dimension"]], dtype=params["dtype"])
    aligned = [1] * len(shape)
    aligned[params["dimension"]] = -1
    return [_constant(np.broadcast_to(numbers.reshape(aligned), shape))]


def _split(inputs: list[np.ndarray], params: dict, shape: tuple[int, ...]) -> list[np.ndarray]:
    return np.split(inputs[0], np.cumsum(params["sizes"])[:-1], params["axis"])


def _unstack(inputs: list[np.ndarray], params: dict, shape: tuple[int, ...]) -> list[np.ndarray]:
    axis = params["axis"]
    return [np.take(inputs[0], k, axis=axis) for k in range(inputs[0].shape[axis])]


_REARRANGE: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda x, p, s: [x[0].reshape(s)],
    "squeeze": lambda x, p, s: [x[0].reshape(s)],
    "expand_dims": lambda x, p, s: [x[0].reshape(s)],
    "transpose": lambda x, p, s: [x[0].transpose(p["permutation"])],
    "slice": _slice,
    "concatenate": lambda x, p, s: [np.concatenate(x, p["dimension"])],
    "stack": lambda x, p, s: [np.stack(x, p["axis"])],
    "unstack": _unstack,
    "split": _split,
    "rev": lambda x, p, s: [np.flip(x[0], p["dimensions"])],
    "iota": _iota,
}

_REDUCE: dict[str, Callable] = {
    "reduce_sum": operator.add,
    "reduce_or": operator.or_,
    "reduce_and": operator.and_,
}


def _is(x: Any, number: float) -> bool:
    return is_number(x) and float(x) == number


def _add(a: Any, b: Any) -> Any:
    return b if _is(a, 0) else a if _is(b, 0) else None


def _mul(a: Any, b: Any) -> Any:
    if _is(a, 0) or _is(b, 0):
        return np.float32(0)
    return b if _is(a, 1) else a if _is(b, 1) else None


def _power(x: Any, y: int) -> Any:
    result = functools.reduce(operator.mul, [x] * abs(y))
    return result if y > 0 else 1.0 / result


def _select(which: Any, no: Any, yes: Any) -> Any:
    if is_number(which):
        return yes if which else no
    return no if no is yes else None


def _and(a: Any, b: Any) -> Any:
    if is_number(a):
        return b if a else False
    return (a if b else False) if is_number(b) else None


def _or(a: Any, b: Any) -> Any:
    if is_number(a):
        return True if a else b
    return (True if b else a) if is_number(b) else None


# What is left of an operation where an operand is a number; None: bind it as it is.
_SIMPLIFY: dict[str, Callable] = {
    "add": _add,
    "add_any": _add,
    "sub": lambda a, b: a if _is(b, 0) else None,
    "mul": _mul,
    "div": lambda a, b: np.float32(0) if _is(a, 0) else a if _is(b, 1) else None,
    "integer_pow": _power,
    "square": lambda x: x * x,
    "select_n": _select,
    "and": _and,
    "or": _or,
}
