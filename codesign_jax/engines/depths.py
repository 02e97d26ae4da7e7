"""Where and how deep bodies touch, over arrays of all worlds: for checks before a start.

A kernel finds contacts link by link, where one can be compiled; here the same laws are called on
whole arrays, for every engine and device.
"""

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.coordinates import reset
from codesign_jax.engines.structured.kernel import kinds, self_collision
from codesign_jax.engines.structured.lanes import apply_columns, once
from codesign_jax.engines.structured.laws import rings, shapes, surroundings
from codesign_jax.engines.structured.laws.kinematics import Kinematics, straight
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.engines.structured.laws.touch import ring_centre, touch
from codesign_jax.engines.structured.world_model import WorldModel, world_constants
from codesign_jax.model import ModelFields
from codesign_jax.model.held import rings_of_link
from codesign_jax.model.layout import first_on_palm, palm_touches
from codesign_jax.scene import Scene

Look = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""From points to their distance from a body and its gradient, see `laws.touch`."""


def largest_depth(scene: Scene, fields: ModelFields) -> jax.Array:
    """Deepest overlap of two bodies that may touch [m], shape (world,); fingers are straight."""
    others = jnp.maximum(depth_between(scene, fields), depth_in_palm(scene, fields))
    return jnp.maximum(depth(scene, fields), others)


@partial(jax.jit, static_argnums=0)
def depth(scene: Scene, fields: ModelFields) -> jax.Array:
    """Deepest overlap of a finger, the palm or the object with another of them or the table [m].

    The structured engine's contacts serve every engine: same spheres, shapes and pairs.  Fingers
    are straight; how deep they stand in one another says `depth_between`.
    """
    alone = dataclasses.replace(scene.effects, finger_finger=False)
    hand, kin, position = _straight(scene, fields)
    scene = dataclasses.replace(scene, effects=alone)
    every = places(scene, hand, kin, position)
    depths = [(-place.gap).reshape(-1, place.gap.shape[-1]).max(0) for place in every.values()]
    if not depths:
        return jnp.zeros_like(fields.object_mass)
    return jnp.stack(depths).max(0)


def depth_by_pair(scene: Scene, fields: ModelFields) -> dict[str, jax.Array]:
    """Deepest overlap [m] by pair of bodies, shape (world,), of fingers (finger, world)."""
    hand, kin, position = _straight(scene, fields)
    by_pair = {}
    for name, place in places(scene, hand, kin, position).items():
        rows = place.gap.shape[-2:] if name.startswith("finger") else place.gap.shape[-1:]
        by_pair[name] = (-place.gap).reshape(-1, *rows).max(0)
    by_pair["finger_finger"] = depth_between(scene, fields)
    by_pair["finger_palm"] = depth_in_palm(scene, fields)
    return by_pair


@partial(jax.jit, static_argnums=0)
def depth_between(scene: Scene, fields: ModelFields) -> jax.Array:
    """Deepest overlap of two straight fingers that may touch [m], shape (world,).

    As spheres around the links' middles, as high as the section: the vertices of two hulls in one
    and the same place would not stand inside one another.
    """
    worlds = fields.start.shape[0]
    count = scene.num_fingers
    if not scene.effects.finger_finger or count == 1:
        return jnp.full((worlds,), -jnp.inf, fields.start.dtype)
    hand, kin, _ = _straight(scene, fields)
    along, across, up = jnp.moveaxis(hand.centre, 1, 0)
    if hand.growth is not None:
        up = up * _first_growth(hand)[0]
    centre = jnp.stack([along, across, up])
    middle = kin.origin + apply_columns(kin.link, centre)
    deepest = []
    for a, b in itertools.combinations(range(count), 2):
        away = middle[:, :, None, a] - middle[:, None, :, b]
        reach = up[:, None, a] + up[None, :, b]
        deepest.append((reach - jnp.sqrt((away**2).sum(0))).reshape(-1, worlds).max(0))
    return jnp.stack(deepest).max(0)


@partial(jax.jit, static_argnums=0)
def depth_in_palm(scene: Scene, fields: ModelFields) -> jax.Array:
    """Deepest overlap of a straight finger with the palm's disc [m], shape (world,).

    By the rings or spheres that touch it in a simulation, of those that may.
    """
    if not scene.effects.finger_palm:
        return jnp.full((fields.start.shape[0],), -jnp.inf, fields.start.dtype)
    hand, kin, _ = _straight(scene, fields)
    return _depth_of_rings(scene, hand, kin)


@partial(jax.jit, static_argnums=0)
def _straight(scene: Scene, fields: ModelFields) -> tuple[WorldModel, Kinematics, jax.Array]:
    """Worlds with straight fingers, and the place of the object's centre, (3, 1, world)."""
    state = reset(scene, fields)
    hand = world_constants(scene, fields)
    return hand, straight(hand, state), state.position


def places(
    scene: Scene, hand: WorldModel, kin: Kinematics, position: jax.Array
) -> dict[str, Place]:
    """Places of the contacts with object, table and fixtures that the scene has, by pair of bodies.

    Items of fingers are (link, ring of the link, finger), of the others (item,); several fields are
    one behind the other.

    Args:
      position: The object's centre, shape (3, 1, world).
    """
    effects = scene.effects
    on_object = partial(_object_distance, scene, hand, kin)
    around = [partial(field, position) for field in surroundings.fields(scene)]
    by_pair = {}

    def add(name: str, numbers: jax.Array, origin: jax.Array, frame: jax.Array) -> None:
        looks = around if name.endswith("_table") else [on_object]
        if not getattr(effects, name) or not looks:
            return
        centre = ring_centre(origin, frame, numbers)
        axis = int(name.startswith("finger"))
        by_pair[name] = _joined([_touch(scene, x, numbers, frame, centre) for x in looks], axis)

    if count := rings_of_link(scene):
        numbers = _first_rings(hand, count)
        numbers = jnp.moveaxis(numbers.reshape(-1, count, *numbers.shape[1:]), 2, 0)
        for name in ("finger_object", "finger_table"):
            add(name, numbers, kin.origin[:, :, None], kin.link[:, :, :, None])
    if palm_touches(scene):
        assert hand.palm_ring is not None
        numbers = jnp.moveaxis(hand.palm_ring[:, :, 0], 1, 0)
        for name in ("palm_object", "palm_table"):
            add(name, numbers, kin.place, kin.palm)
    if effects.object_table and surroundings.slots(scene):
        by_pair["object_table"] = _joined(_of_object(scene, hand, kin, position, on_object), 0)
    return by_pair


def _first_rings(hand: WorldModel, k: int) -> jax.Array:
    """Numbers of the fingers' rings or spheres as a grasp begins, see `WorldModel.ring`.

    Args:
      k: Rings or spheres of a link.
    """
    numbers = hand.ring
    assert numbers is not None
    if hand.growth is None:
        return numbers
    factors = _first_growth(hand)
    if factors.shape[1] > 1:
        factors = jnp.repeat(factors, k, axis=1)
    return jnp.moveaxis(once(rings.grown, jnp.moveaxis(numbers, 1, 0), factors), 0, 1)


def _first_growth(hand: WorldModel) -> jax.Array:
    """Height and width of sections as a grasp begins over those without pressure.

    Shape (2, section, finger, world).
    """
    assert hand.growth is not None and hand.first_pressure is not None
    return once(rings.growth_factors, jnp.moveaxis(hand.growth, 1, 0), hand.first_pressure[None])


def _depth_of_rings(scene: Scene, hand: WorldModel, kin: Kinematics) -> jax.Array:
    """Deepest overlap with the palm's disc of rings or spheres that may touch it [m], (world,)."""
    assert hand.palm_disc is not None
    k = rings_of_link(scene)
    first = (first_on_palm(scene.discretization.links) - 1) * k
    numbers = jnp.moveaxis(_first_rings(hand, k), 1, 0)
    numbers = jnp.broadcast_to(numbers, (*numbers.shape[:2], *kin.origin.shape[2:]))
    inner = numbers[:, first:]
    link = np.arange(first, numbers.shape[1]) // k
    frame = kin.link[:, :, link]
    centre = once(ring_centre, kin.origin[:, link], frame, inner)
    disc = kin.place[:, None], kin.palm[:, :, None], hand.palm_disc[:, None]
    look = partial(kinds.palm_distance, palm=disc)
    place = _touch(scene, look, inner, frame, centre)
    row = link[:, None, None] + 1
    free = self_collision.free_of_palm(row, inner, hand.offset[0], numbers[:, 0])
    depth = jnp.where(place.share * free > 0, -place.gap, -jnp.inf)
    return depth.reshape(-1, depth.shape[-1]).max(0)


def _object_distance(
    scene: Scene, hand: WorldModel, kin: Kinematics, point: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Distance of points from the object, and its gradient along the world's axes."""
    local = shapes.in_object(kin.object, point)
    distance, gradient = once(lambda p: shapes.signed_distance(scene, hand, p), local)
    return distance, apply_columns(kin.object, gradient)


def _touch(
    scene: Scene, look: Look, numbers: jax.Array, frame: jax.Array, centre: jax.Array
) -> Place:
    """Contacts of rings or spheres with a surface, see `touch`."""
    surface = scene.effects.surface
    return touch(surface, numbers, frame, centre, look(centre), look, apply=once)


def _joined(several: list[Place], axis: int) -> Place:
    """Contacts with several fields, one behind the other along an axis of the items."""
    if len(several) == 1:
        return several[0]
    axes = (axis + 1, axis + 1, axis, axis)
    fields = zip(axes, zip(*several, strict=True), strict=True)
    return Place(*(jnp.concatenate(values, at) for at, values in fields))


def _of_object(
    scene: Scene, hand: WorldModel, kin: Kinematics, position: jax.Array, on_object: Look
) -> list[Place]:
    """Contacts of the object with table and fixtures, items first."""

    def points(columns: jax.Array, height: jax.Array, fixture: int | None) -> jax.Array:
        return shapes.lowest_points(scene, hand, columns)

    def look(point: jax.Array, fixture: int) -> tuple[jax.Array, jax.Array]:
        return on_object(point)

    where = position, kin.object, hand.object_id
    return surroundings.object_places(scene, *where, points, look, apply=once)
