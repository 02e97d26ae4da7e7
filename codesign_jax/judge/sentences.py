"""Verdicts on simulated trials, in words; the rule is `verdict.judge`.

A trial is kept, lost, not released or a fault.  Shares and intervals are of all trials, so that
each trial that is not kept counts against the design.  A verdict names the masses and the friction
that it holds for, and the other conditions under which it does not.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from codesign_jax import cost
from codesign_jax.judge import verdict
from codesign_jax.judge.stress import Stress
from codesign_jax.judge.verdict import Verdict, judge, losses, tally
from codesign_jax.scene import Scene
from codesign_jax.types import Forces, Outcome, failed

MANY = 0.1
"""Share of failed trials from which on a verdict comes with a warning."""


def depths(forces: Forces) -> str:
    """The largest depth of each kind of contact over forces of any shape, in words."""
    depths_mm = {k.replace("_", " on "): 1e3 * float(np.max(v)) for k, v in forces.depth.items()}
    words = [f"{k} {v:.2g} mm" for k, v in depths_mm.items() if v > 0]
    return ", ".join(words) or "nothing touched"


class Judged(NamedTuple):
    """Trials by which a design is judged; as a string the verdict, in a sentence."""

    scene: Scene  # the scene that was simulated, with its rule for failed trials
    outcomes: Outcome  # outcomes of the trials, NumPy arrays of shape (trial,)
    accuracy: str | None = None  # name of the accuracy's preset, if one was asked for
    grasps: str = "fresh grasps"  # what the trials are called
    stress: Stress | None = None  # the design's grasps under other conditions, if there are any

    @property
    def verdict(self) -> Verdict:
        """The verdict; failed trials count as not kept."""
        counts = tally(self.outcomes)
        return judge(counts.kept, counts.total)

    @property
    def details(self) -> str:
        """Outcomes and accuracy of the trials, in a line."""
        size = self.scene.discretization
        named = f"accuracy {self.accuracy}, " if self.accuracy else ""
        accuracy = f"{named}steps of {1e3 * size.timestep:g} ms, {size.links} links a finger"
        return f"{of_trials(self.scene, self.outcomes)}; {accuracy}"

    def __str__(self) -> str:
        """The verdict in a sentence; that there is none if every trial failed."""
        counts = tally(self.outcomes)
        if counts.fault == counts.total:
            causes = verdict.failure_counts(self.outcomes.status)
            return f"no verdict: every trial failed ({causes})"
        sentence = self.verdict.sentence(f"{self.grasps} of {objects(self.scene)}")
        return "; ".join([sentence, *([self.limits] if self.limits else [])])

    @property
    def headline(self) -> str:
        """The verdict with the accuracy of its trials, for the head of a page."""
        size = self.scene.discretization
        named = f"accuracy {self.accuracy}" if self.accuracy else "the scene's accuracy"
        return f"{self} [{named}, steps of {1e3 * size.timestep:g} ms]"

    @property
    def limits(self) -> str:
        """Under what other conditions the design is not good; empty where nobody asks."""
        if self.stress is not None:
            return self.stress.limits
        return "other conditions not tried" if self.verdict.word == "good" else ""


def objects(scene: Scene) -> str:
    """The conditions of a verdict, such as "objects of 50 g, friction 0.85"."""
    shapes = scene.objects.object
    noise = scene.objects.noise
    masses = [1e3 * float(shape.mass) for shape in shapes]
    masses += [mass * float(noise.mass_range) for mass in masses]
    text = f"objects of {_span(masses)} g"
    if scene.effects.friction == "none":
        return f"{text}, no friction"
    return f"{text}, friction {_span(float(shape.friction) for shape in shapes)}"


def _span(values: Iterable[float]) -> str:
    """Least and largest of numbers, with three digits."""
    every = [*values]
    return " to ".join(dict.fromkeys(f"{v:.3g}" for v in (min(every), max(every))))


def of_trials(scene: Scene, outcomes: Outcome) -> str:
    """Numbers of trials by outcome and cause of loss, their mean cost, and warnings."""
    warnings = verdict.warning_counts(outcomes.status)
    counts = tally(outcomes)
    causes = f" ({verdict.failure_counts(outcomes.status)})" if counts.fault else ""
    ends = counts.text(losses(scene, outcomes))
    text = f"{ends}{causes}; {mean_cost(scene, outcomes)}"
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
    """A line on how often the solver stopped at its limit; no line if it never did."""
    shares, residuals = (_finite(v) for v in (outcomes.capped, outcomes.residual))
    if not shares.any():
        return []
    text = f"solver: {100 * shares.mean():.2g} % of the steps ended at the limit of iterations"
    if residuals.size:
        middle = np.median(residuals)
        most = residuals.max()
        text += f"; largest residual of a trial: median {middle:.2g}, most {most:.2g} weights"
    return [text]


def _finite(values: Any) -> np.ndarray:
    """The numbers among values; none for None."""
    numbers = np.ravel(np.asarray(values, float))
    return numbers[np.isfinite(numbers)]


def warnings(judged: Judged) -> list[str]:
    """A line with advice if many trials failed; no line otherwise."""
    scene = judged.scene
    counts = tally(judged.outcomes)
    count = counts.not_released + counts.fault
    if count <= MANY * counts.total or counts.fault == counts.total:
        return []
    causes = verdict.failure_counts(judged.outcomes.status)
    text = f"warning: {count} of {counts.total} trials failed ({causes})"
    text += "; STUCK: the hand did not let go of the object" if counts.not_released else ""
    if scene.cost.failure == "exclude":
        text += (
            ". The mean cost leaves them out, so that a search does not avoid such designs: "
            f"--set cost.failure=worst counts each with {scene.cost.maximum:g}"
        )
    return [text]
