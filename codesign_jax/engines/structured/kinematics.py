"""Positions, motion subspaces, velocities and bias accelerations of all bodies of one state.

All spatial quantities are in a world-aligned frame whose origin is the palm's present position (short lever
arms, so that float32 suffices); it does not move during the step.  In such a frame velocities and motion
subspaces of different bodies add without transforms.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.hand import HandLanes, apply_columns, rotation_columns
from codesign_jax.engines.structured.lanes import cross, motion_cross, rotate, spatial

# Axis of the frame about which each hinge turns, in the order bend (y), lateral (z), twist (x).
_HINGE = {"bend": 1, "lateral": 2, "twist": 0}
_WRIST = (0, 2, 1)  # roll (x), yaw (z), pitch (y)


class State(NamedTuple):
    """State of every world in lane layout.

    Attributes:
      wrist: Wrist coordinates x, y, z [m], roll, yaw, pitch [rad], shape (6, 1, world).
      finger: Joint angles [rad], shape (link, axis, finger, world).
      position: Object centre [m], shape (3, 1, world).
      quat: Object orientation, unit quaternion, shape (4, 1, world).
      wrist_vel: Wrist velocities, shape (6, 1, world).
      finger_vel: Joint velocities, as `finger`.
      linear_vel: Object velocity, world frame, shape (3, 1, world).
      angular_vel: Object angular velocity, body frame as in MuJoCo, shape (3, 1, world).
      acc: Accelerations of the last step, the solver's warm start.
    """

    wrist: jax.Array
    finger: jax.Array
    position: jax.Array
    quat: jax.Array
    wrist_vel: jax.Array
    finger_vel: jax.Array
    linear_vel: jax.Array
    angular_vel: jax.Array
    acc: "Acc"


class Acc(NamedTuple):
    """Accelerations; the object's as its spatial vector (angular, linear at its centre), world axes.

    Attributes:
      wrist: Shape (6, 1, world).
      finger: Shape (link, axis, finger, world).
      object: Shape (6, 1, world).
    """

    wrist: jax.Array
    finger: jax.Array
    object: jax.Array


class Kinematics(NamedTuple):
    """Bodies in the frame at the palm; spatial vectors are (angular, linear).

    Attributes:
      palm: Columns of the palm's orientation, shape (3, 3, 1, world).
      wrist_axes: Subspace of the three wrist hinges, shape (3, 6, 1, world).
      palm_vel: Palm velocity, shape (6, 1, world).
      palm_bias: Palm acceleration at zero joint acceleration, same shape.
      link: Columns of the links' orientations, shape (3, 3, link, finger, world).
      origin: Link frame positions, shape (3, link, finger, world).
      axes: Joint subspaces, one (axis, 6, finger, world) a link.
      vel: Link velocities, shape (6, link, finger, world).
      bias: Link accelerations at zero joint acceleration, same shape.
      object: Columns of the object's orientation, shape (3, 3, 1, world).
      object_pos: Object centre, shape (3, 1, world).
      object_vel: Object velocity, shape (6, 1, world).
    """

    palm: jax.Array
    wrist_axes: jax.Array
    palm_vel: jax.Array
    palm_bias: jax.Array
    link: jax.Array
    origin: jax.Array
    axes: list[jax.Array]
    vel: jax.Array
    bias: jax.Array
    object: jax.Array
    object_pos: jax.Array
    object_vel: jax.Array


def kinematics(hand: HandLanes, axis_names: tuple[str, ...], state: State) -> Kinematics:
    """Computes the kinematics of all bodies."""
    palm, wrist_axes, palm_vel, palm_bias = _wrist(state)
    frame = [apply_columns(palm, hand.mount[k]) for k in range(3)]
    origin = apply_columns(palm, hand.base)
    vel, bias = palm_vel, palm_bias
    cos, sin = jnp.cos(state.finger), jnp.sin(state.finger)
    frames, origins, axes, vels, biases = [], [], [], [], []
    for i in range(state.finger.shape[0]):
        origin = origin + frame[0] * hand.offset[i]
        subspace = []
        for a, name in enumerate(axis_names):
            axis = frame[_HINGE[name]]
            s = spatial(axis, cross(origin, axis))
            bias = bias + motion_cross(vel, s) * state.finger_vel[i, a]
            vel = vel + s * state.finger_vel[i, a]
            subspace.append(s)
            frame = rotate(frame, _HINGE[name], cos[i, a], sin[i, a])
        frame = list(jnp.stack(frame))
        axes.append(jnp.stack(subspace))
        frames.append(jnp.stack(frame))
        origins.append(origin)
        vels.append(vel)
        biases.append(bias)
    columns = rotation_columns(state.quat)
    position = state.position - state.wrist[:3]
    omega = apply_columns(columns, state.angular_vel)
    return Kinematics(
        palm=palm,
        wrist_axes=wrist_axes,
        palm_vel=palm_vel,
        palm_bias=palm_bias,
        link=jnp.stack(frames, 2),
        origin=jnp.stack(origins, 1),
        axes=axes,
        vel=jnp.stack(vels, 1),
        bias=jnp.stack(biases, 1),
        object=columns,
        object_pos=position,
        object_vel=spatial(omega, state.linear_vel + cross(position, omega)),
    )


def _wrist(state: State) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    one, zero = jnp.ones_like(state.wrist[0]), jnp.zeros_like(state.wrist[0])
    frame = [jnp.stack([one if i == k else zero for i in range(3)]) for k in range(3)]
    none = jnp.stack([zero] * 3)
    vel, bias = spatial(none, state.wrist_vel[:3]), spatial(none, none)
    cos, sin = jnp.cos(state.wrist[3:]), jnp.sin(state.wrist[3:])
    axes = []
    for k, axis in enumerate(_WRIST):
        s = spatial(frame[axis], none)
        bias = bias + motion_cross(vel, s) * state.wrist_vel[3 + k]
        vel = vel + s * state.wrist_vel[3 + k]
        axes.append(s)
        frame = rotate(frame, axis, cos[k], sin[k])
    return jnp.stack(frame), jnp.stack(axes), vel, bias
