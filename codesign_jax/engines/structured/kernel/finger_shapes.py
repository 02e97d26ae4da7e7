"""Where the fingers of a step are: links, rings, spheres, centre lines and how rings face these.

`self_collision`, which finds the hand's contacts with itself, reads it, and so does their reverse
pass, `contacts_vjp`.
"""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.kinds import above, facing_line
from codesign_jax.engines.structured.kernel.memory import BoundTable, each, loop, zeros
from codesign_jax.engines.structured.kernel.pairing import FingerPairing
from codesign_jax.engines.structured.kernel.rows import Field, Hand, Search, Side
from codesign_jax.engines.structured.kernel.sides import Sides
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanes import apply_columns, cross, dot
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import touch
from codesign_jax.engines.structured.laws.rings import Facing, Ring
from codesign_jax.engines.structured.laws.touch import ring_centre
from codesign_jax.model.layout import RING_TIP, ring_places

APART_LINKS = 3.0
"""Least distance along a finger at which it touches itself [links]: the rings of neighbours overlap
as their joint bends [ours]."""
APART_HEIGHTS = 1.8
"""The same in heights of the largest section [ours]: bent by half a turn about its own lower edge a
finger's centre line is pi/2 = 1.57 heights long, and what is nearer along it does not meet."""
SURFACE_RADIUS = 4.0
"""Bound of the distance of a link's surface from its joint, in half heights of its first ring, for
the speed with which it moves as the link turns [ours]."""


class FingerShapes:
    """The fingers of a step: fields of `rows.Search`, and those of `rows.Side` of links.

    Attributes:
      step: The step's memory; `layout`, `block`, `scratch`, `like`: as there.
      sides: The links and the palm, as sides of contacts.
      palm_vel: The palm's spatial velocity, shape (6, 1, world).
      count: Rings, or spheres, of a finger.
    """

    def __init__(self, step: StepMemory, sides: Sides, palm_vel: Lanes):
        """Prepares the fingers' memory; attributes as above."""
        self.step = step
        self.sides = sides
        self.palm_vel = palm_vel
        self.layout = step.layout
        self.scratch = step.scratch
        self.block = step.block
        self.like = step.like
        self.count = self.layout.links * self.layout.rings_per_link

    # Fields, of the lanes' own fingers and of others

    def write(self, name: Field, value: Lanes, item: Any = 0) -> None:
        """Stores a field of `rows.Search` of the lanes' own fingers."""
        self.scratch.write(name, value, item)

    def read(self, name: Field, item: Any = 0, lane: jax.Array | None = None) -> Lanes:
        """A field of `rows.Search`, of the lanes' own fingers or those of other lanes.

        Args:
          name: The field.
          item: Its item, a scalar, or of each lane, int32 of shape (lane,).
          lane: Lanes of the fingers that have it, int32 of shape (lane,); None for the lanes' own.
        """
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
        """Numbers of rings or spheres, see `StepMemory.ring`; arguments as `read`."""
        if lane is None and not jnp.ndim(item):
            return self.step.ring(item)
        return self.step.ring(*self._places(item, lane))

    def ring_at(self, row: Any) -> Any:
        """The ring whose section a finger has where a segment of its centre line begins.

        All sections are alike but for a tapered finger's: there it is the ring before that place.

        Args:
          row: The segment's link, 0 for the palm's half link, a scalar or int32 of shape (lane,).
        """
        if not self.layout.tapered:
            return self.count - 1
        first = (jnp.asarray(row) - 1) * self.layout.rings_per_link - 1
        return jnp.maximum(first, 0)

    def largest(self) -> Lanes:
        """Numbers of the largest ring of a finger: of its last one, or of either end's."""
        tip = self.ring(self.count - 1)
        return lanewise(jnp.maximum, tip, self.ring(0)) if self.layout.tapered else tip

    def reach(self, numbers: Lanes) -> Lanes:
        """How far rings of these numbers reach from their centres [m], (...)."""
        return lanewise(touch.ring_reach, numbers)

    # Links and centre lines, stored from the palm to the tips

    def start(self, link_acc: Lanes, vel: Lanes, frame: Lanes, base: Lanes) -> None:
        """Stores what belongs to the palm, before `link` stores the links.

        Args:
          link_acc: Spatial acceleration of the fingers' bases without velocity terms, (6, ...).
          vel: Their spatial velocity, (6, ...).
          frame: Their frames as columns, (3, 3, ...).
          base: Their origins from the object's centre [m], (3, ...).
        """
        self.write(Search.fastest, zeros((), self.like))
        self._side(0, link_acc, vel, frame, base)
        self.write(Search.end, lanewise(above, base, frame, frame, self.ring(self.ring_at(0))), 0)

    def link(self, i: Any, link_acc: Lanes, vel: Lanes, frame: Lanes, origin: Lanes) -> None:
        """Stores where a link is; i: its number, the rest as in `start`, of the link."""
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

    # Links, rings and segments, read

    def side_of(self, name: Field, row: Any, lane: jax.Array | None = None) -> Lanes:
        """A field of `rows.Side` of bodies; row: 0 for the palm; the rest as in `read`."""
        if lane is None and not jnp.ndim(row):
            return self.sides.table.read(name, row)
        return self._gathered(self.sides.table, name, row, lane)

    def moves(self, row: Any, lane: jax.Array | None = None) -> list[Lanes]:
        """Spatial accelerations and velocities of bodies, (6, ...) each; arguments as `side_of`."""
        return [self.side_of(name, row, lane) for name in (Side.link_acc, Side.vel)]

    def end_lines(self) -> None:
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
        """What is at a ring.

        Args:
          item: Its number along the finger, a scalar, or of each lane.

        Returns:
          The row of its link in the tables of sides, 1 for the first one; the ring's numbers; the
          link's frame as columns, (3, 3, ...); the ring's centre from the object's [m], (3, ...).
        """
        row = jax.lax.div(item, jnp.full_like(item, self.layout.rings_per_link)) + 1
        frame = self.read(Search.frame, row)
        numbers = self.ring(item)
        return (
            row,
            numbers,
            frame,
            lanewise(ring_centre, self.read(Search.joint, row), frame, numbers),
        )

    def segment(self, row: Any, lane: jax.Array | None = None) -> tuple[tuple, list[Lanes]]:
        """What rings face of segments of centre lines, and how these move.

        Args:
          row: Their links, 0 for the palm's half link; `lane`: as in `read`.

        Returns:
          Their two ends [m], (3, ...) each, frames of their links and both neighbours as columns,
          and the numbers of the rings whose sections they have; `moves` of their links.
        """
        frames = tuple(self.read(Search.frame, r, lane) for r in neighbours(row, self.layout.links))
        ends = self.read(Search.end, row, lane), self.read(Search.end, row + 1, lane)
        return (ends, frames, self.ring(self.ring_at(row + 1), lane)), self.moves(row, lane)

    def facing(
        self, numbers: Lanes, frame: Lanes, centre: Lanes, segment: tuple, row: jax.Array, t: Any
    ) -> Facing:
        """How the lanes' rings face segments; `rings.facing_line`.

        Args:
          numbers: The rings' numbers; `frame`: their links' frames as columns, (3, 3, ...);
            `centre`: their centres [m], (3, ...).
          segment: The segments' ends, frames and sections, see `segment`.
          row: Their links, int32 of shape (lane,).
          t: Where along them the nearest places are, 0 to 1, shape (lane,).
        """
        last = lanes(
            [jnp.where(row == self.layout.links, self.like + 1.0, self.like)], (), wide=True
        )
        where = lanes([t], (), wide=True)
        return lanewise(facing_line, numbers, frame, centre, (*segment, last), where)

    # Of a finger that touches itself

    def _end(self, item: Any) -> jax.Array:
        """The last place along a finger [links] that one of its rings touches."""
        tip = self.ring(self.count - 1)
        return self._along(item) - lanewise(arc, tip, self.largest()).lane

    def rows_back(self, item: Any) -> jax.Array:
        """Segments that begin before the last place of any lane's `_end`, or more, a scalar."""
        return jnp.max((self._end(item) + 1.5).astype(jnp.int32))

    def last_of(self, item: Any, row: Any) -> jax.Array:
        """The last place on a segment, 0 to 1, that rings of the same finger touch, shape (lane,).

        Args:
          item: The rings, a scalar or of each lane.
          row: The segments' links, 0 for the palm's half link; likewise.
        """
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

    # As a grasp begins

    def deepest(self, contacts: ContactList) -> Lanes:
        """The largest overlap of fingers with one another and with the palm [m], or zero.

        Contacts are those that were found. See `engines.depths.depth_between` and `depth_in_palm`.
        """
        depth = zeros((), self.like)
        if self.layout.scene.effects.finger_palm:
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


def neighbours(row: jax.Array, links: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The link before each of some links, itself, and the next one; the ends are their own."""
    return jnp.maximum(row - 1, 0), row, jnp.minimum(row + 1, links)


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
