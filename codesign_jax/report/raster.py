"""Triangles as pixels: which one is nearest at each, by a depth buffer in NumPy."""

from typing import NamedTuple

import numpy as np


class Pixels(NamedTuple):
    """The nearest triangle at each pixel of a picture that has one.

    Attributes:
      at: Index of the pixel in the picture's rows one after another, shape (pixel,).
      face: Index of its triangle, same shape.
      share: Weights of the triangle's corners in space, shape (pixel, 3).
      away: Distance along the direction of view [m], shape (pixel,).
    """

    at: np.ndarray
    face: np.ndarray
    share: np.ndarray
    away: np.ndarray


def nearest(
    corners: np.ndarray, away: np.ndarray, size: tuple[int, int], *, flat: bool = False
) -> Pixels:
    """Finds the nearest triangle at the middle of each pixel.

    Args:
      corners: Places of the corners in the picture [pixel], shape (face, 3, 2).
      away: Their distances along the direction of view [m], above 0, shape (face, 3).
      size: Width and height [pixel].
      flat: Whether the picture is a parallel projection, not a perspective.
    """
    low = np.maximum(np.ceil(corners.min(1) - 0.5), 0).astype(int)
    high = np.minimum(np.floor(corners.max(1) - 0.5), np.array(size) - 1).astype(int)
    span = np.maximum(high - low + 1, 0)
    count = span[:, 0] * span[:, 1]
    face = np.repeat(np.arange(len(corners)), count)
    offset = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    column = low[face, 0] + offset % span[face, 0]
    row = low[face, 1] + offset // span[face, 0]
    weight = _weights(corners, face, column + 0.5, row + 0.5)
    inside = (weight >= 0).all(1)
    face = face[inside]
    weight = weight[inside]
    at = (row * size[0] + column)[inside]
    if not flat:  # what is linear in the picture is the inverse of the distance
        weight = weight / away[face]
        scale = weight.sum(1, keepdims=True)
        weight = weight / scale
        distance = 1 / scale[:, 0]
    else:
        distance = (weight * away[face]).sum(1)
    order = np.argsort(-distance, kind="stable")
    winner = np.full(size[0] * size[1], -1)
    winner[at[order]] = order  # of several values for one pixel the last one stays
    winner = winner[winner >= 0]
    return Pixels(at[winner], face[winner], weight[winner], distance[winner])


def _weights(corners: np.ndarray, face: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points in their triangles, shape (point, 3); NaN without area."""
    a, b, c = np.moveaxis(corners, 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / area
        edges = []
        for p, q in ((b, c), (c, a)):
            slope = (q - p) * inverse[:, None]
            start = -slope[:, 0] * p[:, 1] + slope[:, 1] * p[:, 0]
            edges.append(slope[face, 0] * y - slope[face, 1] * x + start[face])
        return np.stack([*edges, 1 - edges[0] - edges[1]], 1)
