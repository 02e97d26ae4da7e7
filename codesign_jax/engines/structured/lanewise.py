"""Evaluates functions of lane arrays component by component, inside kernels without small arrays.

A GPU kernel keeps each number of a small matrix in a register of its own and has no stack, slice or
concatenation.  The physics is written once, on arrays such as (6, 6, finger, world); here its jaxpr
is evaluated with every component as a separate value over the lanes (finger, world), so that all
rearranging happens at trace time and only arithmetic is left.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend import core

from codesign_jax.engines.structured import identity

# Stand for the lane axes while a function is traced: sizes that no other axis has.
FINGER, WORLD = 1009, 1013


class Lanes:
    """An array as one value per component.

    Attributes:
      parts: Values, an object array with the array's axes, of which the lane axes have length one;
        each is a number or an array over the lanes, (lane,), finger * worlds + world; what belongs
        to a world is the same on all its fingers' lanes.
      shape: Shape with `FINGER` and `WORLD` for the lane axes.
      dtype: Type of the values.
    """

    def __init__(self, parts: np.ndarray, shape: tuple[int, ...], dtype: Any):
        """See the attributes."""
        self.parts, self.shape, self.dtype = parts, shape, np.dtype(dtype)

    def __getitem__(self, index: Any) -> "Lanes":
        """Components along the leading axes that are not lanes."""
        parts = self.parts[index]
        return Lanes(parts, (*parts.shape[:-2], *self.shape[-2:]), self.dtype)

    @property
    def lane(self) -> Any:
        """The only component."""
        return self.parts.item()


def lanes(values: Any, shape: tuple[int, ...], *, wide: bool) -> Lanes:
    """Lanes of components given flat, of a finger each (wide) or of a world.

    Args:
      values: Values over the lanes, as many as `shape` has elements.
      shape: Shape of the components.
      wide: Whether the lanes are (finger, world) and not (1, world).
    """
    parts = np.empty(int(np.prod(shape)), object)
    for k, value in enumerate(values):
        parts[k] = value
    return Lanes(
        parts.reshape(*shape, 1, 1), (*shape, FINGER if wide else 1, WORLD), parts[0].dtype
    )


def lanewise(function: Callable, *args: Any) -> Any:
    """Returns function(*args), where the arrays in args and in the result are `Lanes`.

    Raises:
      NotImplementedError: If the function does something other than arithmetic and rearranging of
        components, such as a sum over fingers.
    """
    leaves, tree = jax.tree.flatten(args, is_leaf=lambda x: isinstance(x, Lanes))
    try:
        call, values = _Call.of(function, tree, leaves)
    except identity.NoIdentity:
        return _components(function, tree, leaves)
    return _program(call)(values)


def _components(function: Callable, tree: Any, leaves: list) -> Any:
    """`lanewise`, traced anew."""
    mine = [i for i, leaf in enumerate(leaves) if isinstance(leaf, Lanes)]

    def flat(*arrays: jax.Array) -> Any:
        filled = list(leaves)
        for i, array in zip(mine, arrays, strict=True):
            filled[i] = array
        return function(*jax.tree.unflatten(tree, filled))

    avals = [jax.ShapeDtypeStruct(leaves[i].shape, leaves[i].dtype) for i in mine]
    jaxpr, out = jax.make_jaxpr(flat, return_shape=True)(*avals)
    parts = _evaluate(jaxpr.jaxpr, jaxpr.consts, [leaves[i].parts for i in mine])
    shapes, out_tree = jax.tree.flatten(out)
    results = [Lanes(p, s.shape, s.dtype) for p, s in zip(parts, shapes, strict=True)]
    return jax.tree.unflatten(out_tree, results)


@dataclasses.dataclass(frozen=True)
class _Call:
    """A call of `lanewise`; calls of one key are one program of their values."""

    key: tuple
    function: Callable = dataclasses.field(compare=False)
    tree: Any = dataclasses.field(compare=False)
    leaves: list = dataclasses.field(compare=False)

    @classmethod
    def of(cls, function: Callable, tree: Any, leaves: list) -> tuple["_Call", list]:
        """Takes the leaves apart into numbers and types, which are the key, and values.

        Raises:
          NoIdentity: If the function, or an argument that is not lanes, has none.
        """
        places: dict[int, int] = {}
        values: list = []
        shells: list = []
        key = [identity.of(function), tree, jax.config.jax_enable_x64]
        for leaf in leaves:
            if isinstance(leaf, Lanes):
                leaf = _emptied(leaf, values, places)
                key += [leaf.shape, leaf.dtype, *map(identity.of, leaf.parts.ravel())]
            else:
                key.append(identity.of(leaf))
            shells.append(leaf)
        key += [jax.typeof(v) for v in values]
        return cls(tuple(key), function, tree, shells), values


class _Place(int):
    """Stands for the value of this number in the components of `Lanes`."""


@functools.lru_cache(maxsize=1024)
def _program(call: _Call) -> Callable[[list], Any]:
    """What calls of one key compute, traced once; JAX finds its operations as one of its own.

    Tracing is most of the time that a kernel takes to compile, and its functions come again: for
    each pair of bodies, and in the kernel of the next scene.
    """
    found: list = []  # as the function is traced: its result, with places instead of values

    def run(*values: Any) -> list:
        filled = [
            Lanes(_fill(x.parts, values), x.shape, x.dtype) if isinstance(x, Lanes) else x
            for x in call.leaves
        ]
        out = _components(call.function, call.tree, filled)
        leaves, tree = jax.tree.flatten(out, is_leaf=lambda x: isinstance(x, Lanes))
        arrays: list = []
        places: dict[int, int] = {}
        found[:] = [_emptied(leaf, arrays, places) for leaf in leaves], tree
        return arrays

    run.__name__ = getattr(call.function, "__name__", "lanewise")
    jitted = jax.jit(run)

    def use(values: list) -> Any:
        arrays = jitted(*values)
        shells, tree = found
        leaves = [Lanes(_fill(x.parts, arrays), x.shape, x.dtype) for x in shells]
        return jax.tree.unflatten(tree, leaves)

    return use


def _emptied(leaf: Lanes, values: list, places: dict[int, int]) -> Lanes:
    """Lanes with places instead of values, which go to the end of a list; `places` by identity."""
    parts = leaf.parts.copy()
    for at, part in np.ndenumerate(parts):
        if not _is_number(part):
            if id(part) not in places:
                places[id(part)] = len(values)
                values.append(part)
            parts[at] = _Place(places[id(part)])
    return Lanes(parts, leaf.shape, leaf.dtype)


def _fill(parts: np.ndarray, values: Any) -> np.ndarray:
    """Components with values in their places."""
    filled = np.empty(parts.shape, object)
    for at, part in np.ndenumerate(parts):
        filled[at] = values[part] if isinstance(part, _Place) else part
    return filled


def _small(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Shape of the components: lane axes have length one."""
    return tuple(1 if n in (FINGER, WORLD) else n for n in shape)


def _constant(value: Any) -> np.ndarray:
    """Components of a literal or captured array."""
    array = np.asarray(value)
    parts = np.empty(_small(array.shape), object)
    for index in np.ndindex(parts.shape):
        parts[index] = array[index]
    return parts


def _evaluate(jaxpr: Any, consts: Any, args: list[np.ndarray]) -> list[np.ndarray]:
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
    name, params = equation.primitive.name, equation.params
    for key in ("jaxpr", "call_jaxpr"):
        if name in ("jit", "pjit", "closed_call", "custom_jvp_call", "remat2", "checkpoint"):
            if key in params:
                inner = params[key]
                consts = getattr(inner, "consts", ())
                return _evaluate(getattr(inner, "jaxpr", inner), consts, inputs)
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

    def each(*parts: Any) -> Any:
        if all(map(_is_number, parts)):
            return _fold(equation, parts)
        if rule is not None:
            simple = rule(*parts, **{"y": params["y"]} if name == "integer_pow" else {})
            if simple is not None:
                return simple
        return _bind(equation, parts)

    return [_each(each, inputs, shape)]


def _each(function: Callable, inputs: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    result = np.empty(shape, object)
    inputs = [np.broadcast_to(x, shape) for x in inputs]
    for index in np.ndindex(shape):
        result[index] = function(*(x[index] for x in inputs))
    return result


def _is_number(x: Any) -> bool:
    return isinstance(x, bool | int | float | np.generic) or (
        isinstance(x, np.ndarray) and x.ndim == 0
    )


def _fold(equation: Any, parts: tuple) -> Any:
    """Result of an operation on numbers, at trace time."""
    types = [v.aval.dtype for v in equation.invars]
    with jax.ensure_compile_time_eval():
        arrays = [np.asarray(p, t) for p, t in zip(parts, types, strict=True)]
        if equation.primitive.name == "convert_element_type":
            return arrays[0].astype(equation.params["new_dtype"])[()]
        return np.asarray(equation.primitive.bind(*arrays, **equation.params))[()]


def _bind(equation: Any, parts: tuple) -> Any:
    """The operation on lanes, to which numbers are spread."""
    shape = next(p.shape for p in parts if not _is_number(p))
    arrays = [splat(p, shape, v.aval.dtype) for p, v in zip(parts, equation.invars, strict=True)]
    return equation.primitive.bind(*arrays, **equation.params)


def splat(part: Any, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    """A number as lanes; lanes as they are."""
    return jax.lax.full(shape, np.asarray(part, dtype)) if _is_number(part) else part


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
    return _is_number(x) and float(x) == number


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
    if _is_number(which):
        return yes if which else no
    return no if no is yes else None


def _and(a: Any, b: Any) -> Any:
    if _is_number(a):
        return b if a else False
    return (a if b else False) if _is_number(b) else None


def _or(a: Any, b: Any) -> Any:
    if _is_number(a):
        return True if a else b
    return (True if b else a) if _is_number(b) else None


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
