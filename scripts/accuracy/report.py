"""Tables and figures of the variants' verdicts, finger tips and rates, from one file."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.scene import load
from codesign_jax.statistics import Interval
from scripts.accuracy import budget
from scripts.shared import output
from scripts.shared.statistics import RESAMPLES, spearman, two_way

PRESETS = ("fast", "standard", "fine", "reference")
CANDIDATES = {
    "1e-6": "`standard` with a tolerance of 1e-6",
    "Euler": "the same and implicit Euler",
    "4 rings, 1e-3": "`standard` with four rings a link",
    "5 ms, 3 rings, 1e-3": "`fine` with three rings a link",
}
RATED = {"gpu": "one H100", "cpu": "2 CPU cores"}
"""Machines whose rates the file has, in words."""


class Change(NamedTuple):
    """A row of the budget: what is changed, from which variant to which, and of what kind."""

    words: str
    of: str
    to: str
    kind: str


CHANCE = "chance"
NUMERICS = "numerics"
MODELS = "models"
COLORS = {CHANCE: "tab:gray", NUMERICS: "tab:blue", MODELS: "tab:orange"}
BASE = "1e-6"
"""What a change is compared with."""
CHANGES = (
    Change("object moved by a micrometre", BASE, "1e-6, moved", CHANCE),
    Change("the same, the truth", "truth", "truth, moved", CHANCE),
    Change("CPUs in place of a GPU", BASE, "1e-6, on CPUs", CHANCE),
    Change("time step of 5 ms", BASE, "5 ms", NUMERICS),
    Change("time step of 2 ms", BASE, "2 ms", NUMERICS),
    Change("time step of 20 ms", BASE, "20 ms", NUMERICS),
    Change("6 links", BASE, "6 links", NUMERICS),
    Change("20 links", BASE, "20 links", NUMERICS),
    Change("four rings a link", BASE, "4 rings", NUMERICS),
    Change("four Newton iterations", BASE, "4 iterations", NUMERICS),
    Change("tolerance of 1e-3: `standard`", BASE, "standard", NUMERICS),
    Change("implicit Euler", BASE, "Euler", NUMERICS),
    Change("step, links and tolerance at once: `fast`", BASE, "fast", NUMERICS),
    Change("step, links and rings at once: the truth", BASE, "truth", NUMERICS),
    Change("the truth refined again", "truth", "finer", NUMERICS),
    Change(
        "MuJoCo C in place of this engine, with spheres", "spheres", "spheres, MuJoCo C", NUMERICS
    ),
    Change("twice the contacts' stiffness", BASE, "twice the stiffness", MODELS),
    Change("half their dissipation time", BASE, "half the dissipation", MODELS),
    Change("fingers creep on one another", BASE, "fingers creep", MODELS),
    Change("pressure resists sideways bending", BASE, "lateral threshold", MODELS),
    Change("a mass of air in each chamber", BASE, "air mass", MODELS),
    Change("the linear bending law", BASE, "linear law", MODELS),
    Change("spheres in place of the hull", BASE, "spheres", MODELS),
    Change("fingers pass one another", BASE, "fingers pass each other", MODELS),
    Change("fingers pass the palm", BASE, "fingers pass the palm", MODELS),
    Change("fingers pass themselves", BASE, "fingers pass themselves", MODELS),
    Change("another of the calibrated sets of constants in each trial", BASE, "constants", MODELS),
)


def mean_costs(cost: np.ndarray) -> np.ndarray:
    """Mean cost of every design over the trials that did not fail, the maximum if all did."""
    good = np.isfinite(cost)
    total = np.where(good, cost, 0.0).sum(-1)
    return np.where(good.any(-1), total / np.maximum(good.sum(-1), 1), 3.0)


def compare(a: np.ndarray, b: np.ndarray) -> dict[str, Interval]:
    """A variant beside another one over the same designs and trials, of which b may have more.

    Returns:
      The difference of success, the share of verdicts that flip and the rank correlation of mean
      costs, each with its interval of 95 % over designs and trials.
    """
    trials = min(a.shape[1], b.shape[1])

    def values(a: np.ndarray, b: np.ndarray) -> list[float]:
        kept = a < SUCCESS_COST
        expected = b < SUCCESS_COST
        rank = float(spearman(mean_costs(a), mean_costs(b)))
        return [kept.mean() - expected.mean(), (kept != expected).mean(), rank]

    intervals = two_way(values, a[:, :trials], b[:, :trials], resamples=RESAMPLES)
    return dict(zip(("success_difference", "flipped", "rank"), intervals, strict=True))


class Budget:
    """Costs of all variants that a file has, and their comparisons."""

    def __init__(self, content: dict[str, Any]):
        """Decodes the file."""
        scene = load("paper")
        records = {n: r for n, r in content["variants"].items() if "lost" in r}
        self.costs = {n: budget.costs(scene, r) for n, r in records.items()}
        self.rates = {n: r["rates"] for n, r in content.get("rates", {}).items()}
        self.tips: dict[str, float] = content.get("tips", {}).get("tip_rms_mm", {})
        self._compared: dict[tuple[str, str], dict[str, Interval]] = {}

    def compared(self, of: str, to: str) -> dict[str, Interval] | None:
        """`compare` of a variant with another one, None if either was not run."""
        if of not in self.costs or to not in self.costs:
            return None
        if (of, to) not in self._compared:  # tables and figures ask for the same ones
            self._compared[of, to] = compare(self.costs[of], self.costs[to])
        return self._compared[of, to]

    @property
    def machines(self) -> list[str]:
        """Machines whose rates were measured, in the order of the columns."""
        return [machine for machine in RATED if machine in self.rates]

    def row(self, name: str, words: str) -> list[str]:
        beside = self.compared(name, "truth")
        repeated = self.compared(name, f"{name}, moved")
        rates = [self.rates[machine].get(name) for machine in self.machines]
        cells = [words, *["–"] * 5]
        if beside:
            cells[1] = points(beside["success_difference"])
            cells[2] = interval(beside["flipped"])
            cells[3] = interval(beside["rank"], ".2f")
        if repeated:
            cells[4] = f"{repeated['flipped'].value:.1%}"
        if name in self.tips:
            cells[5] = f"{self.tips[name]:.2g} mm"
        return cells + [f"{r['grasps_per_s']:,.0f}" if r else "–" for r in rates]

    def tables(self) -> dict[str, str]:
        """Markdown by the name of its marks on docs/accuracy.md."""
        texts = {"budget": f"{output.markdown(budget_table(self))}\n\n{luck(self)}"}
        if "truth" in self.costs:
            texts["against-truth"] = output.markdown(presets_table(self))
        return texts


def interval(value: Interval, form: str = ".1%") -> str:
    if not np.isfinite(value.value):
        return "–"
    return f"{value.value:{form}} [{value.low:{form}}, {value.high:{form}}]"


def points(value: Interval) -> str:
    middle, low, high = (100 * v for v in value)
    return f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]"


def presets_table(results: Budget) -> list[list[str]]:
    head = ["setting", "kept share, points from the truth", "verdicts that flip"]
    head += ["rank correlation", "verdicts that flip if the object moves by a micrometre"]
    head += ["error of the finger tip in the air"]
    rows = [[*head, *(f"grasps/s, {RATED[m]}" for m in results.machines)]]
    rows += [results.row(name, f"`{name}`") for name in PRESETS]
    rows += [results.row(n, words) for n, words in CANDIDATES.items() if n in results.costs]
    return rows


def budget_table(results: Budget) -> list[list[str]]:
    rows = [["change", "verdicts that flip", "kept share, points", "rank correlation", "kind"]]
    for change in CHANGES:
        if beside := results.compared(change.to, change.of):
            cells = interval(beside["flipped"]), points(beside["success_difference"])
            rows.append([change.words, *cells, f"{beside['rank'].value:.2f}", change.kind])
    return rows


def luck(results: Budget) -> str:
    """What six trials tell of a design: a sentence."""
    cost = results.costs["truth" if "truth" in results.costs else BASE]
    kept = (cost < SUCCESS_COST).astype(float)
    six = np.sqrt((kept.mean(1) * (1 - kept.mean(1))).mean() / 6)
    blocks = [mean_costs(cost[:, i : i + 6]) for i in range(0, cost.shape[1] - 5, 6)]
    ranks = [spearman(a, b) for a, b in zip(blocks, blocks[1:], strict=False)]
    words = f"{np.mean(ranks):.2f}" if ranks else "none"
    return (
        f"With six trials of each design, its kept share has a standard error of {100 * six:.0f} "
        f"points; the designs' ranks in six trials and in six other trials correlate by {words}."
    )


def draw_budget(results: Budget, path: Path) -> Path:
    """The budget as bars with their intervals, by kind."""
    shown = [(c, r) for c in CHANGES if (r := results.compared(c.to, c.of))]
    figure = output.new_figure(7.5, 0.28 * len(shown) + 1.0)
    axes = figure.subplots()
    for row, (change, result) in enumerate(shown):
        middle, low, high = (100 * v for v in result["flipped"])
        axes.barh(-row, middle, color=COLORS[change.kind], alpha=0.8)
        error = [[middle - low], [high - middle]]
        axes.errorbar(middle, -row, xerr=error, fmt="none", color="black", capsize=2)
    words = [c.words.replace("`", "") for c, _ in shown]
    axes.set_yticks([-k for k in range(len(shown))], words, fontsize=8)
    handles = [Patch(color=color, alpha=0.8) for color in COLORS.values()]
    axes.legend(handles, list(COLORS), frameon=False, fontsize=8, loc="upper right")
    axes.set(xlabel="verdicts that flip [%]", xlim=(0, None))
    return output.save_figure(figure, path)


# --- accuracy against time ------------------------------------------------------------------------

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
    "1e-6": "standard, 1e-6",
    "4 rings, 1e-3": "standard, four rings",
    "spheres": "spheres",
    "spheres, MuJoCo C": "spheres",
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


def marks(results: Budget) -> tuple[list[Place], list[Place]]:
    """Marks of verdicts and of finger tips, one for each machine whose rate is known.

    In the air engines solve the same equations, so that MuJoCo C has this engine's error there.
    """

    def places(errors: dict[str, Interval]) -> list[Place]:
        every = []
        for (name, error), (machine, rates) in (
            (e, r) for e in errors.items() for r in results.rates.items()
        ):
            if rate := rates.get(name):
                who = f"{C if C in name else 'this engine'}, {RATED[machine]}"
                every.append(Place(who, WORDS[name], rate["grasps_per_s"], error))
        return every

    beside = {name: results.compared(name, "truth") for name in WORDS}
    flipped = {name: c["flipped"] for name, c in beside.items() if c}
    tips = {n: Interval(*[results.tips[n]] * 3) for n in IN_THE_AIR if n in results.tips}
    return places(flipped), places(tips)


def draw_against_time(results: Budget, path: Path) -> Path:
    """Errors of verdicts and of finger tips against grasps a second, side by side."""
    left, right = marks(results)
    figure = output.new_figure(12.5, 5.8)
    verdict, tip = figure.subplots(1, 2)
    words = "grasps a second: whole grasps of designs that hold"
    _marks(verdict, [p._replace(error=Interval(*(100 * v for v in p.error))) for p in left])
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
        axis.xaxis.set_major_formatter(ticker.ScalarFormatter())
        axis.xaxis.set_minor_formatter(ticker.NullFormatter())
    repeated = results.compared("truth, moved", "truth")
    if repeated and (floor := 100 * repeated["flipped"].value):
        verdict.axhline(floor, color="0.4", ls=":", lw=1)
        verdict.text(
            0.99, floor, "a micrometre flips this share of the truth's own", fontsize=8,
            color="0.3", ha="right", va="top", transform=verdict.get_yaxis_transform(),
        )  # fmt: skip
    shown = {p.who for p in (*left, *right)}
    key = [
        Line2D([], [], ls="none", label=who, color=color, marker=marker)
        for who, (color, marker) in LOOKS.items()
        if who in shown
    ]
    figure.legend(handles=key, loc="outside lower center", ncols=4, frameon=False)
    return output.save_figure(figure, path)


def _marks(axis: Axes, places: list[Place]) -> None:
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
    """Joins the marks of a setting by a line, with its name in the widest gap."""
    names = sorted({p.setting for p in places})
    rows = [sorted((p.rate, unit * p.error.value) for p in places if p.setting == n) for n in names]
    heights = _apart(axis, [row[0] for row in rows])
    for name, row, height in zip(names, rows, heights, strict=True):
        rates = [rate for rate, _ in row]
        gaps = list(zip(rates, rates[1:], strict=False))
        low, high = max(gaps, key=lambda g: g[1] / g[0], default=(rates[0] / 10, rates[0]))
        x = np.sqrt(low * high)
        axis.plot(*zip(*sorted([*row, (x, height)]), strict=True), color="0.6", lw=0.7, zorder=1)
        box = {"fc": "white", "ec": "none", "pad": 0.5}
        axis.text(x, height, name, fontsize=8, ha="center", va="center", zorder=4, bbox=box)


def _apart(axis: Axes, points: list[tuple[float, float]], least: float = 0.04) -> list[float]:
    """Heights near those of points, so that names do not meet: `least` of the axis apart."""
    axis.get_ylim()  # finds the limits
    scale = axis.transScale + axis.transLimits
    height = scale.transform(np.reshape(points, (-1, 2)))[:, 1]
    order = np.argsort(height, kind="stable")
    steps = least * np.arange(len(order))
    heights = np.maximum(height[order] - steps, least / 2)  # above the axis
    # Between the lowest heights of which none is too low and the highest of which none too high.
    up = np.maximum.accumulate(heights)
    down = np.minimum.accumulate(heights[::-1])[::-1]
    height[order] = (up + down) / 2 + steps
    return [float(y) for _, y in scale.inverted().transform([(0.0, h) for h in height])]
