"""The reverse pass of a step through its contacts: one derivative for all kinds, see `kinds.power`.

What it leaves for links and palm is kept by body until the sweep from the tips inwards takes it.
A contact of two fingers counts on the lane of its ring, which reads both sides; the other finger's
cotangents go to its own lane by a swap.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import friction_memory, kinds, objects
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables, only_on, plus, pull
from codesign_jax.engines.structured.kernel.finger_shapes import neighbours
from codesign_jax.engines.structured.kernel.kinds import KINDS, BodyMotion, CentreLine
from codesign_jax.engines.structured.kernel.memory import any_of, zeros
from codesign_jax.engines.structured.kernel.pairing import FingerPairing
from codesign_jax.engines.structured.kernel.placement import Item
from codesign_jax.engines.structured.kernel.problem import Iterate
from codesign_jax.engines.structured.kernel.rows import (
    BodyBar,
    Chain,
    Contact,
    Field,
    Hand,
    HeldBar,
    Remembered,
    Slot,
    StepBar,
    World,
)
from codesign_jax.engines.structured.kernel.step import Assembly, Step
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import shapes, surroundings
from codesign_jax.engines.structured.laws.cones import friction_by_contact, which_cone
from codesign_jax.engines.structured.laws.rings import grown, growth_factors
from codesign_jax.engines.structured.laws.touch import ring_centres
from codesign_jax.model.held import EDGES
from codesign_jax.model.layout import touches_itself


class ContactsVjp:
    """Adds the cotangents by a step's contacts, given its virtual accelerations.

    Attributes:
      palm_row: Row of the palm in `rows.BodyBar`, behind the links'.
    """

    def __init__(
        self,
        step: Step,
        assembly: Assembly,
        virtual: Iterate,
        bars: CotangentTables,
    ):
        """Prepares the pass.

        Args:
          step: The step's memory.
          assembly: What `Step.assemble` returns.
          virtual: Virtual accelerations of the wrist, of palm and object.
          bars: The tables of cotangents.
        """
        bodies = assembly.bodies
        world_object = assembly.world_object
        self.step = step
        self.layout = step.layout
        self.contacts = assembly.contacts
        self.fingers = assembly.fingers
        self.world_object = world_object
        self.bars = bars
        self.scratch = step.scratch
        self.like = step.like
        self.lane = step.block.lane
        self.power_bar = self._float(1)
        self.palm_row = step.layout.links + 1
        now = bodies["now"]
        palm = bodies["place"], bodies["frame"], bodies["vel"], now.palm_acc, virtual.palm_acc
        self.palm = BodyMotion(*palm)
        self.object = {"columns": bodies["columns"], "object_vel": bodies["object_vel"]}
        self.object |= {"position": assembly.state["position"]}
        self.fixed: dict[str, Any] = {"object_id": step.constant(World.object_id)}
        self.fixed |= {"object_acc": now.object_acc, "object_along": virtual.object_acc}
        if world_object.mesh is not None:
            self.fixed |= {n: step.constant(n) for n in ("grid_first", "grid_nodes")}
            self.fixed |= {"meshed": world_object.mesh.meshed}
            self.fixed |= {"factor": step.constant(World.grid_factor)}

    def run(self, pressure: Lanes) -> None:
        """Leaves the cotangents of bodies as `rows.BodyBar`; adds all others to their tables.

        Args:
          pressure: Of the chambers.
        """
        self._clear()
        if (self_contacts := self.contacts.self_contacts) is not None:
            self_contacts.each(self._slot)
        for contacts in self.contacts.field_contacts.values():
            reverse = self._points if contacts.layout.name == "object_table" else self._rings
            contacts.each(partial(self._where_touching, contacts, reverse))
        if self.layout.grows:
            self._add_growth(pressure)

    @staticmethod
    def _where_touching(contacts: ContactList, reverse: Callable, item: Item) -> None:
        jax.lax.cond(contacts.touching(item), lambda: reverse(contacts, item), lambda: None)

    # What a side has, and what is left for it

    def body(self, row: Any, lane: Any = None) -> BodyMotion:
        """Pose and motion of a finger's body.

        Args:
          row: The body, 0 for the palm's half link, a scalar or int32 of shape (lane,).
          lane: Lanes that have it, if rows differ by lane.
        """
        return BodyMotion(*(self._chain(getattr(Chain, n), row, lane) for n in BodyMotion._fields))

    def _chain(self, name: Field, row: Any, lane: Any) -> Lanes:
        return self.step.item_of(self.scratch, name, row, lane)

    def ring(self, item: Any, lane: Any = None) -> Lanes:
        """Numbers of a finger's ring or sphere; `lane`: lanes that have it, if items differ."""
        return self.step.ring(item, lane)

    def add_ring(self, bar: Lanes, item: Any, lane: Any = None) -> None:
        """Adds to the cotangents of a finger's ring, and of its growth; arguments as `ring`."""
        if self.layout.grows:
            numbers = self.step.item_of(self.step.hand, Hand.ring, item, lane)
            factors = self.step.growth_of(item, lane)
            bar, factors_bar = pull(grown, (numbers, factors), (), bar)
            self.bars.add({"grown": factors_bar}, self.step.section_of(item), lane)
        self.bars.add({Hand.ring: bar}, item, lane)

    def _add_growth(self, pressure: Lanes) -> None:
        """Adds the cotangents of pressures and sections by all rings' growth."""
        for i in range(self.layout.links if self.layout.tapered else 1):
            given = self.step.hand.read(Hand.growth, i), pressure
            bar = self.scratch.read(StepBar.grown, i)
            growth, pressure_bar = pull(growth_factors, given, (), bar)
            self.bars.add({Hand.growth: growth}, i)
            self.bars.add({"pressure": pressure_bar})

    def add_body(self, bars: dict[str, Lanes], row: Any, lane: Any = None) -> None:
        """Adds to the cotangents of a body, by fields of `BodyMotion`; arguments as `body`."""
        for field, value in bars.items():
            name = getattr(BodyBar, field)
            new = plus(self.step.item_of(self.scratch, name, row, lane), value)
            if lane is None:
                self.scratch.write(name, new, row)
            else:
                self.scratch.scatter(name, new, row, lane)

    def _clear(self) -> None:
        def clear(row: jax.Array, x: jax.Array) -> jax.Array:
            for name in BodyBar.fields():
                self.scratch.write(name, zeros(self.scratch.shape(name), self.like), row)
            return x

        jax.lax.fori_loop(0, self.palm_row + 1, clear, jnp.int32(0))

    def numbers(self, pair: str) -> dict[str, Lanes]:
        """What contacts of a pair of bodies depend on beside the hand, by name."""
        names = [*KINDS[pair].numbers, f"cone.{which_cone(pair)}"]
        names += ["friction"] * friction_by_contact(self.layout.scene, pair)
        constants = {n: self.step.constant(n) for n in names if n in self.step.world}
        return constants | {n: self.object[n] for n in names if n in self.object}

    # Contacts with a fixed place

    def _rings(self, contacts: ContactList, item: Item) -> None:
        """Adds the cotangents of an item's contacts, of the rings of a link or of the palm."""
        i = item.number
        name = contacts.layout.name
        of_palm = name.startswith("palm")
        row = self.palm_row if of_palm else i + 1
        k = 1 if of_palm else self.layout.rings_per_link
        read = partial(self.step.hand.read, Hand.palm_ring) if of_palm else self.ring
        several = [read(i * k + j) for j in range(k)]
        rings = lanewise(lambda several: jnp.stack(several, 1), several)
        mine = self.palm if of_palm else self.body(row), rings
        numbers = self.numbers(name)
        fixed = self._grid_values(mine, numbers) if name.endswith("_object") else self.fixed
        (body, ring_bars), bars = self._reverse_item(contacts, item, mine, numbers, fixed)
        self.bars.add(bars)
        self.add_body(body._asdict(), row)
        for j in range(k):
            bar = ring_bars[:, j]
            if of_palm:
                self.bars.add({Hand.palm_ring: bar}, i)
            else:
                self.add_ring(bar, i * k + j)

    def _points(self, contacts: ContactList, item: Item) -> None:
        """The same of the object's points on table and fixtures that an item deals to the lanes."""
        point = self.step.block.finger + item.number * self.layout.fingers
        fixed = self.fixed | {"point": self._float(point)}
        if "meshed" in fixed:
            fixed |= self._support_points()
        numbers = self.numbers("object_table")
        _, bars = self._reverse_item(contacts, item, (), numbers, fixed)
        self.bars.add(bars)

    def _reverse_item(
        self,
        contacts: ContactList,
        item: Item,
        mine: tuple,
        numbers: dict[str, Lanes],
        fixed: dict[str, Any],
    ) -> tuple[Any, dict[str, Lanes]]:
        """Cotangents of the first side and of numbers by an item's contacts; adds held friction's.

        Args:
          mine: The first side, see `kinds.Kind`; `numbers`, `fixed`: as in `kinds.power`.
        """
        fixed = fixed | {Contact.share: contacts.read(Contact.share, item)}
        held = {}
        if contacts.layout.holds:
            held = {Contact.held_friction: contacts.read(Contact.held_friction, item)}
            fixed |= {HeldBar.held_bar: contacts.read(HeldBar.held_bar, item)}
        run = partial(kinds.power, self.layout.scene, contacts.layout.name)
        mine, _, bars, held_bars = pull(run, (mine, (), numbers, held), (fixed,), self.power_bar)
        friction_memory.add_held(self.bars, contacts, item, held_bars)
        return mine, bars

    def _grid_values(self, mine: tuple, numbers: dict[str, Lanes]) -> dict[str, Any]:
        """`fixed` with the distances of meshes where rings look at the object."""
        fixed = self.fixed
        if "meshed" not in fixed:
            return fixed
        place, rings = mine
        centre = lanewise(ring_centres, place.origin, place.frame, rings)
        fixed = fixed | {"values": self._values(centre)}
        if self.layout.hull:
            run = partial(kinds.second_look, self.layout.scene)
            again = lanewise(run, mine, numbers, fixed)
            fixed |= {"values_again": self._values(again)}
        return fixed

    def _support_points(self) -> dict[str, Lanes]:
        """Points of meshes that may touch table and fixtures, and distances at these' edges."""
        points = {"support_None": self._support(self.object["columns"], self.object["position"][2])}
        position = self.object["position"]
        for j, fixture in enumerate(self.layout.scene.fixture):
            gap, rows = lanewise(partial(surroundings.towards, fixture), position)
            turned = lanewise(surroundings.faced, rows, self.object["columns"])
            points |= {f"support_{j}": self._support(turned, gap)}
            if EDGES[fixture.type]:
                point = lanewise(partial(surroundings.edges, fixture), position)
                points |= {f"values_{j}": self._values(point)}
        return points

    def _support(self, columns: Lanes, height: Lanes) -> Lanes:
        """Points that may touch a table of these axes, in the object's frame."""
        points = objects.table_points(self.layout.scene, self.world_object, columns, height)
        return lanewise(_turned_back, columns, points)

    def _values(self, point: Lanes) -> Lanes:
        local = lanewise(shapes.in_object, self.object["columns"], point)
        return objects.cell_values(self.world_object, local)

    # Contacts in slots

    def _slot(self, item: Item) -> None:
        """Adds the cotangents of a slot's contacts, whose kinds differ by lane."""
        for pair, live in self._kinds_of(item).items():
            any_of(live, partial(self._reverse_slot, pair, item, live))

    def _kinds_of(self, item: Item) -> dict[str, jax.Array]:
        """Lanes of the rings of a slot's contacts, by pair of bodies."""
        pairing = item.pairing
        contacts = self.contacts.self_contacts
        assert contacts is not None
        owner = contacts.read(Remembered.owner, item).lane > 0.5
        live = owner & (contacts.read(Contact.share, item).lane > 0)
        effects = self.layout.scene.effects
        by_pair = {}
        if pairing.itself is not None:
            other = contacts.read(Slot.other_side, item).lane.astype(jnp.int32)
            itself = live & pairing.itself
            by_pair = {"finger_palm": itself & (other == 0), "finger_itself": itself & (other > 0)}
            live = live & ~pairing.itself
        by_pair["finger_finger"] = live
        on = {
            "finger_palm": effects.finger_palm,
            "finger_itself": touches_itself(self.layout.scene),
            "finger_finger": effects.finger_finger,
        }
        return {pair: which for pair, which in by_pair.items() if on[pair]}

    def _reverse_slot(self, pair: str, item: Item, live: jax.Array) -> None:
        contacts = self.contacts.self_contacts
        assert contacts is not None
        remembered = contacts.read(Remembered.ring, item).lane.astype(jnp.int32)
        number = jax.lax.rem(remembered, self._count)
        row = self._row_of(number)
        mine = self.body(row, self.lane), self.ring(number, self.lane)
        theirs, more, leave = self._second_side(pair, item, remembered)
        fixed = {Contact.share: contacts.read(Contact.share, item)} | more
        hold = KINDS[pair].holds == "pairing"
        held, sums_bar = (
            friction_memory.held_and_cotangents(self.step, item.pairing) if hold else ({}, {})
        )
        run = partial(kinds.power, self.layout.scene, pair)
        args = mine, theirs, self.numbers(pair), held
        bars = pull(run, args, (fixed | sums_bar,), self.power_bar)
        side = lanes([live], (), wide=True)
        (body, ring), theirs, numbers, held_bar = only_on(side, bars)
        self.bars.add(numbers)
        friction_memory.add_pairing_cotangents(self.bars, item.pairing, held_bar)
        self.add_body(body._asdict(), row, self.lane)
        self.add_ring(ring, number, self.lane)
        leave(theirs)

    def _second_side(
        self, pair: str, item: Item, remembered: jax.Array
    ) -> tuple[tuple, dict[str, Lanes], Callable[[tuple], None]]:
        """A slot's second side, what of it has no derivative, and what adds its cotangents."""
        pairing = item.pairing
        if pair == "finger_palm":
            leave = lambda bars: self.add_body(bars[0]._asdict(), self.palm_row)  # noqa: E731
            return (self.palm, ()), {}, leave
        contacts = self.contacts.self_contacts
        assert contacts is not None
        if not self.layout.hull:
            return self._sphere(pairing, jax.lax.div(remembered, self._count))
        itself = pair == "finger_itself"
        if itself:
            link = contacts.read(Slot.other_side, item).lane.astype(jnp.int32)
        else:
            link = pairing.swap(contacts.read(Slot.side, item)).lane.astype(jnp.int32)
        last = jnp.where(link == self.layout.links, self.like + 1.0, self.like)
        end: Any = 1
        if itself:
            assert self.fingers is not None
            end = self.fingers.last_of(jax.lax.rem(remembered, self._count), link)
        fixed = {"last": self._float(last), "end": self._float(end)}
        lane = self.lane if itself else pairing.lane

        def leave_segment(bars: tuple) -> None:
            where = link
            if not itself:
                bars, where = pairing.swap((bars, self._float(link)))
                where = where.lane.astype(jnp.int32)
            self._add_segment(bars, where)

        return self._segment(link, lane), fixed, leave_segment

    def _sphere(
        self, pairing: FingerPairing, number: jax.Array
    ) -> tuple[tuple, dict[str, Lanes], Callable[[tuple], None]]:
        """`_second_side` of a contact with another finger's sphere."""

        def leave(bars: tuple) -> None:
            (body, ring), where = pairing.swap((bars, self._float(number)))
            where = where.lane.astype(jnp.int32)
            self.add_body(body._asdict(), self._row_of(where), self.lane)
            self.add_ring(ring, where, self.lane)

        sphere = self.body(self._row_of(number), pairing.lane), self.ring(number, pairing.lane)
        return sphere, {}, leave

    def _segment(self, row: jax.Array, lane: jax.Array) -> tuple[BodyMotion, CentreLine]:
        """Segments of centre lines as a side of a contact; arguments as `body`."""
        before, link, after = neighbours(row, self.layout.links)
        frames = tuple(self._chain(Chain.frame, r, lane) for r in (before, after))
        sections = [self.ring(n, lane) for n in self._sections(row)]
        line = CentreLine(self._chain(Chain.origin, after, lane), frames, *sections)  # type: ignore[arg-type]
        return self.body(link, lane), line

    def _add_segment(self, bars: tuple[BodyMotion, CentreLine], row: jax.Array) -> None:
        """Adds the cotangents of segments of the lanes' own fingers."""
        before, link, after = neighbours(row, self.layout.links)
        body, line = bars
        self.add_body(body._asdict(), link, self.lane)
        self.add_body({"frame": line.frames[0]}, before, self.lane)
        self.add_body({"origin": line.origin, "frame": line.frames[1]}, after, self.lane)
        sections = line.tip, line.first
        for item, bar in zip(self._sections(row), sections, strict=False):
            self.add_ring(bar, item, self.lane)

    def _sections(self, row: jax.Array) -> list[jax.Array]:
        """Rings whose sections segments have, and the one before has; see `ring_at`."""
        assert self.fingers is not None
        places = (1, 0) if self.layout.tapered else (1,)
        return [jnp.zeros_like(row) + self.fingers.ring_at(row + k) for k in places]

    @property
    def _count(self) -> jax.Array:
        """Rings of a finger, on each lane."""
        rings = self.layout.links * self.layout.rings_per_link
        return jnp.full((self.layout.size,), rings, jnp.int32)

    def _row_of(self, number: jax.Array) -> jax.Array:
        """Links of rings."""
        return jax.lax.div(number, jnp.full_like(number, self.layout.rings_per_link)) + 1

    def _float(self, value: Any) -> Lanes:
        return lanes([self.like + jnp.asarray(value, self.like.dtype)], (), wide=True)


def _turned_back(columns: jax.Array, points: jax.Array) -> jax.Array:
    """Points (3, point, world) along the world's axes in the object's frame."""
    return shapes.in_object(columns[:, :, 0], points)
