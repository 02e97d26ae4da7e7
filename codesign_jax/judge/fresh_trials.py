"""Trials that a search has not met, with finer steps, until they decide whether a design is good.

An optimiser picks what the errors of its simulation favour (the winner's curse), and the best of
several final particles was chosen by the very trials that tested it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax.judge import verdict
from codesign_jax.judge.cases import Case
from codesign_jax.judge.sentences import Judged
from codesign_jax.judge.stress import Stress
from codesign_jax.scene import Scene, with_accuracy
from codesign_jax.statistics import mcnemar, wilson
from codesign_jax.types import Outcome

ACCURACY = "reference"
"""Accuracy of fresh trials; docs/results.md has how much the finer steps change."""
HALF = 0.5
"""Share of kept grasps below which a design is not tested further [chosen]."""
CHANCE = 0.05
"""Largest p-value of a difference that is beyond chance [chosen]."""
STREAM = 0x72656665
"""Stream of the trials' noise ("refe")."""


def hopeless(outcomes: Outcome) -> bool:
    """Whether the trials that chose a design, which flatter it, say that it keeps less than half.

    Finer steps and other conditions cannot make it good: neither is worth its time.
    """
    counts = verdict.tally(outcomes)
    return wilson(counts.kept, counts.total).high < HALF


def decide(
    case: Case,
    key: jax.Array,
    most: int,
    previous: Outcome | None = None,
    keep: Callable[[Outcome], None] = lambda outcomes: None,
) -> Outcome:
    """Outcomes of as many trials as decide whether a design is good, see `verdict.sequential`.

    Args:
      case: The design.
      key: Key of the trials.
      most: Most trials; at least 1.
      previous: Outcomes of the first trials, which are known.
      keep: Is called with all outcomes so far after each batch.
    """

    def simulate(first: int, count: int) -> Outcome:
        return case.simulate(count, key, first)

    outcomes = previous
    for outcomes in verdict.sequential(simulate, most, previous):
        keep(outcomes)
    assert outcomes is not None
    return outcomes


class Retest(NamedTuple):
    """Finalists of a search in the same trials at its own accuracy and at that of the test."""

    lost: int  # finalists that the accuracy of the search alone likes
    finalists: int  # different ones

    def sentence(self, accuracy: str) -> str:
        """In words; `accuracy`: name of the search's."""
        return (
            f"{self.lost} of {self.finalists} finalists keep {100 * verdict.WANTED:g} % of these "
            f"grasps at accuracy {accuracy} alone"
        )


def retest(particles: np.ndarray, test: Outcome, searched: Outcome) -> Retest:
    """Counts the finalists that keep enough grasps at the accuracy of the search alone.

    They keep at least `verdict.WANTED` of the test's trials there, and in the same trials fewer at
    the accuracy of the test, by more than chance (McNemar's exact test).

    Args:
      particles: Final particles, shape (particle, parameter); copies count once.
      test: Outcomes at the accuracy of the test, arrays of shape (particle, trial).
      searched: Those at the accuracy of the search, in the same trials.
    """
    first = np.unique(particles, axis=0, return_index=True)[1]
    lost = 0
    for before, after in zip(verdict.kept(searched)[first], verdict.kept(test)[first], strict=True):
        worse, better = int((before & ~after).sum()), int((~before & after).sum())
        beyond_chance = worse > better and mcnemar(worse, better) < CHANCE
        lost += bool(before.mean() >= verdict.WANTED and beyond_chance)
    return Retest(lost, len(first))


def lacking(outcomes: Outcome) -> int:
    """Further trials that would decide if the share of kept grasps stays as it is."""
    ends = verdict.tally(outcomes)
    return verdict.judge(ends.kept, ends.total).more


def judged(scene: Scene, outcomes: Outcome, other: Stress | None = None) -> Judged:
    """Fresh trials of a design of a scene, and its grasps under other conditions."""
    return Judged(with_accuracy(scene, ACCURACY), outcomes, ACCURACY, stress=other)


def steps_and_links(scene: Scene) -> float:
    """How much more time a fresh trial takes than a grasp of the scene, by steps and links."""
    finer = with_accuracy(scene, ACCURACY)
    sizes = [s.num_steps * s.discretization.links for s in (finer, scene)]
    return sizes[0] / sizes[1]
