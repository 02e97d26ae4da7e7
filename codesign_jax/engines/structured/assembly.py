"""A step's problem over arrays of all worlds: where bodies are, what pushes them, what touches.

The kernel puts a step together link by link; here the same functions are called on whole arrays,
for what looks at a state and simulates nothing.
"""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import packing
from codesign_jax.engines.structured.kernel.contact_sets import margin
from codesign_jax.engines.structured.kernel.tables import rings_of_link
from codesign_jax.engines.structured.lanes import dot, once
from codesign_jax.engines.structured.laws import rings, shapes
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
    found = contacts(scene, hand, kin, state.position[2], velocity)
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
    height: jax.Array,
    velocity: Spatial | None = None,
) -> dict[str, Contacts]:
    """Contacts that the scene's effects call for but those between fingers, by pair of bodies.

    Args:
      scene: The scene.
      hand: Constants of the worlds.
      kin: Kinematics.
      height: Height of the object's centre above the table, shape (1, world).
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

    def field(name: str, point: jax.Array) -> tuple[jax.Array, jax.Array]:
        if name.endswith("_table"):
            return shapes.table_distance(height, point)
        local = shapes.in_object(kin.object, point)
        distance, gradient = once(lambda p: shapes.signed_distance(scene, hand, p), local)
        return distance, apply_columns(kin.object, gradient)

    def of_body(names: dict[str, bool], ring: Ring, origin: jax.Array, frame: jax.Array) -> None:
        centre = origin + apply_columns(frame, ring.centre)
        for name in (n for n in names if names[n]):
            first = field(name, centre)
            if e.surface == "spheres":
                add(name, rings.ball_on_field(ring.half[0], centre, *first))
                continue
            offset = once(rings.aim, ring, frame, *first)
            again = field(name, centre + offset)
            add(name, once(rings.on_field, ring, frame, centre, offset, *again))

    if count := rings_of_link(scene):
        numbers = packing.ring_numbers(scene, hand, count)
        numbers = jnp.moveaxis(numbers.reshape(-1, count, *numbers.shape[1:]), 2, 0)
        on = {"finger_object": e.finger_object, "finger_table": e.finger_table}
        of_body(on, Ring.of(numbers), kin.origin[:, :, None], kin.link[:, :, :, None])
    if palm_touches(scene):
        numbers = jnp.moveaxis(packing.palm_numbers(scene, hand), 1, 0)
        on = {"palm_object": e.palm_object, "palm_table": e.palm_table}
        of_body(on, Ring.of(numbers), kin.place, kin.palm)
    if e.object_table:
        place = shapes.object_on_table(scene, hand, kin, height)
        add("object_table", Place(*place, jnp.ones_like(place[2])))
    return found
