"""Hands that lack fingers: as data, as another hand, and what each finger is worth."""

from functools import partial

import jax
import numpy as np
import pytest

from codesign_jax import model, rollout, scene
from codesign_jax.judge import stress, verdict, worth
from codesign_jax.judge.cases import Case
from codesign_jax.model.fields import AWAY
from codesign_jax.runs import reference
from codesign_jax.scene import parameters
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Outcome
from tests.helpers import grasps

PAPER = scene.load("paper")
SPACE = parameters.design_space(PAPER.hand, "full")
PARAMS = SPACE.params(SPACE.default())


def case(the_scene, engine="structured"):
    space = parameters.design_space(the_scene.hand)
    return Case(the_scene, space, space.default(), engine)


@pytest.mark.parametrize(
    ("engine", "within"),
    [
        # float64: what is left is the micrometre's mass and the palm's
        pytest.param("mujoco", 1e-6, marks=pytest.mark.slow),
        ("structured", 1e-4),  # float32, of places after 0.6 s in contact
    ],
)
def test_an_absent_finger_is_as_none(engine, within):
    """Against a hand that has one finger, by the same engine: bodies, contacts, hand's centre."""
    whole = case(grasps.short_grasp(), engine)
    fewer = whole.without((1,))
    trials = rollout.sample_trials(whole.scene, jax.random.key(3), 4)

    def program(of_case):
        simulate = partial(rollout.simulate, of_case.scene, of_case.make_engine())
        return jax.jit(lambda params: simulate(params, trials)[1])

    both = whole.space.params(whole.design)
    trace = program(whole)
    absent = trace(grasps.repeat(worth.without(both, (1,)), 4))
    none = program(fewer)(grasps.repeat(fewer.space.params(fewer.design), 4))
    present = trace(grasps.repeat(both, 4))
    for name in ("distance", "height"):
        ours, theirs, other = (np.asarray(getattr(t, name)) for t in (absent, none, present))
        np.testing.assert_allclose(ours, theirs, atol=within, err_msg=name)
        assert abs(other - theirs).max() > 1e-3, "the finger would be seen"


@pytest.mark.parametrize("length", [np.nan, -0.1])
def test_a_length_that_is_none_is_no_absent_finger(length):
    """It stays what it is, and the world is refused."""
    bad = np.asarray(PARAMS.length).copy()
    bad[1] = length
    fields = model.model_fields(PAPER, PARAMS._replace(length=bad), grasps.still())
    assert not np.allclose(fields.base[1], AWAY)
    assert float(fields.share[1]) == 1.0 and not (np.asarray(fields.mass[1]) > 0).all()


def test_a_hand_without_fingers_has_the_numbers_of_the_others():
    """By name, in units and for a table with an array for each finger."""
    for hand in ("pneuflex4_wide", "tapered4", "thumb4"):
        the_scene = scene.load("paper", hand_name=hand)
        space = parameters.design_space(the_scene.hand, "full")
        design = np.asarray(space.sample(jax.random.key(0), 1)[0])
        fewer = Case(the_scene, space, design, "structured").without((3, 1))
        before, after = space.params(design), fewer.space.params(fewer.design)
        assert fewer.scene.num_fingers == 2
        for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
            expected = np.asarray(a)[[0, 2]] if np.shape(a) == (4,) else a
            np.testing.assert_allclose(b, expected, rtol=1e-6, atol=1e-9)
        azimuths = [the_scene.hand.finger[f].azimuth for f in (0, 2)]
        assert [f.azimuth for f in fewer.scene.hand.finger] == azimuths


@pytest.mark.parametrize(
    ("fingers", "policy", "problem"),
    [
        ((4,), "", r"--without = 4 is outside \[0, 3\]"),
        ((-1,), "", "outside"),
        ((0, 1, 2, 3), "", "names all fingers"),
        ((1,), "mine:Policy", "a policy commands all fingers"),
    ],
)
def test_fingers_that_cannot_leave_are_refused(fingers, policy, problem):
    with pytest.raises(InputError, match=problem):
        Case(PAPER, SPACE, SPACE.default(), "structured", policy).without(fingers)


class Hands:
    """In place of a simulation: which hands keep an object is known without any physics."""

    def __init__(self, keeps):
        self.keeps = keeps  # of the fingers that are there, the condition, and the trial's draw
        self.grasps = 0

    def outcomes(self, hands, trials, the_scene):
        mass = float(the_scene.objects.object[0].mass)
        friction = float(the_scene.objects.object[0].friction)
        name = "heavy" if mass > 0.1 else "slippery" if friction < 0.5 else "as it is"
        lengths = np.asarray(hands.length)
        present = [frozenset(np.flatnonzero(row).tolist()) for row in lengths]
        draws = np.asarray(trials.position)[:, 0]
        kept = np.array([self.keeps(p, name, x) for p, x in zip(present, draws, strict=True)])
        assert (np.asarray(hands.pressure)[lengths == 0] == 0).all()
        self.grasps += len(kept)
        times = np.where(kept, np.inf, 4.0)
        return Outcome(np.zeros(len(kept)), np.zeros(len(kept), int), times, 0 * kept - 1)


def simulated(monkeypatch, keeps):
    hands = Hands(keeps)
    monkeypatch.setattr(worth._Trials, "_outcomes", lambda self, *worlds: hands.outcomes(*worlds))
    return worth.simulate(PAPER, None, PARAMS, jax.random.key(0)), hands


@pytest.mark.parametrize(
    ("keeps", "least", "words"),
    [
        (lambda hand, name, x: hand >= {0, 2}, (1, 3), ["needed", "not needed"] * 2),
        (lambda hand, name, x: hand >= {0, 1, 2, 3}, (), ["needed"] * 4),
        (lambda hand, name, x: 0 in hand, (1, 2, 3), ["needed", *["not needed"] * 3]),
        # With heavy objects finger 1 is needed, with slippery ones finger 3.
        (lambda hand, name, x: hand >= {0, 1} or name != "heavy", (2, 3), ["needed"] * 2),
        (lambda hand, name, x: hand >= {3} or name != "slippery", (0, 1, 2), ["not needed"]),
        # Any two of four.
        (lambda hand, name, x: len(hand) >= 2, (0, 1), ["not needed"] * 2 + ["undecided"] * 2),
        # Three hundredths of the grasps are lost by every hand, in the same trials.
        (lambda hand, name, x: hand >= {0} and x < 0.0094, (1, 2, 3), ["needed"]),
    ],
)
def test_the_least_hand_that_is_no_worse_is_known(monkeypatch, keeps, least, words):
    result, hands = simulated(monkeypatch, keeps)
    assert len(result.least) == len(least) and (len(least) == 2 or result.least == least)
    assert [result.judgement(f) for f in range(len(words))] == words
    assert not result.least or result.no_worse(result.least)
    # Trials are the same: no pair differs where no finger matters.
    for hand in result.hands:
        row = result.hands.index(hand)
        assert (result.both + result.whole + result.fewer <= result.total).all()
        if set(hand) <= set(result.least):
            assert result.whole[row].sum() == 0
    assert hands.grasps <= 2394 / 2 and len(result.rows) == len(result.hands)
    assert len(result.lines()) == 1 + len(result.hands)
    assert result.sentence.startswith("the hand without") == bool(least)


def test_a_hand_that_is_worse_by_the_margin_is_rarely_called_no_worse(monkeypatch):
    """Independent losses of 2 % of the whole hand, of 12 % without finger 1: at most 5 of 100."""
    random = np.random.default_rng(0)
    wrong = 0
    monkeypatch.setattr(worth.rollout, "sample_trials", lambda s, k, n: flat(n))
    for _ in range(200):

        def keeps(hand, name, x):
            return hand >= {0, 2, 3} and random.random() > (0.02 if 1 in hand else 0.12)

        wrong += simulated(monkeypatch, keeps)[0].no_worse((1,))
    assert wrong <= 10


def flat(count):
    """Trials without noise; `rollout.sample_trials` compiles for each number."""
    return grasps.repeat(grasps.still(), count)


def test_results_are_kept_and_damaged_ones_are_not_taken(monkeypatch, tmp_path):
    result, _ = simulated(monkeypatch, lambda hand, name, x: hand >= {0, 2})
    path = tmp_path / reference.FINGERS_FILE
    about = "a design"
    reference.array_files.save_results(path, about, result._asdict())
    again, why = reference.read_worth(tmp_path, about)
    assert not why and again.least == result.least and again.rows == result.rows
    for name, value in {"both": result.both + 99, "absent": result.absent[0]}.items():
        reference.array_files.save_results(path, about, result._asdict() | {name: value})
        assert reference.read_worth(tmp_path, about)[0] is None
    assert reference.read_worth(tmp_path / "other", about) == (None, "")


def test_conditions_are_those_of_the_stress_test():
    names = [name for name, _ in worth._conditions(PAPER)]
    assert {*names[1:]} <= {name for name, _ in stress.variants(PAPER)}
    assert names == [stress.AS_IT_IS, "objects of 200 g", "friction 0.4 on the hand"]


def test_the_margin_is_reached_by_so_many_trials():
    """Else no hand could be no worse after them; and a first look would not do."""
    low = {n: worth.statistics.paired(n, 0, 0, n).low for n in (worth.SCREENED, worth.DECISIVE)}
    assert low[worth.SCREENED] < -worth.MARGIN <= low[worth.DECISIVE]
    assert worth.MARGIN == 2 * round(verdict.WANTED - verdict.POOR, 9)
