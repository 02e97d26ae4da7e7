"""Best final particles on fresh trials: whose they are, that they are simulated, what is said."""

import json
import sys

import numpy as np
import pytest

from codesign_jax import scene
from scripts.experiments import fresh
from scripts.experiments.simulate import Strategies, write
from tests.helpers.toy_engine import TINY

PLAN = Strategies("2d", "2d", ("single", "concurrent"), 2, 3, 2, 3, 3)


def experiment(folder, tested=True):
    """An experiment of two strategies with two runs, whose second particle tested best."""
    particles = np.array([[0.08, 0.0], [0.09, 0.02], [0.10, 0.04]], np.float32)
    cost = np.array([0.3, 0.1, 0.2], np.float32)
    arrays = {
        "strategies": np.array(PLAN.strategies),
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
    assert scene.load("paper", accuracy="reference").discretization.links == 20
