"""Contacts between fingers in the kernel.

A contact is stored on the lanes of both fingers; each lane keeps its own finger's side of it.
Fingers are paired by the exclusive or of their indices with 1, 2, and so on, which reaches every
pair; a row of slots belongs to one such number.  Both lanes of a pair put the same contact into the
same slot, so that they process it at the same time and exchange numbers in registers.  The side of
a contact is a joint's row as in `laws.hull`; a sphere follows the link before that joint.

Contacts of fingers with the palm are a row of slots as well, with the number 0: they are on the
finger's lane alone.  The sides' motions are relative to the palm's then, which changes nothing
between two fingers, as a rigid body's velocity is affine in the point.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import ROWS, ContactSet, zeros
from codesign_jax.engines.structured.kernel.memory import Block, MemoryLayout, loop, solid
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.slots import BoundSlots, HullSet, any_of
from codesign_jax.engines.structured.kernel.solver import tree_add_scaled
from codesign_jax.engines.structured.lanes import dot, sum_axis, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact
from codesign_jax.engines.structured.laws.contact import Contacts
from codesign_jax.engines.structured.laws.hull import across
from codesign_jax.scene import Scene


def pair_slots(scene: Scene) -> int:
    """Slots of a pair of fingers; a world with more contacts fails (CONTACT_OVERFLOW)."""
    d = scene.discretization
    if scene.effects.surface == "hull":
        return 8 * (d.links + 1) * max(1, d.hull_rings * d.hull_points // 16)
    return min(4 * d.links * d.spheres_per_link, (d.links * d.spheres_per_link) ** 2)


class PairSet(HullSet):
    """Contacts between fingers; a row is a pairing of all fingers."""

    def __init__(
        self,
        scene: Scene,
        block: tuple[int, int],
        links: int,
        slots: int,
        *,
        gathers: bool,
        remembers: tuple[str, ...] = (),
    ):
        """Prepares the set.

        Args:
          scene: The scene.
          block: Fingers, a power of two, and worlds of a block.
          links: Moving links of a finger.
          slots: Slots of a pairing, on each lane.
          gathers: Whether lanes read rows of their own as fast as a common one: on GPUs.
          remembers: As in `SlotSet`.
        """
        fingers, worlds = block
        e = scene.effects
        self.palm, self.first = e.finger_palm, int(not e.finger_palm)
        rows = fingers - self.first if e.finger_finger else 1
        how = "finger_finger", rows, slots, fingers * worlds
        super().__init__(scene, *how, gathers=gathers, remembers=remembers)
        self.block, self.links = block, links
        self.skin = scene.effects.surface == "hull"
        if not self.skin:
            self.places, self.of_lines = ContactSet.places, ContactSet.of_lines
        n = ROWS[scene.effects.friction][0]
        self.more = {"row": 1, "hessian": n * (n + 1) // 2}
        self.more |= {f: n for f in ("first", "left", "answer", "along", "moved", "sum")}
        if self.skin:
            self.more |= HullSet.more

    def cone_rows(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """See `ContactSet`; one cone between fingers and one on the palm, if there are both."""
        (shape,) = super().cone_rows().values()
        return {f"cone.{name}": shape for name in self._names()}

    def _names(self) -> list[str]:
        e = self.scene.effects
        on = {"finger_finger": e.finger_finger, "finger_palm": e.finger_palm}
        return [name for name in on if on[name]]

    @property
    def components(self) -> int:
        """Components of a side's motion and wrench."""
        return 9 if self.skin else 6

    def groups(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """See `ContactSet`; and the sides of all fingers, from the palm to the tips."""
        sides = {"motion": 6, "vel": 6, "push": self.components}
        sides |= {"turn": 3} if self.skin else {}
        rows = {f"side.{name}": (self.links + 1, (n,)) for name, n in sides.items()}
        return super().groups() | rows

    @property
    def contacts(self) -> Callable[[tuple, contact.Cone], Contacts]:
        """See `ContactSet`; a lever is that of the lane's own side."""
        return (HullSet if self.skin else ContactSet).contacts

    @property
    def of_line(self) -> Callable[[tuple, contact.Cone], Contacts]:
        """See `ContactSet`."""
        return (HullSet if self.skin else ContactSet).of_line

    def bind(self, table: MemoryLayout, ref: Any, read: Callable[[str], Lanes]) -> "BoundPairs":
        """See `ContactSet`."""
        cones = {name: self.cone(read, name) for name in self._names()}
        return BoundPairs(self, table, ref, cones)


class OwnSide(NamedTuple):
    """What `BoundPairs.load` needs of a slot's own side, read before anything is stored.

    NVIDIA's assembler moves no load before a store that might be to the same place, so a thread
    waits a second time for what is read behind a store.

    Attributes:
      place: Where the contact is, see `ContactSet.places`.
      row: Row of each lane's side, int32, shape (lane,); None where lanes do not gather.
      wrench: Wrench of all contacts so far on that row, (6 or 9, ...); None likewise.
    """

    place: tuple[Lanes, ...]
    row: jax.Array | None
    wrench: Lanes | None


class BoundPairs(BoundSlots):
    """Contacts between fingers with their memory."""

    set: PairSet  # type: ignore[assignment]

    def __init__(self, of: PairSet, table: MemoryLayout, ref: Any, cones: dict[str, contact.Cone]):
        """See `ContactSet.bind`; the cones by name."""
        super().__init__(of, table, ref, next(iter(cones.values())))
        self.block, self._cones = Block(*of.block), cones
        self._palm: Lanes | None = None

    def pairing(self, row: Any) -> Pairing:
        """A row's pairing of the fingers."""
        return Pairing(self.block, row + self.set.first, self.ref.dtype, palm=self.set.palm)

    def of_row(self, row: Any) -> contact.Cone:
        """The cone of a row's contacts."""
        if len(self._cones) == 1:
            return self.cone
        here = lanes([jnp.full((self.set.size,), jnp.equal(row, 0))], (), wide=False)
        between, palm = (self._cones[name] for name in ("finger_finger", "finger_palm"))
        return lanewise(_where, here, palm, between)

    @contextlib.contextmanager
    def with_cone(self, row: Any) -> Iterator[None]:
        """Within this context contacts have the cone of a row's."""
        before, self.cone = self.cone, self.of_row(row)
        yield
        self.cone = before

    def side(self, name: str, row: Any) -> Lanes:
        """Motion of a row, (6 or 9, ...): of the link before a joint, and the joint's turning."""
        before = self.table.read(self.ref, f"side.{name}", row)
        if not self.set.skin:
            return before
        behind = jnp.minimum(row + 1, self.set.links)
        after = self.table.read(self.ref, f"side.{name}", behind)
        return lanewise(lambda a, b: across(a, b, None), before, after)

    def put(self, name: str, value: Lanes, row: Any) -> None:
        """Stores what a row's link before its joint does; row 0 is the palm's."""
        self.table.write(self.ref, f"side.{name}", value, row)

    def beside_palm(self, motion: Lanes, palm: Lanes | None) -> Lanes:
        """A motion relative to the palm's, where contacts with the palm need it."""
        return motion if palm is None or not self.set.palm else lanewise(_minus, motion, palm)

    def put_palm(self, motion: Lanes) -> None:
        """Stores the palm's motion along a step; the tip, which has no joint, does not turn."""
        self._palm = motion
        self.put("motion", self.beside_palm(motion, motion), 0)
        if self.set.skin:
            like = jnp.zeros((self.set.size,), self.ref.dtype)
            self.put("turn", zeros((3,), like), self.set.links)

    def put_link(self, i: Any, before: Lanes, motion: Lanes) -> None:
        """Stores a link's motion along a step, and how the joint between it and `before` turns."""
        self.put("motion", self.beside_palm(motion, self._palm), i + 1)
        if self.set.skin:
            self.put("turn", lanewise(lambda a, b: b[:3] - a[:3], before, motion), i)

    def pushed(self, row: Any) -> Lanes:
        """Wrench of all contacts of a row's own side, (6 or 9, ...)."""
        return self.table.read(self.ref, "side.push", row)

    def rows(self) -> int:
        """Number of a finger's rows."""
        return self.set.links + 1

    # Slots

    def enter(
        self, row: Any, which: jax.Array, owner: jax.Array, mine: dict, other: dict, alike: dict
    ) -> None:
        """Gives contacts a slot on both of their lanes.

        Args:
          row: The pairing.
          which: Lanes that have found a contact, a part of `owner`.
          owner: Lanes that look for contacts, one of each pair of lanes.
          mine: What the finder keeps, by field.
          other: What its partner keeps.
          alike: What every lane knows of its own side.
        """
        gap = lanewise(
            lambda w, g: jnp.where(w, g, 1.0), lanes([which], (), wide=True), other["gap"]
        )
        theirs = self.pairing(row).swap(other | {"gap": gap})
        side = lanes([owner], (), wide=True)
        fields = {
            field: lanewise(jnp.where, side, value, theirs[field]) for field, value in mine.items()
        }
        touch = which | (~owner & (fields["gap"].lane < 0))
        self.add(row, touch, fields | alike, self.block.own)

    def each(self, body: Callable, start: Any) -> Any:
        """Folds body(item, pairing, tree of lanes) over all slots in use."""

        def of_row(row: Any, carry: Any) -> Any:
            pairing = self.pairing(row)
            with self.with_cone(row):
                return self.fold(row, lambda item, c: body(item, pairing, c), carry)

        return loop(self.set.rows, of_row, start, self.set.size)

    def do(self, body: Callable) -> None:
        """Runs body(item, pairing), which stores something, over all slots in use."""

        def one(item: Any, pairing: Pairing, carry: list) -> list:
            body(item, pairing)
            return carry

        self.each(one, [])

    def touching_now(self) -> jax.Array:
        """Whether any slot is in use, a scalar."""

        def most(row: Any, found: jax.Array) -> jax.Array:
            return jnp.maximum(found, self.used(row))

        return jax.lax.fori_loop(0, self.set.rows, most, jnp.int32(0)) > 0

    def touching_worlds(self) -> jax.Array:
        """Lanes of the worlds that have filled any slot, bool, shape (lane,)."""
        assert self._counts is not None
        filled = total([jnp.where(word > 0, 1, 0) for word in self._counts.words])
        return self.block.fold(filled, jnp.maximum) > 0

    # One side's part of a contact

    def relative(self, item: Any, pairing: Pairing) -> Lanes:
        """How the links' motion moves a slot's sides to each other, on its own side's lanes."""
        names = ("motion", "turn") if self.set.skin else ("motion",)
        parts = self._on_rows(item, names)
        contacts = self.set.contacts

        def moved(place, cone, parts):
            return contacts(place, cone).relative(jnp.concatenate(parts)[:, None])

        own = lanewise(moved, self.place(item), self.cone, parts)
        if pairing.palm is None:
            return lanewise(jnp.subtract, own, pairing.swap(own))
        return lanewise(_without, pairing.palm, own, pairing.swap(own))

    def _on_rows(self, item: Any, names: tuple[str, ...]) -> list[Lanes]:
        """What sides have at the rows of a slot's lanes; zeros where nothing touches."""
        groups = self.table.groups
        if self.set.gathers:
            row, lane = self.read("row", item).lane.astype(jnp.int32), self.block.own
            return [self.table.gather(self.ref, f"side.{name}", row, lane) for name in names]
        like = jnp.zeros((self.set.size,), self.ref.dtype)
        start = [zeros(groups[f"side.{name}"][1], like) for name in names]

        def take(row: Any, chosen: jax.Array, found: list[Lanes]) -> list[Lanes]:
            new = [self.table.read(self.ref, f"side.{name}", row) for name in names]
            mask = lanes([chosen], (), wide=True)
            return [lanewise(jnp.where, mask, n, f) for n, f in zip(new, found, strict=True)]

        return self._each_row(item, take, start)

    def _each_row(self, item: Any, body: Callable, start: Any) -> Any:
        """Folds body(row, lanes that touch there, tree of lanes) over the rows of a slot's lanes.

        Few lanes of a block touch in one slot, at two rows if it is one contact: on CPUs whose
        vectors gather number by number that is faster than to gather.
        """
        gap = self.read("gap", item).lane
        left = jnp.where(gap < 0, self.read("row", item).lane.astype(jnp.int32), -1)
        arrays, rebuild = solid(start, self.set.size)

        def step(carry: list) -> list:
            row, left, *values = carry
            chosen = left == row
            left = jnp.where(chosen, -1, left)
            new = solid(body(row, chosen, rebuild(values)), self.set.size)[0]
            return [jnp.max(left), left, *new]

        first = [jnp.max(left), left, *arrays]
        return rebuild(jax.lax.while_loop(lambda c: c[0] >= 0, step, first)[2:])

    def clear_wrenches(self) -> None:
        """Sets the wrenches of all sides to zero."""
        like = jnp.zeros((self.set.size,), self.ref.dtype)

        def clear(row: Any, x: jax.Array) -> jax.Array:
            self.put("push", zeros((self.set.components,), like), row)
            return x

        jax.lax.fori_loop(0, self.rows(), clear, jnp.int32(0))

    def own_side(self, item: Any) -> OwnSide:
        """Reads a slot's own side, for `load`; before anything of the slot is stored."""
        if not self.set.gathers:
            return OwnSide(self.place(item), None, None)
        row = self.read("row", item).lane.astype(jnp.int32)
        wrench = self.table.gather(self.ref, "side.push", row, self.block.own)
        return OwnSide(self.place(item), row, wrench)

    def load(self, item: Any, own: OwnSide, force: Lanes, pairing: Pairing) -> None:
        """Adds a slot's force to its own side's wrench, and the opposite one to the palm's."""
        contacts = self.set.contacts

        def wrench(place, cone, force):
            return sum_axis(contact.contact_wrench(contacts(place, cone), force), 1)

        more = lanewise(wrench, own.place, self.cone, force)
        if pairing.palm is not None:
            any_of(pairing.palm.lane, lambda: self._push_palm(item, more))
        if own.row is not None and own.wrench is not None:
            sums = lanewise(jnp.add, own.wrench, more)
            self.table.scatter(self.ref, "side.push", sums, own.row, self.block.own)
            return

        def add(row: Any, chosen: jax.Array, nothing: list) -> list:
            mask = lanes([chosen], (), wide=True)
            self.put("push", lanewise(_add_where, mask, self.pushed(row), more), row)
            return nothing

        self._each_row(item, add, [])

    def _push_palm(self, item: Any, wrench: Lanes) -> None:
        """Takes a slot's wrench from the palm, where the slot touches."""
        touches = lanes([self.read("gap", item).lane < 0], (), wide=True)
        rest = self.set.components - 6

        def take(touches, sums, wrench):
            away = jnp.where(touches, wrench[:6], 0.0)
            return sums - jnp.concatenate([away, jnp.zeros((rest, *away.shape[1:]), away.dtype)])

        self.put("push", lanewise(take, touches, self.pushed(0), wrench), 0)

    # Newton's method

    def update_constraints(self, alpha: Lanes) -> None:
        """Adds the last step of the line search to jar; stores Hessians and adds up wrenches."""
        self.clear_wrenches()

        def store(item: Any, pairing: Pairing) -> None:
            own = self.own_side(item)
            self.load(item, own, self.update_constraint(item, own.place, alpha), pairing)

        self.do(store)

    def update_wrenches(self, alpha: Lanes) -> None:
        """Adds up wrenches where the last step has moved jar, which is kept."""
        self.clear_wrenches()
        contacts = self.set.contacts

        def response(place, cone, alpha, jar, step):
            return contact.constraint_update(contacts(place, cone), jar + alpha * step).force

        def load(item: Any, pairing: Pairing) -> None:
            own, jar, step = self.own_side(item), self.read("jar", item), self.read("step", item)
            self.load(
                item, own, lanewise(response, own.place, self.cone, alpha, jar, step), pairing
            )

        self.do(load)

    @staticmethod
    def stiff(hessian: Lanes, change: Lanes) -> Lanes:
        """A slot's Hessian times a relative motion."""
        return lanewise(_times, hessian, change)

    def prepare_all(self) -> Lanes:
        """Prepares the line search of all slots; returns the sum of the slopes at 0."""

        def add(item: Any, pairing: Pairing, sums: Lanes) -> Lanes:
            slope = self.line(item, self.relative(item, pairing))
            return lanewise(lambda s, h, f: s + h * f, sums, pairing.half, slope)

        return self.each(add, self._zeros(())[0])

    def slopes_of_all(self, alpha: Lanes, sums: list[Lanes]) -> list[Lanes]:
        """Sums of the first and second derivative of the cost by the step length."""

        def add(item: Any, pairing: Pairing, sums: list[Lanes]) -> list[Lanes]:
            new = self._slopes(item, alpha)
            return lanewise(tree_add_scaled, pairing.half, sums, new)

        return self.each(add, sums)


def _minus(motion, palm):
    return motion - palm


def _without(palm, own, theirs):
    return own - jnp.where(palm, 0.0, theirs)


def _where(mask, one, other):
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), one, other)


def _add_where(chosen, sums, more):
    return sums + jnp.where(chosen, more, 0.0)


def _times(triangle: jax.Array, x: jax.Array) -> jax.Array:
    """A symmetric matrix, given by its upper triangle row by row, times a vector."""
    n = x.shape[0]
    place = {(i, j): k for k, (i, j) in enumerate((i, j) for i in range(n) for j in range(i, n))}
    rows = [jnp.stack([triangle[place[min(i, j), max(i, j)]] for j in range(n)]) for i in range(n)]
    return jnp.stack([dot(row, x) for row in rows])
