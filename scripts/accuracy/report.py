"""Tables and figures of the variants' verdicts and finger tips, from the data of two studies.

`RECOMMENDED` has the designs that searches recommend, `HARD` designs that keep 30 to 95 %.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.patches import Patch

from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.scene import load
from codesign_jax.statistics import Interval
from scripts.accuracy import budget
from scripts.shared import output
from scripts.shared.statistics import RESAMPLES, bootstrap, spearman, two_way_means

RECOMMENDED = "budget.json"
HARD = "hard_designs.json"
"""Files of docs/data."""
PRESETS = ("fast", "standard", "fine", "reference")
CANDIDATES = {
    "1e-6": "`standard` with a tolerance of 1e-6",
    "Euler": "the same and implicit Euler",
    "4 rings, 1e-3": "`standard` with four rings a link",
    "5 ms, 3 rings, 1e-3": "`fine` with three rings a link",
}


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
    Change("a silicone of 101 kPa in place of 88", BASE, "101 kPa", MODELS),
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
      The difference of success and the share of verdicts that flip, with intervals of 95 % over
      designs and trials, and the rank correlation of mean costs, with one over designs: trials that
      are drawn twice add noise, which lowers a correlation.
    """
    trials = min(a.shape[1], b.shape[1])
    a, b = (costs[:, :trials] for costs in (a, b))

    def ranks(rows: np.ndarray) -> np.ndarray:
        return spearman(*(mean_costs(costs)[rows] for costs in (a, b)))

    more = (a < SUCCESS_COST).astype(float) - (b < SUCCESS_COST)
    difference, flipped = two_way_means(more, np.abs(more), resamples=RESAMPLES)
    rank = bootstrap(ranks, len(a), resamples=RESAMPLES)
    return {"success_difference": difference, "flipped": flipped, "rank": rank}


class Budget:
    """Costs of all variants that a file has, and their comparisons."""

    def __init__(self, content: dict[str, Any]):
        """Decodes the file."""
        scene = load("paper")
        records = {n: r for n, r in content["variants"].items() if "lost" in r}
        self.costs = {n: budget.costs(scene, r) for n, r in records.items()}
        self.rates: dict[str, Any] = {n: r["rates"] for n, r in content.get("rates", {}).items()}
        self.tips: dict[str, float] = content.get("tips", {}).get("tip_rms_mm", {})
        self._compared: dict[tuple[str, str], dict[str, Interval]] = {}

    def compared(self, of: str, to: str) -> dict[str, Interval] | None:
        """`compare` of a variant with another one, None if either was not run."""
        if of not in self.costs or to not in self.costs:
            return None
        if (of, to) not in self._compared:  # tables and figures ask for the same ones
            self._compared[of, to] = compare(self.costs[of], self.costs[to])
        return self._compared[of, to]

    def milliseconds(self, machine: str, name: str) -> float | None:
        """Time of a grasp [ms]: wall time of a GPU, processor time of a CPU's core."""
        rate = self.rates.get(machine, {}).get(name)
        if rate is None:
            return None
        return 1e3 * rate["seconds" if machine == "gpu" else "processor_seconds"] / rate["grasps"]

    def row(self, name: str, words: str) -> list[str]:
        beside = self.compared(name, "truth")
        repeated = self.compared(name, f"{name}, moved")
        cells = [words, *["–"] * 5]
        if beside:
            cells[1] = points(beside["success_difference"])
            cells[2] = interval(beside["flipped"])
            cells[3] = interval(beside["rank"], ".2f")
        if repeated:
            cells[4] = f"{repeated['flipped'].value:.1%}"
        if name in self.tips:
            cells[5] = f"{self.tips[name]:.2g} mm"
        return cells


def read(data: Path, name: str) -> Budget:
    """One of the two studies in a folder."""
    return Budget(json.loads((data / name).read_text(encoding="utf-8")))


def tables(recommended: Budget, hard: Budget) -> dict[str, str]:
    """Markdown by the name of its marks on docs/accuracy.md."""
    return {
        "budget": f"{output.markdown(budget_table(recommended, hard))}\n\n{luck(recommended)}",
        "against-truth": output.markdown(presets_table(recommended)),
    }


def interval(value: Interval, form: str = ".1%") -> str:
    """A value with its interval; alone where no resample differs, which is no certainty."""
    if not np.isfinite(value.value):
        return "–"
    if value.low == value.high:
        return f"{value.value:{form}}"
    return f"{value.value:{form}} [{value.low:{form}}, {value.high:{form}}]"


def points(value: Interval) -> str:
    middle, low, high = (100 * v for v in value)
    return f"{middle:+.1f}" if low == high else f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]"


def presets_table(results: Budget) -> list[list[str]]:
    head = ["setting", "kept share, points from the truth", "verdicts that flip"]
    head += ["rank correlation", "verdicts that flip if the object moves by a micrometre"]
    rows = [[*head, "error of the finger tip in the air"]]
    rows += [results.row(name, f"`{name}`") for name in PRESETS]
    rows += [results.row(n, words) for n, words in CANDIDATES.items() if n in results.costs]
    return rows


def budget_table(recommended: Budget, hard: Budget) -> list[list[str]]:
    head = ["change", "recommended designs: verdicts that flip", "kept share, points"]
    head += ["hard designs: verdicts that flip", "kept share, points", "rank correlation", "kind"]
    rows = [head]
    for change in CHANGES:
        compared = [study.compared(change.to, change.of) for study in (recommended, hard)]
        cells = [change.words]
        for beside in compared:
            cells += [interval(beside["flipped"]) if beside else "–"]
            cells += [points(beside["success_difference"]) if beside else "–"]
        cells += [interval(compared[1]["rank"], ".2f") if compared[1] else "–", change.kind]
        if any(compared):
            rows.append(cells)
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


def draw_budget(recommended: Budget, hard: Budget, path: Path) -> Path:
    """The budget as bars with their intervals, by kind: hard designs above recommended ones."""
    shown = [change for change in CHANGES if hard.compared(change.to, change.of)]
    figure = output.new_figure(8.5, 0.36 * len(shown) + 1.0)
    axes = figure.subplots()
    for study, offset, alpha in ((hard, 0.2, 0.9), (recommended, -0.2, 0.4)):
        for row, change in enumerate(shown):
            if not (result := study.compared(change.to, change.of)):
                continue
            middle, low, high = (100 * v for v in result["flipped"])
            y = offset - row
            axes.barh(y, middle, height=0.4, color=COLORS[change.kind], alpha=alpha)
            error = [[middle - low], [high - middle]]
            axes.errorbar(middle, y, xerr=error, fmt="none", color="black", capsize=2, lw=0.8)
    words = [change.words.replace("`", "") for change in shown]
    axes.set_yticks([-k for k in range(len(shown))], words, fontsize=8)
    axes.set_ylim(0.6 - len(shown), 0.6)
    handles = [Patch(color=color, alpha=0.9, label=kind) for kind, color in COLORS.items()]
    handles += [Patch(color="0.3", alpha=0.9, label="dark: hard designs")]
    handles += [Patch(color="0.3", alpha=0.4, label="light: recommended designs")]
    axes.legend(handles=handles, frameon=False, fontsize=8, loc="upper right")
    axes.set(xlabel="verdicts that flip [%]", xlim=(0, None))
    return output.save_figure(figure, path)
