"""`codesign optimize` with several seeds or strategies: the runs, and how they compare."""

import csv
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from codesign_jax import codesign, cost, files, runs
from codesign_jax.commands import common
from codesign_jax.report import statistics, verdicts
from codesign_jax.report.verdicts import Judged
from codesign_jax.runs import RunResult, Settings, columns
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import InputError

MOST = 1000
"""Most runs of one command: a guard against a slip such as 0-99999."""


class Compared(NamedTuple):
    """A run that is compared with others.

    Attributes:
      settings: Its settings.
      result: How it ended; None if it could not finish.
      fresh: Fresh trials of its design; None without any.
    """

    settings: Settings
    result: RunResult | None
    fresh: Judged | None

    @property
    def converged(self) -> int | None:
        """Number of the episode, from 1, from which on the mean cost stays below the limit."""
        if self.result is None or self.result.record is None:
            return None
        episode = codesign.convergence_episode(self.result.record.history.cost.mean(1))
        return None if episode is None else episode + 1

    def judged(self, scene: Scene) -> Judged | None:
        """Fresh trials of its design, else its final test's trials, else None."""
        if self.fresh is None and self.result is not None and self.result.test is not None:
            return of_test(scene, self.result)
        return self.fresh


def parse(text: str) -> list[int]:
    """Reads seeds such as "0-9" or "1,3,5-7", in ascending order.

    Raises:
      InputError: If the text is none, or names too many.
    """
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,10})(?:-([0-9]{1,10}))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first or last >= 2**31:
            raise InputError([f"--seeds {text!r} must be seeds such as 0-9 or 1,3,5"])
        if last - first >= MOST or len(found) > MOST:
            raise InputError([f"--seeds {text!r} names more than {MOST} runs"])
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
    trials = jax.tree.map(lambda v: np.asarray(v)[best], result.test.outcomes)
    return Judged(scene, trials, grasps="grasps of its final test")


def compare(scene: Scene, every: Mapping[Path, Compared], console: Console) -> None:
    """Prints a row for each run and for each strategy the share of those with a good design.

    Args:
      scene: Scene of the runs.
      every: The runs by their folders.
      console: Where to print.
    """
    strategies = list(dict.fromkeys(run.settings.schedule for run in every.values()))
    head = ("seed", "converged", "judged by", "kept", "lost", "stuck", "failed", "verdict")
    rows = []
    for run in every.values():
        own = [run.settings.schedule] if len(strategies) > 1 else []
        rows.append((*own, str(run.settings.seed), *_row(scene, run)))
    common.print_table(console, _table((*(["strategy"] * (len(strategies) > 1)), *head), rows))
    rows = [_summary(scene, name, every) for name in strategies]
    if len(strategies) > 1:
        head = ("strategy", "converged", "grasps until then, median", "good", "95 % interval")
        common.print_table(console, _table(head, rows))
    name, _, _, good, interval = rows[0]
    if good and len(strategies) == 1:
        console.print(f"{good} runs found a good design: {interval} of such runs (95 % interval)")
    if good:
        console.print(verdicts.RULE)


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> Table:
    table = Table(box=box.SIMPLE, collapse_padding=True, pad_edge=False)
    for name in head:
        table.add_column(name, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _summary(scene: Scene, strategy: str, every: Mapping[Path, Compared]) -> tuple[str, ...]:
    """How the runs of a strategy did; what is not known of them is empty."""
    own = [run for run in every.values() if run.settings.schedule == strategy]
    size = own[0].settings.particles * own[0].settings.trials
    episodes = [run.converged for run in own]
    # Of an even number the upper one of the two in the middle: never, if half of them never do.
    middle = sorted(np.inf if e is None else (e - 1) * size for e in episodes)[len(own) // 2]
    converged = f"{sum(e is not None for e in episodes)} of {len(own)}"
    grasps = "never" if np.isinf(middle) else f"{middle:.0f}"
    found = [judged for run in own if (judged := run.judged(scene)) is not None]
    if not found:
        return strategy, converged, grasps, "", ""
    good = sum(judged.verdict.word == "good" for judged in found)
    share = statistics.wilson(good, len(found))
    interval = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
    return strategy, converged, grasps, f"{good} of {len(found)}", interval


def check_table(folder: Path) -> None:
    """Refuses to replace a file of the table's name that is none of these tables.

    Args:
      folder: Folder of the table.

    Raises:
      InputError: If there is one.
    """
    path = folder / columns.SEEDS
    if not path.exists():
        return
    with path.open("rb") as file:
        head = file.readline(1000)
    if not (head.startswith(b"seed,") and b",best_test_cost," in head):
        raise InputError(
            [f"{path} is no table of runs, and would be replaced: choose another --out"]
        )


def write_table(scene: Scene, every: Mapping[Path, Compared], folder: Path) -> Path:
    """Writes seeds.csv: a row for each run; see `runs.columns.MORE`.

    Args:
      scene: Scene of the runs.
      every: The runs by their folders.
      folder: Folder of the table, which has the run folders somewhere in it.
    """
    path = folder / columns.SEEDS
    with files.atomically(path) as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*columns.MORE[columns.SEEDS].columns])
        writer.writeheader()
        for place, run in every.items():
            own = {"seed": run.settings.seed, "run": place.relative_to(folder).as_posix()}
            own |= {"schedule": run.settings.schedule, "first": run.settings.first}
            own["finished"] = int(run.result is not None)
            writer.writerow(own | _values(scene, run) | _fresh_values(run.fresh))
    return path


def _values(scene: Scene, run: Compared) -> dict[str, object]:
    """How a run converged and how its final test ended, by column."""
    found: dict[str, object] = {"converged_episode": run.converged}
    if run.result is None or run.result.record is None or run.result.test is None:
        return found
    test = run.result.test
    costs = np.asarray(test.cost)
    best = int(costs.argmin())
    own = verdicts.tally(jax.tree.map(lambda v: np.asarray(v)[best], test.outcomes))
    first = np.unique(np.asarray(run.result.record.state.particles), axis=0, return_index=True)[1]
    judged = run.judged(scene)
    return found | {
        "best_test_cost": f"{costs[best]:.9g}",
        "kept_trials": own.kept,
        "trials": own.total,
        "paper_successes": int(np.asarray(test.paper_success)[first].sum()),
        "particles": first.size,
        "verdict": judged and judged.verdict.word,
    }


def _fresh_values(judged: Judged | None) -> dict[str, object]:
    """Kept, lost, stuck and failed fresh trials, and their mean cost, by column."""
    if judged is None:
        return {}
    mean = float(cost.particle_cost(judged.scene, judged.outcomes))
    counts = verdicts.tally(judged.outcomes)
    found: dict[str, object] = {f"fresh_{n}_trials": v for n, v in counts._asdict().items()}
    return found | {"fresh_cost": f"{mean:.9g}"}


def _row(scene: Scene, run: Compared) -> tuple[str, ...]:
    """Convergence of a run, and how its design did."""
    if run.result is None or run.result.record is None:
        return ("failed", *[""] * 6)
    converged = f"episode {run.converged}" if run.converged else "no"
    judged = run.judged(scene)
    if judged is None:
        return (converged, *[""] * 6)
    where = "final test" if run.fresh is None else f"{judged.accuracy}"
    found = verdicts.tally(judged.outcomes)
    numbers = f"{found.kept} of {found.total}", *map(str, found[1:])
    return (converged, where, *numbers, judged.verdict.word)


def read(scene: Scene, folder: Path) -> RunResult | None:
    """The run in a folder as it is; None if it has no checkpoint, or every trial failed."""
    try:
        record = runs.load_record(folder, tell=common.warn)
    except InputError as error:
        common.warn(str(error))
        return None
    if record is None or record.failed_status() is not None:
        return None
    test = None if record.test is None else codesign.summarize_test(scene, record.test)
    return RunResult(record, test, 0)
