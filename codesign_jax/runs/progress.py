"""Progress on the terminal: a live bar where there is one, plain lines where not.

Where there is no terminal, a line on the standard error reports what goes on and for how long,
whenever nothing else was printed for a few seconds.
"""

import sys
import threading
import time
from typing import NamedTuple, Self

import rich.console
import rich.progress


def duration(seconds: float) -> str:
    """Formats a time as 1:02:03 or 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Ticker:
    """Says on the standard error what goes on, when nothing has been said for a while."""

    SILENCE = 5.0
    """Time without a line after which one is printed [s]."""

    def __init__(self, *, disable: bool = False):
        """Starts nothing yet; with `disable` it never says anything."""
        self._disable, self._stop = disable, threading.Event()
        self._text = ""
        self._since, self._spoken = 0.0, 0.0

    def __enter__(self) -> "Ticker":
        """Starts."""
        if not self._disable:
            threading.Thread(target=self._run, daemon=True).start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stops."""
        self._stop.set()

    def begin(self, text: str) -> None:
        """Something else goes on from now."""
        self._text, self._since = text, time.monotonic()
        self.spoke()

    def rename(self, text: str) -> None:
        """What goes on since `begin` has another name."""
        self._text = text

    def spoke(self) -> None:
        """Something was said by somebody else."""
        self._spoken = time.monotonic()

    def tick(self) -> None:
        """Says what goes on if nothing has been said for so long."""
        now = time.monotonic()
        if self._text and now - self._spoken >= self.SILENCE:
            self._spoken = now
            words = f"{self._text}: {duration(now - self._since)}"
            print(words, file=sys.stderr, flush=True)

    def _run(self) -> None:
        while not self._stop.wait(0.2):
            self.tick()


class Live:
    """A bar where there is a terminal, else lines on the standard error; a context manager."""

    def __init__(self, console: rich.console.Console, *columns: rich.progress.ProgressColumn):
        """Takes where to tell, and the bar's columns."""
        self._bar = rich.progress.Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        )
        self._ticker = Ticker(disable=console.is_terminal)

    def __enter__(self) -> Self:
        """Shows the bar."""
        self._bar.start()
        self._ticker.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        """Removes it; lines stay."""
        self._ticker.__exit__()
        self._bar.stop()


class Busy(Live):
    """Shows that something of unknown progress goes on, and for how long; a context manager."""

    def __init__(self, console: rich.console.Console, text: str):
        """Takes what goes on."""
        columns = rich.progress.SpinnerColumn(), rich.progress.TextColumn("{task.description}")
        super().__init__(console, *columns, rich.progress.TimeElapsedColumn())
        self._ticker.begin(text)
        self._task = self._bar.add_task(text, total=None)

    def say(self, text: str) -> None:
        """Says more precisely what goes on; its time goes on as well."""
        self._ticker.rename(text)
        self._bar.update(self._task, description=text)


class Progress(Live):
    """Reports the episodes and final tests of one or several runs, a line a round for all of them.

    A context manager; each run speaks by its `Voice`.
    """

    def __init__(
        self,
        total: int,
        runs: int = 1,
        *,
        test: int = 0,
        after: float = 0.0,
        console: rich.console.Console | None = None,
    ):
        """Takes episodes, grasps of the test and of what comes afterwards, of each of the runs."""
        self.total, self._test, self._after = total, runs * test, runs * after
        self.console = console or rich.console.Console(highlight=False, soft_wrap=True)
        columns = rich.progress.BarColumn(), rich.progress.TextColumn("{task.description}")
        super().__init__(self.console, *columns, rich.progress.TimeElapsedColumn())
        self._task = self._bar.add_task("", total=None)
        self._watches: list[Stopwatch] = []
        self._entries: list[_Entry] = []
        self._seconds, self._grasps, self._told = 0.0, 0, 0.0
        self._part, self._tested = 0, 0

    def message(self, text: str) -> None:
        """Prints a line above the bar."""
        self.console.print(text, markup=False)
        self._ticker.spoke()

    def busy(self, text: str) -> "Stopwatch":
        """Shows what goes on while a block runs, and measures it."""
        self._bar.update(self._task, description=text)
        self._ticker.begin(text)
        watch = Stopwatch()
        self._watches = [w for w in self._watches if not w.seconds] + [watch]
        return watch

    def compiled(self) -> None:
        """Leaves the time so far out of what is being measured: it was not for simulating."""
        for watch in self._watches:
            watch.restart()

    def add(self, entry: "_Entry") -> None:
        """Takes a run's report of an episode for the line of this round."""
        self._entries.append(entry)

    def tested(self, grasps: int) -> None:
        """Takes a part of a run's final test for the line of this round."""
        self._part += grasps

    def round(self, seconds: float) -> None:
        """Tells of a round that took so long: its episodes in a line, or its part of the test."""
        entries, self._entries = self._entries, []
        tested, self._part = self._part, 0
        self._tested += tested
        left = max(self._test - self._tested, 0) + self._after
        if entries:
            grasps, first = sum(e.grasps for e in entries), min(e.done for e in entries)
            pace = self._pace(grasps + tested, seconds, left + (self.total - first) * grasps)
            self.message(f"{self._line(entries, first, grasps)}  {pace}")
            self._bar.update(self._task, description=pace)
        elif tested:
            pace = self._pace(tested, seconds, left)
            line = f"final test {self._tested}/{self._test} grasps  {pace}"
            self._bar.update(self._task, description=line)
            if not self.console.is_terminal and time.monotonic() - self._told >= Ticker.SILENCE:
                self._told = time.monotonic()
                self.message(line)

    def _line(self, entries: "list[_Entry]", first: int, grasps: int) -> str:
        if len(entries) == 1:
            return entries[0].line
        last, failed = max(e.done for e in entries), sum(e.failed for e in entries)
        means, bests = ([getattr(e, k) for e in entries] for k in ("mean", "best"))
        count = f"{first:>{len(str(self.total))}}" + (f" to {last}" if last > first else "")
        return (
            f"episode {count}/{self.total}  {len(entries)} runs  "
            f"mean {min(means):.3f} to {max(means):.3f}  best {min(bests):.3f} to {max(bests):.3f}"
            f"  failed {failed}/{grasps}"
        )

    def _pace(self, grasps: int, seconds: float, left: float) -> str:
        """Counts grasps that took so long; the rate so far and the time left, in words."""
        self._seconds, self._grasps = self._seconds + seconds, self._grasps + grasps
        self._bar.update(self._task, completed=self._grasps, total=self._grasps + left)
        rate = self._grasps / max(self._seconds, 1e-9)
        return f"{rate:.1f} grasps/s  ETA {duration(left / rate)}"


class _Entry(NamedTuple):
    """What a run reported of an episode."""

    line: str
    done: int
    mean: float
    best: float
    failed: int
    grasps: int


class Voice:
    """What one of the runs says; its name precedes its messages where there are several."""

    def __init__(self, progress: Progress, name: str = ""):
        """Takes the runs' common progress and what to call this one."""
        self._progress, self._name = progress, f"{name}: " if name else ""
        self.busy, self.tested = progress.busy, progress.tested

    def message(self, text: str) -> None:
        """Prints a line that begins with the run's name."""
        self._progress.message(f"{self._name}{text}")

    def episode(
        self,
        done: int,
        *,
        mean: float,
        best: float,
        failed: int,
        grasps: int,
        causes: str = "",
        warnings: str = "",
    ) -> str:
        """Reports a finished episode and returns the line."""
        total = self._progress.total
        line = f"episode {done:>{len(str(total))}}/{total}  mean {mean:.3f}  best {best:.3f}"
        line += f"  failed {failed}/{grasps}" + (f" ({causes})" if causes else "")
        line += f"  warnings: {warnings}" if warnings else ""
        self._progress.add(_Entry(line, done, mean, best, failed, grasps))
        return line


class Stopwatch:
    """Measures the wall time of a block."""

    seconds, _start = 0.0, 0.0

    def __enter__(self) -> "Stopwatch":
        """Starts."""
        self.restart()
        return self

    def restart(self) -> None:
        """Starts again: what was until now does not count."""
        self._start = time.perf_counter()

    def __exit__(self, *exception: object) -> None:
        """Stops."""
        self.seconds = time.perf_counter() - self._start
