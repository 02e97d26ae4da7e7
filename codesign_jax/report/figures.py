"""Figures of a run as files (matplotlib); a report has those of `charts`."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

import matplotlib
import matplotlib.figure
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from codesign_jax import files
from codesign_jax.codesign import CONVERGED_COST, SUCCESS_COST
from codesign_jax.report.landscape import Landscape

_BLUE = "tab:blue"
_ORANGE = "tab:orange"

P = ParamSpec("P")
R = TypeVar("R")


def default_style(draw: Callable[P, R]) -> Callable[P, R]:
    """Has a function draw by matplotlib's own settings, whatever the user's are.

    A matplotlibrc of another machine may ask for LaTeX (`text.usetex`) or fonts that are not here.
    """

    @functools.wraps(draw)
    def drawn(*arguments: P.args, **options: P.kwargs) -> R:
        with matplotlib.rc_context():
            matplotlib.rcdefaults()
            return draw(*arguments, **options)

    return drawn


@default_style
def save(figure: matplotlib.figure.Figure, path: Path) -> Path:
    """Writes a figure as a whole or not at all."""
    path.parent.mkdir(exist_ok=True)
    with files.atomically(path) as part:  # whose name does not say the kind of picture
        figure.savefig(part, format=path.suffix.lstrip(".") or "png")
    return path


def _figure(width: float, height: float) -> matplotlib.figure.Figure:
    # A figure of its own instead of pyplot's: no state and no display is touched.
    return matplotlib.figure.Figure(figsize=(width, height), dpi=120, layout="constrained")


def _above(axes: Axes, columns: int = 3) -> None:
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, frameon=False)


@default_style
def cost_evolution(
    cost: ArrayLike, *, threshold: float = CONVERGED_COST, title: str = ""
) -> matplotlib.figure.Figure:
    """The evolution of the cost as Fig. 6 of the paper.

    Dots are the costs of the particles, the line is their mean, and the dashed line is the
    threshold that defines convergence.

    Args:
      cost: Particle costs, shape (episode, particle).
    """
    cost = np.asarray(cost)
    episode = np.arange(1, len(cost) + 1)
    figure = _figure(6.4, 3.6)
    axes = figure.add_subplot()
    dots = {"color": _BLUE, "alpha": 0.4, "ms": 5, "rasterized": True}  # of thousands
    axes.plot(np.repeat(episode, cost.shape[1]), cost.ravel(), ".", **dots)
    axes.plot([], [], ".", color=_BLUE, label="particle")
    axes.plot(episode, cost.mean(1), color=_ORANGE, lw=2, label="mean of the particles")
    axes.axhline(threshold, color="black", lw=1, ls="--", label="convergence threshold")
    axes.set(xlabel="episode", ylabel="cost", xlim=(0, len(cost) + 1))
    axes.set_title(title, pad=28)  # above the legend
    axes.set_ylim(bottom=-0.05)
    axes.locator_params(axis="x", integer=True)
    _above(axes)
    return figure


@default_style
def landscape(surface: Landscape) -> matplotlib.figure.Figure:
    """The mean cost over a grid of two parameters as Fig. 8 of the paper: white where low.

    Lines enclose where the mean cost is below the thresholds of convergence and of success.
    """
    figure = _figure(5.6, 4.4)
    axes = figure.add_subplot()
    _landscape(axes, surface)
    lines = ((CONVERGED_COST, _ORANGE, "--"), (SUCCESS_COST, "tab:red", "-"))
    x = surface.first
    y = surface.second
    cost = surface.cost.T
    for level, color, style in lines:
        if cost.min() < level <= cost.max():
            axes.contour(x, y, cost, [level], colors=color, linestyles=style, linewidths=1.2)
            axes.plot([], [], color=color, ls=style, lw=1.2, label=f"below {level:g}")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="upper left", fontsize=8)
    labels = [f"{n} [{u}]" for n, u in zip(surface.names, surface.units, strict=True)]
    axes.set(xlabel=labels[0], ylabel=labels[1])
    return figure


def _landscape(axes: Axes, surface: Landscape) -> None:
    grid = surface.first, surface.second, surface.cost.T
    image = axes.pcolormesh(*grid, cmap="gray_r", shading="nearest", vmin=0, rasterized=True)
    label = f"mean cost of {int(surface.trials)} trials"
    axes.figure.colorbar(image, ax=axes, label=label)
