"""What an accuracy costs in time and loses, on designs that are hard to judge.

python -m scripts.accuracy.decisions     # designs that keep 30 to 95 %, in HARD

`scripts.accuracy` simulates them by all variants, and fills the page.  Three questions: does a
grasp hold, what share of its grasps does a design keep, and which of two designs is better?

A hand is chosen from two by half of the trials at one setting, and valued by the other half at
`reference`, so that no trial is counted on both sides.  The gain of a choice is the kept share of
the chosen hand beyond the mean of the two, in the mean over all pairs; the regret of a setting is
the gain of choosing by `reference` less its gain.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes

from codesign_jax import rollout, scene, use_compilation_cache
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from codesign_jax.statistics import Interval, gain, gains, halves
from codesign_jax.types import failed
from scripts.accuracy import budget
from scripts.accuracy.report import Budget, interval, points
from scripts.shared import output, provenance, work
from scripts.shared.statistics import RESAMPLES, bootstrap, spearman, two_way_means

HARD = Path(__file__).parents[2] / "docs" / "data" / "search" / "hard.npz"
SPREAD = 0.1
"""Standard deviation of a design near a winner, a share of each parameter's range."""
TRIALS = 12
SEED = 11
"""Trials that pick hard designs; no other study draws from this seed."""
LEAST = 0.3
MOST = 0.95
TRUTH = "reference"
"""What the table compares with: the finest preset."""
EXACT = "truth"
"""What the figure compares with, so that it has the finest preset as well."""
MACHINES = {"gpu": "H200", "cpu": "CPU core"}
"""What times are measured on, in words."""


class Row(NamedTuple):
    """A setting: its variant and its words."""

    variant: str
    words: str


PRESETS = ("fast", "standard", "fine", "reference")
CANDIDATES = ("1e-6", "4 rings, 1e-3")
"""Settings of the figure: those that are recommended, and others whose time is known."""
ROWS = (
    *(Row(name, f"`{name}`") for name in PRESETS),
    Row("1e-6", "`standard` with a tolerance of 1e-6"),
    Row("1e-6, moved", "the same, objects moved by a micrometre"),
    Row("4 rings, 1e-3", "`standard` with four rings a link"),
    Row("truth", "step of 2 ms, 20 links, four rings"),
    Row("twice the stiffness", "tolerance of 1e-6, skin of 8 kN/m in place of 4"),
    Row("fingers creep", "the same, no friction memory"),
    Row("101 kPa", "the same, silicone of 101 kPa in place of 88"),
    Row("linear law", "the same, linear bending law"),
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


def ranks(by: np.ndarray, truth: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Spearman's correlation of the shares in one half of the trials and in the other at truth.

    Args:
      by: Kept grasps at the setting that ranks, (design, trial of a half, half).
      truth: At the setting that values.
      rows: Indices of designs, shape (..., design); a correlation for each row.
    """
    chooses = by.mean(1)
    values = truth.mean(1)[:, ::-1]
    return np.mean([spearman(chooses[rows, h], values[rows, h]) for h in (0, 1)], axis=0)


def compared(by: np.ndarray, truth: np.ndarray) -> dict[str, Interval]:
    """Verdicts that flip, kept share, rank correlation and regret, with intervals of 95 %.

    The kept share is that beyond the truth's.  Intervals are over designs and trials.  That of the
    rank correlation is over designs alone: trials that are drawn twice add noise, which lowers a
    correlation.
    """

    more = (by - truth).reshape(len(by), -1)
    kept, flipped = two_way_means(more, np.abs(more), resamples=RESAMPLES)
    regret = regret_of(by, truth)
    correlation = bootstrap(partial(ranks, by, truth), len(by), resamples=RESAMPLES)
    return {"flipped": flipped, "kept": kept, "rank": correlation, "regret": regret}


def regret_of(by: np.ndarray, truth: np.ndarray) -> Interval:
    """Regret with its interval over designs and trials: `two_way`, all resamples at once."""
    rng = np.random.default_rng(0)
    designs, trials, _ = by.shape
    rows = rng.integers(0, designs, (RESAMPLES, designs))
    weights = rng.multinomial(trials, np.full(trials, 1 / trials), RESAMPLES) / trials

    def shares(kept: np.ndarray) -> np.ndarray:
        every = np.einsum("dth,bt->bdh", kept, weights)
        return np.take_along_axis(every, rows[..., None], 1)

    drawn = gains(shares(truth), shares(truth)) - gains(shares(by), shares(truth))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(gain(truth, truth) - gain(by, truth), float(low), float(high))


class Losses(NamedTuple):
    """What settings lose.

    Attributes:
      rows: Settings with their kept share, ranks, flips and regret, see `compared`.
      toss: Regret of the toss of a coin, a share of grasps.
      finer: Flips of `fine` less those of `standard`, in the same trials.
      times: Time of a grasp [ms] by machine and variant; without those that were not timed.
      shown: Flips and regret against `EXACT` of the settings in the figure.
    """

    rows: list[tuple[Row, dict[str, Interval]]]
    toss: float
    finer: Interval
    times: dict[tuple[str, str], float]
    shown: dict[str, dict[str, Interval]]


def losses_of(recommended: Budget, hard: Budget) -> Losses:
    """Measures of hard designs, and times of recommended ones, which hold their objects."""
    kept = {n: halves(costs < SUCCESS_COST) for n, costs in hard.costs.items()}
    rows = [(r, compared(kept[r.variant], kept[TRUTH])) for r in ROWS if r.variant in kept]
    named = ((m, n) for m in MACHINES for n in (*PRESETS, *CANDIDATES))
    times = {(m, n): t for m, n in named if (t := recommended.milliseconds(m, n))}

    fine, standard = (
        np.abs(kept[n] - kept[TRUTH]).reshape(len(kept[n]), -1) for n in ("fine", "standard")
    )
    [finer] = two_way_means(fine - standard, resamples=RESAMPLES)
    timed = [n for n in (*PRESETS, *CANDIDATES) if n in kept]
    shown = {n: compared(kept[n], kept[EXACT]) for n in timed}
    return Losses(rows, gain(kept[TRUTH], kept[TRUTH]), finer, times, shown)


def table(losses: Losses) -> str:
    """The measures of every row, in Markdown, and how `fine` differs from `standard`."""
    head = ["simulated at", *(f"ms a grasp, one {words}" for words in MACHINES.values())]
    head += ["does a grasp hold: verdicts that flip"]
    head += ["what share is kept: points from `reference`"]
    head += ["which of two is better: rank correlation", "regret of a choice, points"]
    cells = [head]
    for row, intervals in losses.rows:
        times = [losses.times.get((machine, row.variant)) for machine in MACHINES]
        shown = [f"{float(f'{t:.2g}'):g}" if t else "–" for t in times]
        flipped, rank = interval(intervals["flipped"]), interval(intervals["rank"], ".2f")
        kept, regret = (points(intervals[name]) for name in ("kept", "regret"))
        if row.variant == TRUTH:
            flipped = kept = regret = "–"
        cells.append([row.words, *shown, flipped, kept, rank, regret])
    toss = f"A toss of a coin has a regret of {100 * losses.toss:.1f} points."
    words = "the share of verdicts that flip changes by"
    finer = f"From `standard` to `fine` {words} {points(losses.finer)} points."
    return f"{output.markdown(cells)}\n\n{toss} {finer}"


# --- the figure -----------------------------------------------------------------------------------

LOOKS = {"gpu": ("tab:blue", "o"), "cpu": ("tab:orange", "s")}
"""Colour and marker of a machine."""


def draw(losses: Losses, recommended: Budget, path: Path) -> Path:
    """Three errors against the time of a grasp, a curve of the presets for each machine.

    Crosses are other settings.  Errors: verdicts that flip against `EXACT`, regret of a choice, and
    the finger tip in the air.
    """
    figure = output.new_figure(12.5, 4.4)
    verdicts, choices, tips = figure.subplots(1, 3)
    flipped, regret = (
        {n: v[name] for n, v in losses.shown.items()} for name in ("flipped", "regret")
    )
    of_tips = {n: Interval(e, e, e) for n, e in recommended.tips.items()}
    _curves(verdicts, losses.times, flipped, 100)
    verdicts.set(title="Does a grasp hold?", ylabel="verdicts that flip [%]", ylim=(0, 25))
    _curves(choices, losses.times, regret, 100)
    choices.axhline(100 * losses.toss, color="0.4", lw=1, ls="--")
    words = "toss of a coin "
    right = choices.get_yaxis_transform()
    choices.text(1, 100 * losses.toss, words, ha="right", va="top", fontsize=8, transform=right)
    words = "regret of a choice [points]"
    choices.set(title="Which of two designs is better?", ylabel=words, ylim=(-3, 13))
    _curves(tips, losses.times, of_tips, 1)
    tips.set(title="Where is the finger tip, in the air?", ylabel="error [mm]", yscale="log")
    tips.set_ylim(0.03, 10)
    tips.yaxis.set_major_formatter(ticker.FuncFormatter(lambda y, _: f"{y:g}"))
    for axes in (verdicts, choices, tips):
        axes.set(xlabel="time of a grasp [ms]", xscale="log")
        axes.xaxis.set_major_formatter(ticker.FuncFormatter(lambda x, _: f"{x:g}"))
        axes.grid(alpha=0.3, lw=0.4)
        axes.margins(x=0.15)
    handles, labels = verdicts.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return output.save_figure(figure, path)


def _curves(
    axes: Axes, times: dict[tuple[str, str], float], errors: dict[str, Interval], scale: float
) -> None:
    """The presets of each machine as a curve with intervals, other settings as crosses."""
    for machine, words in MACHINES.items():
        color, marker = LOOKS[machine]

        def places(names: tuple[str, ...], machine: str = machine) -> list[tuple[str, float]]:
            timed = [n for n in names if n in errors and (machine, n) in times]
            return [(n, times[machine, n]) for n in timed]

        for names, look, label in (
            (PRESETS, {"marker": marker, "ls": "-"}, f"one {words}: presets"),
            (CANDIDATES, {"marker": "x", "ls": "none"}, f"one {words}: other settings"),
        ):
            if not (shown := places(names)):
                continue
            values = scale * np.array([errors[n] for n, _ in shown])
            x = [time for _, time in shown]
            error = [values[:, 0] - values[:, 1], values[:, 2] - values[:, 0]]
            axes.errorbar(
                x, values[:, 0], yerr=error, color=color, label=label, elinewidth=0.8, lw=1,
                capsize=2, **look,
            )  # fmt: skip
            if names is not PRESETS:
                continue
            for (name, time), (_, _, high) in zip(shown, values, strict=True):
                axes.annotate(
                    name, (time, high), xytext=(-2, 3), textcoords="offset points", fontsize=8,
                    rotation=65, color=color,
                )  # fmt: skip


if __name__ == "__main__":
    provenance.parser(__doc__).parse_args()
    use_compilation_cache()
    print(pick())
