"""Progress on the terminal: a live bar where there is one, plain lines where not."""

import threading
import time
from typing import NamedTuple, Self

import rich.progress

from codesign_jax.terminal import Console, line, say

SILENCE = 5.0
"""Time without a line after which one is printed, where there is no terminal [s]; each further one
of the same phase comes after twice the time of the one before."""


def duration(seconds: float) -> str:
    """Formats a time as 1:02:03 or 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _description() -> rich.progress.ProgressColumn:
    """What goes on, as it is: names may hold what rich takes for markup."""
    return rich.progress.TextColumn("{task.description}", markup=False)


class Live:
    """A bar where there is a terminal; a context manager.

    Elsewhere, as in the log of a job, a line says what goes on and for how long if nothing else was
    printed for a few seconds: a few lines for each phase, however long it is.
    """

    def __init__(self, console: Console, *columns: rich.progress.ProgressColumn):
        self.console = console
        self._bar = rich.progress.Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        )
        self._task = self._bar.add_task("", total=None)
        self._stop = threading.Event()
        self.text = ""
        self._since = 0.0  # when the phase began
        self._spoken = 0.0  # when the last line was printed
        self._silence = SILENCE  # until the next one
        self._phase = ""

    def __enter__(self) -> Self:
        self._bar.start()
        if not self.console.is_terminal:
            threading.Thread(target=self._run, daemon=True).start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stop.set()
        self._bar.stop()

    def begin(self, text: str) -> None:
        if text != self._phase:  # episodes, of which a run has hundreds, are one phase
            self._silence = SILENCE
        self._phase = text
        self._since = self._spoken = time.monotonic()
        self.say(text)

    def say(self, text: str) -> None:
        """Says more precisely what goes on; its time goes on as well."""
        self.text = line(text)
        self._bar.update(self._task, description=self.text)

    def message(self, text: str) -> None:
        self.console.print(text)
        self._spoken = time.monotonic()

    def tick(self) -> None:
        """Says what goes on if nothing has been said for so long."""
        now = time.monotonic()
        if self.text and now - self._spoken >= self._silence:
            self._spoken = now
            self._silence *= 2
            say(f"{self.text} ({duration(now - self._since)} so far)", error=True)

    def _run(self) -> None:
        while not self._stop.wait(0.2):
            self.tick()


class Busy(Live):
    """Shows that something of unknown progress goes on, and for how long."""

    def __init__(self, console: Console, text: str):
        columns = (
            rich.progress.SpinnerColumn(),
            _description(),
        )
        super().__init__(console, *columns, rich.progress.TimeElapsedColumn())
        self.begin(text)


class Meter(Live):
    """Grasps that were simulated: a live bar on a terminal, elsewhere a line now and then.

    Attributes:
      total: Grasps to simulate, which may become fewer or more.
      done: Grasps that were simulated.
      later: What is simulated after these, in as many of them as take that time.
    """

    def __init__(self, text: str, total: int, console: Console, *, later: float = 0.0):
        columns = rich.progress.Progress.get_default_columns()[1:-1]
        super().__init__(console, _description(), *columns, rich.progress.TimeRemainingColumn())
        self.total = total
        self.done = 0
        self._name = text
        self._compiled = None
        self.later = later
        self.begin("")
        self.compiling("compiling")

    def compiling(self, words: str) -> None:
        """Says by these words that a program is waited for, or "" for none, and what is left."""
        words += ", then " if words else ""
        self.say(f"{self._name}: {words}{self.total - self.done} grasps")

    def count(self, grasps: int) -> None:
        """Counts grasps that an earlier process simulated."""
        self.done += grasps
        self._bar.update(self._task, completed=self.done, total=self.total)

    def advance(self, grasps: int) -> None:
        """Counts grasps that were just simulated; the first call compiled, and has no rate."""
        self.count(grasps)
        now = time.monotonic()
        text = f"{self._name}: {self.done} of {self.total} grasps"
        start, before = self._compiled = self._compiled or (now, self.done)
        if now > start and not self.console.is_terminal:  # the bar says as much
            rate = (self.done - before) / (now - start)
            time_left = duration((max(self.total - self.done, 0) + self.later) / rate)
            text += f", {rate:.1f} grasps/s, about {time_left} left"
        self.say(text)


class Progress(Live):
    """Reports the episodes and final tests of one or several runs, a line a round for all of them.

    Each run speaks by its `Voice`.
    """

    def __init__(self, total: int, runs: int = 1, *, test: int = 0, after: float = 0.0):
        columns = (
            rich.progress.BarColumn(),
            _description(),
        )
        super().__init__(Console(), *columns, rich.progress.TimeElapsedColumn())
        self.total = total
        self._test = runs * test
        self._after = runs * after
        self._reports: list[Report] = []
        self._seconds = 0.0
        self._grasps = 0.0
        self._part = 0
        self._tested = 0
        self._done = 0

    def add(self, report: "Report") -> None:
        """Takes a run's report of an episode for the line of this round."""
        self._reports.append(report)

    def tested(self, grasps: int) -> None:
        """Takes a part of a run's final test for the line of this round."""
        self._part += grasps

    def round(self, seconds: float) -> None:
        """Tells of a round that took so long: its episodes in a line, or its part of the test."""
        reports = self._reports
        self._reports = []
        tested = self._part
        self._part = 0
        self._tested += tested
        remaining = max(self._test - self._tested, 0) + self._after
        if reports:
            grasps = sum(r.grasps for r in reports)
            first = min(r.done for r in reports)
            pace = self._pace(grasps + tested, seconds, remaining + (self.total - first) * grasps)
            self.message(f"{self._line(reports, first, grasps)}  {pace}")
            self._bar.update(self._task, description=pace)
        elif tested:
            pace = self._pace(tested, seconds, remaining)
            words = f"final test {self._tested}/{self._test} grasps  {pace}"
            self.say(words)

    def _line(self, reports: "list[Report]", first: int, grasps: int) -> str:
        if len(reports) == 1:
            return reports[0].line(self.total)
        last = max(r.done for r in reports)
        failed = sum(r.failed for r in reports)
        means, bests = ([getattr(r, k) for r in reports] for k in ("mean", "best"))
        count = f"{first:>{len(str(self.total))}}" + (f" to {last}" if last > first else "")
        return (
            f"episode {count}/{self.total}  {len(reports)} runs  "
            f"mean {min(means):.3f} to {max(means):.3f}  best {min(bests):.3f} to {max(bests):.3f}"
            f"  failed {failed}/{grasps}"
        )

    def _pace(self, grasps: int, seconds: float, remaining: float) -> str:
        """Counts grasps that took so long; their rate of late and the time left, in words."""
        self._done += grasps
        self._bar.update(self._task, completed=self._done, total=self._done + remaining)
        # A search begins with hands that lose their objects, which ends a grasp early.
        self._seconds = 0.8 * self._seconds + seconds
        self._grasps = 0.8 * self._grasps + grasps
        rate = self._grasps / max(self._seconds, 1e-9)
        return f"{rate:.1f} grasps/s  ETA {duration(remaining / rate)}"


class Report(NamedTuple):
    """What a run tells of a finished episode: its number, costs, and how its grasps ended."""

    done: int
    mean: float
    best: float
    failed: int
    grasps: int
    causes: str = ""
    warnings: str = ""

    def line(self, total: int) -> str:
        line = f"episode {self.done:>{len(str(total))}}/{total}  mean {self.mean:.3f}  "
        line += f"best {self.best:.3f}  failed {self.failed}/{self.grasps}"
        line += f" ({self.causes})" if self.causes else ""
        return line + (f"  warnings: {self.warnings}" if self.warnings else "")


class Voice:
    """What one of the runs says; its name precedes its messages where there are several."""

    def __init__(self, progress: Progress, name: str = ""):
        self._progress = progress
        self._name = f"{name}: " if name else ""
        self.begin = progress.begin
        self.tested = progress.tested

    def message(self, text: str) -> None:
        self._progress.message(f"{self._name}{text}")

    def episode(self, report: Report) -> str:
        """Reports a finished episode and returns the line."""
        self._progress.add(report)
        return report.line(self._progress.total)
