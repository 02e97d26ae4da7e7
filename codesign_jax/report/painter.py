"""Pictures of a grasp: the hand's skin, palm and object on a table, shaded for each pixel in NumPy.

No OpenGL is needed, so that a picture always exists and is the same everywhere.  A light falls from
above beside the camera; what it does not reach is lit by the sky alone.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
from PIL import Image

from codesign_jax.report import bodies, raster
from codesign_jax.report.bodies import Part
from codesign_jax.report.replay import Camera, Replay
from codesign_jax.scene import Scene

_FIELD = 45.0  # MuJoCo's vertical field of view [deg]
_SMOOTH = 2  # pixels of a side that become one
_NEAR = 0.03  # triangles nearer to the eye are left out [m]
# The skin is drawn with at least so many rings of a link and points of a ring.
_RINGS = 4
_POINTS = 24
_CREASE = np.cos(np.radians(40))  # faces that meet more sharply have an edge
_SKY = np.array([[0.95, 0.96, 0.975], [0.84, 0.87, 0.91]])  # behind the table, upwards
_TOP = np.array([0.925, 0.915, 0.895])  # of the table
_LINE = np.array([0.72, 0.70, 0.665])
_GRID = 0.05  # distance of the table's lines [m]
_WIDTH = 0.0012  # of a line [m]
_REACH = 0.75  # distance from the middle at which the table has faded into the sky [m]
# The light's direction: from the camera's to the right, and down [deg].
_ASIDE = -50.0
_STEEP = 58.0
_SHADOWS = 420  # pixels of a side of what the light sees
_LEAST = 0.2
_MOST = 1.0
"""Least and most half side of that [m]: what has rolled away must not coarsen the rest."""
_BIAS = 0.0025  # what stands so little behind another thing is not in its shadow [m]
_BESIDE = [_SHADOWS * i + j for i in (-2, 0, 2) for j in (-2, 0, 2)]  # where it is looked up


class View:
    """A camera that sees points as pixels."""

    def __init__(self, camera: Camera, size: tuple[int, int]):
        azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
        flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        forward = np.cos(elevation) * flat + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
        right = np.array([flat[1], -flat[0], 0.0])
        self.axes = np.stack([right, -np.cross(right, forward), forward])  # right, down, away
        self.eye = np.array(camera.lookat) - camera.distance * forward
        self.size = size
        self.middle = np.array(size) / 2
        self.scale = size[1] / 2 / np.tan(np.radians(_FIELD) / 2)

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places in the picture, shape (..., 2), and how far away they are [m], shape (...)."""
        local = (points - self.eye) @ self.axes.T
        away = np.maximum(local[..., 2:], 1e-3)
        return local[..., :2] / away * self.scale + self.middle, away[..., 0]

    def rays(self, at: np.ndarray) -> np.ndarray:
        """Directions from the eye through pixels, to a distance of 1 m, shape (pixel, 3).

        Args:
          at: Indices of pixels in the rows one after another, shape (pixel,).
        """
        pixel = np.stack([at % self.size[0], at // self.size[0]], 1) + 0.5
        return (pixel - self.middle) / self.scale @ self.axes[:2] + self.axes[2]


def light(camera: Camera) -> np.ndarray:
    """The direction in which light falls, shape (3,)."""
    turn, steep = np.radians([camera.azimuth + _ASIDE, _STEEP])
    flat = np.cos(steep) * np.array([np.cos(turn), np.sin(turn)])
    return np.array([*flat, -np.sin(steep)])


class _Body(NamedTuple):
    """Triangles of all parts, and what stays over time."""

    parts: list[Part]
    face: np.ndarray  # corners as vertices of all parts, shape (face, 3)
    color: np.ndarray  # of each face, shape (face, 3)
    # Which faces give a corner its normal, shape (3 face, face)
    around: scipy.sparse.csr_array


def paint(
    scene: Scene,
    grasp: Replay,
    steps: np.ndarray,
    size: tuple[int, int],
    camera: Camera | Sequence[Camera],
) -> Iterator[np.ndarray]:
    """A picture for each of the grasp's time steps, shape (frame,): uint8, (height, width, 3).

    Args:
      camera: One that stays, or one for each picture.
    """
    start, *states = zip(*bodies.at_steps(scene, grasp, np.append(0, steps)), strict=True)
    body = _body(bodies.parts(bodies.finer(scene, _RINGS, _POINTS), grasp), *start)
    cameras = [camera] * len(steps) if isinstance(camera, Camera) else camera
    picture = None
    before = None
    for (pose, grown), seen in zip(states, cameras, strict=True):
        now = (pose.tobytes(), grown.tobytes(), seen)
        if picture is None or now != before:  # what was lost stands still
            picture = _picture(body, pose, grown, seen, size, table=scene.effects.table)
            before = now
        yield picture


def still(parts: Sequence[Part], camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """A picture of rigid parts in the world's frame on the table, as `paint` makes them."""
    world = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    as_made = np.ones((1, 2))
    body = _body([*parts], world, as_made)
    return _picture(body, world, as_made, camera, size, table=True)


def _body(parts: list[Part], start: np.ndarray, grown: np.ndarray) -> _Body:
    """What stays over time; edges are those at the start.

    Args:
      start: Poses of the bodies then, and `grown` sizes of what is on them, see `bodies.vertices`.
    """
    first = np.cumsum([0, *(len(part.first) for part in parts)])
    face = np.concatenate([part.face + k for part, k in zip(parts, first, strict=False)])
    color = np.repeat([part.color for part in parts], [len(part.face) for part in parts], axis=0)
    # A mesh may have a place several times.
    vertices = np.concatenate([np.column_stack([p.first, p.second]) for p in parts])
    owner = np.repeat(np.arange(len(parts)), [len(part.first) for part in parts])
    keys = np.column_stack([owner, np.round(vertices * 1e6).astype(np.int64)])
    _, same = np.unique(keys, axis=0, return_inverse=True)
    triangles = np.concatenate([bodies.vertices(part, start, grown) for part in parts])[face]
    around = _around(same.ravel()[face].ravel(), _areas(triangles))
    return _Body(parts, face, color, around)


def _around(vertex: np.ndarray, area: np.ndarray) -> scipy.sparse.csr_array:
    """Which faces share a corner's vertex and lie about as its own; see `_Body`.

    Args:
      vertex: Vertices of the corners, shape (3 face,).
      area: Normals of the faces, shape (face, 3).
    """
    order = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex)
    start = np.cumsum(count) - count
    each = count[vertex]
    corner = np.repeat(np.arange(len(vertex)), each)
    rank = np.arange(len(corner)) - np.repeat(np.cumsum(each) - each, each)
    beside = order[start[vertex[corner]] + rank] // 3
    unit = _unit(area)
    alike = (unit[corner // 3] * unit[beside]).sum(1) > _CREASE
    pairs = corner[alike], beside[alike]
    shape = len(vertex), len(area)
    return scipy.sparse.csr_array((np.ones(len(pairs[0]), np.float32), pairs), shape)


def _areas(triangles: np.ndarray) -> np.ndarray:
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / (np.sqrt((vectors * vectors).sum(-1, keepdims=True)) + 1e-30)


def _picture(
    body: _Body,
    pose: np.ndarray,
    grown: np.ndarray,
    camera: Camera,
    size: tuple[int, int],
    *,
    table: bool,
) -> np.ndarray:
    """A picture, uint8, shape (height, width, 3); `grown`: see `_body`."""
    vertices = np.concatenate([bodies.vertices(part, pose, grown) for part in body.parts])
    triangles = vertices.astype(np.float32)[body.face]
    area = _areas(triangles)
    shadows = _Shadows(triangles, camera)
    # What is behind has no edges that need more pixels.
    colors = _behind(View(camera, size), shadows, table=table)
    colors = colors.repeat(_SMOOTH, 0).repeat(_SMOOTH, 1).reshape(-1, 3)
    view = View(camera, (_SMOOTH * size[0], _SMOOTH * size[1]))
    corners, away = view.pixels(triangles)
    shown = (away.min(1) > _NEAR) & ((area * (triangles[:, 0] - view.eye)).sum(1) < 0)
    faces = np.flatnonzero(shown)
    seen = raster.nearest(corners[faces], away[faces], view.size)
    face = faces[seen.face]
    share = seen.share[:, :, None]
    rays = view.rays(seen.at)
    points = view.eye + seen.away[:, None] * rays
    normals = (body.around @ area).reshape(-1, 3, 3)
    normal = _unit((share * _unit(normals[face])).sum(1))
    lit = shadows.lit(points + 0.002 * normal)
    colors[seen.at] = _shaded(
        body.color[face], normal, -_unit(rays), shadows.light, lit, points[:, 2]
    )
    levels = (255 * np.clip(colors, 0, 1)).astype(np.uint8)
    image = Image.fromarray(levels.reshape(_SMOOTH * size[1], _SMOOTH * size[0], 3))
    return np.asarray(image.resize(size, Image.Resampling.BOX))


def _shaded(
    color: np.ndarray,
    normal: np.ndarray,
    back: np.ndarray,
    fall: np.ndarray,
    lit: np.ndarray,
    height: np.ndarray,
) -> np.ndarray:
    """Colours of points under light and sky, shape (pixel, 3).

    Args:
      back: Directions to the eye, shape (pixel, 3).
      fall: The direction in which light falls, shape (3,).
      lit: Shares of the light that reach the points, shape (pixel,).
      height: Their heights above the table [m], shape (pixel,).
    """
    direct = np.maximum(0.0, -(normal @ fall)) * lit
    shine = np.maximum(0.0, (normal * _unit(back - fall)).sum(1)) ** 40 * lit
    # Less of the sky is seen from below, and near the table.
    sky = (0.72 + 0.28 * normal[:, 2]) * (0.78 + 0.22 * np.clip(height / 0.03, 0, 1))
    rim = (1 - np.maximum(0.0, (normal * back).sum(1))) ** 3
    return color * (0.72 * sky + 0.54 * direct)[:, None] + (0.14 * shine + 0.08 * rim)[:, None]


def _behind(view: View, shadows: "_Shadows", *, table: bool) -> np.ndarray:
    """Sky and table, shape (height, width, 3): the plane z = 0 fades into the sky."""
    rays = view.rays(np.arange(view.size[0] * view.size[1]))
    share = np.clip(0.5 + 0.9 * _unit(rays)[:, 2:], 0, 1)
    colors = (1 - share) * _SKY[0] + share * _SKY[1]
    if table and view.eye[2] > 0:
        _table(colors, rays, view, shadows)
    return colors.reshape(view.size[1], view.size[0], 3)


def _table(colors: np.ndarray, rays: np.ndarray, view: View, shadows: "_Shadows") -> None:
    below = np.flatnonzero(rays[:, 2] < -1e-3)
    along = -view.eye[2] / rays[below, 2]
    points = view.eye + along[:, None] * rays[below]
    radius = np.hypot(points[:, 0], points[:, 1])
    near = radius < _REACH
    below = below[near]
    points = points[near]
    fade = np.clip((_REACH - radius[near]) / (0.5 * _REACH), 0, 1)[:, None]
    # A line that is thinner than a pixel is as wide as one and fainter.
    blur = np.maximum(_WIDTH, along[near] / view.scale)
    off = np.abs(points[:, :2] / _GRID - np.round(points[:, :2] / _GRID)) * _GRID
    line = np.clip(1.0 - off / blur[:, None], 0, 1).max(1) * _WIDTH / blur
    color = _TOP + line[:, None] * (_LINE - _TOP)
    bright = 0.66 + 0.34 * shadows.lit(points)
    colors[below] = (1 - fade) * colors[below] + fade * color * bright[:, None]


class _Shadows:
    """What the light sees, as distances along its way."""

    def __init__(self, triangles: np.ndarray, camera: Camera):
        self.light = light(camera)
        right = np.cross(self.light, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(self.light, right), self.light])
        spread = triangles.reshape(-1, 3) @ self.axes.T
        low = spread.min(0)
        high = spread.max(0)
        self.middle = (low + high) / 2 @ self.axes
        self.room = float(np.clip(0.51 * (high - low)[:2].max(), _LEAST, _MOST))
        pixels, away = self._seen(triangles)
        seen = raster.nearest(pixels, away, (_SHADOWS, _SHADOWS), flat=True)
        self.depth = np.full(_SHADOWS * _SHADOWS, np.inf)
        self.depth[seen.at] = seen.away

    def _seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local = (points - self.middle) @ self.axes.T
        return (local[..., :2] / self.room + 1) * _SHADOWS / 2, local[..., 2]

    def lit(self, points: np.ndarray) -> np.ndarray:
        """The share of the light that reaches points, shape (point,)."""
        pixels, away = self._seen(points)
        column, row = np.clip(pixels, 2, _SHADOWS - 3).astype(np.int32).T
        at = row * _SHADOWS + column
        brightness = np.zeros(len(points), np.float32)
        for by in _BESIDE:
            brightness += self.depth[at + by] > away - _BIAS
        return brightness / len(_BESIDE)
