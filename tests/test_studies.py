"""Studies: sets of constants and waves, rates and their worlds, searches in lock step."""

import dataclasses
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from codesign_jax import codesign, rollout, scene
from codesign_jax.codesign import stream_key
from codesign_jax.cost import particle_cost
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters, schema
from codesign_jax.types import failed
from scripts import benchmark, calibration, search
from scripts.calibration import OPEN, Wave
from scripts.search import Study, make_case
from scripts.shared import statistics, work
from tests.helpers.toy_engine import ToyEngine, tiny


def test_sets_fill_their_ranges_and_every_beginning_does():
    units = calibration.space_filling(64, seed=3)
    np.testing.assert_array_equal(units[:16], calibration.space_filling(16, seed=3))
    # A Sobol sequence has one of its first 16 points in each sixteenth of every axis.
    for column in units[:16].T:
        assert sorted(np.floor(16 * column)) == list(range(16))
    found = calibration.values(units)
    for name, o in OPEN.items():
        assert o.low <= found[name].min() and found[name].max() <= o.high
    middle = calibration.values(np.full((1, len(OPEN)), 0.5))
    assert middle["mass"] == pytest.approx(np.sqrt(20 * 300)) and middle["tilt"] == 60.0
    assert (found["pair_gap"] >= found["width"] + 2.0).all()


def test_numbers_of_a_set_are_those_of_the_files():
    """The numbers that a set changes, against the same values set by key path."""
    units = calibration.space_filling(3, seed=1)
    v = {name: values[2] for name, values in calibration.values(units).items()}
    x, y, size = 1e-3 * v["base_x"], 0.5e-3 * v["pair_gap"], 1e-3 * v["half_size"]
    bases = [[x, y], [x, -y], [-x, -y], [-x, y]]
    changes = {f"hand.finger.{i}.base": base for i, base in enumerate(bases)}
    changes |= {f"hand.finger.{i}.tilt": v["tilt"] for i in range(4)}
    sizes = {"cuboid": [size] * 3, "cylinder": [size, 1.2 * size], "sphere": [size]}
    for name, values in sizes.items():
        changes[f"objects.object.{name}.size"] = values
        changes[f"objects.object.{name}.mass"] = 1e-3 * v["mass"]
        changes[f"objects.object.{name}.friction"] = v["friction"]
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
    found = calibration.numbers(scene.load("paper"), calibration.values(units))
    third = jax.tree.map(lambda n: float(n[2] if np.ndim(n) else n), found)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), third, expected)
    with pytest.raises(schema.InputError, match="give each finger a base"):
        calibration.numbers(scene.load("paper_spheres"), calibration.values(units))


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


@pytest.mark.slow  # quick: numbers of a batch are those of single worlds (test_constants)
def test_a_wave_is_one_program_goes_on_and_has_the_costs_of_each_set_alone():
    the_scene, space, _ = tiny()
    fingers = tuple(
        dataclasses.replace(f, radius=None, base=(side * 0.035, 0.0))
        for f, side in zip(the_scene.hand.finger, (1, -1), strict=True)
    )
    hand = dataclasses.replace(the_scene.hand, finger=fingers)
    the_scene = dataclasses.replace(the_scene, hand=hand)
    engine, units = Sensitive(the_scene), calibration.space_filling(5, seed=2)
    wave = Wave(the_scene, engine, space, units, points=4, trials=2, seed=7, chunk=70)
    said = []
    costs = wave.costs([], lambda parts: said.append(len(np.concatenate(parts))))
    assert costs.shape == (5, 4, 4, 2) and engine.traced == 1 and said == [2, 4, 5]
    again = wave.costs([costs[:4]], lambda parts: None)
    np.testing.assert_array_equal(again, costs)
    numbers = calibration.numbers(the_scene, calibration.values(units))
    one = jax.tree.map(lambda v: np.float32(v[3] if np.ndim(v) else v), numbers)
    key = stream_key(jax.random.key(7), calibration.STREAM_WAVE, 3)
    trials = rollout.sample_trials(the_scene, key, 2)
    params = jax.vmap(space.params)(wave.designs().reshape(-1, 2))
    alone = Sensitive(the_scene)
    evaluate = jax.jit(lambda p, t, c: rollout.evaluate(the_scene, alone, p, t, constants=c))
    outcome = jax.tree.map(np.asarray, evaluate(params, trials, one))
    expected = np.where(failed(outcome.status), np.nan, outcome.cost).reshape(4, 4, 2)
    np.testing.assert_allclose(costs[3], expected, atol=1e-6)  # float32 of a cost of 3
    masses = calibration.values(units)["mass"]
    # 5 % of noise on the mass: all worlds of the heaviest fail, and not all of the light ones.
    assert (masses > 150).any() and np.isnan(costs[masses > 150]).all()
    assert not np.isnan(costs[masses < 90]).all()


def wells(ridge=2.6, floor=2.6):
    """Two wells of 12 and 6 cells on a plain; the row between them has the ridge's cost."""
    cost = np.full((12, 12), floor)
    cost[1:4, 2:6], cost[7:9, 3:6], cost[4:7, 3] = 0.0, 0.2, ridge
    return cost


def test_a_saddle_is_where_two_wells_part():
    assert calibration.saddle(wells()) == 2.5
    # Apart at 0.875, the last rung of the ladder below the ridge.
    assert calibration.saddle(wells(0.9)) == 0.875 and calibration.saddle(wells(0.4)) == 0.0
    corner = np.full((12, 12), 3.0)
    corner[2:4, 2:4] = corner[4:6, 4:6] = 0.0  # they meet at a corner only
    assert calibration.saddle(corner) == 0.0


def test_statements_rule_out_what_they_should():
    """Flat landscapes on which nothing, or everything, succeeds; two wells are two regions."""
    space = parameters.design_space(scene.load("paper").hand, "2d")
    flat = [np.full((12, 12), c) for c in (0.0, 2.5)]
    costs = np.repeat(np.array([*flat, wells()])[..., None], 6, -1)
    found = calibration.score(costs, np.full(3, 3.0), space)
    good, bad, two = (({n: d[i] for n, d in found.items()}) for i in range(3))
    assert good["solutions"] == 0 and good["poor seeds"] > calibration.CUTOFF
    assert good["420 simulations"] > calibration.CUTOFF, "after the first episode"
    assert bad["solutions"] == pytest.approx(2.0) and bad["single is poor"] > calibration.CUTOFF
    assert two["two regions"] == two["solutions"] == two["poor seeds"] == 0
    assert good["two regions"] == bad["two regions"] == pytest.approx(1 / 0.3)


def test_both_readings_of_converged():
    """Below 1 in the second episode, above in the third, and below from the fourth on."""
    mean = np.array([[2.0, 0.5, 1.5, 0.9, 0.2], [2.0] * 5])
    np.testing.assert_array_equal(calibration.episodes_to_converge(mean, stays=True), [4, np.inf])
    np.testing.assert_array_equal(calibration.episodes_to_converge(mean, stays=False), [2, np.inf])


def test_the_sets_that_are_left_are_those_of_the_note():
    assert calibration.left().shape == (44, len(OPEN))


# --- rates ----------------------------------------------------------------------------------------


LINKS = {"discretization": {"links": 2}}
LIFTED = LINKS | {"effects": {"disturb": False, "ungrasp": False}}  # half of a grasp's steps


@pytest.mark.parametrize("ties", (False, True))
def test_rank_correlation_equals_its_definition(ties):
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=300), rng.normal(0.3, 1.0, size=300)
    a, b = (np.round(a), np.round(b)) if ties else (a, b)
    x, y = (scipy.stats.rankdata(v) for v in (a, a + b))
    assert statistics.spearman(a, a + b) == pytest.approx(np.corrcoef(x, y)[0, 1], abs=1e-12)


def test_rank_correlation_of_constants_is_undefined():
    assert np.isnan(statistics.spearman([1, 1, 1], [1, 2, 3]))


def test_a_small_batch_is_the_start_of_a_large_one():
    """The same worlds whatever the batch, so that engines and sizes compare."""
    chosen = scene.load("paper_spheres")
    few, many = (work.make_worlds(chosen, n) for n in (7, 31))
    for a, b in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(a, b[:7])


@pytest.mark.parametrize("change", ({"overrides": LINKS}, {"hand_name": "tripod3"}))
def test_other_hands_have_good_designs(change):
    """Every second design is a good one of that hand, the first of them the middle itself."""
    chosen = scene.load("paper_spheres", **change)
    worlds = work.make_worlds(chosen, 12)
    assert worlds.params.length.shape == (12, chosen.num_fingers)
    np.testing.assert_allclose(worlds.params.length[6:], work.GOOD["length"][0] * 1e-3, rtol=1e-6)


def test_a_micrometre_moves_the_objects_and_nothing_else():
    worlds = work.make_worlds(scene.load("paper_spheres", overrides=LINKS), 60)
    moved = work.nudged(worlds.trials)
    difference = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - b).max(), moved, worlds.trials)
    assert float(difference.position) == pytest.approx(1e-6, rel=0.02)  # float32 of centimetres
    assert not any(np.any(d) for d in difference._replace(position=0.0))


def test_winners_are_the_best_final_particle_of_each_concurrent_run():
    """Each as often as any other, and in a second round with another object."""
    chosen = scene.load("paper")
    found, objects = benchmark.winners(chosen), len(chosen.objects.object)
    with np.load(benchmark.WINNERS) as file:
        particles, cost = file["final_particles"][2], file["test_worst"][2]
        assert file["strategies"][2] == "concurrent" and len(found) == 30
    for design, candidates, costs in zip(found, particles, cost, strict=True):
        [best] = {costs[k] for k, c in enumerate(candidates) if np.array_equal(c, design)}
        assert best == costs.min()
    worlds = benchmark.make_worlds(chosen, "winners", 60)
    np.testing.assert_array_equal(worlds.params.length[:30], worlds.params.length[30:])
    assert not np.any(worlds.trials.shape[:30] == worlds.trials.shape[30:])
    random = benchmark.make_worlds(chosen, "random", 60)
    assert len(np.unique(random.params.length, axis=0)) == 60 // objects
    assert np.bincount(random.trials.shape).tolist() == [60 // objects] * objects


@pytest.mark.slow  # quick: what is told of records
def test_a_batch_is_measured_and_judged(monkeypatch):
    """Its verdicts are those of the engine; the rate is that of the shortest call."""
    monkeypatch.setattr(benchmark, "SECONDS", 0.0)
    chosen = scene.load("paper_spheres", overrides=LIFTED)
    record = benchmark.measured(chosen, "mixed", "mujoco", 12, calls=3)
    worlds = work.make_worlds(chosen, 12)
    outcomes, _ = rollout.simulate(chosen, make_engine("mujoco", chosen), *worlds)
    assert record["verdicts"] == "".join("01"[int(c < 0.01)] for c in np.asarray(outcomes.cost))
    assert "0" in record["verdicts"] and "1" in record["verdicts"]
    assert record["grasps_per_s"] == pytest.approx(12 / min(record["seconds"]), abs=0.1)
    assert record["kept"] == pytest.approx(record["verdicts"].count("1") / 12, abs=1e-4)


RUN = {"platform": "cpu", "cpus": 2, "commit": "0123456789", "jax": "0.1", "date": "2026-01-02T03"}


def record(engine, rate, **more):
    base = {"scene": "paper", "designs": "winners", "engine": engine, "worlds": 60, "run": 0}
    return {**base, "grasps_per_s": rate, **more}


def test_tables_are_those_of_the_records_and_a_second_measurement_replaces_the_first():
    records = []
    for new in (record("structured", 1.0), record("structured", 44.4, verdicts="0011")):
        records = benchmark.replaced(records, new)
    records = benchmark.replaced(records, record("MuJoCo C 4.0.0", 8.0, verdicts="0111"))
    gpu = {**RUN, "platform": "gpu", "device": "NVIDIA H100 80GB HBM3"}
    larger = {"runs": [gpu], "records": [record("structured", 1234.0, worlds=16384)]}
    files = [{"runs": [RUN], "records": records}, larger]
    assert benchmark.rates(files).splitlines() == [
        "| grasps a second (time of a batch) | 2 CPU cores, winners | one H100, winners |",
        "| --- | --- | --- |",
        "| 60 grasps, an episode of the paper's 2D | 44 (1.4 s) | – |",
        "| 16,384 grasps | – | 1,200 (13 s) |",
    ]
    assert benchmark.machines(files) == (
        "Measured on 2 CPU cores, JAX 0.1, 2026-01-02; on one H100, JAX 0.1, 2026-01-02 "
        "(`docs/data/rates_*.json`)."
    )
    row = "| paper | 2 CPU cores, 60 grasps | MuJoCo C 4.0.0 | 8.0 | 44 | 6 | 3 of 4 |"
    assert benchmark.peers(files).splitlines()[2:] == [row]


@pytest.mark.parametrize("page", benchmark.PAGES)
def test_tables_of_the_pages_are_those_of_the_data(page):
    text, files = (benchmark.ROOT / page).read_text(encoding="utf-8"), benchmark.read()
    for mark in benchmark.PAGES[page]:
        [shown] = re.findall(f"<!-- {mark}:begin -->\n\n(.*?)\n\n<!-- {mark}:end -->", text, re.S)
        assert shown == benchmark.TABLES[mark](files)


# --- searches -------------------------------------------------------------------------------------


SIZES = "particles=4,trials=2"


def make(path, name):
    budget = 176 if name == "screened-es" else 140  # its final test is larger
    the_scene, space, engine = tiny()
    case = make_case(f"{name}:{SIZES}", space, "2d")
    how = {"seeds": 3, "budget": budget, "tests": 5, "chunk": 20}
    return Study(case, the_scene, engine, space, **how, path=path)


def finish(made):
    while not made.finished:
        made.step()
    made.save()
    return made


@pytest.mark.slow  # quick: a vmapped run is that of each seed alone (test_codesign)
def test_seeds_are_runs_of_the_library_and_go_on(tmp_path):
    whole = finish(make(tmp_path / "whole.npz", "screened-es"))
    begun = make(tmp_path / "begun.npz", "screened-es")
    for _ in range(3):
        begun.step()
    begun.save()
    again = finish(make(tmp_path / "begun.npz", "screened-es"))
    assert again.row() == whole.row()
    np.testing.assert_array_equal(again.state.particles, whole.state.particles)
    # The same by the library, of one seed alone.
    the_scene, space, engine = tiny()
    optimizer = whole.case.optimizer
    task = codesign.Task(the_scene, space, 2, engine)
    state = jax.tree.map(lambda v: v[1], make(tmp_path / "none.npz", "screened-es").state)
    for _ in range(whole.done):
        state, _ = task.episode(optimizer, state)
    # Two programs round in the last bit.
    np.testing.assert_allclose(whole.state.particles[1], state.particles, rtol=1e-4, atol=1e-6)
    # All grasps are counted: the episodes and the test.
    assert whole.row()["grasps"][-1] == 8 * whole.done + whole.tested
    assert whole.tested == 4 * 36


@pytest.mark.slow  # quick: what is reported of stored rows, below
def test_what_is_recommended_was_chosen_by_fresh_trials(tmp_path):
    """The particle of the lowest cost in the mark's own trials, by the library's evaluation."""
    made = finish(make(tmp_path / "one.npz", "particle-filter"))
    the_scene, space, engine = tiny()
    task = codesign.Task(the_scene, space, search.ROUNDS, engine)
    # All grasps are counted: those that find a poor seed, the episodes, and the test.
    assert made.row()["grasps"][-1] == 8 + 8 * made.done + made.tested
    assert made.tested == 4 * search.ROUNDS and made.last is not None
    candidates = made.last[0][2][np.argsort(made.last[1][2], stable=True)]
    noise = codesign.stream_key(made.keys[2], codesign.STREAM_TEST, made.done)
    costs = particle_cost(the_scene, task.evaluate(candidates, noise))
    np.testing.assert_array_equal(made.designs[made.done][2], candidates[np.argmin(costs)])


def test_the_page_gets_a_table_and_a_figure(tmp_path):
    row = {"optimizer": "ours", "preset": "2d", "grasps": [10, 20, 40]}
    row |= {"provenance": {"commit": "abc12345"}}
    row["kept"] = [[0.5, 0.96, 0.2, 0.96], [0.96, 0.97, 1.0, 0.99], [0.96, 0.97, 1.0, 0.5]]
    (tmp_path / "2d-ours.json").write_text(json.dumps(row))
    whole = row | {"optimizer": "screened-es", "preset": "23d"}
    part = whole | {"optimizer": "screened-es:tests=0"}
    (tmp_path / "23d-screened-es.json").write_text(json.dumps(whole))
    (tmp_path / "23d-tests0.json").write_text(json.dumps(part))
    page = tmp_path / "page.md"
    page.write_text("<!-- search:begin -->\n<!-- search:end -->\n")
    figure = tmp_path / "search.png"
    command = ["--report", str(tmp_path), "--page", str(page), "--figure", str(figure)]
    assert search.main(command) == 0
    lines = page.read_text().splitlines()
    assert lines[4].startswith("| `screened-es` | 23d |"), "23 parameters first"
    line = lines[5]
    assert "| `ours` | 2d | three | 4 | 40 | 0.965 |" in line and "0.75 (0.30 to 0.95)" in line
    assert not [text for text in lines if "tests=0" in text], "a part of it left out"
    assert line.endswith("| not reached | abc1234 |") and figure.exists()
    assert search.reached(row | {"kept": row["kept"][:2]}, 0.9) == "20"
