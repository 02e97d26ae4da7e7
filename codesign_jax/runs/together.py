"""Runs in their folders, one or many: the episodes that they want are simulated in one batch.

The runs differ in their seed only.  Each has a folder of its own and may be at an episode of its
own, as after a resumption; one that fails does not stop the others.
"""

import contextlib
import time
from collections.abc import Generator, Iterable, Mapping
from pathlib import Path
from traceback import format_exception
from typing import Any, NamedTuple

from codesign_jax.batch import LIMIT, Batch, Request
from codesign_jax.runs.directory import open_run
from codesign_jax.runs.errors import RunError
from codesign_jax.runs.interrupts import Interrupts, Stopped
from codesign_jax.runs.loop import Loop, Plan, RunResult, begin_fetch, with_seed
from codesign_jax.runs.progress import GroupProgress, Progress

MOST = 100
"""Most runs at once: each holds open files.  More go on when these have ended."""

FAILURES = (OSError, RunError)
"""How a run may fail: what it has cannot be saved, no seed is found, or every trial failed.

Any other error is unexpected: its traceback is kept.
"""


class Timing(NamedTuple):
    """What the runs took.

    Attributes:
      compile_seconds: Compiling the episode; 0 if there was nothing to simulate.
      seconds: Simulations with the saving in between.
      grasps: Grasps of these.
      runs: Runs that were simulated at once.
    """

    compile_seconds: float = 0.0
    seconds: float = 0.0
    grasps: int = 0
    runs: int = 1


class Results(NamedTuple):
    """How runs ended.

    Attributes:
      runs: Result of each run by its seed, or why it failed.
      timing: What they took; with more than `MOST` runs that of the first ones.
    """

    runs: dict[int, RunResult | Exception]
    timing: Timing

    @property
    def signum(self) -> int:
        """Signal that stopped the runs early, or 0."""
        ended = (r.signum for r in self.runs.values() if isinstance(r, RunResult))
        return max(ended, default=0)


def optimize(
    plan: Plan,
    folders: Mapping[int, Path],
    command: list[str],
    *,
    fresh: bool = False,
    sources: Iterable[Path] = (),
    devices: int | None = None,
    chunk: int | None = None,
    after: float = 0.0,
) -> Results:
    """Runs an optimisation of each seed, or goes on with it; the same call does both.

    Args:
      plan: The runs, whatever its seed; see `prepare`.
      folders: Run folder of each seed.
      command: Command line to note in the folders.
      fresh: Deletes earlier runs in the folders first.
      sources: Files that the scene was read from, which `fresh` must not delete.
      devices: Devices that simulate; None for all of this host.
      chunk: Most worlds of one device in one call; None for `batch.LIMIT`.
      after: What the caller simulates of each run afterwards, as a number of its grasps: the time
        left that is shown includes it.

    Raises:
      SceneError: If a folder cannot be used; see `open_run`.
    """
    found: dict[int, RunResult | Exception] = {}
    timing, seeds = None, list(folders)
    begun = {"fresh": fresh, "sources": tuple(sources)}
    for start in range(0, len(seeds), MOST):
        group = {seed: folders[seed] for seed in seeds[start : start + MOST]}
        results = _group(plan, group, command, begun, devices, chunk, after)
        found |= results.runs
        timing = timing or results.timing
        if results.signum:
            break
    return Results(found, timing or Timing())


def _group(
    plan: Plan,
    folders: Mapping[int, Path],
    command: list[str],
    begun: dict[str, Any],
    devices: int | None,
    chunk: int | None,
    after: float,
) -> Results:
    """`optimize` of as many runs as fit into one process; `begun` is how to open the folders."""
    settings, many = plan.settings, len(folders) > 1
    batch = settings.particles * settings.trials
    ahead = {"test": batch * settings.test_rounds, "after": after}
    with contextlib.ExitStack() as stack:
        total = settings.episodes
        progress = GroupProgress(total, len(folders), **ahead) if many else Progress(total, **ahead)
        stack.enter_context(progress)
        loops = {}
        for seed, folder in folders.items():
            own = with_seed(plan, seed)
            how = folder, own.scene, own.settings, command
            run, notes = stack.enter_context(open_run(*how, **begun))
            voice = (
                progress.one(f"seed {seed}") if isinstance(progress, GroupProgress) else progress
            )
            store = stack.enter_context(run.store(tell=voice.message))
            for note in notes:
                voice.message(note)
            loops[seed] = Loop(own, run, store, voice)
        interrupts = stack.enter_context(Interrupts(progress.message))
        simulator = _batch(plan, devices, chunk)
        return _Together(plan, loops, progress, interrupts, simulator).run()


def _batch(plan: Plan, devices: int | None, chunk: int | None) -> Batch:
    """What simulates the runs' episodes."""
    how = plan.scene, plan.engine, plan.space, plan.optimizer, plan.settings.trials
    most = LIMIT if chunk is None else chunk
    judged = {"trajectory": plan.trajectory, "cost": plan.cost}
    return Batch(*how, devices=devices, limit=most, **judged)


class _Together:
    """The rounds of several runs."""

    def __init__(
        self,
        plan: Plan,
        loops: Mapping[int, Loop],
        progress: Progress,
        interrupts: Interrupts,
        batch: Batch,
    ):
        self.plan, self.loops, self.progress = plan, loops, progress
        self.interrupts, self.timing, self.seconds = interrupts, Timing(), 0.0
        self.batch = batch
        self.waiting: dict[int, tuple[Generator, Request]] = {}
        self.found: dict[int, RunResult | Exception] = {}

    def run(self) -> Results:
        for seed, loop in self.loops.items():
            self._go_on(seed, loop.run(), None)
        try:
            if self.waiting:
                self._compile()
            while self.waiting:
                self._round()
        except Stopped as stop:
            self._throw(stop)
            self._show()
            self.progress.message(f"stopped by signal {stop.signum}; the same command resumes")
        except Exception as error:  # what simulates all of them
            self._throw(error)
        self._show()
        signum = self.interrupts.signum
        ended = {
            seed: r._replace(signum=signum) if isinstance(r, RunResult) else r
            for seed, r in sorted(self.found.items())
        }
        return Results(ended, self.timing)

    def _go_on(self, seed: int, asking: Generator, reply: Any) -> None:
        """Lets a run go on until it wants another episode or ends."""
        try:
            self.waiting[seed] = asking, asking.send(reply)
        except StopIteration as stop:
            self.found[seed] = stop.value
        except Exception as error:
            self._fail(seed, error)

    def _compile(self) -> None:
        """Compiles apart from the first round, so that its time is not an episode's."""
        request = next(iter(self.waiting.values()))[1]
        with self.progress.busy("compiling") as watch:
            self.interrupts.call(self.batch.compile, request, len(self.waiting))
        count, engine = len(self.batch.devices), self.plan.engine.name
        where = f", {count} devices" if count > 1 else ""
        message = f"compiled in {watch.seconds:.1f} s (engine {engine}{where})"
        self.progress.message(message)
        self.progress.compiled()
        for seed in self.waiting:
            self.loops[seed].run_directory.log(message)
        self.timing = Timing(watch.seconds, runs=len(self.waiting))

    def _round(self) -> None:
        """One episode of every run that wants one; the episodes before are saved meanwhile."""
        start = time.perf_counter()
        asked = {seed: request for seed, (_, request) in self.waiting.items()}
        answers = self.interrupts.begin(self.batch.begin, list(asked.values()))
        self._save()
        self._show()
        replies = answers()
        begin_fetch(replies)
        for seed, reply in zip(asked, replies, strict=True):
            if seed in self.waiting:
                self._go_on(seed, self.waiting.pop(seed)[0], reply)
        self.seconds = time.perf_counter() - start
        grasps = self.plan.settings.particles * self.plan.settings.trials * len(asked)
        self.timing = self.timing._replace(
            seconds=self.timing.seconds + self.seconds, grasps=self.timing.grasps + grasps
        )

    def _save(self) -> None:
        """Saves the last episode of each run; those that cannot be saved end."""
        for seed in list(self.waiting):
            try:
                self.loops[seed].save()
            except Exception as error:
                self.waiting.pop(seed)[0].close()
                self._fail(seed, error)

    def _show(self) -> None:
        """Reports what was saved since the last round."""
        if isinstance(self.progress, GroupProgress):
            self.progress.round(self.seconds)

    def _throw(self, error: Exception) -> None:
        """Ends every run that still waits."""
        for seed, (asking, _) in self.waiting.items():
            try:
                asking.throw(error)
            except StopIteration as stop:
                self.found[seed] = stop.value
            except Exception as failure:
                self._fail(seed, failure)
        self.waiting = {}

    def _fail(self, seed: int, error: Exception) -> None:
        """Notes how a run failed; the traceback as well, where it is none of `FAILURES`."""
        self.found[seed] = error
        how = str(error) if isinstance(error, FAILURES) else "".join(format_exception(error))
        with contextlib.suppress(OSError):  # a full disk may be why it failed
            self.loops[seed].run_directory.log(f"failed: {how.rstrip()}")
