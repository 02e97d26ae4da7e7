"""Contacts with what distance fields describe, and of the object's points with the table.

They have a place in memory each, whether they touch or not.  What is far from all lanes is not
looked at further.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import friction_memory, objects
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.finger_shapes import FingerShapes
from codesign_jax.engines.structured.kernel.kinds import beside
from codesign_jax.engines.structured.kernel.memory import any_of, zeros
from codesign_jax.engines.structured.kernel.objects import WorldObject
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.problem import relative
from codesign_jax.engines.structured.kernel.rows import (
    Contact,
    Hand,
    Side,
    WorldOptions,
    WorldState,
)
from codesign_jax.engines.structured.kernel.self_collision import closed
from codesign_jax.engines.structured.kernel.step_contacts import StepContacts
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanes import apply_columns, cross, dot, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import shapes, surroundings
from codesign_jax.engines.structured.laws.cones import friction_by_contact
from codesign_jax.engines.structured.laws.rings import Facing, Place
from codesign_jax.engines.structured.laws.touch import (
    ball_on_field,
    facing,
    ring_centres,
    ring_place,
    ring_reach,
)

FAR = 1e3
"""A gap that no ring has [m]."""


class SdfCollision:
    """Enters the contacts of fingers, palm and object with object and table."""

    def __init__(
        self,
        step: StepMemory,
        contacts: StepContacts,
        bodies: dict[str, Any],
        world_object: WorldObject,
    ):
        """Prepares the search.

        Args:
          step: The step's memory.
          contacts: The step's contacts, of which it enters those with fields.
          bodies: What `body_motion.palm_and_object` returns.
          world_object: The object of each lane's world.
        """
        self.step = step
        self.layout = step.layout
        self.bodies = bodies
        self.world_object = world_object
        self.contacts = contacts.field_contacts
        self.names = [name for name, c in self.contacts.items() if c.layout.per_link]
        self.surface = step.layout.scene.effects.surface

    def looks(self, name: str) -> list[Callable[[Lanes], tuple[Lanes, Lanes]]]:
        """The object, or table and fixtures: from points (3, k) to distances (k,) and gradients."""
        if name.endswith("_object"):
            return [self._object]
        position = self.step.world_state.read(WorldState.position)
        return [
            partial(lanewise, field, position) for field in surroundings.fields(self.layout.scene)
        ]

    def _object(self, point: Lanes) -> tuple[Lanes, Lanes]:
        columns = self.bodies["columns"]
        local = lanewise(shapes.in_object, columns, point)
        distance, gradient = objects.signed_distance(self.layout.scene, self.world_object, local)
        return distance, lanewise(apply_columns, columns, gradient)

    def frictions(self, name: str, count: int = 1) -> Lanes | None:
        """Coefficients (1, k) of an item of `count` rings a field; None where all are alike."""
        if not friction_by_contact(self.layout.scene, name):
            return None
        which = surroundings.touched(self.layout.scene, name, count)
        return lanewise(
            lambda v: jnp.stack([v[i] for i in which])[None],
            self.step.constant(WorldOptions.friction),
        )

    def moves(self, name: str, link_acc: Lanes | None, vel: Lanes | None) -> tuple[Lanes, Lanes]:
        """Relative spatial acceleration and velocity of a pair of bodies, (6, ...) each.

        Args:
          name: The pair.
          link_acc: Spatial acceleration of the item's link without velocity terms, (6, ...); `vel`:
            its spatial velocity, (6, ...). None for pairs without a finger.
        """
        bodies = self.bodies
        now = self.bodies["now"]
        return (
            relative(name, link_acc, now.palm_acc, now.object_acc),
            relative(name, vel, bodies["vel"], bodies["object_vel"]),
        )

    def held(self, contacts: ContactList, item: Item) -> tuple[Lanes, Lanes] | None:
        """What an item's contacts hold of friction, see `friction_memory.held_by_item`."""
        return friction_memory.held_by_item(self.step, contacts, self.bodies["columns"], item)

    def of_link(self, i: Any, carry: tuple) -> None:
        """Contacts of a link; carry: its origin, frame, velocity, bias and acceleration."""
        if self.layout.team > 1:  # see `of_rings`
            return
        origin, frame, vel, _, link_acc = carry
        for name in self.names:
            numbers = self.numbers(i)
            centre = lanewise(ring_centres, origin, frame, numbers)
            hold = self.held(self.contacts[name], at(i))
            self.on_field(
                name, at(i), numbers, frame, centre, self.moves(name, link_acc, vel), hold
            )

    def of_rings(self, fingers: FingerShapes) -> None:
        """Contacts of the fingers' rings, dealt to the lanes of a team."""
        for name in self.names:
            contacts = self.contacts[name]
            contacts.write_empty()

            def ring(item: Item, name: str = name, contacts: ContactList = contacts) -> None:
                row, numbers, frame, centre = fingers.body(item.number)
                numbers, centre = (lanewise(as_item, v) for v in (numbers, centre))
                moves = self.moves(
                    name, *(fingers.side_of(n, row) for n in (Side.link_acc, Side.vel))
                )
                hold = self.held(contacts, item)
                self.on_field(name, item, numbers, frame, centre, moves, hold)

            contacts.each(ring)

    def numbers(self, i: Any) -> Lanes:
        """Numbers of the rings or spheres of link i, (number, k), see `StepMemory.ring`."""
        k = self.layout.rings_per_link
        each = [self.step.ring(i * k + j) for j in range(k)]
        return lanewise(lambda rows: jnp.stack(rows, 1), each)

    def on_field(
        self,
        name: str,
        item: Item,
        numbers: Lanes,
        frame: Lanes,
        centre: Lanes,
        moves: tuple[Lanes, Lanes],
        hold: tuple[Lanes, Lanes] | None,
    ) -> None:
        """Creates contacts of rings or balls of a body.

        Args:
          name: The pair of bodies.
          item: Where the contacts are in their list.
          numbers: Numbers of the k rings or balls, (number, k).
          frame: The body's frame as columns, (3, 3, ...).
          centre: Their centres from the object's [m], (3, k).
          moves: See `moves`.
          hold: What the contacts hold of friction, see `held`.
        """
        contacts = self.contacts[name]
        looks = self.looks(name)
        seen = [look(centre) for look in looks]
        friction = self.frictions(name, contacts.layout.k // len(looks))
        if self.surface == "spheres":
            places = [lanewise(ball_on_field, numbers, centre, *first) for first in seen]
            return contacts.create(item, joined(places), *moves, friction=friction)
        flat = (
            not name.endswith("_object") and self.layout.scene.effects.table
        )  # the table comes first
        most = self.closing_gap(numbers, centre, moves[1])
        near = [lanewise(may_touch, numbers, first[0], most).lane for first in seen]
        contacts.write(Contact.share, zeros((contacts.layout.k,), self.step.like), item)

        def look_again() -> None:
            faced = []
            for n, (look, first) in enumerate(zip(looks, seen, strict=True)):
                body = numbers, frame, centre
                faced.append(facing(*body, first, look, plane=flat and n == 0, apply=lanewise))
            close = [lanewise(any_closes, face.gap, most).lane for face in faced]
            any_of(total(close) > 0, lambda: create(faced))

        def create(faced: list[Facing]) -> None:
            places = [lanewise(ring_place, numbers, frame, centre, face) for face in faced]
            contacts.create(item, joined(places), *moves, friction=friction, hold=hold)

        any_of(total(near) > 0, look_again)

    def closing_gap(self, numbers: Lanes, centre: Lanes, velocity: Lanes) -> Lanes:
        """Largest gaps that rings may close within the step, see `closed_gap`.

        Where the place of each ring is recorded, no gap is too large.
        """
        record = self.layout.record
        if record is not None and record.touch:
            return lanewise(lambda numbers: FAR + 0.0 * numbers[6], numbers)
        run = partial(closed_gap, self.layout.scene.discretization.timestep)
        return lanewise(run, numbers, centre, velocity)

    def of_palm_and_object(self, state: dict) -> None:
        """Contacts of the palm's rings or spheres, and of the object with the table."""
        layout = self.layout
        bodies = self.bodies
        palm = [name for name in ("palm_object", "palm_table") if name in self.contacts]
        for i in range(layout.palm_groups if palm else 0):
            numbers = lanewise(as_item, self.step.hand.read(Hand.palm_ring, i))
            centre = lanewise(ring_centres, bodies["place"], bodies["frame"], numbers)
            for name in palm:
                moves = self.moves(name, None, None)
                hold = self.held(self.contacts[name], at(i))
                self.on_field(name, at(i), numbers, bodies["frame"], centre, moves, hold)
        on_table = self.contacts.get("object_table")
        slots = self._table_points(state) if on_table else []
        rubs = self.frictions("object_table")
        for i in range(on_table.layout.places.count if on_table else 0):
            assert on_table is not None
            mine = range(i * layout.fingers, min((i + 1) * layout.fingers, len(slots)))
            place = Place(*self._deal([slots[k] for k in mine]))
            friction = None
            if rubs is not None:
                (friction,) = self._deal([(rubs[:, k],) for k in mine])
            moves = self.moves("object_table", None, None)
            hold = self.held(on_table, at(i))
            on_table.create(at(i), place, *moves, friction=friction, hold=hold)

    def _table_points(self, state: dict) -> list[Place]:
        """Each point of the object on the table and the fixtures, lanes of a world."""
        scene = self.layout.scene

        def points(columns: Lanes, height: Lanes, _: int | None) -> Lanes:
            return objects.table_points(scene, self.world_object, columns, height)

        position = state["position"]
        where = position, self.bodies["columns"], self.world_object.shape
        look = lambda point, _: self._object(point)  # noqa: E731
        places = surroundings.object_places(scene, *where, points, look, apply=lanewise)
        return [slot for place in places for slot in lanewise(slots_of, place)]

    def _deal(self, slots: list) -> list[Lanes]:
        """Deals the slots, each of several (component, 1, world), out to the finger lanes."""
        dealt = []
        for field in range(len(slots[0])):
            values: list[Any] = [s[field] for s in slots]
            parts = []
            for c in range(values[0].parts.shape[0]):
                lane = self.step.like
                for k, value in enumerate(values):
                    lane = jnp.where(self.step.block.finger == k, value.parts[c].item(), lane)
                parts.append(lane)
            dealt.append(lanes(parts, (*values[0].shape[:-2], 1), wide=True))
        return dealt


def joined(places: list[Place]) -> Place:
    """Contacts with several fields, one behind the other."""
    return places[0] if len(places) == 1 else lanewise(lambda *p: beside(list(p)), *places)


def slots_of(place: Place) -> list[Place]:
    """Contacts of an object's points (3, point, world) as a place each."""
    count = place.gap.shape[0]
    return [
        Place(*(v[:, k : k + 1] for v in place[:2]), *(v[k : k + 1] for v in place[2:]))
        for k in range(count)
    ]


def closed_gap(timestep, numbers, centre, vel):
    """Largest gaps that a link's rings may close within the step [m], (k,)."""
    moving = vel[3:, None] + cross(vel[:3, None], centre)
    turning = ring_reach(numbers) * jnp.sqrt(dot(vel[:3], vel[:3]))
    return closed(timestep, jnp.sqrt(dot(moving, moving)) + turning)


def may_touch(numbers, distance, most):
    """One where any of a link's rings may touch within the step, else zero.

    Args:
      distance: Of the rings' centres [m], (k,).
      most: See `closed_gap`.
    """
    real = numbers[6] > 0
    return any_closes(jnp.where(real, distance - ring_reach(numbers), jnp.inf), most)


def any_closes(gap, most):
    """One where any of a link's rings has a smaller gap than `closed_gap`, else zero."""
    closes = jnp.where(gap < most, 1.0, 0.0)
    return sum(closes[k] for k in range(closes.shape[0]))


def as_item(numbers):
    """What one ring has, (n, ...), as that of an item of one contact, (n, 1, ...)."""
    return numbers[:, None]
