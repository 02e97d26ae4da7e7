"""Trials that a search has not met, with finer steps, until they decide whether a design is good.

An optimiser picks what the errors of its simulation favour (the winner's curse), and the best of
several final particles was chosen by the very trials that tested it.
"""

from collections.abc import Callable

import jax

from codesign_jax.judge import verdict
from codesign_jax.judge.cases import Case
from codesign_jax.judge.sentences import Judged
from codesign_jax.judge.stress import Stress
from codesign_jax.scene import Scene, with_accuracy
from codesign_jax.statistics import wilson
from codesign_jax.types import Outcome

ACCURACY = "reference"
"""Accuracy of fresh trials; docs/results.md has how much the finer steps change."""
HALF = 0.5
"""Share of kept grasps below which a design is not tested further [chosen]."""
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
