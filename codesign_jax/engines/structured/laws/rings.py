"""Contact of fingers: rings with a support function, against distance fields and centre lines.

A finger is a chain of rings on its links.  A ring is a superellipsoid |x/e|^4 + |y/a|^4 + |z/b|^4
= 1 about its centre, b up and a across as the finger's section, e along it.  Its support
  h(m) = (|e m_x|^(4/3) + |a m_y|^(4/3) + |b m_z|^(4/3))^(3/4)
says how far it reaches in a direction m: faces, edges and all.  A depth d has the force of a
skin on the cap that the other side cuts off, F(d) = K w (l/w) a b G(d/h)/w^2 for a stiffness K, a
length l of the finger and its width w, and acts at the cap's centre.  A contact's stiffness is the
secant F(d)/d at the step's beginning, with d no less than `NOMINAL`.

All functions take components in front and any axes behind; frames are columns (3, 3, ...).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import apply_columns, apply_rows, cross, dot, total
from codesign_jax.scene import section_growth

NOMINAL = 0.5e-3
"""Least depth of which a contact has the stiffness, also before it touches [m]."""
FADE = 1e-3
"""Distance of two centre lines at which their contact has lost 3 parts in 10 of its force [m]."""
SMALL = 1e-18
"""Least square of a length [m^2], of which a root still has a slope."""
FLOOR = 1e-6
"""Of squares of numbers up to one, where the slope of a root would have none."""
RING_OVERLAP = 0.6
"""Half axis e of a ring along the finger over its part of the finger's length; with 0.5 rings would
meet in their tips and leave gaps between their sides [ours]."""


class Ring(NamedTuple):
    """Rings on a link."""

    centre: jax.Array  # In the link's frame [m], shape (3, ...)
    half: jax.Array  # Half axes e, a and b [m], shape (3, ...)
    # Length of the finger that it stands for, in widths; 0 where there is no ring
    length: jax.Array
    tip: jax.Array  # 1 of the last ring of a finger, else 0

    @classmethod
    def of(cls, numbers: jax.Array) -> "Ring":
        return cls(numbers[:3], numbers[3:6], numbers[6], numbers[7])


def growth_factors(growth: jax.Array, pressure: jax.Array) -> jax.Array:
    """Height and width of sections over those without pressure, shape (2, ...).

    Args:
      growth: How they grow, `section_growth.Growth`, shape (4, ...).
      pressure: Gauge pressure of the sections' chambers [Pa].
    """
    of_section = section_growth.Growth(*jnp.unstack(growth))
    return jnp.stack(section_growth.factors(of_section, pressure))


def grown(numbers: jax.Array, factors: jax.Array) -> jax.Array:
    """Numbers of rings (8, ...) whose sections have these times their height and width, (2, ...).

    The side of the fabric stays where it is, so that the centre rises; and a square of skin is as
    wide as the finger.
    """
    height, width = factors
    x, y, z, e, a, b, length, tip = jnp.unstack(numbers)
    return jnp.stack([x, y, height * z, e, width * a, height * b, length / width, tip])


class Segment(NamedTuple):
    """A stretch of a finger's centre line on one link."""

    ends: tuple[jax.Array, jax.Array]  # Where it begins and ends [m], shape (3, ...) each
    # Of the link before it, of its own and of the next one
    frames: tuple[jax.Array, jax.Array, jax.Array]
    half: jax.Array  # Half axes of its sections; the first is that of the tip, 0 before it


class Place(NamedTuple):
    """A contact."""

    point: jax.Array  # Where it acts [m], shape (3, ...)
    normal: jax.Array  # From the other side to the ring, shape (3, ...)
    gap: jax.Array  # Negative in contact [m], shape (...)
    share: jax.Array  # Its stiffness over that of its pair of bodies, same shape


ROOT_BITS = 1_419_910_442
"""The bits of a float32's inverse cube root are about this number less a third of its own bits.

The bits of a positive float32, read as an integer, are 2^23 times the sum of its binary logarithm
and 127, but for 0.09 at most.  Hence 4/3 of the bits of 1, less 5.6e5 so that the largest errors to
both sides are alike.
"""


@jax.custom_jvp
def inverse_cube_root(x: jax.Array) -> jax.Array:
    """x^(-1/3) of numbers from 1e-9 to 10.

    In float32 by Newton's method for the root of y^-3 - x, which needs no division, from a guess
    within 4 %: three steps leave 2e-7.  In float64 by Halley's method from the fourth root.
    """
    if x.dtype != jnp.float32:
        y = 0.6 * jnp.sqrt(jnp.sqrt(x))
        for _ in range(4):
            cube = y * y * y
            y = y * (cube + 2.0 * x) / (2.0 * cube + x)
        return 1.0 / y
    bits = jax.lax.bitcast_convert_type(x, jnp.int32).astype(x.dtype)
    guess = (ROOT_BITS - bits * (1.0 / 3.0)).astype(jnp.int32)
    y = jax.lax.bitcast_convert_type(guess, x.dtype)
    third = x * (1.0 / 3.0)
    for _ in range(3):
        y = y * (4.0 / 3.0 - third * (y * y * y))
    return y


@inverse_cube_root.defjvp
def _inverse_cube_root_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    (x,) = primals
    (dx,) = tangents
    y = inverse_cube_root(x)
    return y, -y / (3.0 * x) * dx


def cube_root(x: jax.Array) -> jax.Array:
    """See `inverse_cube_root`."""
    y = inverse_cube_root(x)
    return x * (y * y)


def support(half: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Support (...), and half axes times the direction over it (3, ...).

    Args:
      half: Half axes, shape (3, ...).
      direction: Unit vector in the ring's frame, shape (3, ...).
    """
    along = half * direction
    largest = jnp.sqrt(dot(along, along) + SMALL)
    unit = along * (1.0 / largest)
    squares = [u * u + FLOOR for u in jnp.unstack(unit)]
    # Of the sum of |u|^(4/3)
    root = jnp.sqrt(total([s * inverse_cube_root(s) for s in squares]))
    reach = root * jnp.sqrt(root)
    return largest * reach, unit * (1.0 / reach)


def cap(unit: jax.Array, u: jax.Array) -> jax.Array:
    """Area of the part of |y|^4 + |z|^4 = 1 beyond a line at 1 - u of its support.

    A fit [ours] within 10 % of the area by quadrature, see docs/hull.md: a face's law, whose
    direction is an axis, and an edge's, whose direction is a diagonal, by t from 0 to 1 in between.
    """
    root = jnp.sqrt(u)
    y, z = (jnp.sqrt(v * v + FLOOR) for v in (unit[1], unit[2]))
    t = jnp.minimum(y, z) / jnp.maximum(y, z)
    face = 2.26 * u * jnp.sqrt(root) * (1.0 - 0.11 * u)
    edge = 1.56 * u * root * (1.0 + 0.1 * u)
    turn = t * cube_root(u) / (0.5 * u)
    return edge + (face - edge) / (1.0 + turn * turn)


def stiffness(ring: Ring, reach: jax.Array, unit: jax.Array, axial: jax.Array, gap: jax.Array):
    """Contact stiffness over the scene's at a gap (...), see `Place.share`.

    Args:
      reach: Its support, and `unit` what else `support` returns.
      axial: Component along the finger of the direction to the other side; the tip's end is flat.
    """
    depth = jnp.maximum(-gap, NOMINAL)
    u = jnp.minimum(depth / reach, 1.0)
    _, a, b = jnp.unstack(ring.half)
    side = 0.5 * ring.length * b * cap(unit, u) / depth
    end = 0.65 * b / a * jnp.sqrt(u)
    ahead = ring.tip * jnp.maximum(axial, 0.0) ** 2
    return jnp.where(ring.length > 0, side + ahead * (end - side), 0.0)


def arm(ring: Ring, reach: jax.Array, unit: jax.Array, gap: jax.Array) -> jax.Array:
    """Centre of the cap from the ring's centre, in its frame, shape (3, ...)."""
    root = jnp.sqrt(jnp.minimum(jnp.maximum(-gap, 0.0) / reach, 1.0) + 1e-6)
    spread = 1.15 * root * jnp.sqrt(root)
    return ring.half * unit * inverse_cube_root(unit * unit + spread * spread)


def section_normal(half: jax.Array, local: jax.Array) -> jax.Array:
    """Outward normal of a section where a ray in its plane leaves it, shape (3, ...).

    Args:
      half: Half axes.
      local: Direction of the ray in the section's frame, of any length, shape (3, ...).
    """
    y = local[1] / half[1]
    z = local[2] / half[2]
    largest = jnp.maximum(jnp.maximum(jnp.abs(y), jnp.abs(z)), 1e-6)
    y = (y / largest) ** 3 / half[1]
    z = (z / largest) ** 3 / half[2]
    size = jnp.sqrt(y * y + z * z + SMALL)
    return jnp.stack([jnp.zeros_like(y), y / size, z / size])


def farthest(half: jax.Array) -> jax.Array:
    """Distance of a ring's farthest point from its centre [m], shape (...)."""
    square = half * half
    return jnp.sqrt(jnp.sqrt(dot(square, square)))


class Facing(NamedTuple):
    """How a ring faces another body; in a kernel its fields are lanes."""

    normal: jax.Array  # From the other side to the ring, shape (3, ...)
    gap: Any  # Negative in contact [m], shape (...)
    reach: jax.Array  # The ring's support towards the other side, and below what else
    unit: jax.Array  # `support` returns, shape (3, ...)
    axial: jax.Array  # Component along the finger of the direction to the other side
    yields: jax.Array  # Fraction of the depth by which this side yields
    fade: jax.Array  # Fraction of the stiffness that is left


def place(ring: Ring, frame: jax.Array, centre: jax.Array, facing: Facing) -> Place:
    """A ring's contact with the body that it faces."""
    normal, gap, reach, unit, axial, yields, fade = facing
    share = stiffness(ring, reach, unit, axial, yields * gap) * fade
    point = centre + apply_columns(frame, arm(ring, reach, unit, gap)) - 0.5 * gap * normal
    return Place(point, normal, gap, share)


# Against distance fields


def aim(ring: Ring, frame: jax.Array, distance: jax.Array, gradient: jax.Array) -> jax.Array:
    """From a ring's centre to where the field is looked at once more, shape (3, ...).

    The nearest point is seen from a place behind it along the section's own normal: from the centre
    flat faces would be pushed along the line to the nearest edge.

    Args:
      gradient: Unit gradient there, world axes.
    """
    local = apply_rows(frame, -jnp.maximum(distance, 0.0) * gradient)
    normal = section_normal(ring.half, local)
    length = jnp.sqrt(local[1] ** 2 + local[2] ** 2 + SMALL)
    away = jnp.stack([0.0 * length, local[1] - length * normal[1], local[2] - length * normal[2]])
    moves = (distance > 0) & (ring.tip < 0.5)
    return apply_columns(frame, jnp.where(moves, away, 0.0))


def facing_field(
    ring: Ring, frame: jax.Array, offset: jax.Array, distance: jax.Array, normal: jax.Array
) -> Facing:
    """How a ring faces what a distance field describes; arguments as `on_field`."""
    toward = -apply_rows(frame, normal)
    reach, unit = support(ring.half, toward)
    gap = distance - dot(normal, offset) - reach
    ones = jnp.ones_like(gap)
    return Facing(normal, gap, reach, unit, toward[0], ones, ones)


def on_field(
    ring: Ring,
    frame: jax.Array,
    centre: jax.Array,
    offset: jax.Array,
    distance: jax.Array,
    normal: jax.Array,
) -> Place:
    """A ring's contact with what a distance field describes.

    Args:
      offset: See `aim`; any where the field is that of a plane.
      normal: Its unit gradient there, world axes.
    """
    return place(ring, frame, centre, facing_field(ring, frame, offset, distance, normal))


def ball_on_field(
    radius: jax.Array, centre: jax.Array, distance: jax.Array, normal: jax.Array
) -> Place:
    """The round case of `on_field`."""
    gap = distance - radius
    share = jnp.where(radius > 0, jnp.ones_like(gap), 0.0)
    return Place(centre - normal * (radius + 0.5 * gap), normal, gap, share)


# Against centre lines


def nearest(point: jax.Array, segment: Segment, last: jax.Array | float = 1.0) -> jax.Array:
    """Where between its ends, 0 to 1 or `last`, a segment is nearest to a point, shape (...)."""
    start, end = segment.ends
    along = end - start
    return jnp.minimum(jnp.maximum(dot(point - start, along) / dot(along, along), 0.0), last)


def on_line(segment: Segment, t: jax.Array) -> jax.Array:
    start, end = segment.ends
    return start + t * (end - start)


def section_frame(segment: Segment, t: jax.Array) -> jax.Array:
    """Frame of the section there: it turns from one link's middle to the next one's."""
    before, link, after = segment.frames
    aside = t - 0.5
    other = jnp.where(aside < 0, before, after)
    mean = link + jnp.abs(aside) * (other - link)
    x = mean[0] / jnp.sqrt(dot(mean[0], mean[0]))
    y = mean[1] - dot(mean[1], x) * x
    y = y / jnp.sqrt(dot(y, y))
    return jnp.stack([x, y, cross(x, y)])


def facing_line(
    ring: Ring, frame: jax.Array, centre: jax.Array, segment: Segment, t: jax.Array
) -> Facing:
    """How a ring faces another finger, or its own; arguments as `between`.

    The normal is the mean of both sections' own, where the line between the centres leaves them;
    along a finger, as at its ends, it is that line.
    """
    other = section_frame(segment, t)
    away = centre - on_line(segment, t)
    apart = jnp.sqrt(dot(away, away) + SMALL)
    line = away / apart
    normal = jnp.zeros_like(away)
    for axes, half, side in ((frame, ring.half, -1.0), (other, segment.half, 1.0)):
        bulge = apply_columns(axes, side * section_normal(half, side * apply_rows(axes, away)))
        along = dot(line, axes[0]) ** 2
        normal = normal + bulge + along * (line - bulge)
    normal = normal / jnp.sqrt(dot(normal, normal) + SMALL)
    toward = -apply_rows(frame, normal)
    back = apply_rows(other, normal)
    beyond = jnp.where((t >= 1.0) & (back[0] > 0), segment.half[0], 0.0)
    theirs, _ = support(jnp.stack([beyond, segment.half[1], segment.half[2]]), back)
    reach, unit = support(ring.half, toward)
    gap = dot(normal, away) - reach - theirs
    # Both sides yield by half of the depth.
    return Facing(normal, gap, reach, unit, toward[0], 0.5 * jnp.ones_like(gap), _fade(apart))


def between(
    ring: Ring, frame: jax.Array, centre: jax.Array, segment: Segment, t: jax.Array
) -> Place:
    """A ring's contact with another finger, or with its own; the other side's rings look for none.

    Args:
      t: Where that is nearest to the ring's centre, see `nearest`.
    """
    return place(ring, frame, centre, facing_line(ring, frame, centre, segment, t))


def _fade(apart: jax.Array) -> jax.Array:
    """What is left of a force where two centre lines come together, whose normal has no sense."""
    return apart / jnp.sqrt(apart * apart + FADE * FADE)


def ball_on_ball(
    radius: jax.Array, centre: jax.Array, their_radius: jax.Array, their_centre: jax.Array
) -> Place:
    """Contact of two balls; concentric ones have MuJoCo's normal, the x axis."""
    away = centre - their_centre
    square = dot(away, away)
    apart = square > 0
    length = jnp.sqrt(jnp.where(apart, square, 1.0))
    ones = jnp.ones_like(square)
    normal = jnp.where(apart, away / length, jnp.stack([-ones, 0 * ones, 0 * ones]))
    gap = jnp.where(apart, length, 0.0) - radius - their_radius
    some = jnp.where((radius > 0) & (their_radius > 0), ones, 0.0)
    return Place(centre - normal * (radius + 0.5 * gap), normal, gap, some)
