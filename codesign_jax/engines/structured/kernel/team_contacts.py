"""Contacts whose slots are dealt to the lanes of a team, see `shared_memory`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import rows
from codesign_jax.engines.structured.kernel.contact_sets import ContactSet
from codesign_jax.engines.structured.kernel.memory import Block, BoundTable, choose, loop
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.rows import (
    Contact,
    Group,
    Side,
    Slot,
    SlotCount,
    TeamRing,
    TeamSlot,
)
from codesign_jax.engines.structured.kernel.self_contacts import (
    BoundSelfContacts,
    OwnSide,
    SelfContactSet,
    _times,
)
from codesign_jax.engines.structured.kernel.shared_memory import TEAM, TeamRows, ranks
from codesign_jax.engines.structured.kernel.slots import BoundSlots
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact
from codesign_jax.scene import Scene


class TeamSdfContactSet(ContactSet):
    """Contacts of a finger's rings with object or table, dealt to the lanes of its team."""

    in_teams = True

    def __init__(self, scene: Scene, tables: Any, name: str, links: int, k: int):
        """As `ContactSet`; one item more is no contact, another one takes what nobody reads."""
        super().__init__(scene, name, links * k + 2, 1, tables.size)
        self.block = (tables.fingers, tables.block, tables.team)
        self.rings = links * k

    @property
    def sizes(self) -> dict[str, int]:
        """See `ContactSet`; one more contact is recorded for lanes without an item."""
        return super().sizes | {rows.TOUCH: self.rings + 1}

    def groups(self) -> dict[str, Group]:
        """See `ContactSet`; with the Hessian and the force of each."""
        return self.groups_of(Contact, TeamRing)

    def bind(self, table: BoundTable, read: Callable[[str], Lanes]) -> "BoundTeamSdfContacts":
        return BoundTeamSdfContacts(self, table, self.cone(read))


class BoundTeamSdfContacts(BoundSlots):
    """The contacts with their memory."""

    set: TeamSdfContactSet  # type: ignore[assignment]

    def __init__(self, *bound: Any):
        super().__init__(*bound)
        self.block = Block(*self.set.block)

    def _lane(self) -> jax.Array:
        return self.block.column

    def item(self, k: Any) -> Item:
        """Items of the lanes in a round, with the rings that they are of."""
        item, mine = self.block.dealt(self.set.rings, k)
        spare = self.set.rings + 1
        return Item(jnp.where(mine, item, spare - 1), jnp.where(mine, item, spare), item)

    def begin_step(self) -> None:
        """Stores what lanes without an item read: no contact."""
        self.write_empty(self.set.groups(), self.set.rings)

    def each_item(self, body: Callable[[Item], None]) -> None:
        """See `BoundContacts`; a lane each."""

        def step(item: Item, nothing: list) -> list:
            body(item)
            return nothing

        self.fold_items(step, [])

    def fold_items(self, body: Callable, start: Any) -> Any:
        """See `BoundContacts`; a lane each."""
        rounds = self.block.rounds(self.set.rings)
        return loop(rounds, lambda k, carry: body(self.item(k), carry), start, self.set.size)

    def record(self, table: BoundTable, name: str, value: Lanes, item: Item) -> None:
        """See `BoundContacts`; a lane each."""
        table.scatter(name, value[..., 0, :, :], item.source, self.block.column)

    def update_constraints(self, alpha: Lanes) -> None:
        """Adds the last step of the line search to jar; stores Hessians and forces."""

        def store(item: Item) -> None:
            def touches() -> None:
                self.write(
                    TeamRing.force, self.update_constraint(item, self.place(item), alpha), item
                )

            jax.lax.cond(self.touching(item), touches, lambda: None)

        self.each_item(store)

    def columns(self, i: Any, k: int, unit: Lanes, forces: Lanes) -> Lanes:
        """The lanes' columns, (6,), of the sum of X'KX over the k contacts of link i.

        Args:
          unit: The acceleration that a lane's column belongs to.
          forces: Lanes whose column has the forces.
        """
        contacts = self.set.contacts

        def column(sums, place, cone, hessian, force, unit, forces):
            c = contacts(place, cone)
            response = jnp.where(forces, force, _times(hessian, c.relative(unit[:, None])))
            return sums + contact.contact_wrench(c, response)[:, 0]

        sums = self._zeros((6,))[0]
        for item in (at(i * k + j) for j in range(k)):

            def add(item: Any = item, sums: Lanes = sums) -> Lanes:
                kept = [self.read(name, item) for name in ("hessian", "force")]
                args = sums, self.place(item), self.cone, *kept, unit, forces
                return lanewise(column, *args)

            sums = choose(self.touching(item), add, sums, self.set.size)
        return sums

    def prepare_all(self, self_contacts: BoundSelfContacts, k: int, obj: Lanes) -> Lanes:
        """`prepare_linesearch` of all items, k a link; slopes at 0, each on its lane."""

        def add(item: Item, sums: Lanes) -> Lanes:
            row = jax.lax.div(item.number, jnp.full_like(item.number, k)) + 1
            link_acc = self_contacts.table.gather(Side.link_acc, row, self.block.column)
            if self.set.on_object:
                link_acc = lanewise(jnp.subtract, link_acc, obj)
            return lanewise(jnp.add, sums, self.prepare_linesearch(item, link_acc))

        return self.fold_items(add, self._zeros(())[0])


class TeamSelfContactSet(SelfContactSet):
    """Contacts between fingers, a pairing's slots dealt to the lanes."""

    def __init__(self, scene: Scene, block: tuple[int, int, int], *rest: Any, **options: Any):
        """As `SelfContactSet`; block: fingers, worlds and lanes of a team."""
        super().__init__(scene, block[:2], *rest, **options)
        # type: ignore[assignment]
        self.block = block
        self.size = block[0] * block[1] * block[2]

    beside = (Slot, TeamSlot)
    in_teams = True

    def bind(self, table: BoundTable, read: Callable[[str], Lanes]) -> "BoundTeamSelfContacts":
        cones = {name: self.cone(read, name) for name in self._names()}
        return BoundTeamSelfContacts(self, table, cones)


class BoundTeamSelfContacts(BoundSelfContacts):
    """The contacts with their memory."""

    def __init__(self, *bound: Any):
        super().__init__(*bound)
        self.parts = TeamRows(self.block, self.table)
        self._loaded = False

    def _lane(self) -> jax.Array:
        return self.block.column

    def used(self, row: Any) -> jax.Array:
        """Rounds of a row."""
        return jax.lax.div(super().used(row) + (TEAM - 1), jnp.int32(TEAM))

    def _slot(self, row: Any, first: Any, k: jax.Array) -> Item:
        return self._item(row, first, k * TEAM + self.block.mate)

    def _item(self, row: Any, first: Any, number: jax.Array) -> Item:
        assert self._counts is not None
        mine = number < self._counts.of(row)
        item = first + number
        empty = self.set.count - 1
        spare = self.set.slots
        return Item(jnp.where(mine, item, empty), jnp.where(mine, item, spare))

    def add(self, row: Any, which: jax.Array, fields: dict[str, Lanes], lane: jax.Array) -> None:
        """See `BoundSlots`; lanes of a team append in their order."""
        slots = self.set.slots
        count = self.read(SlotCount.count, at(row)).lane
        rank, number = ranks(self.block, which)
        mine = jnp.where(which, jnp.minimum(count.astype(jnp.int32) + rank, slots), slots)
        for field, value in fields.items():
            name = f"{self.set.name}.{field}"
            first = row * (slots + 1)
            self.table.scatter(name, value, first + mine, lane)
        more = lanes([count + number.astype(count.dtype)], (), wide=True)
        self.write(SlotCount.count, more, at(row))

    def own_side(self, item: Any) -> OwnSide:
        """See `BoundSelfContacts`; wrenches are added up later."""
        return OwnSide(self.place(item), None, None)

    def load(self, item: Item, side: OwnSide, force: Lanes) -> None:
        """Keeps a slot's wrench, which is added to its side's when the pass has ended."""
        contacts = self.set.contacts

        def wrench(place, cone, force):
            return contact.contact_wrench(contacts(place, cone), force)

        self.write(TeamSlot.wrench, lanewise(wrench, side.place, self.cone_at(item), force), item)
        self._loaded = True

    def fold_items(self, body: Callable, start: Any) -> Any:
        """See `BoundSelfContacts`; adds up the wrenches of the pass."""
        result = super().fold_items(body, start)
        if self._loaded:
            self._loaded = False
            self._add_wrenches()
        return result

    def clear_wrenches(self) -> None:
        def clear(row: Any, x: jax.Array) -> jax.Array:
            self.parts.put(Side.wrench, self.like, row)
            return x

        jax.lax.fori_loop(0, self.rows(), clear, jnp.int32(0))

    def _add_wrenches(self) -> None:
        """Adds slots to their sides one after the other, a lane each component."""
        name = f"{self.set.name}.wrench"

        def of_row(row: Any, x: jax.Array) -> jax.Array:
            def slot_wrench(k: jax.Array, x: jax.Array) -> jax.Array:
                slot = self._item(row, row * (self.set.slots + 1), k)
                # Lanes without a component read what nobody wrote, which may be no number.
                more = jnp.where(self.block.mate < 6, self.parts.get(name, slot.source), 0.0)
                sides = {"row": more}
                if self.set.with_itself:
                    sides["other"] = jnp.where(jnp.equal(row, 0), -more, 0.0)
                for field, push in sides.items():
                    side = self.read(field, slot).lane.astype(jnp.int32)
                    self.parts.put(Side.wrench, self.parts.get(Side.wrench, side) + push, side)
                return x

            assert self._counts is not None
            return jax.lax.fori_loop(0, jnp.max(self._counts.of(row)), slot_wrench, x)

        jax.lax.fori_loop(0, self.set.rows, of_row, jnp.int32(0))
