"""History matching: sets of constants, landscapes with known regions, the filter on landscapes."""

import argparse
import dataclasses
import itertools
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

from codesign_jax import codesign, rollout, scene
from codesign_jax.archives import Store
from codesign_jax.codesign import stream_key
from codesign_jax.optimize import State, candidates, schedule
from codesign_jax.scene import parameters, schema
from codesign_jax.types import Status
from scripts.calibration import __main__ as calibrate
from scripts.calibration import files, report, score, summary, surrogate
from scripts.calibration.wave import Size, Wave, keep, trial_costs
from scripts.experiments.landscape import STREAM_GRID
from scripts.shared import sets
from tests.helpers.toy_engine import ToyEngine, tiny

AXIS = np.arange(12.0)


def quiet(_):
    """Says nothing."""


# --- sets of constants ---------------------------------------------------------------------------


def test_sets_fill_their_ranges_and_every_beginning_does():
    units = sets.space_filling(64, seed=3)
    np.testing.assert_array_equal(units[:16], sets.space_filling(16, seed=3))
    # A Sobol sequence has one of its first 16 points in each sixteenth of every axis.
    for column in units[:16].T:
        assert sorted(np.floor(16 * column)) == list(range(16))
    found = sets.values(units)
    for o in sets.OPEN:
        assert o.low <= found[o.name].min() and found[o.name].max() <= o.high
    middle = sets.values(np.full((1, len(sets.OPEN)), 0.5))
    assert middle["mass"] == pytest.approx(np.sqrt(20 * 300)) and middle["tilt"] == 60.0
    assert (found["pair_gap"] >= found["width"] + 2.0).all()


def test_numbers_of_a_set_are_those_of_the_files():
    """The numbers that a set changes, against the same values set by key path."""
    units = sets.space_filling(3, seed=1)
    v = {name: values[2] for name, values in sets.values(units).items()}
    x, y, size = 1e-3 * v["base_x"], 0.5e-3 * v["pair_gap"], 1e-3 * v["half_size"]
    bases = [[x, y], [x, -y], [-x, -y], [-x, y]]
    changes = {f"hand.finger.{i}.base": base for i, base in enumerate(bases)}
    changes |= {f"hand.finger.{i}.tilt": v["tilt"] for i in range(4)}
    for name, sizes in (
        ("cuboid", [size] * 3),
        ("cylinder", [size, 1.2 * size]),
        ("sphere", [size]),
    ):
        changes |= {
            f"objects.object.{name}.size": sizes,
            f"objects.object.{name}.mass": 1e-3 * v["mass"],
            f"objects.object.{name}.friction": v["friction"],
        }
    changes |= {
        "hand.material.shear_modulus": 1e3 * v["shear_modulus"],
        "hand.material.lateral_factor": v["lateral"],
        "hand.material.torsion_factor": v["torsion"],
        "hand.section.width": 1e-3 * v["width"],
        "hand.wrist.linear_stiffness": v["wrist_linear"],
        "hand.wrist.linear_damping": 17.0 * np.sqrt(v["wrist_linear"] / 180.0),
        "hand.wrist.angular_stiffness": v["wrist_angular"],
        "hand.wrist.angular_damping": 0.2 * np.sqrt(v["wrist_angular"] / 12.0),
        "objects.table.friction": v["table_friction"],
        "arm.zero_height": 1e-3 * v["zero_height"],
        "arm.shake_amplitude": v["shake_amplitude"],
        "arm.shake_frequency": v["shake_frequency"],
        "contact.normal_stiffness": 1e3 * v["normal_stiffness"],
        "contact.friction_ratio": v["friction_ratio"],
        "cost.maximum": v["cost_maximum"],
    }
    expected = scene.load("paper", overrides=changes).constants()
    found = sets.numbers(scene.load("paper"), sets.values(units))
    third = jax.tree.map(lambda n: float(n[2] if np.ndim(n) else n), found)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), third, expected)


def test_factors_scale_the_stiffness_of_joints():
    from codesign_jax.model import morphology
    from tests.helpers.grasps import hand_world

    plain = scene.load("paper_spheres").hand
    material = dataclasses.replace(plain.material, lateral_factor=0.29, torsion_factor=3.0)
    params, _ = hand_world(scene.load("paper_spheres"))
    soft, stiff = (
        morphology.finger_beams(h, params)
        for h in (dataclasses.replace(plain, material=material), plain)
    )
    np.testing.assert_allclose(soft.lateral, 0.29 * stiff.lateral)
    np.testing.assert_allclose(soft.torsion, 3.0 * stiff.torsion)
    np.testing.assert_allclose(soft.bending, stiff.bending)


def test_a_hand_on_a_circle_is_refused():
    with pytest.raises(schema.InputError, match="give each finger a base"):
        sets.numbers(scene.load("paper_spheres"), sets.values(sets.space_filling(2, 0)))


def test_sets_around_others_stay_near_and_inside():
    units = 0.02 + 0.1 * sets.space_filling(50, seed=0)
    drawn = sets.around(units, 400, seed=1)
    assert (drawn >= 0).all() and (drawn <= 1).all()
    # Means as those they were drawn around: 0.1 is the width of their box, folding at 0 included.
    assert np.abs(drawn.mean(0) - units.mean(0)).max() < 0.02
    assert drawn.max() < 0.3
    with pytest.raises(ValueError, match="too few"):
        sets.around(units[:2], 5, 0)


# --- a wave --------------------------------------------------------------------------------------


class Sensitive(ToyEngine):
    """Keeps the object longer the larger impratio is, and fails the worlds of the heaviest set."""

    def rollout(self, fields, ctrl, *, trajectory=False):
        trace = super().rollout(fields, ctrl, trajectory=trajectory)
        ratio = fields.constants.contact.friction_ratio
        time = np.arange(ctrl.shape[1]) * self.scene.discretization.timestep
        kept = time[None] < 0.4 + 0.1 * jnp.log(ratio)[:, None]
        heavy = fields.body_mass[:, -1] > 0.12
        distance = jnp.where(kept, 0.0, trace.distance)
        speed = jnp.where(heavy[:, None], jnp.nan, trace.speed)
        return trace._replace(distance=distance, speed=speed)


def sensitive():
    """The tiny scene with base points, its space and the engine."""
    the_scene, space, _ = tiny()
    fingers = tuple(
        dataclasses.replace(f, radius=None, base=(side * 0.035, 0.0))
        for f, side in zip(the_scene.hand.finger, (1, -1), strict=True)
    )
    the_scene = dataclasses.replace(
        the_scene, hand=dataclasses.replace(the_scene.hand, finger=fingers)
    )
    return the_scene, space, Sensitive(the_scene)


UNITS = sets.space_filling(5, seed=2)
SIZE = Size(points=4, trials=2, chunk=70)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A wave of five sets, two a call, its engine, and what its steps found."""
    the_scene, space, engine = sensitive()
    wave = Wave(the_scene, engine, space, UNITS, SIZE, seed=7)
    store = Store(tmp_path_factory.mktemp("wave") / "toy.part", "toy")
    assert wave.run(store, quiet) == wave.size.worlds * len(UNITS)
    return wave, engine, store.found


def test_a_wave_is_one_program_and_has_the_costs_of_each_set_alone(whole):
    wave, engine, parts = whole
    assert engine.traced == 1 and wave.steps == 3
    kept = keep(wave, parts)
    costs = trial_costs(kept)
    assert costs.shape == (5, 4, 4, 2)
    the_scene, space, alone = sensitive()
    one = jax.tree.map(lambda v: float(v[3] if np.ndim(v) else v), wave.numbers)
    key = stream_key(jax.random.key(7), STREAM_GRID, 3)
    trials = rollout.sample_trials(the_scene, key, 2)
    params = jax.vmap(space.params)(wave.designs.reshape(-1, 2))
    evaluate = jax.jit(lambda p, t, c: rollout.evaluate(the_scene, alone, p, t, constants=c))
    outcome = jax.tree.map(np.asarray, evaluate(params, trials, jax.tree.map(np.float32, one)))
    expected = np.where(outcome.status == 0, outcome.cost, np.nan).reshape(4, 4, 2)
    # Costs are stored as steps of loss; float32 rounds a cost of 3 to 2e-7.
    np.testing.assert_allclose(costs[3], expected, atol=1e-6)
    masses = sets.values(UNITS)["mass"]
    bad = (kept["status"] & int(Status.NONFINITE)) != 0
    # 5 % of noise on the mass: all worlds of the heaviest, none of the light ones.
    assert bad[masses > 150].all() and not bad[masses < 90].any()
    assert (masses > 150).any() and (masses < 90).any()


def test_a_wave_that_is_cut_off_goes_on(whole, tmp_path):
    wave, _, expected = whole
    path = tmp_path / "toy.part"

    def dies(line):
        if line.lstrip().startswith("2/"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        wave.run(Store(path, "toy"), dies)
    again = Store(path, "toy")
    assert len(again.found) == 2 and len(keep(wave, again.found)["units"]) == 4
    assert wave.run(again, quiet) == wave.size.worlds, "one set is left"
    whole, found = keep(wave, expected), keep(wave, again.found)
    for name in ("lost_step", "status", "units"):
        np.testing.assert_array_equal(found[name], whole[name])
    assert len(Store(path, "toy").found) == 3


def test_sizes_that_do_not_fit_are_refused():
    the_scene, space, engine = sensitive()
    with pytest.raises(ValueError, match="sets"):
        Wave(the_scene, engine, space, UNITS[:0], SIZE)
    paper = scene.load("paper")
    with pytest.raises(ValueError, match="4 trials: must be a multiple of 3"):
        space = parameters.design_space(paper.hand, "2d")
        Wave(paper, engine, space, UNITS, Size(trials=4))


# --- summaries -----------------------------------------------------------------------------------


def wells(floor=2.6, ridge=2.6):
    """Two wells of 12 and 6 cells on a plain; the row between them has the ridge's cost."""
    cost = np.full((12, 12), floor)
    cost[1:4, 2:6] = 0.0
    cost[7:9, 3:6] = 0.2
    cost[4:7, 3] = ridge
    return np.repeat(cost[..., None], 3, -1)


def test_separate_regions_are_found():
    found = summary.summarize(wells(), 2.6, 10.0 * AXIS, AXIS)
    assert found.regions == found.deep_regions == 2 and found.saddle == 2.5
    np.testing.assert_allclose(found.sizes, [12 / 144, 6 / 144])
    np.testing.assert_allclose(found.centres, [[20.0, 3.5], [75.0, 4.0]])
    assert found.lossless == 12 / 144 and found.below_half == found.below_one == 18 / 144
    assert found.above_two == found.untouched == 126 / 144


def test_regions_that_a_low_saddle_joins_are_one():
    found = summary.summarize(wells(ridge=0.9), 2.6, AXIS, AXIS)
    # Apart at 0.875, the last rung of the ladder below the ridge, but not at 1.
    assert found.regions == 1 and found.saddle == 0.875
    np.testing.assert_allclose(found.sizes, [18 / 144, 0.0])
    assert np.isnan(found.centres[1]).all()
    joined = summary.summarize(wells(ridge=0.4), 2.6, AXIS, AXIS)
    assert joined.regions == 1 and joined.saddle == 0.0
    corner = np.full((12, 12, 3), 3.0)
    corner[2:4, 2:4] = corner[4:6, 4:6] = 0.0  # they meet at a corner only
    assert summary.summarize(corner, 3.0, AXIS, AXIS).regions == 1


def test_specks_are_no_regions_and_failed_trials_are_left_out():
    trials = wells()
    trials[10, 10] = 0.0  # one cell of 144
    trials[1, 2] = [np.nan, 0.0, 3.0]
    trials[0, 0] = np.nan
    found = summary.summarize(trials, 2.6, AXIS, AXIS)
    assert found.regions == 2 and found.failed == 4 / 432
    mean = summary.mean_costs(trials[None], np.array([2.6]))[0]
    assert mean[1, 2] == 1.5 and mean[0, 0] == 2.6


# --- the filter on a landscape -------------------------------------------------------------------


def two_parameters():
    space = parameters.design_space(scene.load("paper").hand, "2d")
    return codesign.make_filter(space), space


PLAN = surrogate.Plan(("single", "concurrent"), runs=20, episodes=12, test=6)
FLAT = {0.0: (False, True, 1.0), 0.9: (False, False, 1.0), 2.5: (True, False, np.inf)}
"""Costs of flat landscapes: whether seeds are found, success, episodes to convergence."""


def plane_cost(space, particles):
    """A linear function of the two parameters, which interpolation reproduces."""
    low, high = np.array(space.low), np.array(space.high)
    place = (np.asarray(particles) - low) / (high - low)
    return 2.9 * (1 - place[..., 0]) + 0.05 * place[..., 1]


@pytest.fixture(scope="module")
def runs():
    """Runs on a plane, on flat landscapes, and where half of the trials cost 3, by shared."""
    optimizer, space = two_parameters()
    grids = [np.linspace(a, b, 7) for a, b in zip(space.low, space.high, strict=True)]
    plane = plane_cost(space, np.stack(np.meshgrid(*grids, indexing="ij"), -1))
    landscapes = [np.repeat(plane[..., None], 6, -1)]
    landscapes += [np.full((7, 7, 6), value) for value in FLAT]
    landscapes += [np.broadcast_to([3.0] * 3 + [0.0] * 3, (7, 7, 6))]
    keys = jax.vmap(jax.random.key)(np.arange(PLAN.runs))
    run = surrogate.make_runs(optimizer, space.is_morphology, PLAN)
    every = np.array(landscapes, np.float32)
    return {s: jax.tree.map(np.asarray, run(every, keys, s)) for s in (True, False)}


def test_trial_costs_are_interpolated():
    """Against SciPy, at random places, corners and edges."""
    random = np.random.default_rng(0)
    landscape, low, high = random.random((5, 4, 2)), np.array([1.0, -2.0]), np.array([3.0, 7.0])
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, (5, 4), strict=True)]
    exact = scipy.interpolate.RegularGridInterpolator(axes, landscape)
    places = low + (high - low) * np.vstack([random.random((20, 2)), [[0, 0], [1, 1], [1, 0.3]]])
    found = jax.vmap(surrogate.trial_cost, (None, None, None, 0, None))(
        *(jnp.asarray(v, jnp.float32) for v in (landscape, low, high, places)), 1
    )
    np.testing.assert_allclose(found, exact(places)[:, 1], atol=1e-6)  # float32


def test_a_run_on_a_plane_is_the_filter_on_its_cost(runs):
    """Where every trial costs a linear function, interpolation is exact: a plain loop is a run."""
    optimizer, space = two_parameters()
    ask, tell = jax.jit(optimizer.ask), jax.jit(optimizer.tell)
    mean = runs[True].mean[0]
    for (s, name), r in itertools.product(enumerate(PLAN.strategies), range(2)):
        key = jax.random.key(r)
        drawn = candidates(key, optimizer.space, np.arange(surrogate.CANDIDATES))
        seed = drawn[int(np.argmax(plane_cost(space, drawn) > 2.0))]
        state = State(jnp.tile(seed, (PLAN.particles, 1)), jnp.int32(0), key)
        first = ("morphology", "control")[r % 2]
        for e, mask in enumerate(schedule(name, space.is_morphology, PLAN.episodes, first)):
            moved = ask(state, mask)
            state, info = tell(state, moved, plane_cost(space, moved))
            # Float32 of costs up to 3, and places that rounding moves.
            assert mean[s, r, e] == pytest.approx(float(info.mean_cost), abs=1e-5)
    assert runs[True].seeded[0].all()


@pytest.mark.parametrize("value", FLAT)
def test_flat_landscapes_have_closed_answers(runs, value):
    seeded, success, episodes = FLAT[value]
    for found in runs.values():
        mean, good, poor = (v[1 + list(FLAT).index(value)] for v in found)
        assert (poor == seeded).all() and (good == success).all()
        np.testing.assert_allclose(mean, value, rtol=1e-6)
        for stays in (True, False):
            assert (surrogate.episodes_to_converge(mean, stays=stays) == episodes).all()


def test_particles_share_their_trials_or_meet_their_own(runs):
    """Half of the stored trials cost 3 everywhere: what differs is the spread of the mean."""
    spread = {}
    for shared, found in runs.items():
        mean = found.mean[-1, 1]  # 20 runs of 12 episodes; strategies draw the same trials
        # 6 trials of 0 or 3 are a multiple of 0.5 with mean 1.5 and deviation 3 sqrt(1/24) = 0.612;
        # four deviations of the mean of 240 such are 0.16.
        assert mean.mean() == pytest.approx(1.5, abs=0.16)
        spread[shared] = mean.std()
        assert np.allclose(2 * mean, np.round(2 * mean), atol=1e-5) == shared
    # Ten particles of their own: sqrt(10) less. Four deviations of a standard deviation of 240
    # draws are 18 %.
    assert spread[True] == pytest.approx(0.612, rel=0.18)
    assert spread[False] == pytest.approx(0.612 / np.sqrt(10), rel=0.18)


def test_both_readings_of_converged():
    mean = np.array([[2, 0.9, 1.2, 0.8, 0.7], [2, 0.9, 0.9, 0.9, 1.1], [2] * 5, [0.5] * 5])
    first = surrogate.episodes_to_converge(mean, stays=False)
    stays = surrogate.episodes_to_converge(mean, stays=True)
    np.testing.assert_array_equal(first, [2, 2, np.inf, 1])
    np.testing.assert_array_equal(stays, [4, np.inf, np.inf, 1])
    package = [codesign.convergence_episode(m) for m in mean]
    assert [np.inf if e is None else e + 1 for e in package] == stays.tolist()


# --- scores, files, report -----------------------------------------------------------------------


def measured(**changes):
    """Numbers of two sets that meet every target; changes by name, spaces as in the names."""
    found = {"lossless": 0.1, "saddle": 1.5, "above_two": 0.5}
    for noise in ("shared", "own"):
        for strategy, success, simulations in (
            ("single", 0.1, 3000),
            ("switch-4", 0.6, 900),
            ("concurrent", 0.8, 420),
        ):
            found[f"success {strategy}, {noise}"] = success
            for kind in ("first", "stays"):
                found[f"simulations {strategy}, {kind}, {noise}"] = simulations
    return {k: np.full(2, float(v)) for k, v in (found | changes).items()}


def test_a_set_that_meets_every_target_is_left():
    assert (score.implausibility(measured()) == 0).all()


@pytest.mark.parametrize(
    ("target", "changes"),
    [
        ("two regions", {"saddle": 0.0}),
        ("solutions", {"lossless": -0.01}),
        ("poor seeds", {"above_two": -0.01}),
        ("single is poor", {"success single, own": 0.8}),
        (
            "single is poor",  # where nothing succeeds, the order alone would say nothing
            {f"success {s}, own": 0.0 for s in ("single", "switch-4", "concurrent")},
        ),
        ("concurrent succeeds", {"success switch-4, own": 1.0, "success concurrent, own": 0.6}),
    ],
)
def test_each_target_rules_out(target, changes):
    distances = score.implausibility(measured(**changes))
    names = [t.name for t in score.TARGETS]
    assert (distances[:, names.index(target)] > 0).all()
    assert (np.delete(distances, names.index(target), 1) == 0).all()


def test_one_reading_that_fits_is_enough_and_none_rules_out():
    slow = {k: 2000.0 for k in measured() if k.startswith("simulations concurrent")}
    distances = score.implausibility(measured(**slow))[:, 0]
    # log(2000 / 420) / 0.25
    np.testing.assert_allclose(distances, 6.2425, atol=1e-3)
    slow["simulations concurrent, first, shared"] = 420.0
    assert (score.implausibility(measured(**slow))[:, 0] == 0).all()
    assert score.best(np.array([[1.0, 5.0], [2.0, 2.0], [0.0, 5.0]]), 2).tolist() == [1, 2]


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """Folder with the files of a wave of made-up landscapes, and a copy that is more expensive."""
    folder = tmp_path_factory.mktemp("scored")
    random = np.random.default_rng(0)
    units = sets.space_filling(12, seed=0)
    lost = np.where(random.random((12, 4, 4, 3)) < units[:, :1, None, None], 65535, 350)
    kept = {
        "units": units,
        "lost_step": lost.astype(np.uint16),
        "status": np.zeros((12, 4, 4, 3), np.uint8),
        "first_axis": np.linspace(10, 180, 4),
        "second_axis": np.linspace(-60, 200, 4),
        "window": np.array([3.5, 8.0]),
        "timestep": np.array(0.01),
    }
    for name, fidelity in (("one", "hull"), ("two", "hull, contact between fingers")):
        np.savez(folder / f"{name}.npz", **kept)
        settings = {"fidelity": fidelity, "points": 4, "trials": 3}
        notes = {"settings": settings, "device": "cpu", "commit": "abc"}
        (folder / f"{name}.json").write_text(json.dumps(notes))
    sys.argv = ["calibrate.py", "score", "one", "two", "--out", str(folder), "--runs", "3"]
    assert calibrate.main() == 0
    return folder, calibrate


def test_scores_are_those_of_the_landscapes(scored):
    folder, _ = scored
    [one] = files.read_scores([folder / "one_scores.npz"])
    kept, _ = files.read(folder / "one.npz")
    cost = np.where(kept["lost_step"] == 65535, 0.0, 1.0).mean(-1)
    maximum = sets.values(kept["units"])["cost_maximum"][:, None, None]
    np.testing.assert_allclose(one.data["landscape"], cost * maximum, rtol=1e-3)  # half precision
    np.testing.assert_allclose(one.data["lossless"], (cost == 0).mean((1, 2)))
    assert one.data["distances"].shape == (12, len(score.TARGETS))
    # The first constant decides how often the object is kept.
    rho = report.correlations(one)[0, list(report.MEASURES).index("lossless")]
    assert rho > 0.8


def test_the_report_has_every_table_and_figure(scored, tmp_path):
    folder, _ = scored
    page = tmp_path / "page.md"
    page.write_text("head\n<!-- calibration:begin -->\nold\n<!-- calibration:end -->\ntail\n")
    text = report.make(folder, tmp_path, page)
    assert text in page.read_text() and "old" not in page.read_text()
    for part in ("| one | hull | 12 |", "420 simulations", "tilt of the fingers", "stays, shared"):
        assert part in text
    # The same landscapes rank alike.
    assert "| 12 sets in common |" in text and "| cost < 1 | +1.00 |" in text
    for name in ("constants", "correlations", "landscapes"):
        assert (tmp_path / f"calibration_{name}.png").stat().st_size > 10_000


def test_the_next_wave_goes_on_from_the_best(scored):
    folder, _ = scored
    waves = files.read_scores([folder / "one_scores.npz"])
    units, text = files.next_sets(waves, 50, seed=0, keep=4)
    assert units.shape == (50, len(sets.OPEN)) and "4 best of 12" in text


def test_sets_of_another_wave_are_taken_in_its_order_or_the_best(scored):
    folder, calibrate = scored
    path = folder / "one_scores.npz"
    [one] = files.read_scores([path])
    ask = argparse.Namespace(after=None, like=path, best=None, others=None, sets=5, seed=0, keep=4)
    units, _ = calibrate.chosen_sets(ask, 99)
    np.testing.assert_array_equal(units, one.data["units"][:5])
    ask.best = 2
    units, text = calibrate.chosen_sets(ask, 99)
    worst = one.data["distances"][:5].max(-1)
    found = [int(np.argmax((one.data["units"] == u).all(1))) for u in units]
    assert worst[found].max() <= np.sort(worst)[1] and text == "2 sets of one"
    ask.others = 2
    units, _ = calibrate.chosen_sets(ask, 99)
    found = [int(np.argmax((one.data["units"] == u).all(1))) for u in units]
    # The two best, the next one and the worst, in the wave's order.
    assert found == sorted(score.best(one.data["distances"][:5], 5)[[0, 1, 2, 4]])


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["score", "three"], "three.npz and its .json cannot be read"),
        (["wave", "x", "--sets", "1"], "--sets 1 must be at least 2"),
        (["wave", "x", "--best", "3"], "--best needs --like"),
        (["wave", "x", "--others", "3"], "--others needs --best"),
        (["wave", "x", "--trials", "4", "--size", "tiny"], "4 trials: must be a multiple of 3"),
        (["wave", "x", "--set", "contact.frictoin=1"], "frictoin"),
        (["wave", "x", "--like", "one.npz"], "holds no scores"),
    ],
)
def test_bad_input_is_told_in_words(scored, arguments, part, monkeypatch):
    folder, calibrate = scored
    arguments = [str(folder / a) if a.endswith(".npz") else a for a in arguments]
    monkeypatch.setattr(sys, "argv", ["calibrate.py", *arguments, "--out", str(folder)])
    with pytest.raises(schema.InputError, match=part):
        calibrate.main()
