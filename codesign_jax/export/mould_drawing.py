"""Drawings of a finger's two castings: the moulds cut open, as their solids are."""

from collections.abc import Sequence
from typing import Any

import manifold3d
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from codesign_jax.export import casting, paper
from codesign_jax.export.casting import half_width, prism, shifted
from codesign_jax.export.paper import BOTTOM, EDGE, PAPER, TOP
from codesign_jax.export.process import FABRIC, Process, Size, inlet

Solid = manifold3d.Manifold
Shaded = tuple[str, Sequence[Any]]
"""A colour, and outlines that have it."""
_ROOM = 18.0  # of a view for its title and dimensions [mm on paper]
_TITLE = 90.0  # width of the longest title [mm on paper]
_LEGEND = BOTTOM + 30.0  # upper edge of the legend [mm]

COLORS = {
    "tray": "0.78",
    "core": "#e8c48c",
    "base mould": "0.78",
    "silicone": "#cfdcec",
    "cured shell": "#cfdcec",
    "bottom wall": "#8fb0d8",
    "pin": "0.3",
}
"""Colours of what a drawing shows, by what it is."""
_TURN = {
    "along": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "across": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}
# Beside the middle: solids may have an edge in its plane [mm].
_BESIDE = 0.01


def cut(solid: Solid, plane: str, at: float) -> list[np.ndarray]:
    """Outlines of a solid in a plane, holes turning the other way, each (corner, 2) [mm].

    Args:
      plane: "along" for x and z where y = `at`, "across" for y and z where x = `at`.
    """
    level = -at if plane == "along" else at
    turned = solid.transform(np.column_stack([_TURN[plane], np.zeros(3)]))
    return [np.asarray(v) for v in turned.slice(level + _BESIDE).to_polygons()]


def castings(size: Size, process: Process) -> tuple[dict[str, Solid], dict[str, Solid]]:
    """Solids of the two castings by what they are, as they stand while the silicone cures."""
    pieces = casting.parts(size, process)
    low = prism(
        size.ends, shifted(half_width(size), 1.0), lambda x: -1.0, lambda x: size.at(x).wall
    )
    shell = pieces.finger - low
    first = {"tray": pieces.tray, "silicone": shell, "core": pieces.core}
    if inlet(size, process):
        first["pin"] = casting.pin(size, process)
    second = {"base mould": pieces.base, "bottom wall": pieces.finger ^ low, "cured shell": shell}
    return {name: solid.rotate([180, 0, 0]) for name, solid in first.items()}, second


def page(figure: Figure, size: Size, process: Process, label: str) -> int:
    """Draws both castings of a finger on a page, along the finger and across its middle.

    Returns:
      The reduction of the views.
    """
    first, second = castings(size, process)
    middles = [x for x, _ in casting.bars_of(size)]
    across = sum(middles[:2]) / 2 if len(middles) > 1 else size.length / 2
    names = ("tray", "silicone", "core")
    above = [(COLORS[name], first[name].project().to_polygons()) for name in names]
    cuts = [
        {plane: _cuts(solids, plane, at) for plane, at in (("along", 0.0), ("across", across))}
        for solids in (first, second)
    ]
    wide = sum(max(_extent(views[p])[1][0] for views in cuts) for p in ("along", "across"))
    tall = sum(_extent(v)[1][1] for v in (above, *(views["along"] for views in cuts)))
    room = PAPER[0] - 2 * EDGE - 2 * _ROOM, TOP - _LEGEND - 3 * _ROOM
    scale = paper.scale_of(max(wide / room[0], tall / room[1]))
    words = f"{label}, shell, from above: silicone is poured between the bars"
    top = _view(figure, (EDGE, TOP), above, scale, words)
    for views, solids, words in (
        (cuts[0], first, "shell, cut: the core hangs from its bars"),
        (cuts[1], second, "bottom wall, cut: cast on the fabric, the cured shell set into it"),
    ):
        fabric = {p: _fabric(size, process, p) if solids is second else None for p in views}
        title = f"{label}, {words}"
        below = _view(figure, (EDGE, top), views["along"], scale, title, fabric["along"])
        left = EDGE + max(_extent(views["along"])[1][0] / scale + 2 * _ROOM, _TITLE)
        title = f"across, at {across:.0f} mm"
        _view(figure, (left, top), views["across"], scale, title, fabric["across"])
        top = below
    _legend(figure)
    return scale


def _cuts(solids: dict[str, Solid], plane: str, at: float) -> list[Shaded]:
    return [(COLORS[name], cut(solid, plane, at)) for name, solid in solids.items()]


def _extent(shapes: Sequence[Shaded]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest coordinates of outlines and their size [mm]."""
    every = np.concatenate([np.asarray(v) for _, outlines in shapes for v in outlines])
    return every.min(0), np.ptp(every, 0)


def _view(
    figure: Figure,
    corner: tuple[float, float],
    shapes: Sequence[Shaded],
    scale: int,
    title: str,
    fabric: np.ndarray | None = None,
) -> float:
    """A view with its dimensions below an upper left corner; returns where the next one begins."""
    low, size = _extent(shapes)
    left, top = corner
    bottom = top - 6 - size[1] / scale
    high = low + size
    axes = paper.view(figure, (left, bottom), (low, high), scale, title, left=True)
    for color, outlines in shapes:
        _fill(axes, outlines, color)
    if fabric is not None:
        axes.plot(*fabric.T, color="tab:red", lw=1.6, clip_on=False)
    paper.dimension(axes, (low[0], high[0]), low[1], -6.0, scale)
    paper.dimension(axes, (low[1], high[1]), high[0], 6.0, scale, vertical=True)
    return bottom - _ROOM + 6


def _fabric(size: Size, process: Process, plane: str) -> np.ndarray:
    """The strip of fabric in the second casting, (corner, 2) [mm]."""
    if plane == "across":
        half = size.base.width / 2
        return np.array([[-half, 0.0], [half, 0.0]])
    behind = -size.root - process.clearance - FABRIC / 2
    outside = behind - process.mould_wall - FABRIC
    high = casting.overlap(size) + size.base.wall + 1.0
    path = [(size.length, 0.0), (-size.root, 0.0), (-size.root, size.base.wall)]
    path += [(behind, size.base.wall), (behind, high), (outside, high), (outside, high - 8.0)]
    return np.array(path)


def _fill(axes: Axes, outlines: Sequence[Any], color: str) -> None:
    if not len(outlines):
        return
    loops = (Path(np.vstack([v, v[:1]])) for v in map(np.asarray, outlines))
    whole = Path.make_compound_path(*loops)
    axes.add_patch(PathPatch(whole, facecolor=color, edgecolor="0.2", lw=0.6, clip_on=False))


def _legend(figure: Figure) -> None:
    shown = [
        ("tray, base mould", COLORS["tray"]),
        ("core with bars and frame", COLORS["core"]),
        ("silicone of the shell", COLORS["silicone"]),
        ("silicone of the bottom wall", COLORS["bottom wall"]),
        ("pin of the inlet", COLORS["pin"]),
        ("fabric", "tab:red"),
    ]
    marks: list[Any] = [PathPatch(Path([(0, 0)]), facecolor=color) for _, color in shown]
    figure.legend(
        marks,
        [words for words, _ in shown],
        loc="upper left",
        bbox_to_anchor=(EDGE / PAPER[0], _LEGEND / PAPER[1]),
        fontsize=7,
        frameon=False,
        ncols=2,
    )
