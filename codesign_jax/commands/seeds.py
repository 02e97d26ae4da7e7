"""`codesign optimize --seeds`: several runs of one program, and how they compare."""

import csv
import re
from pathlib import Path

import jax
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from codesign_jax import codesign, cost, files
from codesign_jax.report import statistics, verdicts
from codesign_jax.report.verdicts import Judged
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


def of_test(scene: Scene, result: RunResult) -> Judged:
    """The final test of a run's best final particle.

    Args:
      scene: Scene of the run.
      result: The run, with a final test.
    """
    assert result.test is not None
    best = int(np.asarray(result.test.cost).argmin())
    trials = jax.tree.map(lambda v: np.asarray(v)[best], result.test.trials)
    return Judged(scene, trials)


def compare(
    scene: Scene,
    results: dict[int, RunResult | None],
    fresh: dict[int, Judged | None],
    console: Console,
) -> None:
    """Prints a row for each run and the share of successful ones.

    Args:
      scene: Scene of the runs.
      results: Each run by its seed; None for one that could not finish.
      fresh: Fresh trials of each run's design; None for one without.
      console: Where to print.
    """
    head = ("seed", "converged", "judged by", "kept", "lost", "stuck", "failed", "cost", "success")
    table = Table(box=box.SIMPLE, collapse_padding=True, pad_edge=False)
    for name in head:
        table.add_column(name, no_wrap=True)
    good = []
    for seed, result in results.items():
        judged = fresh[seed]
        if judged is None and result is not None and result.test is not None:
            judged = of_test(scene, result)
        table.add_row(str(seed), *_row(scene, result, judged, tested=fresh[seed] is None))
        if judged is not None:
            good.append(bool(verdicts.success(judged.scene, judged.outcomes)))
    console.print(table)
    if good:
        share = statistics.wilson(sum(good), len(good))
        console.print(
            f"{sum(good)} of {len(good)} runs found a design that keeps at least "
            f"{100 * verdicts.RELIABLE:.0f} % of all trials at a mean cost below "
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
    scene: Scene,
    results: dict[int, RunResult | None],
    fresh: dict[int, Judged | None],
    folders: dict[int, Path],
) -> Path:
    """Writes seeds.csv beside the run folders: a row for each run; see `runs.columns.MORE`.

    Args:
      scene: Scene of the runs.
      results: Each run by its seed; None for one that could not finish.
      fresh: Fresh trials of each run's design; None for one without.
      folders: Run folder of each seed.
    """
    path = next(iter(folders.values())).parent / columns.SEEDS
    with files.atomically(path) as part, part.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*columns.MORE[columns.SEEDS].columns])
        for seed, result in results.items():
            values = *_values(scene, result), *_fresh_values(fresh[seed])
            writer.writerow([seed, int(result is not None), *values, folders[seed].name])
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


def _fresh_values(judged: Judged | None) -> list[object]:
    """Kept, lost, stuck and failed fresh trials, and their mean cost."""
    if judged is None:
        return [""] * 5
    mean = float(cost.particle_cost(judged.scene, judged.outcomes))
    return [*verdicts.tally(judged.outcomes), f"{mean:.9g}"]


def _row(
    scene: Scene, result: RunResult | None, judged: Judged | None, *, tested: bool
) -> tuple[str, ...]:
    """Convergence of a run, and how its design did."""
    if result is None or result.record is None:
        return ("failed", *[""] * 7)
    episode = _values(scene, result)[0]
    converged = f"episode {episode}" if episode else "no"
    if judged is None:
        return (converged, *[""] * 7)
    where = "final test" if tested else f"{judged.accuracy}"
    found = verdicts.tally(judged.outcomes)
    mean = float(cost.particle_cost(judged.scene, judged.outcomes))
    word = "yes" if verdicts.success(judged.scene, judged.outcomes) else "no"
    numbers = f"{found.kept} of {found.total}", *map(str, found[1:]), f"{mean:.4f}"
    return (converged, where, *numbers, word)
