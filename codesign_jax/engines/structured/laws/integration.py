"""Positions and velocities after a step."""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import rotation_columns, total
from codesign_jax.engines.structured.laws.kinematics import Acc, State


def integrate(state: State, columns: jax.Array, acc: Acc, h: float) -> State:
    """Semi-implicit Euler: velocities first, then positions with the new velocities.

    Args:
      columns: Columns of the object's rotation matrix before the step, shape (3, 3, ...).
      h: Time step [s].
    """
    local = jnp.stack([total([columns[k, i] * acc.object[i] for i in range(3)]) for k in range(3)])
    wrist_vel = state.wrist_vel + h * acc.wrist
    finger_vel = state.finger_vel + h * acc.finger
    linear = state.linear_vel + h * acc.object[3:]
    angular = state.angular_vel + h * local
    return State(
        state.wrist + h * wrist_vel,
        state.finger + h * finger_vel,
        state.position + h * linear,
        _turn(state.quat, angular, h),
        wrist_vel,
        finger_vel,
        linear,
        angular,
        acc,
    )


def before(state: State, h: float) -> State:
    """The state from which `integrate` leads to this one, by the accelerations that it has."""
    acc = state.acc
    quat = _turn(state.quat, -state.angular_vel, h)
    columns = rotation_columns(quat)
    local = jnp.stack([total([columns[k, i] * acc.object[i] for i in range(3)]) for k in range(3)])
    return state._replace(
        wrist=state.wrist - h * state.wrist_vel,
        finger=state.finger - h * state.finger_vel,
        position=state.position - h * state.linear_vel,
        quat=quat,
        wrist_vel=state.wrist_vel - h * acc.wrist,
        finger_vel=state.finger_vel - h * acc.finger,
        linear_vel=state.linear_vel - h * acc.object[3:],
        angular_vel=state.angular_vel - h * local,
    )


def _turn(quat: jax.Array, omega: jax.Array, h: float) -> jax.Array:
    """Quaternion after turning with the body-frame angular velocity for a time h."""
    square = total([omega[i] ** 2 for i in range(3)])
    speed = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    half = 0.5 * h * jnp.where(square > 0, speed, 0.0)
    # Without rotation the quotient is zero but its derivative is not.
    axis = jnp.where(square > 0, omega / speed * jnp.sin(half), 0.5 * h * omega)
    w, x, y, z = quat
    a = jnp.cos(half)
    b, c, d = axis
    turned = jnp.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
    )
    return turned / jnp.sqrt(total([turned[i] ** 2 for i in range(4)]))


def rigid_arm(frame: jax.Array, wrist: jax.Array, velocity: jax.Array, h: float) -> jax.Array:
    """Acceleration of the palm's coordinates, (6, ...), that ends the step at the frame."""
    return ((frame - wrist) / h - velocity) / h
