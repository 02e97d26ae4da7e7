"""Mesh objects in lanes: distance by interpolation of voxel grids, support points on the table.

The grids of all meshes of a scene lie one after the other in one array, each with its own shape and
cell: worlds with different meshes read different parts of it, in one program, and no mesh pays for
the resolution or the size of another.

A distance has three parts, because a kernel evaluates arithmetic component by component and reads
memory by itself: `locate` finds a point's cell, the caller reads the distances at the indices of
`corners`, and `interpolate` makes distance and gradient of them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanes import dot
from codesign_jax.scene import Scene, by_structure
from codesign_jax.scene.schema import InputError

# Grids begin at multiples of this index, which a float32 holds exactly up to 2^31.
_ALIGNED = 128
_FAR = 1e-12  # added under square roots: keeps their derivative finite
# A support point counts as one metre lower for this many metres that it lies farther out: on a face
# that is level to 1/20 the four contacts spread, on a steeper one they stay at its lowest edge.
_STEEPEST = 20.0
# Of points that are level, as those of a round foot, the earlier one counts as lower: a few times
# the rounding of a float32, so that which ones are taken does not depend on it.
_ORDER = 2e-7  # m of score for each point


class MeshTables(NamedTuple):
    """Constants of a scene's meshes, a row a shape of the set; a primitive's is void."""

    values: np.ndarray  # Grid values of all meshes [m], flat, z fastest, float32
    first: np.ndarray  # Index of each grid's first value, shape (shape,)
    nodes: np.ndarray  # Nodes along each axis, shape (shape, 3)
    origin: np.ndarray  # Position of the first node [m], shape (shape, 3)
    cell: np.ndarray  # Distance of the nodes [m], shape (shape,)
    # First half size, by which the size of a world's object is known, shape (shape,)
    half: np.ndarray
    # Support points [m], shape (shape, point, 3); their number is a power of two
    support: np.ndarray


@by_structure
def tables(scene: Scene) -> MeshTables | None:
    """Builds the grids of a scene's meshes; None without any.

    Raises:
      InputError: with every mesh whose distance cannot be put on a grid.
    """
    problems: list[str] = []
    grids = {}
    supports = {}
    for i, shape in enumerate(scene.objects.object):
        if not shape.mesh:
            continue
        try:
            grids[i] = shape.mesh.grid
            supports[i] = shape.mesh.support
        except InputError as error:
            problems += [p.told(f"object {shape.name!r}: {p}") for p in error.problems]
    if problems:
        raise InputError(problems)
    if not grids:
        return None
    count = len(scene.objects.object)
    points = 1 << (max(len(s) for s in supports.values()) - 1).bit_length()
    flat = [np.pad(g.values.ravel(), (0, -g.values.size % _ALIGNED)) for g in grids.values()]
    total = sum(v.size for v in flat)
    # Sizes in powers of two: scenes of other meshes find the programs of this one.
    filled = np.zeros((1 << (total - 1).bit_length()) - total, np.float32)
    result = MeshTables(
        np.concatenate([*flat, filled]),
        np.zeros(count, np.int32),
        np.full((count, 3), 2, np.int32),
        np.zeros((count, 3)),
        np.ones(count),
        np.ones(count),
        np.zeros((count, points, 3)),
    )
    start = 0
    for (i, grid), values in zip(grids.items(), flat, strict=True):
        result.first[i] = start
        result.nodes[i] = grid.values.shape
        result.cell[i] = grid.cell
        result.origin[i] = grid.origin
        result.half[i] = scene.objects.object[i].half_sizes[0]
        result.support[i] = np.resize(supports[i], (points, 3))  # repeats the points
        start += values.size
    return result


class GridLanes(NamedTuple):
    """The grid of each world's mesh."""

    # Index of its first value, shape (1, world), int32 or a float that holds it exactly
    first: jax.Array
    nodes: jax.Array  # Nodes along each axis, shape (3, 1, world), like `first`
    origin: jax.Array  # Position of the first node [m], shape (3, 1, world)
    cell: jax.Array  # Distance of the nodes [m], shape (1, world)
    factor: jax.Array  # Factor on the mesh's size, shape (1, world)


class MeshLanes(NamedTuple):
    """The tables on the device, and each world's rows of them."""

    values: jax.Array  # Grid values of all meshes [m], flat, float32: of the scene, not of a world
    grid: GridLanes  # Where and how large the grid of each world's mesh is
    # Support points of the mesh as large as it is [m], shape (3, point, world); their number is a
    # power of two
    support: jax.Array


class GridCell(NamedTuple):
    """The cells of a grid in which points lie."""

    corner: jax.Array  # Index of the cell's first corner in the values, int32, shape (...)
    part: jax.Array  # Position in the cell, 0 to 1 on each axis, shape (3, ...)
    # Way from the nearest point of the grid to the point, in the mesh's size as it is in its file
    # [m], shape (3, ...)
    beyond: jax.Array


def mesh_lanes(scene: Scene, shape: jax.Array, size: jax.Array) -> MeshLanes | None:
    """Looks up the meshes of a batch, once a rollout; None for a scene without meshes."""
    t = tables(scene)
    if t is None:
        return None

    def row(table: np.ndarray) -> jax.Array:
        floating = np.issubdtype(table.dtype, np.floating)
        picked = jnp.asarray(table, size.dtype if floating else None)[shape[0]]
        return jnp.moveaxis(picked, 0, -1)

    factor = size[0] / row(t.half)
    grid = GridLanes(
        first=row(t.first)[None],
        nodes=row(t.nodes)[:, None],
        origin=row(t.origin)[:, None],
        cell=row(t.cell)[None],
        factor=factor,
    )
    support = factor * jnp.moveaxis(row(t.support), 1, 0)
    return MeshLanes(jnp.asarray(t.values), grid, support)


def signed_distance(lanes: MeshLanes, p: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Signed distance and its unit gradient in the object's frame by trilinear interpolation.

    Beyond the grid, where no contact begins, the way back to it is added.
    """
    cell = locate(lanes.grid, p)
    values = lanes.values[corners(lanes.grid, cell)].astype(p.dtype)
    return interpolate(lanes.grid, cell, values)


def locate(grid: GridLanes, p: jax.Array) -> GridCell:
    """Finds the cells of points (3, ..., world) in the object's frame."""
    axes = range(3)
    nodes = grid.nodes.astype(jnp.int32)
    scaled = [(p[k] / grid.factor - grid.origin[k]) / grid.cell for k in axes]
    inside = [jnp.clip(scaled[k], 0.0, (nodes[k] - 1).astype(p.dtype)) for k in axes]
    # A place that is not a number has to lead to a cell too: kernels do not check indices.
    index = [jnp.clip(inside[k].astype(jnp.int32), 0, nodes[k] - 2) for k in axes]
    part = jnp.stack([inside[k] - index[k].astype(p.dtype) for k in axes])
    # Inside of the grid a constant: in a derivative the two terms would cancel to rounding, and
    # `interpolate` divides by a length of zero.
    beyond = [jnp.where(scaled[k] == inside[k], 0.0, scaled[k] - inside[k]) for k in axes]
    beyond = jnp.stack(beyond) * grid.cell
    first = grid.first.astype(jnp.int32)
    return GridCell(first + (index[0] * nodes[1] + index[1]) * nodes[2] + index[2], part, beyond)


def corners(grid: GridLanes, cell: GridCell) -> jax.Array:
    """Indices of the values at a cell's corners, z fastest, int32 of shape (8, ...)."""
    nodes = grid.nodes.astype(jnp.int32)
    offsets = [i * nodes[1] * nodes[2] + j * nodes[2] + k for i, j, k in np.ndindex(2, 2, 2)]
    return jnp.stack([cell.corner + offset for offset in offsets])


def interpolate(grid: GridLanes, cell: GridCell, values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Signed distance (...) and its unit gradient (3, ...) from the values at `corners`."""
    x, y, z = (cell.part[k] for k in range(3))

    def edge(k: int) -> tuple[jax.Array, jax.Array]:
        """Interpolates along z on an edge of the cell."""
        low = values[2 * k]
        high = values[2 * k + 1]
        return low + z * (high - low), high - low

    (a, az), (b, bz), (c, cz), (d, dz) = (edge(k) for k in range(4))
    low = a + y * (b - a)
    high = c + y * (d - c)
    low_z = az + y * (bz - az)
    high_z = cz + y * (dz - cz)
    slope_y = (b - a) + x * ((d - c) - (b - a))
    slope = jnp.stack([high - low, slope_y, low_z + x * (high_z - low_z)])
    back = jnp.sqrt(dot(cell.beyond, cell.beyond) + _FAR**2)
    gradient = slope / grid.cell + cell.beyond / back
    length = jnp.sqrt(dot(gradient, gradient) + _FAR**2)
    return grid.factor * (low + x * (high - low) + back - _FAR), gradient / length


def table_points(lanes: MeshLanes, columns: jax.Array) -> jax.Array:
    """Four support points that carry an object on a plane, from its centre, shape (3, 4, world).

    The lowest; the one farthest from it; then the farthest on either side of the line through both.
    Heights count against distances, so that higher points are taken only when no lower one is left.
    """
    point = turned(columns, lanes.support)
    index = jnp.arange(point.shape[1], dtype=point.dtype)[:, None]
    first = _best(lowest(point, index), point)
    second = _best(farthest(point, index, first[:, None]), point)
    third, fourth = (
        _best(score, point) for score in beside(point, index, first[:, None], second[:, None])
    )
    return jnp.stack([first, second, third, fourth], 1)


def turned(columns: jax.Array, point: jax.Array) -> jax.Array:
    """Points (3, point, world) of the object's frame along the world's axes."""
    return jnp.stack([dot(columns[:, i], point) for i in range(3)])


def lowest(point: jax.Array, index: jax.Array) -> jax.Array:
    """Score of support points (3, point, world) by their height alone; index: (point, 1)."""
    return -(_STEEPEST * point[2] + _ORDER * index)


def farthest(point: jax.Array, index: jax.Array, first: jax.Array) -> jax.Array:
    """Score by the distance from the first point, (3, 1, world)."""
    away = point - first
    return jnp.sqrt(away[0] ** 2 + away[1] ** 2 + _FAR**2) + lowest(point, index)


def beside(
    point: jax.Array, index: jax.Array, first: jax.Array, second: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Scores by the distance on either side of the line through two points, (3, 1, world)."""
    line = second - first
    away = point - first
    length = jnp.sqrt(line[0] ** 2 + line[1] ** 2 + _FAR**2)
    side = (line[0] * away[1] - line[1] * away[0]) / length
    low = lowest(point, index)
    return side + low, low - side


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
