"""The drawings of the build sheet, a page of PDF: a finger, the palm, the hand from three sides."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import matplotlib.patches
import numpy as np
from matplotlib.axes import Axes
from scipy.spatial import ConvexHull

from codesign_jax.export.process import Size
from codesign_jax.export.sheet import NAME, corners, places
from codesign_jax.scene import Scene
from codesign_jax.types import Params

_A4 = (8.27, 11.69)
_SMALL = 5.6


def write(folder: Path, title: str, scene: Scene, params: Params, sizes: Sequence[Size]) -> Path:
    path = folder / f"{NAME}.pdf"
    page(title, scene, params, sizes).savefig(path)
    return path


def page(
    title: str, scene: Scene, params: Params, sizes: Sequence[Size]
) -> matplotlib.figure.Figure:
    # A figure of its own instead of pyplot's: no state and no display is touched.
    figure = matplotlib.figure.Figure(figsize=_A4)
    figure.text(0.06, 0.965, title, fontsize=13, weight="bold")
    _section(figure.add_axes((0.06, 0.80, 0.34, 0.12)), sizes[0])
    _side_view(figure.add_axes((0.44, 0.80, 0.50, 0.12)), sizes[0])
    found = corners(scene, params, sizes)
    _view(figure.add_axes((0.08, 0.46, 0.40, 0.27)), scene, found, "front: x, z", 0, 2)
    _view(figure.add_axes((0.54, 0.46, 0.40, 0.27)), scene, found, "side: y, z", 1, 2)
    _view(figure.add_axes((0.08, 0.12, 0.40, 0.27)), scene, found, "from above: x, y", 0, 1)
    _palm(figure.add_axes((0.54, 0.12, 0.40, 0.27)), scene, params)
    extent = np.ptp(np.concatenate(found), axis=0)
    words = (
        f"Straight fingers, without pressure, span {extent[0]:.0f} x {extent[1]:.0f} x "
        f"{extent[2]:.0f} mm. Red: fabric, which faces inwards. z = 0: the palm's underside. "
        f"Numbers of fingers at their tips. Tables and the order of work: {NAME}.md."
    )
    figure.text(0.06, 0.06, words, fontsize=_SMALL)
    return figure


def _view(axes: Axes, scene: Scene, fingers: np.ndarray, title: str, across: int, up: int) -> None:
    radius, thick = 1e3 * scene.hand.palm.radius, 1e3 * scene.hand.palm.thickness
    depth = 3 - across - up
    near = -1 if depth == 1 else 1  # the front is seen from -y
    order = np.argsort(near * fingers[..., depth].mean(1))
    disc: Any = matplotlib.patches.Circle((0, 0), radius)
    if up == 2:
        disc = matplotlib.patches.Rectangle((-radius, 0), 2 * radius, thick)
    disc.set(facecolor="0.93", edgecolor="0.4", lw=0.7)
    axes.add_patch(disc)
    for i in order:
        flat = fingers[i][:, [across, up]]
        outline = flat[ConvexHull(flat).vertices]
        axes.fill(*outline.T, facecolor="#cfdcec", edgecolor="black", lw=0.7)
        fabric = flat[[0, 1, 5, 4, 0]]
        axes.plot(*fabric.T, color="tab:red", lw=0.9)
        x, y = flat[4:].mean(0)
        axes.text(x, y, str(i), ha="center", va="center", fontsize=8)
    _finish(axes, f"{title} [mm]")
    axes.axis("on")
    axes.tick_params(labelsize=_SMALL)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(0.05)


def _rectangle(axes: Axes, low: tuple[float, float], size: Sequence[float], color: str) -> None:
    width, height = size
    patch = matplotlib.patches.Rectangle(
        low, width, height, facecolor=color, edgecolor="black", lw=0.7
    )
    axes.add_patch(patch)


def _section(axes: Axes, size: Size) -> None:
    (width, height, wall), chamber = size.base, size.base.chamber
    _rectangle(axes, (-width / 2, 0), (width, height), "0.8")
    _rectangle(axes, (-chamber[0] / 2, wall), chamber, "white")
    axes.plot([-width / 2, width / 2], [0, 0], color="tab:red", lw=2)
    axes.text(0, -0.06 * height, f"{width:.1f}", ha="center", va="top", fontsize=6)
    axes.text(-0.53 * width, height / 2, f"{height:.1f}", ha="right", fontsize=6)
    axes.text(0, wall / 2, f"{wall:.1f}", ha="center", va="center", fontsize=6)
    where = "" if size.base == size.tip else " at its base"
    _finish(axes, f"section of finger 0{where} [mm]; red: fabric")
    axes.set(xlim=(-0.85 * width, 0.85 * width), ylim=(-5, height + 2))


def _side_view(axes: Axes, size: Size) -> None:
    start, end = size.chamber_ends
    first, last = size.at(start), size.at(end)
    outer = [(0, 0), (size.length, 0), (size.length, size.tip.height), (0, size.base.height)]
    inner = [(start, first.wall), (end, last.wall)]
    inner += [(end, last.height - last.wall), (start, first.height - first.wall)]
    for outline, color in ((outer, "0.8"), (inner, "white")):
        axes.add_patch(
            matplotlib.patches.Polygon(outline, facecolor=color, edgecolor="0.3", lw=0.8)
        )
    axes.plot([0, size.length], [0, 0], color="tab:red", lw=2)
    axes.text(size.length / 2, -1.5, f"{size.length:.1f}", ha="center", va="top", fontsize=6)
    chambers = dict.fromkeys("{:.1f} x {:.1f}".format(*s.chamber) for s in (first, last))
    text = f"chamber {end - start:.1f} x {' to '.join(chambers)}"
    axes.text(size.length / 2, size.tip.height / 2, text, ha="center", va="center", fontsize=6)
    _finish(axes, "along finger 0 [mm], base on the left")
    axes.set(xlim=(-3, size.length + 3), ylim=(-8, size.base.height + 3))


def _palm(axes: Axes, scene: Scene, params: Params) -> None:
    radius, width = 1e3 * scene.hand.palm.radius, 1e3 * scene.hand.section.width
    axes.add_patch(matplotlib.patches.Circle((0, 0), radius, facecolor="0.93", edgecolor="0.4"))
    position, azimuth = places(scene, params)
    for i, ((x, y), angle) in enumerate(zip(1e3 * position, azimuth, strict=True)):
        direction = np.array([np.cos(angle), np.sin(angle)])
        side = np.array([-direction[1], direction[0]]) * width / 2
        start = np.array([x, y])
        axes.plot(*np.transpose([start - side, start + side]), color="tab:red", lw=1.5)
        axes.annotate(
            "",
            start + 22 * direction,
            start,
            arrowprops={"arrowstyle": "->", "lw": 0.8, "color": "tab:blue"},
        )
        along, across = start + 28 * direction
        axes.text(along, across, str(i), ha="center", va="center", fontsize=7)
    axes.plot([0, 12], [0, 0], color="black", lw=0.6)
    axes.text(13, 0, "x", fontsize=6, va="center")
    _finish(axes, "palm from above: edges of the fingers' fabric")
    reach = max(radius, 1e3 * float(np.abs(position).max()) + 32) + 2
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))


def _finish(axes: Axes, title: str) -> None:
    axes.set_aspect("equal")
    axes.axis("off")
    axes.set_title(title, fontsize=6)
