"""The finger's hull as a skinned triangle mesh, for pictures and export.

Rings of vertices on the section's outline, |y/a|^4 + |z/b|^4 = 1 or a rectangle, stand along the
finger, from the base to the tip, which a grid of smaller rings closes.  A vertex follows the two
nearest links by linear blend skinning: its weight on link i is a hat function of its place along
the straight finger, one at the link's middle and zero at the middles of its neighbours.  The half
segment at the palm counts as link 0 with its middle at the base, the last half segment's middle is
the tip.  A vertex at x = (j + w) segments, 0 <= w <= 1, thus has weight w on link j + 1 and 1 - w
on link j, and moves with joint j + 1 between them alone:
  position = (1 - w) T_j(v) + w T_{j+1}(v), T the rigid motions of the links.
The topology is the scene's; sizes are the parameters', so that fingers of a batch share it.
"""

import functools
from typing import NamedTuple

import numpy as np

from codesign_jax.scene import Scene
from codesign_jax.types import Tip


class Hull(NamedTuple):
    """Mesh of a finger with places as fractions: of a segment, the width and the height."""

    # Along the finger in segments from its base, across in widths from the middle, up in heights
    # from the bottom layer, shape (vertex, 3)
    place: np.ndarray
    # The two links that a vertex follows, 0 the half segment at the palm, shape (vertex, 2)
    link: np.ndarray
    weight: np.ndarray  # their weights, shape (vertex, 2)
    face: np.ndarray  # vertices of the triangles, counter-clockwise from outside, shape (face, 3)


def outline(points: int, *, square: bool = False) -> np.ndarray:
    """Points on the section's outline (width, height), anticlockwise about x, shape (point, 2)."""
    m = points // 4
    t = np.arange(m) / m
    sides = [(t - 0.5, 0 * t), (0 * t + 0.5, t), (0.5 - t, 0 * t + 1), (0 * t - 0.5, 1 - t)]
    place = np.concatenate([np.stack(s, -1) for s in sides])
    if square:
        return place
    middle = np.array([0.0, 0.5])
    away = place - middle
    return middle + away / (((2 * away) ** 4).sum(1, keepdims=True)) ** 0.25


@functools.lru_cache(maxsize=64)
def _hull(links: int, rings: int, points: int, square: bool) -> Hull:
    ring = outline(points, square=square)
    along = np.arange(1, links * rings + 1) / rings
    scale = 1.0 - np.arange(1, rings + 1) / rings  # rings inside the tip's face
    if not square:  # the cap over the last quarter of a segment; see `rings`
        along[-rings:] = np.minimum(along[-rings:], links - 0.25)
        along[-1] = links - 0.25
    inner = np.stack([ring * x + np.array([0, 0.5]) * (1 - x) for x in scale])
    at = np.full(rings, float(links)) if square else links - 0.25 + 0.25 * (1 - scale**4) ** 0.25
    places = [np.column_stack([np.full(points, x), ring]) for x in along]
    places += [np.column_stack([np.full(points, x), r]) for x, r in zip(at, inner, strict=True)]
    base = np.column_stack([np.zeros(points), ring])
    body = np.concatenate(places)[: len(places) * points - points + 1]  # the last is one point
    place = np.concatenate([[[0.0, 0.0, 0.5]], base, body])
    lower = np.clip(np.ceil(place[:, 0] - 1e-9).astype(int) - 1, 0, links - 1)
    upper_weight = place[:, 0] - lower
    return Hull(
        place,
        np.stack([lower, lower + 1], -1),
        np.stack([1.0 - upper_weight, upper_weight], -1),
        _faces(links * rings + rings, points),
    )


def hull(scene: Scene, *, square: bool = False) -> Hull:
    """The closed mesh of a scene's fingers: base, rings, tip; square: see `outline`."""
    d = scene.discretization
    return _hull(d.links, d.hull_rings, d.hull_points, square)


def _faces(rings: int, points: int) -> np.ndarray:
    i = np.arange(points)
    after = (i + 1) % points
    first = 1 + points * np.arange(rings - 1)[:, None]
    a = first + i
    a_next = first + after
    b = a + points
    b_next = a_next + points
    sides = np.concatenate(
        [
            np.stack([a, b_next, b], -1).reshape(-1, 3),
            np.stack([a, a_next, b_next], -1).reshape(-1, 3),
        ]
    )
    end = 1 + points * (rings - 1)
    base = np.stack([0 * i, 1 + after, 1 + i], -1)
    tip = np.stack([0 * i + end + points, end + i, end + after], -1)
    return np.concatenate([base, sides, tip])


def rest(
    scene: Scene, length: float, height: float, *, square: bool = False, tip: Tip | None = None
) -> np.ndarray:
    """Vertices of the straight finger in the frame of its base [m], shape (vertex, 3)."""
    links = scene.discretization.links
    place = hull(scene, square=square).place
    size = np.array([length / links, scene.hand.section.width, height])
    if tip is not None:
        end = np.array([length / links, tip.width, tip.height])
        size = size + (end - size) * place[:, :1] / links
    return place * size


def link_origins(scene: Scene, length: float) -> np.ndarray:
    """Frames of a straight finger's links along it [m], the half segment first, shape (N + 1,)."""
    segment = length / scene.discretization.links
    return np.concatenate([[0.0], segment * (np.arange(scene.discretization.links) + 0.5)])
