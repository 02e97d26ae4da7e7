"""Exact signed distance to a closed triangle mesh, and how often it encloses a point, by libigl."""

from typing import Any

import numpy as np


def signed_distance(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Signed distances [m] of points, negative inside, shape (point,).

    The sign comes from the normal at the closest point, which at edges and vertices is the sum over
    the faces there, weighted by their angles (Baerentzen and Aanaes 2005).

    Args:
      vertices: Positions [m], shape (vertex, 3), of a watertight mesh.
      faces: Vertex indices, shape (face, 3), outwards, none of them degenerate.
      points: Positions [m], shape (point, 3).
    """
    import igl  # which takes half a second, and only scenes with meshes need it

    sign: Any = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    result = igl.signed_distance(points, vertices, _indices(faces), sign_type=sign)
    return np.asarray(result[0])


def winding(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How often a closed surface encloses each point, shape (point,): its solid angle over 4 pi."""
    import igl

    return np.asarray(igl.winding_number(vertices, _indices(faces), points))


def turned_alike(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces turned so that neighbours agree, and the number of the part that each belongs to."""
    import igl

    turned, part = igl.bfs_orient(_indices(faces))
    return np.asarray(turned), np.asarray(part)


def _indices(faces: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(faces, np.int64)
