"""Finds where fingers touch each other, themselves and the palm: rings or spheres.

A ring meets the nearest place of another finger's centre line, or of its own on the way back to the
palm that is `arc` away along the finger.  Of two fingers the first one's rings look: with both
fingers' there would be twice as many contacts, which is what a step's time goes to.  The lanes of a
team, see `shared_memory`, look with a ring each.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import friction_memory
from codesign_jax.engines.structured.kernel.contact_list import ContactList, fields_of, with_held
from codesign_jax.engines.structured.kernel.kinds import (
    above,
    balls,
    facing_line,
    palm_distance,
    place_of,
    with_axis,
)
from codesign_jax.engines.structured.kernel.memory import BoundTable, any_of, loop, solid, zeros
from codesign_jax.engines.structured.kernel.pairing import FingerPairing
from codesign_jax.engines.structured.kernel.ring_pairs import RingPairs
from codesign_jax.engines.structured.kernel.rows import (
    Contact,
    Field,
    Hand,
    Remembered,
    Search,
    Side,
    Slot,
    WorldOptions,
)
from codesign_jax.engines.structured.kernel.sides import Sides
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanes import apply_columns, cross, dot
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, touch
from codesign_jax.engines.structured.laws.rings import Facing, Place, Ring
from codesign_jax.engines.structured.laws.touch import ring_centre
from codesign_jax.model.layout import (
    RING_TIP,
    beyond_base,
    first_on_palm,
    ring_places,
    touches_itself,
)

SURELY = 1.0 - 1e-4
"""At a joint two segments have one nearest place, which is the first one's, whatever is rounded."""
APART_LINKS = 3.0
"""Least distance along a finger at which it touches itself [links]: the rings of neighbours overlap
as their joint bends [ours]."""
APART_HEIGHTS = 1.8
"""The same in heights of the largest section [ours]: bent by half a turn about its own lower edge a
finger's centre line is pi/2 = 1.57 heights long, and what is nearer along it does not meet."""
SURFACE_RADIUS = 4.0
"""Bound of the distance of a link's surface from its joint, in half heights of its first ring, for
the speed with which it moves as the link turns [ours]."""


class SelfCollision:
    """Gives a slot to each contact of fingers with one another, with themselves and the palm."""

    def __init__(
        self, step: StepMemory, self_contacts: ContactList, sides: Sides, bodies: dict[str, Any]
    ):
        self.step = step
        self.contacts = self_contacts
        self.sides = sides
        self.layout = step.layout
        self.scratch = step.scratch
        self.block = step.block
        self.like = step.like
        self.count = self.layout.links * self.layout.rings_per_link
        self.palm_vel = bodies["vel"]
        self.hull = step.layout.scene.effects.surface == "hull"
        self.palm = None
        if step.layout.scene.effects.finger_palm:
            self.palm = bodies["place"], bodies["frame"], step.constant(WorldOptions.palm_disc)

    # Where fingers are

    def write(self, name: Field, value: Lanes, item: Any = 0) -> None:
        """Stores a field of `rows.Search` of the lanes' own fingers."""
        self.scratch.write(name, value, item)

    def read(self, name: Field, item: Any = 0, lane: jax.Array | None = None) -> Lanes:
        """Where the lanes' own fingers are, or those of other lanes; items may be of lanes."""
        if lane is None and not jnp.ndim(item):
            return self.scratch.read(name, item)
        return self._gathered(self.scratch, name, item, lane)

    def _gathered(self, table: BoundTable, name: Field, item: Any, lane: Any) -> Lanes:
        return table.gather(name, *self._places(item, lane))

    def _places(self, item: Any, lane: Any) -> tuple[jax.Array, jax.Array]:
        """Items of each lane, and lanes that have them; None for the lanes' own."""
        item = jnp.zeros_like(self.block.column) + item
        return item, self.block.column if lane is None else lane

    def ring(self, item: Any, lane: jax.Array | None = None) -> Lanes:
        if lane is None and not jnp.ndim(item):
            return self.step.ring(item)
        return self.step.ring(*self._places(item, lane))

    def ring_at(self, row: Any) -> Any:
        """The ring whose section a finger has where a segment of its centre line begins.

        All sections are alike but for a tapered finger's: there it is the ring before that place.
        """
        if not self.layout.tapered:
            return self.count - 1
        first = (jnp.asarray(row) - 1) * self.layout.rings_per_link - 1
        return jnp.maximum(first, 0)

    def largest(self) -> Lanes:
        """Numbers of the largest ring of a finger: of its last one, or of either end's."""
        tip = self.ring(self.count - 1)
        return lanewise(jnp.maximum, tip, self.ring(0)) if self.layout.tapered else tip

    def start(self, link_acc: Lanes, vel: Lanes, frame: Lanes, base: Lanes) -> None:
        """Empties the slots; stores what belongs to the palm."""
        for row in range(self.contacts.layout.slots.rows):
            self.contacts.clear(row)
        friction_memory.clear(self.step)
        self.write(Search.fastest, zeros((), self.like))
        self._side(0, link_acc, vel, frame, base)
        self.write(Search.end, lanewise(above, base, frame, frame, self.ring(self.ring_at(0))), 0)

    def link(self, i: Any, link_acc: Lanes, vel: Lanes, frame: Lanes, origin: Lanes) -> None:
        before = self.read(Search.frame, i)
        self._side(i + 1, link_acc, vel, frame, origin)
        numbers = self.ring(self.ring_at(i + 1))
        self.write(Search.end, lanewise(above, origin, before, frame, numbers), i + 1)
        size = self.read(Search.fastest), vel, self.palm_vel, origin, self.ring(0)
        self.write(Search.fastest, lanewise(_faster, *size))

    def _side(self, row: Any, link_acc: Lanes, vel: Lanes, frame: Lanes, joint: Lanes) -> None:
        self.sides.put(Side.link_acc, link_acc, row)
        self.sides.put(Side.vel, vel, row)
        self.write(Search.frame, frame, row)
        self.write(Search.joint, joint, row)

    def _copy_line(self, pairing: FingerPairing, i: Any) -> None:
        """Copies a segment of the other finger's centre line."""
        self.write(Search.other, pairing.swap(self.read(Search.line, i)), i)

    def side_of(self, name: Field, row: Any, lane: jax.Array | None = None) -> Lanes:
        """A field of `rows.Side` of bodies, of the lanes' own fingers or those of other lanes."""
        if lane is None and not jnp.ndim(row):
            return self.sides.table.read(name, row)
        return self._gathered(self.sides.table, name, row, lane)

    def _lines(self) -> None:
        """Ends the centre lines at the tips' rings; stores their segments."""
        tip = self.ring(self.count - 1)
        place = (
            self.read(Search.joint, self.layout.links),
            self.read(Search.frame, self.layout.links),
        )
        self.write(Search.end, lanewise(ring_centre, *place, tip), self.layout.links + 1)

        def segment(row: Any) -> None:
            ends = self.read(Search.end, row), self.read(Search.end, row + 1)
            self.write(Search.line, lanewise(_line, *ends), row)

        each(self.layout.links + 1, segment)

    def body(self, item: Any) -> tuple[Any, Lanes, Lanes, Lanes]:
        """A ring's link, its numbers, the link's frame and the ring's centre."""
        row = jax.lax.div(item, jnp.full_like(item, self.layout.rings_per_link)) + 1
        frame = self.read(Search.frame, row)
        numbers = self.ring(item)
        return (
            row,
            numbers,
            frame,
            lanewise(ring_centre, self.read(Search.joint, row), frame, numbers),
        )

    def find(self) -> None:
        scene = self.layout.scene
        if self.hull:
            self._lines()
        if self.palm is not None:
            self._each_ring(first_on_palm(self.layout.links) - 1, self._on_palm)
        if touches_itself(scene):
            self._each_ring(0, self._on_itself)
        if not scene.effects.finger_finger:
            return

        def pairing(row: jax.Array, x: jax.Array) -> jax.Array:
            pairing = self.contacts.pairing(row)
            other = jax.lax.div(pairing.lane, jnp.int32(self.layout.block))
            owner = (self.block.finger < other) & (other < self.layout.num_fingers)
            if self.hull and not self.contacts.layout.slots.gathers:
                RingPairs(self, row, pairing, owner).find()
                return x
            if self.hull:
                # The segments of the other finger's centre line.
                each(self.layout.links + 1, partial(self._copy_line, pairing))
                size = lanewise(_stacked, self.reach(self.largest()), self.read(Search.fastest))
                self.write(Search.other_size, pairing.swap(size))
            search = self._on_finger if self.hull else self._on_spheres
            self._each_ring(0, lambda *ring: search(row, pairing, owner, *ring))
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
        count = self.count - first

        def ring(k: Any) -> None:
            item, mine = self.block.dealt(count, k)
            search(item + first, self.like > -1 if mine is None else mine)

        each(self.block.rounds(count), ring)

    # As a grasp begins

    def deepest(self, contacts: ContactList) -> Lanes:
        """The largest overlap of fingers with one another and with the palm [m], or zero.

        Contacts are those that were found. See `engines.depths.depth_between` and `depth_in_palm`.
        """
        depth = zeros((), self.like)
        if self.palm is not None:
            depth = contacts.deepest_in_palm(depth)
        if not self.layout.scene.effects.finger_finger:
            return depth

        def pairing(number: Any, depth: Lanes) -> Lanes:
            partner = FingerPairing(self.block, number + 1, self.like.dtype, with_itself=False)
            return self._deepest_of_pair(partner, depth)

        return loop(self.block.fingers - 1, pairing, depth, self.block.size)

    def _deepest_of_pair(self, pairing: FingerPairing, depth: Lanes) -> Lanes:
        """The larger of a depth and those of the spheres around two fingers' links."""
        fingers = self.layout.num_fingers
        other = jax.lax.div(pairing.lane, jnp.int32(self.layout.block))
        both = lanes([(self.block.finger < fingers) & (other < fingers)], (), wide=True)

        def with_other(j: Any, depth: Lanes) -> Lanes:
            theirs = pairing.swap(self._sphere(j))
            deeper = lambda i, d: lanewise(_deeper, d, both, self._sphere(i), theirs)  # noqa: E731
            return loop(self.layout.links, deeper, depth, self.block.size)

        return loop(self.layout.links, with_other, depth, self.block.size)

    def _sphere(self, i: Any) -> Lanes:
        """Middle and radius [m] of the sphere around a link, as high as its section, (4,)."""
        where = self.read(Search.joint, i + 1), self.read(Search.frame, i + 1)
        centre = self.step.hand.read(Hand.centre, i)
        if self.layout.grows:
            centre = lanewise(_raised, centre, self.step.growth_of(i * self.layout.rings_per_link))
        return lanewise(_sphere, *where, centre)

    # Contacts

    def reach(self, numbers: Lanes) -> Lanes:
        """How far a ring reaches from its centre [m]."""
        return lanewise(touch.ring_reach, numbers)

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
          row: The link.
          mine: Its acceleration and velocity, see `moves`; `theirs`: those of the other body.
          held: What the contact holds of friction, (3,), or nothing.
        """
        place = lanewise(with_axis, place)
        acc, vel = lanewise(_differences, mine, theirs)
        place, jar = self.contacts.begin(place, cone, acc, vel)
        for g in held:
            jar = lanewise(_with_held, jar, place, cone, g)
        return fields_of(place, jar) | {Slot.side: self._number(row)}

    def moves(self, row: Any, lane: jax.Array | None = None) -> list[Lanes]:
        """Accelerations and velocities of links; arguments as `read`."""
        return [self.side_of(name, row, lane) for name in (Side.link_acc, Side.vel)]

    def of_rows(
        self, read: Callable, row: jax.Array, which: jax.Array, pairing: FingerPairing | None
    ) -> Any:
        """read(row of each lane, lane of the finger that has it), a tree of lanes.

        Vectors gather number by number: there the rows of the lanes `which`, of which there are
        few, are read one after the other. Other lanes get what one of these has.

        Args:
          row: int32, shape (lane,).
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
        row, numbers, frame, centre = self.body(item)

        def look(point: Lanes) -> tuple[Lanes, Lanes]:
            return lanewise(palm_distance, point, self.palm)

        field = look(centre)
        place = lanes([self.like + jnp.asarray(row, self.like.dtype)], (), wide=True)
        sizes = self.step.hand.read(Hand.offset, 0), self.ring(0)
        mine = mine & (lanewise(free_of_palm, place, numbers, *sizes).lane > 0)
        near = self._near_palm(field[0], numbers)

        def add(place: Place) -> None:
            palm = jnp.zeros_like(jnp.asarray(row))
            cone = self.contacts.cone_of_row(0)
            theirs = self.moves(palm)
            candidate = self.candidate(place, cone, row, self.moves(row), theirs, [])
            self._alone(candidate, palm, item, mine)

        def enter() -> None:
            faced = touch.facing(numbers, frame, centre, field, look, apply=lanewise)

            def add_ring(_: jax.Array) -> None:
                add(lanewise(touch.ring_place, numbers, frame, centre, faced))

            self.if_close(mine, faced, self.read(Search.fastest), add_ring)

        def enter_ball() -> None:
            add(lanewise(touch.ball_on_field, numbers, centre, *field))

        any_of(mine & near, enter if self.hull else enter_ball)

    def _near_palm(self, distance: Lanes, numbers: Lanes) -> jax.Array:
        size = lanewise(jnp.maximum, distance, zeros((), self.like)).lane
        none = zeros((), self.like)
        return self.near(size * size, self.reach(numbers), none, self.read(Search.fastest))

    def _on_itself(self, item: Any, mine: jax.Array) -> None:
        row, numbers, frame, centre = self.body(item)
        square, other, t = self.nearest(Search.line, centre, item)
        theirs = self.largest() if self.layout.tapered else numbers
        reaches = self.reach(numbers), self.reach(theirs)
        near = mine & self.near(square, *reaches, self.read(Search.fastest))

        def enter() -> None:
            segment, moves = self.of_rows(self.segment, other, near, None)
            faced = self.facing(numbers, frame, centre, segment, other, t)

            def add(close: jax.Array) -> None:
                place = self.place(numbers, frame, centre, faced)
                held = friction_memory.held_by_pairing(self.step, self.contacts, 0)
                candidate = self.candidate(
                    place, self.contacts.cone_of_row(1), row, self.moves(row), moves, held
                )
                self._alone(candidate, other, item, close)

            self.if_close(near, faced, self.read(Search.fastest), add)

        any_of(near, enter)

    def _end(self, item: Any) -> jax.Array:
        """The last place along a finger [links] that one of its rings touches."""
        tip = self.ring(self.count - 1)
        return self._along(item) - lanewise(arc, tip, self.largest()).lane

    def _rows_back(self, item: Any) -> jax.Array:
        """Segments that begin before the last place of any lane's `_end`, or more, a scalar."""
        return jnp.max((self._end(item) + 1.5).astype(jnp.int32))

    def last_of(self, item: Any, row: Any) -> jax.Array:
        """The last place on a segment, 0 to 1, that rings of the same finger touch."""
        start = self.like + jnp.asarray(row).astype(self.like.dtype) - 0.5
        length = jnp.where(jnp.equal(row, self.layout.links), self.like + RING_TIP, 1.0)
        return jnp.minimum((self._end(item) - start) / length, 1.0)

    def _along(self, item: Any) -> jax.Array:
        """Place of a ring along the finger, in links from its base."""
        item = jnp.zeros_like(self.block.column) + item
        k = jnp.full_like(item, self.layout.rings_per_link)
        link = jax.lax.div(item, k)
        number = jax.lax.rem(item, k)
        places = ring_places(self.layout.links, self.layout.rings_per_link)
        part = (number.astype(self.like.dtype) + 0.5) / self.layout.rings_per_link
        last = jnp.where(number == k - 1, places[-1, -1], 0.5 * part)
        along = jnp.where(link == self.layout.links - 1, last, part)
        return link.astype(self.like.dtype) + (0.5 + along)

    def _on_finger(
        self, row: Any, pairing: FingerPairing, owner: jax.Array, item: Any, mine: Any
    ) -> None:
        link, numbers, frame, centre = self.body(item)
        square, other, t = self.nearest(Search.other, centre)
        theirs = self.read(Search.other_size)
        speed = lanewise(jnp.add, self.read(Search.fastest), theirs[1])
        near = owner & mine & self.near(square, self.reach(numbers), theirs[0], speed)

        def enter() -> None:
            segment, moves = self.of_rows(self.segment, other, near, pairing)
            faced = self.facing(numbers, frame, centre, segment, other, t)

            def add(close: jax.Array) -> None:
                place = self.place(numbers, frame, centre, faced)
                held = friction_memory.held_by_pairing(self.step, self.contacts, row)
                candidate = self.candidate(
                    place, self.contacts.cone_of_row(row), link, self.moves(link), moves, held
                )
                self.enter(row, close, owner, candidate, other, item)

            self.if_close(near, faced, speed, add)

        any_of(near, enter)

    def enter(
        self,
        row: Any,
        near: jax.Array,
        owner: jax.Array,
        contact: dict[str, Lanes],
        other: Any,
        item: Any,
        second: jax.Array | None = None,
    ) -> None:
        """Gives contacts of two fingers a slot.

        Args:
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
        any_of(which, lambda: self.contacts.enter(row, which, finder, *fields, alike))

    def nearest(self, name: Field, centre: Lanes, itself: Any = None) -> tuple:
        """The nearest place of a centre line: squared distance, segment, and where along it.

        Args:
          name: `Search.line`, the finger's own, or `Search.other`.
          itself: The ring on the finger's own line.
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
            end = self.like + 1.0 if itself is None else self.last_of(itself, row)
            place, end = (lanes([v], (), wide=True) for v in (number, end))
            return lanewise(compare, self.read(name, row), centre, best, place, end)

        best = lanes([self.like + 1.0, self.like, self.like], (3,), wide=True)
        first = int(itself is not None)  # a finger's half link at the palm is the palm's
        count: Any = last + 1 - first
        if itself is not None and not self.contacts.layout.slots.gathers:
            count = jnp.clip(self._rows_back(itself), 0, count)
        best = loop(count, lambda k, b: nearer(k + first, b), best, self.block.size)
        square, number, t = (best[k].lane for k in range(3))
        return square, number.astype(jnp.int32), t

    def segment(self, row: Any, lane: jax.Array | None = None) -> tuple[tuple, list[Lanes]]:
        """Segments' ends, frames and sections, and their links' `moves`; arguments as `read`."""
        frames = tuple(self.read(Search.frame, r, lane) for r in neighbours(row, self.layout.links))
        ends = self.read(Search.end, row, lane), self.read(Search.end, row + 1, lane)
        return (ends, frames, self.ring(self.ring_at(row + 1), lane)), self.moves(row, lane)

    def facing(
        self, numbers: Lanes, frame: Lanes, centre: Lanes, segment: tuple, row: jax.Array, t: Any
    ) -> Facing:
        """How the lanes' rings face segments; `rings.facing_line`.

        Args:
          segment: Their ends, frames and sections, see `segment`.
          row: Their links.
        """
        last = lanes(
            [jnp.where(row == self.layout.links, self.like + 1.0, self.like)], (), wide=True
        )
        where = lanes([t], (), wide=True)
        return lanewise(facing_line, numbers, frame, centre, (*segment, last), where)

    def place(self, numbers: Lanes, frame: Lanes, centre: Lanes, facing: Facing) -> Place:
        """Contacts of rings with what they face; `rings.place`."""
        return lanewise(place_of, numbers, frame, centre, facing)

    # Spheres

    def _on_spheres(
        self, row: Any, pairing: FingerPairing, owner: jax.Array, item: Any, mine: Any
    ) -> None:
        """A sphere of the finger that comes first, with all of the other one's."""
        link, numbers, _, centre = self.body(item)
        apart = self.layout.rings_per_link

        def with_other(j: Any) -> None:
            theirs = pairing.swap(self.body(j)[1:])
            place = lanewise(balls, numbers, centre, theirs[0], theirs[2])
            near = owner & mine & (place.gap.lane < 0)

            def enter() -> None:
                other = jax.lax.div(j, jnp.full_like(j, apart)) + 1
                moves = pairing.swap(self.moves(other))
                candidate = self.candidate(
                    place, self.contacts.cone_of_row(row), link, self.moves(link), moves, []
                )
                number = item + self.count * j
                self.enter(row, near, owner, candidate, other, number)

            any_of(near, enter)

        each(self.count, with_other)


def neighbours(row: jax.Array, links: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The link before each of some links, itself, and the next one; the ends are their own."""
    return jnp.maximum(row - 1, 0), row, jnp.minimum(row + 1, links)


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


def arc(tip, largest):
    """Least distance along a finger at which it touches itself, in links."""
    heights = APART_HEIGHTS * 2.0 * Ring.of(largest).half[2]
    link = Ring.of(tip).half[0] / RING_TIP
    return jnp.maximum(APART_LINKS, heights / link)


def _sphere(origin, frame, centre):
    return jnp.concatenate([origin + apply_columns(frame, centre), centre[2:]])


def _raised(centre, factors):
    return jnp.stack([centre[0], centre[1], factors[0] * centre[2]])


def _deeper(depth, both, mine, theirs):
    away = mine[:3] - theirs[:3]
    overlap = mine[3] + theirs[3] - jnp.sqrt(dot(away, away))
    return jnp.maximum(depth, jnp.where(both, overlap, 0.0))


def _line(start, end):
    along = end - start
    return jnp.concatenate([start, along, (1.0 / dot(along, along))[None]])


def _faster(most, vel, palm, origin, numbers):
    """Bound of the speed of a finger's surface relative to the palm [m/s]."""
    moving = vel - palm
    speed = moving[3:] + cross(moving[:3], origin)
    turning = jnp.sqrt(dot(moving[:3], moving[:3])) * SURFACE_RADIUS * numbers[5]
    return jnp.maximum(most, jnp.sqrt(dot(speed, speed)) + turning)


def _stacked(*numbers):
    return jnp.stack(numbers)


def _differences(mine: list, theirs: list) -> list:
    return [a - b for a, b in zip(mine, theirs, strict=True)]


def _with_held(jar, place, cone, held_friction):
    return with_held(jar, place, cone, held_friction[:, None])


def each(count: int, body: Callable[[Any], None]) -> None:
    """Runs body(item), which stores something, for all items."""

    def step(k: jax.Array, x: jax.Array) -> jax.Array:
        body(k)
        return x

    jax.lax.fori_loop(0, count, step, jnp.int32(0))
