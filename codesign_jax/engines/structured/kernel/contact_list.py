"""The contacts of a pair of bodies: one list for each pair, and all that is done with one item.

An item is a contact, or the few of a link or a group, see `placement`.  What the solver keeps of it
is declared in `rows.Contact`; where it touches is `kinds.KINDS`; its law is `laws.contact`.  Where
no lane of the block has an active contact, an item with a fixed place is skipped.

Contacts of the hand with itself are one list, "finger_finger": of fingers with one another, with
themselves and with the palm.  A contact of two fingers is stored on the lanes of both: each lane
keeps its own finger's side.  Fingers are paired by the exclusive or of their indices with 1, 2, and
so on, which reaches every pair; a row of slots belongs to one such number.  Both lanes of a pair
put the same contact into the same slot, so that they process it at the same time and exchange
numbers in registers.  Contacts of a finger with the palm or with itself are a row of slots as well,
with the number 0: they are on the finger's lane alone, which has both sides.  How their forces are
laid on their sides is in `sides`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import rows
from codesign_jax.engines.structured.kernel.memory import (
    Block,
    BoundTable,
    anywhere,
    full,
    loop,
    solid,
    tree_add_scaled,
    upper,
    zeros,
)
from codesign_jax.engines.structured.kernel.pairing import FingerPairing
from codesign_jax.engines.structured.kernel.placement import Appended, Cells, Fixed, Item
from codesign_jax.engines.structured.kernel.rows import (
    Contact,
    Group,
    Rows,
    Slot,
    SlotCount,
    TeamRing,
    TeamSlot,
)
from codesign_jax.engines.structured.kernel.shared_memory import TEAM
from codesign_jax.engines.structured.lanes import dot, sum_axis, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, holding
from codesign_jax.engines.structured.laws.cones import friction_by_contact, which_cone
from codesign_jax.engines.structured.laws.contact import Cone, Contacts, LineCost
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.model.held import held
from codesign_jax.model.layout import touches_itself
from codesign_jax.scene import Scene

SELF = "finger_finger"
"""The list of the hand's contacts with itself."""
# Numbers of a contact's line, by friction model.
LINE = {"none": 2, "coulomb": 5}
# Fields of a cone that a friction model does not need.
NEEDLESS = {
    "none": ("tangential_mass", "friction", "regularized_friction"),
    "coulomb": (),
}


def cone_fields(scene: Scene) -> list[str]:
    """Numbers of a cone that a scene's friction model needs."""
    return [name for name in Cone._fields if name not in NEEDLESS[scene.effects.friction]]


def cone_of(scene: Scene, numbers: Any) -> Cone:
    """The cone of a scene's contacts from its numbers, in the order of `cone_fields`."""
    fields: dict[str, Any] = dict.fromkeys(Cone._fields)
    return Cone(**fields | {name: numbers[i] for i, name in enumerate(cone_fields(scene))})


class ContactLayout:
    """The contacts of a pair of bodies as a kernel's layout knows them: their rows in memory.

    Attributes:
      name: The pair of bodies.
      k: Contacts of an item.
      placement: Where they are.
      of_hand: Whether they are the hand's contacts with itself.
      per_link: Whether items are a finger's links; with teams its rings.
      on_object: Whether the second body is the object.
      holds: Whether each contact holds friction; those of the hand share it, `friction_memory`.
      with_itself: Whether a finger is its own partner in a row of slots, the first one.
      first: Number of the pairing that the first row of slots belongs to.
      stores_all: Whether places are stored where nothing touches as well, to be recorded.
    """

    def __init__(
        self,
        scene: Scene,
        name: str,
        k: int,
        placement: Fixed | Appended,
        *,
        remembers: tuple[type[Rows], ...] = (),
        touch: bool = False,
    ):
        """Prepares the list.

        Args:
          remembers: Numbers that are kept of each slot beside its contact, see `remembered`.
          touch: Whether places of contacts with the object are recorded.
        """
        self.scene = scene
        self.name = name
        self.k = k
        self.placement = placement
        self.remembers = remembers
        self.of_hand = name == SELF
        self.per_link = name.startswith("finger_") and not self.of_hand
        self.on_object = name.endswith("_object")
        self.friction_by_contact = friction_by_contact(scene, name)
        self.holds = name in held(scene) and not self.of_hand
        self.with_itself = self.of_hand and (scene.effects.finger_palm or touches_itself(scene))
        self.first = int(not self.with_itself)
        self.stores_all = touch and self.on_object

    @property
    def places(self) -> Fixed:
        """The placement of contacts with a field."""
        assert isinstance(self.placement, Fixed)
        return self.placement

    @property
    def slots(self) -> Appended:
        """The placement of the hand's contacts with itself."""
        assert isinstance(self.placement, Appended)
        return self.placement

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of the axes of `rows`."""
        return {
            rows.ONE: 1,
            rows.ITEM: self.placement.items,
            rows.CONTACTS: self.k,
            rows.RAY: LINE[self.scene.effects.friction],
            rows.TOUCH: self.placement.recorded * self.k,
            rows.SLOT_ROW: self.placement.rows,
            rows.SPARE: TEAM - 6,
        }

    def groups_of(self, *tables: type[Rows]) -> dict[str, Group]:
        """The rows of declared ones that the list has."""
        groups: dict[str, Group] = {}
        for table in tables:
            for field, group in table.groups(self, self.sizes).items():
                groups[f"{self.name}.{field}"] = group
        return groups

    def item_groups(self) -> dict[str, Group]:
        """Rows that have an item each, in scratch memory."""
        shared = self.placement.shared
        if not self.of_hand:
            return self.groups_of(Contact, *([TeamRing] if shared else []))
        return self.groups_of(Contact, Slot, *([TeamSlot] if shared else []), *self.remembers)

    def groups(self) -> dict[str, Group]:
        """All rows of the list in scratch memory."""
        return self.item_groups() | (self.groups_of(SlotCount) if self.placement.rows else {})

    def pairs(self) -> list[str]:
        """Pairs of bodies whose cones the list has: of the hand's up to two."""
        if not self.of_hand:
            return [self.name]
        e = self.scene.effects
        on = {
            SELF: e.finger_finger or touches_itself(self.scene),
            "finger_palm": e.finger_palm,
        }
        return [pair for pair in on if on[pair]]

    def cone_rows(self) -> dict[str, Group]:
        """Rows of the cones in the table of worlds."""
        shape = (len(cone_fields(self.scene)),)
        return {f"cone.{which_cone(pair)}": (1, shape) for pair in self.pairs()}

    def cone(self, read: Callable[[str], Lanes], pair: str) -> Cone:
        """The cone of a pair of bodies; `read` reads constants of the worlds by name."""
        return cone_of(self.scene, read(f"cone.{which_cone(pair)}"))

    def bind(self, table: BoundTable, block: Block, read: Callable[[str], Lanes]) -> "ContactList":
        """The list in a kernel's memory.

        Args:
          table: The table that has its rows.
          block: The lanes.
          read: Reads constants of the worlds by name.
        """
        cones = {pair: self.cone(read, pair) for pair in self.pairs()}
        return ContactList(self, Cells(table, self.name, block), cones)


class ContactList:
    """The contacts of a pair of bodies in a kernel.

    It is a value: `masked` and `counted` give another list of the same memory.

    Attributes:
      layout: What they are.
      cells: Their memory.
      cones: The cones by pair of bodies, numbers of a world.
      block: The lanes; `size`: their number; `like`: zeros of their shape and type.
    """

    def __init__(self, layout: ContactLayout, cells: Cells, cones: dict[str, Cone]):
        self.layout = layout
        self.cells = cells
        self.cones = cones
        self.block = cells.block
        self.size = cells.block.size
        self.like = cells.like

    # Passes over the items

    def fold(self, body: Callable, start: Any) -> Any:
        """Folds body(item, tree of lanes) over all items: links, groups, or slots in use."""
        if not self.layout.of_hand:
            return self.layout.places.fold(self.cells, body, start)
        rows = self.layout.slots.rows
        return loop(
            rows, lambda slot_row, carry: self.fold_row(slot_row, body, carry), start, self.size
        )

    def each(self, body: Callable[[Item], None]) -> None:
        """Runs body(item), which stores something, for all items."""

        def step(item: Item, nothing: list) -> list:
            body(item)
            return nothing

        self.fold(step, [])

    def fold_row(self, slot_row: Any, body: Callable, start: Any) -> Any:
        """`fold` over a row of slots; items have their row's pairing and their cone."""
        pairing = self.pairing(slot_row)
        mixed = self.layout.with_itself and touches_itself(self.layout.scene)

        def slot(item: Item, carry: Any) -> Any:
            other = self.read(Slot.other_side, item).lane if mixed else None
            return body(
                item._replace(pairing=pairing, cone=self.cone_of_row(slot_row, other)), carry
            )

        return self.layout.slots.fold_row(self.cells, slot_row, slot, start)

    def masked(self, busy: jax.Array) -> "ContactList":
        """The list whose passes go through the slots that the lanes `busy` have filled.

        What a pass makes of other worlds is of no use.
        """
        assert self.cells.filled is not None
        cells = self.cells._replace(filled=self.cells.filled.masked(busy))
        return ContactList(self.layout, cells, self.cones)

    # One item: its memory

    def read(self, field: str, item: Item) -> Lanes:
        """A field of the item's contacts, shape (component, k, finger, world)."""
        return self.cells.read(field, item)

    def write(self, field: str, value: Lanes, item: Item) -> None:
        """Stores a field of the item's contacts."""
        self.cells.write(field, value, item)

    def place(self, item: Item) -> Place:
        """Where the item's contacts are."""
        return Place(*(self.read(field, item) for field in Place._fields))

    def cone_at(self, item: Item) -> Cone:
        """The cone of the item's contacts."""
        if item.cone is not None:
            return item.cone
        cone = self.cones[self.layout.name]
        if not self.layout.friction_by_contact:
            return cone
        return lanewise(Cone.of_friction, cone, self.read(Contact.friction, item)[0])

    def touching(self, item: Item) -> jax.Array:
        """Whether any lane's contact is active, a scalar."""
        shares = self.read(Contact.share, item).parts.ravel()
        mask = shares[0] > 0
        for share in shares[1:]:
            mask = mask | (share > 0)
        return anywhere(mask)

    def if_touching(self, item: Item, compute: Callable, parts: list[tuple]) -> list[Lanes]:
        """compute() where a lane touches, zeros of wide shapes elsewhere."""
        empty = [zeros(shape, self.like) for shape in parts]
        none, rebuild = solid(empty, self.size)

        def some() -> list[jax.Array]:
            return solid(compute(), self.size)[0]

        return rebuild(jax.lax.cond(self.touching(item), some, lambda: none))

    # One item: how it begins

    def create(
        self,
        item: Item,
        place: Place,
        acc: Lanes,
        vel: Lanes,
        friction: Lanes | None = None,
        hold: tuple[Lanes, Lanes] | None = None,
    ) -> None:
        """Stores contacts of a link's or a group's places.

        Args:
          acc: Relative spatial acceleration of the bodies, (6, ...); `vel`: relative velocity.
          friction: Coulomb coefficients (1, k) of contacts that have their own.
          hold: What they hold of friction, (3, k), along the world's axes and as it is kept.
        """
        if friction is not None:
            self.write(Contact.friction, friction, item)
        place, jar = self.begin(place, self.cone_at(item), acc, vel)
        more = {}
        if hold is not None:
            jar = lanewise(with_held, jar, place, self.cone_at(item), hold[0])
            more = {Contact.held_friction: hold[1]}
        self.write(Contact.share, place.share, item)

        def store() -> None:
            for field, value in (fields_of(place, jar) | more).items():
                self.write(field, value, item)

        if self.layout.stores_all:
            store()
        else:
            jax.lax.cond(self.touching(item), store, lambda: None)

    def begin(self, place: Place, cone: Cone, acc: Lanes, vel: Lanes) -> tuple[Place, Lanes]:
        """Places whose share is zero where no candidate is, and their jar; rest as in `create`."""
        run = partial(as_candidates, margin(self.layout.scene))
        return lanewise(run, place, cone, acc, vel)

    def deepest(self) -> Lanes:
        """The largest depth of all contacts of the lanes [m], zero where nothing overlaps."""

        def deeper(item: Item, depth: Lanes) -> Lanes:
            fields = (self.read(name, item) for name in (Contact.share, Contact.gap))
            return lanewise(_deeper, depth, *fields)

        return self.fold(deeper, zeros((), self.like))

    # One item: its part of Newton's method

    def inertia_and_wrench(self, item: Item, alpha: Lanes) -> tuple[Lanes, Lanes]:
        """Adds the last step to jar; returns the contacts' inertia (6, 6) and wrench (6,) there."""

        def compute() -> list[Lanes]:
            # All is read before anything is stored, see `sides.OwnSide`.
            jar = self.read(Contact.jar, item)
            step = self.read(Contact.jar_step, item)
            place = self.place(item)
            jar = lanewise(tree_add_scaled, alpha, jar, step)
            self.write(Contact.jar, jar, item)
            matrix, wrench = lanewise(inertia_and_wrench, place, self.cone_at(item), jar)
            return [upper(matrix), wrench]

        triangle, wrench = self.if_touching(item, compute, [(21,), (6,)])
        return full(triangle), wrench

    def wrench(self, item: Item, alpha: Lanes) -> Lanes:
        """Wrench (6,) of the item's contacts where the last step has moved jar, which is kept."""

        def response(place, cone, alpha, jar, step):
            c = make_contacts(place, cone)
            force = contact.constraint_update(c, jar + alpha * step).force
            return sum_axis(contact.contact_wrench(c, force), 1)

        def compute() -> list[Lanes]:
            jar = self.read(Contact.jar, item)
            step = self.read(Contact.jar_step, item)
            given = self.place(item), self.cone_at(item), alpha, jar, step
            return [lanewise(response, *given)]

        return self.if_touching(item, compute, [(6,)])[0]

    def update_constraint(self, item: Item, place: Place, alpha: Lanes) -> Lanes:
        """Adds the last step to jar; stores the Hessian and returns the force, (3, k).

        Args:
          place: Where the contacts are.
        """

        def response(place, cone, jar):
            update = contact.constraint_update(make_contacts(place, cone), jar)
            return update.hessian, update.force

        jar = lanewise(
            tree_add_scaled, alpha, self.read(Contact.jar, item), self.read(Contact.jar_step, item)
        )
        self.write(Contact.jar, jar, item)
        hessian, force = lanewise(response, place, self.cone_at(item), jar)
        self.write(Slot.hessian, hessian, item)  # with a fixed place `TeamRing.hessian`
        return force

    def force_after(self, item: Item, place: Place, alpha: Lanes) -> Lanes:
        """Force (3, k) where the last step has moved jar, which is kept; `place` as above."""

        def response(place, cone, alpha, jar, step):
            return contact.constraint_update(make_contacts(place, cone), jar + alpha * step).force

        jar = self.read(Contact.jar, item)
        step = self.read(Contact.jar_step, item)
        return lanewise(response, place, self.cone_at(item), alpha, jar, step)

    @staticmethod
    def times_hessian(hessian: Lanes, change: Lanes) -> Lanes:
        """The Hessian (6, k) that `update_constraint` stores times a change of jar, (3, k)."""
        return lanewise(symmetric_times, hessian, change)

    def changes(self, item: Item, alpha: Lanes) -> Lanes:
        """How many of the item's contacts the last step takes to another zone of the cone."""

        def count(share, cone, ray, alpha):
            c = make_line_contacts(share, cone)
            line = LineCost(*(ray[i] if i < ray.shape[0] else None for i in range(5)))
            return sum_axis(jnp.where(contact.same_zone(c, line, alpha), 0.0, 1.0), 0)

        def compute() -> list[Lanes]:
            share = self.read(Contact.share, item)
            cone = self.cone_at(item)
            return [lanewise(count, share, cone, self.read(Contact.ray, item), alpha)]

        return self.if_touching(item, compute, [()])[0]

    def relative_acceleration(self, item: Item, acc: Lanes) -> Lanes:
        """Accelerations (3, k) of contact points in their axes, by that of the bodies (6, ...)."""

        def relative(place, cone, acc):
            return make_contacts(place, cone).relative(acc[:, None])

        return lanewise(relative, self.place(item), self.cone_at(item), acc)

    def prepare_linesearch(self, item: Item, step: Lanes) -> Lanes:
        """Stores the cost along a step (6, ...) of the acceleration; returns its slope at 0."""

        def compute() -> list[Lanes]:
            return [self.line(item, self.relative_acceleration(item, step))]

        return self.if_touching(item, compute, [()])[0]

    def line(self, item: Item, change: Lanes) -> Lanes:
        """Stores the contacts' cost along a change of jar; returns its slope at 0."""
        given = self.place(item), self.cone_at(item), self.read(Contact.jar, item), change
        line, slope = lanewise(cost_along_line, *given)
        self.write(Contact.jar_step, change, item)
        self.write(Contact.ray, line, item)
        return slope

    def slopes(self, item: Item, alpha: Lanes) -> list[Lanes]:
        """First and second derivative of the item's cost by the step length, at alpha."""
        return self.if_touching(item, lambda: self._slopes(item, alpha), [(), ()])

    def _slopes(self, item: Item, alpha: Lanes) -> list[Lanes]:
        share = self.read(Contact.share, item)
        cone = self.cone_at(item)
        return lanewise(slopes_along_line, share, cone, self.read(Contact.ray, item), alpha)

    def slopes_of_all(self, alpha: Lanes, sums: list[Lanes]) -> list[Lanes]:
        """Adds both of all slots in use to sums; two fingers' contact counts half on either."""

        def add(item: Item, sums: list[Lanes]) -> list[Lanes]:
            new = self._slopes(item, alpha)
            return lanewise(tree_add_scaled, item.pairing.half, sums, new)

        return self.fold(add, sums)

    def record(self, table: BoundTable, name: str, value: Lanes, item: Item) -> None:
        """Writes a field of `rows.TouchForce` of an item's contacts, (..., k)."""
        for j in range(self.layout.k):
            part = value[..., j, :, :]
            if jnp.ndim(item.source):
                table.scatter(name, part, item.source, self.block.column)
            else:
                table.write(name, part, item.number * self.layout.k + j)

    # Slots, as contacts are found

    def clear(self, slot_row: Any) -> None:
        """Empties a row of slots."""
        self.layout.slots.clear(self.cells, slot_row)

    def append(self, slot_row: Any, which: jax.Array, fields: dict[str, Lanes]) -> None:
        """Gives contacts a slot of a row.

        Args:
          slot_row: The row, a scalar.
          which: Lanes that have found one, bool, shape (lane,).
          fields: What is kept of them, by field, (component, 1, ...).
        """
        self.layout.slots.append(self.cells, slot_row, which, fields)

    def enter(
        self,
        slot_row: Any,
        which: jax.Array,
        owner: jax.Array,
        mine: dict,
        other: dict,
        alike: dict,
    ) -> None:
        """Gives contacts of two fingers a slot on both of their lanes.

        Args:
          slot_row: The row of slots of the fingers' pairing, a scalar.
          which: Lanes that have found a contact, a part of `owner`, of which each pair of lanes has
            one.
          mine: What the finder keeps, by field; `other`: its partner; `alike`: each of its own
            side.
        """
        share = lanewise(_only_where, lanes([which], (), wide=True), other[Contact.share])
        theirs = self.pairing(slot_row).swap(other | {Contact.share: share})
        side = lanes([owner], (), wide=True)
        fields = {
            field: lanewise(jnp.where, side, value, theirs[field]) for field, value in mine.items()
        }
        touch = which | (~owner & (fields[Contact.share].lane > 0))
        self.append(slot_row, touch, fields | alike)

    def remembered(self, numbers: dict[str, Any]) -> dict[str, Lanes]:
        """Fields of the numbers, the same or different on the lanes, that the list remembers."""
        none = self.like
        names = [name for table in self.layout.remembers for name in table.fields()]
        return {
            name: lanes([none + jnp.asarray(number).astype(none.dtype)], (1, 1), wide=True)
            for name, number in numbers.items()
            if name in names
        }

    def write_empty(self) -> None:
        """Stores what lanes without a contact read, if they do."""
        if (empty := self.layout.placement.empty) is not None:
            self.cells.write_empty(self.layout.item_groups(), empty)

    def counted(self) -> "ContactList":
        """The list for passes through its slots, when all contacts are found."""
        cells = self.layout.slots.counted(self.cells)
        self.write_empty()
        return ContactList(self.layout, cells, self.cones)

    def overflow(self) -> jax.Array:
        """One for lanes that had too few slots in any row, else zero, shape (lane,)."""
        return self.layout.slots.overflow(self.cells)

    # Slots, when all are found

    def pairing(self, slot_row: Any) -> FingerPairing:
        """The pairs of fingers whose contacts are in a row of slots, a scalar."""
        number = slot_row + self.layout.first
        with_itself = self.layout.with_itself
        return FingerPairing(self.block, number, self.like.dtype, with_itself=with_itself)

    def cone_of_row(self, slot_row: Any, other: Any = None) -> Cone:
        """The cone of a row's contacts; other: second sides, of which 0 is the palm."""
        if len(self.cones) == 1:
            return next(iter(self.cones.values()))
        palm = jnp.full((self.size,), jnp.equal(slot_row, 0))
        if other is not None:
            palm &= other < 0.5
        here = lanes([palm], (), wide=other is not None)
        return lanewise(_where, here, self.cones["finger_palm"], self.cones[SELF])

    def held_part(self, item: Item) -> Lanes:
        """One for contacts whose friction is kept, zero for those with the palm."""
        pairing = item.pairing
        kept = jnp.ones_like(self.like)
        if pairing.itself is not None:
            palm = pairing.itself & (self.read(Slot.other_side, item).lane < 0.5)
            kept = jnp.where(palm, 0.0, kept)
        return lanes([kept], (), wide=True)

    def deepest_in_palm(self, depth: Lanes) -> Lanes:
        """The larger of a depth and those of the fingers' contacts with the palm [m]."""

        def deeper(item: Item, depth: Lanes) -> Lanes:
            fields = (self.read(name, item)[0] for name in (Contact.share, Contact.gap))
            return lanewise(_deeper_in_palm, depth, self.read(Slot.other_side, item)[0, 0], *fields)

        return self.layout.slots.fold_row(self.cells, 0, deeper, depth)

    def touching_now(self) -> jax.Array:
        """Whether any slot is in use, a scalar."""
        slots = self.layout.slots

        def most(slot_row: Any, count: jax.Array) -> jax.Array:
            return jnp.maximum(count, slots.used(self.cells, slot_row))

        return jax.lax.fori_loop(0, slots.rows, most, jnp.int32(0)) > 0

    def touching_worlds(self) -> jax.Array:
        """Lanes of the worlds that have filled any slot, bool, shape (lane,)."""
        assert self.cells.filled is not None
        filled = total([jnp.where(word > 0, 1, 0) for word in self.cells.filled.words])
        return self.block.fold(filled, jnp.maximum) > 0


def make_contacts(place: Place, cone: Cone) -> Contacts:
    """An item's contacts for their law."""
    return Contacts(place.point, place.normal, place.gap, cone.of_share(place.share))


def make_line_contacts(share: jax.Array, cone: Cone) -> Contacts:
    """What a line search needs of contacts: their cone; it asks for no place."""
    return Contacts(share[None], share[None], share, cone.of_share(share))


# Stages that the kernel evaluates lane by lane


def inertia_and_wrench(place, cone, jar):
    """Sums over an item's contacts: the inertia (6, 6) that they add, and their wrench (6,)."""
    c = make_contacts(place, cone)
    r = contact.constraint_update(c, jar)
    matrix = contact.contact_inertia(c, r.hessian)
    return sum_axis(matrix, 2), sum_axis(contact.contact_wrench(c, r.force), 1)


def cost_along_line(place, cone, jar, change):
    """Numbers of the contacts' cost along a change of jar, see `LineCost`, and its slope at 0."""
    c = make_contacts(place, cone)
    line = contact.line(c, jar, change)
    first, _ = contact.slopes(c, line, 0.0)
    return jnp.stack([v for v in line if v is not None]), sum_axis(first, 0)


def slopes_along_line(share, cone, ray, alpha):
    """First and second derivative of that cost at alpha, summed over an item's contacts."""
    c = make_line_contacts(share, cone)
    line = LineCost(*(ray[i] if i < ray.shape[0] else None for i in range(5)))
    first, second = contact.slopes(c, line, alpha)
    return [sum_axis(first, 0), sum_axis(second, 0)]


def force_of_jar(place, cone, jar):
    """Forces (3, k) of contacts on their first body [N], world axes."""
    contacts = make_contacts(place, cone)
    force = contact.constraint_update(contacts, jar).force[:3]
    return jnp.where(contacts.active, force, 0.0)


def margin(scene: Scene) -> float:
    """Gap that may close within a step [m]."""
    return contact.MARGIN if scene.effects.surface == "hull" else 0.0


def with_held(jar: jax.Array, place: Place, cone: Cone, held_friction: jax.Array) -> jax.Array:
    """The jar of contacts with the friction that they hold, see `holding.held`."""
    return jar + holding.held(make_contacts(place, cone), held_friction)


def fields_of(place: Place, jar: Lanes) -> dict[str, Lanes]:
    """What is kept of new contacts, by field."""
    return {**place._asdict(), Contact.jar: jar, Contact.jar_step: lanewise(jnp.zeros_like, jar)}


def as_candidates(
    margin: float, place: Place, cone: Cone, acc: jax.Array, vel: jax.Array
) -> tuple[Place, jax.Array]:
    """Places whose share is zero where no candidate is, and their jar, see `ContactList.create`."""
    c = make_contacts(place, cone)
    speed = c.relative(vel[:, None])
    approach = -dot(place.normal, speed)
    share = contact.candidates(place.share, place.gap, approach, cone, margin)
    return place._replace(share=share), c.relative(acc[:, None]) - c.reference(speed)


def _deeper(depth, share, gap):
    """The larger of a depth and those of contacts that touch."""
    for k in range(gap.shape[0]):
        depth = jnp.maximum(depth, jnp.where(share[k] > 0, -gap[k], 0.0))
    return depth


def _deeper_in_palm(depth, other, share, gap):
    """The larger of a depth and that of a contact with the palm, whose link is 0."""
    touches = (share[0] > 0) & (other < 0.5)
    return jnp.maximum(depth, jnp.where(touches, -gap[0], 0.0))


def _only_where(mask, value):
    return jnp.where(mask, value, 0.0)


def _where(mask, chosen, other):
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), chosen, other)


def symmetric_times(triangle: jax.Array, x: jax.Array) -> jax.Array:
    """A symmetric matrix, given by its upper triangle row by row, times a vector."""
    n = x.shape[0]
    place = {(i, j): k for k, (i, j) in enumerate((i, j) for i in range(n) for j in range(i, n))}
    rows = [jnp.stack([triangle[place[min(i, j), max(i, j)]] for j in range(n)]) for i in range(n)]
    return jnp.stack([dot(row, x) for row in rows])
