"""A small drawing of the hand with the table's axes, turned by roll, yaw and pitch."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from codesign_jax.export import pose

TURNS: Mapping[str, Mapping[str, float]] = {
    "all angles 0: fingers down": {"roll": 0, "yaw": 0, "pitch": 0},
    "roll +40°: fingers towards +y": {"roll": 40, "yaw": 0, "pitch": 0},
    "yaw +40°: anticlockwise from above": {"roll": 0, "yaw": 40, "pitch": 0},
    "pitch +40°: fingers towards +x": {"roll": 0, "yaw": 0, "pitch": 40},
}
"""Turns about one axis each, by what is said below their drawings."""

_FACES = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (2, 3, 7, 6), (0, 3, 7, 4), (1, 2, 6, 5))
# of the eye: x and y come towards it
_AZIMUTH = np.radians(35)
_ELEVATION = np.radians(25)
_AROUND = np.linspace(0, 2 * np.pi, 49)


def draw(
    axes: Axes,
    fingers: np.ndarray,
    palm: tuple[float, float],
    angles: Mapping[str, float],
    words: str,
) -> None:
    """Draws a hand whose palm is turned about the middle of its underside.

    Args:
      fingers: Corners of the straight fingers in the palm's frame [mm], shape (finger, 8, 3).
      palm: Radius and thickness [mm].
      angles: Roll, yaw and pitch [deg].
      words: What stands below the drawing.
    """
    turn = pose.rotation(**angles)
    radius, thickness = palm
    ring = np.stack([radius * np.cos(_AROUND), radius * np.sin(_AROUND), 0 * _AROUND], 1)
    solids = [(np.concatenate([ring, ring + [0, 0, thickness]]), "0.85", None)]
    solids += [(box, "#cfdcec", str(i)) for i, box in enumerate(fingers)]
    turned = [(turn.apply(points), color, label) for points, color, label in solids]
    for points, color, label in sorted(turned, key=lambda solid: _depth(solid[0]).mean()):
        _solid(axes, points, color, label)
    length = 1.8 * radius
    _arrows(axes, length)
    drawn = [_flat(points) for points, _, _ in turned] + [_flat(1.2 * length * np.eye(3))]
    low, high = (f(np.concatenate(drawn), axis=0) for f in (np.min, np.max))
    edge = 0.04 * (high - low).max()
    axes.set(xlim=(low[0] - edge, high[0] + edge), ylim=(low[1] - edge, high[1] + edge))
    axes.set_aspect("equal")
    axes.axis("off")
    axes.set_title(words, fontsize=6)


def _flat(points: Any) -> np.ndarray:
    """Places on the paper, (..., 2)."""
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    right = -x * np.sin(_AZIMUTH) + y * np.cos(_AZIMUTH)
    away = x * np.cos(_AZIMUTH) + y * np.sin(_AZIMUTH)
    return np.stack([right, z * np.cos(_ELEVATION) - away * np.sin(_ELEVATION)], -1)


def _depth(points: np.ndarray) -> np.ndarray:
    """How near the eye points are."""
    x, y, z = np.moveaxis(points, -1, 0)
    away = x * np.cos(_AZIMUTH) + y * np.sin(_AZIMUTH)
    return away * np.cos(_ELEVATION) + z * np.sin(_ELEVATION)


def _solid(axes: Axes, points: np.ndarray, color: str, label: str | None) -> None:
    flat = _flat(points)
    outline = flat[ConvexHull(flat).vertices]
    axes.add_patch(Polygon(outline, facecolor=color, edgecolor="0.2", lw=0.6))
    if label is None:
        upper = flat[len(flat) // 2 :]
        axes.add_patch(Polygon(upper, fill=False, edgecolor="0.2", lw=0.4))
        return
    near = sorted(_FACES, key=lambda face: _depth(points[[*face]]).mean())[3:]
    for face in near:
        red = set(face) == {0, 1, 4, 5}
        style = {"facecolor": "#e9a8a0" if red else color, "edgecolor": "0.2", "lw": 0.4}
        axes.add_patch(Polygon(flat[[*face]], **style))
    x, y = flat[4:].mean(0)
    axes.text(x, y, label, fontsize=6, ha="center", va="center")


def _arrows(axes: Axes, length: float) -> None:
    for name, end in zip("xyz", length * np.eye(3), strict=True):
        tip = _flat(end)
        style = {"arrowstyle": "->", "lw": 0.9, "color": "tab:green"}
        axes.annotate("", tip, _flat(np.zeros(3)), arrowprops=style)
        x, y = 1.12 * tip
        axes.text(x, y, name, fontsize=7, color="tab:green", ha="center", va="center")
