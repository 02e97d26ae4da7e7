"""Elimination of a joint from a quadratic of the link's and the object's accelerations.

The objective of a subtree, as a function of its base link's spatial acceleration v and the object's
v_o, is
  1/2 v'P v - v'C v_o + 1/2 v_o'Q v_o - r'v - r_o'v_o.
With v = v_parent + S a and the joint's own 1/2 a' diag(armature) a - tau'a, minimising over the
joint accelerations a gives the same form in v_parent: Featherstone's articulated-body recursion
(Rigid Body Dynamics Algorithms, 2008, ch. 7) extended by the object that every finger may touch.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import contract, inverse_spd


class Quadratic(NamedTuple):
    """Coefficients of a subtree's objective.

    Where nothing of the hand may touch the object c, q and r_object are None.
    """

    p: jax.Array  # P, shape (6, 6, finger, world)
    c: jax.Array  # C, same shape
    q: jax.Array  # Q, same shape
    r: jax.Array  # r, shape (6, finger, world)
    r_object: jax.Array  # r_o, same shape


class Factors(NamedTuple):
    """What back substitution needs: a = z - w v_parent + g v_o."""

    w: jax.Array  # D^-1 U', shape (axis, 6, finger, world)
    g: jax.Array  # D^-1 S'C, same shape
    z: jax.Array  # D^-1 (S'r + tau), shape (axis, finger, world)


class Kept(NamedTuple):
    """What another right side needs: see `eliminate_again`."""

    factors: Factors  # The factors
    inverse: jax.Array  # D^-1, shape (axis, axis, finger, world)


def eliminate(
    node: Quadratic, axes: jax.Array, armature: jax.Array, tau: jax.Array
) -> tuple[Quadratic, Kept]:
    """Minimises over the accelerations of a joint.

    Args:
      axes: Motion subspace S, shape (axis, 6, finger, world).
      armature: Diagonal joint inertia (armature with implicit terms), shape (axis, finger, world).
      tau: Joint force, same shape.

    Returns:
      The objective in the parent's acceleration, and what other right sides need.
    """
    u, h, y = _project(node.p, node.c, node.r, axes, tau)
    inverse = _joint_inverse(axes, u, armature)
    factors = Factors(*_factor(inverse, u, h, y))
    return Quadratic(*_reduce(node, u, h, factors)), Kept(factors, inverse)


def eliminate_again(
    axes: jax.Array, kept: Kept, r: jax.Array, r_object: jax.Array, tau: jax.Array | None = None
) -> tuple[jax.Array, jax.Array, Factors]:
    """`eliminate` of the same matrix with other forces, by a sixth of the operations.

    Since r - U z = r - (D^-1 U')'y.

    Args:
      r: Force on the subtree's base link, shape (6, finger, world); `r_object`: on the object.
      tau: Force on the joint, shape (axis, finger, world); None for none.
    """
    w, g, _ = kept.factors
    y = contract(axes, r[None], 1)
    y = y if tau is None else y + tau
    r_object = r_object if g is None else r_object + contract(g, y[:, None], 0)
    z = contract(kept.inverse, y[None], 1)
    return r - contract(w, y[:, None], 0), r_object, kept.factors._replace(z=z)


def _project(p: jax.Array, c: jax.Array | None, r: jax.Array, axes: jax.Array, tau: jax.Array):
    """U = P S, H = S'C and y = S'r + tau, transposed to rows by axis."""
    u = contract(p[None], axes[:, None], 2)
    h = None if c is None else contract(axes[:, :, None], c[None], 1)
    return u, h, contract(axes, r[None], 1) + tau


def _joint_inverse(axes: jax.Array, u: jax.Array, armature: jax.Array) -> jax.Array:
    """D^-1 with D = S'P S + armature."""
    n = axes.shape[0]
    eye = jnp.eye(n, dtype=axes.dtype)[:, :, None, None]
    matrix = contract(axes[:, None], u[None], 2) + eye * armature[:, None]
    return inverse_spd(matrix)


def _factor(inverse: jax.Array, u: jax.Array, h: jax.Array | None, y: jax.Array):
    return (
        contract(inverse[:, :, None], u[None], 1),
        None if h is None else contract(inverse[:, :, None], h[None], 1),
        contract(inverse, y[None], 1),
    )


def _reduce(node: Quadratic, u: jax.Array, h: jax.Array | None, f: Factors):
    p = node.p - contract(u[:, :, None], f.w[:, None], 0)
    r = node.r - contract(u, f.z[:, None], 0)
    if h is None:
        return p, None, node.q, r, node.r_object
    return (
        p,
        node.c - contract(u[:, :, None], f.g[:, None], 0),
        node.q - contract(h[:, :, None], f.g[:, None], 0),
        r,
        node.r_object + contract(h, f.z[:, None], 0),
    )


def substitute(
    axes: jax.Array, factors: Factors, parent: jax.Array, object_acc: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Back substitution of one joint: its accelerations, and its link's spatial acceleration.

    Args:
      parent: Spatial acceleration of the parent, shape (6, finger or 1, world); `object_acc` alike.
    """
    a = factors.z - contract(factors.w, parent[None], 1)
    if factors.g is not None:
        a = a + contract(factors.g, object_acc[None], 1)
    return a, parent + contract(axes, a[:, None], 0)


def solve_object(q: jax.Array, r: jax.Array) -> jax.Array:
    """Solves Q v_o = r for the six object accelerations by 3 x 3 blocks, shape (6, 1, world)."""
    top = inverse_spd(q[:3, :3])
    low = contract(q[3:, :3, None], top[None], 1)  # Q_ba Q_aa^-1
    rest = q[3:, 3:] - contract(low[:, :, None], q[None, :3, 3:], 1)
    second = contract(inverse_spd(rest), (r[3:] - contract(low, r[None, :3], 1))[None], 1)
    left = r[:3] - contract(q[:3, 3:], second[None], 1)
    return jnp.concatenate([contract(top, left[None], 1), second])


def wrist_slides(like: jax.Array) -> jax.Array:
    """Motion subspace of the three wrist slides, shape (3, 6, 1, world)."""
    eye = jnp.eye(3, 6, 3, dtype=like.dtype)[:, :, None, None]
    return jnp.broadcast_to(eye, (3, 6, *like.shape[1:]))
