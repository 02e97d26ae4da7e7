"""Named numbers in a kernel's memory, and loops that carry them."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.components import splat
from codesign_jax.engines.structured.lanewise import Lanes, lanes


class MemoryLayout:
    """Names of the rows of an array (block, row, lane or world of the block).

    A block's numbers lie together in memory; one row is a number of every lane or world.
    """

    def __init__(self, wide: bool, **groups: tuple[int, tuple[int, ...]]):
        """Lays the table out, name by name.

        Args:
          wide: Whether a row has a value for each finger and not only for each world.
          **groups: Number of items (links, slots) and shape of an item, by name.
        """
        self.wide = wide
        self.groups = groups
        self.rows = 0
        self.offset: dict[str, int] = {}
        self.stride = {name: int(np.prod(shape)) for name, (_, shape) in groups.items()}
        for name, (count, _) in groups.items():
            self.offset[name] = self.rows
            self.rows += count * self.stride[name]

    @classmethod
    def by_item(cls, wide: bool, **groups: tuple[int, tuple[int, ...]]) -> "MemoryLayout":
        """Lays out a table item by item, which `pack` and `unpack` cannot be used with.

        Names with the same part before the dot, or without one, and with the same number of items
        belong to the same items. A kernel finds all numbers of a slot or of a link at fixed
        distances from one address.
        """
        table = cls(wide, **groups)
        names_by_items = {}
        for name, (count, _) in groups.items():
            names_by_items.setdefault((name.rpartition(".")[0], count), []).append(name)
        table.rows = 0
        for (_, count), names in names_by_items.items():
            sizes = {name: table.stride[name] for name in names}
            for name in names:
                table.offset[name] = table.rows
                table.stride[name] = sum(sizes.values())
                table.rows += sizes[name]
            table.rows += (count - 1) * sum(sizes.values())
        return table

    def pack(self, fingers: int, block: int, **arrays: jax.Array) -> jax.Array:
        """The table of arrays (item, component, ..., finger or 1, world), worlds padded to blocks.

        Padded worlds and fingers repeat the last one.  An item's axis may be left out where there
        is one item only.
        """
        rows = []
        for name, (count, shape) in self.groups.items():
            array = arrays[name]
            axes = array.shape[:-2]
            assert axes == (count, *shape) or (count == 1 and axes == shape), (name, axes)
            flat = array.reshape(count * int(np.prod(shape)), *array.shape[-2:])
            rows.append(flat)
        stacked = jnp.concatenate(rows)
        if self.wide:
            stacked = lengthen(stacked, 1, fingers)
        stacked = lengthen(stacked, 2, stacked.shape[2] + -stacked.shape[2] % block)
        blocks = stacked.reshape(*stacked.shape[:2], -1, block)
        return jnp.moveaxis(blocks, 2, 0).reshape(blocks.shape[2], self.rows, -1)

    def unpack(
        self, packed: jax.Array, fingers: int, kept: int, worlds: int
    ) -> dict[str, jax.Array]:
        """Inverse of `pack`: arrays (item, component, ..., finger or 1, world) by name.

        Kept are the first `kept` of the fingers and `worlds`, without what fills up.  An item's
        axis is left out where there is one item only.
        """
        blocks = packed.reshape(packed.shape[0], self.rows, fingers, -1)
        flat = jnp.moveaxis(blocks, 0, 2).reshape(self.rows, fingers, -1)[:, :kept, :worlds]
        arrays = {}
        for name, (count, shape) in self.groups.items():
            size = count * int(np.prod(shape))
            first = self.offset[name]
            items = (count, *shape) if self.wide else shape
            arrays[name] = flat[first : first + size].reshape(*items, kept, worlds)
        return arrays


class BoundTable:
    """A table in a kernel: its layout, and the reference to its memory.

    Attributes:
      layout: The rows.
      ref: Pallas' reference.
      world: World of each lane, shape (lane,), for a table of worlds.
    """

    def __init__(self, layout: MemoryLayout, ref: Any, world: jax.Array | None = None):
        self.layout = layout
        self.ref = ref
        self.world = world
        self.dtype = ref.dtype

    def __contains__(self, name: str) -> bool:
        return name in self.layout.groups

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of an item of a row."""
        return self.layout.groups[name][1]

    def _rows(self, name: str, item: Any) -> Iterator[Any]:
        first = self.layout.offset[name] + item * self.layout.stride[name]
        places = range(math.prod(self.shape(name)))
        if isinstance(first, jax.core.Tracer) and not first.shape:
            # Thousands of sums: as operators they take JAX three times as long to trace.
            return (jax.lax.add(first, first.dtype.type(k)) for k in places)
        return (first + k for k in places)

    def read(self, name: str, item: Any = 0) -> Lanes:
        """An item of a row, lanes of the item's shape.

        Args:
          name: The row, a `rows.Field`.
          item: Number of the item, the same for all lanes: an integer or a scalar.
        """
        where = () if self.layout.wide else (self.world,)
        values = [self.ref[(row, *where)] for row in self._rows(name, item)]
        return lanes(values, self.shape(name), wide=self.layout.wide)

    def write(self, name: str, value: Lanes, item: Any = 0) -> None:
        """Stores an item; the lanes of a world store the same number."""
        where = () if self.layout.wide else (self.world,)
        size = self.ref.shape[-1:] if self.layout.wide else self.world.shape  # type: ignore[union-attr]
        for row, part in zip(self._rows(name, item), value.parts.ravel(), strict=True):
            self.ref[(row, *where)] = splat(part, size, value.dtype)

    def number(self, name: str, item: Any, lane: Any) -> jax.Array:
        """The number of one lane, a scalar, of an item with one component."""
        (row,) = self._rows(name, item)
        return self.ref[row, lane]

    def gather(self, name: str, item: jax.Array, lane: jax.Array) -> Lanes:
        """Each lane's item of a lane, of a table of fingers; both are int32 of shape (lane,)."""
        values = [self.ref[row, lane] for row in self._rows(name, item)]
        return lanes(values, self.shape(name), wide=True)

    def scatter(self, name: str, value: Lanes, item: jax.Array, lane: jax.Array) -> None:
        """Stores each lane's value in the item of a lane, inverse of `gather`.

        Args:
          name: The row, of a table of fingers.
          value: Lanes of the item's shape.
          item: Number of each lane's item, int32 of shape (lane,).
          lane: Lane to which each value goes, likewise.
        """
        for row, part in zip(self._rows(name, item), value.parts.ravel(), strict=True):
            self.ref[row, lane] = splat(part, lane.shape, value.dtype)


class TimeStep:
    """Reference to a table of one time step, of an array (time, row, lane)."""

    def __init__(self, ref: Any, t: jax.Array):
        self.ref = ref
        self.t = t
        self.dtype = ref.dtype
        self.shape = ref.shape[1:]

    def _at(self, index: Any) -> tuple:
        return (self.t, *index) if isinstance(index, tuple) else (self.t, index)

    def __getitem__(self, index: Any) -> jax.Array:
        return self.ref[self._at(index)]

    def __setitem__(self, index: Any, value: jax.Array) -> None:
        self.ref[self._at(index)] = value


def lengthen(array: jax.Array, axis: int, length: int) -> jax.Array:
    """Repeats an array's last item along an axis up to a length; `jnp.pad` is 20 operations."""
    missing = length - array.shape[axis]
    if not missing:
        return array
    last = jax.lax.slice_in_dim(array, -1, None, axis=axis)
    shape = list(array.shape)
    shape[axis] = missing
    return jnp.concatenate([array, jnp.broadcast_to(last, shape)], axis)


def tree_add_scaled(alpha: jax.Array, value: Any, step: Any) -> Any:
    """Value + alpha * step for two trees of one structure, leaf by leaf."""
    return jax.tree.map(lambda v, s: v + alpha * s, value, step)


def choose(which: jax.Array, compute: Callable, otherwise: Any, size: int) -> Any:
    """compute() where a scalar is true, else a tree of lanes of the same structure, as it is."""
    arrays, rebuild = solid(otherwise, size)
    some = lambda: solid(compute(), size)[0]  # noqa: E731
    return rebuild(jax.lax.cond(which, some, lambda: arrays))


def either(which: jax.Array, first: Callable, second: Callable, size: int) -> Any:
    """first() where a scalar is true, else second(): trees of lanes of the same structure."""
    rebuilders: list[Callable] = []

    def run(compute: Callable) -> list[jax.Array]:
        arrays, rebuild = solid(compute(), size)
        rebuilders.append(rebuild)
        return arrays

    arrays = jax.lax.cond(which, lambda: run(first), lambda: run(second))
    return rebuilders[0](arrays)


def solid(tree: Any, size: int) -> tuple[list[jax.Array], Callable]:
    """Arrays (size,) of a tree of lanes, numbers filled in, and what rebuilds the tree."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=lambda x: isinstance(x, Lanes))
    arrays: list[jax.Array] = []
    for leaf in leaves:
        arrays += [splat(p, (size,), leaf.dtype) for p in leaf.parts.ravel()]

    def rebuild(values: Any) -> Any:
        rest = list(values)
        new = []
        for leaf in leaves:
            parts = np.empty(leaf.parts.size, object)
            for k in range(parts.size):
                parts[k] = rest.pop(0)
            new.append(Lanes(parts.reshape(leaf.parts.shape), leaf.shape, leaf.dtype))
        return jax.tree.unflatten(structure, new)

    return arrays, rebuild


def loop(count: int, body: Callable, start: Any, size: int, *, reverse: bool = False):
    """Folds body(item, tree of lanes) over the items."""
    first, rebuild = solid(start, size)

    def step(k: jax.Array, arrays: list) -> list:
        item = count - 1 - k if reverse else k
        return solid(body(item, rebuild(arrays)), size)[0]

    return rebuild(jax.lax.fori_loop(0, count, step, first))


def each(count: int, body: Callable[[Any], None]) -> None:
    """Runs body(item), which stores something, for all items; item: int32, a scalar."""

    def step(k: jax.Array, x: jax.Array) -> jax.Array:
        body(k)
        return x

    jax.lax.fori_loop(0, count, step, jnp.int32(0))


def upper(matrix: Lanes) -> Lanes:
    """Upper triangle of a symmetric (n, n) matrix, n (n + 1) / 2 components."""
    n = matrix.shape[0]
    return Lanes(
        matrix.parts[np.triu_indices(n)], (n * (n + 1) // 2, *matrix.shape[2:]), matrix.dtype
    )


def full(triangle: Lanes) -> Lanes:
    """Symmetric (n, n) matrix of its upper triangle."""
    n = (math.isqrt(8 * triangle.shape[0] + 1) - 1) // 2
    parts = np.empty((n, n, 1, 1), object)
    for value, i, j in zip(triangle.parts.ravel(), *np.triu_indices(n), strict=True):
        parts[i, j, 0, 0] = parts[j, i, 0, 0] = value
    return Lanes(parts, (n, n, *triangle.shape[1:]), triangle.dtype)


class Block:
    """The lanes of a block: finger by finger, the worlds of a finger together.

    Attributes:
      fingers: Number of fingers, a power of two.
      worlds: Number of worlds.
      team: Lanes that share the work of a finger, a power of two; see `shared_memory`.
      size: Number of lanes.
      lane: The lanes, shape (lane,).
      world: World of each lane, shape (lane,).
      finger: Finger of each lane, shape (lane,).
      mate: Number of each lane in its team, shape (lane,); `column`: of its finger in tables.
    """

    def __init__(self, fingers: int, worlds: int, team: int = 1):
        self.fingers = fingers
        self.worlds = worlds
        self.team = team
        self.size = fingers * worlds * team
        self.lane = lane = jax.lax.broadcasted_iota(jnp.int32, (self.size,), 0)
        count = jnp.int32(worlds)
        self.world = jax.lax.rem(lane, count)
        self.finger = jax.lax.div(lane, count)
        self.column = lane
        if team > 1:
            self.mate = jax.lax.rem(self.finger, jnp.int32(team))
            self.finger = jax.lax.div(self.finger, jnp.int32(team))
            self.column = self.finger * worlds + self.world

    def over_team(self, array: jax.Array, combine: Callable) -> jax.Array:
        """`fold` over the lanes of each team."""
        return self._swapped(array, combine, self.worlds, self.worlds * self.team)

    def total(self, array: jax.Array) -> jax.Array:
        """Sum of an array (lane,) over all lanes of each world, on all of them."""
        return self.fold(self.over_team(array, jnp.add), jnp.add)

    def dealt(self, count: int, k: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        """The item of each lane in round k when a team shares `count`, and which lanes have one."""
        if self.team == 1:
            return k, None
        item = k * self.team + self.mate
        return jnp.minimum(item, count - 1), item < count

    def rounds(self, count: int) -> int:
        """How many rounds a team needs for so many items, one item a lane and round."""
        return -(-count // self.team)

    def fold(self, array: jax.Array, combine: Callable) -> jax.Array:
        """Every finger's value combined, on all lanes of the world.

        Lanes swap their values in pairs of fingers, then in pairs of pairs: combine(a, b) has to
        equal combine(b, a), so that all lanes of a world get the same bits.
        """
        return self._swapped(array, combine, self.worlds * self.team, self.size)

    def _swapped(self, array: jax.Array, combine: Callable, first: int, end: int) -> jax.Array:
        distance = first
        while distance < end:
            pairs = array.reshape(-1, 2, distance)
            array = combine(array, jax.lax.rev(pairs, (1,)).reshape(self.size))
            distance *= 2
        return array

    def sum(self, tree: Any) -> Any:
        """Sums over the fingers of a tree of lanes."""
        arrays, rebuild = solid(tree, self.size)
        sums = [self.fold(array, jnp.add) for array in arrays]

        def narrow(value: Lanes) -> Lanes:
            return Lanes(value.parts, (*value.shape[:-2], 1, value.shape[-1]), value.dtype)

        return jax.tree.map(narrow, rebuild(sums), is_leaf=lambda x: isinstance(x, Lanes))


def zeros(shape: tuple[int, ...], like: jax.Array) -> Lanes:
    """Lanes of zeros of a finger each, like an array over the lanes."""
    return lanes([jnp.zeros_like(like)] * math.prod(shape), shape, wide=True)


def any_of(which: jax.Array, then: Callable[[], None]) -> None:
    """Runs what stores something, if any lane is true."""
    jax.lax.cond(anywhere(which), then, lambda: None)


def anywhere(mask: jax.Array) -> jax.Array:
    """Whether a mask (lane,) holds on any lane, a scalar."""
    return jnp.max(mask.astype(jnp.int32)) > 0
