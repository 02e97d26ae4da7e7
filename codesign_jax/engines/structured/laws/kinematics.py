"""Positions, motion subspaces, velocities and bias accelerations of all bodies of one state.

All spatial quantities are in one world-aligned frame, whose origin is the object's present centre;
it does not move during the step.  In such a frame velocities and motion subspaces of different
bodies add without transforms.  The object is the origin because it is hardest to solve for in
float32: contacts hold it with up to some hundred kg, which seen from the palm, 0.1 m away, are a
moment of inertia a million times the object's own about its centre.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import (
    apply_columns,
    cross,
    motion_cross,
    once,
    rotate,
    rotation_columns,
    scan_links,
    spatial,
    total,
    turn_columns,
)
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.model.layout import hinge_sign

_WRIST = (0, 2, 1)  # roll (x), yaw (z), pitch (y)


class State(NamedTuple):
    """State of every world in lane layout."""

    wrist: jax.Array  # Wrist coordinates x, y, z [m], roll, yaw, pitch [rad], shape (6, 1, world)
    finger: jax.Array  # Joint angles [rad], shape (link, axis, finger, world)
    position: jax.Array  # Object centre [m], shape (3, 1, world)
    quat: jax.Array  # Object orientation, unit quaternion, shape (4, 1, world)
    wrist_vel: jax.Array  # Wrist velocities, shape (6, 1, world)
    finger_vel: jax.Array  # Joint velocities, as `finger`
    linear_vel: jax.Array  # Object velocity, world frame, shape (3, 1, world)
    angular_vel: jax.Array  # Object angular velocity, body frame as in MuJoCo, shape (3, 1, world)
    acc: "Acc"  # Accelerations of the last step, the solver's warm start
    step: Any = None  # Number of steps since the beginning of the grasp, shape (1, 1, world)
    going: Any = None  # Zero for a world that is decided, else one, likewise
    # Largest absolute velocity, for a failed world that of the failed step, likewise
    speed: Any = None
    overlap: Any = None  # Largest overlap of two bodies as the grasp began [m], likewise
    # Friction that contacts hold, see `holding.held`, rows as in `model.held`, shape
    # (row, lane, world), lanes of fingers; no rows without `effects.friction_memory`
    held: Any = None


class Acc(NamedTuple):
    """Accelerations; the object's as (angular, linear at its centre) in world axes."""

    wrist: jax.Array  # Shape (6, 1, world)
    finger: jax.Array  # Shape (link, axis, finger, world)
    object: jax.Array  # Shape (6, 1, world)


class Spatial(NamedTuple):
    """Spatial motion: palm (6, 1, world), links (6, link, finger, world), object as palm."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array


class Kinematics(NamedTuple):
    """Bodies in the frame at the object's centre; spatial vectors are (angular, linear)."""

    place: jax.Array  # Palm position, shape (3, 1, world)
    palm: jax.Array  # Columns of the palm's orientation, shape (3, 3, 1, world)
    wrist_axes: jax.Array  # Subspace of the three wrist hinges, shape (3, 6, 1, world)
    palm_vel: jax.Array  # Palm velocity, shape (6, 1, world)
    palm_bias: jax.Array  # Palm acceleration at zero joint acceleration, same shape
    link: jax.Array  # Columns of the links' orientations, shape (3, 3, link, finger, world)
    origin: jax.Array  # Link frame positions, shape (3, link, finger, world)
    axes: jax.Array  # Joint subspaces, shape (link, axis, 6, finger, world)
    vel: jax.Array  # Link velocities, shape (6, link, finger, world)
    bias: jax.Array  # Link accelerations at zero joint acceleration, same shape
    object: jax.Array  # Columns of the object's orientation, shape (3, 3, 1, world)
    object_vel: jax.Array  # Object velocity, shape (6, 1, world)


def kinematics(hand: WorldModel, axis_names: tuple[str, ...], state: State) -> Kinematics:
    """Kinematics of a state; the axes' names are those of `model.joint_axes`."""
    place = palm_place(state)
    palm, wrist_axes, palm_vel, palm_bias = once(
        wrist_kinematics, place, state.wrist, state.wrist_vel
    )
    frame, origin = once(mounted, place, palm, hand.mount, hand.base)
    vel = palm_vel
    bias = palm_bias
    trig = once(lambda q: (jnp.cos(q), jnp.sin(q)), state.finger)

    def next_link(carry, link):
        origin, frame, vel, bias = carry
        offset, cos, sin, rate, order = link
        turn = partial(turn_link, axis_names)
        origin, frame, subspace = once(turn, origin, frame, offset, cos, sin, order)
        vel, bias = once(link_velocity, vel, bias, subspace, rate, order)
        return (origin, frame, vel, bias), (origin, frame, vel, bias, subspace)

    order = hinge_sign(jnp.arange(len(hand.offset)))[:, None, None]
    over = (hand.offset, *trig, state.finger_vel, order.astype(hand.offset.dtype))
    lanes = jnp.zeros_like(hand.offset[0])
    first = (origin, frame, vel + lanes, bias + lanes)
    _, (origins, frames, vels, biases, axes) = scan_links(next_link, first, over)
    columns, object_vel = once(object_kinematics, state)
    return Kinematics(
        place=place,
        palm=palm,
        wrist_axes=wrist_axes,
        palm_vel=palm_vel,
        palm_bias=palm_bias,
        link=jnp.moveaxis(frames, 0, 2),
        origin=jnp.moveaxis(origins, 0, 1),
        axes=axes,
        vel=jnp.moveaxis(vels, 0, 1),
        bias=jnp.moveaxis(biases, 0, 1),
        object=columns,
        object_vel=object_vel,
    )


def straight(hand: WorldModel, state: State) -> Kinematics:
    """Places of all bodies with straight fingers: no loop along the links, and nothing else."""
    place = palm_place(state)
    palm = _palm_columns(state.wrist)
    frame, base = mounted(place, palm, hand.mount, hand.base)
    origin = base[:, None] + frame[0][:, None] * jnp.cumsum(hand.offset, axis=0)
    link = jnp.broadcast_to(frame[:, :, None], (3, *origin.shape))
    columns = rotation_columns(state.quat)
    none = jnp.zeros(())
    return Kinematics(place, palm, none, none, none, link, origin, none, none, none, columns, none)


def palm_place(state: State) -> jax.Array:
    """The palm's position from the object's centre [m], shape (3, 1, world)."""
    return state.wrist[:3] - state.position


def wrist_kinematics(place: jax.Array, wrist: jax.Array, wrist_vel: jax.Array):
    """The palm's orientation as columns, the wrist's axes, and the palm's velocity and bias."""
    ones = jnp.ones_like(wrist[0])
    zero = jnp.zeros_like(wrist[0])
    frame = [jnp.stack([ones if i == k else zero for i in range(3)]) for k in range(3)]
    none = jnp.stack([zero] * 3)
    vel = spatial(none, wrist_vel[:3])
    bias = spatial(none, none)
    cos = jnp.cos(wrist[3:])
    sin = jnp.sin(wrist[3:])
    axes = []
    for k, axis in enumerate(_WRIST):
        s = spatial(frame[axis], cross(place, frame[axis]))
        bias = bias + motion_cross(vel, s) * wrist_vel[3 + k]
        vel = vel + s * wrist_vel[3 + k]
        axes.append(s)
        frame = rotate(frame, axis, cos[k], sin[k])
    return jnp.stack(frame), jnp.stack(axes), vel, bias


def _palm_columns(wrist: jax.Array) -> jax.Array:
    """Columns of the palm's orientation, the first result of `wrist_kinematics`."""
    frame = list(jnp.eye(3, dtype=wrist.dtype).reshape(3, 3, *[1] * (wrist.ndim - 1)))
    cos = jnp.unstack(jnp.cos(wrist[3:]))
    sin = jnp.unstack(jnp.sin(wrist[3:]))
    for axis, c, s in zip(_WRIST, cos, sin, strict=True):
        frame = rotate(frame, axis, c, s)
    return jnp.stack(jnp.broadcast_arrays(*frame))


def mounted(place: jax.Array, palm: jax.Array, mount: jax.Array, base: jax.Array):
    """Columns of the orientations of the fingers' bases, and their positions."""
    frame = turn_columns(palm, mount)
    return frame, place + apply_columns(palm, base)


def turn_link(names: tuple[str, ...], origin, frame, offset, cos, sin, order):
    """Position, orientation and motion subspace of a link from its parent's.

    Seen in a mirror that swaps the axes x and y, the hinges of the opposite order twist, lateral,
    bend are bend, lateral, twist, and their angles have the other sign.  So both orders are the
    same arithmetic on columns that trade places.

    Args:
      names: Names of the axes that are on, in the order of `model.layout.AXES`.
      order: See `model.layout.hinge_sign`, shape (...).
    """
    origin = origin + frame[0] * offset
    if names == ("bend",):
        axis = frame[1]
        columns = rotate(list(frame), 1, cos[0], sin[0])
        return origin, jnp.stack(columns), spatial(axis, cross(origin, axis))[None]
    no_turn = jnp.ones_like(cos[0]), jnp.zeros_like(sin[0])
    turns = {name: (cos[a], sin[a]) for a, name in enumerate(names)}
    bend, lateral, twist = (turns.get(name, no_turn) for name in ("bend", "lateral", "twist"))
    forward = order > 0

    def swapped(a, b):
        """The two values, in the other order where the hinges are."""
        return jnp.where(forward, a, b), jnp.where(forward, b, a)

    columns = [*swapped(frame[0], frame[1]), frame[2]]
    both = [swapped(b, t) for b, t in zip(bend, twist, strict=True)]
    turned = []
    for axis, c, s in ((1, both[0][0], both[1][0]), (2, *lateral), (0, both[0][1], both[1][1])):
        turned.append(columns[axis])
        columns = rotate(columns, axis, c, order * s)
    first, middle, last = turned
    bend_axis, twist_axis = swapped(first, last)
    axes = {"bend": bend_axis, "lateral": middle, "twist": twist_axis}
    subspace = [spatial(axes[name], cross(origin, axes[name])) for name in names]
    columns = [*swapped(columns[0], columns[1]), columns[2]]
    return origin, jnp.stack(columns), jnp.stack(subspace)


def link_velocity(
    vel: jax.Array, bias: jax.Array, subspace: jax.Array, rate: jax.Array, order: jax.Array
):
    """Velocity and bias of a link from its parent's; each hinge is carried by those before it."""
    motion = subspace[0] * rate[0]
    carried = None
    for a in range(1, subspace.shape[0]):
        more = motion_cross(motion, subspace[a]) * rate[a]
        carried = more if carried is None else carried + more
        motion = motion + subspace[a] * rate[a]
    bias = bias + motion_cross(vel, motion)
    if carried is not None:
        bias = bias + order * carried
    return vel + motion, bias


def object_kinematics(state: State):
    """Columns of the object's orientation, and its spatial velocity."""
    columns = rotation_columns(state.quat)
    return columns, spatial(apply_columns(columns, state.angular_vel), state.linear_vel)


def palm_acceleration(wrist_acc: jax.Array, axes: jax.Array) -> jax.Array:
    """The palm's spatial acceleration of the wrist's slides and hinges."""
    moving = spatial(jnp.zeros_like(wrist_acc[:3]), wrist_acc[:3])
    return moving + total([axes[k] * wrist_acc[3 + k] for k in range(3)])


def next_acceleration(parent: jax.Array, axes: jax.Array, a: jax.Array) -> jax.Array:
    """A link's spatial acceleration from its parent's and its joint's."""
    return parent + total([axes[k] * a[k] for k in range(axes.shape[0])])


def relative(name: str, motion: Spatial) -> jax.Array:
    """Relative spatial motion of a pair of bodies, with axes for the contacts' items."""
    obj = motion.object
    if name == "finger_object":
        return jnp.stack([motion.link[i] - obj[i] for i in range(6)])[:, :, None]
    return {
        "finger_table": motion.link[:, :, None],
        "palm_object": motion.palm - obj,
        "palm_table": motion.palm,
        "object_table": obj,
    }[name]
