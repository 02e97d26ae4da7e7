"""Finds where fingers touch: spheres, or the hull's vertices and other fingers' sections.

A vertex of the hull touches another finger's row (the stretch between the middles of two links)
where it stands inside the row's section, whose frame turns from one link's to the other's along
the row: rows neither overlap nor leave gaps, however the finger bends.  Both fingers' vertices
are tried, each with half its share of the surface.  All vertices of a row that stand in the same
row of another finger are one contact, see `_pressure`.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.constants import apply_columns
from codesign_jax.engines.structured.kernel import hull
from codesign_jax.engines.structured.kernel.contacts import zeros
from codesign_jax.engines.structured.kernel.memory import loop
from codesign_jax.engines.structured.kernel.pairs import BoundPairs, Pairing
from codesign_jax.engines.structured.kernel.slots import any_of
from codesign_jax.engines.structured.lanes import dot, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.step import Step

ROUND = 0.5
"""Radius of a section's edges to other fingers, over half its smaller side: vertices that stand
less deep than that have a normal that turns with their place."""


def fields(links: int, spheres: int) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Where the fingers are, for the lanes of the others; with the hull there are no spheres."""
    if spheres:
        return {"pair.sphere": (links * spheres, (4,))}
    rows = links + 1
    return {"pair.frame": (rows, (3, 3)), "pair.joint": (rows, (3,)), "pair.ball": (rows, (4,))}


class Search:
    """Gives a slot to each contact between fingers."""

    def __init__(self, step: "Step", pairs: BoundPairs):
        """Takes a step's memory."""
        self.step, self.pairs, self.p = step, pairs, step.p
        self.scratch, self.ref, self.block = step.p.scratch, step.scratch, step.block
        self.like = jnp.zeros((step.p.size,), step.finger_state.dtype)

    def write(self, name: str, value: Lanes, item: Any) -> None:
        """Stores where a finger is."""
        self.scratch.write(self.ref, f"pair.{name}", value, item)

    def read(self, name: str, item: Any, pairing: Pairing | None = None) -> Lanes:
        """Where the lanes' own fingers are, or those that they are paired with."""
        own = self.scratch.read(self.ref, f"pair.{name}", item)
        return own if pairing is None else pairing.swap(own)

    def start(self, motion: Lanes, vel: Lanes, frame: Lanes, base: Lanes) -> None:
        """Empties the slots; stores what belongs to the palm."""
        for row in range(self.pairs.set.rows):
            self.pairs.clear(row)
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
        self.pairs.put("motion", motion, row)
        self.pairs.put("vel", vel, row)
        if not self.p.k:
            self.write("frame", frame, row)
            self.write("joint", joint, row)

    def find(self) -> None:
        """Looks at all pairs of fingers."""
        if not self.p.k:
            self._balls()

        def pairing(row: jax.Array, x: jax.Array) -> jax.Array:
            pairing = self.pairs.pairing(row)
            other = jax.lax.div(pairing.lane, jnp.int32(self.p.block))
            there = (self.block.finger < self.p.num_fingers) & (other < self.p.num_fingers)
            first = self.block.finger < other
            (self._spheres if self.p.k else self._rows)(row, pairing, there, first)
            return x

        jax.lax.fori_loop(0, self.pairs.set.rows, pairing, jnp.int32(0))

    # Spheres

    def _spheres(self, row: Any, pairing: Pairing, there: jax.Array, first: jax.Array) -> None:
        count, owner = self.p.links * self.p.k, there & first

        def outer(i: Any) -> None:
            theirs = self.read("sphere", i, pairing)

            def inner(j: Any) -> None:
                mine = self.read("sphere", j)
                which = owner & (lanewise(_apart, mine, theirs).lane < 0)

                def enter() -> None:
                    one, other = lanewise(_between, mine, theirs)
                    rows = tuple(jax.lax.div(v, jnp.asarray(self.p.k, v.dtype)) + 1 for v in (j, i))
                    moves = self._moves(rows, pairing)
                    self._enter(row, which, owner, (one, other), rows, moves)

                any_of(which, enter)

            each(count, inner)

        each(count, outer)

    # The hull

    def _balls(self) -> None:
        """Balls around the vertices of every row."""

        def one(row: Any) -> None:
            kind = hull.kind_of(row, self.p.links)
            ball = self.p.hand.read(self.step.hand, "ball", kind)
            joint, before, after = self._links(row)
            centre, reach = lanewise(hull.ball_around, joint, before, after, ball)
            whole = lanewise(lambda c, r: jnp.concatenate([c[:, 0], r]), centre, reach)
            self.write("ball", whole, row)

        each(self.p.links + 1, one)

    def _links(self, row: Any, pairing: Pairing | None = None) -> tuple[Lanes, Lanes, Lanes]:
        """Joint of a row, and the frames of the links before and behind it."""
        behind = jnp.minimum(row + 1, self.p.links)
        places = (("joint", behind), ("frame", row), ("frame", behind))
        return tuple(self.read(name, r, pairing) for name, r in places)  # type: ignore[return-value]

    def _rows(self, row: Any, pairing: Pairing, there: jax.Array, first: jax.Array) -> None:
        links = self.p.links
        self_size = self.p.hand.read(self.step.hand, "section_box")
        size = pairing.swap(self_size)
        side = first.astype(jnp.int32)

        def outer(i: Any) -> None:
            theirs, ball = self._links(i, pairing), self.read("ball", i, pairing)
            last = jnp.where(i == links - 1, self.like + 1.0, self.like)

            def inner(j: Any) -> None:
                near = there & (lanewise(_apart, self.read("ball", j), ball).lane < 0)

                def boxes() -> None:
                    own, kind = self._links(j), hull.kind_of(j, links)
                    apart = lanewise(
                        _separated, own, self_size, theirs, size, lanes([last], (), wide=True)
                    )

                    def vertices() -> None:
                        self._row_contact(
                            row, pairing, there, side, (own, kind), (theirs, size, last), (j, i)
                        )

                    any_of(near & (apart.lane < 0), vertices)

                any_of(near, boxes)

            each(links + 1, inner)

        each(links, outer)

    def _row_contact(
        self,
        pairing_row: Any,
        pairing: Pairing,
        there: jax.Array,
        side: jax.Array,
        own: tuple,
        other: tuple,
        rows: tuple,
    ) -> None:
        """Enters the one contact of a row's vertices with another finger's row, see `_pressure`.

        Args:
          pairing_row: Number of the pairing.
          pairing: The pairing.
          there: Lanes whose finger and partner exist.
          side: Lanes' side of the pairing, 0 or 1.
          own: Links of the lanes' own row, see `_links`, and its kind.
          other: Links of their partners' row, its size, and whether it is the last one.
          rows: Numbers of both rows.
        """
        d = self.p.scene.discretization
        count, (links, kind), (theirs, size, last) = d.hull_rings * d.hull_points, own, other

        def add(k: Any, sums: Lanes) -> Lanes:
            vertex = self.p.hand.read(self.step.hand, "vertex", kind * count + k)
            end = lanes([last], (), wide=True)
            ends = lanewise(_inside, vertex, links, theirs, size, end)
            return lanewise(_add_vertex, sums, *ends)

        sums = loop(count, add, zeros((SUMS,), self.like), self.block.size)
        one, two = lanewise(_pressure, sums)
        which = there & (one[2].lane < 0)

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
    ) -> None:
        """Gives contacts a slot; places on either side, the sides' rows, and how they move."""
        pairs, contacts = self.pairs, self.pairs.set.contacts

        def jar(one, other, cone, motion, vel):
            a, b = (contacts(place, cone) for place in (one, other))

            def relative(m):
                return a.relative(m[0][:, None]) - b.relative(m[1][:, None])

            value = relative(motion) - a.reference(relative(vel))
            return value, -value, jnp.zeros_like(value)

        mine, theirs, none = lanewise(jar, ends[0], ends[1], pairs.cone, moves[0], moves[1])
        kept = [
            dict(zip(pairs.set.places, place, strict=True)) | {"jar": value}
            for place, value in zip(ends, (mine, theirs), strict=True)
        ]
        numbers = [v.astype(self.like.dtype) for v in rows]
        side = jnp.where(owner, self.like + numbers[0], self.like + numbers[1])
        alike = {"row": lanes([side], (1, 1), wide=True), "step": none}
        pairs.enter(row, which, owner, kept[0], kept[1], alike)


def each(count: int, body: Callable[[Any], None]) -> None:
    """Runs body(item), which stores something, for all items."""

    def one(k: jax.Array, x: jax.Array) -> jax.Array:
        body(k)
        return x

    jax.lax.fori_loop(0, count, one, jnp.int32(0))


def _apart(a: jax.Array, b: jax.Array) -> jax.Array:
    """Distance between two balls (centre, radius), (4, ...)."""
    away = a[:3] - b[:3]
    return jnp.sqrt(dot(away, away)) - (a[3] + b[3])


def _between(a: jax.Array, b: jax.Array) -> tuple[tuple, tuple]:
    """Point, normal and gap of two balls, on either side; see `finger_pairs`."""
    away, reach = a[:3] - b[:3], a[3] + b[3]
    square = dot(away, away)
    apart = square > 0
    length = jnp.sqrt(jnp.where(apart, square, 1.0))
    one = jnp.ones_like(square)
    fallback = jnp.stack([-one, 0 * one, 0 * one])
    normal = jnp.where(apart, away / length, fallback)
    gap = jnp.where(apart, length, 0.0) - reach
    point = (a[:3] - normal * (a[3] + 0.5 * gap))[:, None]
    gap, normal = gap[None, None], normal[:, None]
    return (point, normal, gap), (point, -normal, gap)


def _separated(own: tuple, own_size, theirs: tuple, size, last) -> jax.Array:
    """More than zero if one of the other row's faces, in both of its frames, parts the two rows.

    Vertices lie between their images on two links, and the other row's frame between its two.
    """
    (joint, *frames), (origin, *others) = own, theirs
    away, extent = joint - origin, (own_size[2], own_size[0], own_size[1])
    low, high = [], []
    for other in others:
        for axis in range(3):
            ends = []
            for frame in frames:
                tilt = [dot(other[axis], frame[k]) for k in range(3)]
                middle = tilt[2] * own_size[1]
                reach = total([jnp.abs(t) * e for t, e in zip(tilt, extent, strict=True)])
                ends.append((middle - reach, middle + reach))
            place = dot(other[axis], away)
            low.append(place + jnp.minimum(ends[0][0], ends[1][0]))
            high.append(place + jnp.maximum(ends[0][1], ends[1][1]))
    width, up, half = size[0], size[1], size[2]
    # Frame before: low[0:3]; frame behind: low[3:6].
    parted = [
        -half - high[0],
        jnp.where(last > 0, -half, low[3] - half),
        jnp.minimum(low[1], low[4]) - width,
        -width - jnp.maximum(high[1], high[4]),
        jnp.minimum(low[2], low[5]) - 2.0 * up,
        -jnp.maximum(high[2], high[5]),
    ]
    most = parted[0]
    for value in parted[1:]:
        most = jnp.maximum(most, value)
    return most


def _inside(vertex, own: tuple, theirs: tuple, size, last) -> tuple[tuple, tuple]:
    """Point, normal, gap, lever and share of a vertex in another finger's row, on either side.

    Args:
      vertex: Place, weight and share of the vertex.
      own: Joint of its row, and frames of the links before and behind it.
      theirs: The same of the other row.
      size: Half the width, the height and a segment of the other finger.
      last: Whether the other row is the last one, which ends at the tip's face.
    """
    point, image, weight, share = hull.placed(vertex, *own)
    point, image = point[:, 0], image[:, 0]
    joint, before, after = theirs
    half_width, half_height, half = size[0], size[1], size[2]
    away = point - joint
    first, second = (jnp.stack([dot(f[k], away) for k in range(3)]) for f in (before, after))
    # Between the planes across the middles of the two links.
    start, end = first[0] + half, half - second[0]
    whole = start + end
    along = jnp.where(whole > 0, start / jnp.where(whole > 0, whole, 1.0), 2.0)
    along = jnp.minimum(jnp.maximum(along, 0.0), 1.0)
    local = first + along * (second - first)
    turned = before + along * (after - before)
    edge = ROUND * jnp.minimum(half_width, half_height)
    depth = [
        jnp.abs(local[1]) - half_width + edge,
        jnp.abs(local[2] - half_height) - half_height + edge,
        jnp.where(last > 0, -end, -half) + edge,
    ]
    signs = [_sign(local[1]), _sign(local[2] - half_height), jnp.ones_like(along)]
    distance, slope = _rounded(depth)
    gap = distance - edge
    within = (start >= 0) & ((end > 0) | (last > 0)) & (whole > 0)
    gap = jnp.where(within, gap, 1.0)
    axes = (turned[1], turned[2], turned[0])
    normal = total([s * g * a for s, g, a in zip(signs, slope, axes, strict=True)])
    normal = normal / jnp.sqrt(jnp.maximum(dot(normal, normal), 1e-12))
    to_contact = -0.5 * gap * normal  # from the point on the skin
    lever = weight * (image + to_contact)
    behind = along * (apply_columns(after, local) + to_contact)
    at, gap, share = (point + to_contact)[:, None], gap[None, None], 0.5 * share
    mine = at, normal[:, None], gap, lever[:, None], share
    return mine, (at, -normal[:, None], gap, behind[:, None], share)


SUMS = 14
"""Numbers that `_add_vertex` sums: share, share x depth, and four vectors."""


def _add_vertex(sums: jax.Array, mine: tuple, other: tuple) -> jax.Array:
    """Adds a vertex of `_inside` to the sums of its row, each quantity weighted by its force."""
    point, normal, gap, lever, share = mine
    depth = jnp.maximum(-gap[0, 0], 0.0)
    share = jnp.where(depth > 0, share[0, 0], 0.0)
    force = share * depth
    vectors = [force * v[:, 0] for v in (normal, point, lever, other[3])]
    return sums + jnp.concatenate([share[None], force[None], *vectors])


def _pressure(sums: jax.Array) -> tuple[tuple, tuple]:
    """The contact of a row with another row, on either side: that of all its vertices inside.

    It has the vertices' resultant: their common stiffness, the sum of their forces, and the centre
    of pressure as its point, which moves as the mean of the vertices weighted by their forces.
    """
    share, force, normal = sums[0], sums[1], sums[2:5]
    some = force > 0
    whole = jnp.where(some, force, 1.0)
    # Vertices that push in different directions cancel in part: the resultant's length.
    size = jnp.sqrt(dot(normal, normal))
    pushes = some & (size > 0)
    normal = jnp.where(pushes, normal / jnp.where(pushes, size, 1.0), 0.0)
    gap = jnp.where(pushes, -size / jnp.where(some, share, 1.0), 1.0)[None, None]
    point, lever, behind = ((sums[k : k + 3] / whole)[:, None] for k in (5, 8, 11))
    normal, share = normal[:, None], share[None, None]
    return (point, normal, gap, lever, share), (point, -normal, gap, behind, share)


def _sign(x: jax.Array) -> jax.Array:
    return jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)


def _rounded(depth: list[jax.Array]) -> tuple[jax.Array, list[jax.Array]]:
    """Distance to a box from the depths behind its faces, and the slope in each of them."""
    outside = [jnp.maximum(d, 0.0) for d in depth]
    square = total([d * d for d in outside])
    is_out = square > 0
    length = jnp.sqrt(jnp.where(is_out, square, 1.0))
    deepest = jnp.maximum(jnp.maximum(depth[0], depth[1]), depth[2])
    nearest = [depth[0] >= deepest]
    nearest.append(~nearest[0] & (depth[1] >= deepest))
    nearest.append(~nearest[0] & ~nearest[1])
    faces = [n.astype(square.dtype) for n in nearest]
    slope = [jnp.where(is_out, d / length, f) for d, f in zip(outside, faces, strict=True)]
    return jnp.where(is_out, length, deepest), slope
