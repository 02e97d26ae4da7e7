"""Each effect of a scene: the same physics in every engine, its own physics, and its cost when off."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import control, model
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.hand import hand_lanes
from tests import small
from tests.test_structured import lanes_state

# Compiling takes longer than all that is done with a program here.
QUICK = {"xla_backend_optimization_level": 0}
CONTACTS = ("finger_object", "finger_table", "palm_object", "palm_table", "object_table")
slow = pytest.mark.slow
# Away from the paper's scene: some together, for speed, then one at a time.
SETTINGS = {
    "new models": {"friction": "full", "wrist": False, "neo_hookean": True},
    "little": {"friction": "none", "twist": False, "palm_table": False, "gravity": False},
    "no contact": dict.fromkeys(CONTACTS, False),
    "frictionless": {"friction": "none"},
    "full friction": {"friction": "full"},
    "rigid arm": {"wrist": False},
    "neo-Hookean": {"neo_hookean": True},
    "weightless": {"gravity": False},
    "fingers do not touch": {"finger_object": False, "finger_table": False},
    "fingers do not touch the table": {"finger_table": False},
    "palm does not touch the object": {"palm_object": False, "twist": False},
    "palm does not touch the table": {"palm_table": False, "lateral_bending": False},
    "no table": {"finger_table": False, "palm_table": False, "object_table": False},
}
TOGETHER = ("new models", "little", "no contact")


def setting(effects, shape="box", **changes):
    """Scene, MuJoCo C's model, fields and controls of a pinch grasp, in float64."""
    scene = small.pinch(shape, **{f"effects__{k}": v for k, v in effects.items()})
    world, trial = small.hand_world(scene, **changes)
    world = jax.tree.map(jnp.asarray, world)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, -0.002]))
    fields = model.model_fields(scene, world, trial)
    ctrl = np.asarray(control.commands(scene, world, trial))
    oracle = world_model(scene, fields)
    oracle.opt.tolerance, oracle.opt.iterations, oracle.opt.ls_iterations = 0.0, 200, 50
    return scene, oracle, fields, ctrl


def apply_softening(scene, fields, data):
    """What the engine `mujoco` applies before a step."""
    if scene.effects.neo_hookean:
        bend = model.layout(scene).dofs[..., 0]
        data.qfrc_applied[bend] = model.softening_moments(scene, fields, data.qpos[bend])


@pytest.mark.parametrize(
    "name", [n if n in TOGETHER else pytest.param(n, marks=slow) for n in SETTINGS]
)
def test_steps_equal_mujocos(name):
    """Accelerations on states along a grasp, from MuJoCo C's own path, contacts included."""
    with jax.enable_x64(True):
        scene, oracle, fields, ctrl = setting(SETTINGS[name])
        engine = StructuredEngine(scene, iterations=100, evaluations=16, tolerance=1e-24)
        hand = hand_lanes(scene, jax.tree.map(lambda x: jnp.asarray(x)[None], fields))
        step, data, most = jax.jit(engine.step, compiler_options=QUICK), mujoco.MjData(oracle), 0
        data.qpos[:] = fields.start
        for k in range(420):
            data.ctrl[:] = ctrl[k]
            apply_softening(scene, fields, data)
            if k % 35 == 20:
                qpos, qvel = data.qpos.copy(), data.qvel.copy()
                mujoco.mj_forward(oracle, data)
                batch = jax.tree.map(lambda x: jnp.asarray(x)[None], fields)
                state = lanes_state(engine, scene, batch, qpos, qvel)
                new, _ = step(hand, state, jnp.asarray(ctrl[k])[:, None])
                acc = (np.asarray(engine.qvel(new))[0] - qvel) / scene.discretization.timestep
                scale = max(np.linalg.norm(data.qacc), 100.0)
                error = np.linalg.norm(acc - data.qacc) / scale
                print(k, data.ncon, error, np.linalg.norm(data.qacc))
                # As in test_structured.
                assert error < 1e-8, (k, data.ncon, error)
                most = max(most, data.ncon)
            mujoco.mj_step(oracle, data)
    print(name, most)
