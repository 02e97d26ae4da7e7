"""States of a batch in lanes, and MuJoCo's coordinates of them."""

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import model
from codesign_jax.engines.structured.laws.kinematics import Acc, State
from codesign_jax.model import ModelFields, held, layout
from codesign_jax.model.layout import hinge_sign
from codesign_jax.scene import Scene


def reset(scene: Scene, fields: ModelFields) -> State:
    """The states in which rollouts of model fields begin, leading axis (world,), in lanes."""
    return _in_lanes(scene, model.split(scene, fields.start))


def make(
    scene: Scene, qpos: jax.Array, qvel: jax.Array, acc: jax.Array, hold: jax.Array | None = None
) -> State:
    """The state at MuJoCo's coordinates, at the beginning of a grasp.

    Args:
      qpos: Generalized positions, shape (world, nq).
      qvel: Generalized velocities, shape (world, nv).
      acc: Accelerations, the solver's warm start, in the order of qvel, the object's as in
        `kinematics.Acc`, shape (world, nv).
      hold: What contacts hold of friction, `held` in `model.RolloutState`; None for nothing.
    """
    start = model.split(scene, jnp.concatenate([qpos, qvel], 1))
    start = start if hold is None else start._replace(held=hold)
    return _in_lanes(scene, start._replace(acc=acc))


def _in_lanes(scene: Scene, start: model.RolloutState) -> State:
    lay = layout(scene)
    end = 6 + lay.dofs.size
    q, v, a, step, going, speed = (jnp.asarray(x).T[:, None] for x in start[:6])

    def finger(x: jax.Array) -> jax.Array:
        return jnp.moveaxis(x[:, 0][lay.dofs], 0, 2)

    return State(
        wrist=q[:6],
        finger=finger(q),
        position=q[end : end + 3],
        quat=q[end + 3 :],
        wrist_vel=v[:6],
        finger_vel=finger(v),
        linear_vel=v[end : end + 3],
        angular_vel=v[end + 3 :],
        acc=Acc(a[:6], finger(a), a[end:]),
        step=step,
        going=going,
        speed=speed,
        overlap=jnp.zeros_like(speed),
        held=jnp.asarray(start.held).T.reshape(-1, held.lanes(scene), q.shape[-1]),
    )


def _flat(wrist: jax.Array, finger: jax.Array, *rest: jax.Array) -> jax.Array:
    forward = hinge_sign(np.arange(len(finger))) > 0
    hinges = jnp.where(forward[:, None, None, None], finger, finger[:, ::-1])
    joints = jnp.moveaxis(hinges, 2, 0).reshape(-1, finger.shape[-1])
    return jnp.concatenate([wrist[:, 0], joints, *(x[:, 0] for x in rest)]).T


def qpos(state: State) -> jax.Array:
    """MuJoCo's qpos, shape (world, nq)."""
    return _flat(state.wrist, state.finger, state.position, state.quat)


def qvel(state: State) -> jax.Array:
    """MuJoCo's qvel, shape (world, nv)."""
    return _flat(state.wrist_vel, state.finger_vel, state.linear_vel, state.angular_vel)


def flat_acc(acc: Acc) -> jax.Array:
    """Accelerations in the order of qvel, shape (world, nv); the object's as in `Acc`."""
    return _flat(acc.wrist, acc.finger, acc.object)


def flat(state: State) -> jax.Array:
    """MuJoCo's qpos, then qvel, shape (world, nq + nv)."""
    return jnp.concatenate([qpos(state), qvel(state)], 1)


def whole(state: State) -> jax.Array:
    """The state as `Trace.last` has it, see `model.RolloutState`."""
    # A step of a decided world leaves accelerations that nothing reads and that may be no numbers.
    acc = jnp.where(state.going[0, 0, :, None] > 0, flat_acc(state.acc), 0.0)
    numbers = (x[0].T for x in (state.step, state.going, state.speed))
    hold = state.held.reshape(-1, state.held.shape[-1]).T
    return jnp.concatenate([flat(state), acc, *numbers, hold], 1)
