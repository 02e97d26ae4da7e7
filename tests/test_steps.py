"""Single steps of the engines against MuJoCo C at the same states: one table of scenes."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import control, model, preflight
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import scene_files
from tests.helpers import grasps, oracles
from tests.helpers.fixtures import POST, SHELF, SLOPES, WALL, loaded
from tests.helpers.refusals import refusal

SLOWLY = pytest.mark.slow
# Faults of fixtures, which the comparison must notice: what is sound, and what is wrong.
FAULTS = {
    "a slope a millimetre aside": ("0.0, 0.045, 0.0", "0.0, 0.044, 0.0"),
    "a normal turned by half a degree": ("orientation = [70,", "orientation = [70.5,"),
    "a slope as slippery as the table": ("friction = 1.1\n", ""),
}
FEW = 5
"""Of so many steps one is enough to notice them."""
# Object, effects and other values by key, and fixtures.
SCENES = {
    "new models": (
        "box",
        {
            "effects.wrist": False,
            "effects.neo_hookean": True,
            # With an inertia of its own, and it falls from an edge.
            "objects.object.0.orientation": [20.0, 0.0, 0.0],
            "objects.object.0.inertia": [5e-5, 8e-5, 1.1e-4],
        },
        "",
    ),
    "sections by elements": (
        "sphere",
        # The thread on the chamber: with one outside these pressures throw the object away.
        {
            "hand.section.law": "elements",
            "hand.section.thread_depth": 1.0,
            "hand.section.winding": "single",
            "effects.neo_hookean": True,
        },
        "",
    ),
    "fixtures": ("sphere", {}, WALL + POST + SLOPES),
}
SLOW = {  # the same parts by themselves, and few of them
    "little": (
        "box",
        {f"effects.{name}": False for name in ("twist", "palm_table", "gravity")}
        | {"effects.friction": "none"},
        "",
    ),
    **{shape: (shape, {}, "") for shape in grasps.SHAPES},
    "no contact": (
        "box",
        {
            f"effects.{pair}": False
            for pair in (
                *("finger_object", "finger_table", "palm_object", "palm_table"),
                "object_table",
            )
        },
        "",
    ),
    "box on slopes": ("box", {}, SLOPES),
    "cylinder on slopes": ("cylinder", {}, SLOPES),
    "capsule on slopes": ("capsule", {}, SLOPES),
}


@jax.jit
def inputs(the_scene, params, trial):
    """Fields and controls, by one program for scenes that differ in numbers."""
    return model.model_fields(the_scene, params, trial), control.commands(the_scene, params, trial)


def a_grasp(the_scene):
    """Fields and controls of a world, with the phases in which everything touches."""
    params, trial = grasps.hand_world(the_scene)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, 0.01]))
    fields, ctrl = inputs(the_scene, params, trial)
    return jax.tree.map(lambda x: jnp.asarray(x)[None], fields), np.asarray(ctrl)[None, :420]


def path_of(the_scene):
    """Fields and controls of a grasp, and the path that the kernel makes of it."""
    fields, ctrl = a_grasp(the_scene)
    engine = StructuredEngine(the_scene, iterations=100, evaluations=40, tolerance=1e-24)
    return fields, ctrl, oracles.path(engine, fields, ctrl)


@pytest.mark.parametrize("name", [*SCENES, *(pytest.param(n, marks=SLOWLY) for n in SLOW)])
def test_steps_of_the_kernel_equal_mujocos(tmp_path, name):
    """Accelerations of every step of the kernel's own path, contacts included.

    Boxes on boxes have other points in MuJoCo, boxes on planes the same.
    """
    shape, effects, fixtures = (SCENES | SLOW)[name]
    with jax.enable_x64(True):
        scene = loaded(tmp_path, fixtures, shape, **effects)
        fields, ctrl, trajectory = path_of(scene)
        errors, far, touching = oracles.against_mujoco(scene, fields, ctrl, trajectory)
        # A difference of velocities over 10 ms loses two of 16 digits, and MuJoCo's own Newton
        # stops at rounding of its cost.  Its rigid arm gives way by the hand's forces over 1e9 kg,
        # which stiff fingers multiply: 1.6e-8 with a wrist of 1e9, 2e-10 of 1e11.
        assert errors.max() < (1e-8 if scene.effects.wrist else 1e-7) and far.max() < 1e-12
        # Of `new models` 0.99 of the states are, of `fixtures` all; what is left out is less than
        # any phase has: 200, 150 and 70 of these 420.
        assert oracles.share(errors) > 0.85
        if not fixtures:
            if scene.effects.finger_object and scene.effects.object_table:
                # More than the object on the table.
                assert touching.max() > (1 if shape == "sphere" else 4)
            return
        plain = loaded(tmp_path, "", shape)
        _, _, fewer = oracles.against_mujoco(plain, a_grasp(plain)[0], ctrl, trajectory, FEW)
        assert (touching[:, ::FEW] > fewer).mean() > 0.3  # fixtures are touched in many steps
        for fault, (sound, wrong) in FAULTS.items():
            other = loaded(tmp_path, fixtures.replace(sound, wrong), shape)
            errors, *_ = oracles.against_mujoco(other, a_grasp(other)[0], ctrl, trajectory, FEW)
            assert errors.max() > 1e-3, fault


@SLOWLY  # a minute each to compile; quick: whole grasps by stock MJX (test_engines)
@pytest.mark.parametrize(
    ("effects", "fixtures"),
    [
        ({}, ""),
        ({"effects.neo_hookean": True}, ""),
        ({}, SLOPES),  # on boxes and cylinders spheres differ from MuJoCo C's by a percent
    ],
)
def test_steps_of_mjx_equal_mujocos(tmp_path, effects, fixtures):
    """Stock MJX with the models that it has, on a sphere (its other contacts differ a little)."""
    with jax.enable_x64(True):
        scene = loaded(tmp_path, fixtures, "sphere", **effects)
        solver = dataclasses.replace(
            scene.solver, tolerance=1e-14, iterations=100, ls_iterations=50
        )
        scene = dataclasses.replace(scene, solver=solver)
        fields, ctrl = a_grasp(scene)
        fields = jax.tree.map(lambda v: v[0], fields)
        engine = make_engine("mjx", scene)
        oracle = oracles.exact(scene, fields)
        arrays = model.mujoco_fields(scene.structure, fields)
        step = jax.jit(engine.step, compiler_options={"xla_backend_optimization_level": 0})
        data = mujoco.MjData(oracle)
        ours = engine.reset(fields)
        most = 0
        data.qpos[:] = fields.start
        for k in range(420):
            data.ctrl[:] = ctrl[0, k]
            oracles.soften(scene, fields, oracle, data)
            if k % 70 == 20:
                ours = ours.replace(qpos=data.qpos.copy(), qvel=data.qvel.copy())
                state = step(arrays, fields, ours, ctrl[0, k])
                mujoco.mj_forward(oracle, data)
                scale = max(np.linalg.norm(data.qacc), oracles.FLOOR)
                # MJX keeps its warm start where it is good enough: 4e-9 at rest.
                assert np.linalg.norm(state.qacc - data.qacc) / scale < 1e-7, k
            mujoco.mj_step(oracle, data)
            most = max(most, data.ncon)
        assert most > 1 or not fixtures


@SLOWLY  # quick: momentum of a box in rings (test_forces), and fixtures that spheres touch
@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_the_kernel_balances_rings_and_edges(tmp_path, shape):
    """Against forces of contacts that plain JAX finds: MuJoCo has neither."""
    alone = {"effects.surface": "hull", "effects.finger_itself": False, "effects.table": False}
    with jax.enable_x64(True):
        scene = loaded(tmp_path, WALL + POST + SHELF, shape, **alone)
        fields, ctrl, trajectory = path_of(scene)
        later = oracles.Path(*(v[:, 1:] for v in trajectory))
        assert oracles.unbalanced(scene, fields, ctrl[:, 1:], later, 10).max() < 1e-8


# --- fixtures: boxes, cylinders and planes that fingers, palm and object touch, against MuJoCo C --


@pytest.mark.slow  # 9 s
def test_an_object_rests_on_a_shelf_or_tips_over_its_edge(tmp_path):
    """Boxes of 60 mm with faces 20 and 35 mm beyond the edge, as in MuJoCo C after a second."""
    pairs = ("table", "finger_object", "finger_table", "palm_object", "palm_table", "twist")
    the_scene = loaded(tmp_path, SHELF, "box", **{f"effects.{name}": False for name in pairs})
    worlds = [grasps.repeat(v, 2) for v in grasps.hand_world(the_scene)]
    fields, ctrl = grasps.batch_inputs(the_scene, *worlds)
    start = np.array(fields.start)
    start[:, -7:] = [0.0, 0.0, 0.03, 1.0, 0.0, 0.0, 0.0]
    start[:, -7] = [0.0, 0.015]
    fields = fields._replace(start=start)
    controls = np.repeat(np.asarray(ctrl[:, :1]), 100, 1)
    engines = make_engine("structured", the_scene).recording(), make_engine("mujoco", the_scene)
    for engine in engines:
        trace = jax.jit(partial(engine.rollout, trajectory=True))(fields, controls)
        stays, falls = np.asarray(trace.height[:, -1])
        assert abs(stays - 0.03) < 1e-3 and falls < -0.1
        if trace.forces is not None:
            weight = 9.81 * float(fields.object_mass[0])
            push = np.asarray(trace.forces.table[:, -2, 2])
            np.testing.assert_allclose(push, [weight, 0.0], rtol=1e-3, atol=1e-3 * weight)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (("size = [0.01, 0.1, 0.05]", "size = [0.01, 0.1]"), "size"),
        (("size = [0.01, 0.1, 0.05]", ""), "size"),
        (('type = "box"', 'type = "plane"'), "size"),
        (("position = [0.06, 0.0, 0.05]", "position = [0.06, 0.0]"), "size"),
        (("[0, 10, 0]", "[0, 10]"), "size"),
        (('type = "box"', 'type = "mesh"'), "unknown"),
    ],
)
def test_wrong_fixtures_are_told(tmp_path, change, code):
    [(told, _)] = refusal(loaded, tmp_path, WALL.replace(*change), "box")
    assert told == code


def test_a_hand_that_starts_in_a_fixture_is_refused(tmp_path):
    high = WALL.replace("0.06, 0.0, 0.05", "0.06, 0.0, 0.2")
    the_scene = loaded(tmp_path, high, "box")
    params, _ = grasps.hand_world(the_scene)
    designs = jax.tree.map(lambda v: np.asarray(v)[None], params)
    [refusal] = preflight.refusals(the_scene, designs, ["it"])
    assert "inside the table, a fixture or object 'box'" in refusal


def test_what_mjx_does_not_collide_is_refused(tmp_path):
    problems = refusal(make_engine, "mjx", loaded(tmp_path, POST, "box"))
    assert problems == [("unsupported", "object 'box'")]


def test_a_scene_with_fixtures_is_kept(tmp_path):
    the_scene = loaded(tmp_path, WALL + POST + SLOPES, "box")
    scene_files.write_scene(the_scene, tmp_path / "run")  # reads it back and compares
    assert the_scene.structure != loaded(tmp_path, WALL + POST, "box").structure
