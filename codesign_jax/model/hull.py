"""The finger's hull as a skinned triangle mesh, for contact, pictures and export.

Rings of vertices on the rectangular section's outline stand along the finger, from the base to the
tip, which a grid of smaller rings closes.  A vertex follows the two nearest links by linear blend
skinning: its weight on link i is a hat function of its place along the straight finger, one at the
link's middle and zero at the middles of its neighbours.  The half segment at the palm counts as
link 0 with its middle at the base, the last half segment's middle is the tip.  A vertex at x =
(j + w) segments, 0 <= w <= 1, thus has weight w on link j + 1 and 1 - w on link j, and moves with
joint j + 1 between them alone:
  position = (1 - w) T_j(v) + w T_{j+1}(v), T the rigid motions of the links.
The topology is the scene's; sizes are the parameters', so that fingers of a batch share it.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from codesign_jax.scene import Scene, by_structure


class Hull(NamedTuple):
    """Mesh of a finger with places as fractions: of a segment, the width and the height.

    Attributes:
      place: Along the finger in segments from its base, across in widths from the middle, up in
        heights from the bottom layer, shape (vertex, 3).
      link: The two links that a vertex follows, 0 the half segment at the palm, shape (vertex, 2).
      weight: Their weights, shape (vertex, 2).
      face: Vertices of the triangles, counter-clockwise from outside, shape (face, 3).
    """

    place: np.ndarray
    link: np.ndarray
    weight: np.ndarray
    face: np.ndarray


class Slots(NamedTuple):
    """The hull's vertices as contact points in rows of equal length, one row a joint.

    Row j < N has the vertices between the links j and j + 1; row N those inside the tip's face,
    which follow link N alone.  The ring at the base is part of the palm and no contact point.

    Attributes:
      along: Distance from the row's joint in segments, shape (row, k).
      across: In widths from the middle, same shape.
      up: In heights from the bottom layer, same shape.
      weight: Weight on link j + 1, same shape; zero in the last row.
      area: Share of the surface, as factors of (segment x width, segment x height, width x height),
        shape (3, row, k).
    """

    along: np.ndarray
    across: np.ndarray
    up: np.ndarray
    weight: np.ndarray
    area: np.ndarray


def outline(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the section's outline, anticlockwise about x from a bottom corner.

    Args:
      points: Their number, a multiple of four: all sides have as many, corners included.

    Returns:
      Places (width, height), shape (point, 2), and each point's share of the outline as factors of
      the width and the height, same shape.
    """
    m = points // 4
    t = np.arange(m) / m
    sides = [(t - 0.5, 0 * t), (0 * t + 0.5, t), (0.5 - t, 0 * t + 1), (0 * t - 0.5, 1 - t)]
    place = np.concatenate([np.stack(s, -1) for s in sides])
    # Half the way to the neighbours on either side.
    steps = np.abs(np.roll(place, -1, 0) - place)
    return place, (steps + np.roll(steps, 1, 0)) / 2


@by_structure
def slots(scene: Scene) -> Slots:
    """The contact points of a scene's fingers."""
    d = scene.discretization
    links, rings, points = d.links, d.hull_rings, d.hull_points
    place, share = outline(points)
    one, zero = np.ones((rings, points)), np.zeros((rings, points))
    weight = np.repeat(np.arange(1, rings + 1) / rings, points).reshape(rings, points)
    span = np.stack([share[:, 0] * one / rings, share[:, 1] * one / rings, zero])
    last = span * np.where(np.arange(rings) == rings - 1, 0.5, 1.0)[None, :, None]
    # Rings inside the tip's face at 1 - 1/R, 1 - 2/R, ..., 0 of the section; the outer one, at 1,
    # is the last ring along the finger.  By area, each takes the band half way to its neighbours.
    scale = 1.0 - np.arange(rings + 1) / rings
    bounds = np.clip([scale + 0.5 / rings, scale - 0.5 / rings], 0.0, 1.0) ** 2
    band = (bounds[0] - bounds[1]) / points
    last[2, -1] += band[0]
    inner = np.stack([zero, zero, band[1:, None] * one])
    tip = place * scale[1:, None, None] + np.array([0, 0.5]) * (1 - scale[1:, None, None])

    def rows(body: np.ndarray, end: np.ndarray) -> np.ndarray:
        return np.stack([*[body.ravel()] * links, end.ravel()])

    area = [rows(span[i], inner[i]) for i in range(3)]
    for i in range(3):
        area[i][links - 1] = last[i].ravel()
    return Slots(
        along=rows(weight - 0.5, 0.5 * one),
        across=rows(place[:, 0] * one, tip[..., 0]),
        up=rows(place[:, 1] * one, tip[..., 1]),
        weight=rows(weight, zero),
        area=np.stack(area),
    )


@by_structure
def hull(scene: Scene) -> Hull:
    """The closed mesh of a scene's fingers: base, rings, tip."""
    d, s = scene.discretization, slots(scene)
    links, rings, points = d.links, d.hull_rings, d.hull_points
    ring, _ = outline(points)
    base = np.column_stack([np.zeros(points), ring])
    along = s.along + np.arange(links + 1)[:, None] + 0.5  # the last row hangs on link N
    along[-1] -= 1.0
    body = np.stack([along, s.across, s.up], -1).reshape(-1, 3)
    body = body[: len(body) - points + 1]  # the last ring has shrunk to one point
    place = np.concatenate([[[0.0, 0.0, 0.5]], base, body])
    lower = np.clip(np.ceil(place[:, 0] - 1e-9).astype(int) - 1, 0, links - 1)
    upper_weight = place[:, 0] - lower
    return Hull(
        place,
        np.stack([lower, lower + 1], -1),
        np.stack([1.0 - upper_weight, upper_weight], -1),
        _faces(links * rings + rings, points),
    )


def _faces(rings: int, points: int) -> np.ndarray:
    """Triangles of a centre, `rings` rings of points and another centre, one after the other."""
    i = np.arange(points)
    after = (i + 1) % points
    first = 1 + points * np.arange(rings - 1)[:, None]
    a, a_next = first + i, first + after
    b, b_next = a + points, a_next + points
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


def rest(scene: Scene, length: float, height: float) -> np.ndarray:
    """Vertices of the straight finger in the frame of its base [m], shape (vertex, 3).

    Args:
      scene: The scene.
      length: Length of the finger [m].
      height: Height of its section [m].
    """
    unit = length / scene.discretization.links, scene.hand.section.width, height
    return hull(scene).place * np.array(unit)


def link_origins(scene: Scene, length: float) -> np.ndarray:
    """Frames of a straight finger's links along it [m], the half segment first, shape (N + 1,)."""
    segment = length / scene.discretization.links
    return np.concatenate([[0.0], segment * (np.arange(scene.discretization.links) + 0.5)])


def pose(
    scene: Scene, length: float, height: float, position: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Vertices of a bent finger by linear blend skinning [m], shape (vertex, 3).

    Args:
      scene: The scene.
      length: Length of the finger [m].
      height: Height of its section [m].
      position: Frame origins of its links, from the half segment on, shape (N + 1, 3).
      rotation: Their orientations, shape (N + 1, 3, 3).
    """
    mesh, straight = hull(scene), rest(scene, length, height)
    origin = link_origins(scene, length)
    result = np.zeros_like(straight)
    for link, weight in zip(mesh.link.T, mesh.weight.T, strict=True):
        local = straight - origin[link, None] * np.array([1.0, 0.0, 0.0])
        moved = position[link] + np.einsum("vij,vj->vi", rotation[link], local)
        result += weight[:, None] * moved
    return result


def write(path: Path, fingers: list[np.ndarray], face: np.ndarray) -> Path:
    """Exports the hulls of a hand's fingers as one mesh file, in the format of its ending.

    Args:
      path: File to write, in any format that trimesh writes, such as .stl, .ply or .obj.
      fingers: Vertices of each finger [m], as from `pose`.
      face: The faces, `hull(scene).face`.

    Returns:
      The path.
    """
    import trimesh

    bodies = [trimesh.Trimesh(v, face, process=False) for v in fingers]
    trimesh.util.concatenate(bodies).export(path)
    return path
