"""Design spaces: Table I, presets, ties, units, limits; arguments of another shape or unit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from codesign_jax import cli, codesign, make_engine, rollout, scene
from codesign_jax.scene import design_files, hand, parameters, unit_slips
from tests.helpers.refusals import refusal
from tests.helpers.toy_engine import TINY, tiny

HAND = hand.load("pneuflex4")
FULL = parameters.design_space(HAND)
PLANAR = parameters.design_space(HAND, "2d")
repeatable = settings(max_examples=30, deadline=None, derandomize=True)


def test_the_full_table_is_the_papers():
    assert FULL.num_parameters == 23
    assert sum(FULL.is_morphology) == 13
    rows = ["length", "height", "wall"]
    expected = [f"{row}[{i}]" for row in rows for i in range(4)]
    expected += ["spread", "arm_roll", "arm_yaw", "arm_pitch", "arm_z", "arm_x", "arm_y"]
    expected += [f"pressure[{i}]" for i in range(4)]
    assert FULL.names == tuple(expected)
    assert parameters.design_space(HAND, "23d") == FULL
    low = FULL.in_units(np.array(FULL.low))
    high = FULL.in_units(np.array(FULL.high))
    per_row = [(10, 180)] * 4 + [(15, 25)] * 4 + [(2, 7)] * 4 + [(0, 110)] + [(-60, 60)] * 3
    per_row += [(-50, 150), (-60, 60), (-60, 60)] + [(0, 150)] * 4
    np.testing.assert_allclose(np.stack([low, high], 1), per_row, rtol=1e-14)


def test_params_are_named_and_in_si_units():
    design = np.arange(1.0, 24.0) * FULL.scale  # 1, 2, ... in the file's units
    params = FULL.params(jnp.asarray(design))
    np.testing.assert_allclose(params.length, np.arange(1, 5) * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(params.height, np.arange(5, 9) * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(params.wall, np.arange(9, 13) * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(params.spread, np.deg2rad(13), rtol=1e-6)
    # The table has roll 14, yaw 15, pitch 16, z 17, x 18, y 19; Params has x y z roll pitch yaw.
    arm = np.array([18e-3, 19e-3, 17e-3, *np.deg2rad([14, 16, 15])])
    np.testing.assert_allclose(params.arm, arm, rtol=1e-6)
    np.testing.assert_allclose(params.pressure, np.arange(20, 24) * 1e3, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"), [("length[1]", 97.0), ("arm_pitch", 15.0), ("pressure[3]", 120e6)]
)
def test_other_units_than_si_are_refused(name, value):
    design = FULL.default()
    design[FULL.names.index(name)] = value
    for call in (FULL.params, FULL.project, FULL.refuse_unit_slips):
        assert refusal(call, jnp.asarray(design)) == [("range", name)]
    params = jax.jit(FULL.params)(jnp.asarray(design))  # whose values a trace does not know
    [(code, _)] = refusal(unit_slips.refuse, params)
    assert code == "range"


def test_designs_of_another_length_are_refused_by_the_conversion_of_units():
    """A single number would stand for every parameter: a length for the arm's height."""
    space = parameters.design_space(HAND, "2d")
    for convert in (space.from_units, space.in_units):
        assert convert([[95.0, 30.0]] * 3).shape == (3, 2)
        for design in (95.0, [95.0], [95.0, 30.0, 1.0], np.ones((2, 3))):
            assert refusal(convert, design) == [("size", "designs")]


def test_designs_outside_of_the_bounds_are_converted_with_a_warning():
    """At the boundary of units; what is in SI already is simulated as it is."""
    space = parameters.design_space(HAND, "2d")
    with pytest.warns(UserWarning, match=r"length = 0.095"):
        np.testing.assert_allclose(space.from_units([0.095, 30.0]), [95e-6, 0.03])
    with pytest.warns(UserWarning, match=r"length = 190.*arm_z = -70"):
        space.from_units([[100.0, 30.0], [190.0, -70.0]])
    for end in space.bounds:  # float32's rounding of a bound is none
        space.from_units(space.in_units(np.array(end, np.float32)))


def test_designs_that_are_not_legal_are_simulated_with_a_warning():
    """Uniform draws between the bounds break the pressure limit, `sample` does not."""
    key = jax.random.key(0)
    FULL.check(FULL.sample(key, 50))
    uniform = np.random.default_rng(0).uniform(FULL.low, FULL.high, (50, 23))
    legal = np.asarray(jax.vmap(FULL.project)(uniform))
    FULL.check(legal)
    above = int((uniform - legal > 1.0).any(1).sum())  # Pa, beyond float32's rounding
    assert 5 < above < 25
    with pytest.warns(UserWarning, match=f"{above} of 50 designs"):
        FULL.check(uniform)
    wide = FULL.default() + (FULL.high - FULL.low) * (np.asarray(FULL.names) == "arm_z")
    with pytest.warns(UserWarning, match=r"arm_z = 0.295"):
        FULL.check(wide)
    jax.eval_shape(lambda design: FULL.check(design), uniform)  # traced: the shape alone


def test_the_2d_preset_ties_lengths_and_fixes_the_rest():
    assert PLANAR.names == ("length", "arm_z") and PLANAR.is_morphology == (True, False)
    np.testing.assert_allclose(PLANAR.in_units(np.array(PLANAR.low)), [10, -60])
    np.testing.assert_allclose(PLANAR.in_units(np.array(PLANAR.high)), [180, 200])
    params = PLANAR.params(jnp.asarray([0.123, 0.045]))
    fixed = {p.name: p.fixed for p in HAND.preset}["2d"]
    np.testing.assert_allclose(params.length, 0.123, rtol=1e-6)
    np.testing.assert_allclose(params.arm[2], 0.045, rtol=1e-6)
    np.testing.assert_allclose(params.arm[0], fixed["arm_x"] * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(params.arm[4], np.deg2rad(fixed["arm_pitch"]), rtol=1e-6)
    np.testing.assert_allclose(params.pressure, 120e3, rtol=1e-6)


designs = st.lists(st.floats(0, 1, width=32, allow_subnormal=False), min_size=23, max_size=23).map(
    lambda u: np.array(FULL.low) + np.array(u) * (np.array(FULL.high) - np.array(FULL.low))
)


@repeatable
@given(designs)
def test_projection_keeps_pressures_strictly_below_their_limit(design):
    before = jnp.asarray(design, jnp.float32)
    after = PROJECT(before)
    params = FULL.params(after)
    assert (np.asarray(params.pressure) < np.float32(40e6) * np.asarray(params.wall)).all()
    np.testing.assert_array_equal(PROJECT(after), after)  # idempotent
    pressure = np.array([n.startswith("pressure") for n in FULL.names])
    np.testing.assert_array_equal(after[~pressure], before[~pressure])
    legal = np.asarray(before[pressure]) < np.float32(40e6) * (1 - 1e-5) * np.asarray(params.wall)
    np.testing.assert_array_equal(after[pressure][legal], before[pressure][legal])


PROJECT = jax.jit(FULL.project)


def test_a_tied_pressure_obeys_the_thinnest_wall():
    free = (hand.Free("wall"), hand.Free("pressure", tied=True))
    tied = dataclasses.replace(HAND, preset=(hand.Preset("tied", free),))
    space = parameters.design_space(tied, "tied")
    design = jnp.asarray([0.007, 0.005, 0.002, 0.006, 150e3])
    np.testing.assert_allclose(space.project(design)[-1], 80e3, rtol=1e-5)
    assert space.project(design)[-1] < 80e3


@pytest.mark.parametrize(
    ("tied", "names", "fingers"),
    [
        (((0, 3), (1, 2)), ["length[0+3]", "length[1+2]"], [0, 1, 1, 0]),
        (((1, 3),), ["length[0]", "length[1+3]", "length[2]"], [0, 1, 2, 1]),
        (((3, 1, 2),), ["length[0]", "length[3+1+2]"], [0, 1, 1, 1]),
        (((0, 1, 2, 3),), ["length"], [0, 0, 0, 0]),
        (True, ["length"], [0, 0, 0, 0]),
        (False, [f"length[{k}]" for k in range(4)], [0, 1, 2, 3]),
    ],
)
def test_groups_of_fingers_share_a_value(tied, names, fingers):
    """Of bounds the narrowest; a pressure that they share obeys the thinnest wall."""
    low = (60.0, 70.0, 80.0, 90.0)
    high = (100.0, 110.0, 120.0, 130.0)
    free = (hand.Free("length", tied, low, high), hand.Free("pressure", tied), hand.Free("wall"))
    tied_hand = dataclasses.replace(HAND, preset=(hand.Preset("own", free),))
    space = parameters.design_space(tied_hand, "own")
    lengths = [n for n in space.names if n.startswith("length")]
    assert lengths == names
    values = np.asarray(space.default(), np.float32)
    values[: len(names)] = 0.08 + np.arange(len(names)) / 1e3
    np.testing.assert_array_equal(space.params(jnp.asarray(values)).length, values[fingers])
    for k in range(len(names)):
        group = [i for i, own_index in enumerate(fingers) if own_index == k]
        ends = space.in_units(space.low)[k], space.in_units(space.high)[k]
        assert ends == pytest.approx((max(low[i] for i in group), min(high[i] for i in group)))
        numbers = parameters.fingers_of(names[k])
        assert numbers in (group, [], [3, 1, 2]) and all(type(n) is int for n in numbers)
    walls = np.array([0.007, 0.005, 0.002, 0.006])
    design = space.default()
    pressures = [n.startswith("pressure") for n in space.names]
    design[pressures] = 150e3
    design[[n.startswith("wall") for n in space.names]] = walls
    allowed = np.asarray(space.project(design))[pressures]
    limits = [min(walls[i] for i in range(4) if fingers[i] == k) * 40e6 for k in range(len(names))]
    np.testing.assert_allclose(allowed, np.minimum(limits, 150e3), rtol=1e-5)


THUMB = hand.load("thumb4")


def test_fingers_may_have_values_and_bounds_of_their_own():
    """The file has [60, 60, 60, 40] to [180, 180, 180, 110] mm, default [100, 100, 100, 75]."""
    space = parameters.design_space(THUMB)
    low = space.in_units(np.array(space.low))
    high = space.in_units(np.array(space.high))
    np.testing.assert_allclose(low[:4], [60, 60, 60, 40])
    np.testing.assert_allclose(high[:4], [180, 180, 180, 110])
    np.testing.assert_allclose(space.in_units(space.default())[:4], [100, 100, 100, 75])
    np.testing.assert_allclose(high[4:8], 25)  # a number is for all fingers
    fixed = parameters.design_space(THUMB, "2d").params(jnp.asarray([0.8, 0.01]))
    np.testing.assert_allclose(fixed.length, [0.1, 0.1, 0.1, 0.075], rtol=1e-6)
    np.testing.assert_allclose(fixed.pressure, [110e3, 110e3, 110e3, 140e3], rtol=1e-6)
    np.testing.assert_allclose(fixed.wall, 0.005, rtol=1e-6)


@pytest.mark.parametrize("the_hand", [HAND, THUMB], ids=lambda h: h.name)
def test_sampled_designs_are_legal_and_uniform_where_no_limit_acts(the_hand):
    space = parameters.design_space(the_hand)
    designs = np.asarray(space.sample(jax.random.key(0), 2000))
    assert (designs.astype(float) >= space.low).all() and (
        designs.astype(float) <= space.high
    ).all()
    params = parameters.params_of(space, designs)
    limit = np.float32(40e6) * np.asarray(params.wall)
    assert (np.asarray(params.pressure) < limit).all()
    # Of a thick wall every pressure is legal; others are lowered and no longer uniform.
    free = np.array([name.startswith("pressure") for name in space.names])
    thick = np.ones(designs.shape, bool)
    thick[:, free] = limit > space.high[free]
    scaled = (designs - space.low) / (space.high - space.low)
    p_values = [stats.kstest(scaled[thick[:, k], k], "uniform").pvalue for k in range(len(free))]
    # The smallest of 23 p-values of a true hypothesis is below 1e-4 once in 400 seeds.
    assert min(p_values) > 1e-4
    lowered = (np.asarray(params.pressure) > limit * (1 - 1e-5)).any(1).mean()
    assert 0.2 < lowered < 0.5  # so the limit was met


# --- arguments: missing axes, lengths and units are answered in words -----------------------------


SCENE, SPACE, ENGINE = tiny()
PARAMS = jax.tree.map(np.asarray, SPACE.params(SPACE.default()))
TRIAL = jax.tree.map(np.asarray, rollout.nominal_trial(SCENE))
OPTIMIZER = codesign.make_filter(SPACE)
TASK = codesign.Task(SCENE, SPACE, 2, ENGINE)


def batch(tree, count):
    return jax.tree.map(lambda v: np.broadcast_to(v, (count, *np.shape(v))), tree)


def simulate(params, trials, **more):
    return rollout.simulate(SCENE, ENGINE, params, trials, **more)


def evaluate(population):
    return TASK.evaluate(jnp.asarray(population), jax.random.key(0))


def draw(key, count):
    """Trials, as a program that JAX traces draws them."""
    return jax.eval_shape(lambda k: rollout.sample_trials(SCENE, k, count), key)


FINER = scene.load(TINY, overrides={"discretization.links": 4, "effects.twist": True})
LONG = dataclasses.replace(SCENE, gravity=np.full(5, 9.81))
KEY = ("type", "key")
CASES = {
    "an engine of another scene": (
        lambda: rollout.simulate(FINER, ENGINE, batch(PARAMS, 1), batch(TRIAL, 1)),
        [("unsupported", "engine toy")],
    ),
    "one hand": (lambda: simulate(PARAMS, batch(TRIAL, 3)), [("size", "params")]),
    "an array of another length": (
        lambda: simulate(batch(PARAMS, 2)._replace(spread=np.zeros(3)), batch(TRIAL, 2)),
        [("size", "")],
    ),
    "a number for a key": (lambda: draw(0, 3), [KEY]),
    "trials for a key": (
        lambda: TASK.evaluate(SPACE.default()[None], batch(TRIAL, 2)),  # type: ignore[arg-type]
        [KEY],
    ),
    "trials for a key that draws trials": (lambda: draw(batch(TRIAL, 2), 3), [KEY]),
    "trials for a key that draws designs": (lambda: SPACE.sample(batch(TRIAL, 2), 3), [KEY]),
    "a word for a key": (
        lambda: TASK.evaluate(SPACE.default()[None], "seed"),  # type: ignore[arg-type]
        [KEY],
    ),
    "several keys": (
        lambda: TASK.evaluate(SPACE.default()[None], jax.random.split(jax.random.key(0), 2)),
        [KEY],
    ),
    "named parameters for a population": (
        lambda: TASK.evaluate(batch(PARAMS, 2), jax.random.key(0)),
        [("type", "population")],
    ),
    "a key for a state": (
        lambda: TASK.episode(OPTIMIZER, jax.random.key(0)),  # type: ignore[arg-type]
        [("type", "state")],
    ),
    "trials for a scene": (
        lambda: TASK.evaluate(SPACE.default()[None], jax.random.key(0), batch(TRIAL, 2)),  # type: ignore[arg-type]
        [("type", "scene")],
    ),
    "designs for named parameters": (
        lambda: simulate(SPACE.default()[None], batch(TRIAL, 1)),
        [("type", "params")],
    ),
    "hands and trials that changed places": (
        lambda: simulate(batch(TRIAL, 2), batch(PARAMS, 2)),
        [("type", "params"), ("type", "trials")],
    ),
    "an engine's name for an engine": (
        lambda: rollout.simulate(SCENE, "mujoco", batch(PARAMS, 1), batch(TRIAL, 1)),  # type: ignore[arg-type]
        [("type", "engine")],
    ),
    "a scene's name for a scene": (
        lambda: make_engine("structured", "paper"),  # type: ignore[arg-type]
        [("type", "scene")],
    ),
    "numbers": (
        lambda: rollout.simulate(LONG, ENGINE, batch(PARAMS, 2), batch(TRIAL, 2)),
        [("size", "scene.gravity")],
    ),
    "one design": (lambda: evaluate(SPACE.default()), [("size", "population")]),
    "millimetres": (lambda: evaluate([[97.0, 0.02]]), [("range", "length")]),
    "one hand while tracing": (
        lambda: jax.jit(lambda p, t: simulate(p, t))(PARAMS, batch(TRIAL, 3)),
        [("size", "params")],
    ),
}
"""Calls, and kind and key of their problems."""


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_said(case):
    call, problems = CASES[case]
    assert refusal(call) == problems


def test_an_optimiser_refuses_what_is_no_key_and_what_is_no_start():
    """By errors of Python's own kinds: the package of optimisers knows no scenes."""
    with pytest.raises((TypeError, ValueError)):
        OPTIMIZER.init(batch(TRIAL, 2), SPACE.default(), 3)
    with pytest.raises(ValueError, match=r"seed_particle\[0\]"):
        OPTIMIZER.init(jax.random.key(0), np.array([97.0, 20.0]), 3)  # millimetres


def test_a_spread_that_turns_no_finger_is_named_and_not_searched(capsys):
    """It stays at its default, and the number of parameters says what is searched."""
    flat = {f"hand.finger.{i}.spread": 0.0 for i in range(3)}
    bare = scene.load("paper", hand_name="tripod3", overrides=flat).hand
    space = parameters.design_space(bare)
    assert "spread" not in space.names and space == parameters.design_space(bare, "18d")
    assert space.idle == (("spread", "every finger has spread = 0"),)
    assert not parameters.design_space(bare, "2d").idle
    whole = parameters.design_space(scene.load("paper", hand_name="tripod3").hand)
    assert float(space.params(space.default()).spread) == float(
        whole.params(whole.default()).spread
    )
    problems = refusal(design_files.parse, space, ["spread=20"], space.default())
    assert problems == [("unsupported", "--design 'spread'")]
    spread = hand.Preset("one", (hand.Free("spread"),))
    alone = dataclasses.replace(bare, preset=(spread,))
    [(code, _)] = refusal(parameters.design_space, alone, "one")
    assert code == "missing"
    words = ["effects.finger_finger=false", *(f"{key}={value}" for key, value in flat.items())]
    line = ["evaluate", "--hand", "tripod3", "--preset", "full", "--dry-run", "--set", *words]
    assert cli.main(line) == 0
    assert "not searched: spread, which has no effect" in capsys.readouterr().out
