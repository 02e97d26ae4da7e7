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
    """Reports a run's episodes and its final test; use as a context manager."""

    def __init__(
        self,
        total: int,
        *,
        test: int = 0,
        after: float = 0.0,
        console: rich.console.Console | None = None,
    ):
        """Takes what there is to do."""
        self.total, self._test, self._after = total, test, after
        self.console = console or rich.console.Console(highlight=False, soft_wrap=True)
        columns = rich.progress.BarColumn(), rich.progress.TextColumn("{task.description}")
        super().__init__(self.console, *columns, rich.progress.TimeElapsedColumn())
        self._task = self._bar.add_task("", total=None)
        self._watches: list[Stopwatch] = []
        self._seconds, self._grasps, self._tested, self._told = 0.0, 0, 0, 0.0

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

    def episode(
        self,
        done: int,
        *,
        mean: float,
        best: float,
        failed: int,
        grasps: int,
        seconds: float,
        causes: str = "",
        warnings: str = "",
    ) -> str:
        """Reports a finished episode and returns the line."""
        left = (self.total - done) * grasps + self._test + self._after
        pace = self._pace(grasps, seconds, left)
        reasons = f" ({causes})" if causes else ""
        reasons += f"  warnings: {warnings}" if warnings else ""
        count = f"{done:>{len(str(self.total))}}/{self.total}"
        line = (
            f"episode {count}  mean {mean:.3f}  best {best:.3f}  failed {failed}/{grasps}"
            f"{reasons}  {pace}"
        )
        self._show(_Entry(done, mean, best, failed, grasps), line, pace)
        return line

    def tested(self, grasps: int, seconds: float) -> None:
        """Reports a part of the final test."""
        self._tested += grasps
        pace = self._pace(grasps, seconds, max(self._test - self._tested, 0) + self._after)
        line = f"final test {self._tested}/{self._test} grasps  {pace}"
        self._bar.update(self._task, description=line)
        if not self.console.is_terminal and time.monotonic() - self._told >= Ticker.SILENCE:
            self._told = time.monotonic()
            self.message(line)

    def _pace(self, grasps: int, seconds: float, left: float) -> str:
        """Counts grasps that took so long; the rate so far and the time left, in words."""
        self._seconds, self._grasps = self._seconds + seconds, self._grasps + grasps
        self._bar.update(self._task, completed=self._grasps, total=self._grasps + left)
        rate = self._grasps / max(self._seconds, 1e-9)
        return f"{rate:.1f} grasps/s  ETA {duration(left / rate)}"

    def _show(self, entry: "_Entry", line: str, pace: str) -> None:
        """Shows a finished episode."""
        self._bar.update(self._task, description=pace)
        self.message(line)


class _Entry(NamedTuple):
    """What a run reported of an episode."""

    done: int
    mean: float
    best: float
    failed: int
    grasps: int


class GroupProgress(Progress):
    """Progress of several runs at once: a line for all of them after each round."""

    def __init__(
        self,
        total: int,
        runs: int,
        *,
        test: int = 0,
        after: float = 0.0,
        console: rich.console.Console | None = None,
    ):
        """Takes the number of runs; the others are of each run, as of `Progress`."""
        super().__init__(total, test=runs * test, after=runs * after, console=console)
        self._entries: list[_Entry] = []
        self._part = 0

    def one(self, name: str) -> "OneOfMany":
        """The progress of one of the runs."""
        return OneOfMany(self, name)

    def add(self, entry: _Entry) -> None:
        """Takes a run's report of an episode for the line of this round."""
        self._entries.append(entry)

    def tested(self, grasps: int, seconds: float) -> None:
        """Takes a run's report of a part of its final test, which took the round's time."""
        self._part += grasps

    def round(self, seconds: float) -> None:
        """Tells of a round that took so long: its episodes in a line, if any ended in it."""
        entries, self._entries = self._entries, []
        tested, self._part = self._part, 0
        if not entries:
            if tested:
                super().tested(tested, seconds)
            return
        self._tested += tested
        grasps, failed = (sum(getattr(e, k) for e in entries) for k in ("grasps", "failed"))
        first, last = min(e.done for e in entries), max(e.done for e in entries)
        left = (self.total - first) * grasps + max(self._test - self._tested, 0) + self._after
        pace = self._pace(grasps + tested, seconds, left)
        means, bests = ([getattr(e, k) for e in entries] for k in ("mean", "best"))
        count = f"{first:>{len(str(self.total))}}" + (f" to {last}" if last > first else "")
        self._bar.update(self._task, description=pace)
        self.message(
            f"episode {count}/{self.total}  {len(entries)} runs  "
            f"mean {min(means):.3f} to {max(means):.3f}  best {min(bests):.3f} to {max(bests):.3f}"
            f"  failed {failed}/{grasps}  {pace}"
        )


class OneOfMany(Progress):
    """Progress of a run among others: messages with its name; its lines are its log's alone."""

    def __init__(self, group: GroupProgress, name: str):
        """Takes the runs' common progress and what to call this one."""
        super().__init__(group.total, console=group.console)
        self._group, self._name = group, name

    def message(self, text: str) -> None:
        """Prints a line that begins with the run's name."""
        self._group.message(f"{self._name}: {text}")

    def busy(self, text: str) -> "Stopwatch":
        """As of the group."""
        return self._group.busy(text)

    def tested(self, grasps: int, seconds: float) -> None:
        """As of the group."""
        self._group.tested(grasps, seconds)

    def _show(self, entry: _Entry, line: str, pace: str) -> None:
        """Leaves it to the group, which prints one line for all runs of a round."""
        self._group.add(entry)


class Stopwatch:
    """Measures the wall time of a block."""

    seconds, _start, _lap = 0.0, 0.0, 0.0

    def __enter__(self) -> "Stopwatch":
        """Starts."""
        self.restart()
        return self

    def restart(self) -> None:
        """Starts again: what was until now does not count."""
        self._start = time.perf_counter()

    def lap(self) -> float:
        """Seconds since the start or the last lap."""
        before, self._lap = max(self._lap, self._start), time.perf_counter()
        return self._lap - before

    def __exit__(self, *exception: object) -> None:
        """Stops."""
        self.seconds = time.perf_counter() - self._start
