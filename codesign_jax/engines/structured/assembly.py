"""A step's problem over arrays of all worlds: where bodies are, what pushes them, what touches.

The kernel puts a step together link by link; here the same functions are called on whole arrays,
for what looks at a state and simulates nothing.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import packing
from codesign_jax.engines.structured.kernel.contact_sets import margin
from codesign_jax.engines.structured.kernel.tables import rings_of_link
from codesign_jax.engines.structured.lanes import dot, once
from codesign_jax.engines.structured.laws import rings, shapes, surroundings
from codesign_jax.engines.structured.laws.cones import which_cone
from codesign_jax.engines.structured.laws.contact import Cone, Contacts, candidates
from codesign_jax.engines.structured.laws.inertia import bodies, joint_springs, smooth_forces
from codesign_jax.engines.structured.laws.integration import rigid_arm
from codesign_jax.engines.structured.laws.kinematics import Kinematics, State, kinematics
from codesign_jax.engines.structured.laws.rings import Place, Ring
from codesign_jax.engines.structured.linear.tree import Matrices, Problem, Spatial, relative
from codesign_jax.engines.structured.world_model import WorldModel, apply_columns
from codesign_jax.model import layout
from codesign_jax.model.layout import palm_touches
from codesign_jax.scene import Scene


def problem(
    scene: Scene, hand: WorldModel, state: State, ctrl: jax.Array
) -> tuple[Problem, Spatial]:
    """Assembles a step's problem and the bodies' velocities; ctrl has shape (nu, world)."""
    kin = kinematics(hand, layout(scene).axes, state)
    body = bodies(hand, kin)
    smooth = smooth_forces(hand, kin, body, state, ctrl, scene)
    matrix = Matrices(*(once(lambda b: b.matrix(), b) for b in body))
    velocity = Spatial(kin.palm_vel, kin.vel, kin.object_vel)
    found = contacts(scene, hand, kin, state.position, velocity)
    h, palm_acc = scene.discretization.timestep, None
    if not scene.effects.wrist:
        palm_acc = rigid_arm(ctrl[:6, None], state.wrist, state.wrist_vel, h)
    springs = joint_springs(scene, hand, state, ctrl[6:])
    hand = hand._replace(armature=springs.armature)
    return Problem(hand, kin, body, matrix, smooth, found, palm_acc), velocity


def contacts(
    scene: Scene,
    hand: WorldModel,
    kin: Kinematics,
    position: jax.Array,
    velocity: Spatial | None = None,
) -> dict[str, Contacts]:
    """Contacts that the scene's effects call for but those between fingers, by pair of bodies.

    Args:
      position: The object's centre, shape (3, 1, world).
      velocity: Of the bodies; none where they are at rest.
    """
    e, found = scene.effects, {}

    def add(name: str, place: Place) -> None:
        cone = getattr(hand.cones, which_cone(name))

        def act(place: Place, cone: Cone, velocity: Spatial | None) -> Contacts:
            c, approach = Contacts(*place[:3], cone.of_share(place.share)), 0.0 * place.gap
            if velocity is not None:
                approach = -dot(c.normal, c.relative(relative(name, velocity)))
            share = candidates(place.share, place.gap, approach, cone, margin(scene))
            return c._replace(cone=cone.of_share(share))

        found[name] = once(act, place, cone, velocity)

    def of_object(point: jax.Array) -> tuple[jax.Array, jax.Array]:
        local = shapes.in_object(kin.object, point)
        distance, gradient = once(lambda p: shapes.signed_distance(scene, hand, p), local)
        return distance, apply_columns(kin.object, gradient)

    def of_body(names: dict[str, bool], ring: Ring, origin: jax.Array, frame: jax.Array) -> None:
        centre = origin + apply_columns(frame, ring.centre)
        for name in (n for n in names if names[n]):
            around = [partial(f, position) for f in surroundings.fields(scene)]
            looks = around if name.endswith("_table") else [of_object]
            places = []
            for look in looks:
                first = look(centre)
                if e.surface == "spheres":
                    places.append(rings.ball_on_field(ring.half[0], centre, *first))
                    continue
                offset = once(rings.aim, ring, frame, *first)
                again = look(centre + offset)
                places.append(once(rings.on_field, ring, frame, centre, offset, *again))
            if places:
                add(name, _joined(places, int(name.startswith("finger"))))

    if count := rings_of_link(scene):
        numbers = packing.ring_numbers(scene, hand, count)
        numbers = jnp.moveaxis(numbers.reshape(-1, count, *numbers.shape[1:]), 2, 0)
        on = {"finger_object": e.finger_object, "finger_table": e.finger_table}
        of_body(on, Ring.of(numbers), kin.origin[:, :, None], kin.link[:, :, :, None])
    if palm_touches(scene):
        numbers = jnp.moveaxis(packing.palm_numbers(scene, hand), 1, 0)
        on = {"palm_object": e.palm_object, "palm_table": e.palm_table}
        of_body(on, Ring.of(numbers), kin.place, kin.palm)
    if e.object_table and surroundings.slots(scene):
        places = _of_object(scene, hand, kin, position, of_object)
        add("object_table", _joined(places, 0))
    return found


def _joined(places: list[Place], axis: int) -> Place:
    """Contacts with several fields, one behind the other along an axis of the items."""
    if len(places) == 1:
        return places[0]
    axes = (axis + 1, axis + 1, axis, axis)
    fields = zip(axes, zip(*places, strict=True), strict=True)
    return Place(*(jnp.concatenate(values, at) for at, values in fields))


def _of_object(
    scene: Scene, hand: WorldModel, kin: Kinematics, position: jax.Array, of_object: Callable
) -> list[Place]:
    """Contacts of the object with table and fixtures, items first."""
    places, one = [], jnp.ones_like
    if scene.effects.table:
        place = shapes.object_on_table(scene, hand, kin.object, position[2])
        places.append(Place(*place, one(place[2])))
    flat = [i for i, s in enumerate(scene.objects.object) if s.type not in surroundings.ROUND]
    for fixture in scene.fixture:
        _, rows = surroundings.towards(fixture, position)
        arms = shapes.lowest_points(scene, hand, surroundings.faced(rows, kin.object))
        place = surroundings.object_on(fixture, position, rows[:, :, 0], arms)
        places.append(Place(*place, one(place[2])))
        if flat and surroundings.EDGES[fixture.type]:
            point = surroundings.edges(fixture, position)
            on, normal, gap = (v[..., 0, :] for v in surroundings.edge_on(point, *of_object(point)))
            mine = jnp.isin(hand.object_id, jnp.array(flat))
            places.append(Place(on, normal, gap, jnp.where(mine, one(gap), 0.0)))
    return places
