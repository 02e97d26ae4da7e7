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


class MeshLanes(NamedTuple):
    """The tables on the device, and each world's rows of them.

    Attributes:
      values: Grid values of all meshes [m], flat: of the scene, not of a world.
      first: Index of the first value of the world's grid, shape (1, world).
      nodes: Nodes along each axis, shape (3, 1, world).
      origin: Position of the first node [m], shape (3, 1, world).
      cell: Distance of the nodes [m], shape (1, world).
      factor: Factor on the mesh's size, shape (1, world).
      support: Support points of the mesh as large as it is [m], shape (3, point, world).
    """

    values: jax.Array
    first: jax.Array
    nodes: jax.Array
    origin: jax.Array
    cell: jax.Array
    factor: jax.Array
    support: jax.Array


def mesh_lanes(scene: Scene, shape: jax.Array, size: jax.Array) -> MeshLanes | None:
    """Looks up the meshes of a batch, once a rollout; None for a scene without meshes.

    Args:
      scene: The scene.
      shape: Index of each world's object, shape (1, world).
      size: Half sizes, shape (3, 1, world).
    """
    t = tables(scene)
    if t is None:
        return None

    def row(table: np.ndarray) -> jax.Array:
        floating = np.issubdtype(table.dtype, np.floating)
        picked = jnp.asarray(table, size.dtype if floating else None)[shape[0]]
        return jnp.moveaxis(picked, 0, -1)

    factor = size[0] / row(t.half)
    return MeshLanes(
        values=jnp.asarray(t.values, size.dtype),
        first=row(t.first)[None],
        nodes=row(t.nodes)[:, None],
        origin=row(t.origin)[:, None],
        cell=row(t.cell)[None],
        factor=factor,
        support=factor * jnp.moveaxis(row(t.support), 1, 0),
    )


def signed_distance(lanes: MeshLanes, p: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Signed distance and its unit gradient in the object's frame by trilinear interpolation.

    Beyond the grid, where no contact begins, the way back to it is added.

    Args:
      lanes: The worlds' meshes.
      p: Points, shape (3, ..., world).
    """
    axes, nodes = range(3), lanes.nodes
    scaled = [(p[k] / lanes.factor - lanes.origin[k]) / lanes.cell for k in axes]
    inside = [jnp.clip(scaled[k], 0.0, (nodes[k] - 1).astype(p.dtype)) for k in axes]
    index = [jnp.minimum(inside[k].astype(jnp.int32), nodes[k] - 2) for k in axes]
    part = [inside[k] - index[k].astype(p.dtype) for k in axes]
    corner = lanes.first + (index[0] * nodes[1] + index[1]) * nodes[2] + index[2]
    value, slope = _interpolate(lanes.values, corner, (nodes[1] * nodes[2], nodes[2]), part)
    beyond = jnp.stack([scaled[k] - inside[k] for k in axes]) * lanes.cell
    back = jnp.sqrt(dot(beyond, beyond) + _FAR**2)
    gradient = slope / lanes.cell + beyond / back
    length = jnp.sqrt(dot(gradient, gradient) + _FAR**2)
    return lanes.factor * (value + back - _FAR), gradient / length


def _interpolate(
    values: jax.Array, corner: jax.Array, strides: tuple, part: list[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Value and gradient per cell at fractions `part` of the cells with the given first corners."""
    x, y, z = part

    def edge(i: int, j: int) -> tuple[jax.Array, jax.Array]:
        """Interpolates along z on the cell's edge (i, j)."""
        at = corner + i * strides[0] + j * strides[1]
        low, high = values[at], values[at + 1]
        return low + z * (high - low), high - low

    (a, az), (b, bz), (c, cz), (d, dz) = edge(0, 0), edge(0, 1), edge(1, 0), edge(1, 1)
    low, high = a + y * (b - a), c + y * (d - c)
    low_z, high_z = az + y * (bz - az), cz + y * (dz - cz)
    slope_y = (b - a) + x * ((d - c) - (b - a))
    slope = jnp.stack([high - low, slope_y, low_z + x * (high_z - low_z)])
    return low + x * (high - low), slope


def table_points(lanes: MeshLanes, columns: jax.Array) -> jax.Array:
    """Four support points that carry an object on a plane, from its centre, shape (3, 4, world).

    The lowest; the one farthest from it; then the farthest on either side of the line through both.
    Heights count against distances, so that higher points are taken only when no lower one is left.

    Args:
      lanes: The worlds' meshes.
      columns: Columns of the object's orientation, shape (3, 3, world).
    """
    point = jnp.stack([dot(columns[:, i], lanes.support) for i in range(3)])
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
