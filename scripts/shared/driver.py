"""Runs an experiment step by step: resumes, saves, reports, and stops in time."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from codesign_jax.runs.interrupts import Interrupts, Stopped
from codesign_jax.runs.progress import duration
from scripts.shared import record as records
from scripts.shared.record import Arrays

# Seconds between two saves where no number of steps is given: saving takes about one.
_SAVE_SECONDS = 20.0


class Experiment(Protocol):
    """What can be driven: `Batch` or `Grid`."""

    steps: int

    def start(self) -> Arrays:
        """Returns the record before the first step."""
        ...

    def step(self, record: Arrays) -> str:
        """Advances the record by one step."""
        ...

    def grasps(self, step: int) -> int:
        """Grasps of a step."""
        ...


@dataclasses.dataclass(frozen=True)
class Stop:
    """When to save and stop.

    Attributes:
      every: Steps between two saves; None saves by time.
      minutes: Time after which no step begins that would not end in it; None for no limit.
    """

    every: int | None = None
    minutes: float | None = None


@dataclasses.dataclass
class Drive:
    """How a process's part of an experiment went.

    Attributes:
      record: The record.
      finished: Whether all steps are done.
      grasps: Grasps of this process, without those of the seeds.
      seconds: Wall time of this process, compilation included.
      first_seconds: Its first step or the seeds' screening, whichever came first: with compilation.
      rate: Grasps per second of the steps after that.
    """

    record: Arrays
    finished: bool
    grasps: int
    seconds: float
    first_seconds: float
    rate: float

    @property
    def screened(self) -> int:
        """Grasps that screened the seeds."""
        return int(self.record.get("screened", 0))

    @property
    def total_seconds(self) -> float:
        """Wall time of all processes up to the last save."""
        return float(self.record["seconds"])

    @property
    def processes(self) -> int:
        """Processes that the experiment took."""
        return int(self.record["processes"])


def drive(
    experiment: Experiment,
    path: Path,
    settings: dict[str, object],
    *,
    stop: Stop = Stop(),  # noqa: B008 - frozen
    say: Callable[[str], None] = print,
) -> Drive:
    """Runs what is left of an experiment; the same call starts and resumes it.

    Args:
      experiment: The experiment.
      path: State file.
      settings: What a state must belong to; see `record.load`.
      stop: When to save and stop.
      say: Told one line a step.

    Raises:
      StateError: If the state file cannot be used.
    """
    begin = time.perf_counter()
    record = records.load(path, settings) if path.exists() else None
    if record is not None:
        say(f"resuming after step {int(record['step'])}/{experiment.steps} from {path}")
    with Interrupts(say) as interrupts:
        return _Loop(experiment, path, settings, stop, say, interrupts, begin).run(record)


@dataclasses.dataclass
class _Loop:
    experiment: Experiment
    path: Path
    settings: dict[str, object]
    stop: Stop
    say: Callable[[str], None]
    interrupts: Interrupts
    begin: float
    first: float = 0.0
    longest: float = 0.0
    grasps: int = 0
    busy: float = 0.0
    counted: int = 0
    before: float = 0.0
    saved: float = dataclasses.field(default_factory=time.perf_counter)

    def run(self, record: Arrays | None) -> Drive:
        record = {} if record is None else record
        left = int(record.get("step", 0)) < self.experiment.steps
        self.before = float(record.get("seconds", 0.0))
        try:
            if not record:
                record = self._start()
            if left:
                record["processes"] = record["processes"] + 1
            while int(record["step"]) < self.experiment.steps and self._in_time():
                self._step(record)
        except Stopped:
            self.say("stopped by a signal; the same command resumes")
        if record and left:
            self._save(record)
        finished = bool(record) and int(record["step"]) >= self.experiment.steps
        rate = self.counted / max(self.busy, 1e-9)
        return Drive(record, finished, self.grasps, self._elapsed(), self.first, rate)

    def _start(self) -> Arrays:
        record = self.interrupts.call(self.experiment.start)
        self.first = self._elapsed()
        record |= {"seconds": np.float64(0), "processes": np.int64(0)}
        self.say(f"seeds and compilation: {self.first:.1f} s")
        self._save(record)
        return record

    def _step(self, record: Arrays) -> None:
        step, before = int(record["step"]), time.perf_counter()
        text = self.interrupts.call(self.experiment.step, record)
        seconds = time.perf_counter() - before
        self.grasps += self.experiment.grasps(step)
        if not self.first:  # a resumed process compiles in its first step
            self.first = seconds
        else:
            self.busy += seconds
            self.counted += self.experiment.grasps(step)
            self.longest = max(self.longest, seconds)
        self.say(f"{step + 1:>3}/{self.experiment.steps}  {self._rate(step, seconds)}  {text}")
        if self._due(step + 1):
            self._save(record)

    def _rate(self, step: int, seconds: float) -> str:
        rate = self.experiment.grasps(step) / max(seconds, 1e-9)
        left = sum(self.experiment.grasps(s) for s in range(step + 1, self.experiment.steps))
        return f"{rate:,.0f} grasps/s  ETA {duration(left / rate)}"

    def _due(self, done: int) -> bool:
        if self.stop.every is not None:
            return done % self.stop.every == 0
        return time.perf_counter() - self.saved > _SAVE_SECONDS

    def _in_time(self) -> bool:
        if self.stop.minutes is None:
            return True
        return self._elapsed() + 1.5 * self.longest < 60 * self.stop.minutes

    def _save(self, record: Arrays) -> None:
        record["seconds"] = np.float64(self.before + self._elapsed())
        records.save(self.path, record, self.settings)
        self.saved = time.perf_counter()

    def _elapsed(self) -> float:
        return time.perf_counter() - self.begin
