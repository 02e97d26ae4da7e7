"""The reverse pass of a step through the contacts of fingers with each other and with the palm.

A contact's power is counted on the lane of its ring, which reads both sides; the other finger's
cotangents go to its own lane by a swap.  A contact of a finger with itself or with the palm has one
lane; what it leaves for the palm is kept as "palmbar".
"""

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import grip_sweep, pair_search, powers
from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.powers import Line, Place
from codesign_jax.engines.structured.kernel.pull import only_on, plus, pull
from codesign_jax.engines.structured.kernel.slots import any_of
from codesign_jax.engines.structured.lanewise import Lanes, lanes
from codesign_jax.model.layout import touches_itself

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

    def run(self) -> None:
        """Goes through all contacts."""

        def clear(i: jax.Array, x: jax.Array) -> jax.Array:
            for name in Place._fields:
                shape = self.scratch.groups[f"pairbar.{name}"][1]
                self.scratch.write(self.ref, f"pairbar.{name}", zeros(shape, self.like), i)
            return x

        jax.lax.fori_loop(0, self.p.links + 1, clear, jnp.int32(0))
        effects, hull = self.p.scene.effects, self.p.scene.effects.surface == "hull"
        if effects.finger_palm:
            self._leave_palm(Place(*(self.sweep.none(n) for n in Place._fields)), first=True)

        def slot(item: Any, pairing: Pairing) -> None:
            read = self.pairs.read
            owner = read("owner", item).lane > 0.5
            live = owner & (read("share", item).lane > 0)
            if pairing.alone is not None:
                other = read("other", item).lane.astype(jnp.int32)
                if effects.finger_palm:
                    palm = live & pairing.alone & (other == 0)
                    any_of(palm, lambda: self._on_palm(item, palm))
                if touches_itself(self.p.scene):
                    itself = live & pairing.alone & (other > 0)
                    any_of(itself, lambda: self._on_itself(item, pairing, itself))
                live = live & ~pairing.alone
            if effects.finger_finger:
                one = self._on_finger if hull else self._spheres
                any_of(live, lambda: one(item, pairing, live))

        self.pairs.do(slot)

    # The palm

    def _on_palm(self, item: Any, live: jax.Array) -> None:
        """Adds the cotangents of a ring or sphere and of the palm."""
        number, row, ring = self._ring(item)
        at, step = self.sweep.at, self.sweep.step
        palm = self._body(jnp.zeros_like(row))._replace(origin=at["place"], frame=at["frame"])
        args = (self._body(row), ring), palm, step.constant("palm_disc"), step.constant(ON_PALM)
        run = partial(powers.on_palm, self.p.scene)
        (place, own), palm, disc, cone = only_on(self._side(live), pull(run, args, (), self._one))
        self.bars.add({ON_PALM: cone, "palm_disc": disc})
        self.bars.add({"ring": own}, number, self.lane)
        self._leave_palm(palm)
        self._leave(place._asdict(), row)

    def _leave_palm(self, bars: Place, *, first: bool = False) -> None:
        """Adds to what the palm's place and motion get."""
        for name, value in bars._asdict().items():
            name = f"palmbar.{name}"
            if not first:
                value = plus(self.scratch.read(self.ref, name), value)
            self.scratch.write(self.ref, name, value)

    # Fingers

    def _spheres(self, item: Any, pairing: Pairing, live: jax.Array) -> None:
        """Adds the cotangents of two spheres."""
        number, row, ring = self._ring(item)
        other = jax.lax.div(self.pairs.read("ring", item).lane.astype(jnp.int32), self._count)
        theirs = self._body(row_of(other, self.p.k), pairing.lane), self._numbers(other, pairing)
        args = (self._body(row), ring), theirs, self.sweep.step.constant(CONE)
        found = pull(partial(powers.between_spheres, self.p.scene), args, (), self._one)
        (place, own), swapped, cone = only_on(self._side(live), found)
        self.bars.add({CONE: cone})
        self.bars.add({"ring": own}, number, self.lane)
        self._leave(place._asdict(), row)
        (place, own), other = pairing.swap((swapped, self._float(other)))
        other = other.lane.astype(jnp.int32)
        self.bars.add({"ring": own}, other, self.lane)
        self._leave(place._asdict(), row_of(other, self.p.k))

    def _on_finger(self, item: Any, pairing: Pairing, live: jax.Array) -> None:
        """Adds the cotangents of a ring and of another finger's segment."""
        row = self.pairs.read("row", item)
        other = pairing.swap(row).lane.astype(jnp.int32)
        still = {"end": self._float(1)}
        theirs = self._rings(item, pairing, live, other, pairing.lane, still)
        line, where = pairing.swap((theirs, self._float(other)))
        self._leave_line(line, where.lane.astype(jnp.int32))

    def _on_itself(self, item: Any, pairing: Pairing, live: jax.Array) -> None:
        """Adds the cotangents of a ring and of its own finger's segment."""
        other = self.pairs.read("other", item).lane.astype(jnp.int32)
        search = self.sweep.step.search
        assert search is not None
        end = search.last_of(self._ring(item)[0], other)
        still = {"end": self._float(end)}
        line = self._rings(item, pairing, live, other, self.lane, still)
        self._leave_line(line, other)

    def _rings(
        self, item: Any, pairing: Pairing, live: jax.Array, other: Any, lane: Any, still: dict
    ) -> Line:
        """Adds the cotangents of a ring; returns those of the segment that it touches."""
        number, row, ring = self._ring(item)
        before, own, after = pair_search.neighbours(other, self.p.links)
        frames = tuple(self._chain("frame", r, lane) for r in (before, after))
        sections = [self._numbers(n, pairing, lane) for n in self._sections(other)]
        line = Line(self._body(own, lane), self._chain("origin", after, lane), frames, *sections)
        still |= {"last": self._float(jnp.where(other == self.p.links, self.like + 1.0, self.like))}
        held = grip_sweep.at(self.sweep.step, pairing)
        args = (self._body(row), ring), line, self.sweep.step.constant(CONE), held
        found = pull(partial(powers.between_rings, self.p.scene), args, (still,), self._one)
        (place, own_ring), line, cone, kept = only_on(self._side(live), found)
        grip_sweep.leave(self.sweep.step, pairing, kept)
        self.bars.add({CONE: cone})
        self.bars.add({"ring": own_ring}, number, self.lane)
        self._leave(place._asdict(), row)
        return line

    def _leave_line(self, line: Line, row: jax.Array) -> None:
        before, own, after = pair_search.neighbours(row, self.p.links)
        self._leave(line.place._asdict(), own)
        self._leave({"frame": line.frames[0]}, before)
        self._leave({"origin": line.origin, "frame": line.frames[1]}, after)
        bars = line.tip, line.first
        for ring, bar in zip(self._sections(row), bars, strict=False):
            self.bars.add({"ring": bar}, ring, self.lane)

    def _sections(self, row: jax.Array) -> list[jax.Array]:
        """Rings whose sections segments have, and the one before has; see `Search.ring_at`."""
        search = self.sweep.step.search
        assert search is not None
        places = (1, 0) if self.p.tapered else (1,)
        return [jnp.zeros_like(row) + search.ring_at(row + k) for k in places]

    # Both

    @property
    def _one(self) -> Lanes:
        return self.sweep.one

    @property
    def _count(self) -> jax.Array:
        return jnp.full((self.p.size,), self.p.links * self.p.k, jnp.int32)

    def _side(self, live: jax.Array) -> Lanes:
        return lanes([live], (), wide=True)

    def _float(self, value: Any) -> Lanes:
        return lanes([self.like + jnp.asarray(value, self.like.dtype)], (), wide=True)

    def _ring(self, item: Any) -> tuple[jax.Array, jax.Array, Lanes]:
        """Number of a slot's ring, its link and its numbers."""
        number = self.pairs.read("ring", item).lane.astype(jnp.int32)
        number = jax.lax.rem(number, self._count)
        ring = self.p.hand.gather(self.sweep.step.hand, "ring", number, self.lane)
        return number, row_of(number, self.p.k), ring

    def _numbers(self, number: jax.Array, pairing: Pairing, lane: Any = None) -> Lanes:
        lane = pairing.lane if lane is None else lane
        return self.p.hand.gather(self.sweep.step.hand, "ring", number, lane)

    def _body(self, row: jax.Array, lane: Any = None) -> Place:
        """A link."""
        return Place(*(self._chain(n, row, lane) for n in Place._fields))

    def _chain(self, name: str, row: jax.Array, lane: Any = None) -> Lanes:
        lane = self.lane if lane is None else lane
        return self.scratch.gather(self.ref, f"chain.{name}", row, lane)

    def _leave(self, values: dict[str, Lanes], row: jax.Array) -> None:
        for name, value in values.items():
            name = f"pairbar.{name}"
            old = self.scratch.gather(self.ref, name, row, self.lane)
            self.scratch.scatter(self.ref, name, plus(old, value), row, self.lane)


def row_of(number: jax.Array, k: int) -> jax.Array:
    """Link of a ring."""
    return jax.lax.div(number, jnp.full_like(number, k)) + 1
