"""Progress on the terminal: a live bar where there is one, plain lines where not."""

import time
from typing import NamedTuple

import rich.console
import rich.progress


def duration(seconds: float) -> str:
    """Formats a time as 1:02:03 or 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Progress:
    """Reports a run's episodes; use as a context manager."""

    def __init__(self, total: int, *, console: rich.console.Console | None = None):
        """Takes the number of episodes."""
        self.total = total
        self.console = console or rich.console.Console(highlight=False, soft_wrap=True)
        columns = (
            rich.progress.BarColumn(),
            rich.progress.TextColumn("{task.description}"),
            rich.progress.TimeElapsedColumn(),
        )
        self._bar = rich.progress.Progress(
            *columns, console=self.console, transient=True, disable=not self.console.is_terminal
        )
        self._task = self._bar.add_task("", total=total)
        self._seconds, self._grasps = 0.0, 0

    def __enter__(self) -> "Progress":
        """Starts the bar."""
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Removes the bar; the lines stay."""
        self._bar.stop()

    def message(self, text: str) -> None:
        """Prints a line above the bar."""
        self.console.print(text, markup=False)

    def busy(self, text: str) -> "Stopwatch":
        """Shows what goes on while a block runs, and measures it."""
        self._bar.update(self._task, description=text)
        return Stopwatch()

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
        """Reports a finished episode and returns the line.

        Args:
          done: Episodes finished, with those of earlier processes.
          mean: Mean particle cost.
          best: Lowest particle cost.
          failed: Failed worlds among the episode's grasps.
          grasps: Grasps of the episode.
          seconds: Wall time of the episode.
          causes: How often each cause of failure occurs, such as "SPEED 1, STUCK 3".
          warnings: How often each warning occurs, such as "SOLVER_CAP 3".
        """
        pace = self._pace(done, grasps, seconds)
        reasons = f" ({causes})" if causes else ""
        reasons += f"  warnings: {warnings}" if warnings else ""
        count = f"{done:>{len(str(self.total))}}/{self.total}"
        line = (
            f"episode {count}  mean {mean:.3f}  best {best:.3f}  failed {failed}/{grasps}"
            f"{reasons}  {pace}"
        )
        self._show(_Entry(done, mean, best, failed, grasps), line, pace)
        return line

    def _pace(self, done: int, grasps: int, seconds: float) -> str:
        """Counts grasps that took so long; the rate so far and the time left, in words."""
        self._seconds, self._grasps = self._seconds + seconds, self._grasps + grasps
        rate = self._grasps / max(self._seconds, 1e-9)
        left = duration((self.total - done) * grasps / rate)
        return f"{rate:.1f} grasps/s  ETA {left}"

    def _show(self, entry: "_Entry", line: str, pace: str) -> None:
        """Shows a finished episode."""
        self._bar.update(self._task, completed=entry.done, description=pace)
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

    def __init__(self, total: int, *, console: rich.console.Console | None = None):
        """Takes the number of episodes of each run."""
        super().__init__(total, console=console)
        self._entries: list[_Entry] = []

    def one(self, name: str) -> "OneOfMany":
        """The progress of one of the runs."""
        return OneOfMany(self, name)

    def add(self, entry: _Entry) -> None:
        """Takes a run's report of an episode for the line of this round."""
        self._entries.append(entry)

    def round(self, seconds: float) -> None:
        """Prints the line of a round that took so long; nothing if no episode ended in it."""
        entries, self._entries = self._entries, []
        if not entries:
            return
        grasps, failed = (sum(getattr(e, k) for e in entries) for k in ("grasps", "failed"))
        first, last = min(e.done for e in entries), max(e.done for e in entries)
        pace = self._pace(first, grasps, seconds)
        means, bests = ([getattr(e, k) for e in entries] for k in ("mean", "best"))
        count = f"{first:>{len(str(self.total))}}" + (f" to {last}" if last > first else "")
        self._bar.update(self._task, completed=first, description=pace)
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

    def _show(self, entry: _Entry, line: str, pace: str) -> None:
        """Leaves it to the group, which prints one line for all runs of a round."""
        self._group.add(entry)


class Stopwatch:
    """Measures the wall time of a block."""

    seconds = 0.0

    def __enter__(self) -> "Stopwatch":
        """Starts."""
        self._start = time.perf_counter()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stops."""
        self.seconds = time.perf_counter() - self._start
