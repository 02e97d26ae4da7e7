"""The paper's experiments: counts, masks, one batch against single runs, resuming, statistics."""

import copy
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.stats
from toy import ToyEngine, tiny

from codesign_jax import codesign
from codesign_jax.optimize import schedule
from codesign_jax.report.statistics import wilson
from codesign_jax.scene.parameters import design_space
from codesign_jax.types import Outcome
from scripts.experiments import (
    PAPER,
    TOTAL_GRASPS,
    Batch,
    Grid,
    Landscape,
    Stop,
    Strategies,
    Worlds,
    continued,
    drive,
    figures,
    plan,
    report,
    results,
    study,
)
from scripts.experiments.study import Study
from scripts.experiments.worlds import chunking, dealt
from scripts.shared import record, statistics

PLAN = Strategies("2d", "2d", ("single", "switch-2", "concurrent"), 2, 6, 5, 3, 6)
SEED = 5
ROOT = Path(__file__).parents[1]
TIMES = ("seconds", "processes")


def settings_of(a_plan=PLAN, chunk=0):
    """Settings of the toy's state."""
    return record.settings(a_plan, tiny()[0], "toy", SEED, chunk)


def quiet(_):
    """Says nothing."""


@pytest.fixture(scope="module")
def setup():
    """A batch over the toy engine, and the engine; a batch holds no state, its record does."""
    scene, space, engine = tiny()
    worlds = Worlds(scene, engine, space, chunk=PLAN.worlds)
    return Batch(PLAN, scene, worlds, codesign.make_filter(space), seed=SEED), engine


@pytest.fixture(scope="module")
def finished(setup, tmp_path_factory):
    """A batch and its record, driven to the end in one go."""
    batch, _ = setup
    path = tmp_path_factory.mktemp("whole") / "state.npz"
    return batch, drive(batch, path, settings_of(), say=quiet).record


@pytest.fixture(scope="module")
def landscape():
    """A grid over the toy engine, two trials a step."""
    scene, space, engine = tiny()
    worlds = Worlds(scene, engine, space, chunk=32)
    return Grid(Landscape("landscape", "2d", 4, 5, block=2), scene, worlds, seed=SEED)


@pytest.fixture(scope="module")
def single():
    """What a single run is made of: scene, space, filter and episode."""
    scene, space, engine = tiny()
    optimizer = codesign.make_filter(space)
    episode = codesign.make_episode(scene, engine, space, optimizer, PLAN.trials)
    return scene, space, optimizer, episode


def assert_equal(a, b):
    """Two records agree bitwise, but for the times."""
    assert a.keys() == b.keys()
    for name in a.keys() - set(TIMES):
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_counts_are_the_papers():
    assert {name: p.grasps for name, p in PAPER.items()} == plan.PAPER_GRASPS
    assert plan.PAPER_GRASPS == {"2d": 1_008_000, "23d": 4_536_000, "landscape": 129_600}
    assert TOTAL_GRASPS == 5_673_600
    assert (PAPER["2d"].worlds, PAPER["23d"].worlds) == (14_400, 32_400)
    for size in plan.OVERRIDES:
        for name in PAPER:
            assert plan.experiment(name, size).preset in ("2d", "23d")


@pytest.mark.parametrize("name", ["2d", "23d"])
def test_masks_open_one_domain_and_start_equally_often_in_either(name):
    scene, *_ = tiny()
    space = design_space(scene.hand, "2d" if name == "2d" else "full")
    masks = PAPER[name].masks(space)
    strategies = PAPER[name].strategies
    assert masks.shape == (len(strategies), 30, PAPER[name].episodes, space.num_parameters)
    domain = np.array(space.is_morphology)
    in_morphology = (masks == domain).all(-1)
    in_control = (masks == ~domain).all(-1)
    for s, strategy in enumerate(strategies[:-1]):
        assert (in_morphology[s] ^ in_control[s]).all()
        assert in_morphology[s, :, 0].sum() == in_control[s, :, 0].sum() == 15
        switches = np.diff(in_morphology[s].astype(int), axis=-1) != 0
        expected = 0 if strategy == "single" else int(strategy.removeprefix("switch-"))
        np.testing.assert_array_equal(switches.sum(-1), expected)
    assert strategies[-1] == "concurrent" and masks[-1].all()


def test_an_experiment_of_fewer_strategies_and_other_runs():
    fewer = plan.narrowed(PAPER["2d"], ["single", "concurrent"], 60)
    assert isinstance(fewer, Strategies) and fewer.grasps == 2 * 60 * 60 * (64 + 6)
    assert plan.narrowed(PAPER["2d"], None, None) is PAPER["2d"]
    for name, strategies, runs, words in (
        ("landscape", ["single"], None, "neither strategies nor runs"),
        ("2d", ["singel"], None, "singel"),
        ("2d", None, 0, "0 runs"),
    ):
        with pytest.raises(ValueError, match=words):
            plan.narrowed(PAPER[name], strategies, runs)


def test_chunks_are_equal_and_waste_little():
    assert chunking(14_400) == (14_400, 1)
    assert chunking(32_400) == (16_200, 2)
    assert chunking(32_400, devices=2) == (16_200, 2)
    assert chunking(14_400, devices=4) == (3_600, 4)
    for worlds, limit, devices in ((32_400, 16_384, 8), (7, 3, 2), (5, 1, 4), (100, 99, 3)):
        size, calls = chunking(worlds, limit, devices)
        assert size <= limit and 0 <= size * calls - worlds < calls
        # One device finds the same chunk, so that a run can be repeated there bit by bit.
        assert chunking(worlds, size).size == size


def test_particles_are_dealt_to_calls_like_cards():
    worlds = dealt(particles=7, trials=3, calls=2)
    np.testing.assert_array_equal(np.sort(worlds), np.arange(21))
    np.testing.assert_array_equal(worlds[::3] // 3, [0, 2, 4, 6, 1, 3, 5])
    np.testing.assert_array_equal(worlds.reshape(-1, 3) % 3, np.tile(np.arange(3), (7, 1)))


TWO_DEVICES = """
import sys
from pathlib import Path
import jax
import numpy as np
from toy import tiny
from codesign_jax import codesign
from scripts.experiments import Batch, Strategies, Worlds, drive

plan = Strategies("2d", "2d", ("single", "concurrent"), 2, 3, 3, 3, 3)
scene, space, engine = tiny()
optimizer = codesign.make_filter(space)
assert jax.device_count() == 2

def run(count):
    used, worlds = set(), Worlds(scene, engine, space, chunk=12, devices=count)
    simulate = worlds._simulate
    before = simulate.func._cache_size()

    def spy(*args):
        found = simulate(*args)
        used.update(found.cost.devices())
        return found

    worlds._simulate = spy
    batch = Batch(plan, scene, worlds, optimizer, seed=5)
    path = Path(sys.argv[1]) / str(count)
    record = drive(batch, path.with_suffix(".state"), {}, say=lambda _: None).record
    assert len(used) == count, used
    assert simulate.func._cache_size() - before == count
    np.savez(path.with_suffix(".npz"), **record)

run(1)
run(2)
"""


@pytest.mark.slow  # the quick tests have it of `codesign optimize` (test_batch)
def test_two_devices_give_the_bits_of_one(tmp_path):
    """Chunks of a step are dealt to the devices; 3 chunks on 2 leave one idle at the end."""
    paths = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    changed = {"XLA_FLAGS": flags, "PYTHONPATH": ":".join(paths), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", TWO_DEVICES, str(tmp_path)]
    subprocess.run(command, check=True, env=os.environ | changed)
    records = []
    for count in (1, 2):
        with np.load(tmp_path / f"{count}.npz") as file:
            records.append({name: file[name] for name in file.files})
    assert_equal(*records)
    assert len(np.unique(records[0]["cost"])) > 5


def test_more_devices_than_there_are_is_refused():
    scene, space, engine = tiny()
    with pytest.raises(ValueError, match="devices=99"):
        Worlds(scene, engine, space, chunk=4, devices=99)


@pytest.mark.parametrize(("strategy", "run"), [(0, 1), (1, 0), (2, 1)])
def test_a_run_of_the_batch_is_the_single_run(finished, single, strategy, run):
    """As `codesign optimize --seed` does it: seed, episodes, final test."""
    _, got = finished
    (scene, space, optimizer, episode), key = single, jax.random.key(SEED + run)
    evaluate = codesign.evaluate_by(episode, optimizer)
    seed, cost, drawn = codesign.find_seed(scene, evaluate, optimizer, key, batch=PLAN.particles)
    mask = schedule(
        PLAN.strategies[strategy],
        np.array(space.is_morphology),
        PLAN.episodes,
        PLAN.first()[run],
    )
    state, costs, info = optimizer.init(key, seed, PLAN.particles), [], None
    for e in range(PLAN.episodes):
        state, info = episode(state, mask[e])
        costs.append(info.selection.cost)
    kept = jax.tree.map(lambda v: v[info.selection.ancestors], info.trials)
    test = codesign.final_test(
        scene, evaluate, state.particles, key, num_trials=PLAN.test_trials, previous=kept
    )
    # The same arithmetic in other programs, where the compiler fuses it: the last bit may differ.
    close = {"rtol": 1e-5, "atol": 1e-6}
    np.testing.assert_allclose(got["seeds"][run], seed, **close)
    np.testing.assert_allclose(got["seed_cost"][run], cost, **close)
    assert got["seed_candidates"][run] == drawn
    np.testing.assert_allclose(got["cost"][strategy, run], costs, **close)
    np.testing.assert_allclose(got["particles"][strategy, run], state.particles, **close)
    np.testing.assert_allclose(got["test_cost"][strategy, run], test.trials.cost, **close)
    np.testing.assert_array_equal(got["test_status"][strategy, run], test.trials.status)


def test_one_compile_serves_seeds_episodes_and_tests(setup, finished):
    assert setup[1].traced == 1


def test_strategies_share_seeds_and_runs_do_not(finished):
    _, got = finished
    first = got["cost"][:, :, 0]
    assert (got["seeds"][0] != got["seeds"][1]).any()
    assert (got["seed_cost"] > codesign.SEED_COST).all()
    # A closed length keeps the seed's: run 1 starts in control, so it kept the length throughout.
    np.testing.assert_array_equal(got["particles"][0, 1, :, 0], got["seeds"][1, 0])
    np.testing.assert_array_equal(first[0], first[1])  # both open the same domain at first


def test_resuming_equals_going_on(finished, tmp_path):
    batch, whole = finished
    path, settings, processes = tmp_path / "state.npz", settings_of(), 0
    while True:
        # No time at all: a process finds the seeds, or goes on by as many steps as we let it.
        part = drive(batch, path, settings, stop=Stop(minutes=0.0), say=quiet)
        processes += 1
        if part.finished:
            break
        for _ in range(3 if part.record["step"] < 3 else 2):
            batch.step(part.record)
        record.save(path, part.record, settings)
    assert processes == 4
    assert_equal(whole, part.record)


def test_saving_by_steps(finished, tmp_path, monkeypatch):
    batch, whole = finished
    saved, save = [], record.save
    monkeypatch.setattr(
        record, "save", lambda p, r, s: (saved.append(int(r["step"])), save(p, r, s))
    )
    path = tmp_path / "state.npz"
    save(path, whole | {"step": np.int64(1)}, settings_of())
    drive(batch, path, settings_of(), stop=Stop(every=3), say=quiet)
    assert saved == [3, 6, 7]


def test_chunks_do_not_change_results(finished, tmp_path):
    batch = copy.copy(finished[0])
    batch.worlds = Worlds(batch.scene, ToyEngine(batch.scene), batch.worlds.space, chunk=25)
    got = drive(batch, tmp_path / "state.npz", settings_of(), say=quiet).record
    for name in ("cost", "particles", "test_cost", "seeds"):
        np.testing.assert_allclose(got[name], finished[1][name], rtol=1e-5, atol=1e-6)
    for name in ("lost_step", "status", "test_status", "seed_candidates"):
        np.testing.assert_array_equal(got[name], finished[1][name])


def test_a_state_of_another_experiment_or_a_damaged_one_is_refused(finished, tmp_path):
    path, settings = tmp_path / "state.npz", settings_of()
    record.save(path, finished[1], settings)
    assert_equal(record.load(path, settings), finished[1])
    assert_equal(record.load(path, settings | {"chunk": 9}), finished[1])
    with pytest.raises(record.StateError, match="seed: 5 there, 6 here"):
        record.load(path, settings | {"seed": 6})
    whole, refused = path.read_bytes(), 0
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(record.StateError, match="cannot be read"):
        record.load(path, settings)
    for at in range(50, len(whole), len(whole) // 40):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        try:  # some bytes, such as a member's date, mean nothing; no number may ever differ
            assert_equal(record.load(path, settings), finished[1])
        except record.StateError:
            refused += 1
    assert refused > 20


def test_landscape_resumes_and_knows_its_axes(landscape, tmp_path):
    grid, settings = landscape, settings_of(landscape.plan)
    assert [grid.grasps(s) for s in range(grid.steps)] == [32, 32, 16]
    whole = drive(grid, tmp_path / "whole.npz", settings, say=quiet).record
    part = grid.start()
    grid.step(part)
    record.save(tmp_path / "part.npz", part | {"seconds": 0.0, "processes": 1}, settings)
    assert_equal(whole, drive(grid, tmp_path / "part.npz", settings, say=quiet).record)
    kept, space = results.summarize(grid, whole), grid.worlds.space
    ends = space.in_units(np.array([space.low, space.high]))
    np.testing.assert_allclose(kept["first_axis"][[0, -1]], ends[:, 0], rtol=1e-5)
    np.testing.assert_allclose(kept["second_axis"][[0, -1]], ends[:, 1], rtol=1e-5)
    # Toy physics: a grasp with longer fingers lasts longer.
    lost = np.where(whole["lost_step"] == record.KEPT, 10_000, whole["lost_step"].astype(int))
    assert (np.diff(lost, axis=0) >= 0).all() and (np.diff(lost, axis=0) > 0).any()


def test_packed_trials_give_the_costs_back(finished):
    batch, got = finished
    cost = results.costs(batch.scene, got["test_lost_step"], got["test_status"])
    np.testing.assert_allclose(cost, got["test_cost"], atol=1e-5)
    kept = results.summarize(batch, got)
    np.testing.assert_allclose(kept["mean"], kept["mean_exclude"], atol=1e-5)
    assert (kept["mean_worst"] >= kept["mean_exclude"] - 1e-6).all()


def test_means_by_either_rule():
    scene, *_ = tiny()
    cost = np.array([[0.0, 1.0, 3.0], [3.0, 3.0, 3.0]], np.float32)
    status = np.array([[0, 0, 1], [1, 2, 64]], np.uint8)
    means = results.both_means(scene, cost, status)
    np.testing.assert_allclose(means["exclude"], [0.5, 3.0])
    np.testing.assert_allclose(means["worst"], [4 / 3, 3.0], rtol=1e-6)
    trials = Outcome(cost, status.astype(np.int32), cost, status)
    np.testing.assert_allclose(means["exclude"], codesign.particle_cost(scene, trials))
    bits = dict(zip(results.BITS, results.failures(status, (0, 1)), strict=True))
    assert [bits[b] for b in (1, 2, 64)] == [2, 1, 1] and sum(bits.values()) == 4


@pytest.mark.parametrize(("successes", "total"), [(0, 30), (1, 30), (17, 30), (30, 30)])
def test_wilson_is_the_score_interval(successes, total):
    """Its ends are the proportions q with |p - q| = z sqrt(q (1 - q) / n), z = 1.95996."""
    value, low, high = wilson(successes, total)
    assert value == successes / total and low <= value <= high
    for end in (low, high):
        distance = 1.9599639845 * np.sqrt(end * (1 - end) / total)
        assert abs(value - end) == pytest.approx(distance, abs=1e-9)


def test_quantiles_and_medians_with_runs_that_never_converged():
    values = np.array([1.0, np.inf, 3.0, 2.0, np.inf, np.inf])
    assert statistics.quantile(values, 0.25) == 2.0
    assert statistics.quantile(values, 0.5) == np.inf
    finite = np.random.default_rng(0).normal(size=(3, 31))
    for q in (0.025, 0.25, 0.5, 0.75):
        expected = np.quantile(finite, q, axis=-1, method="averaged_inverted_cdf")
        np.testing.assert_allclose(statistics.quantile(finite, q), expected)
    interval = statistics.median(finite[0])
    assert interval.low < interval.value == np.median(finite[0]) < interval.high


def test_paired_tests():
    a, b = np.arange(30) < 20, np.arange(30) < 10
    assert statistics.mcnemar(a, b) == pytest.approx(2 * 0.5**10)
    assert statistics.mcnemar(a, a) == 1.0
    slow, fast = np.full(30, np.inf), np.arange(30.0)
    assert statistics.wilcoxon(slow, fast, 64) < 1e-3 < statistics.wilcoxon(fast, fast, 64)
    assert statistics.trend(np.arange(4.0)[:, None] + np.zeros((4, 30))) < 1e-3
    assert statistics.trend(np.zeros((4, 30))) == 1.0


def test_unpaired_tests_and_several_comparisons():
    a, b = np.arange(10) < 9, np.arange(10) < 1
    # All tables of these margins that are no likelier: 2 (1 * 1 + 10 * 10) of C(20, 10).
    assert statistics.fisher(a, b) == pytest.approx(2 * 101 / 184756)
    slow, fast = np.full(30, np.inf), np.arange(30.0)
    assert statistics.mann_whitney(slow, fast) < 1e-3
    assert statistics.mann_whitney(slow, slow) == 1.0
    # The step-down procedure by hand: 4 * 0.005, 3 * 0.01, 2 * 0.03, and no smaller than that.
    found = statistics.holm([0.01, 0.04, 0.03, 0.005])
    np.testing.assert_allclose(found, [0.03, 0.06, 0.06, 0.02])


def test_both_readings_of_converged():
    """Below 1 in the second episode, above in the third, and below from the fourth on."""
    means = np.array([[[2.0, 0.5, 1.5, 0.9, 0.2], [2.0] * 5]])
    one = study.Study({}, {}, {"mean_exclude": means})
    np.testing.assert_array_equal(one.first_below(), [[2.0, np.inf]])
    np.testing.assert_array_equal(one.convergence(), [[4.0, np.inf]])
    np.testing.assert_array_equal(one.convergence(episodes=3), [[np.inf, np.inf]])


def test_regions_are_counted_and_specks_are_not():
    x, y = np.arange(20.0), np.arange(10.0)
    cost = np.full((20, 10), 3.0)
    cost[2:5, 2:5], cost[10:18, 6:9], cost[0, 9] = 0.5, 0.2, 0.0
    data = {"first_axis": x, "second_axis": y, "exclude": cost}
    found = study.regions(data, 1.0, smallest=0.02)
    assert [r.points.sum() for r in found] == [24, 9]
    np.testing.assert_allclose(found[0].low, [10, 6])
    np.testing.assert_allclose(found[0].high, [17, 8])
    assert len(study.regions(data, 0.3, smallest=0.0)) == 2


def write_small(finished, grid, folder):
    """Results of the toy in the place of every experiment's."""
    batch, got = finished
    arrays = results.summarize(batch, got)
    for name in ("2d", "23d"):
        plan = dataclasses.asdict(PLAN) | {"name": name}
        notes = {"settings": {"plan": plan, "scene": "paper"}, "commit": "0123abc"}
        results.write(folder, name, arrays, notes | {"grasps": PLAN.grasps, "wall_seconds": 1.0})
    grid_record = grid.start()
    grid.step(grid_record)
    kept = results.summarize(grid, grid_record)
    notes = {"grasps": 80, "wall_seconds": 1.0, "commit": "0123abc"}
    results.write(folder, "landscape", kept, notes)


def test_figures_and_page_are_made_from_files_alone(finished, landscape, tmp_path):
    write_small(finished, landscape, tmp_path)
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- results:begin -->\nold\n<!-- results:end -->\nafter\n")
    text = report.make(tmp_path, tmp_path / "figures", page)
    names = ["6_cost_evolution", "7a_success", "7b_convergence", "8_landscape"]
    names += ["9a_success", "9b_convergence"]
    for name in names:
        assert (tmp_path / "figures" / f"fig{name}.png").read_bytes()[:4] == b"\x89PNG"
    assert "6120 simulations" in text and "nan" not in text
    filled = page.read_text()
    assert text in filled and "old" not in filled
    assert filled.startswith("before") and filled.endswith("after\n")
    assert json.loads((tmp_path / "2d.json").read_text())["grasps"] == PLAN.grasps

    # Another landscape, in the place of that with contact between fingers, which was stopped.
    other, moved = tmp_path / "fingers", dict(study.load(tmp_path, "landscape")[0])
    moved["exclude"] = np.cumsum(moved["exclude"]).reshape(moved["exclude"].shape)
    notes = {"grasps": 2 * moved["exclude"].size, "wall_seconds": 1.0, "commit": "4567def"}
    results.write(other, "landscape", moved, notes)
    both = report.make(tmp_path, tmp_path / "figures", touching=[other, tmp_path])
    assert "with it" in both.split(text)[1]
    plain = study.load(tmp_path, "landscape")[0]["exclude"]
    expected = scipy.stats.pearsonr(plain.ravel(), moved["exclude"].ravel()).statistic
    row = next(line for line in both.splitlines() if "4567def" in line).split(" | ")
    assert row[1] == "2" and float(row[-1].strip(" |")) == pytest.approx(expected, abs=6e-4)
    assert (tmp_path / "figures" / "fig8_landscape_fingers.png").stat().st_size > 1000


def test_strategies_of_the_same_runs_are_joined(finished):
    batch, got = finished
    arrays, order = results.summarize(batch, got), [str(s) for s in PLAN.strategies]

    def part(rows, commit, **changed):
        names = [order[k] for k in rows]
        own = {
            k: v[rows] if len(v) == len(order) and k not in ("first", "seeds") else v
            for k, v in arrays.items()
        } | changed
        plan = dataclasses.asdict(PLAN) | {"strategies": names}
        notes = {"settings": {"plan": plan, "scene": "paper"}, "commit": commit}
        return study.Study(plan, notes, own)

    last = list(range(1, len(order)))
    parts = part(last, "1111111"), part([0], "2222222")
    (whole,) = study.joined(parts, order)
    assert whole.strategies == order and whole.notes["commit"] == "2222222, 1111111"
    assert all(np.array_equal(whole.data[k], v) for k, v in arrays.items())
    assert report.details(whole) == report.details(part([*range(len(order))], ""))
    other = part([0], "2222222", seeds=arrays["seeds"] + 1)
    assert study.joined([parts[0], other], order) == [parts[0], other], "other runs"


def test_an_experiment_that_was_stopped_has_no_test(setup):
    batch, _ = setup
    record_ = batch.start()
    batch.step(record_)
    kept = results.summarize(batch, record_)
    stopped = study.Study(dataclasses.asdict(PLAN), {}, kept)
    assert stopped.episodes == 1 and not stopped.tested and not stopped.success().any()


def test_what_was_not_run_is_said(tmp_path):
    text = report.make(tmp_path, tmp_path / "figures")
    assert text.count("not run") == 3
    assert figures.label("switch-16") == "16"


@pytest.mark.slow
def test_the_script_stops_resumes_and_draws(tmp_path):
    def call(*arguments):
        command = [sys.executable, "-m", "scripts.experiments", *arguments]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)

    run = [
        "2d",
        "--size",
        "tiny",
        "--engine",
        "mujoco",
        "--scene",
        "paper_spheres",
        "--out",
        str(tmp_path),
    ]
    stopped = call(*run, "--minutes", "0")
    assert stopped.returncode == 3, stopped.stderr
    done = call(*run, "--trials", str(tmp_path / "trials.npz"), "--commit", "abc")
    assert done.returncode == 0 and "resuming after step 0/3" in done.stdout, done.stderr
    notes = json.loads((tmp_path / "2d.json").read_text())
    assert (notes["commit"], notes["grasps"], notes["processes"]) == ("abc", 72, 2)
    with np.load(tmp_path / "trials.npz") as trials:
        assert trials["status"].shape == (2, 2, 2, 2, 3)
    drawn = call("figures", "--data", str(tmp_path), "--figures", str(tmp_path / "figures"))
    assert drawn.returncode == 0 and (tmp_path / "figures" / "fig7a_success.png").exists()
    refused = call(*run, "--seed", "7")
    assert refused.returncode == 1 and "delete it" in refused.stderr


@pytest.mark.slow
def test_the_structured_engine_gives_the_same_bits_on_two_devices(tmp_path):
    path, command = tmp_path / "devices.json", [sys.executable, "-m", "scripts.experiments.devices"]
    subprocess.run([*command, "--json", str(path), "--size", "tiny"], cwd=ROOT, check=True)
    found = json.loads(path.read_text())
    assert found["settings"]["chunk"] == 12 and found["compared"]["arrays"] > 10
    assert [row["different_arrays"] for row in found["devices"].values()] == [[], []]


def published(episodes, value):
    """Results of one strategy in so many episodes of four, all numbers alike."""
    sizes = {"quartiles": (3,), "failed": (7,)}
    data = {
        name: np.full((1, 2, episodes, *sizes.get(name, ())), value, np.float32)
        for name in continued.BY_EPISODE
    }
    data |= {"particle_cost": np.full((2, episodes, 5), value, np.float16)}
    data |= {"strategies": np.array(["single"]), "final_particles": np.full((1, 2, 5, 2), value)}
    sizes = dict(runs=2, particles=5, episodes=4, trials=3, test_trials=3)
    return Study(dict(name="2d", preset="2d", strategies=["single"], **sizes), {}, data)


def test_published_results_are_continued():
    """The earlier episodes stay as they were published; complete ones cannot be gone on with."""
    earlier, later = published(3, 1.0), published(4, 2.0)
    joined = continued.join(earlier, later)
    for name in (*continued.BY_EPISODE, "particle_cost"):
        axis = 1 if name == "particle_cost" else 2
        first, rest = np.split(joined[name], [3], axis)
        assert (first == 1).all() and (rest == 2).all() and rest.shape[axis] == 1
    assert (joined["final_particles"] == 2).all()
    with pytest.raises(ValueError, match="all episodes were simulated"):
        continued.start(later)
