"""Small linear algebra on lanes: the batch is the last axis, components are leading axes.

A *lane* is an array of shape (finger, world) or one that broadcasts to it; a vector has its
components in front, shape (3, ..., finger, world), a matrix two such axes.  Sums over short axes
are written out: XLA's reductions over them are many times slower than additions on a CPU.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp


def once(function: Callable, *args: Any) -> Any:
    """Returns function(*args), which XLA computes once; both are pytrees of arrays.

    XLA's fusion recomputes an intermediate in every kernel that uses it; in a chain of small matrix
    products that multiplies the work by ten and the compile time by a hundred.
    """
    return jax.lax.optimization_barrier(function(*args))


def directly(function: Callable, *args: Any) -> Any:
    """Returns function(*args): the plain way to apply a stage of a law to arrays."""
    return function(*args)


def scan_links(step: Callable, first: Any, links: Any) -> tuple[Any, Any]:
    """`jax.lax.scan` over links, whose slices are rows to the compiler.

    XLA's CPU loops that slice an array of five axes at a dynamic index are not vectorised, those
    that slice one of two or three axes are: a copy of 34 kB takes 2 instead of 8 microseconds.

    Args:
      step: From carry and the arrays of one link to carry and output.
      first: First carry.
      links: Arrays with leading axis (link,).
    """
    leading, treedef = jax.tree.flatten(links)
    count = leading[0].shape[0]
    out_shapes = []
    rows = [x.reshape(count, -1) for x in leading]

    def body(carry: Any, i: jax.Array) -> tuple[Any, Any]:
        arrays = [
            jax.lax.dynamic_index_in_dim(x, i, 0, keepdims=False).reshape(like.shape[1:])
            for x, like in zip(rows, leading, strict=True)
        ]
        carry, out = step(carry, jax.tree.unflatten(treedef, arrays))
        out_shapes[:] = [x.shape for x in jax.tree.leaves(out)]
        return carry, jax.tree.map(lambda x: x.reshape(-1), out)

    last, flat = jax.lax.scan(body, first, jnp.arange(count))
    leaves, out_def = jax.tree.flatten(flat)
    whole = [x.reshape(count, *s) for x, s in zip(leaves, out_shapes, strict=True)]
    return last, jax.tree.unflatten(out_def, whole)


def total(terms: Sequence[jax.Array]) -> jax.Array:
    """Sum of arrays, written out."""
    result = terms[0]
    for term in terms[1:]:
        result = result + term
    return result


def contract(a: jax.Array, b: jax.Array, axis: int) -> jax.Array:
    """Sum over one axis of the broadcast product, written out."""

    def take(x: jax.Array, i: int) -> jax.Array:
        return jax.lax.index_in_dim(x, i if x.shape[axis] > 1 else 0, axis, keepdims=False)

    return total([take(a, i) * take(b, i) for i in range(max(a.shape[axis], b.shape[axis]))])


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Sum of a * b over a's leading axis; trailing axes broadcast.

    Of a b with more components, such as a spatial motion, the first ones count.
    """
    return total([x * y for x, y in zip(jnp.unstack(a), jnp.unstack(b)[: len(a)], strict=True)])


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross product of vectors with the components in front; trailing axes broadcast."""
    # Indexing by numbers would be an operation for each use of a component.
    x, y, z = jnp.unstack(a)
    u, v, w = jnp.unstack(b)
    return jnp.stack([y * w - z * v, z * u - x * w, x * v - y * u])


def spatial(angular: jax.Array, linear: jax.Array) -> jax.Array:
    """A spatial vector (6, ...) of its angular and linear parts, (3, ...) each."""
    return jnp.concatenate([angular, linear])


def motion_cross(v: jax.Array, s: jax.Array) -> jax.Array:
    """Spatial cross product of motion vectors, v x s."""
    return spatial(cross(v[:3], s[:3]), cross(v[:3], s[3:]) + cross(v[3:], s[:3]))


def rotate(columns: list[jax.Array], axis: int, angle_cos: jax.Array, angle_sin: jax.Array) -> list:
    """Turns a frame, given by its columns, about its own axis 0, 1 or 2."""
    i = (axis + 1) % 3
    j = (axis + 2) % 3
    turned = list(columns)
    turned[i] = angle_cos * columns[i] + angle_sin * columns[j]
    turned[j] = angle_cos * columns[j] - angle_sin * columns[i]
    return turned


def rotation_columns(quat: jax.Array) -> jax.Array:
    """Columns of the rotation matrix of unit quaternions, (4, ...) to (3 columns, 3, ...)."""
    w, x, y, z = jnp.unstack(quat)
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]),
            jnp.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]),
            jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def apply_columns(columns: jax.Array, v: jax.Array) -> jax.Array:
    """Rotates vectors: columns times components, (3, 3, ...) and (3, ...); items broadcast."""
    parts = jnp.unstack(_items(columns, v))
    return total([column * x for column, x in zip(parts, jnp.unstack(v), strict=True)])


def apply_rows(columns: jax.Array, v: jax.Array) -> jax.Array:
    """Rotates vectors back, the inverse of `apply_columns`: rows times components."""
    parts = jnp.unstack(_items(columns, v), axis=1)
    return total([row * x for row, x in zip(parts, jnp.unstack(v), strict=True)])


def turn_columns(columns: jax.Array, frames: jax.Array) -> jax.Array:
    """Rotates frames given by their columns, (3, 3, ...) both: `apply_columns` of each column."""
    turned = apply_columns(columns[:, :, None], jnp.moveaxis(frames, 1, 0))
    return jnp.moveaxis(turned, 1, 0)


def _items(columns: jax.Array, v: jax.Array) -> jax.Array:
    """The columns with as many axes of items, behind the first two, as the vectors have."""
    missing = v.ndim + 1 - columns.ndim
    if missing <= 0:
        return columns
    return columns.reshape(3, 3, *[1] * missing, *columns.shape[2:])


def sum_axis(x: jax.Array, axis: int) -> jax.Array:
    """Sum over an axis, written out; the axis leaves."""
    return total([jax.lax.index_in_dim(x, i, axis, keepdims=False) for i in range(x.shape[axis])])


def sum_fingers(x: jax.Array) -> jax.Array:
    """Sum over the fingers, (..., finger, world) to (..., 1, world), written out."""
    return sum_axis(x, x.ndim - 2)[..., None, :]


def inverse_spd(m: jax.Array) -> jax.Array:
    """Inverse of positive definite matrices of order 1 to 3, (n, n, ...), by cofactors."""
    n = m.shape[0]
    if n == 1:
        return 1.0 / m
    if n == 2:
        scale = 1.0 / (m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1])
        off = -m[0, 1] * scale
        return jnp.stack([jnp.stack([m[1, 1] * scale, off]), jnp.stack([off, m[0, 0] * scale])])
    a = m[0, 0]
    b = m[0, 1]
    c = m[0, 2]
    d = m[1, 1]
    e = m[1, 2]
    f = m[2, 2]
    aa = d * f - e * e
    bb = c * e - b * f
    cc = b * e - c * d
    scale = 1.0 / (a * aa + b * bb + c * cc)
    ab = bb * scale
    ac = cc * scale
    bc = (b * c - a * e) * scale
    rows = [
        [aa * scale, ab, ac],
        [ab, (a * f - c * c) * scale, bc],
        [ac, bc, (a * d - b * b) * scale],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])
