"""Fixtures: boxes, cylinders and planes that fingers, palm and object touch, against MuJoCo C."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import preflight, scene
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.runs import scene_files
from codesign_jax.scene import library, schema
from tests.helpers import grasps, oracles
from tests.helpers.grasps import DATA

WALL = """
[[fixture]]
name = "wall"
type = "box"
position = [0.06, 0.0, 0.05]
size = [0.01, 0.1, 0.05]
orientation = [0, 10, 0]
"""
POST = """
[[fixture]]
name = "post"
type = "cylinder"
position = [-0.055, 0.02, 0.04]
size = [0.015, 0.04]
"""
SLOPES = """
[[fixture]]
name = "slope"
type = "plane"
position = [0.0, 0.045, 0.0]
orientation = [70, 0, 0]

[[fixture]]
name = "other slope"
type = "plane"
position = [0.05, 0.0, 0.0]
orientation = [0, -70, 0]
"""
SHELF = """
[[fixture]]
name = "shelf"
type = "box"
position = [-0.1, 0.0, -0.02]
size = [0.11, 0.1, 0.02]
"""
CASES = {"sphere": WALL + POST + SLOPES, "box": SLOPES, "cylinder": SLOPES, "capsule": SLOPES}
QUICK = ("sphere", "box")


def loaded(tmp_path, fixtures, shape, **overrides):
    text = library.available("scenes")["paper_spheres"].read_text() + fixtures
    (tmp_path / "fixtures.toml").write_text(text)
    objects = DATA / f"{shape}.toml"
    where = {"hand_name": DATA / "pinch.toml", "object_set": objects}
    return scene.load(tmp_path / "fixtures.toml", **where, overrides=overrides)


def a_grasp(the_scene):
    """Fields and controls of a world whose object is pushed about by fingers and fixtures."""
    params, trial = grasps.hand_world(the_scene)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, 0.01]))
    fields, ctrl = grasps.world_inputs(the_scene, params, trial)
    return jax.tree.map(lambda x: jnp.asarray(x)[None], fields), np.asarray(ctrl)[None, :420]


@pytest.mark.parametrize(
    "shape", [s if s in QUICK else pytest.param(s, marks=pytest.mark.slow) for s in CASES]
)
def test_steps_equal_mujocos(tmp_path, shape):
    """Accelerations along a grasp; boxes on boxes have other points in MuJoCo, planes the same."""
    with jax.enable_x64(True):
        the_scene = loaded(tmp_path, CASES[shape], shape)
        fields, ctrl = a_grasp(the_scene)
        engine = StructuredEngine(the_scene, iterations=100, evaluations=40, tolerance=1e-24)
        found = oracles.path(engine, fields, ctrl)
        errors, far, touching = oracles.against_mujoco(the_scene, fields, ctrl, found)
        assert errors.max() < 1e-8 and far.max() < 1e-12  # as in test_effects
        plain = loaded(tmp_path, "", shape)
        _, _, fewer = oracles.against_mujoco(plain, a_grasp(plain)[0], ctrl, found)
        assert (touching > fewer).mean() > 0.3  # fixtures are touched in many steps
        moved = CASES[shape].replace("0.0, 0.045, 0.0", "0.0, 0.044, 0.0")
        other = loaded(tmp_path, moved, shape)
        errors, *_ = oracles.against_mujoco(other, a_grasp(other)[0], ctrl, found)
        assert errors.max() > 1e-3  # the same of a slope a millimetre aside


@pytest.mark.slow  # a minute to compile; quick: whole grasps of MuJoCo C above
def test_mjx_steps_equal_mujocos(tmp_path):
    """On planes; its spheres on boxes and cylinders differ from MuJoCo C's by a percent."""
    with jax.enable_x64(True):
        the_scene = loaded(tmp_path, SLOPES, "sphere")
        solver = dataclasses.replace(
            the_scene.solver, tolerance=1e-14, iterations=100, ls_iterations=50
        )
        the_scene = dataclasses.replace(the_scene, solver=solver)
        fields, ctrl = a_grasp(the_scene)
        one = jax.tree.map(lambda v: v[0], fields)
        engine, oracle = make_engine("mjx", the_scene), world_model(the_scene, one)
        oracle.opt.tolerance, oracle.opt.iterations, oracle.opt.ls_iterations = 0.0, 200, 50
        step = jax.jit(engine.step, compiler_options={"xla_backend_optimization_level": 0})
        data, ours = mujoco.MjData(oracle), engine.reset(one)
        data.qpos[:] = one.start
        for k in range(350):
            data.ctrl[:] = ctrl[0, k]
            if k % 70 == 20:
                ours = ours.replace(qpos=data.qpos.copy(), qvel=data.qvel.copy())
                found = step(one, ours, ctrl[0, k])
                mujoco.mj_forward(oracle, data)
                scale = max(np.linalg.norm(data.qacc), 100.0)
                assert np.linalg.norm(found.qacc - data.qacc) / scale < 1e-7, (
                    k
                )  # as in test_effects
            mujoco.mj_step(oracle, data)
        assert data.ncon > 1


HULL = {"effects.surface": "hull", "effects.finger_itself": False}


@pytest.mark.parametrize("shape", ["box", pytest.param("cylinder", marks=pytest.mark.slow)])
def test_the_kernel_balances_rings_and_edges(tmp_path, shape):
    """Against forces of contacts that plain JAX finds: MuJoCo has neither."""
    with jax.enable_x64(True):
        the_scene = loaded(tmp_path, WALL + POST + SHELF, shape, **HULL | {"effects.table": False})
        fields, ctrl = a_grasp(the_scene)
        engine = StructuredEngine(the_scene, iterations=100, evaluations=40, tolerance=1e-24)
        found = oracles.path(engine, fields, ctrl)
        later = oracles.Path(*(v[:, 1:] for v in found))
        assert oracles.unbalanced(the_scene, fields, ctrl[:, 1:], later, 10).max() < 1e-8


@pytest.mark.parametrize(("overhang", "stays"), [(-0.01, True), (0.02, True), (0.035, False)])
def test_an_object_rests_on_a_shelf_or_tips_over_its_edge(tmp_path, overhang, stays):
    """A box of 60 mm with its face `overhang` beyond the edge, as in MuJoCo C after a second."""
    shelf = SHELF.replace("-0.1, 0.0", f"{-0.08 - overhang:g}, 0.0")  # ends at x = 30 mm - overhang
    the_scene = loaded(tmp_path, shelf, "box", **{"effects.table": False})
    fields, ctrl = a_grasp(the_scene)
    flat = jnp.array([0.0, 0.0, 0.03, 1.0, 0.0, 0.0, 0.0], fields.start.dtype)
    fields = fields._replace(start=fields.start.at[:, -7:].set(flat))
    held = jnp.asarray(np.repeat(ctrl[:, :1], 100, 1))
    for name in ("structured", "mujoco"):
        run = partial(make_engine(name, the_scene).rollout, trajectory=True)
        height = float(jax.jit(run)(fields, held).height[0, -1])
        assert abs(height - 0.03) < 1e-3 if stays else height < -0.1, (name, height)  # no failure


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("size = [0.01, 0.1, 0.05]", "size = [0.01, 0.1]"), "a box has 3 values"),
        (("size = [0.01, 0.1, 0.05]", ""), "a box has 3 values"),
        (('type = "box"', 'type = "plane"'), "a plane has no size"),
        (("position = [0.06, 0.0, 0.05]", "position = [0.06, 0.0]"), "three coordinates"),
        (("[0, 10, 0]", "[0, 10]"), "orientation must be roll, pitch and yaw"),
        (('type = "box"', 'type = "mesh"'), "'mesh' is not valid"),
    ],
)
def test_wrong_fixtures_are_told(tmp_path, change, expected):
    with pytest.raises(schema.InputError, match=expected):
        loaded(tmp_path, WALL.replace(*change), "box")


def test_a_hand_that_starts_in_a_fixture_is_refused(tmp_path):
    high = WALL.replace("0.06, 0.0, 0.05", "0.06, 0.0, 0.2")
    the_scene = loaded(tmp_path, high, "box")
    params, _ = grasps.hand_world(the_scene)
    designs = jax.tree.map(lambda v: np.asarray(v)[None], params)
    [refusal] = preflight.refusals(the_scene, designs, ["it"])
    assert "inside the table, a fixture or object 'box'" in refusal


def test_what_mjx_does_not_collide_is_refused(tmp_path):
    with pytest.raises(
        schema.InputError, match="engine mjx: object 'box', a box, with fixture 'post'"
    ):
        make_engine("mjx", loaded(tmp_path, POST, "box"))


def test_a_scene_with_fixtures_is_kept(tmp_path):
    the_scene = loaded(tmp_path, WALL + POST + SLOPES, "box")
    scene_files.write_scene(the_scene, tmp_path / "run")  # reads it back and compares
    assert the_scene.structure != loaded(tmp_path, WALL + POST, "box").structure
