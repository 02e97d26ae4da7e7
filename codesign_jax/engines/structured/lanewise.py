"""Evaluates functions of lane arrays component by component, inside kernels without small arrays.

A GPU kernel keeps each number of a small matrix in a register of its own and has no stack, slice or
concatenation.  The physics is written once, on arrays such as (6, 6, finger, world); here its jaxpr
is evaluated with every component as a separate value over the lanes (finger, world), so that all
rearranging happens at trace time and only arithmetic is left.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from codesign_jax.compiler.straight_line import StraightLine
from codesign_jax.engines.structured import identity
from codesign_jax.engines.structured.components import FINGER, WORLD, evaluate, is_number


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
        self.parts = parts
        self.shape = shape
        self.dtype = np.dtype(dtype)

    def __getitem__(self, index: Any) -> "Lanes":
        """Components along the leading axes that are not lanes."""
        parts = self.parts[index]
        return Lanes(parts, (*parts.shape[:-2], *self.shape[-2:]), self.dtype)

    @property
    def lane(self) -> Any:
        return self.parts.item()


def lanes(values: Any, shape: tuple[int, ...], *, wide: bool) -> Lanes:
    """Lanes of components given flat, of a finger each (wide) or of a world.

    Args:
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
    mine = [i for i, leaf in enumerate(leaves) if isinstance(leaf, Lanes)]

    def flat(*arrays: jax.Array) -> Any:
        filled = list(leaves)
        for i, array in zip(mine, arrays, strict=True):
            filled[i] = array
        return function(*jax.tree.unflatten(tree, filled))

    avals = [jax.ShapeDtypeStruct(leaves[i].shape, leaves[i].dtype) for i in mine]
    jaxpr, out = jax.make_jaxpr(flat, return_shape=True)(*avals)
    parts = evaluate(jaxpr.jaxpr, jaxpr.consts, [leaves[i].parts for i in mine])
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
        wide = jax.config.jax_enable_x64  # type: ignore[attr-defined]  # set when JAX starts
        key = [identity.of(function), tree, wide]
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
    """What calls of one key compute: one operation of JAX, recorded once.

    Tracing is most of the time that a kernel takes to compile, and its functions come again: for
    each pair of bodies, and in the kernel of the next scene.
    """
    recorded: list = []  # The program, and the function's result with places instead of values

    def record(values: list) -> None:
        line = StraightLine(values)
        filled = [
            Lanes(_fill(x.parts, line.arguments), x.shape, x.dtype) if isinstance(x, Lanes) else x
            for x in call.leaves
        ]
        out = _components(call.function, call.tree, filled)
        leaves, tree = jax.tree.flatten(out, is_leaf=lambda x: isinstance(x, Lanes))
        symbols: list = []
        places: dict[int, int] = {}
        shells = [_emptied(leaf, symbols, places) for leaf in leaves]
        line.end(symbols)
        recorded[:] = line, shells, tree

    def use(values: list) -> Any:
        if not recorded:
            record(values)
        line, shells, tree = recorded
        arrays = line.bind(values)
        leaves = [Lanes(_fill(x.parts, arrays), x.shape, x.dtype) for x in shells]
        return jax.tree.unflatten(tree, leaves)

    return use


_code: list[str | None] = [None]  # digest of the code that `_program` traced


def of_code(digest: str | None) -> None:
    """Forgets what was traced of other code than this `reuse.code_digest`; None: it is not known.

    The key of a call has the code of its function, but not of the functions that this one calls.
    """
    if digest is None or digest != _code[0]:
        _program.cache_clear()
    _code[0] = digest


def _emptied(leaf: Lanes, values: list, places: dict[int, int]) -> Lanes:
    """Lanes with places instead of values, which go to the end of a list; `places` by identity."""
    parts = leaf.parts.copy()
    for at, part in np.ndenumerate(parts):
        if not is_number(part):
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
