"""`codesign optimize --seeds`: several runs of one program, and how they compare."""

import csv
import re
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from codesign_jax import codesign, files
from codesign_jax.report import statistics
from codesign_jax.runs import RunResult
from codesign_jax.scene.schema import SceneError

MOST = 1000
"""Most runs of one command: a guard against a slip such as 0-99999."""


def parse(text: str) -> list[int]:
    """Reads seeds such as "0-9" or "1,3,5-7", in ascending order.

    Raises:
      SceneError: If the text is none, or names too many.
    """
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,10})(?:-([0-9]{1,10}))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first or last >= 2**31:
            raise SceneError([f"--seeds {text!r} must be seeds such as 0-9 or 1,3,5"])
        if last - first >= MOST or len(found) > MOST:
            raise SceneError([f"--seeds {text!r} names more than {MOST} runs"])
        found |= set(range(first, last + 1))
    return sorted(found)


def compare(results: dict[int, RunResult | None], console: Console) -> None:
    """Prints a row for each run and the share of successful ones.

    Args:
      results: Each run by its seed; None for one that could not finish.
      console: Where to print.
    """
    head = ("seed", "converged", "best test cost", "kept", "successful")
    table = Table(*head, box=box.SIMPLE)
    solved = []
    for seed, result in results.items():
        table.add_row(str(seed), *_row(result))
        if result is not None and result.test is not None:
            solved.append(bool(np.asarray(result.test.success).any()))
    console.print(table)
    if solved:
        share = statistics.wilson(sum(solved), len(solved))
        console.print(
            f"{sum(solved)} of {len(solved)} runs have a particle below the limit of success, "
            f"{codesign.SUCCESS_COST}: {100 * share.low:.0f} to {100 * share.high:.0f} % of such "
            "runs (95 % interval)"
        )


COLUMNS = (
    "seed",
    "finished",
    "converged_episode",
    "best_test_cost",
    "trials_kept",
    "trials",
    "successful_particles",
    "particles",
    "run",
)
"""Columns of seeds.csv; an episode from 1, empty where a run has none."""


def write_table(results: dict[int, RunResult | None], folders: dict[int, Path]) -> Path:
    """Writes seeds.csv beside the run folders: a row for each run, with `COLUMNS`.

    Args:
      results: Each run by its seed; None for one that could not finish.
      folders: Run folder of each seed.
    """
    path = next(iter(folders.values())).parent / "seeds.csv"
    with files.atomically(path) as part, part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for seed, result in results.items():
            writer.writerow([seed, int(result is not None), *_values(result), folders[seed].name])
    return path


def _values(result: RunResult | None) -> list[object]:
    """Numbers of a run in the order of `COLUMNS`, without seed, finished and run."""
    if result is None or result.record is None:
        return [""] * 6
    episode = codesign.convergence_episode(result.record.history.cost.mean(1))
    first: list[object] = ["" if episode is None else episode + 1]
    if result.test is None:
        return first + [""] * 5
    cost, trials = np.asarray(result.test.cost), np.asarray(result.test.trials.cost)
    best = int(cost.argmin())
    kept = int((trials[best] < codesign.SUCCESS_COST).sum())
    good = int(np.asarray(result.test.success).sum())
    return [*first, f"{cost[best]:.9g}", kept, trials.shape[1], good, cost.size]


def _row(result: RunResult | None) -> tuple[str, ...]:
    """Convergence, best particle's test cost and trials kept, and successful particles."""
    if result is None or result.record is None:
        return ("failed", "", "", "")
    episode, cost, kept, trials, good, particles = _values(result)
    converged = f"episode {episode}" if episode else "no"
    if cost == "":
        return (converged, "", "", "")
    return (
        converged,
        f"{float(str(cost)):.4f}",
        f"{kept} of {trials} trials",
        f"{good} of {particles} particles",
    )
