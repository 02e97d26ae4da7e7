"""The sides of the hand's contacts with itself: how forces are laid on them, and how they move.

The side of a contact is a body of the lane's own finger: a link, or 0 for the palm with the half
links that are fixed to it.  Contacts with a field have no side here: their link is at hand where a
pass over the links looks at them.

The lanes of a block have a slot's contact on different bodies.  On GPUs each lane reads its own;
on CPUs the few different bodies of a slot are listed, and a pass goes from one to the next.  The
lanes of a team keep the wrench of a slot each, and add them up when a pass has ended.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_list import ContactList, make_contacts
from codesign_jax.engines.structured.kernel.memory import (
    Block,
    BoundTable,
    any_of,
    anywhere,
    either,
    solid,
    zeros,
)
from codesign_jax.engines.structured.kernel.placement import Item
from codesign_jax.engines.structured.kernel.rows import Contact, Field, Side, Slot, TeamSlot
from codesign_jax.engines.structured.kernel.shared_memory import TeamRows
from codesign_jax.engines.structured.lanes import sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact
from codesign_jax.engines.structured.laws.rings import Place


class OwnSide(NamedTuple):
    """What `Sides.load` needs of a slot's own side, read before anything is stored.

    NVIDIA's assembler moves no load before a store that might be to the same place, so a thread
    waits a second time for what is read behind a store.
    """

    place: Place  # Where the contact is
    # Body of each lane's side, int32, shape (lane,); None where nothing is added to it at once
    body: jax.Array | None
    wrench: Lanes | None  # Wrench of all contacts so far on that body, (6, ...); None likewise


class Sides:
    """The bodies of the fingers' contacts with one another: fields of `rows.Side`.

    Methods that have a list take the contacts whose sides they are, `ContactList.masked` or all.
    """

    def __init__(self, table: BoundTable, block: Block, bodies: int, *, gathers: bool):
        """Binds the rows of a table.

        Args:
          table: The table.
          block: The lanes.
          bodies: Moving links of a finger and the palm.
          gathers: Whether each lane reads the body of its own side.
        """
        self.table = table
        self.block = block
        self.bodies = bodies
        self.gathers = gathers
        self.like = jnp.zeros((block.size,), table.dtype)
        self.parts = TeamRows(block, table) if block.team > 1 else None

    # The bodies

    def put(self, name: Field, value: Lanes, body: Any) -> None:
        """Stores a field of a body; 0 is the palm."""
        self.table.write(name, value, body)

    def wrench_on(self, body: Any) -> Lanes:
        """Wrench of all contacts on a body, (6, ...)."""
        return self.table.read(Side.wrench, body)

    def clear(self) -> None:
        """Takes all contacts from the bodies."""

        def clear(body: Any, x: jax.Array) -> jax.Array:
            if self.parts is None:
                self.put(Side.wrench, zeros((6,), self.like), body)
            else:
                self.parts.put(Side.wrench, self.like, body)
            return x

        jax.lax.fori_loop(0, self.bodies, clear, jnp.int32(0))

    # Passes that lay forces on the sides

    def lay(self, contacts: ContactList, body: Callable, start: Any) -> Any:
        """Folds body(item, tree of lanes), which loads each item's sides, over a list.

        The bodies have no other wrenches then.
        """
        self.clear()
        result = contacts.fold(body, start)
        if self.parts is not None:
            self._add_up(contacts, self.parts)
        return result

    def lay_each(self, contacts: ContactList, force: Callable[[Item, OwnSide], Lanes]) -> None:
        """Loads the sides of all items with forces (3, ...), force(item, own side)."""

        def load(item: Item, nothing: list) -> list:
            side = self.own_side(contacts, item)
            self.load(contacts, item, side, force(item, side))
            return nothing

        self.lay(contacts, load, [])

    def update_constraints(self, contacts: ContactList, alpha: Lanes) -> None:
        """Adds the last step of the line search to jar; stores Hessians and lays the forces."""
        self.lay_each(
            contacts, lambda item, side: contacts.update_constraint(item, side.place, alpha)
        )

    def update_wrenches(self, contacts: ContactList, alpha: Lanes) -> None:
        """Lays the forces where the last step has moved jar, which is kept."""
        self.lay_each(contacts, lambda item, side: contacts.force_after(item, side.place, alpha))

    def prepare_all(self, contacts: ContactList) -> Lanes:
        """`ContactList.line` along the bodies' accelerations of all items; slopes at 0."""

        def add(item: Item, sums: Lanes) -> Lanes:
            slope = contacts.line(item, self.relative(contacts, item))
            return lanewise(lambda s, h, f: s + h * f, sums, item.pairing.half, slope)

        return contacts.fold(add, zeros((), self.like))

    # The sides of one item

    def relative(self, contacts: ContactList, item: Item) -> Lanes:
        """Relative acceleration of a slot's sides by the bodies', on its own side's lanes."""
        pairing = item.pairing
        place = contacts.place(item)

        def of_side(field: Field) -> Lanes:
            link_acc = self._accelerations(contacts, item, field)

            def moved(place, cone, link_acc):
                return make_contacts(place, cone).relative(link_acc[:, None])

            return lanewise(moved, place, contacts.cone_at(item), link_acc)

        mine = of_side(Slot.side)
        if pairing.itself is None:
            return lanewise(jnp.subtract, mine, pairing.swap(mine))
        ways = (lambda: of_side(Slot.other_side)), (lambda: pairing.swap(mine))
        theirs = either(anywhere(pairing.itself), *ways, self.block.size)
        return lanewise(jnp.subtract, mine, theirs)

    def _accelerations(self, contacts: ContactList, item: Item, field: Field) -> Lanes:
        """Accelerations of the bodies in a field of a slot; zeros where nothing touches."""
        if self.gathers:
            body = contacts.read(field, item).lane.astype(jnp.int32)
            return self.table.gather(Side.link_acc, body, self.block.column)

        def take(body: Any, chosen: jax.Array, accs: Lanes) -> Lanes:
            new = self.table.read(Side.link_acc, body)
            return lanewise(jnp.where, lanes([chosen], (), wide=True), new, accs)

        return self._each_body(contacts, item, field, take, zeros((6,), self.like))

    def own_side(self, contacts: ContactList, item: Item) -> OwnSide:
        """Reads a slot's own side, for `load`; before anything of the slot is stored."""
        if not self.gathers or self.parts is not None:
            return OwnSide(contacts.place(item), None, None)
        body = contacts.read(Slot.side, item).lane.astype(jnp.int32)
        wrench = self.table.gather(Side.wrench, body, self.block.column)
        return OwnSide(contacts.place(item), body, wrench)

    def load(self, contacts: ContactList, item: Item, side: OwnSide, force: Lanes) -> None:
        """Adds a slot's force to its own side's wrench, and takes it from the other side's."""
        pairing = item.pairing
        more = lanewise(wrench_of_force, side.place, contacts.cone_at(item), force)
        if self.parts is not None:
            contacts.write(TeamSlot.wrench, more, item)
            return
        self._add_wrench(contacts, item, Slot.side, more, side)
        if pairing.itself is not None:

            def opposite() -> None:
                self._add_wrench(contacts, item, Slot.other_side, lanewise(jnp.negative, more))

            any_of(pairing.itself, opposite)

    def _add_wrench(
        self,
        contacts: ContactList,
        item: Item,
        field: Field,
        more: Lanes,
        side: OwnSide | None = None,
    ) -> None:
        """Adds a wrench (6, ...) to that of the bodies in a field of a slot.

        Args:
          side: What is known of the own side, if it is that.
        """
        if self.gathers:
            if side is None or side.body is None or side.wrench is None:
                body = contacts.read(field, item).lane.astype(jnp.int32)
                sums = self.table.gather(Side.wrench, body, self.block.column)
            else:
                body, sums = side.body, side.wrench
            sums = lanewise(jnp.add, sums, more)
            self.table.scatter(Side.wrench, sums, body, self.block.column)
            return

        def add(body: Any, chosen: jax.Array, nothing: list) -> list:
            mask = lanes([chosen], (), wide=True)
            self.put(Side.wrench, lanewise(_add_where, mask, self.wrench_on(body), more), body)
            return nothing

        self._each_body(contacts, item, field, add, [])

    def _add_up(self, contacts: ContactList, parts: TeamRows) -> None:
        """Adds a team's slots to their sides one after the other, a lane each component."""
        layout = contacts.layout
        cells = contacts.cells
        name = f"{layout.name}.{TeamSlot.wrench}"
        assert cells.filled is not None
        filled = cells.filled

        def of_row(slot_row: Any, x: jax.Array) -> jax.Array:
            def slot_wrench(k: jax.Array, x: jax.Array) -> jax.Array:
                slot = layout.slots.slot(cells, slot_row, k)
                # Lanes without a component read what nobody wrote, which may be no number.
                more = jnp.where(self.block.mate < 6, parts.get(name, slot.source), 0.0)
                pushes = {Slot.side: more}
                if layout.with_itself:
                    pushes[Slot.other_side] = jnp.where(jnp.equal(slot_row, 0), -more, 0.0)
                for field, push in pushes.items():
                    side = contacts.read(field, slot).lane.astype(jnp.int32)
                    parts.put(Side.wrench, parts.get(Side.wrench, side) + push, side)
                return x

            return jax.lax.fori_loop(0, jnp.max(filled.of(slot_row)), slot_wrench, x)

        jax.lax.fori_loop(0, layout.slots.rows, of_row, jnp.int32(0))

    # Bodies of a slot's lanes, where lanes do not gather

    def list_bodies(self, contacts: ContactList) -> None:
        """Lists the different bodies of each slot's lanes, when all contacts are found."""
        if self.gathers:
            return

        def store(item: Item) -> None:
            self._list_bodies(contacts, item, Slot.side)
            itself = item.pairing.itself
            if itself is not None:
                any_of(itself, lambda: self._list_bodies(contacts, item, Slot.other_side))

        contacts.each(store)

    def _list_bodies(self, contacts: ContactList, item: Item, field: Field) -> None:
        """Lists the different bodies at which a slot's lanes touch.

        The k-th body is stored on the k-th lane of the field's list, their number on all lanes.
        """
        nothing = jnp.full_like(self.like, -1.0)

        def step(carry: list) -> list:
            count, body, left, listed = carry
            left = jnp.where(left == body, -1, left)
            listed = jnp.where(self.block.lane == count, body.astype(listed.dtype), listed)
            return [count + 1, jnp.max(left), left, listed]

        left = _touched_bodies(contacts, item, field)
        first = [jnp.int32(0), jnp.max(left), left, nothing]
        count, _, _, listed = jax.lax.while_loop(lambda c: c[1] >= 0, step, first)
        counts = self.like + count.astype(self.like.dtype)
        contacts.write(f"{field}_listed", lanes([listed], (1, 1), wide=True), item)
        contacts.write(f"{field}_count", lanes([counts], (1, 1), wide=True), item)

    def _each_body(
        self, contacts: ContactList, item: Item, field: Field, act: Callable, start: Any
    ) -> Any:
        """Folds act(body, lanes that touch there, tree of lanes) over the bodies of a slot's lanes.

        Few lanes of a block touch in one slot, at two rows if it is one contact: on CPUs whose
        vectors gather number by number that is faster than to gather.
        """
        bodies = _touched_bodies(contacts, item, field)
        arrays, rebuild = solid(start, self.block.size)
        name = f"{contacts.layout.name}.{field}"
        slot = item.source
        count = self.table.number(f"{name}_count", slot, 0).astype(jnp.int32)

        def step(carry: list) -> list:
            k, *values = carry
            body = self.table.number(f"{name}_listed", slot, k).astype(jnp.int32)
            new = solid(act(body, bodies == body, rebuild(values)), self.block.size)[0]
            return [k + 1, *new]

        first = [jnp.int32(0), *arrays]
        return rebuild(jax.lax.while_loop(lambda c: c[0] < count, step, first)[1:])


def _touched_bodies(contacts: ContactList, item: Item, field: Field) -> jax.Array:
    """Body of each lane's side of a slot, int32, shape (lane,); -1 where nothing touches."""
    touches = contacts.read(Contact.share, item).lane > 0
    return jnp.where(touches, contacts.read(field, item).lane.astype(jnp.int32), -1)


# Stages that the kernel evaluates lane by lane


def wrench_of_force(place, cone, force):
    """Wrench (6,) of the forces of a slot's contacts."""
    return sum_axis(contact.contact_wrench(make_contacts(place, cone), force), 1)


def _add_where(chosen, sums, more):
    return sums + jnp.where(chosen, more, 0.0)
