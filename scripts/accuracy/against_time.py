"""One figure of accuracy against time: verdicts and finger tip, by machine and engine.

`scripts.accuracy.budget --report` draws it, from the files of docs/data alone.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from codesign_jax.report.statistics import Interval
from scripts.accuracy.budget_report import RATED, Budget
from scripts.accuracy.figures import grasps
from scripts.accuracy.report import SHORT
from scripts.accuracy.results import Study
from scripts.accuracy.settings import HULL, PRESETS, one_at_a_time
from scripts.shared import figures

ENGINES = {"structured": "this engine", "mujoco": "MuJoCo C", "warp": "MuJoCo Warp"}
LOOKS = {
    "this engine, one H100": ("tab:blue", "o"),
    "this engine, one H200": ("tab:cyan", "o"),
    "this engine, 2 CPU cores": ("tab:orange", "o"),
    "MuJoCo C, 2 CPU cores": ("tab:green", "s"),
    "MuJoCo Warp, one H200": ("tab:purple", "^"),
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
}
"""Settings whose verdicts are shown where their rate is known, and what they are called."""
SPHERES = "spheres, no skin"
BENCHMARKS = {
    ("structured", "default", 360): "cpu",
    ("mujoco", "documented", 360): "cpu",
    ("structured", "default", 1728): "h200",
    ("warp", "documented", 1728): "h200",
}
"""Records of docs/data/benchmark_*.json: engine, its settings, grasps of a call; and the file."""


class Place(NamedTuple):
    """A mark of the figure.

    Attributes:
      who: Engine and machine, one of `LOOKS`.
      setting: What the setting is called; marks of one name are joined. Empty: a small mark.
      rate: Grasps a second.
      error: Error with its interval; one without width has no bar.
      hollow: Whether the rate is of another scene than the error.
    """

    who: str
    setting: str
    rate: float
    error: Interval
    hollow: bool = False


def exactly(error: float) -> Interval:
    """An error without an interval."""
    return Interval(error, error, error)


def verdicts(budget: Budget) -> list[Place]:
    """Verdicts that flip against the truth in the default scene, and the settings' rates there."""
    return [
        Place(f"this engine, {RATED[machine]}", words, rate["grasps_per_s"], found["flipped"])
        for name, words in WORDS.items()
        for machine, rates in budget.rates.items()
        if (rate := rates.get(name)) and (found := budget.compared(name, "truth"))
    ]


def spheres(budget: Budget, data: Path) -> list[Place]:
    """What engines without the skin can do: spheres.

    The error is this engine's in the default scene with spheres; the rates are those of the
    scene paper_spheres, in which the engines' verdicts agree.

    Args:
      budget: The variants.
      data: Folder of the benchmarks.
    """
    found, error = [], budget.compared("spheres", "truth")
    if error is None:
        return found
    for (engine, setting, worlds), machine in BENCHMARKS.items():
        file = data / f"benchmark_{machine}.json"
        records = json.loads(file.read_text())["records"] if file.exists() else []
        asked = {"engine": engine, "setting": setting, "worlds": worlds, "kind": "grasp"}
        who = f"{ENGINES[engine]}, {SHORT[machine]}"
        found += [
            Place(who, SPHERES, r["grasps_per_s"], error["flipped"], hollow=True)
            for r in records
            if r.get("grasps_per_s") and asked.items() <= r.items()
        ]
    return found


def tips(studies: dict[str, Study]) -> list[Place]:
    """Errors of the finger tip by the first study, and costs of all machines.

    Engines solve the same equations in the air, so that MuJoCo C has this engine's error. Its
    solver is its own: of a preset it has time step, links and damping.

    Args:
      studies: By the machine's name; the first has the errors.
    """
    full, names = next(iter(studies.values())), {s: n for n, s in PRESETS.items()}
    usual = {"surface": HULL, "extra": (), "precision": "float32", "keep_contact": False}
    found = []
    for setting in one_at_a_time("structured"):
        plain, error = replace(setting, iterations=None), full.error("tip", setting)
        if not error or setting not in (*names, replace(plain, **usual)):
            continue
        for machine, study in studies.items():
            for engine, of in {"structured": setting, "mujoco": plain}.items():
                if cost := study.cost(engine, of):
                    who = f"{ENGINES[engine]}, {SHORT[machine]}"
                    found.append(Place(who, names.get(setting, ""), grasps(cost), exactly(error)))
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
    verdict.set(
        title="Verdicts in the default scene, paper",
        xlabel="grasps a second: whole grasps of designs that hold",
        ylabel="verdicts that flip against the truth [%]",
        ylim=(0, None),
    )
    _marks(tip, right)
    tip.set(
        title="Finger tip in a fast motion in the air, no contact",
        xlabel="grasps a second: 9 s of steps in contact, none between fingers",
        ylabel="root mean square error [mm]",
        yscale="log",
    )
    _names(verdict, left, 100)
    _names(tip, right)
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
    if any(p.hollow for p in places):
        words = "hollow: rate in paper_spheres, designs half random"
        looks.append((words, {"color": "0.3", "marker": "o", "mfc": "white"}))
    if not all(p.setting for p in places):
        looks.append(("small: other settings", {"color": "0.3", "marker": "o", "ms": 3}))
    return [Line2D([], [], ls="none", label=words, **look) for words, look in looks]


def _marks(axis: Axes, places: list[Place]) -> None:
    """Draws the marks with their intervals."""
    for place in places:
        color, marker = LOOKS[place.who]
        middle, low, high = place.error
        look: dict[str, Any] = {"color": color, "marker": marker, "ls": "none", "zorder": 3}
        look |= {"mfc": "white"} if place.hollow else {}
        look |= {"ms": 7} if place.setting else {"ms": 3, "alpha": 0.6}
        error = [[middle - low], [high - middle]] if high > low else None
        axis.errorbar(place.rate, middle, yerr=error, elinewidth=0.8, capsize=2, **look)
    axis.set_xscale("log")
    axis.grid(alpha=0.3, which="both", lw=0.4)


def _names(axis: Axes, places: list[Place], unit: float = 1) -> None:
    """Joins the marks of a setting by a line, with its name in the widest gap.

    Args:
      axis: Axis whose scales and limits are final.
      places: Marks.
      unit: What the axis shows of an error of one.
    """
    names = sorted({p.setting for p in places} - {""})
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


def make(budget: Budget, studies: dict[str, Study], data: Path, path: Path) -> Path:
    """Draws the figure.

    Args:
      budget: Variants of the default scene and their rates.
      studies: Of the finger tip, by the machine's name, see `report.studies`.
      data: Folder of the benchmarks.
      path: Picture.
    """
    left = verdicts(budget) + spheres(budget, data)
    moved = budget.compared("truth, moved", "truth")
    return draw(left, tips(studies), moved["flipped"].value if moved else None, path)
