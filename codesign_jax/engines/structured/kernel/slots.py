"""Contacts in slots: few of the many places that may touch do, and only those get a slot.

Every lane fills the slots of a row from the first one on.  A loop over the slots of a row runs to
the largest number that any active lane has filled.  Its cost therefore grows with the contacts that
exist in worlds that still iterate, not with those that are possible.
"""

import copy
import math
from collections.abc import Callable
from typing import Any, Self

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import rows
from codesign_jax.engines.structured.kernel.contact_sets import BoundContacts, ContactSet, zeros
from codesign_jax.engines.structured.kernel.memory import (
    BoundTable,
    anywhere,
    solid,
    tree_add_scaled,
)
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.rows import Contact, Group, Rows, Slot, SlotCount
from codesign_jax.engines.structured.lanes import total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.scene import Scene


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
        return SlotCounts([jnp.where(chosen, word, 0) for word in self.words], self._most)

    def of(self, row: jax.typing.ArrayLike) -> jax.Array:
        """A row's numbers, shape (lane,); `row` is a scalar."""
        row = jnp.asarray(row, jnp.int32)
        each = jnp.int32(self._each)
        which = jax.lax.div(row, each)
        place = jax.lax.rem(row, each)
        word = self.words[0]
        for k, other in enumerate(self.words[1:], 1):
            word = jnp.where(which == k, other, word)
        distance = jnp.full_like(word, self._bits * place)
        return jax.lax.shift_right_logical(word, distance) & ((1 << self._bits) - 1)


def _sizes(most: int) -> tuple[int, int]:
    """Bits of a row's number, and rows of an integer, whose sign stays free."""
    bits = most.bit_length()
    return bits, 31 // bits


class SlotSet(ContactSet):
    """Contacts of one pair of bodies in slots, one contact each, several to a row."""

    def __init__(
        self,
        scene: Scene,
        name: str,
        rows: int,
        slots: int,
        size: int,
        *,
        gathers: bool,
        remembers: tuple[type[Rows], ...] = (),
    ):
        """Prepares the set.

        Args:
          slots: Slots of a row, on each lane; one more takes what finds no room. Where lanes
            gather, one more item of the set is what they read in slots that are not theirs.
          gathers: Whether lanes read items of their own as fast as a common one: on GPUs.
          remembers: Numbers that are kept of each slot beside its contact, see `remembered`.
        """
        super().__init__(scene, name, rows * (slots + 1) + int(gathers), 1, size)
        self.per_link = False
        self.rows = rows
        self.slots = slots
        self.gathers = gathers
        self.remembers = remembers

    @property
    def sizes(self) -> dict[str, int]:
        """See `ContactSet`."""
        return super().sizes | {rows.SLOT_ROW: self.rows}

    def groups(self) -> dict[str, Group]:
        """See `ContactSet`."""
        return self.fields() | self.groups_of(SlotCount)

    def fields(self) -> dict[str, Group]:
        """Rows that each slot has."""
        return self.groups_of(Contact, *self.beside, *self.remembers)

    beside: tuple[type[Rows], ...] = (Slot,)
    """What a slot has beside its contact."""

    def bind(self, table: BoundTable, read: Callable[[str], Lanes]) -> "BoundSlots":
        return BoundSlots(self, table, self.cone(read))


class BoundSlots(BoundContacts):
    """Slots with their memory; methods work on a row."""

    set: SlotSet  # type: ignore[assignment]
    _counts: SlotCounts | None = None

    def clear(self, row: Any) -> None:
        self.write(SlotCount.count, zeros((), self.like), at(row))

    def keep_counts(self) -> None:
        """Keeps in registers how many slots lanes have filled, when all contacts are found."""
        rows = range(self.set.rows)
        most = self.set.slots
        counts = [self.read(SlotCount.count, at(row)).lane.astype(jnp.int32) for row in rows]
        self._counts = SlotCounts.of_rows([jnp.minimum(n, most) for n in counts], most)
        if self.set.gathers:
            self.write_empty(self.set.fields(), self.set.count - 1)

    def write_empty(self, fields: dict[str, tuple[int, tuple[int, ...]]], item: int) -> None:
        """Stores what lanes read in slots that are not theirs: a contact that does not touch.

        All fields of it, as a number that is none, times no share, is none.
        """
        none = self.like
        ones = jnp.ones_like(none)
        prefix = f"{self.set.name}."
        sound = {"gap": [ones], "normal": [none, none, ones]}
        for name, (_, shape) in fields.items():
            values = sound.get(name.removeprefix(prefix), [none] * math.prod(shape))
            self.table.write(name, lanes(values, shape, wide=True), item)

    def used(self, row: Any) -> jax.Array:
        """Number of slots that any lane has filled, a scalar; see `masked`."""
        assert self._counts is not None
        return jnp.max(self._counts.of(row))

    def masked(self, busy: jax.Array) -> Self:
        """The contacts whose passes go through the slots that the lanes `busy` have filled.

        What a pass makes of other worlds is of no use.
        """
        assert self._counts is not None
        among = copy.copy(self)
        among._counts = self._counts.masked(busy)
        return among

    def remembered(self, numbers: dict[str, Any]) -> dict[str, Lanes]:
        """Fields of the numbers, the same or different on the lanes, that the set remembers."""
        none = self.like
        names = [name for table in self.set.remembers for name in table.fields()]
        return {
            name: lanes([none + jnp.asarray(number).astype(none.dtype)], (1, 1), wide=True)
            for name, number in numbers.items()
            if name in names
        }

    def overflow(self) -> jax.Array:
        """One for lanes that had too few slots in any row, else zero, shape (lane,)."""

        def worst(row: jax.Array, most: jax.Array) -> jax.Array:
            return jnp.maximum(most, self.read(SlotCount.count, at(row)).lane)

        most = jax.lax.fori_loop(0, self.set.rows, worst, self.like)
        return jnp.where(most > self.set.slots, 1.0, 0.0).astype(self.like.dtype)

    def add(self, row: Any, which: jax.Array, fields: dict[str, Lanes], lane: jax.Array) -> None:
        """Gives contacts, with what is kept of them, a slot of a row on the lanes `which`."""
        count = self.read(SlotCount.count, at(row)).lane
        first = row * (self.set.slots + 1)
        filled = count.astype(jnp.int32)
        if not self.set.gathers:
            # Lanes without a contact in a slot have sound numbers there, and no touch.
            fresh = first + jnp.minimum(jnp.max(filled), self.set.slots)
            for field, value in fields.items():
                away = lanewise(jnp.zeros_like, value) if field == "share" else value
                self.write(field, away, at(fresh))
        mine = jnp.where(which, jnp.minimum(filled, self.set.slots), self.set.slots)
        if self.set.gathers:
            for field, value in fields.items():
                self.table.scatter(f"{self.set.name}.{field}", value, first + mine, lane)
        else:
            self._fill(first, jnp.where(which, mine, -1), fields)
        more = jnp.where(which, count + 1.0, count)
        self.write(SlotCount.count, lanes([more], (), wide=True), at(row))

    def _fill(self, first: Any, slot: jax.Array, fields: dict[str, Lanes]) -> None:
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
                before = self.read(field, at(first + now))
                self.write(field, lanewise(jnp.where, mask, value, before), at(first + now))
            left = jnp.where(chosen, -1, left)
            return [jnp.max(left), left]

        jax.lax.while_loop(lambda c: c[0] >= 0, store, [jnp.max(slot), slot])

    def fold(self, row: Any, body: Callable, start: Any) -> Any:
        """Folds body(item, tree of lanes) over the slots in use."""
        used = self.used(row)
        first = row * (self.set.slots + 1)
        arrays, rebuild = solid(start, self.set.size)

        def step(carry: list) -> list:
            slot = self._slot(row, first, carry[0])
            return [carry[0] + 1, *solid(body(slot, rebuild(carry[1:])), self.set.size)[0]]

        return rebuild(jax.lax.while_loop(lambda c: c[0] < used, step, [jnp.int32(0), *arrays])[1:])

    def _slot(self, row: Any, first: Any, k: jax.Array) -> Item:
        """A row's k-th slot, behind the row's first item."""
        if not self.set.gathers:
            return Item(first + k, first + k)
        assert self._counts is not None
        mine = k < self._counts.of(row)
        item = jnp.full((self.set.size,), first + k, jnp.int32)
        # that of the first row
        empty = self.set.count - 1
        spare = self.set.slots
        return Item(*(jnp.where(mine, item, jnp.int32(away)) for away in (empty, spare)))

    def update_constraint(self, item: Item, place: Place, alpha: Lanes) -> Lanes:
        """Adds the last step to jar; stores the Hessian and returns the force, of one slot."""
        contacts = self.set.contacts

        def response(place, cone, jar):
            update = contact.constraint_update(contacts(place, cone), jar)
            return update.hessian, update.force

        jar = lanewise(
            tree_add_scaled, alpha, self.read(Contact.jar, item), self.read(Contact.step, item)
        )
        self.write(Contact.jar, jar, item)
        hessian, force = lanewise(response, place, self.cone_at(item), jar)
        self.write(Slot.hessian, hessian, item)
        return force

    def _zeros(self, *shapes: tuple[int, ...]) -> list[Lanes]:
        return [zeros(shape, self.like) for shape in shapes]


def any_of(which: jax.Array, then: Callable[[], None]) -> None:
    """Runs what stores something, if any lane is true."""
    jax.lax.cond(anywhere(which), then, lambda: None)
