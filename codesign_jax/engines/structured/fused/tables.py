"""Named numbers in a kernel's memory, and loops that carry them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanewise import Lanes, lanes, spread


class Table:
    """Names of the rows of an array (block, row, finger or 1, world of the block).

    A block's numbers lie together in memory; one row is a number of every lane.
    """

    def __init__(self, wide: bool, **groups: tuple[int, tuple[int, ...]]):
        """Lays the table out.

        Args:
          wide: Whether a row has a value for each finger and not only for each world.
          **groups: Number of items (links, slots) and shape of an item, by name.
        """
        self.wide, self.groups, self.offset, self.rows = wide, groups, {}, 0
        for name, (count, shape) in groups.items():
            self.offset[name] = self.rows
            self.rows += count * int(np.prod(shape))

    def pack(self, fingers: int, block: int, **arrays: jax.Array) -> jax.Array:
        """The table of arrays (item, component, ..., finger or 1, world), worlds padded to blocks.

        Padded worlds and fingers repeat the last one.
        """
        rows = []
        for name, (count, shape) in self.groups.items():
            array = arrays[name]
            flat = array.reshape(count * int(np.prod(shape)), *array.shape[-2:])
            rows.append(flat)
        stacked = jnp.concatenate(rows)
        missing = fingers - stacked.shape[1] if self.wide else 0
        pad = [(0, 0), (0, missing), (0, -stacked.shape[2] % block)]
        stacked = jnp.pad(stacked, pad, mode="edge")
        blocks = stacked.reshape(*stacked.shape[:2], -1, block)
        return jnp.moveaxis(blocks, 2, 0)

    def _row(self, name: str, item: Any) -> tuple[Any, tuple[int, ...]]:
        _, shape = self.groups[name]
        return self.offset[name] + item * int(np.prod(shape)), shape

    def read(self, ref: Any, name: str, item: Any = 0) -> Lanes:
        """Lanes of an item."""
        row, shape = self._row(name, item)
        return lanes([ref[row + k] for k in range(int(np.prod(shape)))], shape, wide=self.wide)

    def write(self, ref: Any, name: str, value: Lanes, item: Any = 0) -> None:
        """Stores an item."""
        row, _ = self._row(name, item)
        lanes_shape = ref.shape[1:]
        for k, part in enumerate(value.parts.ravel()):
            ref[row + k] = spread(part, lanes_shape, value.dtype)


def solid(tree: Any, fingers: int, block: int) -> tuple[list[jax.Array], Callable]:
    """Arrays of a tree of lanes, numbers filled in, and the function that rebuilds the tree."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=lambda x: isinstance(x, Lanes))
    arrays: list[jax.Array] = []
    for leaf in leaves:
        wide = leaf.shape[-2] != 1
        shape = (fingers if wide else 1, block)
        arrays += [spread(p, shape, leaf.dtype) for p in leaf.parts.ravel()]

    def rebuild(values: Any) -> Any:
        rest, new = list(values), []
        for leaf in leaves:
            parts = np.empty(leaf.parts.size, object)
            for k in range(parts.size):
                parts[k] = rest.pop(0)
            new.append(Lanes(parts.reshape(leaf.parts.shape), leaf.shape, leaf.dtype))
        return jax.tree.unflatten(structure, new)

    return arrays, rebuild


_UPPER = np.triu_indices(6)


def upper(matrix: Lanes) -> Lanes:
    """Upper triangle of a symmetric (6, 6) matrix, 21 components."""
    return Lanes(matrix.parts[_UPPER], (21, *matrix.shape[2:]), matrix.dtype)


def full(triangle: Lanes) -> Lanes:
    """Symmetric (6, 6) matrix of its upper triangle."""
    parts = np.empty((6, 6, 1, 1), object)
    for value, i, j in zip(triangle.parts.ravel(), *_UPPER, strict=True):
        parts[i, j, 0, 0] = parts[j, i, 0, 0] = value
    return Lanes(parts, (6, 6, *triangle.shape[1:]), triangle.dtype)


def sum_lanes(value: Lanes) -> Lanes:
    """Sum over the fingers."""
    parts = np.empty(value.parts.shape, object)
    for index, part in np.ndenumerate(value.parts):
        parts[index] = part.sum(0, keepdims=True)
    return Lanes(parts, (*value.shape[:-2], 1, value.shape[-1]), value.dtype)


def anywhere(mask: jax.Array) -> jax.Array:
    """Whether any lane is true, a scalar."""
    return jnp.max(jnp.max(mask.astype(jnp.int32), axis=1), axis=0) > 0
