"""Pictures of a grasp: the viewer's meshes on a table, painted from back to front by Pillow.

No OpenGL is needed, so that a picture always exists and is the same everywhere.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import trimesh
from PIL import Image, ImageDraw

from codesign_jax.report import bodies
from codesign_jax.report.bodies import Part
from codesign_jax.report.replay import Camera, Replay
from codesign_jax.scene import Scene

_FIELD = 45.0  # MuJoCo's vertical field of view [deg]
_SMOOTH = 2  # pixels of a side that become one
_EDGE = 0.02  # longest edge of a triangle [m]: larger ones would stand before others as a whole
_SKY = (232, 238, 246)
_TABLE = ((219, 214, 204), (204, 199, 189))
_SHADOW = (150, 146, 139)
# half side of the table, and the side of its squares [m]
_REACH = 0.6
_SQUARE = 0.05
_LIGHT = np.array([0.15, -0.25, -1.0])  # the direction in which light falls


class View:
    """A camera that sees points as pixels."""

    def __init__(self, camera: Camera, size: tuple[int, int]):
        azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
        flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        forward = np.cos(elevation) * flat + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
        right = np.array([flat[1], -flat[0], 0.0])
        self.axes = np.stack([right, -np.cross(right, forward), forward])  # right, down, away
        self.eye = np.array(camera.lookat) - camera.distance * forward
        self.middle = np.array(size) / 2
        self.scale = size[1] / 2 / np.tan(np.radians(_FIELD) / 2)

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places in the picture, shape (..., 2), and how far away they are [m], shape (...)."""
        local = (points - self.eye) @ self.axes.T
        away = np.maximum(local[..., 2:], 0.01)
        return local[..., :2] / away * self.scale + self.middle, away[..., 0]


def paint(
    scene: Scene, grasp: Replay, qpos: np.ndarray, size: tuple[int, int], camera: Camera
) -> Iterator[np.ndarray]:
    """A picture for each row of qpos, shape (frame, nq): uint8, (height, width, 3)."""
    parts = [_fine(part) for part in bodies.parts(scene, grasp)]
    large = (_SMOOTH * size[0], _SMOOTH * size[1])
    view = View(camera, large)
    empty = Image.new("RGB", large, _SKY)
    table = scene.effects.table and view.eye[2] > 0
    if table:
        _paint_table(ImageDraw.Draw(empty), view)
    picture = None
    before = np.zeros(0)
    for pose in bodies.poses(scene, grasp, qpos):
        if picture is not None and np.array_equal(pose, before):  # one that was lost stands still
            yield picture
            continue
        image = empty.copy()
        before = pose
        corners = [bodies.vertices(part, pose)[part.face] for part in parts]
        colors = np.repeat([part.color for part in parts], [*map(len, corners)], 0)
        _paint(ImageDraw.Draw(image), view, np.concatenate(corners), colors, shadows=table)
        picture = np.asarray(image.resize(size, Image.Resampling.BOX))
        yield picture


def _fine(part: Part) -> Part:
    """A rigid part with small triangles."""
    if part.weight.any():
        return part
    fine: Any = trimesh.remesh.subdivide_to_size(part.first, part.face, _EDGE)
    vertices, face = fine[:2]
    body = np.full((len(vertices), 2), part.body[0, 0])
    weight = np.zeros(len(vertices))
    return part._replace(first=vertices, second=vertices, body=body, weight=weight, face=face)


def _paint_table(canvas: ImageDraw.ImageDraw, view: View) -> None:
    square = _SQUARE * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    for i, j in itertools.product(range(round(2 * _REACH / _SQUARE)), repeat=2):
        place = np.pad(_SQUARE * np.array([i, j]) - _REACH + square, [(0, 0), (0, 1)])
        pixels, away = view.pixels(place)
        if away.min() > 0.05:  # the others are beside or behind the camera
            canvas.polygon(pixels.ravel().tolist(), fill=_TABLE[(i + j) % 2])


def _paint(
    canvas: ImageDraw.ImageDraw,
    view: View,
    triangles: np.ndarray,
    colors: np.ndarray,
    *,
    shadows: bool,
) -> None:
    """Paints triangles, shape (face, 3, 3), that face the camera, the farthest first."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
    if shadows:
        lit = normal @ _LIGHT < 0
        on_table = triangles - triangles[..., 2:] / _LIGHT[2] * _LIGHT
        for corners in view.pixels(on_table[lit])[0].reshape(-1, 6).tolist():
            canvas.polygon(corners, fill=_SHADOW)
    front = (normal * (triangles.mean(1) - view.eye)).sum(1) < 0
    light = 0.62 - 0.38 * (normal[front] @ _LIGHT / np.linalg.norm(_LIGHT))
    shades = (255 * np.clip(light[:, None] * colors[front], 0, 1)).astype(int).tolist()
    pixels, away = view.pixels(triangles[front])
    corners = pixels.reshape(-1, 6).tolist()
    for k in np.argsort(-away.mean(1)).tolist():
        canvas.polygon(corners[k], fill=tuple(shades[k]))
