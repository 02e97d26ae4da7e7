"""The study of accuracy: presets, settings, oracles and the file of its records."""

import dataclasses
import json
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import cli, model, scene
from codesign_jax.commands import asked
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import parameters, schema
from codesign_jax.scene.effects import ENGINES
from scripts.accuracy import beam, decision, impulse, oracle, study, tip, worlds
from scripts.accuracy.settings import PRESETS, STANDARD, Setting, one_at_a_time
from scripts.accuracy.store import Case, Store, merge
from scripts.accuracy.timing import name
from scripts.shared import peers
from tests.helpers.grasps import pinch, still

ROOT = Path(__file__).parents[1]


# --- presets -------------------------------------------------------------------------------------


def test_the_standard_preset_is_the_scene_and_the_study_s_default():
    assert scene.load("paper", accuracy="standard") == scene.load("paper")
    off = {"effects.finger_finger": False, "effects.finger_palm": False}
    assert STANDARD.scene() == scene.load("paper", overrides=off)


def test_presets_replace_the_scene_s_values_and_overrides_replace_theirs():
    fine = scene.load("paper_spheres", accuracy="reference")
    assert fine.discretization == scene.Discretization(0.001, 20, 1, spring_damping="least")
    for preset_name, setting in PRESETS.items():
        preset = scene.load("paper", accuracy=preset_name).discretization
        mine = setting.scene().discretization
        # The study varies no spheres where the hull is the surface.
        assert dataclasses.replace(preset, spheres_per_link=1) == mine
        assert setting in one_at_a_time("structured")
    fast = scene.load("paper_spheres", accuracy="fast", overrides={"discretization": {"links": 7}})
    assert (fast.discretization.links, fast.newton.iterations) == (7, 4)
    for preset_name in ("fast", "fine"):
        found = scene.load("paper", accuracy=preset_name)
        assert StructuredEngine(found).limits.iterations == PRESETS[preset_name].iterations


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
    found, _ = asked.resolve(
        cli.Optimize(accuracy="fast", engine="mujoco", overrides=(("solver.iterations=7",),))
    )
    assert found.discretization == scene.Discretization(0.01, 10, 1, spring_damping="least")
    assert found.solver.iterations == 7
    assert cli.main(["evaluate", "--accuracy", "fastest"]) == 2
    assert "'fastest' unknown; did you mean 'fast'" in capsys.readouterr().err


# --- settings ------------------------------------------------------------------------------------


def test_settings_change_what_they_say_and_no_two_have_the_same_name():
    every = one_at_a_time("structured")
    assert len({s.label for s in every}) == len(every)
    changed = Setting(timestep=2.0, links=5, axes=2, surface="spheres 2", damping="least").scene()
    assert changed.discretization == scene.Discretization(0.002, 5, 2, spring_damping="least")
    assert changed.effects.surface == "spheres"
    dense = Setting(surface="hull 4 x 16").scene()
    assert (dense.discretization.hull_rings, dense.discretization.hull_points) == (4, 16)
    assert changed.effects.lateral_bending and not changed.effects.twist


def test_a_long_step_needs_a_longer_contact_time_constant():
    """The scene refuses 20 ms as it is; with a longer constant the stiffness stays the same."""
    with pytest.raises(schema.InputError, match="time_constant"):
        Setting(timestep=20.0, keep_contact=True).scene()
    stiffness = []
    for setting in (STANDARD, Setting(timestep=20.0)):
        c = setting.scene().contact
        # k_n of model.contact_invweight's docstring, from what MuJoCo is given.
        k = c.impedance / (c.impedance * c.time_constant) ** 2
        w = 2 * model.contact_invweight(setting.scene())
        stiffness.append(k * c.impedance / ((1 - c.impedance) * w))
    assert stiffness[0] == pytest.approx(stiffness[1], rel=1e-12)
    assert stiffness[0] == pytest.approx(4000.0, rel=1e-12)


# --- oracles -------------------------------------------------------------------------------------


def test_closed_forms():
    """The elastica against Mattiasson's table (1981), the arc against the circle's coordinates."""
    table = {1.0: (0.301720770, 0.056433236), 10.0: (0.810609020, 0.554995600)}
    for load, expected in table.items():
        np.testing.assert_allclose(beam.elastica(load), expected, atol=5e-9)
    assert beam.arc(np.pi) == pytest.approx((2 / np.pi, 1.0))


def test_the_chain_s_error_falls_with_the_square_of_the_links():
    errors = [beam.errors(n, (1.0,), (90.0,)) for n in (5, 10)]
    for load in errors[0]:
        # Second order up to terms of the fourth: 1 / 4 N^2 at five links is 1 %.
        assert errors[0][load] / errors[1][load] == pytest.approx(4.0, rel=0.02)


@pytest.fixture(scope="module")
def grasp():
    """A pinch of two fingers in float64: scene, fields and controls of one world."""
    small = pinch("box", links=2)
    with worlds.floats(True) as dtype:
        space = parameters.design_space(small.hand)
        params = jax.tree.map(lambda x: np.asarray(x)[None], space.params(space.default()))
        trial = jax.tree.map(lambda x: np.asarray(x)[None], still())
        fields, ctrl = worlds.inputs(small, worlds.Worlds(params, trial), dtype)
    return small, fields, ctrl


def test_tips_lie_a_segment_behind_the_last_joint(grasp):
    """A straight finger's tip is its length away from its root."""
    small, fields, _ = grasp
    m = oracle.model_of(small, fields, 0)
    data = mujoco.MjData(m)
    data.qpos[:] = fields.start[0]
    mujoco.mj_kinematics(m, data)
    roots = data.xpos[model.layout(small).stubs]
    away = np.linalg.norm(oracle.tips(small, m, data) - roots, axis=1)
    space = parameters.design_space(small.hand)
    # The default lengths are float32 of the table's millimetres.
    np.testing.assert_allclose(away, space.params(space.default()).length, rtol=1e-6)


def test_grip_is_the_force_that_the_object_feels(grasp):
    """Of states along a pinch: MuJoCo C's own contact forces, and those of the structured step."""
    small, fields, ctrl = grasp
    exact = dataclasses.replace(small, solver=scene.Solver(300, 100, 1e-15))
    found = []

    def visit(m, d, k):
        force, expected = np.zeros(6), 0.0
        for i in range(d.ncon):
            names = [m.geom(g).name for g in d.contact[i].geom]
            mujoco.mj_contactForce(m, d, i, force)
            if "table" not in names and any(n.startswith("object") for n in names):
                expected += force[0]
        assert oracle.grip(exact, m, d) == pytest.approx(expected, abs=1e-12)
        found.append((d.qpos.copy(), d.qvel.copy(), d.ctrl.copy(), d.qacc.copy(), expected))

    m = oracle.model_of(exact, fields, 0)
    oracle.advance(m, fields.start[0], ctrl[0], range(10, 400, 30), visit)
    qpos, qvel, u, qacc, expected = (np.array(column) for column in zip(*found, strict=True))
    assert max(expected) > 0.1, "never touched"
    with worlds.floats(True):
        engine = StructuredEngine(small, iterations=100, evaluations=20, tolerance=1e-18)
        batch = jax.tree.map(lambda x: np.repeat(np.asarray(x), len(qpos), 0), fields)

        @jax.jit
        def run(batch, qpos, qvel, ctrl):
            hand = world_constants(small, batch)
            state = engine.place(engine.reset(batch), qpos, qvel)
            acc = engine.step(hand, state, ctrl)[1].acc
            grip = impulse.grip(small, hand, state._replace(acc=acc), ctrl)
            return acc.wrist[:, 0].T, acc.object[3:, 0].T, grip

        wrist, linear, grip = (np.asarray(v) for v in run(batch, qpos, qvel, u.T))
    # As in test_structured: both solvers stop at rounding of their own.
    for got, mine in ((wrist, qacc[:, :6]), (linear, qacc[:, -6:-3])):
        scale = np.maximum(np.linalg.norm(qacc, axis=1), 100.0)  # ten g: an object may be at rest
        assert (np.linalg.norm(got - mine, axis=1) / scale).max() < 1e-8
    # Accelerations agree to 1e-8 of 100 or more; a link of some grams makes 1e-8 N of that.
    np.testing.assert_allclose(grip, expected, rtol=1e-8, atol=1e-7)


def test_mujoco_converges_with_the_scene_s_own_limits():
    """A line search that ends early looks like convergence: 20 iterations were too few.

    Of 480 states in contact the largest error is 1.6e-4 with the scene's limits; with 20
    iterations of the line search a tenth of them errs by 0.04 and more.
    """
    base = Setting("mujoco", links=4, surface="spheres 1", precision="float64").scene()
    exact = dataclasses.replace(base, solver=scene.Solver(**peers.REFERENCE))
    with worlds.floats(True) as dtype:
        chosen = worlds.paired(worlds.designs(exact, 4), worlds.trials(exact, 6))
        fields, ctrl = worlds.inputs(exact, chosen, dtype)
    few = dataclasses.replace(base, solver=dataclasses.replace(base.solver, ls_iterations=20))
    errors = ([], [])
    ends = tuple(round(t / 0.01) for t in (exact.phases.approach, exact.phases.disturb))
    for w in range(4):
        models = [oracle.model_of(s, fields, w) for s in (base, few)]

        def visit(m, d, k, models=models):
            for other, found in zip(models, errors, strict=True):
                data = mujoco.MjData(other)
                data.qpos[:], data.qvel[:], data.ctrl[:] = d.qpos, d.qvel, d.ctrl
                mujoco.mj_forward(other, data)
                away = np.linalg.norm(data.qacc - d.qacc)
                found.append(away / max(np.linalg.norm(d.qacc), 100.0))

        oracle.advance(
            oracle.model_of(exact, fields, w), fields.start[w], ctrl[w], range(*ends, 30), visit
        )
    assert max(errors[0]) < 1e-3 and max(errors[1]) > 1e-2


@pytest.mark.slow  # quick: a tiny study of them (test_accuracy_report)
def test_tips_of_a_shorter_step_come_closer_to_the_reference():
    """The error of the implicit Euler step falls at first order."""
    reference = tip.motion(Setting("mujoco", timestep=0.5, links=2, iterations=0), 1, 0.4)
    errors = []
    for step in (5.0, 10.0):
        found = tip.motion(Setting("mujoco", timestep=step, links=2), 1, 0.4)
        errors.append(tip.compare(found, reference)["tip_rms_mm"])
    # The reference's own step is a tenth of the smaller one: the ratio is 9.5 / 4.5 at first order.
    assert errors[1] / errors[0] == pytest.approx(9.5 / 4.5, rel=0.2)


def test_populations_are_distinct_final_particles_of_every_quality():
    data = ROOT / "docs" / "data" / "experiments"
    found = decision.populations(data, 60)
    with np.load(data / "23d.npz") as file:
        final, cost = file["final_particles"], file["test_exclude"].ravel()
    every = final.reshape(-1, 23)
    index = [int(np.flatnonzero((every == p).all(1))[0]) for p in found["spread"]]
    assert cost[index].max() > 2.0 and cost[index].min() < 0.05
    assert len(np.unique(found["late"], axis=0)) == 60
    runs = [[(run == p).all(1).any() for run in final[-1]] for p in found["late"]]
    assert np.all(np.sum(runs, 0) >= 2)  # two of each run
    with pytest.raises(ValueError, match="distinct"):
        decision.populations(data, 10_000)


def test_costs_come_back_from_their_text():
    the_scene = Setting().scene()
    start, end = the_scene.window
    lost = np.array([[np.inf, start, end - 1e-3], [0.5 * (start + end), np.inf, np.inf]])
    bad = np.array([[False, False, False], [False, True, False]])
    record = {"lost": decision.encode(lost, bad, the_scene.window), "particles": 2, "trials": 3}
    expected = [[0.0, 3.0, 0.0], [1.5, np.nan, 0.0]]
    # A byte counts 250th parts of the time in which a loss costs: half of one, times 3.
    np.testing.assert_allclose(decision.costs(the_scene, record), expected, atol=0.0061)


# --- the file ------------------------------------------------------------------------------------


def test_a_study_goes_on_where_it_stopped_and_keeps_failures(tmp_path):
    path, calls = tmp_path / "a.json", []

    def case(label, run):
        return Case("tip", Setting(extra=(label,)), (), run)

    good = case("cost.maximum=1", lambda: calls.append(1) or {"value": 2})
    broken = case("cost.maximum=2", lambda: 1 / 0)
    store = Store(path, size="tiny")
    store.measure(good)
    assert "ZeroDivisionError" in store.measure(broken)["failed"]
    again = Store(path, size="tiny")
    assert again.done(good) and again.done(broken) and calls == [1]
    with pytest.raises(ValueError, match="tiny"):
        Store(path, size="full")


def test_a_case_that_kills_its_process_counts_as_failed_after_two_attempts(tmp_path):
    class Killed(BaseException):
        pass

    def die():
        raise Killed

    path, case = tmp_path / "a.json", Case("tip", Setting(), (), die)
    for _ in range(2):
        store = Store(path, size="tiny")
        assert not store.done(case)
        with pytest.raises(Killed):
            store.measure(case)
    store = Store(path, size="tiny")
    assert store.done(case)
    assert "two runs" in json.loads(path.read_text())["records"][case.key]["failed"]


def test_cases_have_names_of_their_own():
    data = ROOT / "docs" / "data" / "experiments"
    for size in study.SIZES.values():
        every = study.cases(size, study.PARTS, ENGINES, data, gpu=True)
        assert len({c.key for c in every}) == len(every)
        assert {c.part for c in every} == {*study.PARTS, "beam"}


def test_files_of_several_processes_become_one(tmp_path):
    for number in range(2):
        store = Store(tmp_path / f"{number}.json", size="tiny", commit=f"c{number}")
        label = f"cost.maximum={number}"
        store.measure(Case("tip", Setting(extra=(label,)), (), lambda n=number: {"value": n}))
    Store(tmp_path / "2.json", size="full").write()
    merge([tmp_path / "0.json", tmp_path / "1.json"], tmp_path / "all.json")
    found = json.loads((tmp_path / "all.json").read_text())
    made = {r["value"]: found["runs"][r["run"]]["commit"] for r in found["records"].values()}
    assert made == {0: "c0", 1: "c1"}
    with pytest.raises(ValueError, match="full, tiny"):
        merge([tmp_path / "0.json", tmp_path / "2.json"], tmp_path / "all.json")


def test_names_of_timed_engines():
    assert name(Setting("mujoco")) == "mujoco"
    assert name(Setting(precision="float64")) == "structured float64"
