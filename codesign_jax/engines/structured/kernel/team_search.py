"""Where fingers touch each other and the palm, looked for by teams of lanes, see `teams`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import skin
from codesign_jax.engines.structured.kernel.memory import anywhere
from codesign_jax.engines.structured.kernel.pair_search import Search, each
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.teams import TEAM
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import hull, sections
from codesign_jax.model.layout import first_on_palm


class TeamSearch(Search):
    """Lanes of a team try pairs of rows, then together the points of each pair that is near."""

    def _near(self, count: int, near: Callable, process: Callable) -> None:
        """Runs process(item, lanes whose finger has one) for the items that fingers have near.

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
                lowest = jax.lax.population_count((bits & -bits) - 1)
                process(k * TEAM + jnp.where(bits > 0, lowest, 0), bits > 0)
                return bits & (bits - 1)

            jax.lax.while_loop(lambda bits: anywhere(bits > 0), next_one, bits)

        each(block.rounds(count), one)

    def _rows_on_palm(self) -> None:
        first = first_on_palm(self.p.links)

        def near(item: jax.Array) -> jax.Array:
            return self._near_palm(item + first)

        def process(item: jax.Array, some: jax.Array) -> None:
            self._row_on_palm(item + first, some)

        self._near(self.p.links + 1 - first, near, process)

    def _rows(self, row: Any, pairing: Pairing, there: jax.Array, first: jax.Array) -> None:
        links, side, own_size = self.p.links, first.astype(jnp.int32), self._size()
        size = self.p.hand.gather(self.step.hand, "section_box", 0, pairing.lane)

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
                ends = self._links(j), own_size, self._links(i, pairing), size, last
                return close & (lanewise(sections.separated, *ends).lane < 0)

            return jax.lax.cond(anywhere(close), boxes, lambda: close)

        def process(item: jax.Array, some: jax.Array) -> None:
            i, j, last = both(item)
            own = self._links(j), skin.kind_of(j, links)
            other = self._links(i, pairing), size, last.lane
            self._row_contact(row, pairing, there & some, side, some, own, other, (j, i))

        self._near(links * (links + 1), near, process)

    def _moves(self, rows: tuple, pairing: Pairing) -> list[tuple[Lanes, Lanes]]:
        table, ref, (mine, theirs) = self.pairs.table, self.pairs.ref, rows
        behind, found = jnp.minimum(theirs + 1, self.p.links), []
        for name in ("motion", "vel"):
            ends = [table.gather(ref, f"side.{name}", k, pairing.lane) for k in (theirs, behind)]
            other = lanewise(lambda a, b: hull.across(a, b, None), *ends)
            found.append((self.pairs.side(name, mine), other))
        return found
