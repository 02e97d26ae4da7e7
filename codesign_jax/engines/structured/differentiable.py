"""A step in plain JAX at accelerations that are known, for derivatives.

The kernel finds the accelerations of a step and has no derivative.  Here the same step is put
together once more from the same functions, over arrays of all worlds; `implicit` makes the
accelerations the function of everything else in the step that they are.
"""

from functools import partial
from typing import NamedTuple

import jax

from codesign_jax.engines.structured import collision, finger_pairs, hull, implicit
from codesign_jax.engines.structured.constants import WorldConstants, apply_columns
from codesign_jax.engines.structured.contact import Contacts
from codesign_jax.engines.structured.inertia import Bodies, bodies, smooth_forces
from codesign_jax.engines.structured.integration import integrate, rigid_arm
from codesign_jax.engines.structured.kinematics import Kinematics, State, kinematics
from codesign_jax.engines.structured.lanes import Stages, total
from codesign_jax.engines.structured.problem import Matrices, Problem, Spatial
from codesign_jax.model import layout
from codesign_jax.model.layout import palm_touches
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import SceneError


class Moved(NamedTuple):
    """A step of a batch.

    Attributes:
      state: The state after it.
      centre: Hand centre before it, world frame, shape (3, 1, world).
    """

    state: State
    centre: jax.Array


def step(scene: Scene, hand: WorldConstants, state: State, ctrl: jax.Array) -> Moved:
    """A time step with the accelerations `state.acc`, as a function of all its arguments.

    Args:
      scene: The scene.
      hand: Constants of the worlds.
      state: Their states; `acc` solves this step, and gets no derivative of its own.
      ctrl: Controls, shape (nu, world).

    Raises:
      SceneError: If there is no derivative of what the scene asks for.
    """
    refuse(scene)
    # The compiler does not know that a shape's index is never negative.
    run = Stages(hand.object_id[0, 0] >= 0 if jax.default_backend() == "cpu" else None)
    assembled, velocity = problem(scene, run, hand, state, ctrl)
    acc = implicit.accelerations(run.predicate, assembled, velocity, state.acc)
    if assembled.palm_acc is not None:
        acc = acc._replace(wrist=assembled.palm_acc)
    h = scene.discretization.timestep
    new = run(lambda s, o, a: integrate(s, o, a, h), state, assembled.kin.object, acc)
    centre = _centre(hand, assembled.kin, assembled.body) + state.position
    return Moved(new, centre)


def problem(
    scene: Scene, run: Stages, hand: WorldConstants, state: State, ctrl: jax.Array
) -> tuple[Problem, Spatial]:
    """Assembles a step's problem and the bodies' velocities; ctrl has shape (nu, world)."""
    kin = kinematics(run, hand, layout(scene).axes, state)
    body = bodies(run, hand, kin)
    smooth = smooth_forces(run, hand, kin, body, state, ctrl, scene)
    matrix = Matrices(*(run(lambda b: b.matrix(), b) for b in body))
    found = contacts(scene, run, hand, kin, state.position[2])
    velocity = Spatial(kin.palm_vel, kin.vel, kin.object_vel)
    h, palm_acc = scene.discretization.timestep, None
    if not scene.effects.wrist:
        palm_acc = rigid_arm(ctrl[:6, None], state.wrist, state.wrist_vel, h)
    return Problem(hand, kin, body, matrix, smooth, found, palm_acc), velocity


def contacts(
    scene: Scene, run: Stages, hand: WorldConstants, kin: Kinematics, height: jax.Array
) -> dict[str, Contacts]:
    """Contacts that the scene's effects call for, by pair of bodies.

    Args:
      scene: The scene.
      run: Runs the stages.
      hand: Constants of the worlds.
      kin: Kinematics.
      height: Height of the object's centre above the table, shape (1, world).
    """
    e, found = scene.effects, {}
    on_object = partial(collision.spheres_on_object, scene, hand, kin)
    on_table = partial(collision.spheres_on_table, hand.cones.hand_table, height)
    if hand.sphere.size:
        spheres = run(collision.finger_spheres, hand, kin)
        if e.finger_object:
            found["finger_object"] = on_object(run, spheres, hand.radius)
        if e.finger_table:
            found["finger_table"] = on_table(spheres, hand.radius)
        if e.finger_finger and scene.num_fingers > 1:
            found["finger_finger"] = finger_pairs.contacts(
                run, hand.cones.finger_finger, spheres, hand.radius
            )
    if e.surface == "hull" and (e.finger_object or e.finger_table):
        skin = run(lambda h, k: hull.vertices(scene, h, k), hand, kin)
        if e.finger_object:
            found["hull_object"] = hull.attach(run, on_object(run, skin.point, 0.0), skin)
        if e.finger_table:
            found["hull_table"] = hull.attach(run, on_table(skin.point, 0.0), skin)
    if palm_touches(scene):
        palm, radius = collision.palm_spheres(hand, kin), hand.palm_radius
        if e.palm_object:
            found["palm_object"] = on_object(run, palm, radius)
        if e.palm_table:
            found["palm_table"] = on_table(palm, radius)
    if e.object_table:
        found["object_table"] = collision.object_on_table(run, scene, hand, kin, height)
    return found


def refuse(scene: Scene) -> None:
    """Checks that a step of the scene has a derivative.

    Raises:
      SceneError: If it has none.
    """
    e = scene.effects
    if e.finger_finger and scene.num_fingers > 1 and (e.surface == "hull" or e.friction == "full"):
        raise SceneError(
            [
                "effects.finger_finger with surface = 'hull' or friction = 'full' has no "
                "derivative: use surface = 'spheres' and friction = 'coulomb' or 'none', as in "
                'scene.load("paper_spheres") or scene.load(..., overrides={"effects.surface": '
                '"spheres"})'
            ]
        )


def _centre(hand: WorldConstants, kin: Kinematics, body: Bodies) -> jax.Array:
    """Mean position of the segments from the object's centre: half weight for half segments."""
    n, links = hand.mount.shape[2], hand.mass.shape[0]
    weights = [1.0] * (links - 1) + [0.5]
    moving = total([w * body.link.centre[:, i] for i, w in enumerate(weights)])
    every = moving + 0.5 * (kin.place + apply_columns(kin.palm, hand.stub_centre))
    return total([every[:, f : f + 1] for f in range(n)]) / (n * links)
