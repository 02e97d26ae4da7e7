"""Sizes of the experiments (paper Secs. VI.3 to VI.5)."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from codesign_jax.optimize import schedule


@dataclasses.dataclass(frozen=True)
class Strategies:
    """Optimisation strategies compared over many runs (Figs. 7 and 9).

    Attributes:
      name: Name of the experiment.
      preset: Design space of the hand.
      strategies: Names for `optimize.schedule`.
      runs: Runs of each strategy; run r has the root key `seed + r` in every strategy.
      particles: Particles of a run.
      episodes: Episodes of a run.
      trials: Trials of a particle in an episode.
      test_trials: Further trials of each final particle, a multiple of `trials`.
    """

    name: str
    preset: str
    strategies: tuple[str, ...]
    runs: int
    particles: int
    episodes: int
    trials: int
    test_trials: int

    def __post_init__(self) -> None:
        """Checks the sizes."""
        if self.test_trials % self.trials:
            raise ValueError(f"{self.test_trials=} must be a multiple of {self.trials=}")

    @property
    def rounds(self) -> int:
        """Rounds of `trials` trials that the final test takes."""
        return self.test_trials // self.trials

    @property
    def num_runs(self) -> int:
        """Runs of all strategies."""
        return len(self.strategies) * self.runs

    @property
    def worlds(self) -> int:
        """Grasps of one episode, or of one round of the final test, over all runs."""
        return self.num_runs * self.particles * self.trials

    @property
    def grasps(self) -> int:
        """Grasps of episodes and final tests, without those that screen the seeds."""
        return self.worlds * (self.episodes + self.rounds)

    def first(self) -> tuple[str, ...]:
        """Domain in which each run starts: either one in turn, so equally often (Sec. VI.4)."""
        return tuple(("morphology", "control")[r % 2] for r in range(self.runs))


@dataclasses.dataclass(frozen=True)
class Landscape:
    """The cost on a grid over a design space of two parameters (Fig. 8).

    Attributes:
      name: Name of the experiment.
      preset: Design space of the hand, of two parameters.
      points: Grid points along either parameter, bounds included.
      trials: Trials of each point; every point meets the same ones.
    """

    name: str
    preset: str
    points: int
    trials: int

    @property
    def grasps(self) -> int:
        """Grasps of the experiment."""
        return self.points**2 * self.trials


SWITCHES = tuple(f"switch-{k}" for k in (1, 2, 4, 8, 16, 32))

_TWO = Strategies("2d", "2d", ("single", *SWITCHES, "concurrent"), 30, 10, 64, 6, 36)
_MANY = Strategies("23d", "23d", ("single", "switch-1", "concurrent"), 30, 60, 128, 6, 72)
PAPER: dict[str, Strategies | Landscape] = {
    "2d": _TWO,
    "23d": _MANY,
    "landscape": Landscape("landscape", "2d", 60, 36),
}

PAPER_GRASPS = {"2d": 1_008_000, "landscape": 129_600, "23d": 4_536_000}
"""The paper's counts; its 1,000,800 in 2D is a digit swap, see docs/notes/results.md."""
TOTAL_GRASPS = sum(PAPER_GRASPS.values())

_FEW = ("single", "switch-1", "switch-4", "concurrent")
# Two links and few runs: the whole path in seconds.  Four links: some minutes on two cores.
SMALL: dict[str, dict[str, Strategies | Landscape]] = {
    "tiny": {
        "2d": Strategies("2d", "2d", ("single", "concurrent"), 2, 2, 2, 3, 3),
        "23d": Strategies("23d", "23d", ("single", "concurrent"), 2, 2, 2, 3, 3),
        "landscape": Landscape("landscape", "2d", 2, 3),
    },
    "cpu": {
        "2d": Strategies("2d", "2d", _FEW, 4, 6, 16, 3, 6),
        "23d": Strategies("23d", "23d", ("single", "concurrent"), 2, 12, 16, 3, 6),
        "landscape": Landscape("landscape", "2d", 12, 6),
    },
}
OVERRIDES = {
    "paper": (),
    "tiny": ("discretization.links=2",),
    "cpu": ("discretization.links=4",),
}
"""What the sizes change in the scene; the paper's change nothing."""


def experiment(name: str, size: str = "paper") -> Strategies | Landscape:
    """Returns an experiment by name in the paper's or a smaller size."""
    for known, expected in PAPER_GRASPS.items():
        if PAPER[known].grasps != expected:
            raise RuntimeError(f"{known}: {PAPER[known].grasps} grasps, the paper has {expected}")
    return (PAPER if size == "paper" else SMALL[size])[name]


def narrowed(
    the_plan: Strategies | Landscape, strategies: Sequence[str] | None, runs: int | None
) -> Strategies | Landscape:
    """Returns an experiment with fewer strategies or another number of runs.

    Run r of a strategy is the same run whatever is beside it, up to rounding: its keys come from
    the seed of run r alone.
    """
    if strategies is None and runs is None:
        return the_plan
    if isinstance(the_plan, Landscape):
        raise ValueError(f"{the_plan.name} is a grid: it has neither strategies nor runs")
    if runs is not None and runs < 1:
        raise ValueError(f"{runs} runs: there must be one at least")
    chosen = the_plan.strategies if strategies is None else tuple(strategies)
    new = dataclasses.replace(the_plan, strategies=chosen, runs=runs or the_plan.runs)
    for name in chosen:
        schedule(name, np.array([True, False]), new.episodes, "morphology")
    return new
