"""`codesign optimize --seeds`: several runs of one program, and how they compare."""

import csv
import re
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from codesign_jax import codesign, cost, files
from codesign_jax.report import statistics
from codesign_jax.runs import RunResult, columns
from codesign_jax.scene import Scene
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


def compare(scene: Scene, results: dict[int, RunResult | None], console: Console) -> None:
    """Prints a row for each run and the share of successful ones.

    Args:
      scene: Scene of the runs.
      results: Each run by its seed; None for one that could not finish.
      console: Where to print.
    """
    head = ("seed", "converged", "best test cost", "kept", "successful")
    table = Table(*head, box=box.SIMPLE)
    solved = []
    for seed, result in results.items():
        table.add_row(str(seed), *_row(scene, result))
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


def check_table(folders: dict[int, Path]) -> None:
    """Refuses to replace a file of the table's name that is none of these tables.

    Args:
      folders: Run folder of each seed.

    Raises:
      SceneError: If there is one.
    """
    path = next(iter(folders.values())).parent / columns.SEEDS
    head = ",".join(columns.MORE[columns.SEEDS].columns)
    if not path.exists():
        return
    with path.open("rb") as file:
        ours = file.read(len(head)) == head.encode()
    if not ours:
        raise SceneError(
            [f"{path} is no table of runs, and would be replaced: choose another --out"]
        )


def write_table(
    scene: Scene, results: dict[int, RunResult | None], folders: dict[int, Path]
) -> Path:
    """Writes seeds.csv beside the run folders: a row for each run; see `runs.columns.MORE`.

    Args:
      scene: Scene of the runs.
      results: Each run by its seed; None for one that could not finish.
      folders: Run folder of each seed.
    """
    path = next(iter(folders.values())).parent / columns.SEEDS
    with files.atomically(path) as part, part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*columns.MORE[columns.SEEDS].columns])
        for seed, result in results.items():
            writer.writerow(
                [seed, int(result is not None), *_values(scene, result), folders[seed].name]
            )
    return path


def _values(scene: Scene, result: RunResult | None) -> list[object]:
    """Numbers of a run in the order of the table, without seed, finished and run."""
    if result is None or result.record is None:
        return [""] * 7
    episode = codesign.convergence_episode(result.record.history.cost.mean(1))
    first: list[object] = ["" if episode is None else episode + 1]
    if result.test is None:
        return first + [""] * 6
    costs, trials = np.asarray(result.test.cost), np.asarray(result.test.trials.cost)
    best = int(costs.argmin())
    counted = cost.counts(scene, np.asarray(result.test.trials.status)[best])
    kept = int((counted & (trials[best] < codesign.SUCCESS_COST)).sum())
    good = int(np.asarray(result.test.success).sum())
    sizes = [kept, int(counted.sum()), trials.shape[1], good, costs.size]
    return [*first, f"{costs[best]:.9g}", *sizes]


def _row(scene: Scene, result: RunResult | None) -> tuple[str, ...]:
    """Convergence, best particle's test cost and trials kept, and successful particles."""
    if result is None or result.record is None:
        return ("failed", "", "", "")
    episode, lowest, kept, counted, _, good, particles = _values(scene, result)
    converged = f"episode {episode}" if episode else "no"
    if lowest == "":
        return (converged, "", "", "")
    return (
        converged,
        f"{float(str(lowest)):.4f}",
        f"{kept} of {counted} trials",
        f"{good} of {particles} particles",
    )
