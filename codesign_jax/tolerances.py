"""What share of hands as they are cast keeps what the design keeps, and which tolerance to tighten.

Every hand deviates from the design: each finger's wall, length and mount by itself, the modulus of
the silicone as a whole, and the constants that the scene draws.  All hands meet the same trials.
What a tolerance is worth is read off a regression over the same grasps: the logit of the share that
a hand keeps, over its deviations and over the sum of squares of each kind of them.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize, special

from codesign_jax import batch, rollout
from codesign_jax.engines import Engine
from codesign_jax.interrupts import interruptible
from codesign_jax.judge import verdict
from codesign_jax.judge.cases import Case
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.scene import Scene, draws, schema
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.statistics import Interval, wilson
from codesign_jax.types import Outcome, Params


class Kind(NamedTuple):
    """A tolerance: what it is of, two standard deviations of a normal distribution."""

    usual: float  # its value [unit]
    unit: str
    size: float  # the unit in those of `keys`
    keys: tuple[str, ...]  # key paths; with {} for each finger
    words: str


KINDS = {
    "wall": Kind(0.3, "mm", 1e-3, ("design.wall.{}",), "walls of each finger"),
    "length": Kind(1.0, "mm", 1e-3, ("design.length.{}",), "length of each finger"),
    "modulus": Kind(10.0, "%", 0.01, ("hand.material.shear_modulus",), "modulus of the silicone"),
    "mount": Kind(
        2.0,
        "deg",
        1.0,
        ("hand.finger.{}.tilt", "hand.finger.{}.azimuth"),
        "tilt and azimuth of each mount",
    ),
}
"""Tolerances by their names; the values are those of careful hand casting [chosen]."""
CONSTANTS = "constants"
"""Name of what the scene draws itself."""
WANTED = 0.95
"""Share of grasps that a hand is to keep."""
HANDS = 64
TRIALS = 24
"""Hands, and grasps of each."""
STREAM = 0x746F6C65
"""Stream of the deviations ("tole")."""
VIRTUAL = 2000
"""Hands of the regression."""
RESAMPLES = 100
"""Resamples of hands for the intervals of the regression."""
RIDGE = 1.0
"""Prior standard deviation of the regression's slopes, in logits [chosen]."""


class Yield(NamedTuple):
    """What cast hands keep; the first hand is the design itself."""

    kept: np.ndarray  # grasps that each hand kept, shape (hand,)
    trials: int  # grasps of each
    scores: np.ndarray  # deviations over their standard deviations, shape (hand, deviation)
    kinds: tuple[str, ...]  # kind of each deviation
    tolerance_widths: Mapping[str, float]  # tolerances that are not the usual ones, by kind

    @property
    def needed(self) -> int:
        """Kept grasps from which on a hand is good."""
        return math.ceil(WANTED * self.trials - 1e-9)

    @property
    def share(self) -> Interval:
        """Share of hands that are good, with Wilson's interval."""
        cast = self.kept[1:]
        return wilson(int((cast >= self.needed).sum()), len(cast))

    @property
    def head(self) -> tuple[str, str, str]:
        """Names of the columns of `rows`."""
        return "tolerance of the", "+-", "good hands if halved"

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """Each kind, its tolerance, and the gain in good hands if that is halved; best first."""
        table = []
        gains = sorted(self.halved().items(), key=lambda pair: -pair[1].value)
        for name, gain in gains:
            kind = KINDS.get(name)
            size = "as drawn"
            if kind is not None:
                size = f"{self.tolerance_widths.get(name, kind.usual):g} {kind.unit}"
            # Plus 0.0, so that none is written as -0.
            value, low, high = (round(100 * v) + 0.0 for v in gain)
            points = f"{value:+.0f} points ({low:+.0f} to {high:+.0f})"
            table.append(("scene's constants" if kind is None else kind.words, size, points))
        return table

    @property
    def summary(self) -> str:
        """The share of good hands in words."""
        share, low, high = self.share
        return (
            f"{100 * share:.0f} % of {len(self.kept) - 1} cast hands keep {100 * WANTED:.0f} % of "
            f"{self.trials} grasps ({100 * low:.0f} to {100 * high:.0f} %); the design itself "
            f"keeps {self.kept[0]}"
        )

    def lines(self) -> list[str]:
        """The share of good hands, and what each tolerance is worth, as aligned text."""
        table = [self.head, *self.rows]
        widths = [max(len(row[k]) for row in table) for k in range(3)]
        cells = [(a.ljust(widths[0]), b.rjust(widths[1]), c) for a, b, c in table]
        return [f"tolerances: {self.summary}", *("  " + "  ".join(c).rstrip() for c in cells)]

    def halved(self) -> dict[str, Interval]:
        """By how much the share of good hands grows if one kind of deviations is halved.

        By the regression, with an interval by resampling of hands.
        """
        random = np.random.default_rng(STREAM)
        virtual = random.normal(size=(VIRTUAL, len(self.kinds)))
        names = list(dict.fromkeys(self.kinds))
        rows = np.arange(1, len(self.kept))
        gains = [self._gains(rows, virtual, names)]
        for _ in range(RESAMPLES):
            gains.append(self._gains(random.choice(rows, len(rows)), virtual, names))
        low, high = np.quantile(gains, (0.025, 0.975), axis=0)
        ends = zip(names, gains[0], low, high, strict=True)
        return {name: Interval(*map(float, bounds)) for name, *bounds in ends}

    def _gains(self, rows: np.ndarray, virtual: np.ndarray, names: list[str]) -> np.ndarray:
        # The design itself is known best: its grasps count once in every fit.
        chosen = np.append(0, rows)
        slopes = regression(self._terms(self.scores[chosen]), self.kept[chosen], self.trials)
        now = self._good(virtual, slopes)
        gains = []
        for name in names:
            half = np.where(np.array(self.kinds) == name, 0.5, 1.0)
            gains.append(self._good(half * virtual, slopes) - now)
        return np.array(gains)

    def _good(self, scores: np.ndarray, slopes: np.ndarray) -> float:
        """Share of hands with these deviations that are good, by the regression."""
        share = special.expit(self._terms(scores) @ slopes)
        return float(special.bdtrc(self.needed - 1, self.trials, share).mean())

    def _terms(self, scores: np.ndarray) -> np.ndarray:
        kinds = np.array(self.kinds)
        squares = [(scores[:, kinds == name] ** 2).mean(1) for name in dict.fromkeys(self.kinds)]
        return np.column_stack([np.ones(len(scores)), scores, *squares])


def regression(terms: np.ndarray, kept: np.ndarray, trials: int) -> np.ndarray:
    """Slopes of the logit of a binomial share, with a ridge on all but the first.

    Args:
      terms: Shape (hand, term), the first a column of ones.
      kept: Successes, shape (hand,).
      trials: Trials of each hand.
    """
    ridge = np.full(terms.shape[1], RIDGE**-2)
    ridge[0] = 1e-3

    def cost(slopes: np.ndarray) -> tuple[float, np.ndarray]:
        logit = terms @ slopes
        value = (trials * np.logaddexp(0, logit) - kept * logit).sum()
        slope = terms.T @ (trials * special.expit(logit) - kept)
        return value + (ridge * slopes**2).sum() / 2, slope + ridge * slopes

    def curvature(slopes: np.ndarray) -> np.ndarray:
        share = special.expit(terms @ slopes)
        return terms.T @ ((trials * share * (1 - share))[:, None] * terms) + np.diag(ridge)

    start = np.zeros(terms.shape[1])
    return optimize.minimize(cost, start, jac=True, hess=curvature, method="trust-exact").x


def table(
    scene: Scene, tolerance_widths: Mapping[str, float]
) -> tuple[draws.Constants, tuple[str, ...]]:
    """The deviations of a hand, and their kinds.

    Args:
      tolerance_widths: Tolerances by name in their units; others have their usual values, those
        of 0 none.
    """
    entries = []
    kinds = []
    for name, kind in KINDS.items():
        spread = tolerance_widths.get(name, kind.usual) * kind.size / 2
        if not spread:
            continue
        keys = [k.format(i) for k in kind.keys for i in range(scene.num_fingers)]
        for key in dict.fromkeys(keys):
            factor = name == "modulus"
            entries.append(
                draws.Constant(
                    key=key,
                    source=kind.words,
                    distribution="lognormal" if factor else "normal",
                    change="factor" if factor else "shift",
                    mean=1.0 if factor else 0.0,
                    sd=spread,
                )
            )
            kinds.append(name)
    return draws.Constants(constant=tuple(entries)), tuple(kinds)


def read(words: tuple[str, ...]) -> dict[str, float]:
    """Tolerances from NAME=VALUE.

    Raises:
      InputError: With every word that is none.
    """
    values = {}
    problems = []
    for word in words:
        name, _, text = word.partition("=")
        if name not in KINDS:
            problems.append(
                schema.Problem(
                    "unknown", f"--tolerances {schema.shown(word)}: {schema.nearest(name, KINDS)}"
                )
            )
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0 <= value <= 20 * KINDS[name].usual:
            most = f"{20 * KINDS[name].usual:g} {KINDS[name].unit}"
            problems.append(
                schema.Problem(
                    "range", f"--tolerances {schema.shown(word)} must be a number from 0 to {most}"
                )
            )
        values[name] = value
    if problems:
        raise schema.InputError(problems)
    return values


def simulate(
    case: Case,
    tolerance_widths: Mapping[str, float],
    key: jax.Array,
    *,
    hands: int = HANDS,
    trials: int = TRIALS,
    done: Callable[[int], None] = lambda grasps: None,
) -> Yield:
    """Simulates the design and hands that deviate from it, all in the same trials.

    Args:
      tolerance_widths: Tolerances by name, see `table`.
      key: Key of trials and deviations.
      hands: Number of hands beside the design.
      trials: Grasps of each.
      done: Is told the grasps of each call.
    """
    scene = case.scene
    deviating_constants, kinds = table(scene, tolerance_widths)
    known = scene.drawn
    random = jax.random.fold_in(key, STREAM)
    cast = np.array(draws.deviations(deviating_constants, random, hands))
    spread = np.array([entry.sd for entry in deviating_constants.constant])
    factor = np.array([entry.is_factor for entry in deviating_constants.constant])
    scores = np.where(factor, np.log(np.where(factor, cast, 1.0)), cast) / spread
    if known.constant:
        more = np.array(draws.deviations(known, jax.random.fold_in(random, 1), hands))
        cast = np.hstack([cast, more])
        scores = np.hstack([scores, _standard(more)])
        kinds += (CONSTANTS,) * more.shape[1]
    exact = np.array(
        [entry.deviation(0.0) for entry in (*deviating_constants.constant, *known.constant)]
    )
    every = np.vstack([exact, cast])
    run = SceneProgram(scene, _cast(case.make_engine(), case.space, deviating_constants, trials))
    design = jnp.asarray(case.design, jnp.float32)
    parts = []
    for outcome in batch.in_chunks(
        lambda rows: interruptible(run, design, (key, jnp.asarray(every[rows], jnp.float32))),
        hands + 1,
        batch.size(hands + 1, trials),
    ):
        parts.append(verdict.kept(outcome).sum(1))
        done(outcome.cost.size)
    zero = np.zeros((1, len(kinds)))
    return Yield(np.concatenate(parts), trials, np.vstack([zero, scores]), kinds, tolerance_widths)


def _standard(values: np.ndarray) -> np.ndarray:
    """Columns about their means, over their deviations."""
    return (values - values.mean(0)) / np.maximum(values.std(0), 1e-9)


@shared
def _cast(
    engine: Engine, space: DesignSpace, deviation_table: draws.Constants, count: int
) -> Callable:
    """Grasps of hands with deviations, first those of the table and then the scene's constants."""
    of_design = [i for i, entry in enumerate(deviation_table.constant) if entry.path[0] == "design"]
    of_scene = [i for i in range(len(deviation_table.constant)) if i not in of_design]
    scene_deviations = draws.Constants(
        constant=tuple(deviation_table.constant[i] for i in of_scene)
    )

    def simulated(design: jax.Array, noise: tuple[jax.Array, jax.Array], scene: Scene) -> Outcome:
        key, deviations = noise
        hands = len(deviations)
        trials = rollout.sample_trials(scene, key, count)
        params = jax.tree.map(lambda v: jnp.repeat(v[None], hands, 0), space.params(design))
        for i in of_design:
            params = deviating(params, deviation_table.constant[i].path, deviations[:, i])
        each = jnp.repeat(deviations, count, 0)
        if scene.drawn.constant:
            trials = trials._replace(constants=None)
        _, params, worlds = rollout.crossed(scene, params, trials)
        if scene.drawn.constant:
            worlds = worlds._replace(constants=each[:, len(deviation_table.constant) :])
        changed = draws.applied(scene, scene_deviations, [each[:, i] for i in of_scene])
        outcomes, _ = rollout.simulate(changed, engine, params, worlds)
        return rollout.grid(outcomes, (hands, count))

    return jax.jit(simulated)  # thousands of grasps


def deviating(params: Params, path: tuple[str, ...], shift: jax.Array) -> Params:
    """Hands one of whose fingers has another wall or length; a tapered wall all along.

    Args:
      params: Hands with leading axis (hand,).
      path: "design", the parameter's name and the finger's number.
      shift: Of each hand [m], shape (hand,).
    """
    name = path[1]
    finger = int(path[2])
    sizes = getattr(params, name).at[:, finger].add(shift)
    params = params._replace(**{name: sizes})
    if name == "wall" and params.tip is not None:
        tip = params.tip._replace(wall=params.tip.wall.at[:, finger].add(shift))
        params = params._replace(tip=tip)
    return params
