"""Finds where fingers touch each other and the palm: spheres, or the hull's vertices.

A vertex of the hull touches another finger's row (the stretch between the middles of two links)
where it stands inside the row's section, whose frame turns from one link's to the other's along
the row: rows neither overlap nor leave gaps, however the finger bends.  Both fingers' vertices
are tried, each with half its share of the surface.  All vertices of a row that stand in the same
row of another finger are one contact, see `sections.pressure`; so are those in the palm's disc.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import grip, skin
from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.memory import anywhere, choose, loop
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.slots import any_of
from codesign_jax.engines.structured.kernel.teams import team_sum, where
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import holding, hull, sections
from codesign_jax.engines.structured.world_model import apply_columns
from codesign_jax.model.layout import first_on_palm, palm_ahead

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.step import Step


def fields(links: int, spheres: int) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Where the fingers are, for the lanes of the others; with the hull there are no spheres."""
    if spheres:
        return {"pair.sphere": (links * spheres, (4,))}
    rows = links + 1
    return {"pair.frame": (rows, (3, 3)), "pair.joint": (rows, (3,)), "pair.ball": (rows, (4,))}


class Search:
    """Gives a slot to each contact between fingers."""

    def __init__(self, step: "Step", pairs: BoundPairs, at: dict[str, Any]):
        """Takes a step's memory and geometry, see `Step`."""
        self.step, self.pairs, self.p = step, pairs, step.p
        self.moves, self.palm = (at["now"].palm_motion, at["vel"]), ()
        if pairs.set.palm:
            self.palm = at["place"], at["frame"], step.constant("palm_disc")
        self.ahead = palm_ahead(step.p.scene)
        self.timestep = step.p.scene.discretization.timestep
        self.scratch, self.ref, self.block = step.p.scratch, step.scratch, step.block
        self.like = jnp.zeros((step.p.size,), step.finger_state.dtype)

    def write(self, name: str, value: Lanes, item: Any) -> None:
        """Stores where a finger is."""
        self.scratch.write(self.ref, f"pair.{name}", value, item)

    def read(self, name: str, item: Any, pairing: Pairing | None = None) -> Lanes:
        """Where the lanes' own fingers are, or those that they are paired with."""
        if pairing is not None and self.block.team > 1:
            return self.scratch.gather(self.ref, f"pair.{name}", item, pairing.lane)
        own = self.scratch.read(self.ref, f"pair.{name}", item)
        return own if pairing is None else pairing.swap(own)

    def start(self, motion: Lanes, vel: Lanes, frame: Lanes, base: Lanes) -> None:
        """Empties the slots; stores what belongs to the palm."""
        for row in range(self.pairs.set.rows):
            self.pairs.clear(row)
        grip.clear(self.step)
        self._side(0, motion, vel, frame, base)

    def link(self, i: Any, motion: Lanes, vel: Lanes, frame: Lanes, origin: Lanes) -> None:
        """Stores where a link is and how it moves."""
        self._side(i + 1, motion, vel, frame, origin)
        for a in range(self.p.k):
            sphere, radius = (self.p.hand.read(self.step.hand, n, i) for n in ("sphere", "radius"))

            def ball(o, f, s, r, a: int = a):
                return jnp.concatenate([o + apply_columns(f, s[:, a]), r[a][None]])

            self.write("sphere", lanewise(ball, origin, frame, sphere, radius), i * self.p.k + a)

    def _side(self, row: Any, motion: Lanes, vel: Lanes, frame: Lanes, joint: Lanes) -> None:
        for name, value, palm in zip(("motion", "vel"), (motion, vel), self.moves, strict=True):
            self.pairs.put(name, self.pairs.beside_palm(value, palm), row)
        if not self.p.k:
            self.write("frame", frame, row)
            self.write("joint", joint, row)

    def find(self) -> None:
        """Looks at all pairs of fingers, and at the palm."""
        if not self.p.k:
            self._balls()
        if self.palm:
            (self._spheres_on_palm if self.p.k else self._rows_on_palm)()

        def pairing(row: jax.Array, x: jax.Array) -> jax.Array:
            pairing = self.pairs.pairing(row)
            other = jax.lax.div(pairing.lane, jnp.int32(self.p.block))
            there = (self.block.finger < self.p.num_fingers) & (other < self.p.num_fingers)
            first = self.block.finger < other
            (self._spheres if self.p.k else self._rows)(row, pairing, there, first)
            return x

        jax.lax.fori_loop(int(self.pairs.set.palm), self.pairs.set.rows, pairing, jnp.int32(0))

    # The palm

    def _spheres_on_palm(self) -> None:
        """Enters contacts of spheres."""
        first = (first_on_palm(self.p.links) - 1) * self.p.k

        def one(j: Any) -> None:
            number, ball = j + first, self.read("sphere", j + first)
            mine, _ = lanewise(sections.ball_on_palm, ball, self.palm)
            row = jax.lax.div(number, jnp.asarray(self.p.k, number.dtype)) + 1
            self._enter_on_palm(mine, row, number)

        each(self.p.links * self.p.k - first, one)

    def _rows_on_palm(self) -> None:
        """Enters one contact of all vertices of a row."""
        first = first_on_palm(self.p.links)

        def one(i: Any) -> None:
            row = i + first
            any_of(self._near_palm(row), lambda: self._row_on_palm(row, None))

        each(self.p.links + 1 - first, one)

    def _near_palm(self, row: Any) -> jax.Array:
        """Lanes on which a vertex of a row may touch the palm, with `ahead` in this step."""
        ball = self.read("ball", row)
        (_, _, gap), _ = lanewise(sections.ball_on_palm, ball, self.palm)
        if not self.ahead:
            return gap.lane < 0
        joint = self.read("joint", jnp.minimum(row + 1, self.p.links))
        speed = lanewise(sections.fastest, ball, joint, self.pairs.side("vel", row))
        return gap.lane < sections.REACH + self.timestep * speed.lane

    def _row_on_palm(self, row: Any, there: jax.Array | None) -> None:
        """Enters one contact of all vertices of a row; there: lanes that have one to try."""
        d, links = self.p.scene.discretization, self._links(row)
        count, kind = d.hull_rings * d.hull_points, skin.kind_of(row, self.p.links)

        vel = self.pairs.side("vel", row) if self.ahead else None

        def add(k: Any, sums: Any) -> Any:
            k, mine = self.block.dealt(count, k)
            vertex = self.p.hand.read(self.step.hand, "vertex", kind * count + k)
            one, other = lanewise(sections.on_palm, vertex, links, self.palm)
            if vel is None:
                new = lanewise(sections.add_vertex, sums, one, other)
            else:
                one, seen = lanewise(partial(sections.ahead, self.timestep), one, vel)
                new = lanewise(sections.add_to_halves, sums, vertex, one, other, seen)
            return new if mine is None else where(mine, new, sums)

        if vel is None:
            start = zeros((sections.SUMS,), self.like)
            sums = loop(self.block.rounds(count), add, start, self.block.size)
            place = lanewise(sections.pressure, team_sum(self.block, sums))[0]
            return self._enter_on_palm(place, row, there=there)
        one = lanewise(sections.none_ahead, lanes([self.like], (), wide=True))
        halves = loop(self.block.rounds(count), add, (one, one), self.block.size)
        for number, sums in enumerate(halves):
            place, _, seen = lanewise(sections.pressure_ahead, self._team_sum(sums))
            self._enter_on_palm(place, row, number, there, seen)

    def _team_sum(self, sums: Lanes) -> Lanes:
        """Sums of a team's lanes; with `ahead` of those with the lowest gap, or one below 0."""
        if self.block.team == 1 or not self.ahead:
            return team_sum(self.block, sums)
        own = sums[-1].lane
        lowest = self.block.over_team(own, jnp.minimum)
        counts = lanes([(own < 0) | (own == lowest)], (), wide=True)
        parts = team_sum(self.block, lanewise(lambda c, s: jnp.where(c, s, 0.0), counts, sums[:-1]))
        return lanewise(_appended, parts, lanes([lowest], (1,), wide=True))

    def _enter_on_palm(
        self,
        place: tuple,
        row: Any,
        sphere: Any = 0,
        there: jax.Array | None = None,
        seen: tuple | None = None,
    ) -> None:
        """Gives a slot to a contact with the palm, whose motion the sides' are relative to."""
        pairs = self.pairs
        which = (place[2].lane < 0) & (self.block.finger < self.p.num_fingers)
        which = which if there is None else self.block.alone(which & there)

        def enter() -> None:
            motion, vel = (pairs.side(name, row) for name in ("motion", "vel"))
            with pairs.with_cone(0):
                fields = pairs.begin(place, motion, vel, ahead=seen)
            number = lanes([self.like + jnp.asarray(row, self.like.dtype)], (1, 1), wide=True)
            fields |= {"row": number} | pairs.remembered({"owner": 1.0, "sphere": sphere})
            pairs.add(0, which, fields, self.block.own)

        any_of(which, enter)

    # Spheres

    def _spheres(self, row: Any, pairing: Pairing, there: jax.Array, first: jax.Array) -> None:
        count, owner = self.p.links * self.p.k, there & first

        def outer(i: Any) -> None:
            theirs = self.read("sphere", i, pairing)

            def inner(j: Any) -> None:
                mine = self.read("sphere", j)
                which = owner & (lanewise(sections.apart, mine, theirs).lane < 0)

                def enter() -> None:
                    one, other = lanewise(sections.between, mine, theirs)
                    rows = tuple(jax.lax.div(v, jnp.asarray(self.p.k, v.dtype)) + 1 for v in (j, i))
                    moves = self._moves(rows, pairing)
                    self._enter(row, which, owner, (one, other), rows, moves, (j, i))

                any_of(which, enter)

            each(count, inner)

        each(count, outer)

    # The hull

    def _balls(self) -> None:
        """Balls around the vertices of every row."""

        def one(row: Any) -> None:
            row, _ = self.block.dealt(self.p.links + 1, row)
            kind = skin.kind_of(row, self.p.links)
            ball = self.p.hand.read(self.step.hand, "ball", kind)
            joint, before, after = self._links(row)
            centre, reach = lanewise(hull.ball_around, joint, before, after, ball)
            whole = lanewise(lambda c, r: jnp.concatenate([c[:, 0], r]), centre, reach)
            self.write("ball", whole, row)

        each(self.block.rounds(self.p.links + 1), one)

    def _links(self, row: Any, pairing: Pairing | None = None) -> tuple[Lanes, Lanes, Lanes]:
        """Joint of a row, and the frames of the links before and behind it."""
        behind = jnp.minimum(row + 1, self.p.links)
        places = (("joint", behind), ("frame", row), ("frame", behind))
        return tuple(self.read(name, r, pairing) for name, r in places)  # type: ignore[return-value]

    def _size(self) -> Lanes:
        """Half the width, the height and a segment of the lanes' own fingers."""
        return self.p.hand.read(self.step.hand, "section_box")

    def _rows(self, row: Any, pairing: Pairing, there: jax.Array, first: jax.Array) -> None:
        links = self.p.links
        self_size = self._size()
        size = pairing.swap(self_size)
        side = first.astype(jnp.int32)

        def outer(i: Any) -> None:
            theirs, ball = self._links(i, pairing), self.read("ball", i, pairing)
            last = jnp.where(i == links - 1, self.like + 1.0, self.like)

            def inner(j: Any) -> None:
                near = there & (lanewise(sections.apart, self.read("ball", j), ball).lane < 0)

                def boxes() -> None:
                    own, kind = self._links(j), skin.kind_of(j, links)
                    apart = lanewise(
                        sections.separated,
                        own,
                        self_size,
                        theirs,
                        size,
                        lanes([last], (), wide=True),
                    )

                    def vertices() -> None:
                        other = theirs, size, last
                        found = row, pairing, there, side
                        self._row_contact(*found, tried, (own, kind), other, (j, i))

                    tried = near & (apart.lane < 0)
                    any_of(tried, vertices)

                any_of(near, boxes)

            each(links + 1, inner)

        each(links, outer)

    def _row_contact(
        self,
        pairing_row: Any,
        pairing: Pairing,
        there: jax.Array,
        side: jax.Array,
        tried: jax.Array,
        own: tuple,
        other: tuple,
        rows: tuple,
    ) -> None:
        """Enters the one contact of a row with another finger's row, see `sections.pressure`.

        Args:
          pairing_row: Number of the pairing.
          pairing: The pairing.
          there: Lanes whose finger and partner exist.
          side: Lanes' side of the pairing, 0 or 1.
          tried: Lanes whose two rows may have a point in common.
          own: Links of the lanes' own row, see `_links`, and its kind.
          other: Links of their partners' row, its size, and whether it is the last one.
          rows: Numbers of both rows.
        """
        count, (links, kind), (theirs, size, last) = skin.pair_points(self.p.scene), own, other
        rings, own_size = self.p.scene.discretization.hull_rings, self._size()
        each_ring, start = count // rings, zeros((sections.SUMS,), self.like)

        def read(k: Any) -> Lanes:
            return self.p.hand.read(self.step.hand, "pair_vertex", k)

        def ring(r: Any, sums: Lanes) -> Lanes:
            first = kind * count + r * each_ring
            ring = lanewise(sections.ring_in_section, read(first), links, theirs)
            away = lanewise(sections.ring_outside, ring, own_size, size).lane

            def add(k: Any, sums: Lanes) -> Lanes:
                k, _ = self.block.dealt(each_ring, k)  # of which teams have a multiple of theirs
                vertex = read(first + k)
                away = lanewise(sections.outside, vertex, ring, size).lane

                def within() -> Lanes:
                    end = lanes([last], (), wide=True)
                    ends = lanewise(sections.inside, vertex, links, theirs, size, end)
                    return lanewise(sections.add_vertex, sums, *ends)

                return choose(anywhere(tried & ~away), within, sums, self.block.size)

            def points() -> Lanes:
                return loop(self.block.rounds(each_ring), add, sums, self.block.size)

            return choose(anywhere(tried & ~away), points, sums, self.block.size)

        sums = team_sum(self.block, loop(rings, ring, start, self.block.size))
        one, two = lanewise(sections.pressure, sums)
        which = self.block.alone(there & (one[2].lane < 0))

        def enter() -> None:
            moves = self._moves(rows, pairing)

            def way(turn: Any) -> None:
                owner = there & (side == turn)
                found = which & owner
                any_of(
                    found,
                    lambda: self._enter(pairing_row, found, owner, (one, two), rows, moves),
                )

            each(2, way)

        any_of(which, enter)

    def _moves(self, rows: tuple, pairing: Pairing) -> list[tuple[Lanes, Lanes]]:
        """Accelerations and velocities of the lanes' own row and of their partners' row."""
        own, theirs = ([self.pairs.side(n, row) for n in ("motion", "vel")] for row in rows)
        return list(zip(own, pairing.swap(theirs), strict=True))

    def _enter(
        self,
        row: Any,
        which: jax.Array,
        owner: jax.Array,
        ends: tuple,
        rows: tuple,
        moves: list[tuple[Lanes, Lanes]],
        spheres: tuple = (0, 0),
    ) -> None:
        """Gives contacts a slot; places on either side, the sides' rows, and how they move."""
        pairs, contacts = self.pairs, self.pairs.set.contacts

        def jar(one, other, cone, held, motion, vel):
            a, b = (contacts(place, cone) for place in (one, other))

            def relative(m):
                return a.relative(m[0][:, None]) - b.relative(m[1][:, None])

            value = relative(motion) - a.reference(relative(vel))
            for g in held:
                value = value + holding.held(a, g[:, None])
            return value, -value, jnp.zeros_like(value)

        cone = pairs.of_row(row)
        held = grip.of_row(self.step, pairs, row)
        mine, theirs, none = lanewise(jar, ends[0], ends[1], cone, held, moves[0], moves[1])
        kept = [
            dict(zip(pairs.set.places, place, strict=True)) | {"jar": value}
            for place, value in zip(ends, (mine, theirs), strict=True)
        ]
        if self.block.team > 1:  # each finger of a pair may have found another contact
            for side, number in zip(kept, rows, strict=True):
                side["row"] = lanes([number.astype(self.like.dtype)], (1, 1), wide=True)
            return pairs.enter(row, which, owner, kept[0], kept[1], {"step": none})
        numbers = [v.astype(self.like.dtype) for v in rows]
        side = jnp.where(owner, self.like + numbers[0], self.like + numbers[1])
        alike = {"row": lanes([side], (1, 1), wide=True), "step": none}
        if pairs.set.remembers:
            alike |= pairs.remembered({"owner": owner, "sphere": jnp.where(owner, *spheres)})
        pairs.enter(row, which, owner, kept[0], kept[1], alike)


def _appended(one: jax.Array, other: jax.Array) -> jax.Array:
    return jnp.concatenate([one, other])


def each(count: int, body: Callable[[Any], None]) -> None:
    """Runs body(item), which stores something, for all items."""

    def one(k: jax.Array, x: jax.Array) -> jax.Array:
        body(k)
        return x

    jax.lax.fori_loop(0, count, one, jnp.int32(0))
