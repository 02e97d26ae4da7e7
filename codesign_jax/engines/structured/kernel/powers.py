"""Powers of the forces of a step along virtual accelerations: what its derivative is taken of.

The accelerations a of a step solve F(a, theta) = 0, see `transforms`; with virtual accelerations
lambda the derivative by theta is that of the scalar -lambda' F, a sum over links, contacts, palm
and object.  Here is what each of them adds, as a function of one link or of the contacts of one
item, over arrays as in `lanewise`, made of the functions that the forward pass calls.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import objects
from codesign_jax.engines.structured.kernel.contact_sets import cone_of, sphere_on_table
from codesign_jax.engines.structured.kernel.problem import make_body
from codesign_jax.engines.structured.kernel.slots import HullSet
from codesign_jax.engines.structured.kernel.step import link_forces, palm_and_object
from codesign_jax.engines.structured.lanes import dot, sum_axis
from codesign_jax.engines.structured.laws import contact, holding, hull, sections, shapes
from codesign_jax.engines.structured.laws.cones import which_cone
from codesign_jax.engines.structured.laws.contact import Contacts
from codesign_jax.engines.structured.linear.tree import next_motion, palm_motion
from codesign_jax.engines.structured.world_model import apply_columns
from codesign_jax.scene import Scene


class Chain(NamedTuple):
    """What the links of a finger inherit from one another.

    Attributes:
      origin: Place of the link's frame, shape (3, ...).
      frame: Columns of its orientation, shape (3, 3, ...).
      vel: Spatial velocity, shape (6, ...).
      bias: Spatial acceleration at zero joint acceleration, same shape.
      motion: Spatial acceleration without velocity terms, same shape.
      along: Virtual spatial acceleration, same shape.
    """

    origin: Any
    frame: Any
    vel: Any
    bias: Any
    motion: Any
    along: Any


class Place(NamedTuple):
    """A body with contacts: as `Chain`."""

    origin: Any
    frame: Any
    vel: Any
    motion: Any
    along: Any


class RowSide(NamedTuple):
    """A link as the vertices of a row of the hull follow it: as `Chain`."""

    frame: Any
    vel: Any
    motion: Any
    along: Any


def of_contacts(contacts: Contacts, vel: jax.Array, motion: jax.Array, along: jax.Array):
    """Power of contacts for relative motions, (6 or 9, ...), with an axis for the items."""
    jar = contacts.relative(motion) - contacts.reference(contacts.relative(vel))
    force = contact.constraint_update(contacts, jar).force
    return sum_axis(dot(force, contacts.relative(along)), 0)


def geometry(scene: Scene, name: str, centre, radius, at: dict, still: dict):
    """Point, normal and gap of points of the hand on the object or the table."""
    if not name.endswith("_object"):
        return sphere_on_table(at["height"], centre, radius)
    local = shapes.in_object(at["columns"], centre)
    distance, gradient = objects.distance_of(scene, local, at, still)
    point, normal, gap = shapes.on_surface(at["columns"], centre, radius, distance, gradient)
    return point, normal, gap[None]


def sphere_centre(place: Place, sphere: jax.Array) -> jax.Array:
    """Centres (3, k, ...) of a body's spheres."""
    return place.origin[:, None] + apply_columns(place.frame[:, :, None], sphere)


def of_spheres(
    scene: Scene, name: str, place: Place, sphere, radius, at: dict, still: dict
) -> jax.Array:
    """Power of the contacts of a link's or the palm's spheres.

    Args:
      scene: The scene.
      name: Pair of bodies, as in `problem.relative`.
      place: The body.
      sphere: Centres of its spheres in its frame, shape (3, k, ...).
      radius: Their radii, shape (k, ...).
      at: The object and the constants of the contacts, by name.
      still: What has no derivative here: accelerations, indices and values of grids.
    """
    point, normal, gap = geometry(scene, name, sphere_centre(place, sphere), radius, at, still)
    moves = _from_object(name, place[2:], at, still)
    return of_contacts(
        Contacts(point, normal, gap[0], _cone(scene, name, at)), *(m[:, None] for m in moves)
    )


def vertex_point(vertex, joint, before: RowSide, after: RowSide):
    """Place of a vertex of the hull, shape (3, 1, ...)."""
    return hull.placed(vertex, joint, before.frame, after.frame)[0]


def of_vertex(
    scene: Scene, name: str, vertex, joint, before: RowSide, after: RowSide, at: dict, still: dict
) -> jax.Array:
    """Power of a vertex of the hull.

    Args:
      scene: The scene.
      name: Pair of bodies, as in `problem.relative`.
      vertex: Place, weight and share, shape (5, ...).
      joint: Place of its row's joint.
      before: The link before it.
      after: The link behind it.
      at: As in `of_spheres`.
      still: As in `of_spheres`.
    """
    point, image, weight, share = hull.placed(vertex, joint, before.frame, after.frame)
    where, normal, gap = geometry(scene, name, point, 0.0, at, still)
    lever = hull.lever(weight, image, where, point)
    contacts = HullSet.contacts((where, normal, gap, lever, share), _cone(scene, name, at))
    first = _from_object(name, before[1:], at, still)
    turning = [b[:3] - a[:3] for a, b in zip(before[1:], after[1:], strict=True)]
    moves = [jnp.concatenate(m)[:, None] for m in zip(first, turning, strict=True)]
    return of_contacts(contacts, *moves)


def of_table(scene: Scene, fingers: int, item: int, at: dict, finger, still: dict) -> jax.Array:
    """Power of the object's points on the table that an item deals to the fingers' lanes.

    Args:
      scene: The scene.
      fingers: Fingers of a block.
      item: The item.
      at: As in `of_spheres`.
      finger: Number of each lane's finger.
      still: As in `of_spheres`, with the motions of the object.
    """
    arms = objects.points_of(scene, at, still)
    places = shapes.on_table(arms, at["height"])
    dealt = []
    for place in places:
        lane = jnp.zeros_like(place[..., 0, None, :]) + 0 * finger
        for k in range(item * fingers, min((item + 1) * fingers, 4)):
            lane = jnp.where(finger == k - item * fingers, place[..., k, None, :], lane)
        dealt.append(lane)
    point, normal, gap = dealt
    used = finger < 4 - item * fingers
    contacts = Contacts(
        point[:, None], normal[:, None], jnp.where(used, gap, 1.0)[None], _cone(scene, TABLE, at)
    )
    moves = at["object_vel"], still["object_motion"], still["object_along"]
    return of_contacts(contacts, *(m[:, None] for m in moves))


TABLE = "object_table"


def of_link(scene: Scene, chain: Chain, numbers: dict, joint: dict, still: dict):
    """What a link hands on, and its power.

    Args:
      scene: The scene.
      chain: What it inherits.
      numbers: See `Step.link_constants`.
      joint: Angles and velocities of the joint before it, and the chamber's pressure, by name.
      still: Accelerations and virtual accelerations of the joint, and the cotangent of the centre
        of mass.
    """
    after, found = link_forces(scene, chain[:5], numbers, joint | {"acc": still["acc"]})
    along = next_motion(chain.along, found["axes"], still["virtual"])
    body = make_body(numbers["mass"], found["body_centre"], found["tensor"])
    armature = found.get("armature_now", numbers["armature"])
    inertial = armature * still["acc"] - found["tau"]
    power = dot(body.times(after[4]) - found["smooth"], along) + dot(inertial, still["virtual"])
    return Chain(*after, along), dot(still["centre_bar"], found["body_centre"]) - power


def of_palm(timestep: float, state: dict, arm, constants: dict, still: dict) -> tuple:
    """Geometry and motions of palm and object, and the power of palm, wrist and object.

    Args:
      timestep: Time step [s].
      state: Positions and velocities of wrist and object, by name.
      arm: Commands of the arm frame.
      constants: See `Step.palm_constants`.
      still: Accelerations of wrist and object, and their virtual ones.
    """
    given = {name: still[name] for name in ("acc_wrist", "acc_object")}
    found = palm_and_object(timestep, state | given, arm, constants)
    palm, now, virtual = found["palm"], found["now"], still["virtual_wrist"]
    along = palm_motion(virtual, palm.axes)
    power = dot(palm.palm.times(now.palm_motion) - palm.smooth_palm, along)
    object_force = palm.object.times(now.object_motion) - palm.smooth_object
    power = power + dot(object_force, still["object_along"])
    power = power + dot(palm.armature * now.wrist - palm.smooth_wrist, virtual)
    place = Chain(
        found["place"], found["frame"], found["vel"], found["bias"], now.palm_motion, along
    )
    height = state["position"][2]
    return place, found["columns"], found["object_vel"], height, now.wrist, -power


def sphere_ball(place: Place, sphere, radius, which):
    """Centre and radius (4, ...) of one of a link's spheres; which: its number."""
    centre = place.origin + apply_columns(place.frame, _item(sphere, which))
    return jnp.concatenate([centre, _item(radius[None], which)])


def between_spheres(
    scene: Scene,
    mine: tuple[Place, Any, Any],
    theirs: tuple[Place, Any, Any],
    numbers: Any,
    which: tuple,
) -> jax.Array:
    """Power of two fingers' spheres on one another.

    Args:
      scene: The scene.
      mine: Link, and centres and radii of its spheres, on the lane's own side.
      theirs: The same of the other finger.
      numbers: Numbers of the cone.
      which: Number of the sphere on either link.
    """
    balls = sphere_ball(*mine, which[0]), sphere_ball(*theirs, which[1])
    one, other = sections.between(*balls)
    cone = cone_of(scene, numbers)
    ends = [Contacts(point, normal, gap[0], cone) for point, normal, gap in (one, other)]
    return _between(ends, mine[0][2:], theirs[0][2:])


def sphere_on_palm(scene: Scene, mine: tuple, palm: Place, size, numbers: Any, which) -> jax.Array:
    """Power of a finger's sphere on the palm.

    Args:
      scene: The scene.
      mine: Link, and centres and radii of its spheres.
      palm: The palm.
      size: Radius and half the thickness of its disc.
      numbers: Numbers of the cone.
      which: Number of the sphere on the link.
    """
    ball = sphere_ball(mine[0], mine[1], mine[2], which)
    cone = cone_of(scene, numbers)
    found = sections.ball_on_palm(ball, (*palm[:2], size))
    ends = [Contacts(point, normal, gap[0], cone) for point, normal, gap in found]
    return _between(ends, mine[0][2:], palm[2:])


def palm_sums(vertex, mine: tuple, palm: tuple) -> jax.Array:
    """What a vertex of a row adds to `sections.pressure` of the palm.

    Args:
      vertex: Place, weight and share of the vertex.
      mine: Joint of its row, and frames of the links before and behind it.
      palm: See `sections.palm_distance`.
    """
    none = jnp.zeros((sections.SUMS, *mine[0].shape[1:]), mine[0].dtype)
    return sections.add_vertex(none, *sections.on_palm(vertex, mine, palm))


def ahead_gap(timestep: float, vertex, mine: tuple, palm: tuple, vels: tuple, side):
    """The gap of a vertex of a half row as `sections.add_ahead` has it; see `ahead_sums`."""
    return _half_ahead(timestep, vertex, mine, palm, vels, side)[0][2][0, 0]


def ahead_sums(timestep: float, vertex, mine: tuple, palm: tuple, vels: tuple, side, lowest):
    """What a vertex of a half row adds to `sections.pressure_ahead`.

    Args:
      timestep: Time step [s].
      vertex: As in `palm_sums`.
      mine: As in `palm_sums`.
      palm: As in `palm_sums`.
      vels: Velocities of the links before and behind its joint and of the palm.
      side: Side of the half row, see `sections.half_of_row`.
      lowest: The lowest gap of the half row.
    """
    half, other, seen = _half_ahead(timestep, vertex, mine, palm, vels, side)
    return sections.part_ahead(half, other, seen, lowest + ROUNDING)


ROUNDING = 0.1 * sections.TOUCH
"""By how much the lowest gap may differ when it is computed again [m]."""


def _half_ahead(timestep: float, vertex, mine: tuple, palm: tuple, vels: tuple, side) -> tuple:
    own, other = sections.on_palm(vertex, mine, palm)
    own, seen = sections.ahead(timestep, own, hull.across(*vels))
    return sections.half_of_row(vertex, own, side), other, seen


def vertex_sums(vertex, mine: tuple, theirs: tuple, last) -> jax.Array:
    """What a vertex of the own row adds to `sections.pressure` of another finger's row.

    Args:
      vertex: Place, weight and share of the vertex.
      mine: Joint of its row, frames of the links before and behind it, and half sizes.
      theirs: The same of the other row.
      last: Whether the other row is the last one, see `sections.inside`.
    """
    *own, _ = mine
    *other, size = theirs
    none = jnp.zeros((sections.SUMS, *own[0].shape[1:]), own[0].dtype)
    return sections.add_vertex(none, *sections.inside(vertex, tuple(own), tuple(other), size, last))


def between_rows(scene: Scene, sums, mine: tuple, theirs: tuple, numbers, held: tuple = ()):
    """Power of a row on another finger's row, or the palm.

    Args:
      scene: The scene.
      sums: See `sections.pressure`.
      mine: Sides before and behind the row.
      theirs: The same of the other row.
      numbers: Numbers of the cone.
      held: What the fingers hold, see `holding.held`, and cotangents of the sums of
        `holding.hold`; nothing where they have no such state.
    """
    cone = cone_of(scene, numbers)
    ends = [HullSet.contacts(end, cone) for end in sections.pressure(sums)]
    return _between(ends, *_row_moves(mine, theirs), held)


def row_on_palm(scene: Scene, sums, mine: tuple, theirs: tuple, numbers):
    """As `between_rows`, of a half row on the palm ahead of touch."""
    cone = cone_of(scene, numbers)
    *places, seen = sections.pressure_ahead(sums)
    one, other = (HullSet.contacts(end, cone) for end in places)
    one = one._replace(ahead=tuple(part[0] for part in seen))
    return _between([one, other], *_row_moves(mine, theirs))


def _row_moves(mine: tuple, theirs: tuple) -> tuple[list, list]:
    """Velocity, acceleration and virtual acceleration of two rows, of nine components each."""
    one, other = (
        [hull.across(a, b, None) for a, b in zip(before[1:], after[1:], strict=True)]
        for before, after in (mine, theirs)
    )
    return one, other


def held_work(contacts: Contacts, force: jax.Array, grip: jax.Array, bars: jax.Array) -> jax.Array:
    """Cotangents of the sums of `holding.hold` times what contacts add to them."""
    return sum_axis(dot(bars[:, None], holding.hold(contacts, force, grip[:, None])), 0)


def _between(ends: list[Contacts], mine: Any, theirs: Any, held: tuple = ()) -> jax.Array:
    one, other = ends
    vel, motion, along = (
        one.relative(a[:, None]) - other.relative(b[:, None])
        for a, b in zip(mine, theirs, strict=True)
    )
    jar = motion - one.reference(vel)
    if not held:
        force = contact.constraint_update(one, jar).force
        return sum_axis(dot(force, along), 0)
    grip, bars = held
    force = contact.constraint_update(one, jar + holding.held(one, grip[:, None])).force
    return sum_axis(dot(force, along), 0) + held_work(one, force, grip, bars)


def _from_object(name: str, moves: Any, at: dict, still: dict) -> list:
    """Velocity, acceleration and virtual acceleration from the object's, if it is touched."""
    if not name.endswith("_object"):
        return list(moves)
    obj = at["object_vel"], still["object_motion"], still["object_along"]
    return [m - o for m, o in zip(moves, obj, strict=True)]


def _cone(scene: Scene, name: str, at: dict) -> contact.Cone:
    return cone_of(scene, at[f"cone.{which_cone(name)}"])


def _item(values: jax.Array, which: jax.Array) -> jax.Array:
    """The item of a number, of values (component, k, ...)."""
    found = values[:, 0]
    for k in range(1, values.shape[1]):
        found = jnp.where(which == k, values[:, k], found)
    return found
