"""Figures 6 to 9 of the paper from committed results."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh

from codesign_jax.report import figures
from codesign_jax.statistics import wilson
from scripts.experiments.results import LANDSCAPE_THRESHOLD, RULES, Study, regions
from scripts.shared import output, statistics

LABELS = {"single": "s.d.", "concurrent": "conc."}
_COLORS = {"exclude": "tab:blue", "worst": "tab:orange"}
_RULE_LABELS = {"exclude": "failed trials excluded", "worst": "failed trials cost the maximum"}

COST_MAXIMUM = 3.0
"""Cost of a grasp that never holds the object (Sec. IV.3): the dark end of the landscape."""


def label(strategy: str) -> str:
    """The paper's name of a strategy: s.d., the number of switches, or conc."""
    return LABELS.get(strategy, strategy.removeprefix("switch-"))


def typical_run(study: Study) -> int:
    """Run of the last strategy whose convergence is the median one."""
    episodes = study.convergence()[-1]
    return int(np.argsort(episodes, kind="stable")[(len(episodes) - 1) // 2])


def draw_evolution(study: Study, path: Path) -> Path:
    """Draws Fig. 6: the particle costs of the run that converges at the median speed."""
    run = typical_run(study)
    title = f"{study.strategies[-1]}, run {run} of {study.plan['runs']}"
    costs = study.data["particle_cost"][run].astype(float)
    path.parent.mkdir(parents=True, exist_ok=True)
    return figures.save(figures.cost_evolution(costs, title=title), path)


def draw_success(study: Study, path: Path) -> Path:
    """Draws Figs. 7a and 9a: the ratio of successful runs with Wilson's 95 % intervals."""
    figure, axes = _axes()
    for offset, rule in zip((-0.18, 0.18), RULES, strict=True):
        rates = [wilson(int(s.sum()), s.size) for s in study.success(rule)]
        value, low, high = np.array(rates).T
        at = np.arange(len(rates)) + offset
        axes.bar(at, value, 0.36, color=_COLORS[rule], alpha=0.75, label=_RULE_LABELS[rule])
        axes.errorbar(at, value, [value - low, high - value], fmt="none", color="black", capsize=3)
    axes.set(ylabel="ratio of successful runs", ylim=(0, 1.2), yticks=np.linspace(0, 1, 6))
    _strategies(axes, study)
    axes.legend(frameon=False, fontsize=8, loc="upper center", ncols=2)  # above the bars
    return output.save_figure(figure, path)


def draw_convergence(study: Study, path: Path) -> Path:
    """Draws Figs. 7b and 9b: median episodes to convergence, with the quartiles.

    Runs that did not converge take part as slower than all others; above the upper line is where
    they are.  Hollow dots are medians of the converged runs alone, whose number
    stands under the strategy.
    """
    figure, axes = _axes()
    episodes = study.convergence()
    limit = study.plan["episodes"]
    never = 1.08 * limit
    low, middle, high = (
        np.minimum(statistics.quantile(episodes, q), never) for q in (0.25, 0.5, 0.75)
    )
    at = np.arange(len(episodes))
    axes.errorbar(at, middle, [middle - low, high - middle], fmt="o", capsize=4, label="all runs")
    converged = np.isfinite(episodes)
    alone = [
        np.median(e[c]) if c.any() else np.nan for e, c in zip(episodes, converged, strict=True)
    ]
    axes.plot(at, alone, "o", mfc="none", color="tab:orange", ms=9, label="converged runs alone")
    axes.axhline(limit, color="black", lw=1, ls="--")
    axes.text(len(at) - 0.55, limit, "not converged", ha="right", va="bottom", fontsize=8)
    axes.set(ylabel="episodes until converged", ylim=(0, 1.15 * limit), xlim=(-0.5, len(at) - 0.5))
    _strategies(axes, study, [f"{n}/{episodes.shape[1]}" for n in converged.sum(1)])
    axes.legend(frameon=False, fontsize=8, loc="best")
    return output.save_figure(figure, path)


def draw_landscapes(grids: dict[str, dict[str, np.ndarray]], path: Path) -> Path:
    """Draws Fig. 8 by each law side by side: white where the cost is low, regions in lines."""
    figure = output.new_figure(5.0 * len(grids) + 0.4, 4.4)
    panels = figure.subplots(1, len(grids), squeeze=False)[0]
    for axes, (law, data) in zip(panels, grids.items(), strict=True):
        image = _landscape(axes, data)
        axes.set_title(f"law of the section: {law}", fontsize=10)
    figure.colorbar(image, ax=panels, label="mean cost")
    return output.save_figure(figure, path)


def _landscape(axes: Axes, data: dict[str, np.ndarray]) -> QuadMesh:
    x = data["first_axis"]
    y = data["second_axis"]
    most = float(data["exclude"].max())
    look = {"cmap": "gray_r", "shading": "nearest", "vmin": 0, "vmax": max(most, COST_MAXIMUM)}
    image = axes.pcolormesh(x, y, data["exclude"].T, **look)
    for letter, region in zip("abcdefgh", regions(data, LANDSCAPE_THRESHOLD), strict=False):
        if not region.points.all():
            axes.contour(x, y, region.points.T.astype(float), [0.5], colors="tab:red", linewidths=1)
        # Inside the region, also where its mean lies outside.
        inside = np.argwhere(region.points)
        axis = np.stack([x[inside[:, 0]], y[inside[:, 1]]], -1)
        scale = np.array([np.ptp(x), np.ptp(y)])
        nearest = axis[np.argmin((((axis - region.centre) / scale) ** 2).sum(1))]
        axes.text(nearest[0], nearest[1], f"({letter})", color="tab:red", ha="center", va="center")
    names = data["parameters"]
    units = data["units"]
    axes.set(xlabel=f"{names[0]} [{units[0]}]", ylabel=f"{names[1]} [{units[1]}]")
    return image


def _axes(width: float = 6.0, height: float = 3.4):
    figure = output.new_figure(width, height)
    return figure, figure.add_subplot()


def _strategies(axes, study: Study, below: list[str] | None = None) -> None:
    labels = [label(s) for s in study.strategies]
    if below:
        labels = [f"{name}\n{text}" for name, text in zip(labels, below, strict=True)]
    axes.set_xticks(range(len(labels)), labels)
    axes.set_xlabel("strategy (s.d.: single domain; number of switches; conc.: concurrent)")
