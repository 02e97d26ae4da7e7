"""Where fingers touch each other and the palm, looked for by teams of lanes, see `teams`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import skin
from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.memory import anywhere, loop
from codesign_jax.engines.structured.kernel.pair_search import Search, each
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.slots import any_of
from codesign_jax.engines.structured.kernel.teams import TEAM, team_sum
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import hull, sections
from codesign_jax.model.layout import first_on_palm


class TeamSearch(Search):
    """Lanes of a team try pairs of rows, then the vertices of the pairs that are near."""

    def read(self, name: str, item: Any, pairing: Pairing | None = None) -> Lanes:
        """See `Search`; a partner's column of the table is read as one's own."""
        if pairing is None:
            return super().read(name, item)
        return self.scratch.gather(self.ref, f"pair.{name}", item, pairing.lane)

    def _balls(self) -> None:
        rows = self.p.links + 1

        def one(k: Any) -> None:
            row, _ = self.block.dealt(rows, k)
            ball = self.p.hand.read(self.step.hand, "ball", skin.kind_of(row, self.p.links))
            joint, before, after = self._links(row)
            centre, reach = lanewise(hull.ball_around, joint, before, after, ball)
            whole = lanewise(lambda c, r: jnp.concatenate([c[:, 0], r]), centre, reach)
            self.write("ball", whole, row)

        each(self.block.rounds(rows), one)

    def _near(self, count: int, near: Callable, process: Callable) -> None:
        """Runs process(item, lanes that have one) for the items that a finger has near.

        Args:
          count: Number of items, dealt to the lanes of each team.
          near: From the lanes' items to whether they are near.
          process: What all lanes of a team do with one item; fingers have different ones.
        """
        block = self.block
        bit = jnp.left_shift(jnp.ones_like(block.mate), block.mate)

        def one(k: Any) -> None:
            item, mine = block.dealt(count, k)
            bits = block.over_team(jnp.where(near(item) & mine, bit, 0), jnp.add)

            def next_one(bits: jax.Array) -> jax.Array:
                some = bits > 0
                lowest = jax.lax.population_count((bits & -bits) - 1)
                item = k * TEAM + jnp.where(some, lowest, 0)
                process(item, some)
                return bits & (bits - 1)

            jax.lax.while_loop(lambda bits: anywhere(bits > 0), next_one, bits)

        each(block.rounds(count), one)

    def _sums(self, count: int, ends_of: Callable) -> Lanes:
        """Sums of `sections.add_vertex` over vertices, dealt to the lanes; on all of them."""

        def add(k: Any, sums: Lanes) -> Lanes:
            vertex, mine = self.block.dealt(count, k)
            ends = ends_of(vertex)
            new = lanewise(sections.add_vertex, sums, *ends)
            return lanewise(jnp.where, lanes([mine], (), wide=True), new, sums)

        none = zeros((sections.SUMS,), self.like)
        return team_sum(self.block, loop(self.block.rounds(count), add, none, self.block.size))

    def _rows_on_palm(self) -> None:
        first, d, links = first_on_palm(self.p.links), self.p.scene.discretization, self.p.links
        count = d.hull_rings * d.hull_points

        def near(item: jax.Array) -> jax.Array:
            ball = self.read("ball", item + first)
            (_, _, gap), _ = lanewise(sections.ball_on_palm, ball, self.palm)
            return gap.lane < 0

        def process(item: jax.Array, some: jax.Array) -> None:
            row = item + first
            own, kind = self._links(row), skin.kind_of(row, links)

            def ends(v: jax.Array) -> tuple:
                vertex = self.p.hand.read(self.step.hand, "vertex", kind * count + v)
                return lanewise(sections.on_palm, vertex, own, self.palm)

            place, _ = lanewise(sections.pressure, self._sums(count, ends))
            self._enter_on_palm((*place[:2], self._alone(place[2], some), *place[3:]), row)

        self._near(links + 1 - first, near, process)

    def _alone(self, gap: Lanes, some: jax.Array) -> Lanes:
        """The gap on the first lane of a team that has a contact, and none on the others."""
        which = lanes([some & (self.block.mate == 0)], (), wide=True)
        return lanewise(lambda w, g: jnp.where(w, g, 1.0), which, gap)

    def _rows(self, row: Any, pairing: Pairing, there: jax.Array, first: jax.Array) -> None:
        links, side = self.p.links, first.astype(jnp.int32)
        self_size = self.p.hand.read(self.step.hand, "section_box")
        size = self.p.hand.gather(self.step.hand, "section_box", 0, pairing.lane)
        count = skin.pair_points(self.p.scene)

        def both(item: jax.Array) -> tuple[jax.Array, jax.Array, Lanes]:
            rows = jnp.full_like(item, links + 1)
            i, j = jax.lax.div(item, rows), jax.lax.rem(item, rows)
            last = jnp.where(i == links - 1, self.like + 1.0, self.like)
            return i, j, lanes([last], (), wide=True)

        def near(item: jax.Array) -> jax.Array:
            i, j, last = both(item)
            balls = self.read("ball", j), self.read("ball", i, pairing)
            close = there & (lanewise(sections.apart, *balls).lane < 0)

            def boxes() -> jax.Array:
                ends = self._links(j), self_size, self._links(i, pairing), size, last
                return close & (lanewise(sections.separated, *ends).lane < 0)

            return jax.lax.cond(anywhere(close), boxes, lambda: close)

        def process(item: jax.Array, some: jax.Array) -> None:
            i, j, last = both(item)
            own, theirs, kind = self._links(j), self._links(i, pairing), skin.kind_of(j, links)

            def ends(v: jax.Array) -> tuple:
                vertex = self.p.hand.read(self.step.hand, "pair_vertex", kind * count + v)
                return lanewise(sections.inside, vertex, own, theirs, size, last)

            one, two = lanewise(sections.pressure, self._sums(count, ends))
            which = there & (self._alone(one[2], some).lane < 0)

            def enter() -> None:
                moves = self._moves((j, i), pairing)

                def way(turn: Any) -> None:
                    owner = there & (side == turn)
                    found = which & owner

                    def now() -> None:
                        self._enter(row, found, owner, (one, two), (j, i), moves)

                    any_of(found, now)

                each(2, way)

            any_of(which, enter)

        self._near(links * (links + 1), near, process)

    def _moves(self, rows: tuple, pairing: Pairing) -> list[tuple[Lanes, Lanes]]:
        table, ref, links = self.pairs.table, self.pairs.ref, self.p.links
        mine, theirs = rows
        found = []
        for name in ("motion", "vel"):
            ends = [
                table.gather(ref, f"side.{name}", row, pairing.lane)
                for row in (theirs, jnp.minimum(theirs + 1, links))
            ]
            other = lanewise(lambda a, b: hull.across(a, b, None), *ends)
            found.append((self.pairs.side(name, mine), other))
        return found
