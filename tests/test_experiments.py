"""The paper's experiments: counts, masks, resuming, statistics, pages, winners on fresh trials."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from codesign_jax import codesign, runs
from codesign_jax import scene as scenes
from codesign_jax.batch import Batch
from codesign_jax.scene.parameters import design_space
from codesign_jax.types import Outcome
from scripts.experiments import __main__ as experiments
from scripts.experiments import fresh, report, simulate
from scripts.experiments.simulate import PAPER, TOTAL_GRASPS, Landscape, Strategies, write
from scripts.shared import statistics
from tests.helpers.toy_engine import TINY, ToyEngine, tiny

PLAN = Strategies("2d", "2d", ("single", "switch-2", "concurrent"), 2, 6, 5, 3, 6)
SEED = 5
ROOT = Path(__file__).parents[1]
GRID = Landscape("landscape", "2d", 4, 5)


@pytest.fixture(scope="module")
def toy():
    """A toy engine in the place of every one that is made."""
    engine = ToyEngine(scenes.load(TINY))
    with pytest.MonkeyPatch.context() as patch:
        for module in (runs.loop, simulate):
            patch.setattr(module, "make_engine", lambda name, scene: engine)
        yield engine


def optimize(folder, **how):
    """Runs the experiment with the toy, or goes on with it; a seed's name is its folder's."""
    plans = simulate.plans(PLAN, scenes.load(TINY), "structured", folder, SEED)
    return runs.optimize(plans, ["test"], **how)


@pytest.fixture(scope="module")
def finished(toy, tmp_path_factory):
    """Folder of the experiment's runs, and what they have."""
    folder = tmp_path_factory.mktemp("whole")
    assert not any(isinstance(r, Exception) for r in optimize(folder).runs.values())
    return folder, simulate.gather(PLAN, folder, SEED)


def points():
    """The landscape with the toy, in calls of six points."""
    how = {"seed": SEED, "chunk": 30, "devices": None, "console": Console(quiet=True)}
    return simulate.landscape(GRID, scenes.load(TINY), "structured", **how)


def test_counts_are_the_papers():
    assert {name: p.grasps for name, p in PAPER.items()} == simulate.PAPER_GRASPS
    assert simulate.PAPER_GRASPS == {"2d": 1_008_000, "23d": 4_536_000, "landscape": 129_600}
    assert TOTAL_GRASPS == 5_673_600
    assert (PAPER["2d"].worlds, PAPER["23d"].worlds) == (14_400, 32_400)


@pytest.mark.parametrize("name", ["2d", "23d"])
def test_masks_open_one_domain_and_start_equally_often_in_either(name, monkeypatch):
    scene = scenes.load("paper")
    monkeypatch.setattr(runs.loop, "make_engine", lambda name, scene: ToyEngine(scene))
    space = design_space(scene.hand, "2d" if name == "2d" else "full")
    plans = simulate.plans(PAPER[name], scene, "structured", Path(), 0)
    shape = len(PAPER[name].strategies), 30, PAPER[name].episodes, space.num_parameters
    masks, names = np.array([p.mask for p in plans.values()]).reshape(shape), PAPER[name].strategies
    assert [p.settings.seed for p in plans.values()] == [*range(30)] * len(names)
    domain = np.array(space.is_morphology)
    in_morphology = (masks == domain).all(-1)
    in_control = (masks == ~domain).all(-1)
    for s, strategy in enumerate(names[:-1]):
        assert (in_morphology[s] ^ in_control[s]).all()
        assert in_morphology[s, :, 0].sum() == in_control[s, :, 0].sum() == 15
        switches = np.diff(in_morphology[s].astype(int), axis=-1) != 0
        expected = 0 if strategy == "single" else int(strategy.removeprefix("switch-"))
        np.testing.assert_array_equal(switches.sum(-1), expected)
    assert names[-1] == "concurrent" and masks[-1].all()


def test_one_program_serves_seeds_episodes_and_tests(toy, finished):
    assert toy.traced <= 2, "one for the shapes, one to compile"


def test_strategies_share_seeds_and_runs_do_not(finished):
    _, got = finished
    first = got["cost"][:, :, 0]
    assert (got["seeds"][0] != got["seeds"][1]).any()
    assert (got["seed_cost"] > codesign.SEED_COST).all()
    # A closed length keeps the seed's: run 1 starts in control, so it kept the length throughout.
    np.testing.assert_array_equal(got["particles"][0, 1, :, 0], got["seeds"][1, 0])
    np.testing.assert_array_equal(first[0], first[1])  # both open the same domain at first


class Killed(BaseException):
    """What no driver catches."""


@pytest.mark.slow  # quick: a killed run goes on (test_resume)
def test_a_run_that_is_killed_between_checkpoints_repeats_what_came_after(
    finished, tmp_path, monkeypatch
):
    """Every third episode is kept: killed in the fifth, the runs go on after the third."""
    begin, calls = Batch.begin, []

    def dies(batch, requests):
        calls.append(len(requests))
        steps = [int(np.asarray(request.state.episode)) for request in requests]
        if min(steps) == 4:
            raise Killed
        return begin(batch, requests)

    monkeypatch.setattr(Batch, "begin", dies)
    with pytest.raises(Killed):
        optimize(tmp_path, every=3)
    monkeypatch.setattr(Batch, "begin", begin)
    part = simulate.gather(PLAN, tmp_path, SEED)
    assert part["cost"].shape[2] == 3 and "test_cost" not in part
    kept = simulate.of_strategies(PLAN, *tiny()[:2], part)
    stopped = report.Study(dataclasses.asdict(PLAN), {}, kept)
    assert stopped.episodes == 3 and not stopped.tested and not stopped.success().any()
    optimize(tmp_path, every=3)
    again, whole = simulate.gather(PLAN, tmp_path, SEED), finished[1]
    assert again.keys() == whole.keys() and len(whole) == 10
    for name, value in whole.items():
        np.testing.assert_array_equal(again[name], value, err_msg=name)


def test_runs_that_are_no_variants_of_one_are_refused(toy, tmp_path):
    plans = simulate.plans(PLAN, scenes.load(TINY), "structured", tmp_path, SEED)
    folder, last = [*plans.items()][-1]
    plans[folder] = last._replace(settings=dataclasses.replace(last.settings, trials=5))
    with pytest.raises(ValueError, match="differs from"):
        runs.optimize(plans, ["test"])
    assert not any(tmp_path.iterdir())
    assert simulate.gather(PLAN, tmp_path / "nothing", SEED) is None


@pytest.mark.slow  # quick: the command's landscape goes on (test_showing)
def test_landscape_knows_its_axes(toy):
    whole = points()
    scene, space, _ = tiny()
    kept = simulate.of_landscape(scene, space, whole)
    ends = space.in_units(np.array([space.low, space.high]))
    np.testing.assert_allclose(kept["first_axis"][[0, -1]], ends[:, 0], rtol=1e-5)
    np.testing.assert_allclose(kept["second_axis"][[0, -1]], ends[:, 1], rtol=1e-5)
    # Toy physics: a grasp with longer fingers lasts longer.
    change = np.diff(np.where(whole["status"], 0.0, whole["trial_cost"]), axis=0)
    assert (change <= 0).all() and (change < 0).any()


def test_means_by_either_rule():
    scene, *_ = tiny()
    cost = np.array([[0.0, 1.0, 3.0], [3.0, 3.0, 3.0]], np.float32)
    status = np.array([[0, 0, 1], [1, 2, 64]], np.uint8)
    means = simulate.both_means(scene, cost, status)
    np.testing.assert_allclose(means["exclude"], [0.5, 3.0])
    np.testing.assert_allclose(means["worst"], [4 / 3, 3.0], rtol=1e-6)
    trials = Outcome(cost, status.astype(np.int32), cost, status)
    np.testing.assert_allclose(means["exclude"], codesign.particle_cost(scene, trials))
    bits = dict(zip(simulate.BITS, simulate.failures(status, (0, 1)), strict=True))
    assert [bits[b] for b in (1, 2, 64)] == [2, 1, 1] and sum(bits.values()) == 4


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


def test_several_comparisons():
    # The step-down procedure by hand: 4 * 0.005, 3 * 0.01, 2 * 0.03, and no smaller than that.
    found = statistics.holm([0.01, 0.04, 0.03, 0.005])
    np.testing.assert_allclose(found, [0.03, 0.06, 0.06, 0.02])


def test_both_readings_of_converged():
    """Below 1 in the second episode, above in the third, and below from the fourth on."""
    means = np.array([[[2.0, 0.5, 1.5, 0.9, 0.2], [2.0] * 5]])
    one = report.Study({}, {}, {"mean_exclude": means})
    np.testing.assert_array_equal(one.first_below(), [[2.0, np.inf]])
    np.testing.assert_array_equal(one.convergence(), [[4.0, np.inf]])


def test_regions_are_counted_and_specks_are_not():
    x, y = np.arange(20.0), np.arange(10.0)
    cost = np.full((20, 10), 3.0)
    cost[2:5, 2:5], cost[10:18, 6:9], cost[0, 9] = 0.5, 0.2, 0.0
    data = {"first_axis": x, "second_axis": y, "exclude": cost}
    found = report.regions(data, 1.0, smallest=0.02)
    assert [r.points.sum() for r in found] == [24, 9]
    np.testing.assert_allclose(found[0].low, [10, 6])
    np.testing.assert_allclose(found[0].high, [17, 8])
    assert len(report.regions(data, 0.3, smallest=0.0)) == 2


def summarized(finished):
    """What is kept of the toy's runs."""
    return simulate.of_strategies(PLAN, *tiny()[:2], finished[1])


def write_small(finished, folder):
    """Results of the toy in the place of every experiment's."""
    for name in ("2d", "23d"):
        plan = dataclasses.asdict(PLAN) | {"name": name}
        notes = {"settings": {"plan": plan, "scene": "paper"}, "commit": "0123abc"}
        notes |= {"grasps": PLAN.grasps}
        simulate.write(folder, name, summarized(finished), notes)
    kept = simulate.of_landscape(*tiny()[:2], points())
    notes = {"grasps": 80, "commit": "0123abc"}
    simulate.write(folder, "landscape", kept, notes)


def test_figures_and_page_are_made_from_files_alone(finished, tmp_path):
    write_small(finished, tmp_path)
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


def test_the_page_has_the_tables_of_its_data():
    data = ROOT / "docs" / "data" / "experiments"
    studies = {name: report.load_study(data, name) for name in ("2d", "23d")}
    text = report.tables(studies, report.load(data, "landscape"))
    assert text in (ROOT / "docs" / "notes" / "results.md").read_text(encoding="utf-8")


def test_what_was_not_run_is_said(tmp_path):
    text = report.make(tmp_path, tmp_path / "figures")
    assert text.count("not run") == 3
    assert report.label("switch-16") == "16"


@pytest.mark.slow  # quick: figures and page are made of such files, above
def test_the_command_writes_what_the_runs_have(toy, finished, tmp_path, monkeypatch):
    monkeypatch.setitem(simulate.SIZES, "tiny", ({"2d": PLAN}, ()))
    command = ["scripts.experiments", "2d", "--size", "tiny", "--scene", str(TINY)]
    command += ["--out", str(tmp_path), "--seed", str(SEED), "--commit", "xyz"]
    monkeypatch.setattr(sys, "argv", command)
    assert experiments.main() == 0
    arrays, notes = report.load(tmp_path, "2d")
    assert (notes["commit"], notes["grasps"]) == ("xyz", PLAN.grasps)
    whole = simulate.of_strategies(PLAN, *tiny()[:2], finished[1])
    assert all(np.array_equal(arrays[name], value) for name, value in whole.items())


# --- winners on fresh trials ----------------------------------------------------------------------


TWO = Strategies("2d", "2d", ("single", "concurrent"), 2, 3, 2, 3, 3)


def experiment(folder, tested=True):
    """An experiment of two strategies with two runs, whose second particle tested best."""
    particles = np.array([[0.08, 0.0], [0.09, 0.02], [0.10, 0.04]], np.float32)
    cost = np.array([0.3, 0.1, 0.2], np.float32)
    arrays = {
        "strategies": np.array(TWO.strategies),
        "final_particles": 1.01 * np.broadcast_to(particles, (2, 2, 3, 2)),
        "test_exclude": np.broadcast_to(cost if tested else cost * np.nan, (2, 2, 3)),
        "mean": np.zeros((2, 2, 2)),
    }
    plan = {"name": "2d", "runs": 2, "particles": 3, "trials": 3, "episodes": 2}
    write(folder, "2d", arrays, {"settings": {"plan": plan}})
    return particles[1] * 1.01


def test_the_particle_that_tested_best_is_taken(tmp_path):
    best = experiment(tmp_path)
    names, found = fresh.winners(tmp_path, "2d")
    assert names == ["single", "concurrent"] and found.shape == (2, 2, 2)
    np.testing.assert_allclose(found, np.broadcast_to(best, (2, 2, 2)), rtol=1e-6)
    experiment(tmp_path, tested=False)
    with pytest.raises(FileNotFoundError, match="no 2d with a final test"):
        fresh.winners(tmp_path, "2d")


def test_the_command_simulates_once_and_reports(tmp_path, monkeypatch, capsys):
    experiment(tmp_path)
    page = tmp_path / "page.md"
    page.write_text("<!-- fresh:begin -->\n<!-- fresh:end -->\n")
    command = ["fresh", "--data", str(tmp_path), "--scene", str(TINY), "--engine", "mujoco"]
    command += ["--experiments", "2d", "--trials", "2", "--accuracies", "standard"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "argv", [*command, "--page", str(page)])
    assert fresh.main() == 0
    arrays = dict(np.load(tmp_path / "fresh.npz"))
    cost = arrays["2d|mujoco, standard|cost"]
    # The same particle in the same trials: the same costs in every strategy and run.
    assert cost.shape == (2, 2, 2) and (cost == cost[:1, :1]).all()
    assert "2 fresh trials" in page.read_text() and "2d" in capsys.readouterr().out
    assert fresh.main() == 0
    assert len(json.loads((tmp_path / "fresh.json").read_text())["runs"]) == 1
    monkeypatch.setattr(sys, "argv", [*command[:2], str(tmp_path / "none")])
    with pytest.raises(SystemExit, match="holds no"):
        fresh.main()


WHAT = ("cost", "status")


def test_shares_leave_out_failed_trials_and_compare_runs():
    cost = np.array([[[0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 0.0]]], np.float16)
    status = np.array([[[0, 8, 0, 2], [0, 0, 0, 0]]], np.uint8)  # a warning counts, a failure not
    arrays = {
        "2d|strategies": np.array(["concurrent"]),
        "2d|standard|cost": cost,
        "2d|standard|status": status,
        "2d|reference|cost": np.ones_like(cost),
        "2d|reference|status": 0 * status,
    }
    np.testing.assert_allclose(fresh._kept(arrays, "2d", "standard"), [[2 / 3, 1.0]])
    line = fresh._table("2d", arrays, ["standard", "reference"]).splitlines()[-1]
    assert "| 83.3 % | 1 of 2" in line and "| -83.3 [-100.0, -66.7] |" in line
    # One trial only is compared with the first one.
    arrays |= {f"2d|short|{what}": arrays[f"2d|standard|{what}"][..., :1] for what in WHAT}
    line = fresh._table("2d", arrays, ["standard", "short"]).splitlines()[-1]
    assert "| 100.0 % | 2 of 2" in line and "| +0.0 [+0.0, +0.0] |" in line
