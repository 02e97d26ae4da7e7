"""Self-contacts: contacts of the hand with itself, of fingers with one another and with the palm.

A contact of two fingers is stored on the lanes of both: each lane keeps its own finger's side.
Fingers are paired by the exclusive or of their indices with 1, 2, and so on, which reaches every
pair; a row of slots belongs to one such number.  Both lanes of a pair put the same contact into the
same slot, so that they process it at the same time and exchange numbers in registers.  The side of
a contact is a link, 0 for the palm with the half links that are fixed to it.

Contacts of a finger with the palm or with itself are a row of slots as well, with the number 0:
they are on the finger's lane alone, which has both sides.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import rows
from codesign_jax.engines.structured.kernel.contact_sets import ContactSet, zeros
from codesign_jax.engines.structured.kernel.memory import (
    Block,
    BoundTable,
    anywhere,
    either,
    loop,
    solid,
    tree_add_scaled,
)
from codesign_jax.engines.structured.kernel.placement import Item
from codesign_jax.engines.structured.kernel.rows import Contact, Field, Group, Rows, Side, Slot
from codesign_jax.engines.structured.kernel.shared_memory import TEAM
from codesign_jax.engines.structured.kernel.slots import BoundSlots, SlotSet, any_of
from codesign_jax.engines.structured.lanes import dot, sum_axis, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.model.layout import touches_itself
from codesign_jax.scene import Scene


class FingerPairing:
    """Fingers in pairs: those whose numbers differ by an exclusive or with the pairing's number.

    Each finger is its own partner in the pairing 0, for contacts with itself and with the palm.

    Attributes:
      lane: Lane of the finger that each lane's finger is paired with, shape (lane,).
      itself: Whether a lane's finger is its own partner, shape (lane,); None if it never is.
      half: The fraction of a contact that a lane counts: two fingers' is on two lanes.
    """

    def __init__(self, block: Block, number: Any, dtype: Any, *, with_itself: bool):
        self.block = block
        self.number = (jnp.zeros_like(block.finger) + number).astype(jnp.int32)
        same = self.number == 0
        ones = jnp.ones_like(block.finger, dtype)
        self.itself = same if with_itself else None
        self.half = lanes(
            [jnp.where(same, ones, 0.5 * ones) if with_itself else 0.5 * ones], (), wide=True
        )
        other = jax.lax.bitwise_xor(block.finger, self.number)
        self.lane = other * block.worlds + block.world

    def swap(self, tree: Any) -> Any:
        """What the lanes that the lanes are paired with have, of a tree of lanes.

        Lanes exchange registers, once for each binary digit of the pairing's number: through memory
        a lane would have to wait until its partner has written.
        """
        block = self.block
        arrays, rebuild = solid(tree, block.size)
        for digit in range(block.fingers.bit_length() - 1):
            distance = block.worlds * block.team << digit
            chosen = jax.lax.bitwise_and(self.number, jnp.int32(1 << digit)) > 0
            arrays = [
                jnp.where(chosen, jax.lax.rev(a.reshape(-1, 2, distance), (1,)).reshape(-1), a)
                for a in arrays
            ]
        return rebuild(arrays)


def pair_slots(scene: Scene) -> int:
    """Slots of a pair of fingers; a world with more contacts fails (CONTACT_OVERFLOW).

    A ring has one contact with another finger, one with its own and one with the palm.
    """
    d = scene.discretization
    e = scene.effects
    if e.surface == "hull":
        return d.links * d.hull_rings * (2 if e.finger_palm and touches_itself(scene) else 1)
    return min(4 * d.links * d.spheres_per_link, (d.links * d.spheres_per_link) ** 2)


class SelfContactSet(SlotSet):
    """Contacts of the hand with itself; a row of slots belongs to a pairing of all fingers."""

    def __init__(
        self,
        scene: Scene,
        block: tuple[int, int],
        links: int,
        slots: int,
        *,
        gathers: bool,
        remembers: tuple[type[Rows], ...] = (),
    ):
        fingers, worlds = block
        e = scene.effects
        self.with_itself = e.finger_palm or touches_itself(scene)
        self.first = int(not self.with_itself)
        rows = fingers - self.first if e.finger_finger else 1
        sizes = "finger_finger", rows, slots, fingers * worlds
        super().__init__(scene, *sizes, gathers=gathers, remembers=remembers)
        self.block = block
        self.links = links

    def cone_rows(self) -> dict[str, Group]:
        """See `ContactSet`; one cone between fingers and one on the palm, if there are both."""
        (shape,) = super().cone_rows().values()
        return {f"cone.{name}": shape for name in self._names()}

    def _names(self) -> list[str]:
        e = self.scene.effects
        between = e.finger_finger or touches_itself(self.scene)
        on = {"finger_finger": between, "finger_palm": e.finger_palm}
        return [name for name in on if on[name]]

    @property
    def sizes(self) -> dict[str, int]:
        """See `ContactSet`."""
        return super().sizes | {rows.BODY: self.links + 1, rows.SPARE: TEAM - 6}

    def groups(self) -> dict[str, Group]:
        """See `ContactSet`; and the sides of all fingers, from the palm to the tips."""
        return super().groups() | Side.groups(self, self.sizes)

    def bind(self, table: BoundTable, read: Callable[[str], Lanes]) -> "BoundSelfContacts":
        cones = {name: self.cone(read, name) for name in self._names()}
        return BoundSelfContacts(self, table, cones)


class OwnSide(NamedTuple):
    """What `BoundSelfContacts.load` needs of a slot's own side, read before anything is stored.

    NVIDIA's assembler moves no load before a store that might be to the same place, so a thread
    waits a second time for what is read behind a store.
    """

    place: Place  # Where the contact is
    # Row of each lane's side, int32, shape (lane,); None where lanes do not gather
    row: jax.Array | None
    wrench: Lanes | None  # Wrench of all contacts so far on that row, (6, ...); None likewise


class BoundSelfContacts(BoundSlots):
    """Contacts between fingers with their memory."""

    set: SelfContactSet  # type: ignore[assignment]

    def __init__(self, of: SelfContactSet, table: BoundTable, cones: dict[str, contact.Cone]):
        super().__init__(of, table, next(iter(cones.values())))
        self.block = Block(*of.block)
        self._cones = cones

    def deepest_in_palm(self, depth: Lanes) -> Lanes:
        """The larger of a depth and those of the fingers' contacts with the palm [m]."""

        def deeper(item: Item, depth: Lanes) -> Lanes:
            fields = (self.read(name, item)[0] for name in (Contact.share, Contact.gap))
            return lanewise(_deeper_in_palm, depth, self.read(Slot.other, item)[0, 0], *fields)

        return super().fold(0, deeper, depth)

    def pairing(self, row: Any) -> FingerPairing:
        return FingerPairing(
            self.block, row + self.set.first, self.table.dtype, with_itself=self.set.with_itself
        )

    def cone_of_row(self, row: Any, other: Any = None) -> contact.Cone:
        """The cone of a row's contacts; other: second sides, of which 0 is the palm."""
        if len(self._cones) == 1:
            return self.cone
        palm = jnp.full((self.set.size,), jnp.equal(row, 0))
        if other is not None:
            palm &= other < 0.5
        here = lanes([palm], (), wide=other is not None)
        return lanewise(_where, here, self._cones["finger_palm"], self._cones["finger_finger"])

    def holds(self, item: Item) -> Lanes:
        """One for contacts whose friction is kept, zero for those with the palm."""
        pairing = item.pairing
        kept = jnp.ones_like(self.like)
        if pairing.itself is not None:
            palm = pairing.itself & (self.read(Slot.other, item).lane < 0.5)
            kept = jnp.where(palm, 0.0, kept)
        return lanes([kept], (), wide=True)

    def put(self, name: Field, value: Lanes, row: Any) -> None:
        """Stores a field of `rows.Side` of a body; row 0 is the palm's."""
        self.table.write(name, value, row)

    def wrench_on(self, row: Any) -> Lanes:
        """Wrench of all contacts on a link, (6, ...)."""
        return self.table.read(Side.wrench, row)

    def rows(self) -> int:
        return self.set.links + 1

    # Slots

    def enter(
        self, row: Any, which: jax.Array, owner: jax.Array, mine: dict, other: dict, alike: dict
    ) -> None:
        """Gives contacts a slot on both of their lanes.

        Args:
          which: Lanes that have found a contact, a part of `owner`, of which each pair of lanes has
            one.
          mine: What the finder keeps, by field; `other`: its partner; `alike`: each of its own
            side.
        """
        share = lanewise(_only_where, lanes([which], (), wide=True), other[Contact.share])
        theirs = self.pairing(row).swap(other | {Contact.share: share})
        side = lanes([owner], (), wide=True)
        fields = {
            field: lanewise(jnp.where, side, value, theirs[field]) for field, value in mine.items()
        }
        touch = which | (~owner & (fields[Contact.share].lane > 0))
        self.add(row, touch, fields | alike, self.block.column)

    def fold(self, row: Any, body: Callable, start: Any) -> Any:
        """See `BoundSlots`; items have their row's pairing and their cone."""
        pairing = self.pairing(row)
        mixed = self.set.with_itself and touches_itself(self.set.scene)

        def slot(item: Item, carry: Any) -> Any:
            other = self.read(Slot.other, item).lane if mixed else None
            return body(item._replace(pairing=pairing, cone=self.cone_of_row(row, other)), carry)

        return super().fold(row, slot, start)

    def fold_items(self, body: Callable, start: Any) -> Any:
        """See `BoundContacts`; over all slots in use."""
        size = self.set.size
        return loop(self.set.rows, lambda row, carry: self.fold(row, body, carry), start, size)

    def each_item(self, body: Callable[[Item], None]) -> None:
        """See `BoundContacts`; for all slots in use."""

        def slot(item: Item, nothing: list) -> list:
            body(item)
            return nothing

        self.fold_items(slot, [])

    def touching_now(self) -> jax.Array:
        def most(row: Any, count: jax.Array) -> jax.Array:
            return jnp.maximum(count, self.used(row))

        return jax.lax.fori_loop(0, self.set.rows, most, jnp.int32(0)) > 0

    def touching_worlds(self) -> jax.Array:
        """Lanes of the worlds that have filled any slot, bool, shape (lane,)."""
        assert self._counts is not None
        filled = total([jnp.where(word > 0, 1, 0) for word in self._counts.words])
        return self.block.fold(filled, jnp.maximum) > 0

    # One side's part of a contact

    def relative(self, item: Item) -> Lanes:
        """Relative acceleration of a slot's sides by the links', on its own side's lanes."""
        contacts = self.set.contacts
        pairing = item.pairing
        place = self.place(item)

        def of_side(field: Field) -> Lanes:
            link_acc = self._on_rows(item, field)

            def moved(place, cone, link_acc):
                return contacts(place, cone).relative(link_acc[:, None])

            return lanewise(moved, place, self.cone_at(item), link_acc)

        mine = of_side(Slot.row)
        if pairing.itself is None:
            return lanewise(jnp.subtract, mine, pairing.swap(mine))
        ways = (lambda: of_side(Slot.other)), (lambda: pairing.swap(mine))
        theirs = either(anywhere(pairing.itself), *ways, self.set.size)
        return lanewise(jnp.subtract, mine, theirs)

    def _on_rows(self, item: Item, field: Field) -> Lanes:
        """Accelerations of the links in a field of a slot's lanes; zeros where nothing touches."""
        if self.set.gathers:
            row = self.read(field, item).lane.astype(jnp.int32)
            return self.table.gather(Side.link_acc, row, self.block.column)
        start = zeros((6,), self.like)

        def take(row: Any, chosen: jax.Array, accs: Lanes) -> Lanes:
            new = self.table.read(Side.link_acc, row)
            return lanewise(jnp.where, lanes([chosen], (), wide=True), new, accs)

        return self._each_row(item, field, take, start)

    def keep_counts(self) -> None:
        """See `BoundSlots`; where lanes do not gather, lists the rows of each slot's lanes."""
        super().keep_counts()
        if self.set.gathers:
            return

        def store(item: Item) -> None:
            self._list_rows(item, Slot.row)
            if item.pairing.itself is not None:
                any_of(item.pairing.itself, lambda: self._list_rows(item, Slot.other))

        self.each_item(store)

    def _list_rows(self, item: Item, field: Field) -> None:
        """Lists the different rows at which a slot's lanes touch.

        The k-th row is stored on the k-th lane of the field's list, their number on all lanes.
        """
        nothing = jnp.full_like(self.like, -1.0)

        def step(carry: list) -> list:
            count, row, left, listed = carry
            left = jnp.where(left == row, -1, left)
            listed = jnp.where(self._lane() == count, row.astype(listed.dtype), listed)
            return [count + 1, jnp.max(left), left, listed]

        left = self._touched_rows(item, field)
        first = [jnp.int32(0), jnp.max(left), left, nothing]
        count, _, _, listed = jax.lax.while_loop(lambda c: c[1] >= 0, step, first)
        counts = self.like + count.astype(self.like.dtype)
        self.write(f"{field}_listed", lanes([listed], (1, 1), wide=True), item)
        self.write(f"{field}_count", lanes([counts], (1, 1), wide=True), item)

    def _touched_rows(self, item: Item, field: Field) -> jax.Array:
        """Row of each lane's side of a slot, int32, shape (lane,); -1 where nothing touches."""
        touches = self.read(Contact.share, item).lane > 0
        return jnp.where(touches, self.read(field, item).lane.astype(jnp.int32), -1)

    def _each_row(self, item: Item, field: Field, body: Callable, start: Any) -> Any:
        """Folds body(row, lanes that touch there, tree of lanes) over the rows of a slot's lanes.

        Few lanes of a block touch in one slot, at two rows if it is one contact: on CPUs whose
        vectors gather number by number that is faster than to gather.
        """
        rows = self._touched_rows(item, field)
        arrays, rebuild = solid(start, self.set.size)
        name = f"{self.set.name}.{field}"
        slot = item.source
        count = self.table.number(f"{name}_count", slot, 0).astype(jnp.int32)

        def step(carry: list) -> list:
            k, *values = carry
            row = self.table.number(f"{name}_listed", slot, k).astype(jnp.int32)
            new = solid(body(row, rows == row, rebuild(values)), self.set.size)[0]
            return [k + 1, *new]

        first = [jnp.int32(0), *arrays]
        return rebuild(jax.lax.while_loop(lambda c: c[0] < count, step, first)[1:])

    def clear_wrenches(self) -> None:
        def clear(row: Any, x: jax.Array) -> jax.Array:
            self.put(Side.wrench, zeros((6,), self.like), row)
            return x

        jax.lax.fori_loop(0, self.rows(), clear, jnp.int32(0))

    def own_side(self, item: Item) -> OwnSide:
        """Reads a slot's own side, for `load`; before anything of the slot is stored."""
        if not self.set.gathers:
            return OwnSide(self.place(item), None, None)
        row = self.read(Slot.row, item).lane.astype(jnp.int32)
        wrench = self.table.gather(Side.wrench, row, self.block.column)
        return OwnSide(self.place(item), row, wrench)

    def load(self, item: Item, side: OwnSide, force: Lanes) -> None:
        """Adds a slot's force to its own side's wrench, and takes it from the other side's."""
        pairing = item.pairing
        more = lanewise(wrench_of_force, side.place, self.cone_at(item), force)
        self._add_wrench(item, Slot.row, more, side.wrench, side.row)
        if pairing.itself is not None:

            def opposite() -> None:
                self._add_wrench(item, Slot.other, lanewise(jnp.negative, more))

            any_of(pairing.itself, opposite)

    def _add_wrench(
        self,
        item: Item,
        field: Field,
        more: Lanes,
        sums: Lanes | None = None,
        row: jax.Array | None = None,
    ) -> None:
        if self.set.gathers:
            if row is None or sums is None:
                row = self.read(field, item).lane.astype(jnp.int32)
                sums = self.table.gather(Side.wrench, row, self.block.column)
            sums = lanewise(jnp.add, sums, more)
            self.table.scatter(Side.wrench, sums, row, self.block.column)
            return

        def add(row: Any, chosen: jax.Array, nothing: list) -> list:
            mask = lanes([chosen], (), wide=True)
            self.put(Side.wrench, lanewise(_add_where, mask, self.wrench_on(row), more), row)
            return nothing

        self._each_row(item, field, add, [])

    # Newton's method

    def update_constraints(self, alpha: Lanes) -> None:
        """Adds the last step of the line search to jar; stores Hessians and adds up wrenches."""
        self.clear_wrenches()

        def store(item: Item) -> None:
            side = self.own_side(item)
            self.load(item, side, self.update_constraint(item, side.place, alpha))

        self.each_item(store)

    def update_wrenches(self, alpha: Lanes) -> None:
        """Adds up wrenches where the last step has moved jar, which is kept."""
        self.clear_wrenches()
        contacts = self.set.contacts

        def response(place, cone, alpha, jar, step):
            return contact.constraint_update(contacts(place, cone), jar + alpha * step).force

        def load(item: Item) -> None:
            side = self.own_side(item)
            jar = self.read(Contact.jar, item)
            step = self.read(Contact.step, item)
            force = lanewise(response, side.place, self.cone_at(item), alpha, jar, step)
            self.load(item, side, force)

        self.each_item(load)

    @staticmethod
    def times_hessian(hessian: Lanes, change: Lanes) -> Lanes:
        return lanewise(_times, hessian, change)

    def prepare_all(self) -> Lanes:
        def add(item: Item, sums: Lanes) -> Lanes:
            slope = self.line(item, self.relative(item))
            return lanewise(lambda s, h, f: s + h * f, sums, item.pairing.half, slope)

        return self.fold_items(add, self._zeros(())[0])

    def slopes_of_all(self, alpha: Lanes, sums: list[Lanes]) -> list[Lanes]:
        """Sums of the first and second derivative of the cost by the step length."""

        def add(item: Item, sums: list[Lanes]) -> list[Lanes]:
            new = self._slopes(item, alpha)
            return lanewise(tree_add_scaled, item.pairing.half, sums, new)

        return self.fold_items(add, sums)


def _only_where(mask, value):
    return jnp.where(mask, value, 0.0)


def _deeper_in_palm(depth, other, share, gap):
    """The larger of a depth and that of a contact with the palm, whose link is 0."""
    touches = (share[0] > 0) & (other < 0.5)
    return jnp.maximum(depth, jnp.where(touches, -gap[0], 0.0))


def _where(mask, chosen, other):
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), chosen, other)


def _add_where(chosen, sums, more):
    return sums + jnp.where(chosen, more, 0.0)


def _times(triangle: jax.Array, x: jax.Array) -> jax.Array:
    """A symmetric matrix, given by its upper triangle row by row, times a vector."""
    n = x.shape[0]
    place = {(i, j): k for k, (i, j) in enumerate((i, j) for i in range(n) for j in range(i, n))}
    rows = [jnp.stack([triangle[place[min(i, j), max(i, j)]] for j in range(n)]) for i in range(n)]
    return jnp.stack([dot(row, x) for row in rows])


def wrench_of_force(place, cone, force):
    """Wrench (6,) of the forces of a slot's contacts."""
    return sum_axis(contact.contact_wrench(ContactSet.contacts(place, cone), force), 1)
