"""Accuracy: presets, the study's variants and tips, and its tables of verdicts that are known."""

import dataclasses
import json
from pathlib import Path

import jax
import mujoco
import numpy as np

from codesign_jax import cli, scene
from codesign_jax.commands import optimize
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from scripts.accuracy import budget, report
from scripts.shared import work

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
        worlds = jax.tree.map(np.asarray, work.make_worlds(exact, 2))
        fields, ctrl = jax.tree.map(np.asarray, work.inputs(exact, worlds))
    errors = ([], [])
    first, last = (round(t / 0.01) for t in (exact.phases.approach, exact.phases.disturb))
    for w in range(2):
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


# --- verdicts ------------------------------------------------------------------------------------


def test_every_variant_is_a_scene_and_every_row_has_its_variants(tmp_path):
    scenes = {name: variant.scene() for name, variant in budget.VARIANTS.items()}
    fine = scenes["truth"].discretization
    assert (fine.timestep, fine.links, fine.hull_rings) == (0.002, 20, 4)
    assert scenes["1e-3"].newton.decrement == 1e-3 and scenes["4 iterations"].newton.iterations == 4
    named = {n for c in report.CHANGES for n in (c.of, c.to)}
    named |= {*report.PRESETS, *report.CANDIDATES, *budget.TIMED, *report.WORDS}
    assert named <= set(budget.VARIANTS)
    assert len({budget.path_of(tmp_path, name) for name in budget.VARIANTS}) == len(scenes)
    json.dumps(budget.merged(tmp_path))


def test_the_page_has_the_tables_of_its_data(monkeypatch):
    monkeypatch.setattr(report, "RESAMPLES", 2)  # intervals are left out of the comparison
    made = report.Budget(json.loads((DATA.parent / "budget.json").read_text()))
    page = (DATA.parents[1] / "accuracy.md").read_text()
    for mark, text in made.tables().items():
        shown = page.split(f"<!-- {mark}:begin -->")[1].split(f"<!-- {mark}:end -->")[0]
        assert _without_intervals(shown.strip()) == _without_intervals(text), mark


def _without_intervals(text):
    return [part.split("]")[-1] for part in text.split("[")]
