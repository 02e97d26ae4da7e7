"""Kinds of contact: which sides meet, and where and how deep, from the poses and numbers of both.

`KINDS` has a row for each pair of bodies.  The search (`sdf_collision`, `self_collision`) decides
which sides meet; `evaluate` says where, as a pure function of arrays, made of the stages that the
search evaluates with a test of the gap between them.  The reverse pass differentiates `power`, the
same for all kinds: the power of a contact's force along virtual accelerations, see `residual`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import objects
from codesign_jax.engines.structured.kernel.contact_list import cone_of, make_contacts
from codesign_jax.engines.structured.lanes import apply_columns, apply_rows, dot, sum_axis
from codesign_jax.engines.structured.laws import contact, holding, rings, shapes, surroundings
from codesign_jax.engines.structured.laws.cones import friction_by_contact, which_cone
from codesign_jax.engines.structured.laws.rings import Facing, Place, Ring, Segment
from codesign_jax.engines.structured.laws.touch import aim, ring_centre, ring_centres, touch
from codesign_jax.scene import Scene


class BodyMotion(NamedTuple):
    """Pose and motion of a link or the palm; world axes, about the object's centre."""

    origin: Any  # Place of the body's frame [m], shape (3, ...)
    frame: Any  # Columns of its orientation, shape (3, 3, ...)
    vel: Any  # Spatial velocity, shape (6, ...)
    link_acc: Any  # Spatial acceleration without velocity terms, same shape
    along: Any  # Virtual spatial acceleration, same shape


class CentreLine(NamedTuple):
    """What a segment of a finger's centre line needs beside the pose of its link."""

    origin: Any  # Place of the joint behind it [m], shape (3, ...)
    frames: tuple[Any, Any]  # Of the links before it and behind it, columns (3, 3, ...) each
    # Numbers of the ring whose section it has, see `SelfCollision.ring_at`; on the last segment
    # of the finger's last one, shape (8, ...)
    tip: Any
    first: Any = None  # Of that which the segment before it has, of a tapered finger


class Kind(NamedTuple):
    """A kind of contact.

    A side "rings", "disc", "segment" is a pair of a `BodyMotion` and further numbers; "object" and
    "surroundings" are among the numbers of a world.
    """

    sides: tuple[str, str]  # What meets what; the normal is from the second to the first
    # Names of the world's numbers and of the object's state that it depends on, of which some
    # scenes have not all; its cone's, and frictions of fixtures, come besides
    numbers: tuple[str, ...]
    # Place of k contacts from (scene, pair, first side, second side, numbers of the world, fixed);
    # `fixed` has what has no derivative, see `power`
    evaluate: Callable[..., Place]
    # Whose friction is held from step to step: that of a "contact" or of a "pairing" of fingers
    holds: str = ""


# Stages, which the search evaluates as well


def palm_distance(point: jax.Array, palm: tuple) -> tuple[jax.Array, jax.Array]:
    """Distance of points from the palm's disc and its gradient.

    Args:
      point: Points [m], shape (3, ...).
      palm: Origin, frame, and radius with half height of the disc, see `shapes.disc_distance`.
    """
    return shapes.disc_distance(point, *palm)


def above(origin, before, frame, numbers):
    """Where a finger's centre line passes a joint [m], shape (3, ...).

    Args:
      origin: Place of the joint.
      before: Frame of the link before the joint.
      frame: Frame of the link behind it.
      numbers: Numbers of the ring whose section the finger has there, shape (8, ...).
    """
    return origin + 0.5 * numbers[5] * (before[2] + frame[2])


def facing_line(numbers, frame, centre, other, t):
    """How rings face segments of a centre line, see `rings.facing_line`.

    Args:
      numbers: Numbers of the rings, shape (8, ...).
      frame: Frames of their links, columns (3, 3, ...).
      centre: Their centres [m], shape (3, ...).
      other: Ends and frames of the segments, a ring of their section, and 1 on last segments.
      t: Where on the segments their centres are nearest, see `rings.nearest`.
    """
    ends, frames, tip, last = other
    segment = Segment(ends, frames, jnp.stack([last * tip[3], tip[4], tip[5]]))
    return rings.facing_line(Ring.of(numbers), frame, centre, segment, t)


def place_of(numbers: jax.Array, frame: jax.Array, centre: jax.Array, facing: Facing) -> Place:
    """Contacts of rings with segments that they face, see `rings.place`."""
    return rings.place(Ring.of(numbers), frame, centre, facing)


def balls(numbers, centre, theirs, their_centre):
    """Contacts of spheres by their numbers (8, ...) and centres (3, ...)."""
    return rings.ball_on_ball(numbers[3] * numbers[6], centre, theirs[3] * theirs[6], their_centre)


def with_axis(place: Place) -> Place:
    """A place with an axis for the contacts of an item, of which there is one."""
    return Place(*(v[:, None] for v in place[:2]), *(v[None] for v in place[2:]))


def beside(places: list[Place]) -> Place:
    """Contacts with several fields, one behind the other along the axis of an item's contacts."""
    if len(places) == 1:
        return places[0]
    axes = 1, 1, 0, 0  # of the items, by field
    fields = zip(axes, zip(*places, strict=True), strict=True)
    return Place(*(jnp.concatenate(values, axis) for axis, values in fields))


# Evaluations


def look(scene: Scene, point: jax.Array, numbers: dict, fixed: dict, values: Any = None):
    """Distance of points (3, ...) from the object, and its gradient along the world's axes.

    Args:
      values: Distances at the corners of the cells of a mesh's grid in which the points lie.
    """
    local = shapes.in_object(numbers["columns"], point)
    fixed = fixed if values is None else fixed | {"values": values}
    distance, gradient = objects.distance_of(scene, local, numbers, fixed)
    return distance, apply_columns(numbers["columns"], gradient)


def second_look(scene: Scene, mine: tuple, numbers: dict, fixed: dict) -> jax.Array:
    """Where rings look at the object again, see `touch`, shape (3, k, ...)."""
    place, ring = mine
    centre = ring_centres(place.origin, place.frame, ring)
    first = look(scene, centre, numbers, fixed, fixed.get("values"))
    return centre + aim(ring, place.frame, *first)


def rings_on_object(scene: Scene, pair: str, mine: tuple, _, numbers: dict, fixed: dict) -> Place:
    """Rings, or spheres, of a link or the palm on the object."""
    place, ring = mine
    centre = ring_centres(place.origin, place.frame, ring)
    field = partial(look, scene, numbers=numbers, fixed=fixed)
    first = field(centre, values=fixed.get("values"))
    again = partial(field, values=fixed.get("values_again"))
    return touch(scene.effects.surface, ring, place.frame, centre, first, again)


def rings_on_surroundings(
    scene: Scene, pair: str, mine: tuple, _, numbers: dict, fixed: dict
) -> Place:
    """The same on the table and the fixtures, of which the table comes first."""
    place, ring = mine
    centre = ring_centres(place.origin, place.frame, ring)
    places = []
    for n, of_position in enumerate(surroundings.fields(scene)):
        field = partial(of_position, numbers["position"])
        plane = n < scene.effects.table
        surface = scene.effects.surface
        places.append(touch(surface, ring, place.frame, centre, field(centre), field, plane=plane))
    return beside(places)


def object_on_surroundings(
    scene: Scene, pair: str, mine: Any, _, numbers: dict, fixed: dict
) -> Place:
    """The object's points on table and fixtures that an item deals to the fingers' lanes."""

    def points(columns: jax.Array, height: jax.Array, fixture: int | None) -> jax.Array:
        """See `surroundings.object_places`; points of a mesh are those that the search has."""
        constants = fixed
        if "meshed" in fixed:
            constants = fixed | {"support": fixed[f"support_{fixture}"]}
        return objects.points_of(scene, numbers | {"columns": columns}, constants)

    def on_object(point: jax.Array, fixture: int) -> tuple[jax.Array, jax.Array]:
        return look(scene, point, numbers, fixed, fixed.get(f"values_{fixture}"))

    where = numbers["position"], numbers["columns"], fixed["object_id"]
    places = surroundings.object_places(scene, *where, points, on_object)
    values = (jnp.concatenate(v, -2) for v in zip(*places, strict=True))
    return with_axis(Place(*(_deal(scene, fixed, v) for v in values)))


def _deal(scene: Scene, fixed: dict, value: jax.Array) -> jax.Array:
    """The points (..., point, world) that the lanes have, zeros where they have none.

    Args:
      fixed: With the number of each lane's point, "point".
    """
    lane = jnp.zeros_like(value[..., 0, None, :]) + 0 * fixed["point"]
    for k in range(surroundings.slots(scene)):
        lane = jnp.where(fixed["point"] == k, value[..., k, None, :], lane)
    return lane


def ring_on_disc(
    scene: Scene, pair: str, mine: tuple, theirs: tuple, numbers: dict, fixed: dict
) -> Place:
    """A finger's ring or sphere on the palm's disc."""
    place, ring = mine
    palm, _ = theirs
    centre = ring_centre(place.origin, place.frame, ring)
    disc = partial(palm_distance, palm=(palm.origin, palm.frame, numbers["palm_disc"]))
    return with_axis(touch(scene.effects.surface, ring, place.frame, centre, disc(centre), disc))


def ring_on_segment(
    scene: Scene, pair: str, mine: tuple, theirs: tuple, numbers: dict, fixed: dict
) -> Place:
    """A ring on another finger's centre line or its own, or a sphere on another finger's sphere.

    Args:
      fixed: Whether the segment is the last one, "last", and where it may be touched at the most,
        "end".
    """
    place, ring = mine
    link, other = theirs
    centre = ring_centre(place.origin, place.frame, ring)
    if scene.effects.surface == "spheres":
        return with_axis(balls(ring, centre, other, ring_centre(link.origin, link.frame, other)))
    before, after = other.frames
    first = other.tip if other.first is None else other.first
    start = above(link.origin, before, link.frame, first)
    behind = above(other.origin, link.frame, after, other.tip)
    tip = ring_centre(link.origin, link.frame, other.tip)
    ends = start, jnp.where(fixed["last"] > 0, tip, behind)
    t = rings.nearest(centre, Segment(ends, None, None), fixed["end"])  # type: ignore[arg-type]
    segment = ends, (before, link.frame, after), other.tip, fixed["last"]
    faced = facing_line(ring, place.frame, centre, segment, t)
    return with_axis(place_of(ring, place.frame, centre, faced))


OBJECT = "columns", "object_vel", "object_size", "grid_origin", "grid_cell", "grid_factor"
_ON_OBJECT = Kind(("rings", "object"), OBJECT, rings_on_object, "contact")
_ON_TABLE = Kind(("rings", "surroundings"), ("position",), rings_on_surroundings, "contact")
_OBJECT_ON_TABLE = Kind(
    ("object", "surroundings"), (*OBJECT, "position"), object_on_surroundings, "contact"
)
_ON_SEGMENT = Kind(("rings", "segment"), (), ring_on_segment, "pairing")
KINDS = {
    "finger_object": _ON_OBJECT,
    "palm_object": _ON_OBJECT,
    "finger_table": _ON_TABLE,
    "palm_table": _ON_TABLE,
    "object_table": _OBJECT_ON_TABLE,
    "finger_finger": _ON_SEGMENT,
    "finger_itself": _ON_SEGMENT,
    "finger_palm": Kind(("rings", "disc"), ("palm_disc",), ring_on_disc),
}
"""The kinds by pairs of bodies."""


# Power


def power(
    scene: Scene,
    pair: str,
    mine: tuple,
    theirs: tuple,
    numbers: dict,
    held: dict,
    fixed: dict,
) -> jax.Array:
    """Power of an item's contacts along virtual accelerations [W], (...).

    With cotangents of the friction that they hold behind the step it has these times what they
    hold, so that one derivative is that of both.

    Args:
      scene: The scene.
      pair: Name of a kind in `KINDS`.
      mine: The first side, `theirs`: the second, see `Kind`; nothing for what is in `numbers`.
      numbers: The object's state and constants of the world, by name, among them the cone's.
      held: Friction that they hold, "held_friction": (3, k) of contacts, in the object's axes on
        the object, (3,) of a pairing; nothing where they hold none.
      fixed: What has no derivative: "share" of the contacts, zero of those that do not count, the
        object's accelerations, indices, values of grids, and "held_bar" or "sums_bar".
    """
    kind = KINDS[pair]
    place = kind.evaluate(scene, pair, mine, theirs, numbers, fixed)
    place = place._replace(share=jnp.where(fixed["share"] > 0, place.share, 0.0))
    contacts = make_contacts(place, _cone(scene, pair, place, numbers, fixed))
    vel, link_acc, along = (
        contacts.relative(m[:, None]) for m in _relative(kind, mine, theirs, numbers, fixed)
    )
    jar = link_acc - contacts.reference(vel)
    if not held:
        return sum_axis(dot(contact.constraint_update(contacts, jar).force, along), 0)
    of_contacts = kind.holds == "contact"
    friction = held["held_friction"] if of_contacts else held["held_friction"][:, None]
    axes = numbers["columns"] if pair.endswith("_object") else None
    in_world = friction if axes is None else apply_columns(axes, friction)
    jar = jar + holding.held(contacts, in_world)
    force = contact.constraint_update(contacts, jar).force
    after = holding.hold(contacts, force, in_world)
    if of_contacts:
        bars = fixed["held_bar"]
        after = holding.quotient(after)
        after = after if axes is None else apply_rows(axes, after)
    else:
        bars = fixed["sums_bar"][:, None]
    return sum_axis(dot(force, along), 0) + sum_axis(dot(bars, after), 0)


def _cone(scene: Scene, pair: str, place: Place, numbers: dict, fixed: dict) -> contact.Cone:
    """The cone of contacts, with a friction of each where the scene's fixtures have their own."""
    cone = cone_of(scene, numbers[f"cone.{which_cone(pair)}"])
    if not friction_by_contact(scene, pair):
        return cone
    count = place.gap.shape[0] // len(surroundings.fields(scene)) if pair != "object_table" else 1
    which = surroundings.touched(scene, pair, count)
    if pair == "object_table":
        friction = jnp.stack([numbers["friction"][i, 0] for i in which])
        return cone.of_friction(_deal(scene, fixed, friction)[None])
    return cone.of_friction(jnp.stack([numbers["friction"][i] for i in which]))


def _relative(kind: Kind, mine: tuple, theirs: tuple, numbers: dict, fixed: dict) -> list:
    """Velocity, acceleration and virtual acceleration of the first side from the second's."""
    obj = numbers.get("object_vel"), fixed.get("object_acc"), fixed.get("object_along")
    moves = {"object": obj, "surroundings": None}
    first, second = (
        moves[name] if name in moves else side[0][2:]
        for name, side in zip(kind.sides, (mine, theirs), strict=True)
    )
    assert first is not None
    if second is None:
        return list(first)
    return [a - b for a, b in zip(first, second, strict=True)]
