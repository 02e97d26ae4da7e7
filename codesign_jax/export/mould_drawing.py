"""Drawings of a finger's two castings: the moulds cut open, as their solids are."""

from collections.abc import Sequence
from typing import Any

import manifold3d
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from codesign_jax.export import casting
from codesign_jax.export.casting import half_width, prism, shifted
from codesign_jax.export.process import FABRIC, Process, Size, inlet

Solid = manifold3d.Manifold

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


def page(figure: Figure, size: Size, process: Process, label: str) -> None:
    """Draws both castings of a finger on a page, along the finger and across its middle."""
    first, second = castings(size, process)
    middles = [x for x, _ in casting.bars_of(size)]
    across = sum(middles[:2]) / 2 if len(middles) > 1 else size.length / 2
    above = figure.add_axes((0.07, 0.74, 0.62, 0.16))
    for name in ("tray", "silicone", "core"):
        _fill(above, first[name].project().to_polygons(), COLORS[name])
    _finish(above, f"{label}, shell, from above: silicone is poured between the bars")
    for bottom, solids, words in (
        (0.54, first, "shell, cut: the core hangs from its bars"),
        (0.32, second, "bottom wall, cut: cast on the fabric, the cured shell set into it"),
    ):
        for plane, at, left, width in (("along", 0.0, 0.07, 0.62), ("across", across, 0.77, 0.18)):
            axes = figure.add_axes((left, bottom, width, 0.16))
            for name, solid in solids.items():
                _fill(axes, cut(solid, plane, at), COLORS[name])
            if solids is second:
                axes.plot(*_fabric(size, process, plane).T, color="tab:red", lw=1.6)
            _finish(axes, f"{label}, {words}" if plane == "along" else f"across, at {at:.0f} mm")
    _legend(figure)


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
    axes.add_patch(PathPatch(whole, facecolor=color, edgecolor="0.2", lw=0.6))


def _finish(axes: Axes, title: str) -> None:
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.tick_params(labelsize=5.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(f"{title} [mm]", fontsize=7, parse_math=False)


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
        bbox_to_anchor=(0.06, 0.27),
        fontsize=7,
        frameon=False,
        ncols=2,
    )
