"""Which of two hands is better: the figures of the accuracy page on designs that are hard to judge.

python -m scripts.accuracy.decisions --pick     # designs that keep 30 to 95 %, in HARD
python -m scripts.accuracy --of docs/data/search/hard.npz --designs 32 --trials 20 \\
    --out runs/hard --only "fast;standard;fine;reference;..."          # the variants of ROWS
python -m scripts.accuracy --out runs/hard --merge docs/data/decisions.json
python -m scripts.accuracy.decisions            # the figures and the table of the page

The verdicts that one change flips are in CHANGES, a count for each change.

A hand is chosen from two by half of the trials at one setting, and valued by the other half at
`reference`, so that no trial is counted on both sides.  The gain of a choice is the kept share of
the chosen hand beyond the mean of the two, in the mean over all pairs; the regret of a setting is
the gain of choosing by `reference` less its gain.
"""

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from codesign_jax import rollout, scene, use_compilation_cache
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from codesign_jax.statistics import Interval, gain, halves
from codesign_jax.types import failed
from scripts.accuracy import budget
from scripts.accuracy.report import interval, points
from scripts.shared import output, provenance, work
from scripts.shared.statistics import RESAMPLES, bootstrap, spearman, two_way

DOCS = Path(__file__).parents[2] / "docs"
HARD = DOCS / "data" / "search" / "hard.npz"
DATA = DOCS / "data" / "decisions.json"
FIGURE = DOCS / "figures" / "choices.png"
CHANGES = DOCS / "data" / "hard_designs.json"
CHANGES_FIGURE = DOCS / "figures" / "decisions.png"
KINDS = {
    "chance": ("a micrometre", "0.6"),
    "step": ("time step, integrator, accuracy", "tab:blue"),
    "contact": ("constants of the contact", "tab:green"),
    "rubber": ("constants of the rubber", "tab:red"),
}
"""What a change concerns: its words and its colour."""
SPREAD = 0.1
"""Standard deviation of a design near a winner, a share of each parameter's range."""
TRIALS = 12
SEED = 11
"""Trials that pick hard designs; no other study draws from this seed."""
LEAST = 0.3
MOST = 0.95
TRUTH = "reference"


class Row(NamedTuple):
    """A setting: its variant, its words and its kind."""

    variant: str
    words: str
    kind: str


PRESET = "accuracy"
CHANCE = "chance"
CONTACT = "contact"
RUBBER = "rubber"
COLORS = {PRESET: "tab:blue", CHANCE: "0.5", CONTACT: "tab:green", RUBBER: "tab:red"}
ROWS = (
    Row("fast", "`fast`", PRESET),
    Row("standard", "`standard`", PRESET),
    Row("fine", "`fine`", PRESET),
    Row("reference", "`reference`", PRESET),
    Row("1e-6", "`standard` with a tolerance of 1e-6", PRESET),
    Row("1e-6, moved", "the same, objects moved by a micrometre", CHANCE),
    Row("twice the stiffness", "the same, skin of 8 kN/m in place of 4", CONTACT),
    Row("fingers creep", "the same, no friction memory", CONTACT),
    Row("101 kPa", "the same, silicone of 101 kPa in place of 88", RUBBER),
    Row("linear law", "the same, linear bending law", RUBBER),
)


# --- hard designs ---------------------------------------------------------------------------------


def neighbours(space: parameters.DesignSpace, winners: np.ndarray) -> np.ndarray:
    """A design near each winner that a search may propose, shape (design, parameter)."""
    low, high = space.box
    normal = np.random.default_rng(SEED).normal(size=winners.shape)
    inside = np.clip(winners + SPREAD * (high - low) * normal, low, high)
    return np.asarray(jax.jit(jax.vmap(space.project))(jnp.asarray(inside, jnp.float32)))


def pick() -> Path:
    """Writes the neighbours of winners that keep `LEAST` to `MOST` of `TRIALS` grasps."""
    grasping = scene.load("paper")
    space = parameters.design_space(grasping.hand, "23d")
    engine = make_engine("structured", grasping)
    drawn = rollout.sample_trials(grasping, jax.random.key(SEED), TRIALS)
    designs = neighbours(space, work.winners())

    @jax.jit
    def run(vectors: jax.Array, trials: Any) -> Any:
        return rollout.simulate(grasping, engine, jax.vmap(space.params)(vectors), trials)[0]

    outcome = run(*budget.crossed(designs, drawn))
    kept = (np.asarray(outcome.cost) < SUCCESS_COST) & ~failed(np.asarray(outcome.status))
    share = kept.reshape(len(designs), TRIALS).mean(1)
    hard = (share >= LEAST) & (share <= MOST)
    print(f"{hard.sum()} of {hard.size} keep {LEAST:.0%} to {MOST:.0%} of {TRIALS} grasps")
    return output.write_arrays(HARD, {"designs0": designs[hard]})


# --- choices --------------------------------------------------------------------------------------


def rank(by: np.ndarray, truth: np.ndarray) -> float:
    """Spearman's correlation of the shares in one half of the trials and in the other at truth."""
    chooses = by.mean(1).T
    values = truth.mean(1)[:, ::-1].T
    return float(np.mean(spearman(chooses, values)))


def compared(by: np.ndarray, truth: np.ndarray) -> dict[str, Interval]:
    """Verdicts that flip, kept share, rank correlation and regret, with intervals of 95 %.

    The kept share is that beyond the truth's.  Intervals are over designs and trials.  That of the
    rank correlation is over designs alone: trials that are drawn twice add noise, which lowers a
    correlation.
    """

    def values(by: np.ndarray, truth: np.ndarray) -> list[float]:
        regret = gain(truth, truth) - gain(by, truth)
        return [float((by != truth).mean()), float(by.mean() - truth.mean()), regret]

    def ranks(rows: np.ndarray) -> np.ndarray:
        return np.array([rank(by[row], truth[row]) for row in np.atleast_2d(rows)])

    flipped, kept, regret = two_way(values, by, truth, resamples=RESAMPLES)
    correlation = bootstrap(ranks, len(by), resamples=RESAMPLES)
    return {"flipped": flipped, "kept": kept, "rank": correlation, "regret": regret}


def kept_of(content: dict[str, Any]) -> dict[str, np.ndarray]:
    """Halves of the kept grasps of every variant of a file."""
    grasping = scene.load("paper")
    records = content["variants"]
    return {n: halves(budget.costs(grasping, r) < SUCCESS_COST) for n, r in records.items()}


def results(content: dict[str, Any]) -> list[tuple[Row, dict[str, Interval]]]:
    """The rows that were simulated, with their measures."""
    kept = kept_of(content)
    simulated = [row for row in ROWS if row.variant in kept]
    return [(row, compared(kept[row.variant], kept[TRUTH])) for row in simulated]


def table(rows: list[tuple[Row, dict[str, Interval]]]) -> str:
    """The measures of every row, in Markdown."""
    head = ["simulated at", "does a grasp hold: verdicts that flip"]
    head += ["what share is kept: points from `reference`"]
    head += ["which of two is better: rank correlation", "regret of a choice, points"]
    cells = [head]
    for row, intervals in rows:
        flipped, rank = interval(intervals["flipped"]), interval(intervals["rank"], ".2f")
        kept, regret = (points(intervals[name]) for name in ("kept", "regret"))
        if row.variant == TRUTH:
            kept = regret = "–"
        cells.append([row.words, flipped, kept, rank, regret])
    return output.markdown(cells)


# --- the figure -----------------------------------------------------------------------------------


def draw(rows: list[tuple[Row, dict[str, Interval]]], toss: float, path: Path) -> Path:
    """Rank correlations and regrets as dots with their intervals, a line for each setting.

    Args:
      rows: The settings with their measures.
      toss: Regret of the toss of a coin, a share of grasps.
      path: The figure's.
    """
    figure = output.new_figure(9, 3.8)
    left, right = figure.subplots(1, 2, sharey=True)
    _dots(left, rows, "rank", 1.0)
    left.set_xlim(0, 1)
    left.set_xlabel("rank correlation of designs")
    _dots(right, rows, "regret", 100.0)
    right.axvline(0, color="0.7", lw=1, zorder=0)
    right.axvline(100 * toss, color="0.4", lw=1, ls="--", zorder=0)
    right.text(100 * toss, len(rows) - 0.4, "toss of a coin ", ha="right", va="bottom", fontsize=8)
    right.set_xlabel("regret, points of success")
    right.set_xlim(-3, 14)
    right.set_xticks(range(-2, 14, 2))
    words = {row.variant: row.words.replace("`", "") for row, _ in rows}
    left.set_yticks(range(len(rows)), [*words.values()], fontsize=9)
    left.set_ylim(len(rows) - 0.4, -0.6)
    kinds = dict.fromkeys(row.kind for row, _ in rows)
    dots = [left.plot([], [], "o", color=COLORS[kind], label=kind)[0] for kind in kinds]
    figure.legend(handles=dots, loc="outside lower right", ncols=4, frameon=False, fontsize=8)
    return output.save_figure(figure, path)


def _dots(axes: Axes, rows: list[tuple[Row, dict[str, Interval]]], name: str, scale: float) -> None:
    """A dot with its interval for each row; the truth has no regret."""
    for y, (row, intervals) in enumerate(rows):
        if name == "regret" and row.variant == TRUTH:
            continue
        middle, low, high = (scale * v for v in intervals[name])
        axes.plot([low, high], [y, y], color=COLORS[row.kind], lw=1.5)
        axes.plot(middle, y, "o", color=COLORS[row.kind], ms=6)


# --- changes --------------------------------------------------------------------------------------


def rank_interval(rank: float, designs: int) -> Interval:
    """Interval of 95 % of Spearman's correlation over designs, by Fisher's transformation.

    Its variance for ranks: D. G. Bonett, T. A. Wright, Sample size requirements for estimating
    Pearson, Kendall and Spearman correlations, Psychometrika 65, 2000.
    """
    # A correlation that is stored as 1.00 may be 0.995.
    inside = np.clip(rank, -0.995, 0.995)
    error = 1.96 * np.sqrt((1 + inside**2 / 2) / (designs - 3))
    low, high = np.tanh(np.arctanh(inside) + np.array([-error, error]))
    return Interval(rank, float(low), float(high))


def draw_changes(content: dict[str, Any], path: Path) -> Path:
    """A bar for each change, shortest first, with the rank correlation of the designs' shares.

    The bars have no intervals: the file has sums, and grasps of one design or of one trial are not
    independent.
    """
    trials = content["designs"] * content["trials"]
    rows = sorted(content["variants"], key=lambda row: -row["gained"] - row["lost"])
    figure = output.new_figure(9, 4.6)
    axes = figure.subplots()
    for y, row in enumerate(rows):
        share = 100 * (row["gained"] + row["lost"]) / trials
        axes.barh(y, share, color=KINDS[row["kind"]][1], alpha=0.85)
        ranks = rank_interval(row["rank"], content["designs"])
        text = f"{share:.0f} %, ranks {ranks.value:.2f} ({ranks.low:.2f} to {ranks.high:.2f})"
        axes.text(share + 0.4, y, text, va="center", fontsize=8)
    axes.set_yticks(range(len(rows)), [row["variant"].replace("`", "") for row in rows], fontsize=8)
    axes.set_xlim(0, 34)
    axes.set_xlabel(f"verdicts that change [%], {content['designs']} designs that keep 30 to 95 %")
    for words, color in KINDS.values():
        axes.bar(0, 0, color=color, label=words)
    axes.legend(frameon=False, fontsize=8, loc="upper right")
    return output.save_figure(figure, path)


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("--pick", action="store_true", help="pick hard designs and stop")
    args = parser.parse_args()
    use_compilation_cache()
    if args.pick:
        print(pick())
        return 0
    print(draw_changes(json.loads(CHANGES.read_text()), CHANGES_FIGURE))
    content = json.loads(DATA.read_text())
    rows = results(content)
    text = table(rows)
    print(text)
    output.fill(DOCS / "accuracy.md", text, "decisions")
    truth = kept_of(content)[TRUTH]
    print(draw(rows, gain(truth, truth), FIGURE))
    return 0


if __name__ == "__main__":
    sys.exit(main())
