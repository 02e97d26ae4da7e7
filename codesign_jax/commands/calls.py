"""Many designs in the same trials, some at a time: progress, and a file from which to go on."""

import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import Progress, TimeRemainingColumn

from codesign_jax import archives, batch, codesign
from codesign_jax.engines import Engine
from codesign_jax.runs import outcomes, rates
from codesign_jax.runs.progress import Ticker, duration
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome

WORLDS = {"cpu": 512}
"""Most worlds of one call by platform: few enough to see progress, enough to fill the cores."""
SECONDS = 10.0
"""Shortest time between lines of progress where there is no terminal for a bar."""


class Trials(NamedTuple):
    """What every design meets.

    Attributes:
      scene: The scene.
      engine: Name of the engine that simulates.
      space: Design space of the designs.
      count: Trials of each design.
      seed: Root of the trials' noise.
    """

    scene: Scene
    engine: str
    space: DesignSpace
    count: int
    seed: int


def most_designs(trials: Trials) -> int:
    """Designs that one call simulates at most."""
    return max(1, WORLDS.get(jax.default_backend(), batch.LIMIT) // trials.count)


def equal(designs: int, most: int) -> int:
    """Designs of each of equal calls: a short last one would be filled up."""
    return -(-designs // -(-designs // most))


def work(trials: Trials, size: int) -> rates.Work:
    """What a call of so many designs is, for estimates."""
    return rates.batch_work(trials.scene, trials.engine, size * trials.count, devices=1)


class Meter:
    """Grasps that were simulated: a live bar on a terminal, elsewhere a line now and then.

    Attributes:
      total: Grasps to simulate, which may become fewer.
      done: Grasps that were simulated.
    """

    def __init__(self, text: str, total: int, console: Console):
        """Takes what is simulated, the number of grasps, and where to tell."""
        self.total, self._text, self._console = total, text, console
        columns = (*Progress.get_default_columns()[:-1], TimeRemainingColumn())
        self._bar = Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        )
        self._task = self._bar.add_task(text, total=total)
        self._ticker = Ticker(disable=console.is_terminal)
        self._ticker.begin(text)
        self.done, self._since, self._told = 0, None, time.monotonic()

    def __enter__(self) -> "Meter":
        """Shows the bar."""
        self._bar.start()
        self._ticker.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        """Removes it."""
        self._ticker.__exit__()
        self._bar.stop()

    def found(self, grasps: int) -> None:
        """Counts grasps that an earlier process simulated."""
        self.done += grasps
        self._bar.update(self._task, completed=self.done, total=self.total)

    def advance(self, grasps: int) -> None:
        """Counts grasps that were just simulated."""
        self.done += grasps
        self._bar.update(self._task, completed=self.done, total=self.total)
        now = time.monotonic()
        self._ticker.rename(f"{self._text}: {self.done} of {self.total} grasps")
        if self._since and not self._console.is_terminal and now - self._told >= SECONDS:
            start, before = self._since
            self._told, rate = now, (self.done - before) / max(now - start, 1e-9)
            left = duration(max(self.total - self.done, 0) / rate)
            self._console.print(
                f"{self._text}: {self.done} of {self.total} grasps, {rate:.1f} grasps/s, "
                f"about {left} left"
            )
            self._ticker.spoke()

    def compiled(self) -> None:
        """Leaves the call before, which compiled, out of the rate."""
        self._since = time.monotonic(), self.done


class Calls:
    """Simulates designs in calls of one size, and keeps the outcomes in a file.

    Asked for the same designs in the same order, another process finds there what was simulated:
    so the same command goes on.

    Attributes:
      found: Designs whose outcomes were there.
      refused: Why outcomes that were there are not taken, in words of which the file is the
        subject; empty if they are.
    """

    def __init__(self, trials: Trials, engine: Engine, size: int, part: Path, designs: np.ndarray):
        """Compiles nothing yet.

        Args:
          trials: What every design meets.
          engine: The engine of that name.
          size: Most designs of a call.
          part: The file; the caller deletes it at the end.
          designs: All designs that may be asked for, shape (design, parameter), which with `trials`
            and `size` determine the outcomes: calls of another size round differently.
        """
        self._trials, self._size, self._part = trials, size, archives.Parts(part)
        how = trials.scene, trials.engine, designs, trials.count, trials.seed
        self._key = f"{outcomes.key(*how)} {size}"
        read = [outcomes.unpacked(arrays, self._key) for arrays in self._part.found]
        self.refused = next((why for _, why in read if why), "")
        kept = [] if self.refused else [outcome for outcome, _ in read if outcome is not None]
        self._part.go_on(len(kept))
        self._kept = joined(kept) if kept else None
        self.found = sum(len(outcome.cost) for outcome in kept)
        self._next, self._seconds = 0, []
        self._evaluate = codesign.make_evaluate(trials.scene, engine, trials.space, trials.count)

    def __call__(self, designs: np.ndarray, meter: Meter) -> Outcome:
        """Outcomes of designs [SI units], arrays of shape (design, trial)."""
        parts = []
        for start in range(0, len(designs), self._size):
            parts.append(self._call(designs[start : start + self._size], meter))
        return joined(parts)

    def _call(self, designs: np.ndarray, meter: Meter) -> Outcome:
        first, self._next = self._next, self._next + len(designs)
        if self._next <= self.found:
            meter.found(len(designs) * self._trials.count)
            return jax.tree.map(lambda v: v[first : self._next], self._kept)
        rows = np.minimum(np.arange(self._size), len(designs) - 1)
        population, start = jnp.asarray(designs[rows], jnp.float32), time.perf_counter()
        every = self._evaluate(population, jax.random.key(self._trials.seed))
        outcome = jax.tree.map(lambda v: np.asarray(v)[: len(designs)], every)
        self._seconds.append(time.perf_counter() - start)
        self._part.append(outcomes.packed(outcome, self._key))
        meter.advance(len(designs) * self._trials.count)
        if len(self._seconds) == 1:
            meter.compiled()
        return outcome

    def record_rate(self) -> None:
        """Keeps what was measured for estimates, if a call compiled and others did not."""
        if len(self._seconds) > 1:
            first, *others = self._seconds
            each = sum(others) / len(others)
            rate = self._size * self._trials.count / each
            rates.record(work(self._trials, self._size), rate, max(first - each, 0.0))


def joined(parts: list[Outcome]) -> Outcome:
    """Outcomes of several calls, one after the other."""
    return jax.tree.map(lambda *v: np.concatenate(v), *parts)
