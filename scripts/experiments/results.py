"""Committed results of the experiments (Sec. VI.3): success, convergence, regions of success."""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from codesign_jax.codesign import CONVERGED_COST, SUCCESS_COST, convergence_episode

RULES = ("exclude", "worst")
"""Rules for failed trials under which results are evaluated; see `cost.particle_cost`."""


@dataclasses.dataclass(frozen=True)
class Study:
    """The committed results of an experiment on strategies.

    Attributes:
      plan: Sizes; see `simulate.Strategies`.
      notes: Provenance.
      data: Arrays; see `simulate.of_strategies`.
    """

    plan: dict[str, Any]
    notes: dict[str, Any]
    data: dict[str, np.ndarray]

    @property
    def strategies(self) -> list[str]:
        return [str(s) for s in self.data["strategies"]]

    @property
    def per_episode(self) -> int:
        return self.plan["particles"] * self.plan["trials"]

    @property
    def tested(self) -> bool:
        """Whether the final test was made; an experiment that was stopped before has none."""
        return not np.isnan(self.data["test_exclude"]).all()

    @property
    def episodes(self) -> int:
        return self.data["mean"].shape[-1]

    def success(self, rule: str = "exclude") -> np.ndarray:
        """Whether any final particle's mean test cost is below 0.01, bool, (strategy, run)."""
        return np.any(self.data[f"test_{rule}"] < SUCCESS_COST, axis=-1)

    def convergence(self, rule: str = "exclude") -> np.ndarray:
        """Episodes simulated when the mean cost is below 1.0 for good, (strategy, run).

        The episode that converged is counted; infinite where a run did not converge.
        """

        def count(means: np.ndarray) -> float:
            episode = convergence_episode(means)
            return np.inf if episode is None else episode + 1.0

        return np.apply_along_axis(count, -1, self.data[f"mean_{rule}"])

    def first_below(self, rule: str = "exclude") -> np.ndarray:
        """Episodes simulated when the mean cost is below 1.0 for the first time, (strategy, run).

        The paper's "converged" may be read so as well; infinite where a run never got there.
        """
        below = self.data[f"mean_{rule}"] < CONVERGED_COST
        return np.where(below.any(-1), below.argmax(-1) + 1.0, np.inf)


def load(folder: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """Reads NAME.npz and NAME.json of a folder; None where there are none."""
    path = folder / f"{name}.npz"
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as file:
        data = {key: file[key] for key in file.files}
    return data, json.loads((folder / f"{name}.json").read_text())


def load_study(folder: Path, name: str) -> Study | None:
    """Reads an experiment on strategies; None where its files are missing."""
    loaded = load(folder, name)
    if loaded is None:
        return None
    data, notes = loaded
    return Study(notes["settings"]["plan"], notes, data)


class Results(NamedTuple):
    """The experiments by one law of the fingers' section.

    Attributes:
      studies: Experiments on strategies by name, None where one was not made.
      grid: Arrays and notes of the landscape; None likewise.
    """

    studies: dict[str, Study | None]
    grid: tuple[dict[str, np.ndarray], dict[str, Any]] | None


LAWS = {"chamber": "", "elements": "elements"}
"""Laws of the section, and the folders of their results."""


def read(data: Path) -> dict[str, Results]:
    """Results by each law that a folder has some of."""
    folders = {law: data / folder for law, folder in LAWS.items()}
    every = {
        law: Results({n: load_study(folder, n) for n in ("2d", "23d")}, load(folder, "landscape"))
        for law, folder in folders.items()
    }
    return {law: r for law, r in every.items() if any(r.studies.values()) or r.grid}


class Region(NamedTuple):
    """A connected region of the landscape.

    Attributes:
      share: Its part of the grid's points.
      centre: Mean of its points in the parameters' units, shape (2,).
      low: Lower ends, shape (2,).
      high: Upper ends, shape (2,).
      mean: Mean cost in it.
      points: Its points, bool, shape (point, point).
    """

    share: float
    centre: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mean: float
    points: np.ndarray


LANDSCAPE_THRESHOLD = CONVERGED_COST
"""Cost below which a point of the landscape belongs to a region."""
SMALLEST = 0.005
"""Least share of the landscape that is called a region; smaller parts come and go with trials."""


def regions(
    data: dict[str, np.ndarray], threshold: float, rule: str = "exclude", smallest: float = SMALLEST
) -> list[Region]:
    """Connected components with cost below a threshold, largest first; points meet at edges.

    Components below `smallest` are left out.
    """
    cost = data[rule]
    labels, count = ndimage.label(cost < threshold)  # type: ignore[misc]
    axes = np.meshgrid(data["first_axis"], data["second_axis"], indexing="ij")
    parts = []
    for label in range(1, count + 1):
        points = labels == label
        where = np.stack([a[points] for a in axes])
        mean = float(cost[points].mean())
        parts.append(
            Region(float(points.mean()), where.mean(1), where.min(1), where.max(1), mean, points)
        )
    return sorted((r for r in parts if r.share >= smallest), key=lambda r: -r.share)
