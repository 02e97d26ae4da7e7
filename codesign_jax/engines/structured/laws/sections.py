"""Where fingers meet: balls, and a vertex of one finger's hull in a section of another finger.

A row's section lies between the middles of two links; its frame turns from one link's to the
other's along the row.  It is the superellipse phi = (|y/a|^4 + |z/b|^4)^(1/4) < 1, with a cap over
the last half segment.  A point on one finger's outline is as deep in the other's section as
(1 - phi)/|grad phi|, to first order the distance to the outline, and is pushed against its own
outward normal, as by a pressure: the sum over the surface is then the pressure's buoyancy, which
for shallow overlaps is the overlap's volume and grows with the depth up to the axis, where no
direction flips.  Lane by lane, see `fingers`.
"""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import cross, dot, total
from codesign_jax.engines.structured.laws import hull, shapes
from codesign_jax.engines.structured.world_model import apply_columns, apply_rows

AXIS = 1e-3
"""Distance from a section's axis, over half its sides, below which the depth is constant."""


def apart(a: jax.Array, b: jax.Array) -> jax.Array:
    """Distance between two balls (centre, radius), (4, ...)."""
    away = a[:3] - b[:3]
    return jnp.sqrt(dot(away, away)) - (a[3] + b[3])


def between(a: jax.Array, b: jax.Array) -> tuple[tuple, tuple]:
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


def ball_on_palm(ball: jax.Array, palm: tuple) -> tuple[tuple, tuple]:
    """Point, normal and gap of a ball (centre, radius) on the palm, on either side.

    Args:
      ball: Centre and radius, shape (4, ...).
      palm: See `palm_distance`.
    """
    distance, normal = palm_distance(ball[:3], palm)
    gap = distance - ball[3]
    point = (ball[:3] - normal * (ball[3] + 0.5 * gap))[:, None]
    gap, normal = gap[None, None], normal[:, None]
    return (point, normal, gap), (point, -normal, gap)


def palm_distance(point: jax.Array, palm: tuple) -> tuple[jax.Array, jax.Array]:
    """Signed distance of a point from the palm's disc, and its gradient.

    Args:
      point: The point, shape (3, ...).
      palm: Place of the palm's frame, which is on the disc's underside, columns of its orientation,
        and radius and half the thickness of the disc.
    """
    place, frame, size = palm
    local = apply_rows(frame, point - place)
    distance, slope = shapes.cylinder(size, jnp.stack([local[0], local[1], local[2] - size[1]]))
    return distance, apply_columns(frame, slope)


def on_palm(vertex, own: tuple, palm: tuple) -> tuple[tuple, tuple]:
    """Point, normal, gap, lever and share of a vertex on the palm, on either side.

    Args:
      vertex: Place, weight and share of the vertex.
      own: Joint of its row, and frames of the links before and behind it.
      palm: See `palm_distance`.
    """
    point, image, weight, share = hull.placed(vertex, *own)
    gap, normal = palm_distance(point[:, 0], palm)
    to_contact = -0.5 * gap * normal
    lever = weight * (image[:, 0] + to_contact)
    at, gap = (point[:, 0] + to_contact)[:, None], gap[None, None]
    mine = at, normal[:, None], gap, lever[:, None], share
    return mine, (at, -normal[:, None], gap, jnp.zeros_like(lever)[:, None], share)


REACH = 0.006
"""Gap at a step's end, at the velocity of its beginning, below which a contact may act [m].

Fingers that come loose from rest move by half a centimetre in a step of 10 ms.
"""


def ahead(timestep: float, mine: tuple, vel: jax.Array) -> tuple[tuple, tuple]:
    """A contact that acts in the step that would carry it into what it touches.

    Args:
      timestep: Time step h [s].
      mine: Point, normal, gap, lever and share of a vertex on the moving side.
      vel: Motion of that side relative to the other, shape (9, ...).

    Returns:
      The same with the lower of the gap now and, at this velocity, at the step's end; and
      `Contacts.ahead`, both of shape (1, 1, ...).
    """
    point, normal, gap, lever, share = mine
    moving = vel[3:6] + cross(vel[:3], point[:, 0]) + cross(vel[6:], lever[:, 0])
    later = gap + timestep * dot(normal[:, 0], moving)
    seen = jnp.minimum(gap, 0.0), jnp.maximum(gap, 0.0) / timestep
    return (point, normal, jnp.minimum(gap, later), lever, share), seen


def fastest(ball: jax.Array, joint: jax.Array, vel: jax.Array) -> jax.Array:
    """Bound of the speed of a row's vertices, which lie in a ball [m/s].

    Args:
      ball: Centre and radius, shape (4, ...).
      joint: Place of the row's joint, shape (3, ...).
      vel: Motion of the row, shape (9, ...).
    """
    away = ball[:3] - joint
    moving = vel[3:6] + cross(vel[:3], ball[:3])
    reach = ball[3] + jnp.sqrt(dot(away, away))
    turning = ball[3] * jnp.sqrt(dot(vel[:3], vel[:3])) + reach * jnp.sqrt(dot(vel[6:], vel[6:]))
    return jnp.sqrt(dot(moving, moving)) + turning


def separated(own: tuple, own_size, theirs: tuple, size, last) -> jax.Array:
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


def ring_in_section(vertex, own: tuple, theirs: tuple) -> jax.Array:
    """Where a ring's points are in both frames of another finger's row: one affine map a frame.

    Points of a ring differ in two of their coordinates only, so that a point across and up from the
    joint has the coordinates map[:, 0] + across map[:, 1] + up map[:, 2].

    Args:
      vertex: Any point of the ring, see `inside`.
      own: Joint of its row, and frames of the links before and behind it.
      theirs: The same of the other row.

    Returns:
      The maps to the coordinates in the frame before and in that behind, shape (6, 3, ...).
    """
    (joint, before, after), (origin, *frames) = own, theirs
    weight = vertex[6]
    columns = [before[k] + weight * (after[k] - before[k]) for k in range(3)]
    start = joint - origin + vertex[0] * columns[0]
    rows = [[dot(f[k], v) for v in (start, *columns[1:])] for f in frames for k in range(3)]
    return jnp.stack([jnp.stack(row) for row in rows])


LEEWAY = 1e-5
"""How far outside a point has to be to be left out by `outside` [m]: far above rounding errors."""


def ring_outside(ring: jax.Array, own_size, size) -> jax.Array:
    """Whether all points of a ring are outside another finger's row, surely; see `outside`."""
    across, up = own_size[0], own_size[1]  # from the section's middle
    middle = [r[0] + up * r[2] for r in ring]
    reach = [across * jnp.abs(r[1]) + up * jnp.abs(r[2]) for r in ring]
    low = [m - r for m, r in zip(middle, reach, strict=True)]
    high = [m + r for m, r in zip(middle, reach, strict=True)]
    return _parted(low, high, size)


def outside(vertex, ring: jax.Array, size) -> jax.Array:
    """Whether a point of a ring is outside another finger's row, surely.

    Args:
      vertex: The point.
      ring: See `ring_in_section`.
      size: See `inside`.
    """
    place = [r[0] + vertex[1] * r[1] + vertex[2] * r[2] for r in ring]
    return _parted(place, place, size)


def _parted(low: list, high: list, size) -> jax.Array:
    """Whether a box in the frame before and one in the frame behind have no point in the row.

    A point's place in the row's section lies between its places in the two frames.
    """
    width, up, half = size[0], size[1], size[2]
    most = jnp.maximum(-half - high[0], low[3] - half)
    for k, least, largest in ((1, -width, width), (2, 0.0 * up, 2.0 * up)):
        most = jnp.maximum(most, jnp.minimum(low[k], low[3 + k]) - largest)
        most = jnp.maximum(most, least - jnp.maximum(high[k], high[3 + k]))
    return most > LEEWAY


def inside(vertex, own: tuple, theirs: tuple, size, last) -> tuple[tuple, tuple]:
    """Point, normal, gap, lever and share of a point in another finger's row, on either side.

    Args:
      vertex: Place, normal, weight and share of the point, see `hull.pair_vertices`.
      own: Joint of its row, and frames of the links before and behind it.
      theirs: The same of the other row.
      size: Half the width, the height and a segment of the other finger.
      last: Whether the other row is the last one, which ends in the tip's cap.
    """
    place = jnp.concatenate([vertex[:3], vertex[6:]])
    point, image, weight, share = hull.placed(place, *own)
    point, image, (_, *links) = point[:, 0], image[:, 0], own
    before, after = (apply_columns(link, vertex[3:6]) for link in links)
    normal = -((1.0 - weight) * before + weight * after)
    joint, before, after = theirs
    half = size[2]
    away = point - joint
    first, second = (jnp.stack([dot(f[k], away) for k in range(3)]) for f in (before, after))
    # Between the planes across the middles of the two links.
    start, end = first[0] + half, half - second[0]
    whole = start + end
    along = jnp.where(whole > 0, start / jnp.where(whole > 0, whole, 1.0), 2.0)
    along = jnp.minimum(jnp.maximum(along, 0.0), 1.0)
    local = first + along * (second - first)
    ahead = jnp.where(last > 0, jnp.maximum(second[0], 0.0), 0.0)
    sides = zip((ahead, local[1], local[2] - size[1]), (half, size[0], size[1]), strict=True)
    units = [
        (jnp.maximum(jnp.abs(x) / s, floor), s)
        for (x, s), floor in zip(sides, (0, AXIS, AXIS), strict=True)
    ]
    fourth = total([u * u * u * u for u, _ in units])
    phi = jnp.sqrt(jnp.sqrt(fourth))
    slope = jnp.sqrt(total([(u * u * u / s) ** 2 for u, s in units]))
    within = (start >= 0) & ((end > 0) | (last > 0)) & (whole > 0) & (phi < 1)
    gap = jnp.where(within, (phi - 1.0) * (phi * phi * phi / slope), 1.0)
    to_contact = -0.5 * gap * normal  # from the point on the skin
    lever = weight * (image + to_contact)
    behind = along * (apply_columns(after, local) + to_contact)
    at, gap, share = (point + to_contact)[:, None], gap[None, None], 0.5 * share
    mine = at, normal[:, None], gap, lever[:, None], share
    return mine, (at, -normal[:, None], gap, behind[:, None], share)


SUMS = 14
"""Numbers that `add_vertex` sums: share, share x depth, and four vectors."""


def add_vertex(sums: jax.Array, mine: tuple, other: tuple) -> jax.Array:
    """Adds a vertex of `inside` to the sums of its row, each quantity weighted by its force."""
    point, normal, gap, lever, share = mine
    depth = jnp.maximum(-gap[0, 0], 0.0)
    share = jnp.where(depth > 0, share[0, 0], 0.0)
    force = share * depth
    vectors = [force * v[:, 0] for v in (normal, point, lever, other[3])]
    return sums + jnp.concatenate([share[None], force[None], *vectors])


AHEAD = SUMS + 3
"""Numbers of `add_ahead`: `SUMS`, both of `Contacts.ahead` x share, and the lowest gap."""
TOUCH = 1e-6
"""Depth that a contact counts with which may act and does not reach the palm [m]."""


def half_of_row(vertex, mine: tuple, side) -> tuple:
    """A vertex of `ahead` as one of the half of its row on one side of the finger, -1 or 1.

    One contact a row would leave the finger free to roll, which the step after would see.
    """
    across = side * vertex[1]
    part = jnp.where(across > TOUCH, 1.0, jnp.where(across < -TOUCH, 0.0, 0.5))
    point, normal, gap, lever, share = mine
    return point, normal, jnp.where(part > 0, gap, 1.0), lever, part * share


def none_ahead(like: jax.Array) -> jax.Array:
    """Sums of no vertices, with the largest gap that a candidate may have."""
    zero = jnp.zeros_like(like)
    return jnp.stack([*[zero] * (AHEAD - 1), zero + REACH])


def part_ahead(mine: tuple, other: tuple, seen: tuple, lowest: jax.Array) -> jax.Array:
    """What a vertex of `ahead` adds to the sums: in the palm, or the nearest one where none is.

    Args:
      mine: The vertex on its own side.
      other: On the palm's.
      seen: `Contacts.ahead`.
      lowest: The lowest gap of all vertices, shape (...).
    """
    gap, share = mine[2][0, 0], mine[4][0, 0]
    depth = jnp.where(gap < 0, -gap, jnp.where(gap <= lowest, TOUCH, 0.0))
    place = *mine[:2], -depth[None, None], *mine[3:]
    none = jnp.zeros((SUMS, *gap.shape), gap.dtype)
    share = jnp.where(depth > 0, share, 0.0)
    more = jnp.stack([share * part[0, 0] for part in seen])
    return jnp.concatenate([add_vertex(none, place, other), more])


def add_ahead(sums: jax.Array, mine: tuple, other: tuple, seen: tuple) -> jax.Array:
    """As `add_vertex`, of a vertex of `ahead`."""
    before, gap = sums[-1], mine[2][0, 0]
    lowest = jnp.minimum(before, gap)
    kept = jnp.where((gap < before) & (before >= 0), 0.0, sums[:-1])
    return jnp.concatenate([kept + part_ahead(mine, other, seen, lowest), lowest[None]])


def add_to_halves(sums: tuple, vertex, mine: tuple, other: tuple, seen: tuple) -> tuple:
    """`add_ahead` of the two halves of a vertex's row, see `half_of_row`."""
    halves = (half_of_row(vertex, mine, side) for side in (-1, 1))
    return tuple(add_ahead(s, half, other, seen) for s, half in zip(sums, halves, strict=True))


def pressure_ahead(sums: jax.Array) -> tuple[tuple, tuple, tuple]:
    """As `pressure`, of the sums of `add_ahead`; and `Contacts.ahead`.

    The row's is the mean of its vertices, less as far as they push in different directions.
    """
    share, force, normal = sums[0], sums[1], sums[2:5]
    some = force > 0
    square = dot(normal, normal)
    pushes = some & (square > 0)
    agree = jnp.sqrt(jnp.where(pushes, square, 1.0)) / jnp.where(some, force * share, 1.0)
    seen = tuple((agree * part)[None, None] for part in sums[SUMS : SUMS + 2])
    return *pressure(sums[:SUMS]), seen


def pressure(sums: jax.Array) -> tuple[tuple, tuple]:
    """The contact of a row with another row, on either side: that of all its vertices inside.

    It has the vertices' resultant: their common stiffness, the sum of their forces, and the centre
    of pressure as its point, which moves as the mean of the vertices weighted by their forces.
    """
    share, force, normal = sums[0], sums[1], sums[2:5]
    some = force > 0
    whole = jnp.where(some, force, 1.0)
    # Vertices that push in different directions cancel in part: the resultant's length.
    square = dot(normal, normal)
    pushes = some & (square > 0)
    # The root of a number above zero: that of zero has no slope.
    size = jnp.sqrt(jnp.where(pushes, square, 1.0))
    normal = jnp.where(pushes, normal / size, 0.0)
    gap = jnp.where(pushes, -size / jnp.where(some, share, 1.0), 1.0)[None, None]
    point, lever, behind = ((sums[k : k + 3] / whole)[:, None] for k in (5, 8, 11))
    normal, share = normal[:, None], share[None, None]
    return (point, normal, gap, lever, share), (point, -normal, gap, behind, share)
