"""Finds where fingers touch each other, themselves and the palm: rings or spheres.

A ring meets the nearest place of another finger's centre line, or of its own on the way back to the
palm that is `finger_shapes.arc` away along the finger.  Of two fingers the first one's rings look:
with both fingers' there would be twice as many contacts, which is what a step's time goes to.  The
lanes of a team, see `shared_memory`, look with a ring each.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import friction_memory
from codesign_jax.engines.structured.kernel.contact_list import ContactList, fields_of, with_held
from codesign_jax.engines.structured.kernel.finger_shapes import FingerShapes
from codesign_jax.engines.structured.kernel.kinds import (
    balls,
    palm_distance,
    place_of,
    with_axis,
)
from codesign_jax.engines.structured.kernel.memory import any_of, each, loop, solid, zeros
from codesign_jax.engines.structured.kernel.pairing import FingerPairing
from codesign_jax.engines.structured.kernel.ring_pairs import RingPairs
from codesign_jax.engines.structured.kernel.rows import (
    Contact,
    Field,
    Hand,
    Remembered,
    Search,
    Slot,
    WorldOptions,
)
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, touch
from codesign_jax.engines.structured.laws.rings import Facing, Place
from codesign_jax.model.layout import beyond_base, first_on_palm, touches_itself

SURELY = 1.0 - 1e-4
"""At a joint two segments have one nearest place, which is the first one's, whatever is rounded."""


class SelfCollision:
    """Gives a slot to each contact of fingers with one another, with themselves and the palm.

    Attributes:
      fingers: Where the fingers are.
      contacts: The hand's contacts with itself.
      hull: Whether fingers have rings.
      palm: The palm's place (3, ...), frame (3, 3, ...) and disc, lanes of a world; None without
        contacts with it.
    """

    def __init__(self, fingers: FingerShapes, self_contacts: ContactList, bodies: dict[str, Any]):
        """Prepares the search; bodies: what `body_motion.palm_and_object` returns."""
        step = fingers.step
        self.step = step
        self.fingers = fingers
        self.contacts = self_contacts
        self.layout = step.layout
        self.block = step.block
        self.like = step.like
        self.hull = step.layout.scene.effects.surface == "hull"
        self.palm = None
        if step.layout.scene.effects.finger_palm:
            self.palm = bodies["place"], bodies["frame"], step.constant(WorldOptions.palm_disc)

    def clear(self) -> None:
        """Empties the slots, before the step's contacts are found."""
        for slot_row in range(self.contacts.layout.slots.rows):
            self.contacts.clear(slot_row)
        friction_memory.clear(self.step)

    def find(self) -> None:
        """Gives a slot to each contact of this step, when all links are stored."""
        scene = self.layout.scene
        fingers = self.fingers
        if self.hull:
            fingers.end_lines()
        if self.palm is not None:
            self._each_ring(first_on_palm(self.layout.links) - 1, self._on_palm)
        if touches_itself(scene):
            self._each_ring(0, self._on_itself)
        if not scene.effects.finger_finger:
            return

        def pairing(slot_row: jax.Array, x: jax.Array) -> jax.Array:
            pairing = self.contacts.pairing(slot_row)
            other = jax.lax.div(pairing.lane, jnp.int32(self.layout.block))
            owner = (self.block.finger < other) & (other < self.layout.num_fingers)
            if self.hull and not self.contacts.layout.slots.gathers:
                RingPairs(self, slot_row, pairing, owner).find()
                return x
            if self.hull:
                # The segments of the other finger's centre line.
                each(self.layout.links + 1, partial(self._copy_line, pairing))
                reach = fingers.reach(fingers.largest())
                size = lanewise(_stacked, reach, fingers.read(Search.fastest))
                fingers.write(Search.other_size, pairing.swap(size))
            search = self._on_finger if self.hull else self._on_spheres
            self._each_ring(0, lambda *ring: search(slot_row, pairing, owner, *ring))
            return x

        jax.lax.fori_loop(
            int(self.contacts.layout.with_itself),
            self.contacts.layout.slots.rows,
            pairing,
            jnp.int32(0),
        )

    def _each_ring(self, link: int, search: Callable) -> None:
        """Runs search(item, lanes that have it) for all rings from a link on, dealt to lanes."""
        first = link * self.layout.rings_per_link
        count = self.fingers.count - first

        def ring(k: Any) -> None:
            item, mine = self.block.dealt(count, k)
            search(item + first, self.like > -1 if mine is None else mine)

        each(self.block.rounds(count), ring)

    def _copy_line(self, pairing: FingerPairing, i: Any) -> None:
        """Copies a segment of the other finger's centre line."""
        self.fingers.write(Search.other, pairing.swap(self.fingers.read(Search.line, i)), i)

    # Which rings are close

    def gap(self, speed: Lanes) -> jax.Array:
        """Largest gap that bodies of this speed to each other may close in this step [m]."""
        return lanewise(partial(closed, self.layout.scene.discretization.timestep), speed).lane

    def near(self, square: jax.Array, mine: Lanes, theirs: Lanes, speed: Lanes) -> jax.Array:
        """Whether rings may touch in this step.

        Args:
          square: Squared distance of their centres [m^2].
          mine: Reach of one ring; `theirs`: of the other one [m].
          speed: Bound of the speed at which they approach [m/s].
        """
        far = lanewise(jnp.add, mine, theirs).lane + self.gap(speed)
        return square < far * far

    def if_close(
        self, near: jax.Array, faced: Facing, speed: Lanes, add: Callable[[jax.Array], None]
    ) -> None:
        """Runs add(lanes whose rings are close), if any may touch in this step.

        Args:
          near: Lanes to look at.
          faced: How their rings face the other body.
          speed: Bound of the speed at which they approach [m/s].
        """
        close = near & (faced.gap.lane < self.gap(speed))
        any_of(close, lambda: add(close))

    # What is stored of a contact

    def candidate(
        self,
        place: Place,
        cone: Any,
        row: Any,
        mine: list[Lanes],
        theirs: list[Lanes],
        held: list[Lanes],
    ) -> dict[str, Lanes]:
        """Fields of a contact of a link with another body, see `ContactList.create`.

        Args:
          place: Where it is.
          cone: Its friction cone.
          row: The link, 1 for the first one.
          mine: Its acceleration and velocity, see `moves`; `theirs`: those of the other body.
          held: What the contact holds of friction, (3,), or nothing.
        """
        place = lanewise(with_axis, place)
        acc, vel = lanewise(_differences, mine, theirs)
        place, jar = self.contacts.begin(place, cone, acc, vel)
        for g in held:
            jar = lanewise(_with_held, jar, place, cone, g)
        return fields_of(place, jar) | {Slot.side: self._number(row)}

    def of_rows(
        self, read: Callable, row: jax.Array, which: jax.Array, pairing: FingerPairing | None
    ) -> Any:
        """Returns read(row of each lane, lane of the finger that has it), a tree of lanes.

        Vectors gather number by number: there the rows of the lanes `which`, of which there are
        few, are read one after the other. Other lanes get what one of these has.

        Args:
          read: Reads, such as `FingerShapes.segment`.
          row: Rows of bodies, int32, shape (lane,).
          which: Lanes that need them, bool, shape (lane,).
          pairing: Whose partner has the rows; None for the lanes' own fingers.
        """
        if self.contacts.layout.slots.gathers:
            return read(row, None if pairing is None else pairing.lane)
        # The lanes that have the rows read them, and then pass them on.
        left = jnp.where(which, row, -1)
        if pairing is not None:
            left = pairing.swap(lanes([left], (), wide=True)).lane
        first = jnp.maximum(jnp.max(left), 0)
        arrays, rebuild = solid(read(first), self.block.size)

        def step(carry: list) -> list:
            now, left, *values = carry
            chosen = left == now
            new = solid(read(now), self.block.size)[0]
            values = [jnp.where(chosen, a, b) for a, b in zip(new, values, strict=True)]
            left = jnp.where(chosen, -1, left)
            return [jnp.max(left), left, *values]

        left = jnp.where(left == first, -1, left)
        start = [jnp.max(left), left, *arrays]
        gathered = rebuild(jax.lax.while_loop(lambda c: c[0] >= 0, step, start)[2:])
        return gathered if pairing is None else pairing.swap(gathered)

    # Each kind of contact

    def _number(self, value: Any) -> Lanes:
        return lanes([self.like + jnp.asarray(value, self.like.dtype)], (1, 1), wide=True)

    def _alone(self, candidate: dict[str, Lanes], other: Any, item: Any, mine: jax.Array) -> None:
        """Gives a slot to a contact of a finger with the palm or itself.

        Args:
          candidate: See `candidate`.
          other: Link of the other side, 0 for the palm; `item`: the ring.
        """
        candidate |= {Slot.other_side: self._number(other)}
        candidate |= self.contacts.remembered({Remembered.owner: 1.0, Remembered.ring: item})
        which = mine & (candidate[Contact.share].lane > 0)
        any_of(which, lambda: self.contacts.append(0, which, candidate))

    def _on_palm(self, item: Any, mine: jax.Array) -> None:
        fingers = self.fingers
        row, numbers, frame, centre = fingers.body(item)

        def look(point: Lanes) -> tuple[Lanes, Lanes]:
            return lanewise(palm_distance, point, self.palm)

        field = look(centre)
        place = lanes([self.like + jnp.asarray(row, self.like.dtype)], (), wide=True)
        sizes = self.step.hand.read(Hand.offset, 0), fingers.ring(0)
        mine = mine & (lanewise(free_of_palm, place, numbers, *sizes).lane > 0)
        near = self._near_palm(field[0], numbers)

        def add(place: Place) -> None:
            palm = jnp.zeros_like(jnp.asarray(row))
            cone = self.contacts.cone_of_row(0)
            theirs = fingers.moves(palm)
            candidate = self.candidate(place, cone, row, fingers.moves(row), theirs, [])
            self._alone(candidate, palm, item, mine)

        def enter() -> None:
            faced = touch.facing(numbers, frame, centre, field, look, apply=lanewise)

            def add_ring(_: jax.Array) -> None:
                add(lanewise(touch.ring_place, numbers, frame, centre, faced))

            self.if_close(mine, faced, fingers.read(Search.fastest), add_ring)

        def enter_ball() -> None:
            add(lanewise(touch.ball_on_field, numbers, centre, *field))

        any_of(mine & near, enter if self.hull else enter_ball)

    def _near_palm(self, distance: Lanes, numbers: Lanes) -> jax.Array:
        fingers = self.fingers
        size = lanewise(jnp.maximum, distance, zeros((), self.like)).lane
        none = zeros((), self.like)
        square = size * size
        return self.near(square, fingers.reach(numbers), none, fingers.read(Search.fastest))

    def _on_itself(self, item: Any, mine: jax.Array) -> None:
        fingers = self.fingers
        row, numbers, frame, centre = fingers.body(item)
        square, other, t = self.nearest(Search.line, centre, item)
        theirs = fingers.largest() if self.layout.tapered else numbers
        reaches = fingers.reach(numbers), fingers.reach(theirs)
        near = mine & self.near(square, *reaches, fingers.read(Search.fastest))

        def enter() -> None:
            segment, moves = self.of_rows(fingers.segment, other, near, None)
            faced = fingers.facing(numbers, frame, centre, segment, other, t)

            def add(close: jax.Array) -> None:
                place = self.place(numbers, frame, centre, faced)
                held = friction_memory.held_by_pairing(self.step, self.contacts, 0)
                candidate = self.candidate(
                    place, self.contacts.cone_of_row(1), row, fingers.moves(row), moves, held
                )
                self._alone(candidate, other, item, close)

            self.if_close(near, faced, fingers.read(Search.fastest), add)

        any_of(near, enter)

    def _on_finger(
        self, slot_row: Any, pairing: FingerPairing, owner: jax.Array, item: Any, mine: Any
    ) -> None:
        fingers = self.fingers
        link, numbers, frame, centre = fingers.body(item)
        square, other, t = self.nearest(Search.other, centre)
        theirs = fingers.read(Search.other_size)
        speed = lanewise(jnp.add, fingers.read(Search.fastest), theirs[1])
        near = owner & mine & self.near(square, fingers.reach(numbers), theirs[0], speed)

        def enter() -> None:
            segment, moves = self.of_rows(fingers.segment, other, near, pairing)
            faced = fingers.facing(numbers, frame, centre, segment, other, t)

            def add(close: jax.Array) -> None:
                place = self.place(numbers, frame, centre, faced)
                held = friction_memory.held_by_pairing(self.step, self.contacts, slot_row)
                candidate = self.candidate(
                    place,
                    self.contacts.cone_of_row(slot_row),
                    link,
                    fingers.moves(link),
                    moves,
                    held,
                )
                self.enter(slot_row, close, owner, candidate, other, item)

            self.if_close(near, faced, speed, add)

        any_of(near, enter)

    def enter(
        self,
        slot_row: Any,
        near: jax.Array,
        owner: jax.Array,
        contact: dict[str, Lanes],
        other: Any,
        item: Any,
        second: jax.Array | None = None,
    ) -> None:
        """Gives contacts of two fingers a slot.

        Args:
          slot_row: Their row of slots.
          near: Lanes that may have found a contact.
          owner: Lanes of the rings' fingers.
          contact: See `candidate`.
          other: The other finger's links.
          item: The ring.
          second: Lanes of the other finger, if they have looked; else the owners have.
        """
        which = near & (contact[Contact.share].lane > 0)
        step = contact[Contact.jar_step]
        mine = {name: value for name, value in contact.items() if name != Contact.jar_step}
        theirs = mine | {Slot.side: self._number(other)}
        theirs |= {
            name: lanewise(jnp.negative, mine[name]) for name in (Contact.normal, Contact.jar)
        }
        none = {}
        if self.contacts.layout.with_itself:
            none = {Slot.other_side: zeros((1, 1), self.like)}

        alike = (
            self.contacts.remembered({Remembered.owner: owner, Remembered.ring: item})
            | none
            | {Contact.jar_step: step}
        )
        fields = (mine, theirs) if second is None else (theirs, mine)
        finder = owner if second is None else second
        any_of(which, lambda: self.contacts.enter(slot_row, which, finder, *fields, alike))

    def nearest(self, name: Field, centre: Lanes, itself: Any = None) -> tuple:
        """The nearest place of a centre line.

        Args:
          name: `Search.line`, the finger's own, or `Search.other`.
          centre: The lanes' rings' centres [m], (3, ...).
          itself: The ring on the finger's own line.

        Returns:
          Its squared distance [m^2], its segment's link, int32, and where along the segment it is,
          0 to 1, shape (lane,) each.
        """
        last = self.layout.links

        def compare(segment, centre, best, number, end):
            start = segment[:3]
            along = segment[3:6]
            away = centre - start
            t = dot(away, along) * segment[6]
            t = jnp.minimum(jnp.maximum(t, 0.0), end)
            left = away - t * along
            square = jnp.where(end >= 0, dot(left, left), 1.0)
            better = square < SURELY * best[0]
            new = jnp.stack([square, number + 0.0 * square, t])
            return jnp.where(better, new, best)

        def nearer(row: Any, best: Lanes) -> Lanes:
            number = self.like + jnp.asarray(row).astype(self.like.dtype)
            end = self.like + 1.0 if itself is None else self.fingers.last_of(itself, row)
            place, end = (lanes([v], (), wide=True) for v in (number, end))
            return lanewise(compare, self.fingers.read(name, row), centre, best, place, end)

        best = lanes([self.like + 1.0, self.like, self.like], (3,), wide=True)
        first = int(itself is not None)  # a finger's half link at the palm is the palm's
        count: Any = last + 1 - first
        if itself is not None and not self.contacts.layout.slots.gathers:
            count = jnp.clip(self.fingers.rows_back(itself), 0, count)
        best = loop(count, lambda k, b: nearer(k + first, b), best, self.block.size)
        square, number, t = (best[k].lane for k in range(3))
        return square, number.astype(jnp.int32), t

    def place(self, numbers: Lanes, frame: Lanes, centre: Lanes, facing: Facing) -> Place:
        """Contacts of rings with what they face; `rings.place`.

        Args:
          numbers: The rings' numbers; `frame`: their links' frames as columns, (3, 3, ...);
            `centre`: their centres [m], (3, ...).
          facing: How they face it.
        """
        return lanewise(place_of, numbers, frame, centre, facing)

    def _on_spheres(
        self, slot_row: Any, pairing: FingerPairing, owner: jax.Array, item: Any, mine: Any
    ) -> None:
        """A sphere of the finger that comes first, with all of the other one's."""
        fingers = self.fingers
        link, numbers, _, centre = fingers.body(item)
        apart = self.layout.rings_per_link

        def with_other(j: Any) -> None:
            theirs = pairing.swap(fingers.body(j)[1:])
            place = lanewise(balls, numbers, centre, theirs[0], theirs[2])
            near = owner & mine & (place.gap.lane < 0)

            def enter() -> None:
                other = jax.lax.div(j, jnp.full_like(j, apart)) + 1
                moves = pairing.swap(fingers.moves(other))
                candidate = self.candidate(
                    place, self.contacts.cone_of_row(slot_row), link, fingers.moves(link), moves, []
                )
                number = item + fingers.count * j
                self.enter(slot_row, near, owner, candidate, other, number)

            any_of(near, enter)

        each(fingers.count, with_other)


def closed(timestep, speed):
    """Largest gap that bodies of a speed to each other may close in a step [m]."""
    return jnp.maximum(contact.MARGIN, timestep * speed)


def free_of_palm(row, numbers, offset, first):
    """1 for rings that may touch the palm, else 0, see `beyond_base`.

    Args:
      row: The ring's link, 1 for the first one that moves.
      offset: From the finger's base to its first joint [m], half a segment.
      first: Numbers of the finger's first ring, at its base.
    """
    along = (row - 0.5) * 2.0 * offset + numbers[0]
    return jnp.where(beyond_base(along, 2.0 * first[5]), 1.0, 0.0)


def _stacked(*numbers):
    return jnp.stack(numbers)


def _differences(mine: list, theirs: list) -> list:
    return [a - b for a, b in zip(mine, theirs, strict=True)]


def _with_held(jar, place, cone, held_friction):
    return with_held(jar, place, cone, held_friction[:, None])
