"""Figures of a run (matplotlib)."""

from pathlib import Path

import matplotlib.figure
import numpy as np
from numpy.typing import ArrayLike

from codesign_jax import files
from codesign_jax.codesign import CONVERGED_COST, SUCCESS_COST
from codesign_jax.report.landscape import Landscape


def cost_evolution(
    cost: ArrayLike, path: Path, *, threshold: float = CONVERGED_COST, title: str = ""
) -> Path:
    """Draws the evolution of the cost as Fig. 6 of the paper.

    Dots are the costs of the particles, the line is their mean, and the dashed line is the
    threshold that defines convergence.

    Args:
      cost: Particle costs, shape (episode, particle).
    """
    cost = np.asarray(cost)
    episode = np.arange(1, len(cost) + 1)
    # A figure of its own instead of pyplot's: no state and no display is touched.
    figure = matplotlib.figure.Figure(figsize=(6.4, 3.6), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.plot(
        np.repeat(episode, cost.shape[1]), cost.ravel(), ".", color="tab:blue", alpha=0.4, ms=5
    )
    axes.plot([], [], ".", color="tab:blue", label="particle")
    axes.plot(episode, cost.mean(1), color="tab:orange", lw=2, label="mean of the particles")
    axes.axhline(threshold, color="black", lw=1, ls="--", label="convergence threshold")
    axes.set(xlabel="episode", ylabel="cost", title=title, xlim=(0, len(cost) + 1))
    axes.set_ylim(bottom=-0.05)
    axes.locator_params(axis="x", integer=True)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    return _save(figure, path)


def landscape(found: Landscape, path: Path) -> Path:
    """Draws the mean cost over a grid of two parameters as Fig. 8 of the paper: white where low.

    Lines enclose where the mean cost is below the thresholds of convergence and of success.
    """
    figure = matplotlib.figure.Figure(figsize=(5.6, 4.4), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    x, y, cost = found.first, found.second, found.cost.T
    image = axes.pcolormesh(x, y, cost, cmap="gray_r", shading="nearest", vmin=0)
    figure.colorbar(image, label=f"mean cost of {int(found.trials)} trials")
    lines = ((CONVERGED_COST, "tab:orange", "--"), (SUCCESS_COST, "tab:red", "-"))
    for level, color, style in lines:
        if cost.min() < level <= cost.max():
            axes.contour(x, y, cost, [level], colors=color, linestyles=style, linewidths=1.2)
            axes.plot([], [], color=color, ls=style, lw=1.2, label=f"below {level:g}")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="upper left", fontsize=8)
    labels = [f"{n} [{u}]" for n, u in zip(found.names, found.units, strict=True)]
    axes.set(xlabel=labels[0], ylabel=labels[1])
    return _save(figure, path)


def _save(figure: matplotlib.figure.Figure, path: Path) -> Path:
    with files.atomically(path) as part:  # whose name does not say the kind of picture
        figure.savefig(part, format=path.suffix.lstrip(".") or "png")
    return path
