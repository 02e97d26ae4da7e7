"""Rings of one finger against another finger's centre line, two rings at a time.

Of two fingers only the first one's rings look.  On a CPU a lane is a finger, and the second
finger's lane looks with the next ring of the first one: no lane waits.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import friction_memory
from codesign_jax.engines.structured.kernel.memory import any_of, anywhere, choose, loop, zeros
from codesign_jax.engines.structured.kernel.pairing import FingerPairing
from codesign_jax.engines.structured.kernel.rows import Search
from codesign_jax.engines.structured.kernel.shared_memory import where
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

SAFE = 1e-4
"""Distance that a ring keeps from being near [m]: above any rounding of places, and above what
`self_collision.SURELY` leaves open of a distance below a metre."""


class RingPairs:
    """The search of one pairing's contacts.

    Attributes:
      search: The `SelfCollision` that begins it; `fingers`, `contacts`: as there.
      slot_row: The pairing's row of slots, a scalar.
      first: Lanes of fingers whose rings look, bool, shape (lane,).
      second: Lanes of the fingers that they look at.
    """

    def __init__(self, search: Any, slot_row: jax.Array, pairing: FingerPairing, first: jax.Array):
        """Begins the search of a row of slots; search: the `SelfCollision` that begins it."""
        fingers = search.fingers
        self.search = search
        self.fingers = fingers
        self.contacts = search.contacts
        self.slot_row = slot_row
        self.pairing = pairing
        self.first = first
        number = jnp.where(first, jnp.int32(1), jnp.int32(0))
        self.second = pairing.swap(lanes([number], (), wide=True)).lane > 0
        mine = fingers.read(Search.fastest)
        reach = fingers.reach(fingers.largest())
        self.their_reach = self._second_finger(reach)
        their_speed = self._second_finger(mine)
        self.speed = lanewise(jnp.add, self.mixed(mine, mine), their_speed)
        most = lanewise(jnp.maximum, reach, fingers.reach(fingers.ring(0)))
        reaches = self.mixed(most, most), self.their_reach
        gap = lanes([search.gap(self.speed)], (), wide=True)
        self.far = lanewise(lambda a, b, c: a + b + c + SAFE, *reaches, gap)

    def mixed(self, mine: Any, partner: Any) -> Any:
        """Trees of lanes: a lane's own on the lanes `first`, its partner's on all others."""
        return where(self.first, mine, self.pairing.swap(partner))

    def _second_finger(self, value: Any) -> Any:
        """A tree of lanes of each finger, as the second finger of each pair has it."""
        return where(self.first, self.pairing.swap(value), value)

    def find(self) -> None:
        """Gives a slot to each contact."""
        search = self.search
        fingers = self.fingers

        def copy(i: Any, nothing: list) -> list:
            fingers.write(Search.other, self._second_finger(fingers.read(Search.line, i)), i)
            return nothing

        size = search.block.size
        loop(search.layout.links + 1, copy, [], size)
        start = zeros((3,), search.like), zeros((), search.like)
        loop(-(-fingers.count // 2), lambda k, seen: self._look(2 * k, *seen), start, size)

    def _look(self, item: jax.Array, seen: Lanes, free: Lanes) -> tuple[Lanes, Lanes]:
        """Looks with a ring and the one behind it, unless both are surely far.

        A ring's distance from a line changes by no more than its centre moves, so that most rings
        of fingers that are apart need no look.

        Args:
          item: The first ring.
          seen: Centres of the rings that have looked last.
          free: How far from them nothing is near [m].

        Returns:
          `seen` and `free` for the next rings.
        """
        search = self.search
        fingers = self.fingers
        following = jnp.minimum(item + 1, fingers.count - 1)
        looks = self.first | (self.second & (item + 1 < fingers.count))
        first = fingers.body(item)
        second = fingers.body(following)
        centre = self.mixed(first[3], second[3])
        away = lanewise(moved_square, centre, seen).lane
        sure = (free.lane > 0) & (away < free.lane * free.lane)

        def look() -> tuple[Lanes, Lanes]:
            square = self._narrow((item, following), first, second, centre, looks)
            return centre, lanewise(left_free, square, self.far)

        return choose(anywhere(looks & ~sure), look, (seen, free), search.block.size)

    def _narrow(
        self, items: tuple, first: tuple, second: tuple, centre: Lanes, looks: jax.Array
    ) -> Lanes:
        """Enters contacts of two rings; returns the squared distances of their centres.

        Args:
          items: The rings that the lanes `first` and `second` look with.
          first: The first ring's body, `second`: the other's, see `FingerShapes.body`.
          centre: The lanes' ring's centre; `looks`: lanes that have a ring.
        """
        search = self.search
        fingers = self.fingers
        reach = self.mixed(fingers.reach(first[1]), fingers.reach(second[1]))
        square, other, t = search.nearest(Search.other, centre)
        near = looks & search.near(square, reach, self.their_reach, self.speed)

        def enter() -> None:
            numbers = self.mixed(first[1], second[1])
            frame = self.mixed(first[2], second[2])
            segment, moves = self._segment(other, near)
            faced = fingers.facing(numbers, frame, centre, segment, other, t)

            def add(close: jax.Array) -> None:
                place = search.place(numbers, frame, centre, faced)
                mine = self.mixed(fingers.moves(first[0]), fingers.moves(second[0]))
                held = friction_memory.held_by_pairing(search.step, self.contacts, self.slot_row)
                held = self.mixed(held, held)
                cone = self.contacts.cone_of_row(self.slot_row)
                link = jnp.where(self.first, first[0], second[0])
                candidate = search.candidate(place, cone, link, mine, moves, held)
                self._enter(candidate, other, close, items)

            search.if_close(near, faced, self.speed, add)

        any_of(near, enter)
        return lanes([square], (), wide=True)

    def _segment(self, row: jax.Array, near: jax.Array) -> Any:
        """Segments of the second finger and their links' moves on both lanes of the pairs."""
        search = self.search
        fingers = self.fingers
        theirs = search.of_rows(fingers.segment, row, near & self.first, self.pairing)
        same = search.of_rows(fingers.segment, row, near & self.second, None)
        return where(self.first, theirs, same)

    def _enter(self, contact: dict[str, Lanes], other: Any, close: jax.Array, items: tuple) -> None:
        """Gives contacts a slot, the first ring's before the second's.

        Args:
          contact: See `SelfCollision.candidate`.
          other: The second finger's links.
          items: The rings that the lanes `first` and `second` have looked with.
        """
        enter = partial(self.search.enter, self.slot_row)
        enter(close & self.first, self.first, contact, other, items[0])
        enter(close & self.second, self.first, contact, other, items[1], self.second)


def moved_square(centre: jax.Array, before: jax.Array) -> jax.Array:
    """Square of the distance between two places [m^2]."""
    away = centre - before
    return dot(away, away)


def left_free(square: jax.Array, far: jax.Array) -> jax.Array:
    """How much more than `far` a squared distance is [m]."""
    return jnp.sqrt(square) - far
