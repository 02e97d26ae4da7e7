"""What simulated trials say about a design, in words: one verdict (`judge`), by one rule.

Trials are kept, lost, stuck (the hand did not let go) or failed otherwise, and all of them are
counted: shares and intervals are of all trials, so that a trial that failed is one that did not
keep its object.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from codesign_jax import codesign, cost, runs
from codesign_jax.report import statistics
from codesign_jax.report.statistics import Interval
from codesign_jax.scene import Scene
from codesign_jax.types import Forces, Outcome, failed

RELIABLE = 0.95
"""Share of its grasps that a good design keeps at least."""
UNRELIABLE = 0.85
"""Share that the interval of a good design leaves out: 22 grasps without a loss do."""
RULE = (
    "good: at least 95 % kept, and the 95 % interval in brackets lies above 85 %; not good: it "
    "lies below 95 %; otherwise not enough trials"
)
"""The rule of `judge` in words."""
_MOST = 10_000
_SQUARE = 1.959963984540054**2  # of the normal distribution's 97.5 % point
MANY = 0.1
"""Share of failed trials from which on a verdict comes with a warning."""


class Verdict(NamedTuple):
    """Whether a design is good; as a string a sentence without its subject."""

    share: Interval  # share of its grasps that it kept, with the 95 % interval
    total: int  # number of the grasps
    word: str  # "good", "not good" or "not enough trials"
    more: int  # further grasps after which the share, if it stays, is good or not good; 0 if it is

    def sentence(self, grasps: str = "fresh grasps") -> str:
        """Such as "keeps 97 % of 150 fresh grasps (93 to 99 %): good"."""
        share, low, high = (_percent(v) for v in self.share)
        text = f"keeps {share} % of {self.total} {grasps} ({low} to {high} %): {self.word}"
        if not self.more:
            return text
        some = f"{self.more:,}" if self.more <= _MOST else f"more than {_MOST:,}"
        return f"{text}, {some} more at this share would decide"


def depths(forces: Forces) -> str:
    """The largest depth of each kind of contact over forces of any shape, in words."""
    found = {k.replace("_", " on "): 1e3 * float(np.max(v)) for k, v in forces.depth.items()}
    words = [f"{k} {v:.2g} mm" for k, v in found.items() if v > 0]
    return ", ".join(words) or "nothing touched"


def judge(kept: int, total: int) -> Verdict:
    """The verdict on a design, by `RULE`: this function is the only place that decides it.

    Wilson's interval leaves out a share p_0 where the score test rejects it, that is from
    z^2 p_0 (1 - p_0) / (p - p_0)^2 grasps on: the number that decides has a closed form.  A kept
    grasp more never makes a verdict worse, a lost one never better, and at a constant share a
    decision stays.
    """
    good = kept / total > RELIABLE - 1e-9
    limit = UNRELIABLE if good else RELIABLE
    needed = _SQUARE * limit * (1 - limit) / (kept / total - limit) ** 2
    more = max(math.floor(needed) + 1 - total, 0)
    word = "not enough trials" if more else "good" if good else "not good"
    return Verdict(statistics.wilson(kept, total), total, word, more)


def _percent(share: float) -> str:
    text = f"{100 * share:.0f}"
    lifted = text in ("95", "100") and 100 * share < float(text)
    return f"{math.floor(1000 * share) / 10:.1f}" if lifted else text


class Tally(NamedTuple):
    """How trials ended, numbers of them; the four add up to all."""

    kept: int  # neither lost nor failed
    lost: int  # the object left the hand within the window of the cost
    stuck: int  # the hand did not let go of the object
    failed: int  # those that failed otherwise: faults of the simulation

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


def good(outcomes: Outcome) -> np.ndarray:
    """Which designs are good, bool; of outcomes with the trial as the last axis."""
    kept = codesign.verdicts(outcomes) == codesign.VERDICTS.index("kept")
    found = [judge(int(n), kept.shape[-1]).word == "good" for n in kept.sum(-1).ravel()]
    return np.array(found).reshape(kept.shape[:-1])


class Judged(NamedTuple):
    """Trials by which a design is judged; as a string the verdict, in a sentence."""

    scene: Scene  # the scene that was simulated, with its rule for failed trials
    outcomes: Outcome  # outcomes of the trials, NumPy arrays of shape (trial,)
    accuracy: str | None = None  # name of the accuracy's preset, if one was asked for
    grasps: str = "fresh grasps"  # what the trials are called

    @property
    def verdict(self) -> Verdict:
        """The verdict; failed trials count as not kept."""
        found = tally(self.outcomes)
        return judge(found.kept, found.total)

    @property
    def details(self) -> str:
        """How the trials ended and at what accuracy, in a line."""
        size = self.scene.discretization
        named = f"accuracy {self.accuracy}, " if self.accuracy else ""
        how = f"{named}steps of {1e3 * size.timestep:g} ms, {size.links} links a finger"
        return f"{of_trials(self.scene, self.outcomes)}; {how}"

    def __str__(self) -> str:
        """The verdict in a sentence; that there is none if every trial failed."""
        found = tally(self.outcomes)
        if found.failed == found.total:
            causes = runs.failure_counts(self.outcomes.status)
            return f"no verdict: every trial failed ({causes})"
        return self.verdict.sentence(self.grasps)


def of_trials(scene: Scene, outcomes: Outcome) -> str:
    """Says how trials ended: numbers of them, mean cost, warnings."""
    warnings = runs.warning_counts(outcomes.status)
    found = tally(outcomes)
    causes = f" ({runs.failure_counts(outcomes.status)})" if found.failed else ""
    text = f"{found}{causes}; {mean_cost(scene, outcomes)}"
    return text + (f"; warnings: {warnings}" if warnings else "")


def mean_cost(scene: Scene, outcomes: Outcome) -> str:
    """The mean cost of trials and what failed ones count in it; arguments as of `of_trials`."""
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
    """Says in a line how often the solver stopped at its limit; no line if it never did."""
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
