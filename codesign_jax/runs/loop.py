"""Optimisations in their folders, one or many: seeds, episodes, final tests.

`optimize` does what section VI of the paper describes.  Several runs go side by side, each in a
folder of its own: three programs ask, simulate and tell an episode of all of them
(`Task.side_by_side`).  They may differ in seed, schedule and first domain, and one that fails does
not stop the others.

An episode is saved while the devices simulate the next one, so that no device waits for a disk.  A
process that is killed leaves the checkpoints of all episodes but the last one or two, and tables
that may end before them or in a row; the same command goes on from the newest checkpoint.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign
from codesign_jax.batch import LIMIT
from codesign_jax.codesign import EpisodeInfo, Task
from codesign_jax.devices import take
from codesign_jax.interrupts import Interrupts, Stopped
from codesign_jax.optimize import OptimizerState, candidates
from codesign_jax.runs.directory import open_run
from codesign_jax.runs.plan import Plan, finalists, needs_poor_seed, variant
from codesign_jax.runs.programs import RETEST, Programs
from codesign_jax.runs.progress import Progress, Voice
from codesign_jax.runs.record import Start
from codesign_jax.runs.run import Run, RunResult
from codesign_jax.runs.settings import Settings
from codesign_jax.types import Outcome

MOST = 100
"""Most runs at once: each holds open files.  More go on when these have ended."""


class Results(NamedTuple):
    """How runs ended.

    Attributes:
      runs: Result of each run by its folder, or why it failed.
      signum: Signal that stopped them early, or 0.
    """

    runs: dict[Path, RunResult | Exception]
    signum: int


def optimize(
    plans: Mapping[Path, Plan],
    command: list[str],
    *,
    fresh: bool = False,
    devices: int | None = None,
    chunk: int | None = None,
    after: float = 0.0,
    programs: Programs | None = None,
) -> Results:
    """Runs optimisations, or goes on with them; the same call does both.

    Args:
      plans: Each run by its folder; all are variants of one plan, see `prepare` and `variant`.
      command: Command line to note in the folders.
      fresh: Deletes earlier runs in the folders first.
      devices: Devices that simulate; None for all of this host.
      chunk: Most worlds of one device in one call; None for `batch.LIMIT`.  Runs that have no room
        go on when the others have ended.
      after: What the caller simulates of each run afterwards, as a number of its episodes' grasps:
        the time left that is shown includes it.
      programs: What the caller simulates afterwards, to be compiled while the search runs.

    Raises:
      InputError: If a folder cannot be used; see `open_run`.
      ValueError: If the plans are not variants of one, or there are not so many devices.
    """
    plan = next(iter(plans.values()))
    for other in plans.values():
        variant(plan, other.settings)
    many = len(take(devices))
    room = many * (chunk or LIMIT) // (plan.settings.particles * plan.settings.trials)
    results = Results({}, 0)
    size = max(1, min(MOST, room))
    folders = list(plans)
    for start in range(0, len(folders), size):
        group = {folder: plans[folder] for folder in folders[start : start + size]}
        plan_here = _on_devices(plan, many)
        more = _optimize_group(group, plan_here, command, fresh, after, programs or Programs())
        results = Results(results.runs | more.runs, more.signum)
        if results.signum:
            break
    return results


def _on_devices(plan: Plan, count: int) -> Plan:
    """The plan with tasks whose worlds so many devices share."""
    task = dataclasses.replace(plan.task, devices=count)
    test = dataclasses.replace(plan.test_task, devices=count) if plan.retests else task
    return plan._replace(task=task, test_task=test)


def run_names(every: Mapping[Path, Settings]) -> dict[Path, str]:
    """Names of several runs: each has its seed, and its schedule if these differ."""
    several = len({settings.schedule for settings in every.values()}) > 1
    return {
        folder: (f"{settings.schedule}, " if several else "") + f"seed {settings.seed}"
        for folder, settings in every.items()
    }


def _optimize_group(
    plans: Mapping[Path, Plan],
    plan: Plan,
    command: list[str],
    fresh: bool,
    after: float,
    programs: Programs,
) -> Results:
    names = run_names({folder: each.settings for folder, each in plans.items()})
    with contextlib.ExitStack() as stack:
        ahead = {"test": len(plan.tests) * plan.test_grasps, "after": after}
        progress = stack.enter_context(Progress(plan.settings.episodes, len(plans), **ahead))
        runs = {}
        for folder, each in plans.items():
            voice = Voice(progress, names[folder] if len(plans) > 1 else "")
            runs[folder] = stack.enter_context(_opened(folder, each, command, fresh, voice))
        interrupts = stack.enter_context(Interrupts(progress.message))
        Search([*runs.values()], plan, progress, interrupts, programs).run()
        return Results({folder: run.result for folder, run in runs.items()}, interrupts.signum)


@contextlib.contextmanager
def _opened(
    folder: Path, plan: Plan, command: list[str], fresh: bool, voice: Voice
) -> Iterator[Run]:
    with open_run(folder, plan.scene, plan.settings, command, fresh=fresh) as (directory, notes):
        for note in notes:
            voice.message(note)
        with directory.store(tell=voice.message) as store:
            yield Run(plan, directory, store, voice)


class Search:
    """Several runs side by side: seeds, episodes, final tests."""

    def __init__(
        self,
        runs: list[Run],
        plan: Plan,
        progress: Progress,
        interrupts: Interrupts,
        programs: Programs,
    ):
        """Takes runs of one plan, in their open folders; compiles nothing yet."""
        self._runs = runs
        self._plan = plan
        self._task = plan.task
        self._episode = plan.task.side_by_side(plan.optimizer)
        self._compiled: Callable | None = None
        worlds = len(runs) * plan.settings.particles * plan.settings.trials
        # Of every call, so that one program of each task serves.
        self._size = plan.task.call_size(worlds)
        self._rows: list[Run] = []  # runs that are simulated
        self._progress = progress
        self._interrupts = interrupts
        self._programs = programs
        self._seconds = 0.0  # that the last simulation took

    def run(self) -> None:
        """Simulates what is left of the runs, until a signal asks to stop."""
        try:
            self._restore()
            self._find_seeds()
            self._run_episodes()
            self._test()
            self._save()
        except Stopped as stop:
            self._save()
            words = f"stopped by signal {stop.signum}; the same command resumes"
            self._progress.message(words)
            for run in self._going():
                run.log(words)
        except Exception as error:  # of the program that simulates all of them
            for run in self._going():
                run.fail(error)

    def _restore(self) -> None:
        for run in self._runs:
            self._let(run, run.restore)

    def _find_seeds(self) -> None:
        for run in self._going():
            if run.record is None:
                self._let(run, self._find_seed, run)
        self._rows = self._going()

    def _find_seed(self, run: Run) -> None:
        plan = run.plan
        if not needs_poor_seed(plan):
            run.begin(candidates(plan.key, plan.optimizer.space, [0])[0])
            return
        self._progress.begin("looking for a poor seed")
        arguments = {"batch": plan.settings.particles}
        seed, cost, drawn = codesign.seed_search(
            plan.scene, plan.optimizer, plan.key, self._outcomes, **arguments
        )
        start = Start(np.asarray(seed), np.asarray(cost, np.float32), np.asarray(drawn))
        run.begin(seed, start)

    def _outcomes(self, population: jax.Array, key: jax.Array) -> Outcome:
        """Outcomes of one run's particles in the trials of an episode that moves nothing."""
        (outcomes,) = self._tested(self._task, [population], [key])
        return outcomes

    def _tested(
        self,
        task: Task,
        populations: list[Any],
        keys: list[jax.Array],
        advance: Callable[[int], Any] = lambda worlds: None,
    ) -> list[Outcome]:
        """Outcomes of particles in the first trials of these root keys, in calls of a search."""

        def checked(worlds: int) -> None:
            advance(worlds)
            if self._interrupts.signum:
                raise Stopped(self._interrupts.signum)

        def simulate() -> list[Outcome]:
            trials = task.first_trials(jnp.stack(keys))
            particles = np.stack(populations)
            return task.outcomes(particles, trials, size=self._size, advance=checked)

        wait = self._interrupts.begin(simulate)
        self._save()
        return wait()

    def _run_episodes(self) -> None:
        """The loop of Fig. 5; runs that were ahead of the others wait for them.

        Every call has the arrays of all runs, whether or not it is their turn: it is one program,
        and what becomes of a run does not depend on when another one fails.
        """
        self._progress.begin("simulating")
        runs = self._rows
        for e in range(self._plan.settings.episodes):
            group = [run for run in self._going() if run.done == e]
            if not group:
                continue
            # Move, simulate, weigh, resample.
            every = self._simulate([(run.state, run.plan.mask[e]) for run in runs])
            for run, (state, info) in zip(runs, every, strict=True):
                if run in group and run.error is None:
                    run.add(state, info)

    def _test(self) -> None:
        """The final test: the final particles in trials of its own."""
        settings = self._plan.settings
        runs = self._rows
        going = self._going()
        if not going:
            return
        chosen = [finalists(run.plan, np.asarray(run.state.particles)) for run in runs]
        size = max(len(few) for few, _ in chosen)
        particles = [few[np.arange(size) % len(few)] for few, _ in chosen]
        rounds = settings.test_rounds
        keys = [codesign.test_key(run.plan.key, k) for run in runs for k in range(rounds)]
        populations = [few for few in particles for _ in range(rounds)]
        self._programs.wait(RETEST, lambda words: self._progress.begin(words) if words else None)
        self._progress.begin("testing the final particles")
        tests = [
            self._tested(task, populations, keys, self._progress.tested)
            for task in self._plan.tests
        ]
        for i, (run, (_, rows)) in enumerate(zip(runs, chosen, strict=True)):
            if run not in going or run.error is not None:
                continue
            of_run = []
            for parts in tests:
                outcomes = parts[i * rounds : (i + 1) * rounds]
                every = jax.tree.map(lambda *v: np.concatenate(v, axis=1), *outcomes)
                of_run.append(jax.tree.map(lambda v, p=rows: v[p], every))
            self._let(run, run.finish, *of_run)

    def _simulate(
        self, episodes: list[tuple[OptimizerState, np.ndarray]]
    ) -> list[tuple[OptimizerState, EpisodeInfo]]:
        """An episode of each run, from its state and mask: the state after it and the report.

        The results are arrays of NumPy.  The episodes before are saved meanwhile.
        """
        keys = jnp.stack([state.key for state, _ in episodes])
        arrays = [(state._replace(key=None), mask) for state, mask in episodes]  # type: ignore[arg-type]
        states, masks = jax.tree.map(lambda *v: np.stack(v), *arrays)
        states = states._replace(key=keys)
        program = self._program(states, masks)
        start = time.perf_counter()
        wait = self._interrupts.begin(program, states, masks)
        self._save()
        states, infos = wait()
        results = jax.device_get((states._replace(key=None), infos))
        self._seconds = time.perf_counter() - start
        rows = [jax.tree.map(lambda v, r=row: v[r], results) for row in range(len(episodes))]
        return [
            (new._replace(key=state.key), info)
            for (state, _), (new, info) in zip(episodes, rows, strict=True)
        ]

    def _program(self, states: OptimizerState, masks: np.ndarray) -> Callable:
        """Compiles apart from the first call, so that its time is not an episode's."""
        if self._compiled is None:
            text = self._progress.text
            self._progress.begin(self._programs.words())
            with self._programs.first():
                self._compiled = self._interrupts.call(self._episode.compile, states, masks)
            count = self._task.devices
            where = self._task.engine.name + (f", {count} devices" if count > 1 else "")
            name = self._plan.settings.search_accuracy
            where += f", accuracy {name}" if self._plan.retests else ""
            message = f"compiled in {self._programs.seconds:.1f} s (engine {where})"
            self._progress.message(message)
            self._progress.begin(text)
            for run in self._going():
                run.log(message)
            self._programs.begin()
        return self._compiled

    def _save(self) -> None:
        for run in self._runs:
            if run.error is None:
                self._let(run, run.save)
        self._progress.round(self._seconds)

    def _going(self) -> list[Run]:
        """Runs that are neither over nor have failed."""
        return [run for run in self._runs if run.error is None and not run.over]

    def _let(self, run: Run, act: Callable[..., None], *arguments: Any) -> None:
        """Lets a run do something; one that fails ends, and the others go on."""
        try:
            act(*arguments)
        except Stopped:
            raise
        except Exception as error:
            run.fail(error)
