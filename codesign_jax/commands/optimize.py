"""`codesign optimize`."""

import contextlib
import dataclasses
import shlex
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax import codesign, devices, files, preflight, runs, terminal
from codesign_jax.commands import common, compare, status
from codesign_jax.commands.flags import Optimize
from codesign_jax.commands.run_settings import resolve, runs_of, several
from codesign_jax.judge import fresh_trials, sentences, stress, verdict, worth
from codesign_jax.judge.sentences import Judged
from codesign_jax.report import advice
from codesign_jax.runs import Plan, RunResult, Settings, columns, reference
from codesign_jax.runs.directory import reopened
from codesign_jax.runs.programs import Programs
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import Scene, accuracy_name, schema
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.scene.scene_files import scene_texts
from codesign_jax.terminal import Console, say
from codesign_jax.types import Params


class _After(NamedTuple):
    """What is simulated of a run's design once the run has ended."""

    most: int  # fresh grasps at most
    later: float  # grasps after those of this run, of the run's accuracy
    programs: Programs
    words: Sequence[str]  # the command line behind `codesign`


def main(options: Optimize) -> int:
    common.use_compilation_cache()
    scene, settings = resolve(options)
    every = runs_of(options, scene, settings)
    plan = runs.prepare(scene, settings)
    plans = {folder: runs.variant(plan, run_settings) for folder, run_settings in every.items()}
    _refuse(options, scene, every)
    if options.dry_run:
        terminal.wait("checking how hands of the design space begin")
        for note in preflight.notes(scene, plan.space, _ends(plan.space)):
            say(note)
        for note in common.policy_notes(plan.task.engine, plan.space.params(plan.space.default())):
            say(note)
        _dry_run(plan, len(every), options)
        return 0
    most = reference.most_trials(options.reference_trials, settings)
    after = _after(scene, most)
    slower = fresh_trials.steps_and_links(plan.task.scene) / fresh_trials.steps_and_links(scene)
    arguments = {"devices": options.devices, "chunk": options.chunk, "after": slower * after}
    worlds = len(every) * settings.particles * settings.trials
    alone = len(devices.take(options.devices)) == 1
    with reference.programs_of(plan, most, worlds if alone else 0) as programs:
        terminal.wait(programs.words())
        with programs.first():
            start = _start(plan, len(every), options)
            notes = preflight.notes(scene, plan.space, _ends(plan.space), start)
        for note in notes:
            say(note)
        done = runs.optimize(plans, sys.argv, fresh=options.fresh, programs=programs, **arguments)
        if done.signum:
            programs.abandon()
        return _tell_all(plans, done, _After(most, after, programs, options.words), options)


def _start(plan: Plan, count: int, options: Optimize) -> Callable[[Params], bool]:
    """Whether hands are known to start apart from everything, by the program of the search.

    Code of the user's own is not called before a run's folder can tell of its errors.
    """
    settings = plan.settings
    user_code = settings.policy or plan.task.cost is not None
    if user_code or len(devices.take(options.devices)) > 1:
        return lambda hands: False
    return partial(plan.task.start, worlds=count * settings.particles * settings.trials)


def _tell_all(
    plans: Mapping[Path, Plan], done: runs.Results, work: _After, options: Optimize
) -> int:
    """Tells how each run ended, with its tests; the exit status."""
    names = runs.run_names({f: p.settings for f, p in plans.items()}) if several(options) else {}
    errors = {folder: r for folder, r in done.runs.items() if isinstance(r, Exception)}
    for folder, error in errors.items():
        _tell_error(f"{names[folder]}: " if names else "", error)
    if done.signum:
        return 128 + done.signum
    console = Console()
    ended = {folder: r for folder, r in done.runs.items() if isinstance(r, RunResult)}
    for k, (folder, result) in enumerate(ended.items()):
        if names:
            console.print(f"{names[folder]}:")
        later = (len(ended) - k - 1) * work.later
        with _resumable({f: plans[f].settings for f in ended}):
            _tell(plans[folder], result, folder, work._replace(later=later), console)
    compared = _compare(options) if names else 0
    return compared or int(bool(errors))


@contextlib.contextmanager
def _resumable(ended: Mapping[Path, Settings]) -> Iterator[None]:
    """Says to the terminal and to the runs' logs that tests which are stopped go on later."""
    try:
        yield
    except KeyboardInterrupt:
        words = "stopped in the tests behind the search; the same command resumes"
        say(words, error=True)
        for folder, settings in ended.items():
            with reopened(folder, settings) as directory:
                directory.log(words)
        raise


def _refuse(options: Optimize, scene: Scene, every: Mapping[Path, Settings]) -> None:
    """Refuses folders in which runs cannot start or go on, before anything that takes time."""
    first = options.out or next(iter(every))
    common.refuse(common.place_problems("--out", first, folder=True))
    _refuse_links(options, every)
    for folder, settings in every.items():
        runs.check_folder(folder, scene, settings, fresh=options.fresh)


def _tell_error(name: str, error: Exception) -> None:
    if not isinstance(error, runs.FAILURES):
        say(*"".join(traceback.format_exception(error)).splitlines(), error=True)
        name += f"{type(error).__name__}: "
    say(f"error: {name}{status.words(error)}", error=True)


def _compare(options: Optimize) -> int:
    """Compares the command's runs as their folders have them; whether one of them failed."""
    scene, settings = resolve(dataclasses.replace(options, fresh=False))
    every = runs_of(options, scene, settings)
    compared = compare.read_all(
        {folder: (scene, run_settings) for folder, run_settings in every.items()}
    )
    console = Console()
    table = (options.out or Path("runs")) / columns.SEEDS
    compare.compare(compared, console)
    compare.write_table(compared, table)
    console.print(f"table: {table}")
    return int(any(run.result is None for run in compared.values()))


def _after(scene: Scene, most: int) -> float:
    """What a run simulates once it has ended, in grasps of its accuracy."""
    if not most:
        return 0.0
    fresh = min(most, verdict.USUAL) * fresh_trials.steps_and_links(scene)
    return fresh + reference.STRESS_TRIALS * stress.sets(scene) + worth.grasps(scene.num_fingers)


def _tell(plan: Plan, result: RunResult, folder: Path, work: _After, console: Console) -> None:
    """Tells how a run ended, with its verdict."""
    assert result.record is not None
    _summarize(plan, result, console)
    most = work.most
    if result.test is None:
        pass
    elif most and fresh_trials.hopeless(compare.of_test(plan.scene, result).outcomes):
        console.print(
            "reference test and other conditions left out: even the test that chose the design, "
            "which flatters it, kept less than half of its grasps"
        )
        _judge(plan, result, None, folder, work.words, console)
    elif not most:
        _judge(plan, result, None, folder, work.words, console)
    else:
        with runs.reopened(folder, plan.settings) as run:
            judged = _test_again(plan, run, work, console)
        _judge(plan, result, judged, folder, work.words, console)
    _draw(result.record.history.cost, folder / "figures" / "cost_evolution.png", console)
    console.print(f"results: {folder}")
    console.print(f"to look at: {shlex.join(['codesign', 'report', str(folder)])}")


def _test_again(plan: Plan, run: runs.RunDirectory, work: _After, console: Console) -> Judged:
    """The design in fresh grasps and under other conditions, and without each finger; tells so."""
    most, later, programs, _ = work
    slower = fresh_trials.steps_and_links(plan.scene)
    others = stress.sets(plan.scene)
    coming = (later + reference.STRESS_TRIALS * others) / slower
    outcomes = reference.test(run, plan.settings, most, console, programs, coming)
    case, other = reference.stress_run(run, plan.settings, console, programs, later)
    reference.tell_stress(case, other, console)
    judged = fresh_trials.judged(plan.scene, outcomes, other)
    if judged.verdict.word != "not good":
        fingers = reference.worth_run(run, plan.settings, console)
        if fingers is not None:
            reference.tell_worth(fingers, run.path, console)
    return judged


def _draw(cost: np.ndarray, path: Path, console: Console) -> None:
    """Draws the episodes' costs; a picture that fails costs no result."""
    try:
        with Busy(console, "drawing"), files.naming(path):
            from codesign_jax.report import figures

            figures.save(figures.cost_evolution(cost), path)
    except OSError:  # a full disk fails the command
        raise
    except Exception as error:  # of matplotlib, which has many
        common.warn(f"{path} could not be drawn ({type(error).__name__}: {error})")
    else:
        console.print(f"figure: {path}")


def _refuse_links(options: Optimize, folders: Iterable[Path]) -> None:
    """Refuses links below --out, where a command of several runs chooses the folders."""
    if options.out is None:
        return
    every = {parent for folder in folders for parent in (folder, *folder.parents)}
    links = sorted(p for p in every if options.out in p.parents and p.is_symlink())
    hint = "is a symbolic link: put the folder itself in its place"
    common.refuse([schema.Problem("file", f"{link} {hint}") for link in links])


def _ends(space: DesignSpace) -> dict[str, np.ndarray]:
    thin = np.where([name.split("[")[0] == "wall" for name in space.names], space.low, space.high)
    ends = {"default": space.default(), "lower ends": space.low, "upper ends": space.high}
    ends |= {"thinnest walls": thin}
    projected = jax.vmap(space.project)(np.array([*ends.values()], np.float32))
    names = [f"design of the space's {n}" for n in ends]
    return dict(zip(names, np.asarray(projected), strict=True))


def _dry_run(plan: Plan, count: int, options: Optimize) -> None:
    scene = plan.scene
    settings = plan.settings
    for name, text in scene_texts(scene).items():
        say(f"# ---- {name}", *text.split("\n"))
    values = dataclasses.asdict(settings).items()
    say("# ---- settings", *(f"{name}: {value}" for name, value in values), "")
    batch = settings.particles * settings.trials
    seed = batch if runs.needs_poor_seed(plan) else 0
    say(f"grasps: {plan.grasps}" + (f" and at least {seed} to find the seed" if seed else ""))
    if tested := settings.test_rounds * settings.trials:
        whole = f", in whole rounds of {settings.trials}" if tested != settings.test_trials else ""
        many = plan.test_grasps
        few = plan.finalists
        say(f"final test: {many} of these grasps, {tested} trials of {few} particles{whole}")
        if plan.retests:
            say(
                f"search at accuracy {settings.search_accuracy}, final test at "
                f"{accuracy_name(scene) or 'that of the scene'}, and {many} grasps more of it at "
                "the search's"
            )
    if count > 1:
        say(f"runs: {count}, in one batch; grasps and disk are those of each")
    row = 40 + 12 * plan.space.num_parameters
    rows = settings.episodes * settings.particles * (settings.trials + 1)
    say(f"disk: about {3 * rows * row / 1e6:.1f} MB")
    if most := reference.most_trials(options.reference_trials, settings):
        usual = f"until the verdict is decided, about {verdict.USUAL} for a good design"
        say(f"reference test: at most {most} grasps at accuracy {fresh_trials.ACCURACY}, {usual}")
        say(f"other conditions: {reference.STRESS_TRIALS * stress.sets(scene)} grasps")
        if scene.num_fingers > 1:
            say(f"worth of fingers: about {worth.grasps(scene.num_fingers)} grasps")
    say("time: `codesign check` measures it on this machine")


def _summarize(plan: Plan, result: RunResult, console: Console) -> None:
    assert result.record is not None
    history = result.record.history
    particles = np.asarray(result.record.state.particles)
    converged = codesign.convergence_episode(history.cost.mean(1))
    if plan.task.cost is not None:
        console.print(
            f"lowest mean cost of an episode, by {plan.settings.cost}: "
            f"{history.cost.mean(1).min():.4g}"
        )
    elif converged is None:
        console.print(f"not converged: the mean cost does not stay below {codesign.CONVERGED_COST}")
    elif converged == 0:
        console.print(f"converged: no episode has a mean cost above {codesign.CONVERGED_COST}")
    else:
        grasps = converged * plan.settings.particles * plan.settings.trials
        console.print(f"converged from episode {converged + 1} on, after {grasps} grasps")
    if result.test is not None:
        best = particles[int(np.asarray(result.test.cost).argmin())]
        console.print(*runs.describe(plan.space, best, "best final particle").split("\n"), sep="\n")


def _judge(
    plan: Plan,
    result: RunResult,
    fresh: Judged | None,
    folder: Path,
    words: Sequence[str],
    console: Console,
) -> None:
    assert result.test is not None
    test = compare.of_test(plan.scene, result)
    assert result.record is not None
    count = len(np.unique(np.asarray(result.record.state.particles), axis=0))
    chosen = f"chosen as the best of {count} final particles"
    if fresh is None:
        lines = [f"{chosen} by these very trials, which flatters it: {test.details}"]
    else:
        lines = [
            f"{chosen}, by a test that flatters it: {verdict.tally(test.outcomes)}",
            f"its fresh grasps: {fresh.details}",
        ]
    judged = test if fresh is None else fresh
    for line in [*lines, *sentences.warnings(judged), f"verdict: {judged}"]:
        console.print(line)
    tips = advice.after_search(judged, plan.settings, ["codesign", *words], folder)
    for what, command in tips:
        console.print(f"to try {what}: {shlex.join(['codesign', *command])}")
