"""The residual of a step along virtual accelerations: the scalar that its derivative is taken of.

The accelerations a of a step solve F(a, theta) = 0, see `transforms`; with virtual accelerations
lambda the derivative by theta is that of the scalar -lambda' F, a virtual power and a sum over
links, contacts, palm and object.  Here is what links, palm and object add, as functions of arrays
as in `lanewise`, made of the functions that the forward pass calls; what contacts add is
`kinds.power`.
"""

from typing import Any, NamedTuple

from codesign_jax.engines.structured.kernel.body_motion import (
    carried_momentum,
    link_forces,
    palm_and_object,
)
from codesign_jax.engines.structured.kernel.problem import make_body
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.laws.kinematics import next_acceleration, palm_acceleration
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
