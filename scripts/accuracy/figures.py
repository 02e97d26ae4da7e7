"""Work-precision diagrams: error against time, with Pareto fronts and failed settings."""

import textwrap
from pathlib import Path
from typing import NamedTuple

import matplotlib.lines
import numpy as np
from matplotlib.axes import Axes

from codesign_jax.scene import load as load_scene
from scripts.accuracy import analysis
from scripts.accuracy.settings import HULL, LINKS, TIMESTEPS, Setting, standard_of
from scripts.shared import figures as pictures
from scripts.shared import labels

COLORS = {"structured": "tab:blue", "mujoco": "tab:green", "mjx": "tab:orange"}
MARKERS = {
    "standard": "*",
    "time step": "o",
    "links": "s",
    "axes": "v",
    "surface": "h",
    "damping": "D",
    "contact": "p",
    "iterations": "P",
    "precision": "X",
    "several": "^",
}
REFUSED = "refused or failed"
GRASP = load_scene("paper").phases.ungrasp
"""Simulated time of a grasp [s]."""


def grasps(cost: float) -> float:
    """Grasps a second at a cost [wall s of a simulated s of a world]; its own inverse."""
    return 1 / (cost * GRASP)


class Point(NamedTuple):
    """One setting in a diagram.

    Attributes:
      engine: Engine.
      knob: What the setting changes, one of `MARKERS`.
      label: The setting in words.
      cost: Wall seconds of a simulated second of a world.
      error: Error, not a number for a setting that was refused or failed.
    """

    engine: str
    knob: str
    label: str
    cost: float
    error: float


def knob(setting: Setting) -> str:
    """What a setting changes of the standard one."""
    # MuJoCo C's finger tip in the air stands for that of the hull, see `Study.points`.
    base, found = standard_of(setting.engine if setting.surface != HULL else "structured"), []
    for name, fields in {
        "time step": ("timestep", "keep_contact"),
        "links": ("links",),
        "axes": ("axes",),
        "surface": ("surface",),
        "damping": ("damping",),
        "contact": ("extra",),
        "iterations": ("iterations",),
        "precision": ("precision",),
    }.items():
        if any(getattr(setting, f) != getattr(base, f) for f in fields):
            found.append(name)
    return "standard" if not found else found[0] if len(found) == 1 else "several"


def diagram(panels: dict[str, list[Point]], path: Path, title: str) -> None:
    """Draws panels of error against cost, each engine's Pareto front as a line with names.

    Args:
      panels: Points by the name of the error.
      path: Picture.
      title: Machine and batch.
    """
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    size = 6.4 * columns, 4.4 * rows + 1.0
    figure = pictures.new(*size)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    names = [_panel(*item) for item in zip(axes, panels.items(), strict=False)]
    every = [p for points in panels.values() for p in points]
    engines = dict.fromkeys(p.engine for p in every)
    lines = [matplotlib.lines.Line2D([], [], color=COLORS[e], lw=2) for e in engines]
    shown = {p.knob if np.isfinite(p.error) else REFUSED for p in every}
    known = [k for k in (*MARKERS, REFUSED) if k in shown]
    for name in known:
        look = {"marker": MARKERS.get(name, "x"), "color": "0.4" if name in MARKERS else "tab:red"}
        lines.append(matplotlib.lines.Line2D([], [], ls="none", ms=8, **look))
    figure.legend(lines, [*engines, *known], loc="outside lower center", ncols=7, frameon=False)
    figure.suptitle("\n".join(textwrap.wrap(title, 60 * columns)), fontsize=9)
    figure.draw_without_rendering()  # lays out: labels need to know where the points are
    figure.set_layout_engine("none")
    for axis, (texts, points) in zip(axes, names, strict=False):
        labels.add(axis, texts, points)
    pictures.save(figure, path)


def _panel(axis: Axes, item: tuple[str, list[Point]]) -> tuple[list[labels.Label], np.ndarray]:
    """Draws one error's points; returns the names to write and all points, shape (point, 2)."""
    name, points = item
    positive = [p.error for p in points if p.error > 0]
    floor, top = 0.5 * min(positive, default=1e-3), 2.5 * max(positive, default=1.0)
    drawn = [p._replace(error=max(p.error, floor)) for p in points]  # log of no error at all
    texts: list[labels.Label] = []
    for engine in dict.fromkeys(p.engine for p in points):
        mine = [p for p in drawn if p.engine == engine and np.isfinite(p.error)]
        chosen = [mine[i] for i in analysis.front([(p.cost, p.error) for p in mine])]
        line = np.array([(p.cost, p.error) for p in chosen]).reshape(-1, 2)
        axis.plot(*line.T, color=COLORS[engine], lw=1, alpha=0.6)
        for p in mine:
            axis.plot(
                p.cost, p.error, MARKERS[p.knob], color=COLORS[engine], mec="black", mew=0.4,
                ms=13 if p.knob == "standard" else 6, ls="none",
            )  # fmt: skip
        named = chosen + [p for p in mine if p.knob == "standard" and p not in chosen]
        texts += [(p.cost, p.error, p.label, "black") for p in named]
    refused = [p for p in points if not np.isfinite(p.error)]
    for p in refused:
        axis.plot(p.cost, top, "x", color="tab:red", ms=8, mew=2, ls="none")
        texts.append((p.cost, top, p.label, "tab:red"))
    axis.set(xscale="log", yscale="log", xlabel="wall s of a simulated s of a world", ylabel=name)
    axis.margins(x=0.08, y=0.08)
    axis.grid(alpha=0.3, which="both", lw=0.4)
    # Matplotlib asks for limits at zero as well.
    both = lambda x: grasps(np.maximum(x, 1e-300))  # noqa: E731
    other = axis.secondary_xaxis("top", functions=(both, both))
    other.set_xlabel("grasps/s")
    where = [(p.cost, p.error if np.isfinite(p.error) else top) for p in drawn]
    return texts, np.array(where)


def convergence(lines: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Errors against what is refined, with their slopes, two panels: time step and links.

    Args:
      lines: (size, error) by name; the names that speak of the time step go left.
      path: Picture.
    """
    figure = pictures.new(9.6, 5.2)
    left, right = figure.subplots(1, 2)
    for name, points in lines.items():
        axis = left if "time step" in name else right
        slope = analysis.order(points)
        label = name + ("" if slope is None else f": order {slope:.2f}")
        if points:
            axis.loglog(*zip(*sorted(points), strict=True), marker="o", ms=4, label=label)
    left.set(xlabel="time step [ms]", ylabel="error")
    right.set(xlabel="length of a link / length of the finger", ylabel="error")
    left.set_xticks(TIMESTEPS, [f"{t:g}" for t in TIMESTEPS])
    right.set_xticks([1 / n for n in LINKS], [f"1/{n}" for n in LINKS])
    for axis in (left, right):
        axis.xaxis.minorticks_off()
        if axis.lines:
            axis.legend(frameon=False, fontsize=7, loc="upper center",
                        bbox_to_anchor=(0.5, -0.16))  # fmt: skip
        axis.grid(alpha=0.3, which="both", lw=0.4)
    pictures.save(figure, path)
