"""Accuracy: presets, the study's variants and tips, and its tables of verdicts that are known."""

import dataclasses
import json
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import cli, model, scene
from codesign_jax.commands import optimize
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import parameters, schema
from scripts.accuracy import budget, report
from scripts.shared import output, work
from tests.helpers.grasps import pinch, still, world_inputs

DATA = Path(__file__).parents[1] / "docs" / "data" / "experiments"


# --- presets -------------------------------------------------------------------------------------


def test_presets_replace_the_scene_s_values_and_overrides_replace_theirs():
    assert scene.load("paper", accuracy="standard") == scene.load("paper")
    fine = scene.load("paper_spheres", accuracy="reference")
    assert fine.discretization == scene.Discretization(0.001, 20, 1, spring_damping="least")
    fast = scene.load("paper_spheres", accuracy="fast", overrides={"discretization": {"links": 7}})
    assert (fast.discretization.links, fast.newton.iterations) == (7, 4)
    for name, iterations in {"fast": 4, "fine": 6}.items():
        found = scene.load("paper", accuracy=name)
        assert StructuredEngine(found).limits.iterations == iterations


def test_an_unknown_preset_is_refused_with_the_other_problems(tmp_path):
    wrong = {"discretization": {"timestep": 18.0}}
    with pytest.raises(schema.InputError) as error:
        scene.load("paper_spheres", accuracy="fats", overrides=wrong)
    assert "did you mean 'fast'" in str(error.value)
    assert "0.018" in str(error.value)
    mistaken = tmp_path / "mine.toml"
    mistaken.write_text('description = "x"\n[discretization]\nlink = 3\n[solver]\n')
    with pytest.raises(schema.InputError, match="links"):
        scene.load("paper_spheres", accuracy=mistaken)


def test_the_command_line_takes_a_preset(capsys):
    found, _ = optimize.resolve(
        cli.Optimize(accuracy="fast", engine="mujoco", overrides=(("solver.iterations=7",),))
    )
    assert found.discretization == scene.Discretization(0.01, 10, 1, spring_damping="least")
    assert found.solver.iterations == 7
    assert cli.main(["evaluate", "--accuracy", "fastest"]) == 2
    assert "'fastest' unknown; did you mean 'fast'" in capsys.readouterr().err


def test_mujoco_converges_with_the_scene_s_own_limits():
    """A line search that ends early looks like convergence: 20 iterations were too few.

    Of 480 states in contact the largest error is 1.6e-4 with the scene's limits; with 20
    iterations of the line search a tenth of them errs by 0.04 and more.
    """
    plain = {"links": 4, "spheres_per_link": 1}, {"surface": "spheres", "finger_finger": False}
    overrides = dict(zip(("discretization", "effects"), plain, strict=True))
    base = scene.load("paper", overrides=overrides)
    exact = dataclasses.replace(base, solver=scene.Solver(300, 100, 1e-15))
    few = dataclasses.replace(base, solver=dataclasses.replace(base.solver, ls_iterations=20))
    with jax.enable_x64(True):
        worlds = jax.tree.map(np.asarray, work.make_worlds(exact, 4))
        fields, ctrl = jax.tree.map(np.asarray, work.inputs(exact, worlds))
    errors = ([], [])
    first, last = (round(t / 0.01) for t in (exact.phases.approach, exact.phases.disturb))
    for w in range(4):
        of_world = jax.tree.map(lambda x, w=w: x[w], fields)
        truth, *others = (world_model(s, of_world) for s in (exact, base, few))
        d, datas = mujoco.MjData(truth), [mujoco.MjData(m) for m in others]
        d.qpos[:] = of_world.start
        for k in range(last):
            d.ctrl[:] = ctrl[w, k]
            if k >= first and k % 30 == 0:
                mujoco.mj_forward(truth, d)
                for m, data, found in zip(others, datas, errors, strict=True):
                    data.qpos[:], data.qvel[:], data.ctrl[:] = d.qpos, d.qvel, d.ctrl
                    mujoco.mj_forward(m, data)
                    away = np.linalg.norm(data.qacc - d.qacc)
                    found.append(away / max(np.linalg.norm(d.qacc), 100.0))
            mujoco.mj_step(truth, d)
    assert max(errors[0]) < 1e-3 and max(errors[1]) > 1e-2


# --- finger tips ---------------------------------------------------------------------------------


def test_tips_lie_a_segment_behind_the_last_joint():
    """A straight finger's tip is its length away from its root."""
    small = pinch("box", links=2)
    space = parameters.design_space(small.hand)
    params = space.params(space.default())
    fields = jax.tree.map(np.asarray, world_inputs(small, params, still())[0])
    compiled = world_model(small, fields)
    data = mujoco.MjData(compiled)
    data.qpos[:] = fields.start
    mujoco.mj_kinematics(compiled, data)
    roots = data.xpos[model.layout(small).stubs]
    away = np.linalg.norm(budget.tips(small, compiled, fields.start) - roots, axis=1)
    # The default lengths are float32 of the table's millimetres.
    np.testing.assert_allclose(away, params.length, rtol=1e-6)


# --- verdicts ------------------------------------------------------------------------------------


def test_designs_are_distinct_final_particles_two_of_each_run():
    found = budget.late_designs(DATA, 60)
    with np.load(DATA / "23d.npz") as file:
        final = file["final_particles"][-1]
    assert len(np.unique(found, axis=0)) == 60
    runs = [[(run == p).all(1).any() for run in final] for p in found]
    assert np.all(np.sum(runs, 0) >= 2)
    with pytest.raises(ValueError, match="distinct"):
        budget.late_designs(DATA, 10_000)


def test_costs_come_back_from_their_text():
    the_scene = scene.load("paper")
    start, end = the_scene.window
    lost = np.array([[np.inf, start, end - 1e-3], [0.5 * (start + end), np.inf, np.inf]])
    bad = np.array([[False, False, False], [False, True, False]])
    record = {"lost": budget.encode(lost, bad, the_scene.window), "particles": 2, "trials": 3}
    expected = [[0.0, 3.0, 0.0], [1.5, np.nan, 0.0]]
    # A byte counts 250th parts of the time in which a loss costs: half of one, times 3.
    np.testing.assert_allclose(budget.costs(the_scene, record), expected, atol=0.0061)


def test_every_variant_is_a_scene_and_every_row_has_its_variants(tmp_path):
    scenes = {name: variant.scene() for name, variant in budget.VARIANTS.items()}
    fine = scenes["truth"].discretization
    assert (fine.timestep, fine.links, fine.hull_rings, fine.hull_points) == (0.002, 20, 4, 16)
    assert scenes["1e-3"].newton.decrement == 1e-3 and scenes["4 iterations"].newton.iterations == 4
    named = {n for c in report.CHANGES for n in (c.of, c.to)}
    named |= {*report.PRESETS, *report.CANDIDATES, *budget.TIMED, *report.WORDS}
    assert named <= set(budget.VARIANTS)
    assert len({budget.path_of(tmp_path, name) for name in budget.VARIANTS}) == len(scenes)
    json.dumps(budget.merged(tmp_path))


def test_constants_are_those_of_sets_that_no_target_ruled_out():
    drawn = budget.calibrated(scene.load("paper"), 5, 2)
    masses = np.asarray(drawn.objects.object[0].mass)
    assert masses.shape == (10,) and np.array_equal(masses[:5], masses[5:])
    assert len(np.unique(masses)) == 5 and masses.max() < 0.3


def test_comparing_a_variant_with_itself_and_with_its_opposite():
    cost = np.array([[0.0, 0.0], [0.0, 3.0], [3.0, 3.0], [1.0, 0.0], [2.0, 2.0], [0.5, 0.0]])
    same = report.compare(cost, cost)
    assert same["flipped"].value == 0.0 and same["rank"].value == pytest.approx(1.0)
    assert report.compare(3.0 - cost, cost)["rank"].value == pytest.approx(-1.0)
    failed = cost.copy()
    failed[0, 0] = np.nan
    assert report.compare(failed, cost)["flipped"].value == pytest.approx(1 / 12), "not kept"
    alike = report.compare(np.ones((6, 2)), np.zeros((6, 2)))
    assert np.isnan(alike["rank"]).all() and alike["flipped"] == (1.0, 1.0, 1.0)


WINDOW = scene.load("paper").window


def record(kept):
    lost = np.where(kept, np.inf, WINDOW[0])
    text = budget.encode(lost, np.zeros(kept.shape, bool), WINDOW)
    return {"particles": kept.shape[0], "trials": kept.shape[1], "lost": text, "status": {}}


def rate(value):
    return {"grasps": 240, "seconds": 240 / value, "grasps_per_s": value}


@pytest.fixture
def found():
    """20 designs in 12 trials: the truth loses 30 of 240, standard 18 of these alone."""
    truth = np.ones((20, 12), bool)
    truth[:15, :2] = False
    standard = truth.copy()
    standard[:6, :2] = True
    moved = standard.copy()
    moved[0, :6] = False
    variants = {"truth": truth, "standard": standard, "standard, moved": moved}
    every = {name: record(kept) for name, kept in variants.items()}
    return {"variants": every | {"spheres": {"refused": "no"}}, "rates": {}}


def test_biases_and_flips_are_those_that_were_planted(found):
    made = report.Budget(found)
    row = made.row("standard", "`standard`")
    assert row[1].startswith("+5.0 [") and row[2].startswith("5.0% [")  # 12 of 240
    assert row[4] == "2.5%" and row[5:] == ["–"] * 3
    rows = {cells[0]: cells for cells in report.budget_table(made)}
    assert rows["object moved by a micrometre, `standard`"][2].startswith("-2.5 [")
    assert rows["step, links and skin at once: the truth"][2].startswith("-5.0 [")
    assert "spheres in place of the skin" not in rows, "refused"
    assert len(report.presets_table(made)[0]) == 6, "no rates"


def test_tables_and_figures_have_what_was_planted(found, tmp_path):
    """A setting without rate or without error is no mark; nothing stands for what is not there."""
    found["variants"]["spheres, MuJoCo C"] = found["variants"]["standard"]
    found["rates"] = {
        "gpu": {"rates": {"standard": rate(500), "fast": rate(600)}},  # fast has no verdicts
        "cpu": {"rates": {"standard": rate(50), "truth": rate(1), "spheres, MuJoCo C": rate(3)}},
    }
    found["tips"] = {"tip_rms_mm": {"standard": 5.0, "fast": 2.0, "least, 1e-3": 2.0}}
    made = report.Budget(found)
    head, *rows = report.presets_table(made)
    assert head[6:] == ["grasps/s, one H100", "grasps/s, 2 CPU cores"]
    assert {row[0]: row[6:] for row in rows}["`standard`"] == ["500", "50"]
    left, right = report.marks(made)
    ours, c = "this engine", ("MuJoCo C, 2 CPU cores", "spheres, no skin", 3)
    of_standard = {(f"{ours}, one H100", "standard", 500), (f"{ours}, 2 CPU cores", "standard", 50)}
    assert {m[:3] for m in left} == of_standard | {c}
    assert all(m.error.value == 0.05 and m.error.low < 0.05 < m.error.high for m in left)
    assert {m[:3] for m in right} == of_standard | {(f"{ours}, one H100", "fast", 600)}
    assert report.draw_against_time(made, tmp_path / "time.png").stat().st_size > 5000
    assert report.draw_budget(made, tmp_path / "budget.png").stat().st_size > 5000


def test_names_that_would_meet_are_moved_apart():
    axis = output.new_figure(4, 3).subplots()
    axis.set(xlim=(1, 10), ylim=(0, 1), xscale="log")
    heights = report._apart(axis, [(2, 0.5), (3, 0.51), (2, 0.9), (4, 0.5)], least=0.1)
    assert heights == pytest.approx([0.405, 0.605, 0.9, 0.505], abs=0.02)


def test_the_page_has_the_tables_of_its_data(monkeypatch):
    monkeypatch.setattr(report, "RESAMPLES", 2)  # intervals are left out of the comparison
    made = report.Budget(json.loads((DATA.parent / "budget.json").read_text()))
    page = (DATA.parents[1] / "accuracy.md").read_text()
    for mark, text in made.tables().items():
        shown = page.split(f"<!-- {mark}:begin -->")[1].split(f"<!-- {mark}:end -->")[0]
        assert _without_intervals(shown.strip()) == _without_intervals(text), mark


def _without_intervals(text):
    return [part.split("]")[-1] for part in text.split("[")]
