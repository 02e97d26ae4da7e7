"""Runs in their folders, one or many: the episodes that they want are simulated in one batch.

The runs may differ in seed, schedule and first domain.  Each has a folder of its own and may be at
an episode of its own, as after a resumption; one that fails does not stop the others.
"""

import contextlib
import time
from collections.abc import Generator, Mapping
from pathlib import Path
from traceback import format_exception
from typing import Any, NamedTuple

from codesign_jax import codesign
from codesign_jax.batch import LIMIT, Batch, Request
from codesign_jax.compiler.ffi import KernelUnavailable
from codesign_jax.runs.directory import open_run
from codesign_jax.runs.errors import RunError
from codesign_jax.runs.interrupts import Interrupts, Stopped
from codesign_jax.runs.loop import Loop, Plan, RunResult, begin_fetch, variant
from codesign_jax.runs.progress import Progress, Voice
from codesign_jax.runs.settings import Settings

MOST = 100
"""Most runs at once: each holds open files.  More go on when these have ended."""

FAILURES = (OSError, RunError, KernelUnavailable)
"""How a run may fail: what it has cannot be saved, no seed is found, every trial failed, or the
engine cannot run here.

Any other error is unexpected: its traceback is kept.
"""


class Results(NamedTuple):
    """Result of each run by its folder, or why it failed."""

    runs: dict[Path, RunResult | Exception]

    @property
    def signum(self) -> int:
        """Signal that stopped the runs early, or 0."""
        ended = (r.signum for r in self.runs.values() if isinstance(r, RunResult))
        return max(ended, default=0)


def optimize(
    plans: Mapping[Path, Plan],
    command: list[str],
    *,
    fresh: bool = False,
    devices: int | None = None,
    chunk: int | None = None,
    every: int = 1,
    after: float = 0.0,
) -> Results:
    """Runs optimisations, or goes on with them; the same call does both.

    Args:
      plans: Each run by its folder; all are variants of one plan, see `prepare` and `variant`.
      command: Command line to note in the folders.
      fresh: Deletes earlier runs in the folders first.
      devices: Devices that simulate; None for all of this host.
      chunk: Most worlds of one device in one call; None for `batch.LIMIT`.
      every: Episodes between two checkpoints of a run; a killed process repeats what came after.
      after: What the caller simulates of each run afterwards, as a number of its grasps: the time
        left that is shown includes it.

    Raises:
      InputError: If a folder cannot be used; see `open_run`.
      ValueError: If the plans are not variants of one.
    """
    found: dict[Path, RunResult | Exception] = {}
    folders = list(plans)
    for plan in plans.values():
        variant(plans[folders[0]], plan.settings)
    for start in range(0, len(folders), MOST):
        group = {folder: plans[folder] for folder in folders[start : start + MOST]}
        results = _group(group, command, fresh, devices, chunk, every, after)
        found |= results.runs
        if results.signum:
            break
    return Results(found)


def run_names(every: Mapping[Path, Settings]) -> dict[Path, str]:
    """What to call each of several runs: by its seed, and by its schedule if these differ."""
    several = len({own.schedule for own in every.values()}) > 1
    return {
        folder: (f"{own.schedule}, " if several else "") + f"seed {own.seed}"
        for folder, own in every.items()
    }


def _group(
    plans: Mapping[Path, Plan],
    command: list[str],
    fresh: bool,
    devices: int | None,
    chunk: int | None,
    every: int,
    after: float,
) -> Results:
    plan = next(iter(plans.values()))
    called = run_names({folder: own.settings for folder, own in plans.items()})
    with contextlib.ExitStack() as stack:
        ahead = {"test": plan.test_grasps, "after": after}
        progress = Progress(plan.settings.episodes, len(plans), **ahead)
        stack.enter_context(progress)
        loops = {}
        for folder, own in plans.items():
            how = folder, own.scene, own.settings, command
            run, notes = stack.enter_context(open_run(*how, fresh=fresh))
            voice = Voice(progress, called[folder] if len(plans) > 1 else "")
            store = stack.enter_context(run.store(tell=voice.message))
            for note in notes:
                voice.message(note)
            loops[folder] = Loop(own, run, store, voice, every=every)
        interrupts = stack.enter_context(Interrupts(progress.message))
        limit = LIMIT if chunk is None else chunk
        simulator = Batch(plan.task, plan.optimizer, devices=devices, limit=limit)
        return _Together(plan, loops, progress, interrupts, simulator).run()


class _Together:
    """The rounds of several runs."""

    def __init__(
        self,
        plan: Plan,
        loops: Mapping[Path, Loop],
        progress: Progress,
        interrupts: Interrupts,
        batch: Batch,
    ):
        self.plan = plan
        self.loops = loops
        self.progress = progress
        self.interrupts = interrupts
        self.seconds = 0.0
        self.batch = batch
        self.waiting: dict[Path, tuple[Generator, Request]] = {}
        self.found: dict[Path, RunResult | Exception] = {}

    def run(self) -> Results:
        for folder, loop in self.loops.items():
            self._go_on(folder, loop.run(), None)
        try:
            if self.waiting:
                self._compile()
            while self.waiting:
                self._round()
        except Stopped as stop:
            self._throw(stop)
            self.progress.round(self.seconds)
            self.progress.message(f"stopped by signal {stop.signum}; the same command resumes")
        except Exception as error:  # what simulates all of them
            self._throw(error)
        self.progress.round(self.seconds)
        signum = self.interrupts.signum
        ended = {
            folder: r._replace(signum=signum) if isinstance(r, RunResult) else r
            for folder in self.loops
            if (r := self.found.get(folder)) is not None
        }
        return Results(ended)

    def _go_on(self, folder: Path, asking: Generator, reply: Any) -> None:
        try:
            self.waiting[folder] = asking, asking.send(reply)
        except StopIteration as stop:
            self.found[folder] = stop.value
        except Exception as error:
            self._fail(folder, error)

    def _compile(self) -> None:
        """Compiles apart from the first round, so that its time is not an episode's."""
        request = next(iter(self.waiting.values()))[1]
        wanted = self.progress.text
        start = time.perf_counter()
        self.progress.begin("compiling")
        self.interrupts.call(self.batch.compile, request, len(self.waiting))
        if test := self._test(request):
            self.interrupts.call(self.batch.compile, test, len(self.waiting))
        count = len(self.batch.devices)
        engine = self.plan.task.engine.name
        where = f", {count} devices" if count > 1 else ""
        message = f"compiled in {time.perf_counter() - start:.1f} s (engine {engine}{where})"
        self.progress.message(message)
        self.progress.begin(wanted)
        for folder in self.waiting:
            self.loops[folder].run_directory.log(message)

    def _test(self, request: Request) -> Request | None:
        settings = self.plan.settings
        optimizer = self.plan.optimizer
        few = self.plan.finalists
        if settings.test_trials == 0 or few == len(request.state.particles):
            return None
        return Request(*codesign.closed(optimizer, request.state.particles[:few], self.plan.key))

    def _round(self) -> None:
        """One episode of every run that wants one; the episodes before are saved meanwhile."""
        start = time.perf_counter()
        asked = {folder: request for folder, (_, request) in self.waiting.items()}
        answers = self.interrupts.begin(self.batch.begin, list(asked.values()))
        self._save()
        self.progress.round(self.seconds)
        replies = answers()
        begin_fetch(replies)
        for folder, reply in zip(asked, replies, strict=True):
            if folder in self.waiting:
                self._go_on(folder, self.waiting.pop(folder)[0], reply)
        self.seconds = time.perf_counter() - start

    def _save(self) -> None:
        """Saves the last episode of each run; those that cannot be saved end."""
        for folder in list(self.waiting):
            try:
                self.loops[folder].save()
            except Exception as error:
                self.waiting.pop(folder)[0].close()
                self._fail(folder, error)

    def _throw(self, error: Exception) -> None:
        for folder, (asking, _) in self.waiting.items():
            try:
                asking.throw(error)
            except StopIteration as stop:
                self.found[folder] = stop.value
            except Exception as failure:
                self._fail(folder, failure)
        self.waiting = {}

    def _fail(self, folder: Path, error: Exception) -> None:
        """Notes how a run failed; the traceback as well, where it is none of `FAILURES`."""
        self.found[folder] = error
        how = str(error) if isinstance(error, FAILURES) else "".join(format_exception(error))
        with contextlib.suppress(OSError):  # a full disk may be why it failed
            for line in f"failed: {how.rstrip()}".splitlines():
                self.loops[folder].run_directory.log(line)
