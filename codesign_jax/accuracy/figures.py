"""Work-precision diagrams: error against time, with Pareto fronts and failed settings."""

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.figure
import matplotlib.lines
import numpy as np

from codesign_jax.accuracy.settings import LINKS, TIMESTEPS, Setting

COLORS = {"structured": "tab:blue", "mujoco": "tab:green", "mjx": "tab:orange"}
MARKERS = {
    "standard": "*",
    "time step": "o",
    "links": "s",
    "axes": "v",
    "spheres": "D",
    "iterations": "P",
    "precision": "X",
    "several": "^",
}


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
    base, found = Setting(engine=setting.engine), []
    for name, fields in {
        "time step": ("timestep", "keep_contact"),
        "links": ("links",),
        "axes": ("axes",),
        "spheres": ("spheres",),
        "iterations": ("iterations",),
        "precision": ("precision",),
    }.items():
        if any(getattr(setting, f) != getattr(base, f) for f in fields):
            found.append(name)
    return "standard" if not found else found[0] if len(found) == 1 else "several"


def diagram(panels: dict[str, list[Point]], path: Path, title: str) -> None:
    """Draws panels of error against cost.

    Args:
      panels: Points by the name of the error.
      path: Picture.
      title: Machine and batch.
    """
    from codesign_jax.accuracy.statistics import front

    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    figure = matplotlib.figure.Figure((5.2 * columns, 3.6 * rows), dpi=120, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    shown: dict[str, Any] = {}
    for axis, (name, points) in zip(axes, panels.items(), strict=False):
        good = [p for p in points if np.isfinite(p.error)]
        positive = [p.error for p in good if p.error > 0]
        floor = 0.5 * min(positive, default=1e-3)
        top = 2.5 * max(positive, default=1.0)
        for engine in dict.fromkeys(p.engine for p in points):
            mine = [p for p in good if p.engine == engine]
            chosen = front([(p.cost, max(p.error, floor)) for p in mine])
            line = [(mine[i].cost, max(mine[i].error, floor)) for i in chosen]
            if line:
                axis.plot(*zip(*line, strict=True), color=COLORS[engine], lw=1, alpha=0.6)
            for p in mine:
                size = 13 if p.knob == "standard" else 6
                (shown[p.knob],) = axis.plot(
                    p.cost, max(p.error, floor), MARKERS[p.knob], color=COLORS[engine], ms=size,
                    mec="black", mew=0.4, ls="none",
                )  # fmt: skip
            for i in chosen:
                where = mine[i].cost, max(mine[i].error, floor)
                # Labels above and below in turn, where the points of a front lie close.
                away = (4, 4) if chosen.index(i) % 2 else (4, -9)
                axis.annotate(mine[i].label, where, fontsize=5.5, xytext=away,
                              textcoords="offset points")  # fmt: skip
            failed = [p for p in points if p.engine == engine and not np.isfinite(p.error)]
            for p in failed:
                (shown["refused or failed"],) = axis.plot(
                    p.cost, top, "x", color="tab:red", ms=8, mew=2, ls="none"
                )
                axis.annotate(p.label, (p.cost, top), fontsize=5.5, color="tab:red",
                              xytext=(4, -8), textcoords="offset points")  # fmt: skip
        axis.set(xscale="log", yscale="log", title=name, xlabel="wall s a simulated s and world")
        axis.grid(alpha=0.3, which="both", lw=0.4)
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    engines = dict.fromkeys(p.engine for points in panels.values() for p in points)
    lines = [matplotlib.lines.Line2D([], [], color=COLORS[e], lw=2) for e in engines]
    handles, names = [*lines, *shown.values()], [*engines, *shown]
    figure.legend(handles, names, loc="outside lower center", ncols=6, frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def convergence(lines: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Errors against what is refined, with their slopes, two panels: time step and links.

    Args:
      lines: (size, error) by name; the names that speak of the time step go left.
      path: Picture.
    """
    from codesign_jax.accuracy.statistics import order

    figure = matplotlib.figure.Figure((9.6, 3.6), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, points in lines.items():
        axis = left if "time step" in name else right
        slope = order(points)
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
            axis.legend(frameon=False, fontsize=7)
        axis.grid(alpha=0.3, which="both", lw=0.4)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
