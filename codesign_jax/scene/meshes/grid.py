"""Signed distance on a voxel grid, as fine as a bound on its interpolation error asks for."""

import io
from typing import Any, NamedTuple

import numpy as np
import trimesh

from codesign_jax import array_files, reuse, terminal
from codesign_jax.scene.meshes.surface import signed_distance

# The error grows in proportion to the cell at edges and with its square elsewhere.
COARSEST = 0.0025
MAX_NODES = 3_000_000  # 12 MB in float32
# Looking for a node's nearest faces takes longest where all are equally far, as in a ball's middle:
# 13 s of processor time for a ball of 82,000 faces and 800,000 nodes.
MAX_WORK = 3e10  # faces times nodes
_NEAR = 0.002  # how far from the surface "near the surface" goes [m]
WORTH_KEEPING = 0.1  # time to build from which a grid is kept [s]; reading one takes milliseconds


class Grid(NamedTuple):
    """Signed distances at the nodes of a regular grid in the body's frame."""

    origin: np.ndarray  # position of node (0, 0, 0) [m], shape (3,)
    cell: float  # distance between neighbouring nodes [m]
    values: np.ndarray  # distances at the nodes [m], float32, shape (nx, ny, nz)
    error: float  # error of interpolation that 99 % of points near the surface stay under [m]
    worst: float  # largest error at any of these points [m]: sharp corners are rounded by so much


_LAYOUT = {
    "origin": array_files.Array("f", (3,)),
    "values": array_files.Array("f", ("x", "y", "z")),
    **dict.fromkeys(("cell", "error", "worst"), array_files.Array("f", ())),
}


def build(vertices: np.ndarray, faces: np.ndarray, bound: float, reach: float) -> Grid:
    """Builds the coarsest grid whose error near the surface stays under a bound.

    The error is measured, not derived: trilinear interpolation against the exact distance at random
    points within 2 mm of the surface, of which 99 % must be better than the bound.  The rest are at
    corners where three edges meet; there the error is half a cell whatever the cell.

    Args:
      vertices: Positions in the body's frame [m], shape (vertex, 3).
      faces: Vertex indices, shape (face, 3).
      bound: Largest error [m].
      reach: How far beyond the surface the grid goes [m]; see `codesign_jax.scene.mesh_margins`.
    """
    points = near_surface(vertices, faces, 3000)
    exact = signed_distance(vertices, faces, points)
    low = vertices.min(0) - reach
    extent = np.ptp(vertices, axis=0) + 2 * reach
    cell = _cell(vertices, faces, points[::4], exact[::4], low, bound)
    while True:
        shape = np.ceil(extent / cell).astype(int) + 1
        if shape.prod() > MAX_NODES:
            raise ValueError(
                f"a grid of {cell * 1e3:.2g} mm cells, which a voxel_error of {bound * 1e3:.3g} mm "
                f"needs, has {shape.prod():,} nodes, more than {MAX_NODES:,}; it goes "
                f"{reach * 1e3:g} mm beyond the surface, as far as the hand's contacts need"
            )
        if shape.prod() * len(faces) > MAX_WORK:
            raise ValueError(
                f"{len(faces):,} faces are too many for a grid of {shape.prod():,} nodes: "
                "use fewer faces or a larger voxel_error"
            )
        values = signed_distance(vertices, faces, _nodes(low, cell, shape))
        grid = Grid(low, cell, values.astype(np.float32).reshape(shape), 0.0, 0.0)
        error = np.abs(interpolate(grid, points) - exact)
        if np.quantile(error, 0.99) <= bound:
            return grid._replace(error=float(np.quantile(error, 0.99)), worst=float(error.max()))
        cell *= 0.9


def near_surface(
    vertices: np.ndarray, faces: np.ndarray, count: int, outside: float | None = None
) -> np.ndarray:
    """Random points within 2 mm of the surface, uniform over its area, shape (point, 3).

    With `outside` all are so far outside of it [m].
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
    offset = outside
    if offset is None:
        offset = np.random.default_rng(0).uniform(-_NEAR, _NEAR, (count, 1))
    return np.asarray(points) + offset * mesh.face_normals[face]


def interpolate(grid: Grid, points: np.ndarray) -> np.ndarray:
    """Trilinear interpolation at points inside the grid, shape (point,)."""
    scaled = (points - grid.origin) / grid.cell
    index = np.clip(np.floor(scaled).astype(int), 0, np.array(grid.values.shape) - 2)
    corners = [grid.values[tuple((index + c).T)] for c in np.ndindex(2, 2, 2)]
    return _blend(np.stack(corners, 1), scaled - index)


def _blend(corners: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Weights values at a cell's corners, (point, 8) with z fastest, by the position in it."""
    block = corners.reshape(-1, 2, 2, 2)
    for k in range(3):
        t = part[:, k].reshape(-1, *[1] * (2 - k))
        block = block[:, 0] * (1 - t) + block[:, 1] * t
    return block


def _cell(
    vertices: np.ndarray,
    faces: np.ndarray,
    points: np.ndarray,
    exact: np.ndarray,
    low: np.ndarray,
    bound: float,
) -> float:
    """Cell that meets the bound at points, without building the grid; it begins at `low`."""
    cell = COARSEST
    offsets = np.array(list(np.ndindex(2, 2, 2)))
    while True:
        base = low + np.floor((points - low) / cell) * cell
        corners = (base[:, None] + offsets * cell).reshape(-1, 3)
        values = signed_distance(vertices, faces, corners).reshape(-1, 8)
        error = np.abs(_blend(values, (points - base) / cell) - exact)
        worst = np.quantile(error, 0.99)
        if worst <= bound or cell < 2e-4:
            return cell
        cell *= max(0.5, min(0.95, bound / worst))


def _nodes(low: np.ndarray, cell: float, shape: np.ndarray) -> np.ndarray:
    axes = [low[k] + cell * np.arange(shape[k]) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def cached(key: str, vertices: np.ndarray, faces: np.ndarray, bound: float, reach: float) -> Grid:
    """Like `build`; grids that take longer than a tenth of a second are kept on disk."""
    name = reuse.key(key, bound, reach)
    if name is None or reuse.limit() is None:
        terminal.wait(f"computing the distances around a mesh of {len(faces):,} faces")
        return build(vertices, faces, bound, reach)
    path = reuse.folder() / "meshes" / f"{name}.kept"

    def build_packed() -> bytes:
        terminal.wait(f"computing the distances around a mesh of {len(faces):,} faces")
        return array_files.packed(build(vertices, faces, bound, reach)._asdict())

    arrays: dict[str, Any] = array_files.unpacked(
        io.BytesIO(reuse.kept(path, build_packed, worth=WORTH_KEEPING)), path, _LAYOUT
    )
    for name in ("cell", "error", "worst"):
        arrays[name] = float(arrays[name])
    return Grid(**arrays)
