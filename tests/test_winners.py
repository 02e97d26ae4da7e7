"""Final particles simulated again: what is varied, resuming, and the table."""

import json
import runpy
import shutil
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from codesign_jax import model, parameters, rollout
from codesign_jax.codesign import stream_key
from codesign_jax.engines import make_engine
from codesign_jax.experiments import record, winners, winners_report
from codesign_jax.experiments.winners import STANDARD, VARIANTS, Finals, Task, Variant

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs" / "data" / "reproduction"
SMALL = ("discretization.links=2",)
QUICK = Variant("MuJoCo C", engine="mujoco", best=True, blocks=1)


def test_finals_are_the_concurrent_strategy_s_with_the_best_first():
    found = winners.finals(DATA, "2d", runs=8, particles=3)
    with np.load(DATA / "2d.npz") as file:
        assert file["strategies"][-1] == "concurrent"
        particles, cost = file["final_particles"][-1], file["test_exclude"][-1]
    for run in range(8):
        best = particles[run, cost[run].argmin()]
        np.testing.assert_array_equal(found.chosen(True)[run, 0], best)
    np.testing.assert_array_equal(found.cost, np.sort(cost[:8], 1)[:, :3])
    assert found.successful.tolist() == (cost[:8].min(1) < 0.01).tolist()


def test_friction_and_stiffness_reach_mujoco_s_model():
    """Every pair's Coulomb coefficient and every spring, by the factors asked for."""
    plain, changed = (
        v.scene(SMALL) for v in (Variant("a"), Variant("b", friction=1.3, stiffness=0.8))
    )
    before, after = (model.compile_template(s) for s in (plain, changed))
    np.testing.assert_allclose(after.pair_friction[:, :2], 1.3 * before.pair_friction[:, :2])
    np.testing.assert_allclose(after.jnt_stiffness, 0.8 * before.jnt_stiffness)
    np.testing.assert_array_equal(after.body_mass, before.body_mass)


def test_variants_have_names_of_their_own_and_fit_on_a_command_line():
    names = [v.name for v in VARIANTS]
    assert len(set(names)) == len(names)
    assert not [n for n in names if "," in n or "|" in n]


@pytest.fixture(scope="module")
def finals():
    return winners.finals(DATA, "23d", runs=2, particles=2)


def test_a_call_is_an_evaluation_of_these_particles(finals):
    """The costs are those of `rollout.evaluate` in trials drawn from the block's own key."""
    found = Task(finals, QUICK, 1, 3).run(SMALL)
    scene = QUICK.scene(SMALL)
    space = parameters.design_space(scene.hand, "23d")
    key = stream_key(jax.random.key(0), winners.STREAM_WINNERS, 1)
    trials = rollout.sample_trials(scene, key, 3)
    params = jax.vmap(space.params)(finals.chosen(True)[:, 0])
    engine = make_engine("mujoco", scene)
    expected = jax.jit(lambda p, t: rollout.evaluate(scene, engine, p, t))(params, trials)
    cost = found["23d|MuJoCo C|1|cost"]
    assert cost.shape == (2, 1, 3)
    np.testing.assert_array_equal(cost[:, 0], np.asarray(expected.cost).astype(np.float16))
    np.testing.assert_array_equal(found["23d|MuJoCo C|1|status"][:, 0], expected.status)


def test_a_drive_goes_on_where_it_stopped(finals, tmp_path):
    path, said, settings = tmp_path / "w.npz", [], {"size": "tiny"}
    todo = winners.tasks([finals], [Variant("MuJoCo C", engine="mujoco", best=True)], 2, 3)
    assert [t.block for t in todo] == [0, 1]
    first, finished = winners.drive(todo[:1], path, settings, more=SMALL, say=said.append)
    assert finished and len(said) == 1
    _, finished = winners.drive(todo, path, settings, more=SMALL, budget=-1.0, say=said.append)
    assert not finished and "1 of 2" in said[-1]
    every, finished = winners.drive(todo, path, settings, more=SMALL, say=said.append)
    assert finished and len(said) == 3
    for name, value in first.items():
        np.testing.assert_array_equal(every[name], value)
    assert winners.gather(every, "23d", "MuJoCo C")[0].shape == (2, 1, 6)
    assert winners.gather(every, "23d", "nothing") is None
    with pytest.raises(record.StateError, match="size"):
        winners.drive(todo, path, {"size": "paper"})


def made(kept, failed=()):
    """Results of one block from a table of kept grasps, (run, particle, trial)."""
    cost = np.where(kept, 0.0, 1.5).astype(np.float16)
    status = np.zeros(cost.shape, np.uint8)
    for index in failed:
        status[index], cost[index] = 1, 3.0
    return cost, status


def test_shares_are_counted_over_successful_runs():
    """Four runs of which three succeeded; under the variant one of these loses an object."""
    particles = np.zeros((4, 2, 23), np.float32)
    cost = np.array([[0.0, 0.5], [0.0, 0.0], [0.0, 1.0], [0.2, 0.4]], np.float32)
    finals = Finals("23d", "23d", particles, cost)
    kept = np.ones((4, 2, 4), bool)
    kept[:, 1] = [[True] * 4, [False] * 4, [False] * 4, [False] * 4]
    other = kept.copy()
    other[1, 0, 2] = False
    results = {}
    for name, table, failed in ((STANDARD, kept, ()), ("friction -30 %", other, [(0, 0, 1)])):
        c, s = made(table, failed)
        results |= {f"23d|{name}|0|cost": c, f"23d|{name}|0|status": s}
    first, second = winners_report.rows(results, finals)
    assert first.counts == (3, 3) and first.p is None
    assert second.counts == (2, 3)  # a failed trial is left out of the mean, as in the paper
    assert second.p == 1.0  # one discordant pair
    assert second.kept.value == pytest.approx(10 / 12) and second.same == pytest.approx(10 / 12)
    assert first.every.value == pytest.approx(5 / 8)
    assert second.every.value == pytest.approx(4 / 8)
    assert second.failed == pytest.approx(1 / 32)


def test_the_script_simulates_and_draws(tmp_path, monkeypatch, capsys):
    """The script with MuJoCo C alone; its table has the standard it is compared with."""
    monkeypatch.chdir(ROOT)
    out = tmp_path / "winners.npz"

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["scripts/winners.py", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            runpy.run_path("scripts/winners.py", run_name="__main__")
        return end.value.code

    small = ["--size", "tiny", "--experiments", "23d", "--set", *SMALL, "--out", out]
    assert "unknown" in run(*small, "--variants", "MuJoCo D")
    assert not out.exists()
    assert run(*small, "--variants", "MuJoCo C", "--commit", "abc") == 0
    assert json.loads(out.with_suffix(".json").read_text())["commit"] == "abc"
    results = record.load(out, json.loads(out.with_suffix(".json").read_text())["settings"])
    # The standard's place is taken by the same grasps: every share of agreement is then one.
    for part in ("cost", "status"):
        results[f"23d|{STANDARD}|0|{part}"] = results[f"23d|MuJoCo C|0|{part}"]
    np.savez(out, **results)
    shutil.copy(DATA / "23d.npz", tmp_path)
    page = tmp_path / "results.md"
    page.write_text("<!-- winners:begin -->\nold\n<!-- winners:end -->\n")
    text = winners_report.make(tmp_path, tmp_path, page)
    assert "100.0 %" in text and "of 2" in text
    assert "old" not in page.read_text() and text in page.read_text()
    assert (tmp_path / "winners.png").stat().st_size > 5_000
