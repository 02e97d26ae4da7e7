"""The reverse pass of a step through the contacts between fingers.

A contact's power is counted on the lane of its owner, which knows both sides; the other side's
cotangents go to its own lane by the swap that brought that side's numbers.
"""

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import hull, powers, sections
from codesign_jax.engines.structured.kernel.contacts import zeros
from codesign_jax.engines.structured.kernel.memory import anywhere, choose, loop
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.powers import Place, RowSide
from codesign_jax.engines.structured.kernel.pull import only_on, plus, pull
from codesign_jax.engines.structured.kernel.slots import any_of
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.sweep import Sweep

CONE = "cone.finger_finger"


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

        def slot(item: Any, pairing: Pairing) -> None:
            row = self.pairs.read("row", item).lane.astype(jnp.int32)
            owner = self.pairs.read("owner", item).lane > 0.5
            live = owner & (self.pairs.read("gap", item).lane < 0)
            any_of(live, lambda: one(item, pairing, row, lanes([live], (), wide=True)))

        self.pairs.do(slot)

    def _spheres(self, item: Any, pairing: Pairing, row: jax.Array, live: Lanes) -> None:
        """Adds the cotangents of spheres of two links."""
        number = self.pairs.read("sphere", item).lane.astype(jnp.int32)
        link = jax.lax.div(number, jnp.int32(self.p.k))
        number = (number - link * self.p.k).astype(self.like.dtype)
        which = lanes([number], (), wide=True)
        place = Place(*(self._chain(n, row) for n in Place._fields))
        mine = place, *(self.hand(n, link, self.lane) for n in ("sphere", "radius"))
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
        d = p.scene.discretization
        count = d.hull_rings * d.hull_points
        behind = jnp.minimum(row + 1, links)
        first = hull.kind_of(row, p.links) * count
        ends = [RowSide(*(self._chain(n, r) for n in RowSide._fields)) for r in (row, behind)]
        size = p.hand.read(self.sweep.step.hand, "section_box")
        mine = self._chain("origin", behind), *(side.frame for side in ends), size
        last = lanes([jnp.where(row == links - 1, self.like + 1.0, self.like)], (), wide=True)
        theirs, other_ends, last = pairing.swap((mine, tuple(ends), last))

        def vertex(k: Any) -> tuple[jax.Array, Lanes]:
            number = (first + k).astype(jnp.int32)
            return number, self.hand("vertex", number, self.lane)

        def sums_of(k: Any) -> Lanes:
            return lanewise(powers.vertex_sums, vertex(k)[1], mine, theirs, last)

        none = zeros((sections.SUMS,), self.like)
        sums = loop(count, lambda k, s: plus(s, sums_of(k)), none, p.size)
        args = sums, tuple(ends), other_ends, self.sweep.step.constant(CONE)
        run = partial(powers.between_rows, p.scene)
        bar, *moves, numbers = only_on(live, pull(run, args, (), self.sweep.one))
        self.bars.add({CONE: numbers})

        def back(k: Any, carry: tuple) -> tuple:
            pushes = only_on(live, sums_of(k)[1])

            def compute() -> tuple:
                number, place = vertex(k)
                found = pull(powers.vertex_sums, (place, mine, theirs), (last,), bar)
                own, *sides = only_on(live, found)
                self.bars.add({"vertex": own}, number, self.lane)
                return plus(carry, tuple(sides))

            return choose(anywhere(pushes.lane > 0), compute, carry, p.size)

        empty = tuple(zeros(s, self.like) for s in ((3,), (3, 3), (3, 3), (3,)))
        own, swapped = loop(count, back, (empty, empty), p.size)
        swapped, their_moves = pairing.swap((swapped, moves[1]))
        (joint, *frames, box), moves = plus(own, swapped), plus(moves[0], their_moves)
        self.bars.add({"section_box": box})
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
