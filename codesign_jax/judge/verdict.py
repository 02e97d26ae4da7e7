# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportUnknownLambdaType=false, reportMissingTypeStubs=false
"""Verdicts: when a world is decided, how a trial ended, and whether a design is good.

A world is decided when its object is lost within the cost's window (paper Fig. 3) or when it
failed.  The functions of that rule, which every engine and the cost apply, consist of comparisons
only, so that they take NumPy arrays, JAX arrays and the lanes of a kernel alike.  None of them asks
whether a number is finite, because a GPU kernel cannot: comparisons with a number that is not one
are false.

A design is judged by the outcomes of its trials (`judge`), by Wald's sequential probability ratio
test of the share of its grasps that it keeps.

>>> from codesign_jax.judge import verdict
>>> verdict.judge(60, 60).word, verdict.judge(24, 24).word
('good', 'not enough trials')
"""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import Scene
from codesign_jax.statistics import Interval, wilson
from codesign_jax.types import HARMLESS, WARNINGS, Outcome, Status, Trace, failed

FAR = 3e38
"""Larger than any distance, and still a number in float32."""


class Bounds(NamedTuple):
    """Thresholds that decide a world: numbers, or arrays that broadcast to the worlds' arrays."""

    # Distance from object centre to hand centre from which on the object is lost [m]
    lost_distance: Any
    start: Any  # the first time step at which a lost object counts
    end: Any  # the first time step at which it no longer does
    speed: Any  # largest velocity of a world that has not failed [rad/s or m/s]
    # How far below the table the object's centre may be [m]; `FAR` without a table, where what
    # falls is lost as soon as the window begins
    penetration: Any


def bounds(scene: Scene) -> Bounds:
    """The bounds of a scene, whose numbers may be arrays or traced."""
    start, end = map(scene.steps_to, scene.window)
    limits = scene.limits
    deep = limits.penetration if scene.effects.table else FAR + 0 * limits.penetration
    return Bounds(scene.cost.lost_distance, start, end, limits.speed, deep)


def lost(bounds: Bounds, distance: Any, step: Any) -> Any:
    """Whether the object is lost: far from the hand, and within the window of the cost.

    Args:
      distance: Object centre to hand centre [m].
    """
    return (distance >= bounds.lost_distance) & (step >= bounds.start) & (step < bounds.end)


def sound(bounds: Bounds, distance: Any, height: Any) -> Any:
    """Whether a state consists of numbers and its object is not below the table.

    Args:
      distance: Object centre to hand centre [m].
      height: Object centre above the table [m].
    """
    return (distance <= FAR) & (height >= -bounds.penetration)


def slow(bounds: Bounds, speed: Any) -> Any:
    """Whether the largest absolute generalized velocity is a number and within the limit."""
    return speed <= bounds.speed


def goes_on(
    bounds: Bounds, distance: Any, height: Any, speed: Any, step: Any, *, to_end: bool
) -> Any:
    """Whether a world in this state takes the next step.

    The step is kept if the state after it is `slow` as well, else the world stays where it was.

    Args:
      distance: Object centre to hand centre [m].
      height: Object centre above the table [m].
    """
    good = sound(bounds, distance, height) & slow(bounds, speed)
    return good if to_end else good & ~lost(bounds, distance, step)


def failures(scene: Scene, trace: Trace) -> jax.Array:
    """Why each state of a trace is not sound, or its step not valid; bits of `Status`, else 0.

    Args:
      trace: Trace of one world, arrays of shape (time,).

    Returns:
      Bits, shape (time,) int32.
    """
    numbers = jnp.isfinite(trace.speed) & jnp.isfinite(trace.distance) & jnp.isfinite(trace.height)
    bits = as_bit(~numbers, Status.NONFINITE)
    bits |= as_bit(trace.speed > scene.limits.speed, Status.SPEED)
    bits |= as_bit(trace.height < -bounds(scene).penetration, Status.PENETRATION)
    if trace.status is not None:
        status = jnp.asarray(trace.status, jnp.int32)
        bits |= jnp.where(failed(status), status, jnp.zeros_like(status))
    return bits


def as_bit(condition: jax.Array, bit: Status) -> jax.Array:
    """The bit where the condition holds, int32 in every mode of JAX."""
    return condition.astype(jnp.int32) * np.int32(bit)


# ---- how a trial ended

VERDICTS = ("kept", "lost", "not_released", "fault")
"""How a trial ends, see `verdicts`."""


def verdicts(outcomes: Outcome) -> np.ndarray:
    """Outcomes of trials as indices of `VERDICTS`; tables, reports and commands use this rule.

    A trial is lost if it did not fail and lost its object within the window of the scene's cost,
    whatever the user's own cost says.  A trial that failed is not released if the hand held the
    object and did not release it at the end (STUCK); otherwise it is a fault of the simulation.

    Args:
      outcomes: Outcomes, arrays of any shape.

    Returns:
      Indices, of the same shape.
    """
    status = np.asarray(outcomes.status)
    lost = np.isfinite(outcomes.lost_time)
    stuck = VERDICTS.index("not_released")
    broken = VERDICTS.index("fault")
    bad = np.where(status & Status.STUCK, stuck, broken)
    return np.where(failed(status), bad, lost.astype(int))


def kept(outcomes: Outcome) -> np.ndarray:
    """Whether trials kept their object and released it at the end, shaped like the outcomes."""
    return verdicts(outcomes) == VERDICTS.index("kept")


class Tally(NamedTuple):
    """Numbers of trials by outcome; the four add up to all trials."""

    kept: int  # neither lost nor failed
    lost: int  # the object left the hand within the window of the cost
    not_released: int  # the hand did not let go of the object
    fault: int  # the simulation failed, see `Status`

    @property
    def total(self) -> int:
        """All trials."""
        return sum(self)

    def __str__(self) -> str:
        """In words, such as "kept 20 of 24, 3 lost, 1 not released"."""
        return self.text()

    def text(self, losses: "Losses | None" = None) -> str:
        """In words, with the causes of losses if they are given."""
        causes = f" ({losses})" if losses and self.lost else ""
        words = f"kept {self.kept} of {self.total}, {self.lost} lost{causes}"
        words += f", {self.not_released} not released"
        return words + (f", {self.fault} fault" + "s" * (self.fault > 1) if self.fault else "")


def tally(outcomes: Outcome) -> Tally:
    """Counts trials, given as arrays of any shape."""
    return Tally(*np.bincount(verdicts(outcomes).ravel(), minlength=len(VERDICTS)).tolist())


class Losses(NamedTuple):
    """Numbers of lost trials by what the hand had done by then; they add up to `Tally.lost`."""

    unmoved: int  # the object is where it was put, see `Status.UNMOVED`
    lift: int  # it slipped as the arm lifted it, or was left behind
    shaking: int  # it was thrown as the arm shook it

    def __str__(self) -> str:
        """In words, without what did not happen; such as "2 never moved, 1 slipped in the lift"."""
        words = "never moved", "slipped in the lift", "thrown in the shaking"
        return ", ".join(f"{n} {text}" for n, text in zip(self, words, strict=True) if n)


def losses(scene: Scene, outcomes: Outcome) -> Losses:
    """Counts the lost ones among trials by their cause.

    Args:
      scene: The scene that was simulated, for the times of its phases.
      outcomes: Outcomes, arrays of any shape.
    """
    lost = verdicts(outcomes) == VERDICTS.index("lost")
    unmoved = lost & ((np.asarray(outcomes.status) & Status.UNMOVED) != 0)
    lifted = lost & ~unmoved & (np.asarray(outcomes.lost_time) < scene.phase_ends["lift"])
    return Losses(*(int(v.sum()) for v in (unmoved, lifted, lost & ~unmoved & ~lifted)))


def status_names(status: int) -> str:
    """Names of the status bits that are set, joined by "+", or "OK"."""
    return "+".join(bit.name or "" for bit in Status(int(status))) or "OK"


def failure_counts(status: jax.typing.ArrayLike) -> str:
    """How often each cause of failure occurs, e.g. "SPEED 1, STUCK 3"; empty if none does."""
    return _counts(status, [bit for bit in Status if bit not in HARMLESS])


def warning_counts(status: jax.typing.ArrayLike) -> str:
    """How often each warning occurs, which does not fail a trial, e.g. "SOLVER_CAP 3"."""
    return _counts(status, [*WARNINGS])


def _counts(status: jax.typing.ArrayLike, bits: Iterable[Status]) -> str:
    every = np.asarray(status)
    counts = {bit.name: int(((every & bit) != 0).sum()) for bit in bits}
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count)


def ending(outcome: Outcome) -> str:
    """How a trial ended, in words; its entries are numbers."""
    if failed(int(outcome.status)):
        return f"failed ({status_names(int(outcome.status))})"
    lost = float(outcome.lost_time)
    return f"object lost at {lost:.2f} s" if np.isfinite(lost) else "object kept"


# ---- whether a design is good

WANTED = 0.95
"""Share of its grasps from which on a design ought to be called good."""
POOR = 0.90
"""Share of its grasps up to which a design ought to be called not good."""
ERROR = 0.05
"""Largest probability that a design of at most `POOR` is ever called good, and that one of at least
`WANTED` is ever called not good."""
BATCH = 20
"""Grasps between two looks of `sequential`: three batches without a loss decide."""
MOST = 600
"""Most grasps of `sequential` by default."""
USUAL = 73
"""Expected number of grasps of `sequential` for a design that keeps 99 % of them."""
RULE = (
    f"good, not good: Wald's sequential test between shares of {100 * POOR:.0f} and "
    f"{100 * WANTED:.0f} % kept, with errors of at most {100 * ERROR:.0f} %; every trial that is "
    "not kept counts against the design"
)
"""The rule of `judge` in words."""

OPEN = "not enough trials"
"""What is said of a design until its trials decide."""
_OF_KEPT = math.log(WANTED / POOR)
_OF_LOST = math.log((1 - POOR) / (1 - WANTED))
# By Ville's inequality a likelihood ratio exceeds 1 / ERROR at any time with at most that
# probability, however often it is looked at; Wald's own bound, (1 - ERROR) / ERROR, is less strict.
_DECISIVE = math.log(1 / ERROR)
_MANY = 10_000


class Verdict(NamedTuple):
    """Whether a design is good."""

    share: Interval  # share of its grasps that it kept, with Wilson's 95 % interval
    total: int  # number of the grasps
    word: str  # "good", "not good" or "not enough trials"
    more: int  # further grasps after which the share, if it stays, is good or not good; 0 if it is

    def sentence(self, grasps: str = "fresh grasps") -> str:
        """Such as "keeps 97 % of 150 fresh grasps (93 to 99 %): good"."""
        share, low, high = (_percent(v) for v in self.share)
        text = f"keeps {share} % of {self.total} {grasps} ({low} to {high} %): {self.word}"
        return f"{text}, {self.further}" if self.more else text

    @property
    def further(self) -> str:
        """How many grasps are missing, such as "225 more at this share would decide"."""
        missing = f"{self.more:,}" if self.more <= _MANY else f"more than {_MANY:,}"
        return f"{missing} more at this share would decide"


def evidence(kept: int, total: int) -> float:
    """Logarithm of the likelihood ratio of a share of `WANTED` to one of `POOR`.

    A design is good from log(1 / `ERROR`) on, and not good from its negative on.
    """
    return kept * _OF_KEPT - (total - kept) * _OF_LOST


def word(kept: int, total: int) -> str:
    """The word for a design: good, not good or `OPEN`; no other function decides it.

    A kept grasp more never makes a verdict worse, a lost one never better.  It may be asked for
    after every grasp, and trials may be added: `ERROR` bounds the probability of ever being wrong.
    """
    ratio = evidence(kept, total)
    if abs(ratio) < _DECISIVE - 1e-9:
        return OPEN
    return "good" if ratio > 0 else "not good"


def judge(kept: int, total: int) -> Verdict:
    """The verdict on a design, by `word`, with the share that it keeps and its interval."""
    decision = word(kept, total)
    more = _more(evidence(kept, total), total) if decision == OPEN else 0
    return Verdict(wilson(kept, total), total, decision, more)


def _more(ratio: float, total: int) -> int:
    """Grasps after which a ratio that grows as until now decides; `_MANY` + 1 for more."""
    needed = total * _DECISIVE / max(abs(ratio), 1e-9)
    return math.ceil(min(needed - total, _MANY + 1) - 1e-9)


def good(outcomes: Outcome) -> np.ndarray:
    """Whether designs are good, from outcomes with the trial as the last axis."""
    every = kept(outcomes)
    good_designs = [word(int(n), every.shape[-1]) == "good" for n in every.sum(-1).ravel()]
    return np.array(good_designs).reshape(every.shape[:-1])


def sequential(
    simulate: Callable[[int, int], Outcome], most: int = MOST, previous: Outcome | None = None
) -> Iterator[Outcome]:
    """Simulates trials in batches until they decide whether a design is good.

    Args:
      simulate: Outcomes of trials, shape (trial,), from the index of the first and their number,
        which is the same in every call.
      most: Most trials; at least 1.
      previous: Outcomes of the first trials, which are known.

    Yields:
      Outcomes of all trials so far, shape (trial,), after each batch.
    """
    count = min(BATCH, most)
    so_far = previous
    while so_far is None or undecided(so_far, most):
        first = 0 if so_far is None else so_far.cost.size
        batch = simulate(first, count)
        parts = [batch] if so_far is None else [so_far, batch]
        # A last batch of fewer trials would be another program.
        so_far = jax.tree.map(lambda *v: np.concatenate(v)[:most], *parts)
        yield so_far


def undecided(outcomes: Outcome, most: int) -> bool:
    """Whether `sequential` goes on behind these outcomes, with so many trials at most."""
    counts = tally(outcomes)
    return counts.total < most and word(counts.kept, counts.total) == OPEN


def _percent(share: float) -> str:
    text = f"{100 * share:.0f}"
    lifted = text in ("95", "100") and 100 * share < float(text)
    return f"{math.floor(1000 * share) / 10:.1f}" if lifted else text
