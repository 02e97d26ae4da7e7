"""From the winners' results to a table and a figure."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.figure
import numpy as np

from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.experiments import statistics, winners
from codesign_jax.experiments.record import Arrays
from codesign_jax.experiments.report import fill
from codesign_jax.experiments.statistics import Interval
from codesign_jax.experiments.winners import STANDARD, VARIANTS, Finals
from codesign_jax.types import failed

MARK = "winners"
"""Name of the marks in the page."""

NOTHING = Interval(np.nan, np.nan, np.nan)
"""Where no run succeeded."""

_COLORS = {"23d": "tab:blue", "2d": "tab:orange"}


class Row(NamedTuple):
    """An experiment's particles under a variant.

    Attributes:
      name: Variant.
      trials: Trials of a particle.
      best: Share of the successful runs whose best particle still succeeds, and its counts.
      counts: Best particles that succeed, and successful runs.
      p: Paired test of these against the standard in the same trials; None for itself.
      every: Share of all final particles that succeed; None if they were not simulated.
      kept: Share of the best particles' grasps without a loss.
      same: Share of these grasps with the standard's verdict, in the same trials.
      failed: Share of all trials that failed numerically.
    """

    name: str
    trials: int
    best: Interval
    counts: tuple[int, int]
    p: float | None
    every: Interval | None
    kept: Interval
    same: float | None
    failed: float


def make(data: Path, pictures: Path, page: Path | None) -> str:
    """Writes table and figure of whatever was simulated.

    Args:
      data: Folder with winners.npz, 2d.npz and 23d.npz.
      pictures: Folder of the figure.
      page: Markdown page whose text between the marks is replaced; None for none.

    Returns:
      The table in Markdown.
    """
    with np.load(data / "winners.npz", allow_pickle=False) as file:
        results = {k: file[k] for k in file.files}
    tables = {}
    for name in dict.fromkeys(k.split("|")[0] for k in results if "|" in k):
        shapes = [results[k].shape for k in results if k.startswith(name) and k.endswith("cost")]
        finals = winners.finals(data, name, *np.max(shapes, axis=0)[:2])
        tables[name] = (finals, rows(results, finals))
    figure(tables, pictures / "winners.png")
    text = "\n\n".join(_markdown(*table) for table in tables.values())
    notes = json.loads((data / "winners.json").read_text())
    text += f"\n\nMade by `{notes['command']}` at commit {str(notes['commit'])[:12]}, "
    text += f"{notes['device']}; {sum(v.size for k, v in results.items() if k.endswith('cost')):,} "
    text += "grasps."
    if page:
        fill(page, text, MARK)
    return text


def rows(results: Arrays, finals: Finals) -> list[Row]:
    """One row a variant of an experiment, the standard first."""
    names = dict.fromkeys(k.split("|")[1] for k in results if k.startswith(f"{finals.name}|"))
    standard = winners.gather(results, finals.name, STANDARD)
    found = []
    for name in names:
        cost, status = winners.gather(results, finals.name, name)  # type: ignore[misc]
        found.append(_row(name, finals, cost, status, standard))
    return found


def solved(cost: np.ndarray, status: np.ndarray) -> np.ndarray:
    """Whether particles solve the task: mean cost of the trials that did not fail below 0.01."""
    good = ~failed(status)
    mean = np.where(good, cost, 0).sum(-1) / np.maximum(good.sum(-1), 1)
    return good.any(-1) & (mean < SUCCESS_COST)


def _row(
    name: str,
    finals: Finals,
    cost: np.ndarray,
    status: np.ndarray,
    standard: tuple[np.ndarray, np.ndarray] | None,
) -> Row:
    runs, particles, trials = cost.shape
    top = cost[:, 0], status[:, 0]  # the best particle of each run is its first
    won = finals.successful
    good = solved(*top)
    kept = (top[0] < SUCCESS_COST) & ~failed(top[1])
    p = same = None
    shared = None if standard is None else standard[0].shape[-1]
    # Other objects have trials of their own.
    other_objects = {v.name for v in VARIANTS if v.objects}
    if shared and standard and won.any() and name != STANDARD and name not in other_objects:
        n = min(trials, shared)
        other = [v[:, 0, :n] for v in standard]
        mine = [v[:, :n] for v in top]
        p = statistics.mcnemar(solved(*mine)[won], solved(*other)[won])
        theirs = (other[0] < SUCCESS_COST) & ~failed(other[1])
        same = float((kept[:, :n] == theirs)[won].mean())
    by_run = solved(cost, status).mean(1)
    return Row(
        name,
        trials,
        statistics.wilson(int(good[won].sum()), max(int(won.sum()), 1)),
        (int(good[won].sum()), int(won.sum())),
        p,
        statistics.bootstrap(by_run, lambda v: v.mean(-1)) if particles > 1 else None,
        statistics.bootstrap(kept[won].mean(1), lambda v: v.mean(-1)) if won.any() else NOTHING,
        same,
        float(failed(status).mean()),
    )


def _percent(value: Interval | None) -> str:
    if value is None or np.isnan(value.value):
        return "–"
    return f"{100 * value.value:.0f} % [{100 * value.low:.0f}, {100 * value.high:.0f}]"


def _markdown(finals: Finals, found: list[Row]) -> str:
    lines = [
        f"{finals.name}: {finals.particles.shape[0]} concurrent runs, of which "
        f"{int(finals.successful.sum())} succeeded",
        "",
        "| simulated again | trials | best particles of successful runs that still succeed | p "
        "| their grasps kept | same verdict as the standard | all final particles that succeed "
        "| failed trials |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in found:
        cells: list[Any] = [
            r.name,
            r.trials,
            f"{r.counts[0]} of {r.counts[1]}: {_percent(r.best)}",
            "" if r.p is None else "< 0.001" if r.p < 1e-3 else f"{r.p:.3f}",
            _percent(r.kept),
            "" if r.same is None else f"{100 * r.same:.1f} %",
            _percent(r.every),
            f"{100 * r.failed:.2f} %",
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def figure(tables: dict[str, tuple[Finals, list[Row]]], path: Path) -> None:
    """Shares that hold, with intervals: best particles' grasps, and best particles that succeed."""
    picture = matplotlib.figure.Figure((8.4, 3.6), dpi=120, layout="constrained")
    axes = picture.subplots(1, 2, sharey=True)
    names = list(dict.fromkeys(r.name for _, found in tables.values() for r in found))[::-1]
    for k, (name, (finals, found)) in enumerate(tables.items()):
        for axis, part in zip(axes, ("best", "kept"), strict=True):
            values = [getattr(r, part) for r in found]
            y = [names.index(r.name) + 0.12 - 0.24 * k for r in found]
            x = np.array([v.value for v in values])
            ends = np.array([[v.value - v.low, v.high - v.value] for v in values]).T
            label = f"{name}: {int(finals.successful.sum())} runs"
            axis.errorbar(
                x, y, xerr=np.maximum(ends, 0), fmt="o", ms=4, capsize=2,
                color=_COLORS.get(name, "tab:gray"), label=label,
            )  # fmt: skip
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set(xlabel="best particles that still succeed", xlim=(-0.02, 1.02))
    axes[1].set(xlabel="their grasps without a loss", xlim=(-0.02, 1.02))
    axes[0].legend(frameon=False, fontsize=8)
    for axis in axes:
        axis.grid(alpha=0.3, lw=0.4)
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(path)
