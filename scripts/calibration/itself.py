"""The default scene by its own experiments: real runs in place of the surrogate's, same targets."""

from pathlib import Path

import numpy as np

from scripts.calibration import score, summary
from scripts.experiments import study
from scripts.shared import tables

STRATEGIES = ("single", "switch-4", "concurrent")
"""Those whose success and speed the targets ask for."""
SAYS = {
    "420 simulations": "{simulations concurrent, first, own:,.0f} until the mean cost is first "
    "below 1, {simulations concurrent, stays, own:,.0f} until it stays there",
    "two regions": "a cost of {saddle:g} separates two regions",
    "solutions": "{lossless:.0%} of the designs",
    "poor seeds": "{above_two:.0%} of the designs",
    "single is poor": "{success single, own:.0%}, with four switches {success switch-4, own:.0%}",
    "concurrent succeeds": "{success concurrent, own:.0%}",
    "switching is faster": "{simulations switch-4, stays, own:,.0f} with four switches, "
    "{simulations concurrent, stays, own:,.0f} with both domains at once, one domain later",
}
"""What the scene has of each target."""


def measured(folder: Path) -> dict[str, np.ndarray]:
    """The numbers that `score.TARGETS` ask for, of the experiments in a folder, shape (1,) each.

    Real trials have no reading "shared" or "own": both names have the same numbers.

    Args:
      folder: Folder with `2d` and `landscape`.

    Raises:
      FileNotFoundError: If one of them is missing.
    """
    runs, landscape = study.load_study(folder, "2d"), study.load(folder, "landscape")
    if runs is None or landscape is None:
        raise FileNotFoundError(f"{folder} holds no 2d or no landscape")
    cost = landscape[0]["exclude"]
    found = {
        "lossless": (cost < 0.01).mean(),
        "above_two": (cost > 2.0).mean(),
        "saddle": summary.saddle_height(cost),
    }
    episodes = {"first": runs.first_below(), "stays": runs.convergence()}
    success, never = runs.success(), runs.episodes + 1
    for strategy in STRATEGIES:
        place = runs.strategies.index(strategy)
        for noise in ("shared", "own"):
            found[f"success {strategy}, {noise}"] = success[place].mean()
            for kind, each in episodes.items():
                middle = np.median(np.minimum(each[place], never))
                found[f"simulations {strategy}, {kind}, {noise}"] = runs.per_episode * middle
    return {name: np.array([float(value)]) for name, value in found.items()}


def table(folder: Path) -> str:
    """What the default scene has of each target, and its distance, as a Markdown table."""
    found = measured(folder)
    [distances] = score.implausibility(found)
    numbers = {name: float(value[0]) for name, value in found.items()}
    rows = [["target", "the default scene", "distance, standard deviations"]]
    for target, distance in zip(score.TARGETS, distances, strict=True):
        rows.append([target.name, SAYS[target.name].format(**numbers), f"{distance:.1f}"])
    return tables.markdown(rows)
