"""The build sheet as two pages of PDF, drawn by matplotlib."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import matplotlib.patches
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from scipy.spatial import ConvexHull

from codesign_jax.export.process import Size
from codesign_jax.export.sheet import NAME, Drift, SheetSection, corners, places
from codesign_jax.export.tolerance import Side
from codesign_jax.scene import Scene
from codesign_jax.types import Params

_A4 = (8.27, 11.69)
_SMALL = 5.6
_LINE = 0.0095  # height of a line of that size in the figure's


def write(folder: Path, *content: Any, assembly: Sequence[SheetSection], **shown: Any) -> Path:
    """Writes the sheet to a folder as two pages of PDF."""
    path = folder / f"{NAME}.pdf"
    with PdfPages(path) as pages:
        pages.savefig(page(*content, **shown))
        pages.savefig(second_page(assembly, shown["scene"], shown["params"], shown["sizes"]))
    return path


def page(
    title: str,
    lines: Sequence[str],
    content: Sequence[SheetSection],
    *,
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    drift: Drift | None,
) -> matplotlib.figure.Figure:
    """Draws the sheet on one page."""
    # A figure of its own instead of pyplot's: no state and no display is touched.
    figure = matplotlib.figure.Figure(figsize=_A4)
    figure.text(0.06, 0.965, title, fontsize=13, weight="bold")
    about = "\n".join(textwrap.fill(line, 165) for line in lines)
    figure.text(0.06, 0.957, about, fontsize=_SMALL, va="top")
    top = 0.935 - _LINE * (about.count("\n") + 1)  # below what it is about, however long that is
    _section(figure.add_axes((0.04, top - 0.14, 0.24, 0.13)), sizes[0])
    _side_view(figure.add_axes((0.30, top - 0.14, 0.38, 0.13)), sizes[0])
    _palm(figure.add_axes((0.70, top - 0.16, 0.26, 0.16)), scene, params)
    top -= 0.175
    for section in content:
        if section.title.startswith("Tolerance") and drift and drift.rows:
            top = _tolerance(figure, top, section, drift)
        else:
            top = _table(figure, top, section)
    return figure


def second_page(
    content: Sequence[SheetSection], scene: Scene, params: Params, sizes: Sequence[Size]
) -> matplotlib.figure.Figure:
    """Draws the hand from three sides, and below it the sections; arguments as of `page`."""
    figure = matplotlib.figure.Figure(figsize=_A4)
    figure.text(0.06, 0.965, "Assembly", fontsize=13, weight="bold")
    found = corners(scene, params, sizes)
    _view(figure.add_axes((0.08, 0.66, 0.40, 0.27)), scene, found, "front: x, z", 0, 2)
    _view(figure.add_axes((0.54, 0.66, 0.40, 0.27)), scene, found, "side: y, z", 1, 2)
    _view(figure.add_axes((0.08, 0.36, 0.40, 0.26)), scene, found, "from above: x, y", 0, 1)
    extent = np.ptp(np.concatenate(found), axis=0)
    words = (
        f"Straight fingers, without pressure, span {extent[0]:.0f} x {extent[1]:.0f} x "
        f"{extent[2]:.0f} mm. Red: fabric, which faces inwards. z = 0: the palm's underside. "
        "Numbers of fingers at their tips."
    )
    _notes(figure, 0.58, textwrap.wrap(words, 60), left=0.54)
    top = 0.34
    for section in content:
        top = _table(figure, top, section)
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


def _lines(text: str) -> list[str]:
    return textwrap.wrap(text, 165)


def _table(figure: matplotlib.figure.Figure, top: float, section: SheetSection) -> float:
    figure.text(0.06, top, section.title, fontsize=8, weight="bold", va="top")
    top -= 0.015
    if section.rows:
        height = 0.0125 * (len(section.rows) + 1)
        axes = figure.add_axes((0.06, top - height, 0.88, height))
        axes.axis("off")
        table = axes.table(section.rows, colLabels=section.head, bbox=[0, 0, 1, 1], cellLoc="left")
        table.auto_set_font_size(False)
        table.set_fontsize(_SMALL)
        table.auto_set_column_width([*range(len(section.head))])
        for (row, _), cell in table.get_celld().items():
            cell.set_linewidth(0.3)
            cell.PAD = 0.03
            if row == 0:
                cell.set_facecolor("0.9")
        top -= height + 0.003
    return _notes(figure, top, section.notes)


def _notes(
    figure: matplotlib.figure.Figure, top: float, notes: Sequence[str], left: float = 0.06
) -> float:
    text = [line for note in notes for line in _lines(note)]
    figure.text(left, top, "\n".join(text), fontsize=_SMALL, va="top", linespacing=1.3)
    return top - _LINE * len(text) - 0.010


def _tolerance(
    figure: matplotlib.figure.Figure, top: float, section: SheetSection, drift: Drift
) -> float:
    figure.text(0.06, top, section.title, fontsize=8, weight="bold", va="top")
    bottom = 0.02 + _LINE * sum(len(_lines(note)) for note in section.notes) + 0.015
    bottom = max(bottom, top - 0.03 - 0.03 * len(drift.rows))
    axes = figure.add_axes((0.14, bottom, 0.63, top - 0.018 - bottom))
    for k, row in enumerate(drift.rows):
        ends = [_end(side, row.value) for side in (row.down, row.up)]
        span = row.up.limit - row.down.limit
        at = [(end - row.down.limit) / span for end in (*ends, row.value)]
        axes.plot([0, 1], [k, k], color="0.85", lw=0.6, zorder=0)
        axes.plot(at[:2], [k, k], color="tab:blue", lw=3.5, solid_capstyle="butt")
        axes.plot(at[2], k, "|", color="black", ms=7)
        for side in (row.down, row.up):
            if side.bad is not None:
                x = (side.bad.value - row.down.limit) / span
                axes.plot(x, k, "x", color="tab:red", ms=3.5, mew=0.9, clip_on=False)
        left, right = f"{row.down.limit:.4g}  ", f"  {row.up.limit:.4g}"
        axes.text(0, k, left, ha="right", va="center", fontsize=4.5, color="0.4")
        label = f"{right}    {ends[0]:.3g} … {row.value:.3g} … {ends[1]:.3g} {row.unit}"
        axes.text(1, k, label, ha="left", va="center", fontsize=4.8)
    axes.set(xlim=(0, 1.0), ylim=(len(drift.rows) - 0.5, -0.5), xticks=[])
    axes.set_yticks(range(len(drift.rows)), [row.name for row in drift.rows], fontsize=_SMALL)
    axes.tick_params(length=0, pad=22)
    axes.spines[:].set_visible(False)
    key = "Bar: down to and up to; |: the design; x: fails at; grey: range. Shares: build_sheet.md."
    return _notes(figure, bottom - 0.006, [key, *section.notes])


def _end(side: Side, value: float) -> float:
    return value if side.good is None else side.good.value


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
