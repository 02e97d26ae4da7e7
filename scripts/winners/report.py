"""From the winners' results to a table and a figure."""

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.figure
import numpy as np

from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.report.statistics import Interval, wilson
from codesign_jax.types import failed
from scripts.shared import figures as pictures
from scripts.shared import statistics
from scripts.shared.tables import fill
from scripts.winners import files as winners_files
from scripts.winners import variants as winners
from scripts.winners.files import Arrays, Run
from scripts.winners.variants import STANDARD, VARIANTS, Finals

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
      standard: Successful runs whose best particle succeeds under the standard in the same trials,
        and the share of all final particles that do; None for the standard and other objects.
      p: Paired test of the former against the variant's; None likewise.
      every: Share of all final particles that succeed; None if they were not simulated.
      kept: Share of the best particles' grasps without a loss.
      same: Share of these grasps with the standard's verdict, in the same trials.
      failed: Share of all trials that failed numerically.
    """

    name: str
    trials: int
    best: Interval
    counts: tuple[int, int]
    standard: tuple[int, float] | None
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
    results, _, runs = winners_files.read(data / "winners.npz")
    tables = {}
    for name in dict.fromkeys(k.split("|")[0] for k in winners_files.calls(results)):
        shapes = [
            results[f"{k}|cost"].shape
            for k in winners_files.calls(results)
            if k.startswith(f"{name}|")
        ]
        finals = winners.finals(data, name, *np.max(shapes, axis=0)[:2])
        tables[name] = (finals, rows(results, finals))
    figure(tables, pictures / "winners.png")
    text = "\n\n".join(_markdown(*table) for table in tables.values())
    text += f"\n\n{made_by(results, runs)}"
    if page:
        fill(page, text, MARK)
    return text


def made_by(results: Arrays, runs: list[Run]) -> str:
    """The runs behind the table, with the grasps of each, as a Markdown list."""
    lines = ["Made by", ""]
    for run in runs:
        grasps = sum(results[f"{key}|cost"].size for key in run["calls"])
        commit = f" at commit {str(run['commit'])[:12]}" if run.get("commit") else ""
        device = f", {run['device']}" if run.get("device") else ""
        lines.append(f"* `{run['command']}`{commit}{device}: {grasps:,} grasps")
    return "\n".join(lines)


def rows(results: Arrays, finals: Finals) -> list[Row]:
    """One row a variant of an experiment, in the order of `VARIANTS`, then extra ones."""
    calls = [k.split("|") for k in winners_files.calls(results)]
    there = {variant for name, variant, block in calls if name == finals.name and block == "0"}
    known = [v.name for v in VARIANTS]
    names = [n for n in known if n in there] + sorted(there - set(known))
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
    top = cost[:, 0], status[:, 0]  # the best particle of each run is its first
    won, good, kept = finals.successful, solved(*top), _kept(*top)
    # Other objects have trials of their own.
    other_objects = {v.name for v in VARIANTS if v.objects}
    shared = p = same = None
    if standard and won.any() and name != STANDARD and name not in other_objects:
        n = min(cost.shape[-1], standard[0].shape[-1])
        same_trials = [v[..., :n] for v in standard]
        theirs = solved(*same_trials)
        shared = int(theirs[won, 0].sum()), float(theirs.mean())
        p = statistics.mcnemar(solved(*(v[:, :n] for v in top))[won], theirs[won, 0])
        same = float((kept[:, :n] == _kept(*(v[:, 0] for v in same_trials)))[won].mean())
    by_run = solved(cost, status).mean(1)
    return Row(
        name,
        cost.shape[-1],
        wilson(int(good[won].sum()), max(int(won.sum()), 1)),
        (int(good[won].sum()), int(won.sum())),
        shared,
        p,
        _mean(by_run) if cost.shape[1] > 1 else None,
        _mean(kept[won].mean(1)) if won.any() else NOTHING,
        same,
        float(failed(status).mean()),
    )


def _mean(values: np.ndarray) -> Interval:
    return statistics.bootstrap(lambda i: values[i].mean(-1), len(values))


def _kept(cost: np.ndarray, status: np.ndarray) -> np.ndarray:
    return (cost < SUCCESS_COST) & ~failed(status)


def _percent(value: Interval | None) -> str:
    if value is None or np.isnan(value.value):
        return "–"
    return f"{100 * value.value:.0f} % [{100 * value.low:.0f}, {100 * value.high:.0f}]"


def _markdown(finals: Finals, found: list[Row]) -> str:
    lines = [
        f"{finals.name}: {finals.particles.shape[0]} concurrent runs, of which "
        f"{int(finals.successful.sum())} succeeded",
        "",
        "| simulated again | trials | best particles of successful runs that still succeed "
        "| the standard in these trials | p | their grasps kept | same verdict as the standard "
        "| all final particles that succeed | the standard in these trials | failed trials |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in found:
        cells: list[Any] = [
            r.name,
            r.trials,
            f"{r.counts[0]} of {r.counts[1]}: {_percent(r.best)}",
            "" if r.standard is None else r.standard[0],
            "" if r.p is None else "< 0.001" if r.p < 1e-3 else f"{r.p:.3f}",
            _percent(r.kept),
            "" if r.same is None else f"{100 * r.same:.1f} %",
            _percent(r.every),
            "" if r.standard is None or r.every is None else f"{100 * r.standard[1]:.0f} %",
            f"{100 * r.failed:.2f} %",
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def figure(tables: dict[str, tuple[Finals, list[Row]]], path: Path) -> None:
    """Shares that hold, with intervals: best particles that succeed, and their grasps.

    A black stroke is the standard's share in the variant's trials: more trials are harder to pass.
    """
    picture = matplotlib.figure.Figure((8.4, 3.6), dpi=120, layout="constrained")
    axes = picture.subplots(1, 2, sharey=True)
    names = list(dict.fromkeys(r.name for _, found in tables.values() for r in found))[::-1]
    for k, (name, (finals, found)) in enumerate(tables.items()):
        y = [names.index(r.name) + 0.12 - 0.24 * k for r in found]
        for axis, part in zip(axes, ("best", "kept"), strict=True):
            values = [getattr(r, part) for r in found]
            x = np.array([v.value for v in values])
            ends = np.array([[v.value - v.low, v.high - v.value] for v in values]).T
            label = f"{name}: {int(finals.successful.sum())} runs"
            axis.errorbar(
                x, y, xerr=np.maximum(ends, 0), fmt="o", ms=4, capsize=2,
                color=_COLORS.get(name, "tab:gray"), label=label,
            )  # fmt: skip
        there = [(r.standard[0] / r.counts[1], h) for r, h in zip(found, y, strict=True)
                 if r.standard]  # fmt: skip
        if there:
            axes[0].plot(*zip(*there, strict=True), "|", ms=9, color="black")
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set(xlabel="best particles that still succeed", xlim=(-0.02, 1.02))
    axes[1].set(xlabel="their grasps without a loss", xlim=(-0.02, 1.02))
    axes[1].legend(frameon=False, fontsize=8, loc="center left")
    for axis in axes:
        axis.grid(alpha=0.3, lw=0.4)
    pictures.save(picture, path)
