"""The residual of a step along virtual accelerations: the scalar that its derivative is taken of.

The accelerations a of a step solve F(a, theta) = 0, see `transforms`; with virtual accelerations
lambda the derivative by theta is that of the scalar -lambda' F, a virtual power and a sum over
links, contacts, palm and object.  Here is what each of them adds, as a function of one link or of
the contacts of one item, over arrays as in `lanewise`, made of the functions that the forward pass
calls.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import objects, sdf_collision, self_collision
from codesign_jax.engines.structured.kernel.contact_sets import ContactSet, cone_of
from codesign_jax.engines.structured.kernel.friction_memory import behind, held_work
from codesign_jax.engines.structured.kernel.problem import make_body
from codesign_jax.engines.structured.kernel.step import (
    carried_momentum,
    link_forces,
    palm_and_object,
)
from codesign_jax.engines.structured.lanes import dot, sum_axis
from codesign_jax.engines.structured.laws import contact, holding, rings, shapes, surroundings
from codesign_jax.engines.structured.laws.cones import friction_by_contact, which_cone
from codesign_jax.engines.structured.laws.contact import Contacts
from codesign_jax.engines.structured.laws.kinematics import next_acceleration, palm_acceleration
from codesign_jax.engines.structured.laws.rings import Segment
from codesign_jax.engines.structured.laws.touch import aim, ring_centre, ring_centres, touch
from codesign_jax.engines.structured.world_model import apply_columns
from codesign_jax.model.held import EDGES, ROUND
from codesign_jax.scene import Scene


class LinkMotion(NamedTuple):
    """What the links of a finger inherit from one another."""

    origin: Any  # Place of the link's frame, shape (3, ...)
    frame: Any  # Columns of its orientation, shape (3, 3, ...)
    vel: Any  # Spatial velocity, shape (6, ...)
    bias: Any  # Spatial acceleration at zero joint acceleration, same shape
    link_acc: Any  # Spatial acceleration without velocity terms, same shape
    along: Any  # Virtual spatial acceleration, same shape


class FastMotion(NamedTuple):
    """What they inherit of what they carry over, see `inertia.carried_force`: as `LinkMotion`."""

    origin: Any
    frame: Any
    vel: Any
    along: Any


class Before(NamedTuple):
    """The same as the last step ended."""

    origin: Any
    frame: Any
    vel: Any


class BodyMotion(NamedTuple):
    """A body with contacts: as `LinkMotion`."""

    origin: Any
    frame: Any
    vel: Any
    link_acc: Any
    along: Any


def of_contacts(
    contacts: Contacts,
    vel: jax.Array,
    link_acc: jax.Array,
    along: jax.Array,
    hold: tuple = (),
) -> jax.Array:
    """Power of contacts for relative accelerations, (6, ...), with an axis for the items.

    Hold is what they hold of friction, the cotangents of what they hold behind the step, and the
    columns of the axes of both or None; nothing where they hold none.
    """
    jar = contacts.relative(link_acc) - contacts.reference(contacts.relative(vel))
    work = 0.0
    if hold:
        held_friction, bars, axes = hold
        held_in_world = held_friction if axes is None else apply_columns(axes, held_friction)
        jar = jar + holding.held(contacts, held_in_world)
        work = sum_axis(dot(bars, behind(contacts, jar, held_friction, axes)), 0)
    force = contact.constraint_update(contacts, jar).force
    return sum_axis(dot(force, contacts.relative(along)), 0) + work


def _held(name: str, held: dict, variables: dict, fixed: dict) -> tuple:
    """What `of_contacts` needs of the friction that a pair of bodies holds."""
    if not held:
        return ()
    axes = variables["columns"] if name.endswith("_object") else None
    return held["held"], fixed["held_bar"], axes


def look(scene: Scene, point, variables: dict, fixed: dict, values: Any = None):
    """Distance of points of the hand from the object, and its gradient, world axes."""
    local = shapes.in_object(variables["columns"], point)
    fixed = fixed if values is None else fixed | {"values": values}
    distance, gradient = objects.distance_of(scene, local, variables, fixed)
    return distance, apply_columns(variables["columns"], gradient)


def around(scene: Scene, variables: dict) -> list[Callable]:
    """Distance fields of table and fixtures: from points to distances and their gradients."""
    if not scene.fixture:
        return [partial(shapes.table_distance, variables["height"])]
    return [partial(field, variables["position"]) for field in surroundings.fields(scene)]


def of_rings(
    scene: Scene, name: str, place: BodyMotion, numbers, variables: dict, held: dict, fixed: dict
) -> jax.Array:
    """Power of the contacts of the rings, or spheres, of a link or the palm.

    Args:
      numbers: Numbers of its rings, see `rings.Ring`, shape (8, k, ...).
      variables: The object and the constants of the contacts, by name.
      held: What they hold of friction, "held"; nothing where they hold none.
      fixed: What has no derivative here: accelerations, indices and values of grids, cotangents of
        what they hold behind the step, and "share" of the contacts, which tells which are
        candidates.
    """
    centre = ring_centres(place.origin, place.frame, numbers)
    places = []
    on_object = name.endswith("_object")
    looks = (
        around(scene, variables)
        if not on_object
        else [partial(look, scene, variables=variables, fixed=fixed)]
    )
    for n, field in enumerate(looks):
        values = [{"values": fixed.get(k)} if on_object else {} for k in ("values", "values_again")]
        first = field(centre, **values[0])
        again = partial(field, **values[1])
        plane = not on_object and n < scene.effects.table  # the table comes first
        surface = scene.effects.surface
        touched = touch(surface, numbers, place.frame, centre, first, again, plane=plane)
        places.append(touched)
    candidates = sdf_collision.beside(places)
    candidates = candidates._replace(share=jnp.where(fixed["share"] > 0, candidates.share, 0.0))
    cone = _cone(scene, name, variables)
    if friction_by_contact(scene, name):
        which = surroundings.touched(scene, name, numbers.shape[1])
        cone = cone.of_friction(jnp.stack([variables["friction"][i] for i in which]))
    contacts = ContactSet.contacts(candidates, cone)
    moves = _from_object(name, place[2:], variables, fixed)
    hold = _held(name, held, variables, fixed)
    return of_contacts(contacts, *(m[:, None] for m in moves), hold=hold)


def second_look(
    scene: Scene, name: str, place: BodyMotion, numbers, variables: dict, fixed: dict
) -> jax.Array:
    """Where rings look at a field again, see `touch`, shape (3, k, ...)."""
    centre = ring_centres(place.origin, place.frame, numbers)
    first = look(scene, centre, variables, fixed, fixed.get("values"))
    return centre + aim(numbers, place.frame, *first)


def of_table(
    scene: Scene, fingers: int, item: int, variables: dict, held: dict, finger: Any, fixed: dict
) -> jax.Array:
    """Power of the object's points on the table that an item deals to the fingers' lanes.

    Finger is the number of each lane's finger; the rest is as in `of_rings`.
    """
    slots = surroundings.slots(scene)

    def deal(place: jax.Array) -> jax.Array:
        lane = jnp.zeros_like(place[..., 0, None, :]) + 0 * finger
        for k in range(item * fingers, min((item + 1) * fingers, slots)):
            lane = jnp.where(finger == k - item * fingers, place[..., k, None, :], lane)
        return lane

    point, normal, gap = map(deal, _of_object(scene, variables, fixed))
    used = (finger < slots - item * fingers) & (fixed["share"][0] > 0)
    cone = _cone(scene, TABLE, variables)
    if friction_by_contact(scene, TABLE):
        which = surroundings.touched(scene, TABLE, 1)
        rubs = jnp.stack([variables["friction"][i, 0] for i in which])
        cone = cone.of_friction(deal(rubs)[None])
    cone = cone.of_share(jnp.where(used, 1.0, 0.0)[None])
    contacts = Contacts(point[:, None], normal[:, None], gap[None], cone)
    moves = variables["object_vel"], fixed["object_acc"], fixed["object_along"]
    hold = _held(TABLE, held, variables, fixed)
    return of_contacts(contacts, *(m[:, None] for m in moves), hold=hold)


def _of_object(scene: Scene, variables: dict, fixed: dict) -> tuple:
    """Point, normal (3, slot, world) and gap of the object on table and fixtures."""
    places = []
    if scene.effects.table:
        places.append(
            shapes.on_table(objects.points_of(scene, variables, fixed), variables["height"])
        )
    flat = any(shape.type not in ROUND for shape in scene.objects.object)
    for j, fixture in enumerate(scene.fixture):
        position = variables["position"]
        _, rows = surroundings.towards(fixture, position)
        turned = variables | {"columns": surroundings.faced(rows, variables["columns"])}
        constants = fixed | {"support": fixed[f"support_{j}"]} if "meshed" in fixed else fixed
        arms = objects.points_of(scene, turned, constants)
        places.append(surroundings.object_on(fixture, position, rows[:, :, 0], arms))
        if flat and EDGES[fixture.type]:
            point = surroundings.edges(fixture, position)
            seen = look(scene, point, variables, fixed, fixed.get(f"values_{j}"))
            edge = surroundings.edge_on(point, *seen)
            places.append(tuple(v[..., 0, :] for v in edge))
    if len(places) == 1:
        return places[0]
    return tuple(jnp.concatenate(v, -2) for v in zip(*places, strict=True))


TABLE = "object_table"


def of_link(scene: Scene, chain: LinkMotion, numbers: dict, joint: dict, fixed: dict):
    """What a link hands on, and its power.

    Chain is what it inherits, `numbers` its constants; `fixed` has the accelerations and virtual
    accelerations of the joint, the order of its hinges, and the cotangent of the centre of mass.
    """
    joint = joint | {"acc": fixed["acc"], "order": fixed["order"]}
    after, stored = link_forces(scene, chain[:5], numbers, joint)
    along = next_acceleration(chain.along, stored["axes"], fixed["virtual"])
    body = make_body(numbers["mass"], stored["body_centre"], stored["tensor"])
    armature = stored.get("armature_now", numbers["armature"])
    inertial = armature * fixed["acc"] - stored["tau"]
    power = dot(body.times(after[4]) - stored["smooth"], along) + dot(inertial, fixed["virtual"])
    return LinkMotion(*after, along), dot(fixed["centre_bar"], stored["body_centre"]) - power


def of_fast_link(
    scene: Scene, now: FastMotion, before: Before, numbers: dict, joint: dict, fixed: dict
):
    """What a link hands on, and the power of the momentum that it carries over; see `of_link`."""
    joint = joint | {"order": fixed["order"]}
    after, behind, axes, force = carried_momentum(scene, now[:3], before, numbers, joint)
    along = next_acceleration(now.along, axes, fixed["virtual"])
    origin, frame, vel = after
    return FastMotion(origin, frame, vel, along), Before(*behind), dot(force, along)


def of_palm(timestep: float, state: dict, arm, constants: dict, fixed: dict) -> tuple:
    """Geometry and accelerations of palm and object, and the power of palm, wrist and object."""
    given = {name: fixed[name] for name in ("acc_wrist", "acc_object")}
    bodies = palm_and_object(timestep, state | given, arm, constants)
    palm = bodies["palm"]
    now = bodies["now"]
    virtual = fixed["virtual_wrist"]
    along = palm_acceleration(virtual, palm.axes)
    power = dot(palm.palm.times(now.palm_acc) - palm.smooth_palm, along)
    object_force = palm.object.times(now.object_acc) - palm.smooth_object
    power = power + dot(object_force, fixed["object_along"])
    power = power + dot(palm.armature * now.wrist - palm.smooth_wrist, virtual)
    place = LinkMotion(
        bodies["place"], bodies["frame"], bodies["vel"], bodies["bias"], now.palm_acc, along
    )
    height = state["position"][2]
    return place, bodies["columns"], bodies["object_vel"], height, now.wrist, -power


def on_palm(
    scene: Scene, mine: tuple[BodyMotion, Any], palm: BodyMotion, size, numbers
) -> jax.Array:
    """Power of a finger's ring or sphere, on a link, on the palm's disc of a size."""
    place, ring = mine
    centre = ring_centre(*place[:2], ring)
    on_disc = partial(self_collision.palm_distance, palm=(*palm[:2], size))
    contact_place = touch(
        scene.effects.surface, ring, place.frame, centre, on_disc(centre), on_disc
    )
    return _between(scene, contact_place, place[2:], palm[2:], numbers)


def between_spheres(scene: Scene, mine: tuple, theirs: tuple, numbers: Any) -> jax.Array:
    """Power of two fingers' spheres on one another: links, and the spheres' numbers."""
    first, second = (ring_centre(place.origin, place.frame, ring) for place, ring in (mine, theirs))
    contact_place = self_collision.balls(mine[1], first, theirs[1], second)
    return _between(scene, contact_place, mine[0][2:], theirs[0][2:], numbers)


class CentreLineSegment(NamedTuple):
    """A segment of a finger's centre line."""

    place: BodyMotion  # Its link
    origin: Any  # Place of the joint behind it
    frames: tuple[Any, Any]  # Of the links before it and behind it
    # Numbers of the ring whose section it has, see `SelfCollision.ring_at`; on the last segment
    # of the finger's last one.
    tip: Any
    first: Any = None  # Of that which the segment before it has, of a tapered finger


def between_rings(
    scene: Scene,
    mine: tuple[BodyMotion, Any],
    theirs: CentreLineSegment,
    numbers,
    held: tuple,
    fixed: dict,
) -> jax.Array:
    """Power of a ring on another finger, or its own.

    Args:
      mine: Link, and the ring's numbers; `theirs`: segment that it touches.
      held: What the fingers hold, see `holding.held`, and cotangents of the sums of
        `holding.hold`; nothing where they have no such state.
      fixed: Whether the segment is the last one, "last", and where it may be touched at the most,
        "end".
    """
    place, ring = mine
    link = theirs.place
    before, after = theirs.frames
    first = theirs.tip if theirs.first is None else theirs.first
    start = self_collision.above(link.origin, before, link.frame, first)
    behind = self_collision.above(theirs.origin, link.frame, after, theirs.tip)
    tip = ring_centre(link.origin, link.frame, theirs.tip)
    ends = start, jnp.where(fixed["last"] > 0, tip, behind)
    centre = ring_centre(*place[:2], ring)
    t = rings.nearest(centre, Segment(ends, None, None), fixed["end"])  # type: ignore[arg-type]
    other = ends, (before, link.frame, after), theirs.tip, fixed["last"]
    contact_place = self_collision.between(ring, place.frame, centre, other, t)
    return _between(scene, contact_place, place[2:], link[2:], numbers, held)


def _between(
    scene: Scene, contact_place: Any, mine: Any, theirs: Any, numbers: Any, held: tuple = ()
) -> jax.Array:
    contacts = ContactSet.contacts(self_collision.with_axis(contact_place), cone_of(scene, numbers))
    vel, link_acc, along = (
        contacts.relative((a - b)[:, None]) for a, b in zip(mine, theirs, strict=True)
    )
    jar = link_acc - contacts.reference(vel)
    if not held:
        force = contact.constraint_update(contacts, jar).force
        return sum_axis(dot(force, along), 0)
    held_friction, bars = held
    force = contact.constraint_update(
        contacts, jar + holding.held(contacts, held_friction[:, None])
    ).force
    return sum_axis(dot(force, along), 0) + held_work(contacts, force, held_friction, bars)


def _from_object(name: str, moves: Any, variables: dict, fixed: dict) -> list:
    """Velocity, acceleration and virtual acceleration from the object's, if it is touched."""
    if not name.endswith("_object"):
        return list(moves)
    obj = variables["object_vel"], fixed["object_acc"], fixed["object_along"]
    return [m - o for m, o in zip(moves, obj, strict=True)]


def _cone(scene: Scene, name: str, variables: dict) -> contact.Cone:
    return cone_of(scene, variables[f"cone.{which_cone(name)}"])
