"""One figure of accuracy against time: verdicts and finger tip, by machine and engine.

`scripts.accuracy.budget --report` draws it, from the file of --merge alone.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from codesign_jax.report.statistics import Interval
from scripts.accuracy.budget_report import RATED, Budget
from scripts.shared import figures

C = "MuJoCo C"
LOOKS = {
    "this engine, one H100": ("tab:blue", "o"),
    "this engine, 2 CPU cores": ("tab:orange", "o"),
    "MuJoCo C, 2 CPU cores": ("tab:green", "s"),
}
"""Color and marker of an engine on a machine, the same in both panels."""
WORDS = {
    "fast": "fast",
    "standard": "standard",
    "fine": "fine",
    "reference": "reference",
    "least, 1e-3": "10 ms, tolerance 1e-3",
    "4 x 16, least, 1e-3": "10 ms, 1e-3, finer skin",
    "5 ms, least, 1e-3": "5 ms, tolerance 1e-3",
    "spheres": "spheres, no skin",
    "spheres, MuJoCo C": "spheres, no skin",
}
"""Variants that are shown where their rate is known, and what they are called."""
IN_THE_AIR = ("fast", "standard", "fine", "reference", "spheres", "spheres, MuJoCo C")
"""Those of which the finger tip is shown."""


class Place(NamedTuple):
    """A mark of the figure.

    Attributes:
      who: Engine and machine, one of `LOOKS`.
      setting: What the setting is called; marks of one name are joined.
      rate: Grasps a second, whole ones in the default scene.
      error: Error with its interval; one without width has no bar.
    """

    who: str
    setting: str
    rate: float
    error: Interval


def exactly(error: float) -> Interval:
    """An error without an interval."""
    return Interval(error, error, error)


def places(budget: Budget, errors: dict[str, Interval]) -> list[Place]:
    """Marks of the variants that have an error, one for each machine whose rate is known."""
    found = []
    for name, error in errors.items():
        for machine, rates in budget.rates.items():
            if rate := rates.get(name):
                who = f"{C if C in name else 'this engine'}, {RATED[machine]}"
                found.append(Place(who, WORDS[name], rate["grasps_per_s"], error))
    return found


def draw(left: list[Place], right: list[Place], floor: float | None, path: Path) -> Path:
    """Draws both panels.

    Args:
      left: Verdicts.
      right: Finger tips.
      floor: Share of the truth's verdicts that a micrometre flips, None if not known.
      path: Picture.
    """
    figure = figures.new(12.5, 5.8)
    verdict, tip = figure.subplots(1, 2)
    _marks(verdict, [p._replace(error=Interval(*(100 * v for v in p.error))) for p in left])
    words = "grasps a second: whole grasps of designs that hold"
    verdict.set(
        title="Verdicts in the default scene, paper",
        xlabel=words,
        ylabel="verdicts that flip against the truth [%]",
        ylim=(0, None),
    )
    _marks(tip, right)
    tip.set(
        title="Finger tip in a fast motion in the air, no contact",
        xlabel=words,
        ylabel="root mean square error [mm]",
        yscale="log",
    )
    _names(verdict, left, 100)
    _names(tip, right)
    for axis in (verdict, tip):
        axis.set_xlim(axis.get_xlim()[0] / 2)  # room for the name of a mark at the edge
    if floor is not None:
        verdict.axhline(100 * floor, color="0.4", ls=":", lw=1)
        verdict.text(
            0.99, 100 * floor, "a micrometre flips this share of the truth's own", fontsize=8,
            color="0.3", ha="right", va="top", transform=verdict.get_yaxis_transform(),
        )  # fmt: skip
    figure.legend(handles=_key([*left, *right]), loc="outside lower center", ncols=4, frameon=False)
    return figures.save(figure, path)


def _key(places: list[Place]) -> list[Line2D]:
    """What marks mean."""
    shown = {p.who for p in places}
    looks = [(who, {"color": c, "marker": m}) for who, (c, m) in LOOKS.items() if who in shown]
    return [Line2D([], [], ls="none", label=words, **look) for words, look in looks]


def _marks(axis: Axes, places: list[Place]) -> None:
    """Draws the marks with their intervals."""
    for place in places:
        color, marker = LOOKS[place.who]
        middle, low, high = place.error
        error = [[middle - low], [high - middle]] if high > low else None
        axis.errorbar(
            place.rate, middle, yerr=error, color=color, marker=marker, ms=7, ls="none",
            zorder=3, elinewidth=0.8, capsize=2,
        )  # fmt: skip
    axis.set_xscale("log")
    axis.grid(alpha=0.3, which="both", lw=0.4)


def _names(axis: Axes, places: list[Place], unit: float = 1) -> None:
    """Joins the marks of a setting by a line, with its name in the widest gap.

    Args:
      axis: Axis whose scales and limits are final.
      places: Marks.
      unit: What the axis shows of an error of one.
    """
    names = sorted({p.setting for p in places})
    rows = [sorted((p.rate, unit * p.error.value) for p in places if p.setting == n) for n in names]
    heights = _apart(axis, [row[0] for row in rows])
    gaps = [_gap([rate for rate, _ in row]) for row in rows]
    low, high = max((g[0] for g in gaps), default=0), min((g[1] for g in gaps), default=0)
    for name, row, height, gap in zip(names, rows, heights, gaps, strict=True):
        # Below one another if there is a place that is free in all rows.
        x = np.sqrt(low * high if high > 3 * low else gap[0] * gap[1])
        line = sorted([*row, (x, height)])
        axis.plot(*zip(*line, strict=True), color="0.6", lw=0.7, zorder=1)
        box = {"fc": "white", "ec": "none", "pad": 0.5}
        axis.text(x, height, name, fontsize=8, ha="center", va="center", zorder=4, bbox=box)


def _gap(rates: list[float]) -> tuple[float, float]:
    """The widest gap between sorted rates; of a single one the decade below it."""
    pairs = list(zip(rates, rates[1:], strict=False))
    return max(pairs, key=lambda p: p[1] / p[0], default=(rates[0] / 10, rates[0]))


def _apart(axis: Axes, points: list[tuple[float, float]], least: float = 0.04) -> list[float]:
    """Heights near those of points, so that names do not meet: `least` of the axis apart."""
    axis.get_ylim()  # finds the limits
    scale = axis.transScale + axis.transLimits
    height = scale.transform(np.reshape(points, (-1, 2)))[:, 1]
    order = np.argsort(height, kind="stable")
    steps = least * np.arange(len(order))
    wanted = height[order] - steps
    # Between the lowest heights of which none is too low and the highest of which none too high.
    up, down = np.maximum.accumulate(wanted), np.minimum.accumulate(wanted[::-1])[::-1]
    height[order] = (up + down) / 2 + steps
    return [float(y) for _, y in scale.inverted().transform([(0.0, h) for h in height])]


def marks(budget: Budget) -> tuple[list[Place], list[Place]]:
    """Marks of both panels.

    In the air engines solve the same equations, so that MuJoCo C has this engine's error there.

    Args:
      budget: Variants of the default scene, their rates and the errors of their finger tips.
    """
    beside = {name: budget.compared(name, "truth") for name in WORDS}
    flipped = {name: found["flipped"] for name, found in beside.items() if found}
    tips = {name: exactly(budget.tips[name]) for name in IN_THE_AIR if name in budget.tips}
    return places(budget, flipped), places(budget, tips)


def make(budget: Budget, path: Path) -> Path:
    """Draws the figure of `marks` into a file."""
    moved = budget.compared("truth, moved", "truth")
    return draw(*marks(budget), moved["flipped"].value if moved else None, path)
