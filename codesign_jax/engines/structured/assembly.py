"""A step's problem over arrays of all worlds: where bodies are, what pushes them, what touches.

The kernel puts a step together link by link; here the same functions are called on whole arrays,
for what looks at a state and simulates nothing.
"""

from functools import partial

import jax

from codesign_jax.engines.structured.lanes import once
from codesign_jax.engines.structured.laws import finger_pairs, hull, shapes
from codesign_jax.engines.structured.laws.contact import Contacts
from codesign_jax.engines.structured.laws.inertia import bodies, joint_springs, smooth_forces
from codesign_jax.engines.structured.laws.integration import rigid_arm
from codesign_jax.engines.structured.laws.kinematics import Kinematics, State, kinematics
from codesign_jax.engines.structured.linear.tree import Matrices, Problem, Spatial
from codesign_jax.engines.structured.world_model import WorldModel
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
    found = contacts(scene, hand, kin, state.position[2])
    velocity = Spatial(kin.palm_vel, kin.vel, kin.object_vel)
    h, palm_acc = scene.discretization.timestep, None
    if not scene.effects.wrist:
        palm_acc = rigid_arm(ctrl[:6, None], state.wrist, state.wrist_vel, h)
    springs = joint_springs(scene, hand, state, ctrl[6:])
    hand = hand._replace(armature=springs.armature)
    return Problem(hand, kin, body, matrix, smooth, found, palm_acc), velocity


def contacts(
    scene: Scene, hand: WorldModel, kin: Kinematics, height: jax.Array
) -> dict[str, Contacts]:
    """Contacts that the scene's effects call for, by pair of bodies.

    Args:
      scene: The scene.
      hand: Constants of the worlds.
      kin: Kinematics.
      height: Height of the object's centre above the table, shape (1, world).
    """
    e, found = scene.effects, {}
    on_object = partial(shapes.spheres_on_object, scene, hand, kin)
    on_table = partial(shapes.spheres_on_table, hand.cones.hand_table, height)
    if hand.sphere.size:
        spheres = once(shapes.finger_spheres, hand, kin)
        if e.finger_object:
            found["finger_object"] = on_object(spheres, hand.radius)
        if e.finger_table:
            found["finger_table"] = on_table(spheres, hand.radius)
        if e.finger_finger and scene.num_fingers > 1:
            found["finger_finger"] = finger_pairs.contacts(
                hand.cones.finger_finger, spheres, hand.radius
            )
    if e.surface == "hull" and (e.finger_object or e.finger_table):
        skin = once(lambda h, k: hull.vertices(scene, h, k), hand, kin)
        if e.finger_object:
            found["hull_object"] = hull.attach(on_object(skin.point, 0.0), skin)
        if e.finger_table:
            found["hull_table"] = hull.attach(on_table(skin.point, 0.0), skin)
    if palm_touches(scene):
        palm, radius = shapes.palm_spheres(hand, kin), hand.palm_radius
        if e.palm_object:
            found["palm_object"] = on_object(palm, radius)
        if e.palm_table:
            found["palm_table"] = on_table(palm, radius)
    if e.object_table:
        found["object_table"] = shapes.object_on_table(scene, hand, kin, height)
    return found
