"""What each finger of a hand is worth: its grasps without a finger, by backward elimination.

A finger is taken away as data of the program that searched: its length is 0, see `Params`.  Every
hand meets the same trials as the whole one, as they are, with heavier objects and with less
friction.  The least hand that is no worse than the whole one is sought finger by finger, the one
first that is missed least.  A hand that is surely worse in one condition is not tried in the
others, and the conditions that ask most of a hand come first.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax import rollout, statistics
from codesign_jax.batch import Batch
from codesign_jax.engines import Engine
from codesign_jax.judge import stress, verdict
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Params, Trial

MARGIN = 0.1
"""A hand is no worse if the 95 % interval of the difference of its share of kept grasps ends above
minus this [chosen]: half as much again as between a good hand and a poor one, see `verdict`."""
SCREENED = 12
"""Trials by which a hand is looked at first, in the condition that asks most of it."""
DECISIVE = 36
"""Trials of each condition after which a hand is found no worse, or given up: where the two hands
never differ they have an interval of 10 points."""
DOUBTFUL = 2 * MARGIN
"""Difference from which on a hand is given up after the first look in a condition."""
STREAM = 0x66696E67
"""Stream of the trials' noise ("fing")."""
NEEDED = "needed"
IDLE = "not needed"
OPEN = "undecided"
"""What is said of a finger."""

Fingers = tuple[int, ...]
"""Numbers of fingers, in ascending order."""


class Worth(NamedTuple):
    """Grasps of a hand without some of its fingers, each paired with one of the whole hand.

    The arrays count trials, shape (hand, condition): none where a hand was given up before.
    """

    conditions: tuple[str, ...]
    absent: np.ndarray  # fingers that a hand lacks, bool, shape (hand, finger)
    both: np.ndarray  # kept by the whole hand and by this one
    whole: np.ndarray  # kept by the whole hand alone
    fewer: np.ndarray  # kept by this hand alone
    total: np.ndarray

    @property
    def hands(self) -> list[Fingers]:
        """Fingers that each hand lacks."""
        return [tuple(np.flatnonzero(row).tolist()) for row in self.absent]

    def differences(self, hand: Fingers) -> list[statistics.Interval]:
        """Share that a hand keeps less that of the whole hand, by condition that was tried."""
        row = self.hands.index(hand)
        counts = zip(self.both[row], self.fewer[row], self.whole[row], self.total[row], strict=True)
        return [statistics.paired(*map(int, numbers)) for numbers in counts if numbers[-1]]

    def no_worse(self, hand: Fingers) -> bool:
        """Whether a hand is no worse than the whole one in any condition."""
        enough = (self.total[self.hands.index(hand)] >= DECISIVE).all()
        return bool(enough) and all(d.low >= -MARGIN for d in self.differences(hand))

    @property
    def least(self) -> Fingers:
        """Fingers without which the hand is no worse: the most of them; none of the whole hand."""
        return max((hand for hand in self.hands if self.no_worse(hand)), key=len, default=())

    def judgement(self, finger: int) -> str:
        """Whether a finger is `NEEDED`, not needed beside all others (`IDLE`), or it is `OPEN`."""
        if finger in self.least or self.no_worse((finger,)):
            return IDLE
        missed = any(d.high < 0 for d in self.differences((finger,)))
        return NEEDED if missed else OPEN

    @property
    def head(self) -> tuple[str, ...]:
        """Names of the columns of `rows`."""
        return "kept without finger", *self.conditions, "the finger is"

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """A row for each finger that was left out alone, then hands that lack several."""
        table_rows = []
        for row, hand in enumerate(self.hands):
            kept = self.both[row] + self.fewer[row]
            before = self.both[row] + self.whole[row]
            them = "it" if len(hand) == 1 else "them"
            cells = [
                f"{k} of {n} ({b} with {them})" if n else "–"
                for k, n, b in zip(kept, self.total[row], before, strict=True)
            ]
            word = self.judgement(hand[0]) if len(hand) == 1 else ""
            if len(hand) > 1:
                word = "no worse" if self.no_worse(hand) else "worse or undecided"
            table_rows.append((named(hand), *cells, word))
        return table_rows

    @property
    def sentence(self) -> str:
        """Which fingers may be left out, in a sentence."""
        if not self.least:
            return "no hand with fewer fingers was shown to be no worse"
        low = min(d.low for d in self.differences(self.least))
        return (
            f"the hand without finger {named(self.least)} is no worse: at most {-100 * low:.0f} "
            f"points less in any of {len(self.conditions)} conditions (95 % intervals)"
        )

    def lines(self) -> list[str]:
        """The rows as aligned text."""
        every = [self.head, *self.rows]
        widths = [max(len(row[k]) for row in every) for k in range(len(self.head))]
        return [
            "  " + "  ".join(map(str.ljust, row, widths)).rstrip()  # columns of words and numbers
            for row in every
        ]


def named(fingers: Fingers) -> str:
    """Fingers in words, such as "1 and 3"."""
    *most, last = map(str, fingers)
    return f"{', '.join(most)} and {last}" if most else last


def without(params: Params, fingers: Fingers) -> Params:
    """Parameters of a hand that lacks fingers: arrays of NumPy, shaped as those given."""
    present = np.ones(np.shape(params.length), np.float32)
    present[[*fingers]] = 0.0
    length, pressure = (present * np.asarray(v) for v in (params.length, params.pressure))
    return jax.tree.map(np.asarray, params)._replace(length=length, pressure=pressure)


class _Trials:
    """Kept grasps of hands in the same trials, as far as they were simulated."""

    def __init__(
        self,
        scene: Scene,
        engine: Engine,
        params: Params,
        key: jax.Array,
        done: Callable[[int], None],
    ):
        self._params = params
        self._key = key
        self._done = done
        self._batch = Batch(scene, engine, rollout.Options())
        self._scenes = dict(_conditions(scene))
        # By hand and condition: whether it kept the object, shape (trial,)
        self.kept: dict[Fingers, dict[str, np.ndarray]] = {}

    @property
    def conditions(self) -> list[str]:
        """Names of the conditions, those first that ask most of a hand."""
        as_it_is, *harder = self._scenes
        return [*harder, as_it_is]

    def simulate(self, hands: Sequence[Fingers], count: int, condition: str) -> None:
        """Simulates so many trials of hands in a condition, unless they are known."""
        for hand in hands:
            self.kept.setdefault(hand, dict.fromkeys(self._scenes, np.zeros(0, bool)))
        known = {hand: self.kept[hand][condition].size for hand in hands}
        new = {hand: np.arange(n, count) for hand, n in known.items() if n < count}
        if not new:
            return
        scene = self._scenes[condition]
        drawn = jax.tree.map(np.asarray, rollout.sample_trials(scene, self._key, count))
        rows = np.concatenate([*new.values()])
        trials = jax.tree.map(lambda v: v[rows], drawn)
        every = [
            jax.tree.map(lambda v, n=t.size: np.repeat(v[None], n, 0), self._hand(hand))
            for hand, t in new.items()
        ]
        worlds = jax.tree.map(lambda *v: np.concatenate(v), *every)
        outcomes = self._outcomes(worlds, trials, scene)
        kept = np.split(verdict.kept(outcomes), np.cumsum([t.size for t in new.values()])[:-1])
        for hand, more in zip(new, kept, strict=True):
            self.kept[hand][condition] = np.concatenate([self.kept[hand][condition], more])

    def _outcomes(self, hands: Params, trials: Trial, scene: Scene) -> Outcome:
        return self._batch.simulate(hands, trials, scene, advance=self._done)[0]

    def _hand(self, fingers: Fingers) -> Params:
        return without(self._params, fingers)

    def worth(self) -> Worth:
        """What was simulated so far."""
        hands = [hand for hand in self.kept if hand]
        counts = np.zeros((4, len(hands), len(self._scenes)), int)
        for h, hand in enumerate(hands):
            for c, name in enumerate(self._scenes):
                fewer = self.kept[hand][name]
                whole = self.kept[()][name][: fewer.size]
                outcomes = (whole & fewer, whole & ~fewer, ~whole & fewer)
                counts[:, h, c] = [*(v.sum() for v in outcomes), fewer.size]
        absent = np.zeros((len(hands), len(self._params.length)), bool)
        for h, hand in enumerate(hands):
            absent[h, [*hand]] = True
        return Worth(tuple(self._scenes), absent, *counts)


def simulate(
    scene: Scene,
    engine: Engine,
    params: Params,
    key: jax.Array,
    done: Callable[[int], None] = lambda grasps: None,
) -> Worth:
    """Leaves out fingers one by one as long as the hand is no worse; `done` counts the grasps.

    Args:
      params: Parameters of the whole hand.
      key: Key of the trials.
    """
    trials = _Trials(scene, engine, params, key, done)
    count = len(params.length)
    left_out: Fingers = ()
    while len(left_out) < count - 1:
        hands = [tuple(sorted({*left_out, f})) for f in range(count) if f not in left_out]
        if left_out:  # what was missed beside all others is missed beside fewer
            worth = trials.worth()
            hands = [h for h in hands if not _given_up(worth, ({*h} - {*left_out}).pop())]
        no_worse = (hand for hand in _least_missed(trials, hands) if _decide(trials, hand))
        fewer = next(no_worse, None)
        if fewer is None:
            break
        left_out = fewer
    return trials.worth()


def grasps(fingers: int) -> int:
    """Grasps that `simulate` needs for a hand of which one finger can be left out, and no other."""
    return (fingers - 1) * SCREENED + 3 * 2 * DECISIVE


def _conditions(scene: Scene) -> list[tuple[str, Scene]]:
    return [(stress.AS_IT_IS, scene), *stress.heavier(scene)[:1], stress.slippery(scene)]


def _given_up(worth: Worth, finger: int) -> bool:
    return any(d.value < -DOUBTFUL for d in worth.differences((finger,)))


def _least_missed(trials: _Trials, hands: Sequence[Fingers]) -> list[Fingers]:
    """Hands of which more than a first look is worth while, the best one first."""
    if not hands:
        return []
    trials.simulate([(), *hands], SCREENED, trials.conditions[0])
    worth = trials.worth()
    missed = {hand: min(worth.differences(hand)).value for hand in hands}
    likely = [hand for hand in hands if missed[hand] >= -DOUBTFUL]
    return sorted(likely, key=lambda hand: -missed[hand])


def _decide(trials: _Trials, hand: Fingers) -> bool:
    """Whether a hand is no worse; it is given up in the first condition that does not show it."""
    for condition in trials.conditions:
        trials.simulate([(), hand], DECISIVE, condition)
        if min(trials.worth().differences(hand), key=lambda d: d.low).low < -MARGIN:
            return False
    return True
