"""Motion, inertia and forces without contacts of palm, object and links: stages of a step.

A stage is evaluated lane by lane, see `lanewise`: arrays have the axes of one world, and the lanes
behind them.  The residual of a step consists of the same stages, `residual`.
"""

from typing import Any

import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.problem import Iterate, Palm, triangle
from codesign_jax.engines.structured.lanes import apply_columns, total
from codesign_jax.engines.structured.laws import inertia
from codesign_jax.engines.structured.laws import kinematics as kin
from codesign_jax.engines.structured.laws.inertia import Body, Centred
from codesign_jax.engines.structured.laws.integration import rigid_arm
from codesign_jax.engines.structured.laws.kinematics import (
    State,
    next_acceleration,
    palm_acceleration,
)
from codesign_jax.engines.structured.laws.step_numbers import pushed
from codesign_jax.model.layout import joint_axes
from codesign_jax.scene import Scene


def palm_and_object(timestep: float, state: dict, arm, constants: dict) -> dict[str, Any]:
    """Geometry, motion, inertia and smooth forces of palm, wrist and object.

    Args:
      state: State of wrist and object, by the names of `State`, with "acc_wrist" and "acc_object".
      arm: Commands of the arm frame, shape (6, ...). Without a stiffness of the wrist its
        accelerations follow from them.
      constants: Those of `PALM_CONSTANTS` that the scene has.
    """
    stiffness = constants.get("wrist_stiffness")
    gravity = constants.get("gravity")
    lanes_state = State(**{name: state.get(name) for name in State._fields})
    place = kin.palm_place(lanes_state)
    frame, axes, vel, bias = kin.wrist_kinematics(place, state["wrist"], state["wrist_vel"])
    columns, object_vel = kin.object_kinematics(lanes_state)
    centre = place + apply_columns(frame, constants["palm_centre"])
    turned = inertia.turned_tensor(frame, constants["palm_inertia"])
    palm = Body(constants["palm_mass"], centre, turned)
    tensor = inertia.principal_tensor(columns, constants["object_inertia"])
    grasped = Centred(constants["object_mass"], tensor)
    spring = -constants["wrist_damping"] * state["wrist_vel"]
    if stiffness is not None:
        spring = stiffness * (arm - state["wrist"]) + spring
    acc = state["acc_wrist"], state["acc_object"]
    if stiffness is None:
        acc = rigid_arm(arm, state["wrist"], state["wrist_vel"], timestep), acc[1]
    now = Iterate(acc[0], palm_acceleration(acc[0], axes), acc[1])
    smooth_palm = palm.smooth_force(vel, bias, gravity)
    smooth_palm = pushed("palm", smooth_palm, palm.mass, centre, constants)
    inverse = inertia.principal_tensor(columns, 1 / constants["object_inertia"])
    smooth_object = grasped.smooth_force(object_vel, gravity, inverse, timestep)
    origin = jnp.zeros_like(smooth_object[:3])  # the object's centre
    smooth_object = pushed("object", smooth_object, grasped.mass, origin, constants)
    smooth = smooth_palm, smooth_object
    return {
        "place": place,
        "frame": frame,
        "vel": vel,
        "bias": bias,
        "columns": columns,
        "object_vel": object_vel,
        "now": now,
        "palm": Palm(palm, grasped, *smooth, spring, constants["wrist_armature"], axes),
    }


def link_forces(scene: Scene, parent: tuple, constants: dict, joint: dict):
    """A link's kinematics, inertia and forces.

    Args:
      parent: Origin, frame, velocity, bias and acceleration of the link before it.
      joint: Angles, velocities and accelerations of the joint, the chamber's pressure, and the
        order of the hinges, see `hinge_sign`, by name.

    Returns:
      What `parent` is for the next link, and what the solver needs, by name.
    """
    origin, frame, vel, bias, link_acc = parent
    q = joint["finger"]
    rate = joint["finger_vel"]
    pressure = joint["pressure"]
    hinges = [constants[n] for n in ("stiffness", "damping", "armature")]
    cos = jnp.cos(q)
    sin = jnp.sin(q)
    origin, frame, axes = kin.turn_link(
        joint_axes(scene), origin, frame, constants["offset"], cos, sin, joint["order"]
    )
    vel, bias = kin.link_velocity(vel, bias, axes, rate, joint["order"])
    link_acc = next_acceleration(link_acc, axes, joint["acc"])
    body = Body(
        constants["mass"],
        origin + apply_columns(frame, constants["centre"]),
        inertia.principal_tensor(frame, constants["inertia"]),
    )
    if "law" in constants:
        springs = inertia.section_springs(scene, hinges, constants["law"], pressure, q)
        tau = springs.moments - springs.damping * rate
    else:
        springs = inertia.springs(scene, tuple(hinges), constants.get("threshold"), pressure, q)
        tau = -springs.stiffness * q - springs.damping * rate
        bend = tau[:1] + constants["gain"] * pressure
        if springs.moment is not None:
            bend = bend + springs.moment
        if "section" in constants:
            bend = bend + inertia.softening_moment(constants["section"], hinges[0][:1], q[:1])
        tau = jnp.concatenate([bend, tau[1:]])
    share = inertia.share_of_products(vel[:3], scene.discretization.timestep)
    smooth = body.smooth_force(vel, bias, constants.get("gravity"), share)
    stored = {
        "axes": axes,
        "body_centre": body.centre,
        "tensor": triangle(body.tensor),
        "link_acc": link_acc,
        "smooth": pushed("link", smooth, body.mass, body.centre, constants),
        "tau": tau,
        "share": share,
    }
    if "law" in constants or "threshold" in constants:
        stored["armature_now"] = springs.armature
    return (origin, frame, vel, bias, link_acc), stored


WRIST = ("wrist", "wrist_vel", "position")
"""What `bases_before` takes of the state."""


def bases_before(timestep: float, wrist, wrist_vel, position, mount, base) -> tuple:
    """Origin, frame and velocity of the fingers' bases as the last step ended.

    See `inertia.carried_force`.
    """
    wrist = wrist - timestep * wrist_vel
    place = wrist[:3] - position
    palm, _, vel, _ = kin.wrist_kinematics(place, wrist, wrist_vel)
    frame, origin = kin.mounted(place, palm, mount, base)
    return origin, frame, vel


def carried_momentum(scene: Scene, now: tuple, before: tuple, constants: dict, joint: dict):
    """What a link that turns fast gets for the rest of its velocity products.

    Args:
      now: Origin, frame and velocity of the link before it; `before`: as the last step ended.

    Returns:
      Both for the next link, the joint's axes, and the force, see `inertia.carried_force`.
    """
    h = scene.discretization.timestep
    q = joint["finger"]
    rate = joint["finger_vel"]
    momenta = []
    chains = []
    for (origin, frame, vel), angles in ((before, q - h * rate), (now, q)):
        origin, frame, axes = kin.turn_link(
            joint_axes(scene),
            origin,
            frame,
            constants["offset"],
            jnp.cos(angles),
            jnp.sin(angles),
            joint["order"],
        )
        vel = vel + total([axes[k] * rate[k] for k in range(rate.shape[0])])
        centre = origin + apply_columns(frame, constants["centre"])
        body = constants["mass"], constants["inertia"], frame, centre
        momenta.append(inertia.momentum(*body, vel))
        chains.append((origin, frame, vel))
    rest = (1 - inertia.share_of_products(vel[:3], h)) / h
    force = inertia.carried_force(momenta[1], momenta[0], frame, centre, rest)
    return chains[1], chains[0], axes, force
