"""The tables and the figure of `scripts.accuracy.budget`, from its file alone.

The figure of accuracy against time is `against_time`.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.patches import Patch

from codesign_jax.scene import load
from scripts.accuracy import analysis, decision
from scripts.accuracy.tables import interval
from scripts.shared import figures, tables

PRESETS = ("fast", "standard", "fine", "reference")
CANDIDATES = {
    "least": "`standard` with least damping",
    "least, 1e-3": "`standard` with least damping, a tolerance of 1e-3",
    "4 x 16, least, 1e-3": "the same and a skin of 4 × 16 points a link",
    "5 ms, least, 1e-3": "`fine` with a tolerance of 1e-3 and 24 iterations",
    "5 ms, 3 x 12, least, 1e-3": "the same and a skin of 3 × 12 points a link",
}
RATED = {"gpu": "one H100", "cpu": "2 CPU cores"}
"""Machines whose rates the file has, in words."""


class Change(NamedTuple):
    """A row of the budget: what is changed, from which variant to which, and of what kind."""

    words: str
    of: str
    to: str
    kind: str


CHANCE, NUMERICS, MODELS = "chance", "numerics", "models"
COLORS = {CHANCE: "tab:gray", NUMERICS: "tab:blue", MODELS: "tab:orange"}
CHANGES = (
    Change("object moved by a micrometre, `standard`", "standard", "standard, moved", CHANCE),
    Change("the same, the truth", "truth", "truth, moved", CHANCE),
    Change("CPUs in place of a GPU, `standard`", "standard", "standard, on CPUs", CHANCE),
    Change("time step of 5 ms", "standard", "5 ms", NUMERICS),
    Change("time step of 2 ms", "standard", "2 ms", NUMERICS),
    Change("20 links", "standard", "20 links", NUMERICS),
    Change("skin of 4 × 16 points a link", "standard", "4 x 16", NUMERICS),
    Change("four Newton iterations", "standard", "4 iterations", NUMERICS),
    Change("tolerance of 1e-3", "standard", "1e-3", NUMERICS),
    Change("least damping alone", "standard", "least", NUMERICS),
    Change("step, links and skin at once: the truth", "standard", "truth", NUMERICS),
    Change("the truth refined again", "truth", "finer", NUMERICS),
    Change(
        "the palm acts once a finger is in it", "standard, on CPUs", "palm once inside", NUMERICS
    ),
    Change(
        "MuJoCo C in place of this engine, with spheres",
        "spheres",
        "spheres, MuJoCo C",
        NUMERICS,
    ),
    Change("fingers creep on one another", "standard, on CPUs", "fingers creep", MODELS),
    Change("soft touch", "standard, on CPUs", "soft touch", MODELS),
    Change("pressure resists sideways bending", "standard, on CPUs", "lateral threshold", MODELS),
    Change("neo-Hookean bending", "standard", "neo-Hookean", MODELS),
    Change("spheres in place of the skin", "standard", "spheres", MODELS),
    Change("fingers pass one another", "standard", "fingers pass each other", MODELS),
    Change("fingers pass the palm", "standard", "fingers pass the palm", MODELS),
    Change(
        "another of the calibrated sets of constants in each trial",
        "standard, on CPUs",
        "constants",
        MODELS,
    ),
)


class Budget:
    """Costs of all variants that a file has, and their comparisons."""

    def __init__(self, found: dict[str, Any]):
        """Decodes the file."""
        scene = load("paper")
        records = {n: r for n, r in found["variants"].items() if "lost" in r}
        self.costs = {n: decision.costs(scene, r) for n, r in records.items()}
        self.rates = {n: r["rates"] for n, r in found.get("rates", {}).items()}
        self.tips: dict[str, float] = found.get("tips", {}).get("tip_rms_mm", {})
        self._compared: dict[tuple[str, str], dict[str, Any]] = {}

    def compared(self, of: str, to: str) -> dict[str, Any] | None:
        """`analysis.compare` of a variant with another one, None if either was not run."""
        if of not in self.costs or to not in self.costs:
            return None
        if (of, to) not in self._compared:  # tables and figures ask for the same ones
            self._compared[of, to] = analysis.compare(self.costs[of], self.costs[to])
        return self._compared[of, to]

    def row(self, name: str, words: str) -> list[str]:
        """A setting beside the truth."""
        beside, moved = self.compared(name, "truth"), self.compared(name, f"{name}, moved")
        rates = [self.rates.get(machine, {}).get(name) for machine in RATED]
        cells = [words, *["–"] * 5]
        if beside:
            cells[1] = points(beside["success_difference"])
            cells[2], cells[3] = interval(beside["flipped"]), interval(beside["rank"], ".2f")
        if moved:
            cells[4] = f"{moved['flipped'].value:.1%}"
        if name in self.tips:
            cells[5] = f"{self.tips[name]:.2g} mm"
        return cells + [f"{r['grasps_per_s']:,.0f}" if r else "–" for r in rates]

    def tables(self) -> dict[str, str]:
        """Markdown by the name of its marks on docs/accuracy.md."""
        found = {"budget": f"{tables.markdown(budget_table(self))}\n\n{luck(self)}"}
        if "truth" in self.costs:
            found["against-truth"] = tables.markdown(presets_table(self))
        return found


def points(value: Any) -> str:
    """A difference of success in points, with its interval."""
    middle, low, high = (100 * v for v in value)
    return f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]"


def presets_table(budget: Budget) -> list[list[str]]:
    """Presets and candidates beside the truth."""
    head = ["setting", "success, points from the truth", "verdicts that flip", "rank correlation"]
    head += ["flips by a micrometre", "finger tip in the air"]
    rows = [[*head, *(f"grasps/s, {m}" for m in RATED.values())]]
    rows += [budget.row(name, f"`{name}`") for name in PRESETS]
    rows += [budget.row(n, words) for n, words in CANDIDATES.items() if n in budget.costs]
    return rows if budget.rates else [row[: -len(RATED)] for row in rows]


def budget_table(budget: Budget) -> list[list[str]]:
    """What each change moves."""
    rows = [["change", "verdicts that flip", "success, points", "rank correlation", "of"]]
    for change in CHANGES:
        if found := budget.compared(change.to, change.of):
            cells = interval(found["flipped"]), points(found["success_difference"])
            rows.append([change.words, *cells, f"{found['rank'].value:.2f}", change.kind])
    return rows


def luck(budget: Budget) -> str:
    """What six trials tell of a design: a sentence."""
    cost = budget.costs["truth" if "truth" in budget.costs else "standard"]
    kept = (cost < 0.01).astype(float)
    six = np.sqrt((kept.mean(1) * (1 - kept.mean(1))).mean() / 6)
    rank = analysis.trial_noise(cost)
    told = "none" if rank is None else f"{rank:.2f}"
    return (
        f"Luck of six trials: a design's success has a standard error of {100 * six:.0f} points; "
        f"ranks by six trials and by six others correlate by {told}."
    )


def draw(budget: Budget, path: Path) -> Path:
    """The budget as bars with their intervals, by kind."""
    found = [(c, r) for c in CHANGES if (r := budget.compared(c.to, c.of))]
    figure = figures.new(7.5, 0.28 * len(found) + 1.0)
    axes = figure.subplots()
    for place, (change, result) in enumerate(found):
        middle, low, high = (100 * v for v in result["flipped"])
        axes.barh(-place, middle, color=COLORS[change.kind], alpha=0.8)
        error = [[middle - low], [high - middle]]
        axes.errorbar(middle, -place, xerr=error, fmt="none", color="black", capsize=2)
    words = [c.words.replace("`", "") for c, _ in found]
    axes.set_yticks([-k for k in range(len(found))], words, fontsize=8)
    handles = [Patch(color=color, alpha=0.8) for color in COLORS.values()]
    axes.legend(handles, list(COLORS), frameon=False, fontsize=8, loc="upper right")
    axes.set(xlabel="verdicts that flip [%]", xlim=(0, None))
    return figures.save(figure, path)


def make(budget: Budget, page: Path | None, figure: Path | None) -> int:
    """Prints the tables, fills them into a page, draws the figure; returns the exit status."""
    for mark, text in budget.tables().items():
        print(f"{text}\n")
        if page:
            tables.fill(page, text, mark)
    if figure:
        print(draw(budget, figure))
    return 0
