"""Figures of a run (matplotlib), as files and as pictures of its report."""

import base64
import functools
import io
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
from codesign_jax.report.markup import text
from codesign_jax.runs.record import History
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import HARMLESS, Forces, Status

_BLUE = "tab:blue"
_ORANGE = "tab:orange"
_COLUMNS = 3  # of the grid of parameters

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


@default_style
def html(figure: matplotlib.figure.Figure, name: str) -> str:
    """A figure as a piece of a page that needs no other file."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none"}):  # the browser's letters
        figure.savefig(buffer, format="svg")
    data = base64.b64encode(buffer.getvalue()).decode()
    source = f"data:image/svg+xml;base64,{data}"
    return f"<img class='figure' id='{name}' alt='{text(name)}' src='{source}'>"


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
    axes.set(xlabel="episode", ylabel="cost", title=title, xlim=(0, len(cost) + 1))
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


@default_style
def designs(
    history: History, space: DesignSpace, chosen: np.ndarray, surface: Landscape | None
) -> matplotlib.figure.Figure:
    """All particles of a run with two parameters, over the landscape where there is one.

    Args:
      chosen: The chosen design [SI units], shape (2,).
    """
    figure = _figure(6.4, 4.4)
    axes = figure.add_subplot()
    if surface is not None:
        _landscape(axes, surface)
    x, y = space.in_units(history.population.reshape(-1, 2)).T
    dots = {"s": 14, "edgecolors": "white", "linewidths": 0.4, "vmin": 0, "rasterized": True}
    scatter = axes.scatter(x, y, c=history.cost.ravel(), label="particle", **dots)
    figure.colorbar(scatter, ax=axes, label="cost")
    star = {"marker": "*", "s": 200, "color": _ORANGE, "edgecolors": "black", "linewidths": 0.8}
    axes.scatter(*space.in_units(chosen)[:, None], label="chosen design", **star)
    labels = [f"{n} [{u}]" for n, u in zip(space.names, space.units, strict=True)]
    axes.set(xlabel=labels[0], ylabel=labels[1])
    _above(axes)
    return figure


@default_style
def parameters(
    history: History, space: DesignSpace, chosen: np.ndarray
) -> matplotlib.figure.Figure:
    """Distribution of every parameter over the episodes: range, quartiles and median.

    Args:
      chosen: The chosen design [SI units], shape (parameter,), drawn as a line.
    """
    columns = min(_COLUMNS, space.num_parameters)
    rows = -(-space.num_parameters // columns)
    figure = _figure(9.6, 0.6 + 1.9 * rows)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    values, low, high, shown = (
        space.in_units(np.array(v)) for v in (history.population, space.low, space.high, chosen)
    )
    episode = np.arange(1, len(values) + 1)
    for k, axes in enumerate(grid[: space.num_parameters]):
        for ends, shade, name in (((0, 100), 0.15, "range"), ((25, 75), 0.3, "quartiles")):
            between = np.percentile(values[..., k], ends, axis=1)
            axes.fill_between(episode, *between, color=_BLUE, alpha=shade, lw=0, label=name)
        axes.plot(episode, np.median(values[..., k], 1), color=_BLUE, label="median")
        axes.axhline(shown[k], color=_ORANGE, lw=1.2, ls=":", label="chosen design")
        axes.set(ylim=(low[k], high[k]), title=f"{space.names[k]} [{space.units[k]}]")
        axes.locator_params(axis="x", integer=True)
    for axes in grid[space.num_parameters :]:
        axes.set_visible(False)
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=4, frameon=False)
    return figure


@default_style
def grip(forces: Forces, scene: Scene) -> matplotlib.figure.Figure:
    """Normal force of each finger on the object, and the palm's force, over time.

    Args:
      forces: Forces of a grasp, arrays of shape (time, ...).
    """
    figure = _figure(7.6, 3.0)
    axes = figure.add_subplot()
    time = scene.discretization.timestep * np.arange(len(forces.grip))
    series = {f"finger {i}": forces.grip[:, i] for i in range(forces.grip.shape[1])}
    series["palm"] = np.linalg.norm(forces.palm, axis=1)
    for name, force in series.items():
        axes.plot(time, force, lw=1.2, label=name)
    for name, end in scene.phase_ends.items():
        axes.axvline(end, color="0.5", lw=0.8, ls=":")
        style = {"rotation": 90, "ha": "right", "va": "top", "fontsize": 7, "color": "0.4"}
        axes.text(end, 1.0, f"{name} ", transform=axes.get_xaxis_transform(), **style)
    axes.set(xlabel="time [s]", ylabel="force [N]")
    _above(axes, len(series))
    return figure


@default_style
def failures(status: np.ndarray) -> matplotlib.figure.Figure:
    """Frequency of each cause of failure in each episode.

    Args:
      status: Bits of `Status`, shape (episode, particle, trial).
    """
    figure = _figure(6.4, 2.8)
    axes = figure.add_subplot()
    episode = np.arange(1, len(status) + 1)
    below = np.zeros(len(status))
    for bit in (b for b in Status if b and b not in HARMLESS):
        count = ((status & bit) != 0).sum((1, 2))
        if count.any():
            axes.bar(episode, count, bottom=below, label=bit.name)
            below = below + count
    axes.set(xlabel="episode", ylabel="trials")
    axes.locator_params(axis="x", integer=True)
    _above(axes)
    return figure
