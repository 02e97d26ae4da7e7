"""Figures of scored waves (matplotlib)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from scripts.calibration import score
from scripts.calibration.files import Scored
from scripts.shared import figures as pictures
from scripts.shared import sets

COLUMNS = 5
LANDSCAPES = 8
BINS = 6
"""Parts of a constant's range."""


def constants(wave: Scored, path: Path) -> Path:
    """Draws which share of the sets is left in each part of every constant's range."""
    rows = -(-len(sets.OPEN) // COLUMNS)
    figure = pictures.new(2.3 * COLUMNS, 1.9 * rows)
    left, values = wave.plausible, sets.values(wave.data["units"])
    axes = None
    for i, o in enumerate(sets.OPEN):
        axes = figure.add_subplot(rows, COLUMNS, i + 1, sharey=axes)
        space = np.geomspace if o.log else np.linspace
        edges = space(o.low, o.high, BINS + 1)
        tried, found = (np.histogram(v, edges)[0] for v in (values[o.name], values[o.name][left]))
        share = found / np.maximum(tried, 1)
        # One more of either kind, so that a bin without a set that is left has an error too.
        known = (found + 1) / (tried + 2)
        error = np.sqrt(known * (1 - known) / np.maximum(tried, 1))
        axes.stairs(100 * share, edges, fill=True, color="tab:blue", alpha=0.6)
        middle = np.sqrt(edges[1:] * edges[:-1]) if o.log else (edges[1:] + edges[:-1]) / 2
        axes.errorbar(middle, 100 * share, 100 * error, fmt="none", ecolor="black", lw=0.9)
        axes.axhline(100 * left.mean(), color="black", lw=0.8, ls="--")
        axes.set(xscale="log" if o.log else "linear", ylim=(0, None))
        axes.set_title(f"{o.label} [{o.unit}]" if o.unit else o.label, fontsize=9)
        axes.tick_params(labelsize=8, labelleft=i % COLUMNS == 0)
        if o.log:
            ticks = np.geomspace(o.low, o.high, 4)
            axes.set_xticks(ticks, [f"{t:.2g}" if t < 100 else f"{t:.0f}" for t in ticks])
            axes.minorticks_off()
    figure.supylabel("sets left [%]", fontsize=10)
    return pictures.save(figure, path, dpi=110)


def correlations(found: np.ndarray, measures: Mapping[str, str], path: Path) -> Path:
    """Draws rank correlations of constants and measures, shape (constant, measure)."""
    figure = pictures.new(6.5, 6.5)
    axes = figure.add_subplot()
    image = axes.imshow(found, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    for (i, j), value in np.ndenumerate(found):
        if abs(value) >= 0.2:
            color = "white" if abs(value) > 0.6 else "black"
            axes.text(j, i, f"{value:+.1f}", ha="center", va="center", fontsize=7, color=color)
    axes.set_yticks(range(len(sets.OPEN)), [o.label for o in sets.OPEN], fontsize=8)
    axes.set_xticks(range(len(measures)), list(measures.values()), rotation=40, ha="right")
    axes.tick_params(axis="x", labelsize=8)
    figure.colorbar(image, label="Spearman's rank correlation")
    return pictures.save(figure, path, dpi=110)


def landscapes(wave: Scored, path: Path) -> Path:
    """Draws the landscapes of the best sets, with the levels that make and separate regions."""
    chosen = score.best(wave.data["distances"], LANDSCAPES)
    columns = min(4, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = pictures.new(2.6 * columns, 2.5 * rows)
    x, y = wave.data["first_axis"], wave.data["second_axis"]
    image = None
    for k, i in enumerate(chosen):
        axes = figure.add_subplot(rows, columns, k + 1)
        cost = wave.data["landscape"][i].astype(float)
        image = axes.pcolormesh(x, y, cost.T, cmap="gray_r", vmin=0, vmax=3, shading="nearest")
        if np.ptp(cost) > 0:
            axes.contour(x, y, cost.T, [0.5, 1.0], colors=["tab:blue", "tab:orange"], linewidths=1)
        worst = wave.data["distances"][i].max()
        axes.set_title(f"set {i}, distance {worst:.1f}", fontsize=8)
        axes.tick_params(labelsize=7)
    figure.supxlabel("finger length [mm]", fontsize=9)
    figure.supylabel("X_D z [mm]", fontsize=9)
    if image is not None:
        figure.colorbar(image, ax=figure.axes, label="mean cost")
    return pictures.save(figure, path, dpi=110)
