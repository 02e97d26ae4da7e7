"""`codesign compare`: runs side by side, and two designs in the same trials.

`codesign optimize` ends with it where there are several seeds or strategies.
"""

import math
import os
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from rich import box
from rich.table import Table

from codesign_jax import codesign, cost, files, runs, statistics
from codesign_jax.commands import common, flags
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Compare
from codesign_jax.judge import fresh_trials, sentences, verdict
from codesign_jax.judge.cases import Case
from codesign_jax.judge.sentences import Judged
from codesign_jax.model import morphology
from codesign_jax.runs import (
    RunResult,
    Settings,
    columns,
    manifest,
    reference,
    selection,
    tables,
)
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import design_space
from codesign_jax.scene.schema import InputError, Problem
from codesign_jax.terminal import Console

_OF_SETTINGS = ("schedule", "optimizer", "preset", "engine", "cost", "search_accuracy")
TRIALS = 150
"""Trials in which designs are compared by default."""
_WORDS = {"schedule": "strategy", "search_accuracy": "search"}


class Compared(NamedTuple):
    """A run that is compared with others."""

    scene: Scene
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

    @property
    def judged(self) -> Judged | None:
        """Fresh trials of its design, else its final test's trials, else None."""
        if self.fresh is None and self.result is not None and self.result.test is not None:
            return of_test(self.scene, self.result)
        return self.fresh

    @property
    def air(self) -> float | None:
        """Air in all unloaded chambers of its design [cm^3]; None without a finished episode."""
        if self.result is None or self.result.record is None:
            return None
        design = selection.choose(self.scene, self.result.record).design
        space = design_space(self.scene.hand, self.settings.preset)
        return float(morphology.air(self.scene.hand, space.params(design)))

    @property
    def kind(self) -> dict[str, str]:
        """Properties besides the seed in which runs may differ, by column."""
        properties = {"scene": self.scene.name, "hand": self.scene.hand.name}
        properties["objects"] = self.scene.objects.name
        return properties | {_WORDS.get(n, n): str(getattr(self.settings, n)) for n in _OF_SETTINGS}


def main(options: Compare) -> int:
    designs = [path for path in options.folders if flags.is_design(path)]
    folders = [] if designs else [run for folder in options.folders for run in _runs_in(folder)]
    problems = common.number_problems(
        ("--trials", options.trials, 1, 100_000), ("--seed", options.seed, 0, 2**31 - 1)
    )
    if not options.folders:
        problems.append(Problem("missing", "compare needs at least one run folder"))
    if designs and options.out is not None:
        problems.append(
            Problem("conflict", "--out is a table of runs; leave it out beside design files")
        )
    paths = [*options.folders] if designs else folders
    sides = bool(options.set_a or options.set_b)
    alone = len(paths) == 1 and (len(options.policy) == 1 or sides)
    if designs and len(paths) != 2 and not alone:
        problems.append(
            Problem(
                "conflict",
                "compare takes two designs, or one with --policy against none or with --set-b",
            )
        )
    if sides and len(paths) not in (1, 2):
        problems.append(
            Problem(
                "conflict", f"--set-a and --set-b are of two designs; there are {len(paths)} runs"
            )
        )
    if options.trials is not None and len(paths) != 2 and not alone:
        problems.append(
            Problem(
                "conflict", f"--trials compares two designs; the folders have {len(folders)} runs"
            )
        )
    common.refuse(problems + common.place_problems("--out", options.out, ".csv"))
    simulates = bool(designs) or options.trials is not None or sides
    pair = _pair(options, paths) if simulates else {}
    console = Console()
    if folders:
        every = read_all({folder: runs.read_run(folder) for folder in folders})
        compare(every, console, named=True)
        if options.out is not None:
            write_table(every, options.out)
            console.print(f"table: {options.out}")
    if pair:
        compare_pair(pair, options, console)
    return 0


def _runs_in(folder: Path) -> list[Path]:
    folders = manifest.runs_inside(folder, "**")
    if (folder / manifest.PROVENANCE).exists() or not folders:
        runs.read_run(folder)  # which says what is wrong
        return [folder]
    return folders


def read_all(every: Mapping[Path, tuple[Scene, Settings]]) -> dict[Path, Compared]:
    """The runs in folders as they are, with the fresh trials that these have, by folder."""
    compared = {}
    for folder, (scene, settings) in every.items():
        result = read(scene, folder)
        fresh = None
        if result is not None and result.test is not None and (folder / reference.FILE).exists():
            kept, why = reference.stored(folder, settings)
            if why:
                judge = "" if kept else ": the final test, which flatters the design, judges it"
                common.warn(f"{folder / reference.FILE} {why}{judge}")
            if kept is not None:
                about = reference.tested(folder, settings)[1]
                other, _ = reference.read_stress(folder, about, any_code=True)
                fresh = fresh_trials.judged(scene, kept, other)
        compared[folder] = Compared(scene, settings, result, fresh)
    return compared


def _pair(options: Compare, paths: list[Path]) -> dict[str, Case]:
    """The two designs by what they are called; one alone is with its policy and without it."""
    sides = options.set_a, options.set_b
    if len(paths) == 1 and any(sides):
        paths = 2 * paths
    subjects = [_subject(options, path, side) for path, side in zip(paths, sides, strict=False)]
    of_runs = not any(map(flags.is_design, paths))
    if of_runs and (unknown := {*options.policy} - {subject.policy for subject in subjects}):
        raise InputError(
            [
                Problem("conflict", f"--policy {name}: neither run was made with it")
                for name in unknown
            ]
        )
    every = [find_case(subject) for subject in subjects]
    words = [" ".join(chain.from_iterable(side)) for side in sides]
    named = zip(paths, words, strict=False)
    names = [f"{path} with {more}" if more else str(path) for path, more in named]
    if len(every) == 1:
        [case] = every
        return {f"{names[0]} with {case.policy}": case, "without": case._replace(policy="")}
    first, other = every
    if first.scene.objects != other.scene.objects:
        compared = "runs" if of_runs else "designs"
        raise InputError.of(
            "conflict",
            f"the two {compared} have other objects or noise: --objects says which to take",
        )
    if names[0] == names[1]:
        names[1] += " again"
    return dict(zip(names, every, strict=True))


def _subject(options: Compare, path: Path, side: tuple[tuple[str, ...], ...]) -> flags.Subject:
    names = ("accuracy", "objects", "constants", "rigid_mount", "robust", "engine")
    arguments = {n: getattr(options, n) for n in names}
    arguments["overrides"] = (*options.overrides, *side)
    if not flags.is_design(path):
        policy_of_run = runs.read_run(path)[1].policy
        policy = policy_of_run if policy_of_run in options.policy else None
        return flags.Subject(run_folder=path, policy=policy, **arguments)
    if len(options.policy) > 1:
        raise InputError.of("conflict", "--policy takes one policy beside design files")
    return flags.Subject(
        design=((str(path),),), policy=next(iter(options.policy), None), **arguments
    )


def compare_pair(pair: dict[str, Case], options: Compare, console: Console) -> None:
    """Simulates designs by their names in the same trials, and prints how they differ."""
    kept = []
    count = TRIALS if options.trials is None else options.trials
    for name, case in pair.items():
        with Busy(console, f"compiling, then simulating {common.counted(count, 'grasp')}"):
            outcome, departure = case.observe(count, jax.random.key(options.seed))
        console.print(f"{name} {Judged(case.scene, outcome, options.accuracy)}")
        console.print(f"{name}: {case.air:.1f} cm³ of air in all unloaded chambers")
        if departure is not None:
            console.print(f"policy {case.policy} {departure}")
        kept.append(verdict.kept(outcome))
    for line in difference(*kept, names=[*pair]):
        console.print(line)


def difference(first: np.ndarray, second: np.ndarray, names: list[str]) -> list[str]:
    """Prints how often each of two designs kept the object, in the same trials.

    Args:
      first: Which trials the first design kept, shape (trial,) bool.
    """
    only = int((first & ~second).sum()), int((~first & second).sum())
    both = int((first & second).sum())
    total = len(first)
    interval = statistics.paired(both, *only, total)
    value, low, high = (100 * v for v in interval)
    word = f"{names[value < 0]} keeps more"
    if low <= 0 <= high:
        word = "no difference is shown"
        if value:
            word += f"; about {_needed(*only, total):,} trials at these shares would show one"
    return [
        f"of the same {total} trials {both} were kept by both, {only[0]} by {names[0]} alone, "
        f"{only[1]} by {names[1]} alone, and {total - both - sum(only)} by neither",
        f"difference: {value:+.1f} percentage points ({low:+.1f} to {high:+.1f}, 95 % interval by "
        f"Newcombe; McNemar's exact test: p = {statistics.mcnemar(*only):.2g}): {word}",
    ]


def _needed(first: int, second: int, total: int) -> int:
    """Paired trials whose 95 % interval of the difference would leave out 0 at the same shares.

    By the normal distribution's variance of a difference of paired shares.
    """
    share = first / total
    other = second / total
    variance = share + other - (share - other) ** 2
    return math.ceil(1.96**2 * variance / (share - other) ** 2)


def of_test(scene: Scene, result: RunResult) -> Judged:
    """The final test of a run's best final particle."""
    assert result.test is not None
    best = int(np.asarray(result.test.cost).argmin())
    trials = jax.tree.map(lambda v: np.asarray(v)[best], result.test.outcomes)
    return Judged(scene, trials, grasps="grasps of its final test")


def compare(every: Mapping[Path, Compared], console: Console, *, named: bool = False) -> None:
    """Prints a row for each run and for each kind of them the share of those with a good design."""
    kinds = {folder: run.kind for folder, run in every.items()}
    differ = [n for n in next(iter(kinds.values())) if len({k[n] for k in kinds.values()}) > 1]
    groups: dict[tuple[str, ...], list[Compared]] = {}
    rows = []
    for folder, run in every.items():
        key = tuple(kinds[folder][n] for n in differ)
        groups.setdefault(key, []).append(run)
        name = [folder.as_posix()] if named else []
        rows.append((*name, *key, str(run.settings.seed), *_row(run)))
    head = ("seed", "converged", "judged by", "kept", "lost", "not released", "faults", "verdict")
    head += ("other conditions", "air [cm³]")
    common.print_table(console, _table((*["run"] * named, *differ, *head), rows))
    rows = [(*kind, *_summary(group)) for kind, group in groups.items()]
    if len(groups) > 1:
        head = ("converged", "grasps until then, median", "good", "95 % interval")
        common.print_table(console, _table((*differ, *head), rows))
    *_, good, interval = rows[0]
    if good and len(groups) == 1:
        console.print(f"{good} runs found a good design: {interval} of such runs (95 % interval)")
    if good:
        object_words = {sentences.objects(run.judged.scene) for run in every.values() if run.judged}
        console.print(f"{verdict.RULE}; for {', or '.join(sorted(object_words))}")


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> Table:
    table = Table(box=box.SIMPLE, collapse_padding=True, pad_edge=False)
    for name in head:
        table.add_column(name, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _summary(group: list[Compared]) -> tuple[str, ...]:
    """Summary of the runs of a kind; unknown values are empty."""
    size = group[0].settings.particles * group[0].settings.trials
    episodes = [run.converged for run in group]
    # Of an even number the upper one of the two in the middle: never, if half of them never do.
    middle = sorted(np.inf if e is None else (e - 1) * size for e in episodes)[len(group) // 2]
    converged = f"{sum(e is not None for e in episodes)} of {len(group)}"
    grasps = "never" if np.isinf(middle) else f"{middle:.0f}"
    judgements = [judged for run in group if (judged := run.judged) is not None]
    if not judgements:
        return converged, grasps, "", ""
    good = sum(judged.verdict.word == "good" for judged in judgements)
    share = statistics.wilson(good, len(judgements))
    interval = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
    return converged, grasps, f"{good} of {len(judgements)}", interval


def write_table(every: Mapping[Path, Compared], path: Path) -> None:
    head = [*columns.MORE[columns.SEEDS].columns]
    files.make_folder_of(path)
    tables.write(path, head, (_values(folder, run, path) for folder, run in every.items()))


def _values(folder: Path, run: Compared, path: Path) -> dict[str, object]:
    """The row of a run in a place, for a table's path; what is not known is empty."""
    row: dict[str, object] = dict.fromkeys(columns.MORE[columns.SEEDS].columns, "")
    row["run"] = Path(os.path.relpath(folder, path.parent)).as_posix()
    row |= {name: getattr(run.settings, name) for name in ("seed", "schedule", "first")}
    record = run.result and run.result.record
    row["finished"] = int(bool(record) and record.done == run.settings.episodes)
    row["converged_episode"] = run.converged or ""
    if run.result is None or run.result.record is None or run.result.test is None:
        return row
    test = run.result.test
    chosen = of_test(run.scene, run.result)
    first = np.unique(np.asarray(run.result.record.state.particles), axis=0, return_index=True)[1]
    row |= {
        "best_test_cost": f"{np.asarray(test.cost).min():.9g}",
        "kept_trials": verdict.tally(chosen.outcomes).kept,
        "trials": chosen.outcomes.cost.size,
        "paper_successes": int(np.asarray(test.paper_success)[first].sum()),
        "particles": first.size,
        "chamber_volume_cm3": f"{run.air:.9g}",
        "verdict": (run.fresh or chosen).verdict.word,
        "other_conditions": (run.fresh or chosen).limits,
    }
    if run.fresh is not None:
        counts = verdict.tally(run.fresh.outcomes)._asdict()
        row |= {f"fresh_{name}_trials": number for name, number in counts.items()}
        mean = float(cost.particle_cost(run.fresh.scene, run.fresh.outcomes))
        row["fresh_cost"] = f"{mean:.9g}"
    return row


def _row(run: Compared) -> tuple[str, ...]:
    if run.result is None or run.result.record is None:
        return ("failed", *[""] * 8)
    converged = f"episode {run.converged}" if run.converged else "no"
    judged = run.judged
    if judged is None:
        return (converged, *[""] * 7, f"{run.air:.1f}")
    where = "final test" if run.fresh is None else f"{judged.accuracy}"
    tally = verdict.tally(judged.outcomes)
    numbers = f"{tally.kept} of {tally.total}", *map(str, tally[1:])
    words = judged.verdict.word, judged.limits
    return (converged, where, *numbers, *words, f"{run.air:.1f}")


def read(scene: Scene, folder: Path) -> RunResult | None:
    """The run in a folder as it is; None if it has no checkpoint, or every trial failed."""
    try:
        record = runs.load_record(folder, tell=common.warn)
    except InputError as error:
        common.warn(str(error))
        return None
    if record is None or record.failed_outcomes() is not None:
        return None
    test = None if record.test is None else codesign.summarize_test(scene, record.test)
    return RunResult(record, test)
