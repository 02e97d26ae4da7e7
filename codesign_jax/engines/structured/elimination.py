"""Elimination of a joint from a quadratic of the link's and the object's accelerations.

The objective of a subtree, as a function of its base link's spatial acceleration v and the object's v_o, is
  1/2 v'P v - v'C v_o + 1/2 v_o'Q v_o - r'v - r_o'v_o.
With v = v_parent + S a and the joint's own 1/2 a'(arm)a - tau'a, minimising over the joint accelerations a
gives the same form in v_parent: Featherstone's articulated-body recursion (Rigid Body Dynamics Algorithms,
2008, ch. 7) extended by the object that every finger may touch.  About 650 multiply-adds for three axes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import dot, inverse_spd, total


class Quadratic(NamedTuple):
    """Coefficients of a subtree's objective.

    Attributes:
      p: Rows of P, shape (6, 6, finger, world).
      c: Rows of C, same shape.
      q: Rows of Q, same shape.
      r: r, shape (6, finger, world).
      r_object: r_o, same shape.
    """

    p: jax.Array
    c: jax.Array
    q: jax.Array
    r: jax.Array
    r_object: jax.Array


class Factors(NamedTuple):
    """What back substitution needs: a = z - w v_parent + g v_o.

    Attributes:
      w: D^-1 U', shape (axis, 6, finger, world).
      g: D^-1 S'C, same shape.
      z: D^-1 (S'r + tau), shape (axis, finger, world).
    """

    w: jax.Array
    g: jax.Array
    z: jax.Array


def eliminate(
    node: Quadratic, axes: jax.Array, arm: jax.Array, tau: jax.Array
) -> tuple[Quadratic, Factors]:
    """Minimises over the accelerations of a joint.

    Args:
      node: The subtree's objective in its base link's acceleration.
      axes: Motion subspace S, shape (axis, 6, finger, world).
      arm: Diagonal joint inertia (armature with implicit terms), shape (axis, finger, world).
      tau: Joint force, same shape.

    Returns:
      The objective in the parent's acceleration and the factors for `substitute`.
    """
    n = range(axes.shape[0])
    # jnp.stack of separately computed rows keeps XLA from recomputing an intermediate in each user.
    u = jnp.stack([total([node.p[j] * axes[a, j] for j in range(6)]) for a in n])
    h = jnp.stack([total([node.c[j] * axes[a, j] for j in range(6)]) for a in n])
    y = jnp.stack([dot(axes[a], node.r) + tau[a] for a in n])
    d = [[dot(axes[min(a, b)], u[max(a, b)]) for b in n] for a in n]
    inverse = inverse_spd([[d[a][b] + arm[a] if a == b else d[a][b] for b in n] for a in n])
    inverse = jnp.stack([jnp.stack(row) for row in inverse])
    w = jnp.stack([total([inverse[a, b] * u[b] for b in n]) for a in n])
    g = jnp.stack([total([inverse[a, b] * h[b] for b in n]) for a in n])
    z = jnp.stack([total([inverse[a, b] * y[b] for b in n]) for a in n])
    reduced = Quadratic(
        p=jnp.stack([node.p[i] - total([u[a, i] * w[a] for a in n]) for i in range(6)]),
        c=jnp.stack([node.c[i] - total([u[a, i] * g[a] for a in n]) for i in range(6)]),
        q=jnp.stack([node.q[i] - total([h[a, i] * g[a] for a in n]) for i in range(6)]),
        r=node.r - total([u[a] * z[a] for a in n]),
        r_object=node.r_object + total([h[a] * z[a] for a in n]),
    )
    return reduced, Factors(w, g, z)


def substitute(factors: Factors, parent: jax.Array, object_acc: jax.Array) -> jax.Array:
    """Joint accelerations, shape (axis, finger, world), from the parent's and the object's (6, ...)."""
    n = range(factors.z.shape[0])
    return jnp.stack(
        [factors.z[a] - dot(factors.w[a], parent) + dot(factors.g[a], object_acc) for a in n]
    )


def solve_object(q: jax.Array, r: jax.Array) -> jax.Array:
    """Solves Q v_o = r for the six object accelerations, by 3 x 3 blocks.

    Args:
      q: Rows of Q, shape (6, 6, 1, world).
      r: Right-hand side, shape (6, 1, world).
    """
    top = inverse_spd([[q[i, j] for j in range(3)] for i in range(3)])
    top = jnp.stack([jnp.stack(row) for row in top])
    # L = Q_ba Q_aa^-1, Schur complement Q_bb - L Q_ab.
    low = jnp.stack([total([top[i] * q[3 + k, i] for i in range(3)]) for k in range(3)])
    schur = jnp.stack(
        [q[3 + k, 3:] - total([q[i, 3:] * low[k, i] for i in range(3)]) for k in range(3)]
    )
    inverse = inverse_spd([[schur[i, j] for j in range(3)] for i in range(3)])
    rest = [r[3 + k] - dot(low[k], r[:3]) for k in range(3)]
    second = jnp.stack([total([inverse[k][i] * rest[i] for i in range(3)]) for k in range(3)])
    reduced = [r[i] - dot(q[i, 3:], second) for i in range(3)]
    first = jnp.stack([total([top[k, i] * reduced[i] for i in range(3)]) for k in range(3)])
    return jnp.concatenate([first, second])
