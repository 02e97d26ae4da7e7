"""The reverse pass of a step through `residual`: palm, fingers and contacts, from the tips inwards.

The power of a self-contact is counted on the lane of its ring, which reads both sides;
the other finger's cotangents go to its own lane by a swap.  A contact of a finger with itself or
with the palm has one lane; what it leaves for the palm is kept as "palmbar".
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import (
    friction_memory,
    objects,
    residual,
    self_collision,
)
from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables, only_on, plus, pull
from codesign_jax.engines.structured.kernel.memory import choose, loop
from codesign_jax.engines.structured.kernel.objects import WorldObject
from codesign_jax.engines.structured.kernel.problem import Iterate
from codesign_jax.engines.structured.kernel.residual import (
    Before,
    BodyMotion,
    CentreLineSegment,
    FastMotion,
    LinkMotion,
)
from codesign_jax.engines.structured.kernel.rows import (
    Chain,
    ChainBefore,
    Contact,
    Field,
    Hand,
    HeldBar,
    PairBar,
    PalmBar,
    Remembered,
    Slot,
    Virtual,
    World,
    WorldOptions,
)
from codesign_jax.engines.structured.kernel.self_contacts import (
    BoundSelfContacts,
    FingerPairing,
)
from codesign_jax.engines.structured.kernel.slots import any_of
from codesign_jax.engines.structured.kernel.step import WRIST, Step, bases_before
from codesign_jax.engines.structured.kernel.step_memory import FINGER_CONSTANTS, LINK_CONSTANTS
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import shapes, surroundings
from codesign_jax.engines.structured.laws.cones import friction_by_contact, which_cone
from codesign_jax.engines.structured.laws.kinematics import mounted
from codesign_jax.engines.structured.laws.touch import ring_centres
from codesign_jax.engines.structured.world_model import apply_columns
from codesign_jax.model import held
from codesign_jax.model.layout import touches_itself

SHAPES = LinkMotion(*(getattr(Chain, name).shape for name in LinkMotion._fields))


class ResidualVjp:
    """Adds a step's part of the cotangents, given its virtual accelerations."""

    def __init__(
        self,
        step: Step,
        state: dict[str, Lanes],
        bodies: dict[str, Any],
        world_object: WorldObject,
        virtual: Iterate,
        bars: CotangentTables,
    ):
        self.step = step
        self.layout = step.layout
        self.bodies = bodies
        self.world_object = world_object
        self.contacts = step.contacts
        self.scratch = step.scratch
        self.virtual = virtual
        self.bars = bars
        self.block = step.block
        self.like = step.like
        self.power_bar = lanes([self.like + 1.0], (), wide=True)
        self.wrist = {n: state[n] for n in WRIST}
        self.object = {"columns": bodies["columns"], "object_vel": bodies["object_vel"]}
        self.object |= {"height": state["position"][2]}
        if self.layout.scene.fixture:
            self.object |= {"position": state["position"]}
        names = ("object_size", "grid_origin", "grid_cell", "grid_factor")
        self.object |= {n: step.constant(n) for n in names if n in step.world}
        self.fixed: dict[str, Any] = {"object_id": step.constant(World.object_id)}
        self.fixed |= {"object_acc": bodies["now"].object_acc}
        self.fixed |= {"object_along": virtual.object_acc}
        if world_object.mesh is not None:
            self.fixed |= {n: step.constant(n) for n in ("grid_first", "grid_nodes")}
            self.fixed |= {"meshed": world_object.mesh.meshed}

    def chain(self, i: Any) -> LinkMotion:
        """What the link before joint i hands on."""
        names = (getattr(Chain, n) for n in LinkMotion._fields)
        return LinkMotion(*(self.scratch.read(n, i) for n in names))

    def fingers(self, pressure: Lanes, centre_bar: Lanes) -> tuple[LinkMotion, dict[str, Lanes]]:
        """From the tips inwards; cotangents of what the palm hands on, on each lane.

        Also returns those of `WRIST` by the momenta that fast links carry over.
        """
        layout = self.layout
        tips = self.layout.links
        touching = [n for n in ("finger_object", "finger_table") if n in self.contacts]

        def link(i: Any, after: LinkMotion) -> LinkMotion:
            if touching:
                place = _place(self.chain(i + 1))
                for name in touching:
                    new = self.rings(name, i, place)
                    after = _add(after, **new._asdict())
            before = self._link(i, after, pressure, centre_bar)
            return self.more(before, i)

        after = LinkMotion(*(zeros(shape, self.like) for shape in SHAPES))
        after = self.more(after, tips)
        base = loop(tips, link, after, layout.size, reverse=True)
        base, wrist = self._fast_links(base)
        return self._mount(base, centre_bar), wrist

    def none(self, name: str) -> Lanes:
        return zeros(getattr(SHAPES, name), self.like)

    def more(self, bars: LinkMotion, i: Any) -> LinkMotion:
        """Adds what self-contacts have left for a link."""
        if PairBar.origin not in self.scratch:
            return bars
        return _add(
            bars, **{n: self.scratch.read(getattr(PairBar, n), i) for n in BodyMotion._fields}
        )

    def _link(self, i: Any, after: LinkMotion, pressure: Lanes, centre_bar: Lanes) -> LinkMotion:
        numbers = self.step.link_constants(i)
        joint = self.step.joint(i)
        fixed = {"acc": joint.pop("acc"), "order": self.step.order(i)}
        fixed["virtual"] = self.scratch.read(Virtual.virtual, i)
        weight = self.step.hand.read(Hand.centre_weight, i + 1)
        fixed["centre_bar"] = lanewise(jnp.multiply, centre_bar, weight)
        run = partial(residual.of_link, self.layout.scene)
        joint = joint | {"pressure": pressure}
        before, bars, moved = pull(
            run, (self.chain(i), numbers, joint), (fixed,), (after, self.power_bar)
        )
        self.bars.add({n: bars.pop(n) for n in LINK_CONSTANTS}, i)
        sections = {n: bars.pop(n) for n in FINGER_CONSTANTS if n in bars}
        self.bars.add(sections, i if self.layout.tapered else 0)
        self.bars.add(bars | {"pressure": moved.pop("pressure")})
        self.bars.add_joint(moved, i)
        return before

    def _fast_links(self, base: LinkMotion) -> tuple[LinkMotion, dict[str, Lanes]]:
        """Adds the momenta that links carry over to what the fingers' bases hand on.

        Also returns their cotangents of `WRIST`.
        """
        wrist = {n: zeros(value.shape[:1], self.like) for n, value in self.wrist.items()}
        empty = FastMotion(*(self.none(n) for n in FastMotion._fields)), wrist
        bars, wrist = choose(self.step.fast, self._carried_momenta, empty, self.layout.size)
        return _add(base, **bars._asdict()), self.block.sum(wrist)

    def _carried_momenta(self) -> tuple[FastMotion, dict[str, Lanes]]:
        run = partial(residual.of_fast_link, self.layout.scene)

        def link(i: Any, after: tuple) -> tuple:
            chain = self.chain(i)
            now = FastMotion(*(getattr(chain, n) for n in FastMotion._fields))
            before = Before(
                *(self.scratch.read(getattr(ChainBefore, n), i) for n in Before._fields)
            )
            constants = self.step.link_constants(i)
            numbers = {n: constants[n] for n in ("offset", "mass", "centre", "inertia")}
            joint = self.step.joint(i)
            fixed = {"order": self.step.order(i), "virtual": self.scratch.read(Virtual.virtual, i)}
            del joint["acc"]
            given = now, before, numbers, joint
            *bars, numbers, joint = pull(run, given, (fixed,), (*after, self.power_bar))
            self.bars.add(numbers, i)
            self.bars.add_joint(joint, i)
            return tuple(bars)

        tips = (t(*(self.none(n) for n in t._fields)) for t in (FastMotion, Before))
        now, before = loop(self.layout.links, link, tuple(tips), self.layout.size, reverse=True)
        names = ("mount", "base")
        given = *self.wrist.values(), *(self.step.hand.read(n) for n in names)
        run = partial(bases_before, self.layout.scene.discretization.timestep)
        *wrist, mount, place = pull(run, given, (), tuple(before))
        self.bars.add({"mount": mount, "base": place})
        return now, dict(zip(self.wrist, wrist, strict=True))

    def _mount(self, base: LinkMotion, centre_bar: Lanes) -> LinkMotion:
        read = self.step.hand.read
        names = ("mount", "base", "stub_centre")
        palm = self.bodies["place"], self.bodies["frame"]

        def run(palm, mount, base, stub, weight):
            place, frame = palm
            turned, origin = mounted(place, frame, mount, base)
            middle = place + apply_columns(frame, stub)
            return turned, origin, sum(weight[k] * middle[k] for k in range(3))

        weight = lanewise(jnp.multiply, centre_bar, read(Hand.centre_weight))
        given = (palm, *(read(n) for n in names))
        (place, frame), *bars = pull(
            run, given, (weight,), (base.frame, base.origin, self.power_bar)
        )
        self.bars.add(dict(zip(names, bars, strict=True)))
        return base._replace(origin=place, frame=frame)

    # Contacts

    def palm_and_table(self, base: LinkMotion) -> LinkMotion:
        """Adds the contacts of the palm's rings or spheres, and of the object with the table."""
        names = [n for n in ("palm_object", "palm_table") if n in self.contacts]
        bodies = self.bodies
        now = self.bodies["now"]
        place = BodyMotion(
            bodies["place"],
            bodies["frame"],
            bodies["vel"],
            now.palm_acc,
            self.virtual.palm_acc,
        )
        if PalmBar.origin in self.scratch:
            more = {n: self.scratch.read(getattr(PalmBar, n)) for n in BodyMotion._fields}
            base = _add(base, **more)
        for i in range(self.layout.palm_groups if names else 0):
            for name in names:
                new = self.rings(name, i, place, "palm_ring")
                base = _add(base, **new._asdict())
        if residual.TABLE in self.contacts:
            self._table()
        return base

    def rings(self, name: str, i: Any, place: BodyMotion, table: str = "ring") -> BodyMotion:
        """Cotangents of a body, of an item of the contacts of its rings."""
        k = self.layout.rings_per_link if table == "ring" else 1
        rows = [self.step.hand.read(table, i * k + j) for j in range(k)]
        numbers = lanewise(lambda rows: jnp.stack(rows, 1), rows)

        def compute(variables: dict, fixed: dict) -> BodyMotion:
            if "meshed" in fixed and name.endswith("_object"):
                centre = lanewise(ring_centres, place.origin, place.frame, numbers)
                fixed = fixed | {"values": self._values(centre)}
                if self.layout.hull:
                    run = partial(residual.second_look, self.layout.scene, name)
                    again = lanewise(run, place, numbers, variables, fixed)
                    fixed = fixed | {"values_again": self._values(again)}
            run = partial(residual.of_rings, self.layout.scene, name)
            args = place, numbers, variables, self.held(name, i)
            body_bars, ring_bars, shared, held = pull(run, args, (fixed,), self.power_bar)
            friction_memory.add_held(self.bars, self.contacts[name], i, held)
            for j in range(k):
                self.bars.add({table: ring_bars[:, j]}, i * k + j)
            self.bars.add(shared)
            return body_bars

        return self._touching(name, i, compute)

    def _touching(
        self, name: str, i: Any, compute: Callable[[dict, dict], BodyMotion]
    ) -> BodyMotion:
        variables = self._object(name)
        empty = BodyMotion(*(self.none(n) for n in BodyMotion._fields))
        contacts = self.contacts[name]
        fixed = self.fixed | self.of_contacts(name, i)
        return choose(
            contacts.touching(i), lambda: compute(variables, fixed), empty, self.layout.size
        )

    def _table(self) -> None:
        contacts = self.contacts[residual.TABLE]
        layout = self.layout
        finger = lanes([self.block.finger.astype(self.like.dtype)], (), wide=True)
        variables = self._object(residual.TABLE)
        fixed = self.fixed
        if "meshed" in fixed:
            columns = self.bodies["columns"]
            fixed = fixed | {"factor": self.object["grid_factor"]}
            fixed |= {"support": self._support(columns, self.object["height"])}
            for j, fixture in enumerate(layout.scene.fixture):
                position = self.object["position"]
                gap, rows = lanewise(partial(surroundings.towards, fixture), position)
                turned = lanewise(surroundings.faced, rows, columns)
                fixed |= {f"support_{j}": self._support(turned, gap)}
                if held.EDGES[fixture.type]:
                    point = lanewise(partial(surroundings.edges, fixture), position)
                    fixed |= {f"values_{j}": self._values(point)}
        for i in range(contacts.set.count):

            def compute(i: int = i) -> None:
                run = partial(residual.of_table, layout.scene, layout.fingers, i)
                constants = fixed | self.of_contacts(residual.TABLE, i)
                args = variables, self.held(residual.TABLE, i)
                bars, held = pull(run, args, (finger, constants), self.power_bar)
                friction_memory.add_held(self.bars, contacts, i, held)
                self.bars.add(bars)

            jax.lax.cond(contacts.touching(i), compute, lambda: None)

    def held(self, name: str, i: Any) -> dict[str, Lanes]:
        """What an item's contacts hold of friction; nothing where they hold none."""
        contacts = self.contacts[name]
        return {"held": contacts.read(Contact.held, i)} if contacts.set.holds else {}

    def of_contacts(self, name: str, i: Any) -> dict[str, Lanes]:
        """What an item's contacts have that has no derivative, by name."""
        names = [Contact.share, *[HeldBar.held_bar] * self.contacts[name].set.holds]
        return {n: self.contacts[name].read(n, i) for n in names}

    def _object(self, name: str) -> dict[str, Lanes]:
        """What contacts of a pair of bodies depend on beside the hand, by name."""
        cone = f"cone.{which_cone(name)}"
        surrounded = bool(self.layout.scene.fixture)
        names = {"height", "position"} if surrounded else {"height"}
        if not name.endswith("_table"):
            names = set(self.object) - names
        if name == residual.TABLE:
            names = set(self.object) - (set() if surrounded else {"grid_origin", "grid_cell"})
        chosen = {n: v for n, v in self.object.items() if n in names}
        names = [cone] + ["friction"] * friction_by_contact(self.layout.scene, name)
        return chosen | {n: self.step.constant(n) for n in names}

    def _support(self, columns: Lanes, height: Lanes) -> Lanes:
        """Points that may touch a table of these axes, in the object's frame."""
        points = objects.table_points(self.layout.scene, self.world_object, columns, height)
        return lanewise(_turned_back, columns, points)

    def _values(self, centre: Lanes) -> Lanes:
        local = lanewise(shapes.in_object, self.bodies["columns"], centre)
        return objects.cell_values(self.world_object, local)


def _turned_back(columns: jax.Array, points: jax.Array) -> jax.Array:
    """Points (3, point, world) along the world's axes in the object's frame."""
    return shapes.in_object(columns[:, :, 0], points)


def _place(chain: LinkMotion) -> BodyMotion:
    return BodyMotion(*(getattr(chain, n) for n in BodyMotion._fields))


def _add(bars: LinkMotion, **more: Lanes) -> LinkMotion:
    old = {n: getattr(bars, n) for n in more}
    return bars._replace(**plus(old, more))


CONE = "cone.finger_finger"
ON_PALM = "cone.finger_palm"


class SelfContactsVjp:
    """Leaves the cotangents of the links with self-contacts as "pairbar"."""

    def __init__(self, sweep: ResidualVjp, self_contacts: BoundSelfContacts):
        self.sweep = sweep
        self.contacts = self_contacts
        self.layout = sweep.layout
        self.bars = sweep.bars
        self.like = sweep.like
        self.lane = sweep.block.lane
        self.scratch = sweep.scratch
        self.hand = sweep.step.hand

    def run(self) -> None:
        def clear(i: jax.Array, x: jax.Array) -> jax.Array:
            for name in BodyMotion._fields:
                name = getattr(PairBar, name)
                self.scratch.write(name, zeros(self.scratch.shape(name), self.like), i)
            return x

        jax.lax.fori_loop(0, self.layout.links + 1, clear, jnp.int32(0))
        effects = self.layout.scene.effects
        hull = self.layout.scene.effects.surface == "hull"
        if effects.finger_palm:
            self._leave_palm(
                BodyMotion(*(self.sweep.none(n) for n in BodyMotion._fields)), first=True
            )

        def slot(item: Any, pairing: FingerPairing) -> None:
            read = self.contacts.read
            owner = read(Remembered.owner, item).lane > 0.5
            live = owner & (read(Contact.share, item).lane > 0)
            if pairing.itself is not None:
                other = read(Slot.other, item).lane.astype(jnp.int32)
                if effects.finger_palm:
                    palm = live & pairing.itself & (other == 0)
                    any_of(palm, lambda: self._on_palm(item, palm))
                if touches_itself(self.layout.scene):
                    itself = live & pairing.itself & (other > 0)
                    any_of(itself, lambda: self._on_itself(item, pairing, itself))
                live = live & ~pairing.itself
            if effects.finger_finger:
                reverse = self._on_finger if hull else self._spheres
                any_of(live, lambda: reverse(item, pairing, live))

        self.contacts.do(slot)

    # The palm

    def _on_palm(self, item: Any, live: jax.Array) -> None:
        """Adds the cotangents of a ring or sphere and of the palm."""
        number, row, ring = self._ring(item)
        bodies = self.sweep.bodies
        step = self.sweep.step
        palm = self._body(jnp.zeros_like(row))._replace(
            origin=bodies["place"], frame=bodies["frame"]
        )
        args = (
            (self._body(row), ring),
            palm,
            step.constant(WorldOptions.palm_disc),
            step.constant(ON_PALM),
        )
        run = partial(residual.on_palm, self.layout.scene)
        (place, ring_bar), palm, disc, cone = only_on(
            self._side(live), pull(run, args, (), self._power_bar)
        )
        self.bars.add({ON_PALM: cone, "palm_disc": disc})
        self.bars.add({"ring": ring_bar}, number, self.lane)
        self._leave_palm(palm)
        self._leave(place._asdict(), row)

    def _leave_palm(self, bars: BodyMotion, *, first: bool = False) -> None:
        for name, value in bars._asdict().items():
            name = getattr(PalmBar, name)
            if not first:
                value = plus(self.scratch.read(name), value)
            self.scratch.write(name, value)

    # Fingers

    def _spheres(self, item: Any, pairing: FingerPairing, live: jax.Array) -> None:
        number, row, ring = self._ring(item)
        other = jax.lax.div(
            self.contacts.read(Remembered.ring, item).lane.astype(jnp.int32), self._count
        )
        theirs = (
            self._body(row_of(other, self.layout.rings_per_link), pairing.lane),
            self._numbers(other, pairing),
        )
        args = (self._body(row), ring), theirs, self.sweep.step.constant(CONE)
        bars = pull(partial(residual.between_spheres, self.layout.scene), args, (), self._power_bar)
        (place, ring_bar), swapped, cone = only_on(self._side(live), bars)
        self.bars.add({CONE: cone})
        self.bars.add({"ring": ring_bar}, number, self.lane)
        self._leave(place._asdict(), row)
        (place, ring_bar), other = pairing.swap((swapped, self._float(other)))
        other = other.lane.astype(jnp.int32)
        self.bars.add({"ring": ring_bar}, other, self.lane)
        self._leave(place._asdict(), row_of(other, self.layout.rings_per_link))

    def _on_finger(self, item: Any, pairing: FingerPairing, live: jax.Array) -> None:
        """Adds the cotangents of a ring and of another finger's segment."""
        row = self.contacts.read(Slot.row, item)
        other = pairing.swap(row).lane.astype(jnp.int32)
        fixed = {"end": self._float(1)}
        theirs = self._rings(item, pairing, live, other, pairing.lane, fixed)
        line, where = pairing.swap((theirs, self._float(other)))
        self._leave_line(line, where.lane.astype(jnp.int32))

    def _on_itself(self, item: Any, pairing: FingerPairing, live: jax.Array) -> None:
        """Adds the cotangents of a ring and of its own finger's segment."""
        other = self.contacts.read(Slot.other, item).lane.astype(jnp.int32)
        search = self.sweep.step.search
        assert search is not None
        end = search.last_of(self._ring(item)[0], other)
        fixed = {"end": self._float(end)}
        line = self._rings(item, pairing, live, other, self.lane, fixed)
        self._leave_line(line, other)

    def _rings(
        self, item: Any, pairing: FingerPairing, live: jax.Array, other: Any, lane: Any, fixed: dict
    ) -> CentreLineSegment:
        """Adds the cotangents of a ring; returns those of the segment that it touches."""
        number, row, ring = self._ring(item)
        before, link, after = self_collision.neighbours(other, self.layout.links)
        frames = tuple(self._chain(Chain.frame, r, lane) for r in (before, after))
        sections = [self._numbers(n, pairing, lane) for n in self._sections(other)]
        line = CentreLineSegment(
            self._body(link, lane), self._chain(Chain.origin, after, lane), frames, *sections
        )
        fixed |= {
            "last": self._float(jnp.where(other == self.layout.links, self.like + 1.0, self.like))
        }
        held = friction_memory.held_and_cotangents(self.sweep.step, pairing)
        args = (self._body(row), ring), line, self.sweep.step.constant(CONE), held
        bars = pull(
            partial(residual.between_rings, self.layout.scene), args, (fixed,), self._power_bar
        )
        (place, own_ring), line, cone, kept = only_on(self._side(live), bars)
        friction_memory.add_pairing_cotangents(self.bars, pairing, kept)
        self.bars.add({CONE: cone})
        self.bars.add({"ring": own_ring}, number, self.lane)
        self._leave(place._asdict(), row)
        return line

    def _leave_line(self, line: CentreLineSegment, row: jax.Array) -> None:
        before, link, after = self_collision.neighbours(row, self.layout.links)
        self._leave(line.place._asdict(), link)
        self._leave({"frame": line.frames[0]}, before)
        self._leave({"origin": line.origin, "frame": line.frames[1]}, after)
        bars = line.tip, line.first
        for ring, bar in zip(self._sections(row), bars, strict=False):
            self.bars.add({"ring": bar}, ring, self.lane)

    def _sections(self, row: jax.Array) -> list[jax.Array]:
        """Rings whose sections segments have, and the one before has; see `ring_at`."""
        search = self.sweep.step.search
        assert search is not None
        places = (1, 0) if self.layout.tapered else (1,)
        return [jnp.zeros_like(row) + search.ring_at(row + k) for k in places]

    # Both

    @property
    def _power_bar(self) -> Lanes:
        return self.sweep.power_bar

    @property
    def _count(self) -> jax.Array:
        return jnp.full(
            (self.layout.size,), self.layout.links * self.layout.rings_per_link, jnp.int32
        )

    def _side(self, live: jax.Array) -> Lanes:
        return lanes([live], (), wide=True)

    def _float(self, value: Any) -> Lanes:
        return lanes([self.like + jnp.asarray(value, self.like.dtype)], (), wide=True)

    def _ring(self, item: Any) -> tuple[jax.Array, jax.Array, Lanes]:
        """Number of a slot's ring, its link and its numbers."""
        number = self.contacts.read(Remembered.ring, item).lane.astype(jnp.int32)
        number = jax.lax.rem(number, self._count)
        ring = self.hand.gather(Hand.ring, number, self.lane)
        return number, row_of(number, self.layout.rings_per_link), ring

    def _numbers(self, number: jax.Array, pairing: FingerPairing, lane: Any = None) -> Lanes:
        lane = pairing.lane if lane is None else lane
        return self.hand.gather(Hand.ring, number, lane)

    def _body(self, row: jax.Array, lane: Any = None) -> BodyMotion:
        return BodyMotion(*(self._chain(getattr(Chain, n), row, lane) for n in BodyMotion._fields))

    def _chain(self, name: Field, row: jax.Array, lane: Any = None) -> Lanes:
        lane = self.lane if lane is None else lane
        return self.scratch.gather(name, row, lane)

    def _leave(self, values: dict[str, Lanes], row: jax.Array) -> None:
        for name, value in values.items():
            name = getattr(PairBar, name)
            old = self.scratch.gather(name, row, self.lane)
            self.scratch.scatter(name, plus(old, value), row, self.lane)


def row_of(number: jax.Array, k: int) -> jax.Array:
    return jax.lax.div(number, jnp.full_like(number, k)) + 1
