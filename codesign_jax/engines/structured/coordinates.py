"""States of a batch in lanes, and MuJoCo's coordinates of them."""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.laws.kinematics import Acc, State
from codesign_jax.model import ModelFields, layout
from codesign_jax.model.layout import pairings_held
from codesign_jax.scene import Scene


def reset(scene: Scene, fields: ModelFields) -> State:
    """Start states of a batch, fields with leading axis (world,)."""
    qvel = jnp.asarray(fields.qvel)
    return make(scene, fields.qpos, qvel, jnp.zeros_like(qvel))


def make(scene: Scene, qpos: jax.Array, qvel: jax.Array, acc: jax.Array) -> State:
    """The state at MuJoCo's coordinates.

    Args:
      scene: The scene.
      qpos: Generalized positions, shape (world, nq).
      qvel: Generalized velocities, shape (world, nv).
      acc: Accelerations, the solver's warm start, in the order of qvel, the object's as in
        `kinematics.Acc`, shape (world, nv).
    """
    lay, held = layout(scene), pairings_held(scene)
    end = 6 + lay.dofs.size
    q, v, a = (x.T[:, None] for x in (qpos, qvel, acc))

    def finger(x: jax.Array) -> jax.Array:
        return jnp.moveaxis(x[6:end, 0].reshape(*lay.dofs.shape, -1), 0, 2)

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
        grip=jnp.zeros((held, 3, len(lay.dofs), len(qpos)), q.dtype) if held else None,
    )


def _flat(wrist: jax.Array, finger: jax.Array, *rest: jax.Array) -> jax.Array:
    joints = jnp.moveaxis(finger, 2, 0).reshape(-1, finger.shape[-1])
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
    """Generalized positions and velocities, shape (world, nq + nv)."""
    return jnp.concatenate([qpos(state), qvel(state)], 1)


def speed(state: State) -> jax.Array:
    """Largest absolute generalized velocity; not finite if any velocity or position is not."""
    return jnp.abs(qvel(state)).max(1) + 0.0 * qpos(state).sum(1)
