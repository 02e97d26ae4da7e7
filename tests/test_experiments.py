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
from codesign_jax.types import Outcome
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


@pytest.mark.slow  # quick: the tables of stored runs are those of the page
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
