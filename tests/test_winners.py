"""Final particles simulated again: what is varied, resuming, and the table."""

import json
import runpy
import shutil
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from codesign_jax import archives, rollout
from codesign_jax.codesign import stream_key
from codesign_jax.engines import make_engine
from codesign_jax.scene import InputError, parameters
from scripts.winners import (
    files as winners_files,
)
from scripts.winners import (
    report as winners_report,
)
from scripts.winners import (
    variants as winners,
)
from scripts.winners.variants import STANDARD, VARIANTS, Finals, Task, Variant
from tests.helpers import grasps

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
    space, trial = parameters.design_space(plain.hand), rollout.nominal_trial(plain)
    params = space.params(space.default())
    before, after = (grasps.world_inputs(s, params, trial)[0] for s in (plain, changed))
    # In float32, to some roundings.
    np.testing.assert_allclose(after.pair_friction[:, :2], 1.3 * before.pair_friction[:, :2], 1e-5)
    np.testing.assert_allclose(after.jnt_stiffness, 0.8 * before.jnt_stiffness, 1e-5)
    np.testing.assert_array_equal(after.body_mass, before.body_mass)


def test_variants_have_names_of_their_own_and_fit_on_a_command_line():
    names = [v.name for v in VARIANTS]
    assert len(set(names)) == len(names)
    assert not [n for n in names if "," in n or "|" in n]
    surface = {v.name: v.scene(SMALL).effects.surface for v in VARIANTS}
    assert [n for n in names if surface[n] != "spheres"] == ["hull"] and surface["hull"] == "hull"


@pytest.fixture(scope="module")
def finals():
    return winners.finals(DATA, "23d", runs=2, particles=2)


@pytest.mark.slow  # quick: runs of an experiment's batch are single ones (test_experiments)
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


def test_a_drive_goes_on_where_it_stopped(finals, tmp_path, monkeypatch):
    """Calls make up their costs: what they simulate is the other tests'."""

    def run(task, more, limit):
        assert more == SMALL
        names = (f"{task.key}|{part}" for part in ("cost", "status"))
        types = (np.float16, np.uint8)
        return {n: np.full((2, 1, 3), task.block, t) for n, t in zip(names, types, strict=True)}

    monkeypatch.setattr(Task, "run", run)
    path, said, settings = tmp_path / "w.npz", [], {"size": "tiny"}
    todo = winners.tasks([finals], [Variant("MuJoCo C", engine="mujoco", best=True)], 2, 3)
    assert [t.block for t in todo] == [0, 1]
    noted = []

    def note(key):
        stored = archives.load(path) if path.exists() else {}
        noted.append((key, len(winners_files.calls(stored))))
        winners_files.write_runs(path, settings, [{"calls": [key]}])

    first, finished = winners.drive(
        todo[:1], path, settings, more=SMALL, say=said.append, note=note
    )
    assert finished and len(said) == 1
    assert noted == [("23d|MuJoCo C|0", 0)]  # before its numbers: none is ever without its run
    _, finished = winners.drive(todo, path, settings, more=SMALL, budget=-1.0, say=said.append)
    assert not finished and "1 of 2" in said[-1]
    every, finished = winners.drive(todo, path, settings, more=SMALL, say=said.append)
    assert finished and len(said) == 3
    for name, value in first.items():
        np.testing.assert_array_equal(every[name], value)
    assert winners.gather(every, "23d", "MuJoCo C")[0].shape == (2, 1, 6)
    assert winners.gather(every, "23d", "nothing") is None
    with pytest.raises(InputError, match="size"):
        winners.drive(todo, path, {"size": "paper"})


def made(kept, failed=()):
    """Results of one block from a table of kept grasps, (run, particle, trial)."""
    cost = np.where(kept, 0.0, 1.5).astype(np.float16)
    status = np.zeros(cost.shape, np.uint8)
    for index in failed:
        status[index], cost[index] = 1, 3.0
    return cost, status


def stored(path, runs, **variants):
    """A file of one block of each variant, whose grasps all have one cost."""
    results = {}
    for name, cost in variants.items():
        results[f"2d|{name}|0|cost"] = np.full((2, 1, 3), cost, np.float16)
        results[f"2d|{name}|0|status"] = np.zeros((2, 1, 3), np.uint8)
    archives.save(path, results)
    winners_files.write_runs(path, {"size": "tiny"}, runs)
    return path


def test_files_are_joined_with_their_runs(tmp_path):
    a = stored(tmp_path / "a.npz", [{"command": "A", "calls": ["2d|x|0", "2d|y|0"]}], x=0, y=1)
    b = stored(tmp_path / "b.npz", [{"command": "B", "calls": ["2d|y|0", "2d|z|0"]}], y=1, z=2)
    out = tmp_path / "new" / "out.npz"
    assert sorted(winners_files.merge([a, b], out)) == ["2d|x|0", "2d|y|0", "2d|z|0"]
    results, _, runs = winners_files.read(out)
    assert [float(results[f"2d|{v}|0|cost"].max()) for v in "xyz"] == [0, 1, 2]
    assert [(r["command"], r["calls"]) for r in runs] == [
        ("A", ["2d|x|0", "2d|y|0"]),
        ("B", ["2d|z|0"]),
    ]
    with pytest.raises(InputError, match="exists and is not among"):
        winners_files.merge([a, b], out)
    c = stored(tmp_path / "c.npz", [{"command": "C", "calls": ["2d|z|0"]}], z=1)
    with pytest.raises(InputError, match="c.npz: its 2d|z|0|cost differs"):
        winners_files.merge([out, c], out)
    other = tmp_path / "d.npz"
    archives.save(other, {})
    winners_files.write_runs(other, {"size": "cpu"}, [])
    with pytest.raises(InputError, match="size: cpu there, tiny wanted"):
        winners_files.merge([out, other], out)
    (tmp_path / "c.json").unlink()
    with pytest.raises(InputError, match="cannot be read from its .json"):
        winners_files.merge([out, c], out)


def test_an_early_file_s_command_is_not_held_for_calls_that_it_did_not_make(tmp_path):
    path = stored(tmp_path / "a.npz", [], x=0, hull=1)
    early = {"command": "python w.py --variants x", "commit": "abc", "settings": {"size": "tiny"}}
    path.with_suffix(".json").write_text(json.dumps(early))
    _, _, runs = winners_files.read(path)
    assert [(r["command"], r["calls"]) for r in runs] == [
        ("python w.py --variants x", ["2d|x|0"]),
        (winners_files.UNKNOWN, ["2d|hull|0"]),
    ]


def test_a_call_repeated_after_a_kill_is_the_later_run_s():
    runs = [{"command": "A", "calls": ["a", "b"]}, {"command": "B", "calls": []}]
    winners_files.note(runs, "b")
    assert [r["calls"] for r in runs] == [["a"], ["b"]]


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
    assert first.standard is None and second.standard == (3, pytest.approx(5 / 8))


def test_a_variant_of_fewer_blocks_is_compared_in_the_same_trials():
    """The standard loses an object in its second block, which the variant never met."""
    finals = Finals("2d", "2d", np.zeros((2, 1, 2), np.float32), np.zeros((2, 1), np.float32))
    kept, results = np.ones((2, 1, 3), bool), {}
    late = kept.copy()
    late[0, 0, 1] = False
    for key, table in ((f"{STANDARD}|0", kept), (f"{STANDARD}|1", late), ("hull|0", kept)):
        results[f"2d|{key}|cost"], results[f"2d|{key}|status"] = made(table)
    first, second = winners_report.rows(results, finals)
    assert (first.name, first.trials, first.counts) == (STANDARD, 6, (1, 2))
    assert (second.name, second.trials, second.counts) == ("hull", 3, (2, 2))
    assert second.standard == (2, 1.0) and second.p == 1.0 and second.same == 1.0


def test_the_script_simulates_and_draws(tmp_path, monkeypatch, capsys):
    """The script with MuJoCo C alone; its table has the standard it is compared with."""
    monkeypatch.chdir(ROOT)
    out = tmp_path / "winners.npz"

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["winners", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            runpy.run_module("scripts.winners", run_name="__main__", alter_sys=True)
        return end.value.code

    small = ["--size", "tiny", "--experiments", "23d", "--set", *SMALL, "--out", out]
    assert "unknown" in run(*small, "--variants", "MuJoCo D")
    assert not out.exists()
    assert run(*small, "--variants", "MuJoCo C", "--commit", "abc") == 0
    fine = ["--variants", "MuJoCo C at 1 ms and 20 links", "--set", "discretization.timestep=0.01"]
    assert "set: " in run(*small, *fine)  # other settings: refused, and nothing is noted
    extra = ["--extra", "rough:contact.finger_table_friction=1.5", "--variants", "MuJoCo C,rough"]
    assert run(*small, *extra, "--commit", "def", "--budget", "-1") == 3
    both = ["--experiments", "23d,2d", "--variants", "MuJoCo C", "--commit", "def"]
    assert run(*small, *both) == 0
    results, settings, runs = winners_files.read(out)
    assert [(r["commit"], r["calls"]) for r in runs] == [
        ("abc", ["23d|MuJoCo C|0"]),
        ("def", ["2d|MuJoCo C|0"]),
    ]
    assert runs[0]["command"].startswith("python -m scripts.winners --size tiny")
    assert "'MuJoCo C'" in runs[0]["command"] and runs[0]["versions"]["mujoco"]
    # The standard's place is taken by the same grasps: every share of agreement is then one.
    for part in ("cost", "status"):
        results[f"23d|{STANDARD}|0|{part}"] = results[f"23d|MuJoCo C|0|{part}"]
    runs.append({"command": "copied", "calls": [f"23d|{STANDARD}|0"]})
    archives.save(out, results)
    winners_files.write_runs(out, settings, runs)
    for name in ("23d.npz", "2d.npz"):
        shutil.copy(DATA / name, tmp_path)
    page = tmp_path / "results.md"
    page.write_text("<!-- winners:begin -->\nold\n<!-- winners:end -->\n")
    text = winners_report.make(tmp_path, tmp_path, page)
    assert "100.0 %" in text and "of 2" in text
    assert "at commit abc, cpu" in text and "* `copied`: 6 grasps" in text
    assert "old" not in page.read_text() and text in page.read_text()
    assert (tmp_path / "winners.png").stat().st_size > 5_000
