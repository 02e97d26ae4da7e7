"""Where the contacts of a pair of bodies are in memory, and the items of a pass over them.

There are two placements.  With `Fixed` each link, group or ring has a place, whether it touches or
not.  With `Appended` few of the many places that may touch do, and only those get a slot: every
lane fills the slots of a row from the first one on, and a loop over the slots of a row runs to the
largest number that any active lane has filled.  Its cost therefore grows with the contacts that
exist in worlds that still iterate, not with those that are possible.

The items of either may be dealt to the lanes of a team, see `shared_memory`, one a lane and round.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.memory import Block, BoundTable, loop, solid, zeros
from codesign_jax.engines.structured.kernel.rows import Contact, Group, SlotCount
from codesign_jax.engines.structured.kernel.shared_memory import ranks
from codesign_jax.engines.structured.lanes import total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise


class Item(NamedTuple):
    """One contact, or the few of a link or of a group, in a pass over a pair of bodies.

    Where lanes have items of their own, those that a pass is not for read an item where nothing
    touches, the same for all of them, and write to one that nobody reads. So a GPU's memory, which
    is what its threads wait for, is asked for little that no lane uses.
    """

    source: Any  # Item that is read: a scalar, or int32 of shape (lane,) if lanes have their own
    sink: Any  # Item that is written, likewise
    number: Any = None  # Link, group or ring of a contact with a fixed place, likewise
    pairing: Any = None  # `pairing.FingerPairing` of a contact of the hand with itself
    cone: Any = None  # The contact's cone, where those of a pair of bodies differ


def at(number: Any) -> Item:
    """The item of a link or a group, the same on all lanes."""
    return Item(number, number, number)


class SlotCounts:
    """Numbers of the slots that lanes have filled: those of all rows in a few integers a lane.

    Every pass through the contacts asks for them. Read from memory, a GPU's thread would wait for
    each of them before it knows whether a row has any contact.

    Attributes:
      words: The integers, int32 of shape (lane,) each.
    """

    def __init__(self, words: list[jax.Array], most: int):
        self.words = words
        self._most = most
        self._bits, self._each = _sizes(most)

    @classmethod
    def of_rows(cls, counts: list[jax.Array], most: int) -> "SlotCounts":
        """Packs the rows' numbers, from 0 to `most`, int32 of shape (lane,) each."""
        bits, each = _sizes(most)
        parts = [counts[start : start + each] for start in range(0, len(counts), each)]
        words = [total([n * (1 << bits * k) for k, n in enumerate(part)]) for part in parts]
        return cls(words, most)

    def masked(self, chosen: jax.Array) -> "SlotCounts":
        """The numbers of the lanes of a mask, zero on others."""
        return SlotCounts([jnp.where(chosen, word, 0) for word in self.words], self._most)

    def of(self, slot_row: jax.typing.ArrayLike) -> jax.Array:
        """Numbers of a row of slots, shape (lane,); slot_row: the row's number, a scalar."""
        slot_row = jnp.asarray(slot_row, jnp.int32)
        each = jnp.int32(self._each)
        which = jax.lax.div(slot_row, each)
        place = jax.lax.rem(slot_row, each)
        word = self.words[0]
        for k, other in enumerate(self.words[1:], 1):
            word = jnp.where(which == k, other, word)
        distance = jnp.full_like(word, self._bits * place)
        return jax.lax.shift_right_logical(word, distance) & ((1 << self._bits) - 1)


def _sizes(most: int) -> tuple[int, int]:
    """Bits of a row's number, and rows of an integer, whose sign stays free."""
    bits = most.bit_length()
    return bits, 31 // bits


class Cells(NamedTuple):
    """The memory of a pair's contacts: their rows in a table, and how many slots are filled."""

    table: BoundTable
    name: str  # What stands before the names of the rows
    block: Block  # The lanes
    filled: SlotCounts | None = None  # With `Appended`, once all contacts are found

    @property
    def like(self) -> jax.Array:
        """Zeros of the lanes' shape and type."""
        return jnp.zeros((self.block.size,), self.table.dtype)

    def read(self, field: str, item: Item) -> Lanes:
        """A field of an item, lanes of the item's shape."""
        name = f"{self.name}.{field}"
        if not jnp.ndim(item.source):
            return self.table.read(name, item.source)
        return self.table.gather(name, item.source, self.block.column)

    def write(self, field: str, value: Lanes, item: Item) -> None:
        """Stores a field of an item."""
        name = f"{self.name}.{field}"
        if not jnp.ndim(item.sink):
            self.table.write(name, value, item.sink)
        else:
            self.table.scatter(name, value, item.sink, self.block.column)

    def write_empty(self, groups: dict[str, Group], item: int) -> None:
        """Stores what lanes read in items that are not theirs: a contact that does not touch.

        All fields of it, as a number that is none, times no share, is none.

        Args:
          groups: Rows of the list that have an item each.
          item: Number of the item.
        """
        none = self.like
        ones = jnp.ones_like(none)
        sound = {"gap": [ones], "normal": [none, none, ones]}
        for name, (_, shape) in groups.items():
            field = name.removeprefix(f"{self.name}.")
            values = sound.get(field, [none] * math.prod(shape))
            self.table.write(name, lanes(values, shape, wide=True), item)


@dataclass(frozen=True)
class Fixed:
    """A place for each link, group or ring.

    Attributes:
      count: How many there are.
      shared: Whether the lanes of a team share them, one a lane and round.
    """

    count: int
    shared: bool = False
    rows: ClassVar[int] = 0  # of slots

    @property
    def items(self) -> int:
        """Items in memory; one more is no contact, another one takes what nobody reads."""
        return self.count + 2 * self.shared

    @property
    def recorded(self) -> int:
        """Items whose contacts are recorded; one more for lanes without an item."""
        return self.count + self.shared

    @property
    def empty(self) -> int | None:
        """Item without a contact, which lanes without an item read; None if all lanes have one."""
        return self.count if self.shared else None

    def fold(self, cells: Cells, body: Callable, start: Any) -> Any:
        """Folds body(item, tree of lanes) over all items."""
        block = cells.block
        rounds = block.rounds(self.count) if self.shared else self.count
        return loop(rounds, lambda k, carry: body(self._item(block, k), carry), start, block.size)

    def _item(self, block: Block, k: Any) -> Item:
        """Items of the lanes in a round."""
        if not self.shared:
            return at(k)
        number, mine = block.dealt(self.count, k)
        source, sink = (jnp.where(mine, number, self.count + n) for n in range(2))
        return Item(source, sink, number)


@dataclass(frozen=True)
class Appended:
    """Slots for contacts as they are found, one contact each, several to a row.

    Attributes:
      rows: Rows of slots.
      slots: Slots of a row, on each lane; one more takes what finds no room. Where lanes gather,
        one more item is what they read in slots that are not theirs.
      gathers: Whether lanes read items of their own as fast as a common one: on GPUs.
      shared: As of `Fixed`, of the slots of a row.
    """

    rows: int
    slots: int
    gathers: bool
    shared: bool = False

    @property
    def items(self) -> int:
        """Items in memory."""
        return self.rows * (self.slots + 1) + int(self.gathers)

    @property
    def recorded(self) -> int:
        """Items whose contacts are recorded one by one: none."""
        return 0

    @property
    def empty(self) -> int | None:
        """Item that lanes read in slots that are not theirs; None where all read their own."""
        return self.items - 1 if self.gathers else None

    def first(self, slot_row: Any) -> Any:
        """Item of a row's first slot."""
        return slot_row * (self.slots + 1)

    # As contacts are found

    def clear(self, cells: Cells, slot_row: Any) -> None:
        """Empties a row."""
        cells.write(SlotCount.count, zeros((), cells.like), at(slot_row))

    def append(
        self, cells: Cells, slot_row: Any, which: jax.Array, fields: dict[str, Lanes]
    ) -> None:
        """Gives contacts, with what is kept of them, a slot of a row on the lanes `which`.

        Lanes of a team append in their order.
        """
        count = cells.read(SlotCount.count, at(slot_row)).lane
        first = self.first(slot_row)
        filled = count.astype(jnp.int32)
        if self.shared:
            rank, number = ranks(cells.block, which)
            filled = filled + rank
        if not self.gathers:
            # Lanes without a contact in a slot have sound numbers there, and no touch.
            fresh = at(first + jnp.minimum(jnp.max(filled), self.slots))
            for field, value in fields.items():
                away = lanewise(jnp.zeros_like, value) if field == Contact.share else value
                cells.write(field, away, fresh)
        mine = jnp.where(which, jnp.minimum(filled, self.slots), self.slots)
        if self.gathers:
            for field, value in fields.items():
                cells.write(field, value, at(first + mine))
        else:
            self._fill(cells, first, jnp.where(which, mine, -1), fields)
        if self.shared:
            more = count + number.astype(count.dtype)
        else:
            more = jnp.where(which, count + 1.0, count)
        cells.write(SlotCount.count, lanes([more], (), wide=True), at(slot_row))

    def _fill(self, cells: Cells, first: Any, slot: jax.Array, fields: dict[str, Lanes]) -> None:
        """Stores the lanes' contacts, one slot after the other: vectors scatter slowly.

        Args:
          first: Item of the row's first slot.
          slot: The slot of each lane behind it, int32, shape (lane,); -1 for lanes without a
            contact.
        """

        def store(carry: list) -> list:
            now, left = carry
            chosen = left == now
            mask = lanes([chosen], (), wide=True)
            for field, value in fields.items():
                before = cells.read(field, at(first + now))
                cells.write(field, lanewise(jnp.where, mask, value, before), at(first + now))
            left = jnp.where(chosen, -1, left)
            return [jnp.max(left), left]

        jax.lax.while_loop(lambda c: c[0] >= 0, store, [jnp.max(slot), slot])

    def counted(self, cells: Cells) -> Cells:
        """The memory with the numbers of filled slots in registers, when all are found."""
        most = self.slots
        counts = [
            cells.read(SlotCount.count, at(slot_row)).lane.astype(jnp.int32)
            for slot_row in range(self.rows)
        ]
        filled = SlotCounts.of_rows([jnp.minimum(n, most) for n in counts], most)
        return cells._replace(filled=filled)

    def overflow(self, cells: Cells) -> jax.Array:
        """One for lanes that had too few slots in any row, else zero, shape (lane,)."""

        def worst(slot_row: jax.Array, most: jax.Array) -> jax.Array:
            return jnp.maximum(most, cells.read(SlotCount.count, at(slot_row)).lane)

        most = jax.lax.fori_loop(0, self.rows, worst, cells.like)
        return jnp.where(most > self.slots, 1.0, 0.0).astype(cells.like.dtype)

    # When all are found

    def used(self, cells: Cells, slot_row: Any) -> jax.Array:
        """Largest number of slots that a lane has filled, or of rounds of a team, a scalar."""
        assert cells.filled is not None
        most = jnp.max(cells.filled.of(slot_row))
        if not self.shared:
            return most
        team = cells.block.team
        return jax.lax.div(most + (team - 1), jnp.int32(team))

    def fold_row(self, cells: Cells, slot_row: Any, body: Callable, start: Any) -> Any:
        """Folds body(item, tree of lanes) over a row's slots in use."""
        used = self.used(cells, slot_row)
        first = self.first(slot_row)
        size = cells.block.size
        arrays, rebuild = solid(start, size)

        def step(carry: list) -> list:
            item = self._item(cells, slot_row, first, carry[0])
            return [carry[0] + 1, *solid(body(item, rebuild(carry[1:])), size)[0]]

        return rebuild(jax.lax.while_loop(lambda c: c[0] < used, step, [jnp.int32(0), *arrays])[1:])

    def _item(self, cells: Cells, slot_row: Any, first: Any, k: jax.Array) -> Item:
        """A row's k-th slot, or the lanes' slots in round k."""
        if not self.gathers:
            return Item(first + k, first + k)
        if self.shared:
            return self.slot(cells, slot_row, k * cells.block.team + cells.block.mate)
        return self.slot(cells, slot_row, k)

    def slot(self, cells: Cells, slot_row: Any, number: jax.Array) -> Item:
        """A row's slot of a number, where lanes gather: of the lanes that have filled it.

        Args:
          number: The number, a scalar or int32 of shape (lane,).
        """
        assert cells.filled is not None
        mine = number < cells.filled.of(slot_row)
        item = jnp.broadcast_to(self.first(slot_row) + number, mine.shape)
        spare = self.slots  # that of the first row
        source, sink = (jnp.where(mine, item, jnp.int32(k)) for k in (self.items - 1, spare))
        return Item(source, sink)
