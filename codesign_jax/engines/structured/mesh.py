"""Mesh objects in lanes: distance by interpolation of voxel grids, support points on the table.

The grids of all meshes of a scene lie one after the other in one array, each with its own shape and
cell: worlds with different meshes read different parts of it, in one program, and no mesh pays for
the resolution or the size of another.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanes import dot
from codesign_jax.scene import Scene
from codesign_jax.schema import SceneError

_FAR = 1e-12  # added under square roots: keeps their derivative finite
# A support point counts as one metre lower for this many metres that it lies farther out: on a face
# that is level to 1/20 the four contacts spread, on a steeper one they stay at its lowest edge.
_STEEPEST = 20.0


class Tables(NamedTuple):
    """Constants of a scene's meshes, a row for each shape of the set; those of primitives are void.

    Attributes:
      values: Grid values of all meshes [m], flat, z fastest.
      first: Index of each grid's first value, shape (shape,).
      nodes: Nodes along each axis, shape (shape, 3).
      origin: Position of the first node [m], shape (shape, 3).
      cell: Distance of the nodes [m], shape (shape,).
      half: First half size, by which the size of a world's object is known, shape (shape,).
      support: Support points [m], shape (shape, point, 3); their number is a power of two.
    """

    values: np.ndarray
    first: np.ndarray
    nodes: np.ndarray
    origin: np.ndarray
    cell: np.ndarray
    half: np.ndarray
    support: np.ndarray


@functools.cache
def tables(scene: Scene) -> Tables | None:
    """Builds the grids of a scene's meshes; None without any.

    Raises:
      SceneError: with every mesh whose distance cannot be put on a grid.
    """
    problems: list[str] = []
    grids, supports = {}, {}
    for i, shape in enumerate(scene.objects.object):
        if not shape.mesh:
            continue
        try:
            grids[i], supports[i] = shape.mesh.grid, shape.mesh.support
        except SceneError as error:
            problems += [f"object {shape.name!r}: {p}" for p in error.problems]
    if problems:
        raise SceneError(problems)
    if not grids:
        return None
    count = len(scene.objects.object)
    points = 1 << (max(len(s) for s in supports.values()) - 1).bit_length()
    result = Tables(
        np.concatenate([g.values.ravel() for g in grids.values()]),
        np.zeros(count, np.int32),
        np.full((count, 3), 2, np.int32),
        np.zeros((count, 3)),
        np.ones(count),
        np.ones(count),
        np.zeros((count, points, 3)),
    )
    start = 0
    for i, grid in grids.items():
        result.first[i], result.nodes[i], result.cell[i] = start, grid.values.shape, grid.cell
        result.origin[i], result.half[i] = grid.origin, scene.objects.object[i].half_sizes[0]
        result.support[i] = np.resize(supports[i], (points, 3))  # repeats the points
        start += grid.values.size
    return result


def signed_distance(
    scene: Scene, shape: jax.Array, size: jax.Array, p: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Signed distance and its unit gradient in the object's frame by trilinear interpolation.

    Beyond the grid, where no contact begins, the way back to it is added.

    Args:
      scene: The scene.
      shape: Index of each world's object, shape (1, world).
      size: Half sizes, shape (3, 1, world).
      p: Points, shape (3, ..., world).
    """
    t = tables(scene)
    assert t is not None
    factor = size[0] / _row(t.half, shape, p.dtype)
    origin, cell = _row(t.origin, shape, p.dtype), _row(t.cell, shape, p.dtype)
    nodes = [jnp.asarray(t.nodes[:, k])[shape] for k in range(3)]
    scaled = [(p[k] / factor - origin[k]) / cell for k in range(3)]
    inside = [jnp.clip(x, 0.0, (n - 1).astype(p.dtype)) for x, n in zip(scaled, nodes, strict=True)]
    index = [jnp.minimum(x.astype(jnp.int32), n - 2) for x, n in zip(inside, nodes, strict=True)]
    part = [x - i.astype(p.dtype) for x, i in zip(inside, index, strict=True)]
    corner = (index[0] * nodes[1] + index[1]) * nodes[2] + index[2] + jnp.asarray(t.first)[shape]
    strides = (nodes[1] * nodes[2], nodes[2], jnp.ones_like(nodes[2]))
    value, slope = _interpolate(jnp.asarray(t.values, p.dtype), corner, strides, part)
    beyond = jnp.stack([x - q for x, q in zip(scaled, inside, strict=True)]) * cell
    back = jnp.sqrt(dot(beyond, beyond) + _FAR**2)
    gradient = slope / cell + beyond / back
    length = jnp.sqrt(dot(gradient, gradient) + _FAR**2)
    return factor * (value + back - _FAR), gradient / length


def _row(table: np.ndarray, shape: jax.Array, dtype) -> jax.Array:
    """Each world's row with its components in front, shape (..., 1, world)."""
    return jnp.moveaxis(jnp.asarray(table, dtype)[shape], (0, 1), (-2, -1))


def _interpolate(
    values: jax.Array, corner: jax.Array, strides: tuple, part: list[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Value and gradient per cell at fractions `part` of the cells with the given first corners."""
    x, y, z = part

    def edge(i: int, j: int) -> tuple[jax.Array, jax.Array]:
        """Interpolates along z on the cell's edge (i, j)."""
        at = corner + i * strides[0] + j * strides[1]
        low, high = values[at], values[at + strides[2]]
        return low + z * (high - low), high - low

    (a, az), (b, bz), (c, cz), (d, dz) = edge(0, 0), edge(0, 1), edge(1, 0), edge(1, 1)
    low, high = a + y * (b - a), c + y * (d - c)
    low_z, high_z = az + y * (bz - az), cz + y * (dz - cz)
    slope_y = (b - a) + x * ((d - c) - (b - a))
    slope = jnp.stack([high - low, slope_y, low_z + x * (high_z - low_z)])
    return low + x * (high - low), slope


def table_points(scene: Scene, shape: jax.Array, size: jax.Array, columns: jax.Array) -> jax.Array:
    """Four support points that carry an object on a plane, from its centre, shape (3, 4, world).

    The lowest; the one farthest from it; then the farthest on either side of the line through both.
    Heights count against distances, so that higher points are taken only when no lower one is left.

    Args:
      scene: The scene.
      shape: Index of each world's object, shape (world,).
      size: Half sizes, shape (3, world).
      columns: Columns of the object's orientation, shape (3, 3, world).
    """
    t = tables(scene)
    assert t is not None
    local = jnp.moveaxis(jnp.asarray(t.support, size.dtype)[shape], 0, -1)  # (point, 3, world)
    local = local * (size[0] / jnp.asarray(t.half, size.dtype)[shape])
    point = jnp.stack([dot(columns[:, i], jnp.moveaxis(local, 1, 0)) for i in range(3)])
    height = _STEEPEST * point[2]
    first = _best(-height, point)
    away = point - first[:, None]
    second = _best(jnp.sqrt(away[0] ** 2 + away[1] ** 2 + _FAR**2) - height, point)
    line = second - first
    line = line / jnp.sqrt(line[0] ** 2 + line[1] ** 2 + _FAR**2)
    side = line[0] * away[1] - line[1] * away[0]
    third, fourth = _best(side - height, point), _best(-side - height, point)
    return jnp.stack([first, second, third, fourth], 1)


def _best(score: jax.Array, point: jax.Array) -> jax.Array:
    """The point with the largest score, (point, world) and (3, point, world) to (3, world).

    By halving: vectorized over worlds, where XLA's argmax on a CPU is not.
    """
    while score.shape[0] > 1:
        half = score.shape[0] // 2
        keep = score[:half] >= score[half:]
        point = jnp.where(keep, point[:, :half], point[:, half:])
        score = jnp.where(keep, score[:half], score[half:])
    return point[:, 0]
