"""Charts of a report: what `web/charts.js` draws of numbers, as pieces of a page."""

import html as escaping
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from codesign_jax.codesign import CONVERGED_COST
from codesign_jax.report import bodies, viewer
from codesign_jax.report.landscape import Landscape
from codesign_jax.runs.record import History
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import HARMLESS, Forces, Status

Chart = dict[str, Any]
"""What `web/charts.js` reads, of JSON's types."""

BLUE = "#2f6fab"
ORANGE = "#d9731a"
GREY = "#5a6776"
CAUSES = ("#cf4b3f", "#d9731a", "#8a63b3", "#2f6fab", "#00909e", "#b59f00", "#5a6776")
"""Colours of causes of failure, which repeat."""
CHEAP = np.array([47, 111, 171])
DEAR = np.array([235, 200, 60])
"""Ends of the colours of costs, red, green and blue."""


def html(chart: Chart, name: str) -> str:
    """A chart as a piece of a page that `viewer.page` makes."""
    text = json.dumps(chart).replace("<", "\\u003c")
    place = escaping.escape(name)
    start = f'startChart(document.getElementById("{place}"), {text});'
    return f'<div id="{place}" class="plot"></div>\n<script>{start}</script>'


def grid(charts: Sequence[tuple[str, Chart]], name: str) -> str:
    """Small charts with their titles, side by side."""
    parts = [
        f"<figure><figcaption>{escaping.escape(title)}</figcaption>{html(chart, f'{name}-{k}')}"
        "</figure>"
        for k, (title, chart) in enumerate(charts)
    ]
    return f"<div class='charts'>{''.join(parts)}</div>"


def cost_evolution(cost: ArrayLike) -> Chart:
    """The evolution of the cost as Fig. 6 of the paper.

    Dots are the costs of the particles, the line is their mean.

    Args:
      cost: Particle costs, shape (episode, particle).
    """
    cost = np.asarray(cost, float)
    episode = np.arange(1, len(cost) + 1)
    dots = _layer("dots", "particles", BLUE, np.repeat(episode, cost.shape[1]), cost.ravel())
    mean = _layer("line", "mean of the particles", ORANGE, episode, cost.mean(1))
    level = {"y": CONVERGED_COST, "text": "threshold of convergence", "color": "#1d2733"}
    return {
        "x": _episodes(len(cost)),
        "y": _axis("cost", np.append(cost, [0, 1.2 * CONVERGED_COST])),
        "layers": [dots | {"opacity": 0.4}, mean],
        "lines": [level],
        "height": 280,
    }


def parameters(history: History, space: DesignSpace, chosen: np.ndarray) -> list[tuple[str, Chart]]:
    """Distribution of every parameter over the episodes, with its name: range, quartiles, median.

    Args:
      chosen: The chosen design [SI units], shape (parameter,), drawn as a line.
    """
    values, low, high, shown = (
        space.in_units(np.array(v)) for v in (history.population, space.low, space.high, chosen)
    )
    episode = np.arange(1, len(values) + 1)
    charts = []
    for k, (name, unit) in enumerate(zip(space.names, space.units, strict=True)):
        layers = []
        for ends, opacity, of in (((0, 100), 0.15, "all"), ((25, 75), 0.3, "middle half")):
            bottom, top = np.percentile(values[..., k], ends, axis=1)
            layers.append(_layer("band", of, BLUE, episode, bottom))
            layers[-1] |= {"high": _numbers(top), "opacity": opacity}
        layers.append(_layer("line", "median", BLUE, episode, np.median(values[..., k], 1)))
        ends = [episode[0], episode[-1]]
        line = _layer("line", "chosen design", ORANGE, ends, [shown[k], shown[k]])
        layers.append(line | {"dash": "3 3"})
        y = {"low": float(low[k]), "high": float(high[k])}
        x = _episodes(len(values)) | {"label": ""}
        chart = {"x": x, "y": y, "layers": layers, "height": 130, "legend": False}
        charts.append((f"{name} [{unit}]", chart))
    return charts


def landscape(surface: Landscape) -> Chart:
    """The mean cost over a grid of two parameters as Fig. 8 of the paper: white where low."""
    x, y = (f"{n} [{u}]" for n, u in zip(surface.names, surface.units, strict=True))
    cells = {
        "kind": "cells",
        "name": f"mean cost of {int(surface.trials)} trials",
        "color": ["#000"],
        "x": _numbers(surface.first),
        "y": _numbers(surface.second),
        "values": [_numbers(row) for row in surface.cost],
        "most": float(max(surface.cost.max(), 1e-9)),
    }
    axes = {"x": _axis(x, surface.first, cells=True), "y": _axis(y, surface.second, cells=True)}
    return {**axes, "layers": [cells], "height": 340}


def designs(
    history: History, space: DesignSpace, chosen: np.ndarray, surface: Landscape | None
) -> Chart:
    """All particles of a run with two parameters, over the landscape where there is one.

    Args:
      chosen: The chosen design [SI units], shape (2,).
    """
    x, y = space.in_units(history.population.reshape(-1, 2)).T
    cost = history.cost.ravel()
    names = [f"{n} [{u}]" for n, u in zip(space.names, space.units, strict=True)]
    share = np.clip(cost / max(cost.max(), 1e-9), 0, 1)[:, None]
    colors = [_css(color) for color in (1 - share) * CHEAP + share * DEAR]
    dots = _layer("dots", "particles", BLUE, x, y) | {"color": colors, "radius": 4, "edge": "#fff"}
    dots["title"] = [f"cost {c:.2f}: {a:.4g}, {b:.4g}" for a, b, c in zip(x, y, cost, strict=True)]
    star = _layer("dots", "chosen design", ORANGE, *space.in_units(chosen)[:, None])
    star |= {"radius": 7, "edge": "#1d2733"}
    star["title"] = ["the chosen design"]
    low, high = space.in_units(space.low), space.in_units(space.high)
    axes = [
        {"label": name, "low": float(a), "high": float(b)}
        for name, a, b in zip(names, low, high, strict=True)
    ]
    ground = [] if surface is None else landscape(surface)["layers"]
    return {"x": axes[0], "y": axes[1], "layers": [*ground, dots, star], "height": 340}


def grip(forces: Forces, scene: Scene) -> Chart:
    """Normal force of each finger on the object, and the palm's force, over time.

    Args:
      forces: Forces of a grasp, arrays of shape (time, ...).
    """
    every = max(1, round(0.02 / scene.discretization.timestep))
    grips = np.asarray(forces.grip)[::every]
    time = every * scene.discretization.timestep * np.arange(len(grips))
    layers = [
        _layer("line", f"finger {f}", bodies.finger_color(f), time, grips[:, f])
        for f in range(grips.shape[1])
    ]
    palm = np.linalg.norm(np.asarray(forces.palm)[::every], axis=1)
    layers.append(_layer("line", "palm", GREY, time, palm))
    return {
        "x": {"label": "time [s]", "low": 0.0, "high": float(time[-1])},
        "y": _axis("force [N]", np.array([0.0, 0.1, grips.max(), palm.max()])),
        "layers": layers,
        "marks": [[name, end] for name, end in viewer.phases(scene)],
        "height": 260,
    }


def failures(status: np.ndarray) -> Chart:
    """Frequency of each cause of failure in each episode.

    Args:
      status: Bits of `Status`, shape (episode, particle, trial).
    """
    episode = np.arange(1, len(status) + 1)
    below = np.zeros(len(status))
    layers = []
    for bit in (b for b in Status if b and b not in HARMLESS):
        count = ((status & bit) != 0).sum((1, 2))
        if count.any():
            color = CAUSES[len(layers) % len(CAUSES)]
            bars = _layer("bars", str(bit.name), color, episode, count)
            layers.append(bars | {"below": _numbers(below)})
            below = below + count
    y = _axis("trials", np.append(below, 0)) | {"whole": True}
    return {"x": _episodes(len(status)), "y": y, "layers": layers, "height": 220}


def _layer(kind: str, name: str, color: str, x: ArrayLike, y: ArrayLike) -> Chart:
    return {"kind": kind, "name": name, "color": color, "x": _numbers(x), "y": _numbers(y)}


def _numbers(values: ArrayLike) -> list[float]:
    """Numbers with four digits, more than a chart shows."""
    return [float(f"{v:.4g}") for v in np.asarray(values, float)]


def _axis(label: str, values: np.ndarray, *, cells: bool = False) -> Chart:
    """An axis that spans values, with some room above them; of cells up to their edges."""
    low, high = float(np.min(values)), float(np.max(values))
    room = 0.04 * (high - low)
    if cells:
        room = (high - low) / max(2 * (len(values) - 1), 1)
    return {"label": label, "low": low - room * cells, "high": (high + room) or 1.0}


def _episodes(count: int) -> Chart:
    return {"label": "episode", "low": 0.5, "high": count + 0.5, "whole": True}


def _css(color: np.ndarray) -> str:
    return "#" + "".join(f"{round(v):02x}" for v in color)
