"""Shared memory of a GPU: what lies there, and the teams of lanes that share a finger's work.

A team is several lanes.  A warp of one world has 37 kB of numbers where one of eight worlds, a lane
a finger, has half a megabyte, far more than a multiprocessor's cache.  The lanes of a team share a
column of each table.  What is not shared out is computed by all of them, with the same bits.

* Matrices: lane k < 6 has column k of P, C and Q, and lane 6 has the forces r and r_o, see
  `elimination`.  One recursion P -= U'W, Q -= H'G then updates the forces as well, if G of lane 6
  is -z.  Rows that all lanes need (U and H, three numbers a column) go through shared memory.
* Right sides: lane k < 6 has component k; products are sums over the team.
* Contacts: slot or ring k is lane k modulo the team's.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.components import splat
from codesign_jax.engines.structured.kernel.memory import Block, BoundTable
from codesign_jax.engines.structured.kernel.rows import Again, Scratch
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.scene import Scene

TEAM = 8
"""Lanes of a team: six columns, the forces, and one for a second right side."""
FORCES = 6
AGAIN = 7
"""Lanes of the forces, and of conjugate gradients' right side in the rows of w."""
WARP = 32
UNUSED = (Scratch.body_centre, Scratch.tensor, Scratch.z, Again.z_again)
"""Rows of the links' scratch memory that only the solver of single lanes has."""


def lanes_of_a_finger(scene: Scene, backend: str, fingers: int) -> int:
    """How many lanes share a finger's work: `TEAM` or 1.

    It follows from the scene's structure and the backend alone, since last bits depend on it.
    """
    e = scene.effects
    coupled = e.finger_finger and scene.num_fingers > 1
    return TEAM if backend == "gpu" and coupled and fingers * TEAM <= WARP else 1


class SharedColumns:
    """Reference to a table of fingers, of which the lanes of a team share a column."""

    def __init__(self, block: Block, ref: Any):
        self.ref = ref
        self.column = block.column
        self.dtype = ref.dtype
        self.shape = (*ref.shape[:-1], block.size)

    def _at(self, index: Any) -> tuple:
        index = index if isinstance(index, tuple) else (index,)
        return index if len(index) == len(self.shape) else (*index, self.column)

    def __getitem__(self, index: Any) -> jax.Array:
        """The lanes' elements; without a last index those of their own column."""
        return self.ref[self._at(index)]

    def __setitem__(self, index: Any, value: jax.Array) -> None:
        """Stores elements; lanes that share one store the same bits."""
        self.ref[self._at(index)] = value


class TeamRows:
    """Reads and writes a table's rows by the lanes of a team, each its own row."""

    def __init__(self, block: Block, table: BoundTable):
        self.block = block
        self.layout = table.layout
        self.ref = table.ref

    def _at(self, name: str, item: Any, first: int, step: int) -> tuple:
        row = item * self.layout.stride[name] + self.block.mate * step
        return row + (self.layout.offset[name] + first), self.block.column

    def get(self, name: str, item: Any = 0, first: int = 0, step: int = 1) -> jax.Array:
        """Row `first` + lane * `step` of an item, shape (lane,)."""
        return self.ref[self._at(name, item, first, step)]

    def put(self, name: str, value: jax.Array, item: Any = 0, first: int = 0) -> None:
        """Stores it in row `first` + lane."""
        self.ref[self._at(name, item, first, 1)] = value

    def rows(self, name: str, item: Any = 0) -> Lanes:
        """The lane's column of a matrix, shape (row,)."""
        count = self.layout.groups[name][1][0]
        parts = [self.get(name, item, TEAM * k) for k in range(count)]
        return lanes(parts, (count,), wide=True)

    def put_rows(self, name: str, value: Lanes, item: Any = 0) -> None:
        """Stores an item whose components lie one behind the other, `TEAM` columns each.

        Args:
          name: The row.
          value: Lanes of the item's shape.
          item: Number of the item.
        """
        for k, part in enumerate(value.parts.ravel()):
            self.put(name, splat(part, (self.block.size,), value.dtype), item, TEAM * k)


def team_sum(block: Block, value: Lanes) -> Lanes:
    """Sums over the team of components, wide."""
    parts = [block.over_team(p, jnp.add) for p in value.parts.ravel()]
    return lanes(parts, value.shape[:-2], wide=True)


def where(mask: jax.Array, first: Any, second: Any) -> Any:
    """Trees of lanes, `first` where a mask (lane,) holds, else `second`."""
    which = lanes([mask], (), wide=True)
    return lanewise(lambda w, a, b: jax.tree.map(partial(jnp.where, w), a, b), which, first, second)


def chosen(block: Block, values: Lanes, otherwise: Any = 0.0) -> jax.Array:
    """Component k of six values on lane k, shape (lane,)."""
    parts = list(values.parts.ravel())
    component = otherwise
    for k, part in enumerate(parts):
        component = jnp.where(block.mate == k, part, component)
    return component


def ranks(block: Block, which: jax.Array) -> tuple[jax.Array, jax.Array]:
    """How many lanes of a team before each one are true, and how many of all."""
    bit = jnp.left_shift(jnp.ones_like(block.mate), block.mate)
    bits = block.over_team(jnp.where(which, bit, 0), jnp.add)
    count = jax.lax.population_count
    return count(bits & (bit - 1)), count(bits)
