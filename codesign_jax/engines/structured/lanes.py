"""Small linear algebra on lanes: the batch is the last axis, components are leading axes.

A *lane* is an array of shape (finger, world) or one that broadcasts to it; a vector has its components in
front, shape (3, ..., finger, world); a 6 x 6 matrix is a list of six rows of shape (6, finger, world).
Sums over short axes are written out: XLA's reductions over them are far slower than additions on a CPU.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp


def total(terms: Sequence[jax.Array]) -> jax.Array:
    """Sum of a short list."""
    result = terms[0]
    for term in terms[1:]:
        result = result + term
    return result


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Sum over the leading axis of a * b."""
    return total([a[i] * b[i] for i in range(a.shape[0])])


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross product of vectors with the components in front."""
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def spatial(angular: jax.Array, linear: jax.Array) -> jax.Array:
    """Spatial vector (angular, linear) of six components."""
    return jnp.concatenate([angular, linear])


def motion_cross(v: jax.Array, s: jax.Array) -> jax.Array:
    """Spatial cross product of motion vectors, v x s."""
    return spatial(cross(v[:3], s[:3]), cross(v[:3], s[3:]) + cross(v[3:], s[:3]))


def rotate(columns: list[jax.Array], axis: int, angle_cos: jax.Array, angle_sin: jax.Array) -> list:
    """Turns a frame, given by its columns, about its own axis 0, 1 or 2."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turned = list(columns)
    turned[i] = angle_cos * columns[i] + angle_sin * columns[j]
    turned[j] = angle_cos * columns[j] - angle_sin * columns[i]
    return turned


def sum_fingers(x: jax.Array) -> jax.Array:
    """Sum over the finger axis, kept with length one."""
    return total([x[..., f : f + 1, :] for f in range(x.shape[-2])])


def inverse_spd(m: list[list[jax.Array]]) -> list[list[jax.Array]]:
    """Inverse of a symmetric positive definite matrix of order 1 to 3, by cofactors."""
    n = len(m)
    if n == 1:
        return [[1.0 / m[0][0]]]
    if n == 2:
        scale = 1.0 / (m[0][0] * m[1][1] - m[0][1] * m[0][1])
        off = -m[0][1] * scale
        return [[m[1][1] * scale, off], [off, m[0][0] * scale]]
    (a, b, c), (_, d, e), (_, _, f) = m
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * aa + b * bb + c * cc)
    ab, ac, bc = bb * scale, cc * scale, (b * c - a * e) * scale
    return [
        [aa * scale, ab, ac],
        [ab, (a * f - c * c) * scale, bc],
        [ac, bc, (a * d - b * b) * scale],
    ]
