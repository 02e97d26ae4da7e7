"""The reverse pass of a step through the contacts of fingers with each other and with the palm.

A contact's power is counted on the lane of its owner, which knows both sides; the other side's
cotangents go to its own lane by the swap that brought that side's numbers.  A contact with the palm
has one lane; what it leaves for the palm is kept as "palmbar".
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import grip_sweep, powers, skin
from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.memory import anywhere, choose, loop
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.powers import Place, RowSide
from codesign_jax.engines.structured.kernel.pull import only_on, plus, pull
from codesign_jax.engines.structured.kernel.slots import any_of
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import sections
from codesign_jax.model.layout import palm_ahead

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.sweep import Sweep

CONE, ON_PALM = "cone.finger_finger", "cone.finger_palm"


class PairSweep:
    """Leaves the cotangents of the links with contacts between fingers as "pairbar"."""

    def __init__(self, sweep: "Sweep", pairs: BoundPairs):
        """Takes a step's sweep and its contacts between fingers."""
        self.sweep, self.pairs, self.p, self.bars = sweep, pairs, sweep.p, sweep.bars
        self.like, self.lane = sweep.like, sweep.block.lane
        self.scratch, self.ref = sweep.p.scratch, sweep.step.scratch
        self.hand = partial(self.p.hand.gather, sweep.step.hand)

    def run(self) -> None:
        """Goes through all contacts."""

        def clear(i: jax.Array, x: jax.Array) -> jax.Array:
            for name in Place._fields:
                shape = self.scratch.groups[f"pairbar.{name}"][1]
                self.scratch.write(self.ref, f"pairbar.{name}", zeros(shape, self.like), i)
            return x

        jax.lax.fori_loop(0, self.p.links + 1, clear, jnp.int32(0))
        one = self._rows if self.pairs.set.skin else self._spheres
        on_palm = self._row_on_palm if self.pairs.set.skin else self._sphere_on_palm
        if self.pairs.set.palm:
            self._leave_palm(Place(*(self.sweep.none(n) for n in Place._fields)), first=True)

        def slot(item: Any, pairing: Pairing) -> None:
            row = self.pairs.read("row", item).lane.astype(jnp.int32)
            owner = self.pairs.read("owner", item).lane > 0.5
            live = owner & (self.pairs.read("gap", item).lane < 0)
            side = lanes([live], (), wide=True)
            if pairing.palm is not None:
                palm = pairing.palm.lane
                any_of(live & palm, lambda: on_palm(item, row, side))
                live = live & ~palm
            if self.p.scene.effects.finger_finger:
                any_of(live, lambda: one(item, pairing, row, side))

        self.pairs.do(slot)

    # The palm

    def _palm(self) -> tuple[Place, Lanes]:
        """The palm, and radius and half the thickness of its disc."""
        palm = self._body(jnp.zeros_like(self.lane))
        at = self.sweep.at
        palm = palm._replace(origin=at["place"], frame=at["frame"])
        return palm, self.sweep.step.constant("palm_disc")

    def _leave_palm(self, bars: Place, *, first: bool = False) -> None:
        """Adds to what the palm's place and motion get."""
        for name, value in bars._asdict().items():
            name = f"palmbar.{name}"
            if not first:
                value = plus(self.scratch.read(self.ref, name), value)
            self.scratch.write(self.ref, name, value)

    def _sphere_on_palm(self, item: Any, row: jax.Array, live: Lanes) -> None:
        """Adds the cotangents of a link's sphere and of the palm."""
        link, which = self._sphere(item)
        mine = self._body(row), *(self.hand(n, link, self.lane) for n in ("sphere", "radius"))
        args = mine, *self._palm(), self.sweep.step.constant(ON_PALM)
        run = partial(powers.sphere_on_palm, self.p.scene)
        found = only_on(live, pull(run, args, (which,), self.sweep.one))
        (place, *own), palm, disc, numbers = found
        self.bars.add({ON_PALM: numbers, "palm_disc": disc})
        self.bars.add(dict(zip(("sphere", "radius"), own, strict=True)), link, self.lane)
        self._leave_palm(palm)
        self._leave(place._asdict(), row)

    def _row_on_palm(self, item: Any, row: jax.Array, live: Lanes) -> None:
        """Adds the cotangents of a row of the hull and of the palm."""
        d = self.p.scene.discretization
        count = d.hull_rings * d.hull_points
        vertex, behind, ends = self._row(row, "vertex", count)
        mine = self._chain("origin", behind), *(side.frame for side in ends)
        palm, disc = self._palm()
        body = (palm.origin, palm.frame, disc)

        run, of_vertex = partial(powers.between_rows, self.p.scene), powers.palm_sums
        given, fixed, numbers = (mine, body), (), sections.SUMS
        empty: tuple = ((3,), (3, 3), (3, 3)), ((3,), (3, 3), (2,))
        if palm_ahead(self.p.scene):
            run, numbers = partial(powers.row_on_palm, self.p.scene), sections.AHEAD - 1
            of_vertex = partial(powers.ahead_sums, d.timestep)
            given = *given, (ends[0].vel, ends[1].vel, palm.vel)
            fixed, empty = self._half(item, vertex, count, given), (*empty, ((6,), (6,), (6,)))

        def sums_of(k: Any) -> Lanes:
            return lanewise(of_vertex, vertex(k)[1], *given, *fixed)

        side, cone = RowSide(palm.frame, *palm[2:]), self.sweep.step.constant(ON_PALM)
        args = self._sums(count, sums_of, numbers), ends, (side, side), cone
        bar, moves, (first, second), cone = only_on(live, pull(run, args, (), self.sweep.one))
        self.bars.add({ON_PALM: cone})

        def one(number: Any, place: Lanes) -> tuple[Lanes, tuple]:
            own, *bodies = only_on(live, pull(of_vertex, (place, *given), fixed, bar))
            return own, tuple(bodies)

        found = self._back(count, "vertex", vertex, live, sums_of, one, empty)
        (joint, *frames), (origin, frame, size), *vels = found
        self.bars.add({"palm_disc": size})
        moved = plus(first, second)
        if vels:
            *both, other = vels[0]
            moves = [m._replace(vel=plus(m.vel, v)) for m, v in zip(moves, both, strict=True)]
            moved = moved._replace(vel=plus(moved.vel, other))
        self._leave_palm(Place(origin, frame, *moved[1:]))
        self._leave_row(row, behind, joint, frames, moves)

    def _half(self, item: Any, vertex: Callable, count: int, given: tuple) -> tuple[Lanes, Lanes]:
        """Side of the half row of a slot, and the lowest gap of its vertices."""
        number = self.pairs.read("sphere", item).lane
        side = lanes([2.0 * number - 1.0], (), wide=True)
        gap = partial(powers.ahead_gap, self.p.scene.discretization.timestep)

        def lower(k: Any, lowest: Lanes) -> Lanes:
            return lanewise(jnp.minimum, lowest, lanewise(gap, vertex(k)[1], *given, side))

        far = lanes([self.like + sections.REACH], (), wide=True)
        return side, loop(count, lower, far, self.p.size)

    # Fingers

    def _spheres(self, item: Any, pairing: Pairing, row: jax.Array, live: Lanes) -> None:
        """Adds the cotangents of spheres of two links."""
        link, which = self._sphere(item)
        mine = self._body(row), *(self.hand(n, link, self.lane) for n in ("sphere", "radius"))
        theirs, other = pairing.swap((mine, which))
        args, fixed = (mine, theirs, self.sweep.step.constant(CONE)), ((which, other),)
        run = partial(powers.between_spheres, self.p.scene)
        own, swapped, numbers = only_on(live, pull(run, args, fixed, self.sweep.one))
        place, *own = plus(own, pairing.swap(swapped))
        self.bars.add({CONE: numbers})
        self.bars.add(dict(zip(("sphere", "radius"), own, strict=True)), link, self.lane)
        self._leave(place._asdict(), row)

    def _rows(self, item: Any, pairing: Pairing, row: jax.Array, live: Lanes) -> None:
        """Adds the cotangents of a row of the hull and of the other finger's row."""
        p, links = self.p, jnp.int32(self.p.links)
        count = skin.pair_points(p.scene)
        vertex, behind, ends = self._row(row, "pair_vertex", count)
        size = p.hand.read(self.sweep.step.hand, "section_box")
        mine = self._chain("origin", behind), *(side.frame for side in ends), size
        last = lanes([jnp.where(row == links - 1, self.like + 1.0, self.like)], (), wide=True)
        theirs, other_ends, last = pairing.swap((mine, ends, last))

        def sums_of(k: Any) -> Lanes:
            return lanewise(powers.vertex_sums, vertex(k)[1], mine, theirs, last)

        held = grip_sweep.at(self.sweep.step, pairing)
        args = self._sums(count, sums_of), ends, other_ends, self.sweep.step.constant(CONE), held
        run = partial(powers.between_rows, p.scene)
        bar, *moves, numbers, kept = only_on(live, pull(run, args, (), self.sweep.one))
        grip_sweep.leave(self.sweep.step, pairing, kept)
        self.bars.add({CONE: numbers})

        def one(number: Any, place: Lanes) -> tuple[Lanes, tuple]:
            found = pull(powers.vertex_sums, (place, mine, theirs), (last,), bar)
            own, *sides = only_on(live, found)
            return own, tuple(sides)

        side = ((3,), (3, 3), (3, 3), (3,))
        own, swapped = self._back(count, "pair_vertex", vertex, live, sums_of, one, (side, side))
        swapped, their_moves = pairing.swap((swapped, moves[1]))
        (joint, *frames, box), moves = plus(own, swapped), plus(moves[0], their_moves)
        self.bars.add({"section_box": box})
        self._leave_row(row, behind, joint, frames, moves)

    # Both

    def _body(self, row: jax.Array) -> Place:
        """The link before a row's joint."""
        return Place(*(self._chain(n, row) for n in Place._fields))

    def _sphere(self, item: Any) -> tuple[jax.Array, Lanes]:
        """Link of a slot's sphere, and the sphere's number there."""
        number = self.pairs.read("sphere", item).lane.astype(jnp.int32)
        link = jax.lax.div(number, jnp.int32(self.p.k))
        which = (number - link * self.p.k).astype(self.like.dtype)
        return link, lanes([which], (), wide=True)

    def _row(
        self, row: jax.Array, table: str, count: int
    ) -> tuple[Callable, jax.Array, tuple[RowSide, RowSide]]:
        """Points of a row by number, of a table with so many a row; the row behind; both sides."""
        behind = jnp.minimum(row + 1, self.p.links)
        first = skin.kind_of(row, self.p.links) * count

        def vertex(k: Any) -> tuple[jax.Array, Lanes]:
            number = (first + k).astype(jnp.int32)
            return number, self.hand(table, number, self.lane)

        one, other = (RowSide(*(self._chain(n, r) for n in RowSide._fields)) for r in (row, behind))
        return vertex, behind, (one, other)

    def _sums(self, count: int, sums_of: Callable, numbers: int = sections.SUMS) -> Lanes:
        """What all vertices of a row add to `sections.pressure`."""
        none = zeros((numbers,), self.like)
        return loop(count, lambda k, s: plus(s, sums_of(k)), none, self.p.size)

    def _back(
        self,
        count: int,
        table: str,
        vertex: Callable,
        live: Lanes,
        sums_of: Callable,
        one: Callable,
        shapes: tuple,
    ) -> tuple:
        """Adds the cotangents of a row's vertices; sums those of both sides, of these shapes."""

        def back(k: Any, carry: tuple) -> tuple:
            pushes = only_on(live, sums_of(k)[1])

            def compute() -> tuple:
                number, place = vertex(k)
                own, sides = one(number, place)
                self.bars.add({table: own}, number, self.lane)
                return plus(carry, sides)

            return choose(anywhere(pushes.lane > 0), compute, carry, self.p.size)

        empty = tuple(tuple(zeros(s, self.like) for s in side) for side in shapes)
        return loop(count, back, empty, self.p.size)

    def _leave_row(
        self, row: jax.Array, behind: jax.Array, joint: Lanes, frames: Any, moves: Any
    ) -> None:
        self._leave({"origin": joint}, behind)
        for side, frame, where in zip(moves, frames, (row, behind), strict=True):
            self._leave(side._replace(frame=frame)._asdict(), where)

    def _chain(self, name: str, row: jax.Array) -> Lanes:
        return self.scratch.gather(self.ref, f"chain.{name}", row, self.lane)

    def _leave(self, values: dict[str, Lanes], row: jax.Array) -> None:
        for name, value in values.items():
            name = f"pairbar.{name}"
            old = self.scratch.gather(self.ref, name, row, self.lane)
            self.scratch.scatter(self.ref, name, plus(old, value), row, self.lane)
