"""`codesign check`: how fast and how exact a scene is on this machine, by simulating it."""

import dataclasses
import importlib.metadata
import os
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich import box
from rich.table import Table

from codesign_jax import optimize, preflight, runs, sampling, statistics, user_code
from codesign_jax.commands import common
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Check
from codesign_jax.engines import Engine
from codesign_jax.interrupts import interruptible
from codesign_jax.judge import fresh_trials, verdict
from codesign_jax.judge.cases import Case
from codesign_jax.runs import Settings, reference, selection
from codesign_jax.runs.progress import Busy, duration
from codesign_jax.scene import Scene, accuracy_name, library, scene_files, with_accuracy
from codesign_jax.scene.schema import Problem
from codesign_jax.statistics import Interval, clustered
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome, Trial, failed

_ROUNDS = 4
"""Batches of random designs of which a mixed sample takes the best."""
_LEAST = 4
"""Designs that are simulated at accuracy reference, however long that takes."""
_GRASPS = 360
"""Grasps in the batch with --presets: flips of few verdicts tell nothing."""
_REPEATS = 4
"""Times that a mixed sample has each design with --presets, for a choice between two of them."""


class Measured(NamedTuple):
    """A batch of grasps."""

    scene: Scene  # what was simulated
    outcomes: Outcome  # arrays of shape (design, trial)
    seconds: float  # wall time of the batch, compiled before
    compiling: float  # time to compile the program, or to load it [s]
    name: str = ""  # the accuracy; empty for the scene's own
    rows: np.ndarray | None = None  # index of each row's design among the different ones

    @property
    def rate(self) -> float:
        return self.outcomes.cost.size / self.seconds

    @property
    def kept(self) -> np.ndarray:
        """Whether each grasp kept its object, shape (design, trial)."""
        return verdict.kept(self.outcomes)

    def __str__(self) -> str:
        """Rate and sizes in a line."""
        size = self.scene.discretization
        count = self.outcomes.cost.size
        named = f"accuracy {self.name}, " if self.name else ""
        return (
            f"{named}steps of {1e3 * size.timestep:g} ms, {size.links} links a finger: "
            f"{self.rate:.3g} grasps/s ({count} grasps in {self.seconds:.3g} s; compiled or "
            f"loaded in {self.compiling:.1f} s)"
        )


def main(options: Check) -> int:
    common.use_compilation_cache()
    load = os.getloadavg()[0]
    case = find_case(options)
    settings = _settings(options, case)
    levels = _levels(options, case, settings)
    _refuse(options, case, levels[fresh_trials.ACCURACY])
    console = Console()
    for line in _head(case, load):
        console.print(line)
    words, measured = simulate(case, settings, levels, options, console)
    return tell(case, settings, words, measured, console, table=options.presets)


def _levels(options: Check, case: Case, settings: Settings) -> dict[str, Scene]:
    """The scene, at its own accuracy first, at each accuracy to measure; `reference` is the last.

    It is measured at its own, and at that of a search if that is another one.
    """
    others = {}
    if settings.search_accuracy != runs.SCENE_ACCURACY:
        others[settings.search_accuracy] = _search_scene(options, case, settings)
    for name in library.available("accuracy") if options.presets else ():
        others.setdefault(name, with_accuracy(case.scene, name))
    finer = {fresh_trials.ACCURACY: with_accuracy(case.scene, fresh_trials.ACCURACY)}
    preset = accuracy_name(case.scene) if options.presets else ""
    others = {n: scene for n, scene in others.items() if n not in (preset, fresh_trials.ACCURACY)}
    return {preset: case.scene} | others | finer


def _search_scene(options: Check, case: Case, settings: Settings) -> Scene:
    """The scene at the accuracy of a search; a run's has that in its folder."""
    if options.run_folder is None:
        return runs.search_scene(case.scene, settings)
    file = options.run_folder / scene_files.SEARCH
    return find_case(dataclasses.replace(options, accuracy=str(file))).scene


def simulate(
    case: Case, settings: Settings, levels: dict[str, Scene], options: Check, console: Console
) -> tuple[str, list[Measured]]:
    """A description of the designs, and their grasps at every accuracy, in the same trials.

    Those at the last one, `reference`, are the first of them.
    """
    trials = len(case.scene.objects.object)
    usual = _GRASPS if options.presets else settings.particles * settings.trials
    count = max(_LEAST, (options.grasps or usual) // trials)
    measured: list[Measured] = []
    with Busy(console, "compiling") as busy:
        engine = case.make_engine()
        run, compiling = _compile(case.scene, engine, case, count)
        busy.say("simulating at the scene's accuracy")
        designs, words = _sample(options, case, run, count)
        drawn = _draw(case, 1, 0, count).trials
        for name, scene in levels.items():
            number = count
            if name == fresh_trials.ACCURACY:
                slower = fresh_trials.steps_and_links(case.scene)
                few = options.seconds * measured[0].rate / slower / trials
                number = int(np.clip(few, _LEAST, count))
            if measured:
                busy.say(f"compiling at accuracy {name}")
                run, compiling = _compile(scene, case.make_engine(scene), case, number)
                busy.say(f"simulating {number * trials} grasps at accuracy {name}")
            some = designs[:number], jax.tree.map(lambda v, n=number: v[:n], drawn)
            calls = [_time_call(run, *some) for _ in range(1 if number < count else 2)]
            outcomes, seconds = min(calls, key=lambda call: call[1])
            rows = np.unique(np.asarray(some[0]), axis=0, return_inverse=True)[1].ravel()
            measured.append(Measured(scene, outcomes, seconds, compiling, name, rows))
    return words, measured


def _refuse(options: Check, case: Case, finer: Scene) -> None:
    problems = common.number_problems(
        ("--grasps", options.grasps, 1, 1_000_000), ("--seconds", options.seconds, 1, 86_400)
    )
    problems += common.engine_problems(case.engine, options.overrides)
    if finer == case.scene:
        sentence = (
            f"accuracy {fresh_trials.ACCURACY} is what others are compared with: choose another by "
            "--accuracy"
        )
        problems.append(Problem("unsupported", sentence))
    common.refuse(problems)


def _head(case: Case, load: float) -> list[str]:
    """The subject and the machine of the check, and warnings."""
    device = jax.devices()[0]
    where = f"{os.cpu_count()} CPU cores"
    if hasattr(os, "sched_getaffinity"):
        where = f"{len(os.sched_getaffinity(0))} CPU cores"
    if device.platform != "cpu" and case.engine != "mujoco":
        where = f"one {device.device_kind}"
    versions = (f"{name} {importlib.metadata.version(name)}" for name in ("jax", "mujoco"))
    lines = [f"scene {case.scene.name}, engine {case.engine}; {where}; {', '.join(versions)}"]
    if load > 0.5:
        lines.append(
            f"warning: the machine is busy (load {load:.1f}), so that rates are lower than they "
            "could be"
        )
    return lines + preflight.notes(case.scene, case.space, {"the design": case.design})


def _settings(options: Check, case: Case) -> Settings:
    if options.run_folder:
        return runs.read_run(options.run_folder)[1]
    objects = len(case.scene.objects.object)
    arguments = {"optimizer": optimize.DEFAULT, "objects": objects}
    arguments |= {"policy": case.policy}
    names = common.design_file(options).preset, "concurrent", "morphology", case.engine
    settings = runs.make_settings(*names, 0, **arguments)
    if options.accuracy is None and runs.coarse_search(case.scene, settings):
        arguments["search_accuracy"] = runs.COARSE
    return runs.make_settings(*names, 0, **arguments)


def _without_own_code(settings: Settings) -> Settings:
    """Settings of as many grasps that import nothing: a run's are a stranger's, maybe."""
    optimizer = optimize.PAPER if user_code.is_user_code(settings.optimizer) else settings.optimizer
    replaced = {"optimizer": optimizer, "cost": runs.SCENE_COST, "policy": ""}
    replaced["search_accuracy"] = runs.SCENE_ACCURACY  # which may be a file
    return dataclasses.replace(settings, **replaced)


Run = Callable[[jax.Array, Trial], Outcome]


def _compile(scene: Scene, engine: Engine, case: Case, count: int) -> tuple[Run, float]:
    program = sampling.make_simulate(scene, engine, case.space)
    like = _draw(case, 0, 0, count)
    begin = time.perf_counter()
    return interruptible(program.compile, *like), time.perf_counter() - begin


def _draw(case: Case, stream: int, first: int, count: int) -> sampling.Drawn:
    key = jax.random.fold_in(jax.random.key(0), stream)
    sizes = {"first": first, "n": count, "num_trials": len(case.scene.objects.object)}
    return sampling.draw(case.scene, case.space, key, **sizes)


def _time_call(run: Run, designs: jax.Array, trials: Trial) -> tuple[Outcome, float]:
    begin = time.perf_counter()
    outcomes = jax.tree.map(np.asarray, interruptible(run, designs, trials))
    return outcomes, time.perf_counter() - begin


def _sample(options: Check, case: Case, run: Run, count: int) -> tuple[jax.Array, str]:
    """Designs of shape (count, parameter), repeated where there are fewer, and what they are."""
    if options.run_folder:
        particles = selection.read_record(options.run_folder).state.particles
        designs = np.unique(np.asarray(particles), axis=0)
        words = f"the {common.counted(len(designs), 'final particle')} of {options.run_folder} "
        words += "that differ"
    elif options.design:
        designs = np.asarray(case.design)[None]
        words = runs.describe(case.space, case.design)
    else:
        designs, words = _mixed(options, case, run, count)
        if options.presets:
            designs = designs[: max(2, count // _REPEATS)]
    return jnp.asarray(np.resize(designs, (count, designs.shape[1])), jnp.float32), words


def _mixed(options: Check, case: Case, run: Run, count: int) -> tuple[np.ndarray, str]:
    begin = time.perf_counter()
    designs = []
    costs = []
    while len(designs) < _ROUNDS and time.perf_counter() - begin < options.seconds / _ROUNDS:
        drawn = _draw(case, 0, count * len(designs), count)
        outcomes, _ = _time_call(run, *drawn)
        designs.append(np.asarray(drawn.designs))
        costs.append(np.where(failed(outcomes.status), np.inf, outcomes.cost).mean(1))
    every = np.concatenate(designs)
    half = (count + 1) // 2
    best = every[np.concatenate(costs).argsort(kind="stable")[:half]]
    mixed = np.stack([best, every[-half:]], 1).reshape(-1, best.shape[1])[:count]
    words = (
        f"half of them random, half the best of {len(every)} random ones; those that a search "
        "ends with take longer, and fewer of their verdicts differ (--run FOLDER measures them)"
    )
    return mixed, words


def tell(
    case: Case,
    settings: Settings,
    words: str,
    measured: list[Measured],
    console: Console,
    *,
    table: bool,
) -> int:
    """Prints what `simulate` found; the exit status."""
    usual, fine = measured[0], measured[-1]
    causes = verdict.failure_counts(usual.outcomes.status)
    lines = [
        *f"designs: {words}".split("\n"),
        *map(str, measured),
        *([f"failed: {causes}"] if causes else []),
        _kept(usual, fine),
        _search(case, settings, measured),
    ]
    for line in lines:
        console.print(line)
    if table:
        common.print_table(console, _table(measured))
    return int(any(failed(m.outcomes.status).all() for m in (usual, fine)))


def _kept(usual: Measured, fine: Measured) -> str:
    """Kept grasps at both accuracies, and how many verdicts differ."""
    theirs = fine.kept
    ours = usual.kept[: len(theirs)]
    differ, share = _flips(usual, fine)
    return (
        f"kept: {ours.sum()} of {ours.size} grasps, at accuracy {fresh_trials.ACCURACY} "
        f"{theirs.sum()}; verdicts differ in {differ}: {100 * share.value:.2g} % "
        f"(95 % interval {100 * share.low:.2g} to {100 * share.high:.2g} %)"
    )


def _flips(level: Measured, fine: Measured) -> tuple[int, Interval]:
    """Verdicts that differ from those at the finest accuracy, and their share."""
    theirs = fine.kept
    differ = level.kept[: len(theirs)] != theirs
    rows = np.arange(len(theirs)) if fine.rows is None else fine.rows
    of_design = np.bincount(rows, weights=differ.sum(1))
    return int(differ.sum()), clustered(of_design, np.bincount(rows) * theirs.shape[1])


def _search(case: Case, settings: Settings, measured: list[Measured]) -> str:
    """How long a search of these settings takes, with its test, and the verdict behind it."""
    usual, fine = measured[0], measured[-1]
    searched = next((m for m in measured if m.name == settings.search_accuracy), usual)
    plan = runs.prepare(case.scene, _without_own_code(settings))
    episodes = plan.grasps - plan.test_grasps
    seconds = searched.compiling + episodes / searched.rate + plan.test_grasps / usual.rate
    if searched is not usual:
        seconds += usual.compiling + plan.test_grasps / searched.rate
    tested = min(reference.most_trials(None, settings), verdict.USUAL)
    test = f", and {duration(tested / fine.rate)} for its test at accuracy {fresh_trials.ACCURACY}"
    return (
        f"a search ({settings.optimizer}, preset {settings.preset}, {plan.grasps} grasps): about "
        f"{duration(seconds)}{test if tested else ''}"
    )


def _table(measured: list[Measured]) -> Table:
    """A row for each accuracy: what it costs, and what it loses against the last one."""
    table = Table(box=box.SIMPLE, collapse_padding=True, pad_edge=False)
    head = ("accuracy", "step [ms]", "links", "ms a grasp", "kept", "verdicts that differ")
    for name in (*head, "95 % interval", "regret, points"):
        table.add_column(name, no_wrap=True)
    truth = measured[-1].kept
    for level in sorted(measured, key=lambda m: fresh_trials.steps_and_links(m.scene))[::-1]:
        kept = level.kept[: len(truth)]
        size = level.scene.discretization
        differ, share = _flips(level, measured[-1])
        numbers = (
            f"{1e3 * size.timestep:g}",
            str(size.links),
            f"{1e3 / level.rate:.3g}",
            f"{100 * kept.mean():.1f} %",
            f"{differ} of {truth.size}",
            f"{100 * share.low:.1f} to {100 * share.high:.1f} %",
        )
        table.add_row(level.name or "the scene's", *numbers, _regret(level, measured[-1]))
    return table


def _regret(level: Measured, fine: Measured) -> str:
    """What is lost by choosing between two designs at an accuracy, in points of the kept share."""
    by, truth = (_by_design(m, fine) for m in (level, fine))
    if by is None or truth is None or level is fine:
        return "–"
    truth = statistics.halves(truth)
    lost = statistics.gain(truth, truth) - statistics.gain(statistics.halves(by), truth)
    return f"{100 * lost:+.1f}"


def _by_design(level: Measured, fine: Measured) -> np.ndarray | None:
    """Kept grasps of each different design, as many of each, shape (design, trial).

    None without two designs that have a trial for each half at both accuracies.
    """
    rows = fine.rows
    if rows is None:
        return None
    kept = level.kept[: len(rows)]
    groups = [kept[rows == k].ravel() for k in range(rows.max() + 1)]
    least = min(len(group) for group in groups)
    if len(groups) < 2 or least < 2:
        return None
    return np.stack([group[:least] for group in groups])
