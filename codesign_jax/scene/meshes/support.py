"""Points of a body that can touch a plane."""

import numpy as np
from scipy.spatial import ConvexHull

MAX_POINTS = 256


def support_points(vertices: np.ndarray, limit: int = MAX_POINTS) -> np.ndarray:
    """Vertices of the convex hull, or a spread-out selection of them, shape (point, 3).

    No other point of a body can be its lowest.  Of more than `limit` vertices those are taken that
    are farthest from the ones taken before; a ball of 30 mm then loses 0.5 mm at the most.
    """
    hull = vertices[ConvexHull(vertices).vertices]
    if len(hull) <= limit:
        return hull
    chosen = [int(np.linalg.norm(hull, axis=1).argmax())]
    nearest = np.linalg.norm(hull - hull[chosen[0]], axis=1)
    while len(chosen) < limit:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(hull - hull[chosen[-1]], axis=1))
    return hull[chosen]
