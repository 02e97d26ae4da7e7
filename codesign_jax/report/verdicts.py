"""What simulated trials say about a design, in words: one verdict, with failed trials in it.

Trials are kept, lost, stuck (the hand did not let go) or failed otherwise, and all of them are
counted: shares and intervals are of all trials, so that a trial that failed is one that did not
keep its object.
"""

from typing import Any, NamedTuple

import numpy as np

from codesign_jax import codesign, cost, runs
from codesign_jax.report import statistics
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, failed

RELIABLE = 0.95
"""Share of all trials that a successful design keeps at least: the mean cost alone lets a design
pass that loses a sixth of its objects late, as such losses cost little."""
_RELIABLE = f"{100 * RELIABLE:.0f} %"
MANY = 0.1
"""Share of failed trials from which on a verdict comes with a warning."""


class Tally(NamedTuple):
    """How trials ended, numbers of them; the four add up to all.

    Attributes:
      kept: Neither lost nor failed: a cost below the limit of success.
      lost: The object left the hand within the window of the cost.
      stuck: The hand did not let go of the object.
      failed: Those that failed otherwise: faults of the simulation.
    """

    kept: int
    lost: int
    stuck: int
    failed: int

    @property
    def total(self) -> int:
        """All trials."""
        return sum(self)

    def __str__(self) -> str:
        """In words, such as "kept 20 of 24, 3 lost, 1 stuck"."""
        words = f"kept {self.kept} of {self.total}, {self.lost} lost, {self.stuck} stuck"
        return words + (f", {self.failed} failed" if self.failed else "")


def tally(outcomes: Outcome) -> Tally:
    """Counts trials, given as arrays of any shape."""
    ends = codesign.verdicts(outcomes).ravel()
    return Tally(*np.bincount(ends, minlength=len(codesign.VERDICTS)).tolist())


def success(scene: Scene, outcomes: Outcome) -> Any:
    """Whether designs are successful: `RELIABLE`, with a mean cost below the limit of success.

    Args:
      scene: The scene, with its rule for failed trials.
      outcomes: Outcomes with the trial as the last axis.

    Returns:
      Bools without the trial axis.
    """
    low = np.asarray(cost.particle_cost(scene, outcomes)) < codesign.SUCCESS_COST
    return low & (_kept(outcomes).mean(-1) >= RELIABLE)


def _kept(outcomes: Outcome) -> np.ndarray:
    return codesign.verdicts(outcomes) == codesign.VERDICTS.index("kept")


class Judged(NamedTuple):
    """Trials by which a design is judged; as a string the verdict, in a line.

    Attributes:
      scene: The scene that was simulated, with its rule for failed trials.
      outcomes: Outcomes of the trials, NumPy arrays of shape (trial,).
      accuracy: Name of the accuracy's preset, if one was asked for.
    """

    scene: Scene
    outcomes: Outcome
    accuracy: str | None = None

    @property
    def at(self) -> str:
        """The accuracy in words."""
        size = self.scene.discretization
        named = f"accuracy {self.accuracy}, " if self.accuracy else ""
        return f"{named}steps of {1e3 * size.timestep:g} ms, {size.links} links a finger"

    def __str__(self) -> str:
        """How the design did, at what accuracy, how sure that is, and whether it is a success."""
        found = tally(self.outcomes)
        if found.failed == found.total:
            causes = runs.failure_counts(self.outcomes.status)
            return f"every trial failed ({causes}): none counts as kept or lost ({self.at})"
        share = statistics.wilson(found.kept, found.total)
        bad = ", failed trials count as not kept" if found.stuck or found.failed else ""
        return (
            f"{found} ({self.at}): it keeps {100 * share.low:.0f} to {100 * share.high:.0f} % of "
            f"grasps (95 % interval{bad}); {mean_cost(self.scene, self.outcomes)}; {self._words}"
        )

    @property
    def _words(self) -> str:
        """Whether that is a success."""
        if success(self.scene, self.outcomes):
            limit = codesign.SUCCESS_COST
            return f"a success in these trials: at least {_RELIABLE} kept, mean cost below {limit}"
        if _kept(self.outcomes).mean() < RELIABLE:
            return f"no success: less than {_RELIABLE} kept"
        return f"no success: the mean cost is not below {codesign.SUCCESS_COST}"


def of_object(scene: Scene, outcomes: Outcome) -> str:
    """Says how a design did with one object, shorter than a verdict.

    Args:
      scene: The scene, with its rule for failed trials.
      outcomes: Outcomes of trials with the object, NumPy arrays of shape (trial,).
    """
    warnings = runs.warning_counts(outcomes.status)
    found = tally(outcomes)
    causes = f" ({runs.failure_counts(outcomes.status)})" if found.failed else ""
    text = f"{found}{causes}; {mean_cost(scene, outcomes)}"
    return text + (f"; warnings: {warnings}" if warnings else "")


def mean_cost(scene: Scene, outcomes: Outcome) -> str:
    """The mean cost of trials and what failed ones count in it; arguments as of `of_object`."""
    count = int(failed(np.asarray(outcomes.status)).sum())
    if count == np.size(outcomes.status) and scene.cost.failure == "exclude":
        return "no mean cost"
    mean = f"mean cost {float(cost.particle_cost(scene, outcomes)):.4f}"
    if not count:
        return mean
    if scene.cost.failure == "exclude":
        return f"{mean} without the {count} that failed"
    return f"{mean} with {scene.cost.maximum:g} for each of the {count} that failed"


def solver(outcomes: Outcome) -> list[str]:
    """Says in a line how often the solver stopped at its limit; no line if it never did.

    Args:
      outcomes: Outcomes, arrays of any shape.
    """
    shares, residuals = (_told(v) for v in (outcomes.capped, outcomes.residual))
    if not shares.any():
        return []
    text = f"solver: {100 * shares.mean():.2g} % of the steps ended at the limit of iterations"
    if residuals.size:
        middle, most = np.median(residuals), residuals.max()
        text += f"; largest residual of a trial: median {middle:.2g}, most {most:.2g} weights"
    return [text]


def _told(values: Any) -> np.ndarray:
    """The numbers among values; none for None."""
    numbers = np.ravel(np.asarray(values, float))
    return numbers[np.isfinite(numbers)]


def warnings(judged: Judged) -> list[str]:
    """Says in a line that many trials failed, and what may be done about it; no line if few did."""
    scene, found = judged.scene, tally(judged.outcomes)
    count = found.stuck + found.failed
    if count <= MANY * found.total or found.failed == found.total:
        return []
    causes = runs.failure_counts(judged.outcomes.status)
    text = f"warning: {count} of {found.total} trials failed ({causes})"
    text += "; STUCK: the hand did not let go of the object" if found.stuck else ""
    if scene.cost.failure == "exclude":
        text += (
            ". The mean cost leaves them out, so that a search does not avoid such designs: "
            f"--set cost.failure=worst counts each with {scene.cost.maximum:g}"
        )
    return [text]
