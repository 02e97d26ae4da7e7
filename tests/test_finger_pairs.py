"""Contacts between fingers: the structured engine against MuJoCo C, pairs of spheres and all."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import model
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import StructuredEngine, finger_pairs, solver
from codesign_jax.engines.structured.hand import hand_lanes
from codesign_jax.engines.structured.lanes import Stages
from codesign_jax.schema import SceneError
from tests import small
from tests.test_structured import lanes_state

SETTINGS = {"effects__finger_finger": True, "discretization__spheres_per_link": 2}


def curled(scene, seed, bend, height):
    """Model, data and lanes of a hand with random joint angles about a bend, object between."""
    hand, trial = small.hand_world(scene, length=0.1)
    fields = model.model_fields(scene, jax.tree.map(jnp.asarray, hand), trial)
    oracle = model.compile_model(scene, hand, trial)
    oracle.opt.tolerance, oracle.opt.iterations, oracle.opt.ls_iterations = 0.0, 200, 50
    data, random = mujoco.MjData(oracle), np.random.default_rng(seed)
    lay, qpos = model.layout(scene), np.array(fields.start)
    qpos[2] = height
    angles = 0.1 * random.normal(size=lay.dofs.shape)
    angles[..., 0] += bend
    qpos[6 : 6 + lay.dofs.size] = angles.ravel()
    data.qpos[:], data.qvel[:] = qpos, 0.3 * random.normal(size=oracle.nv)
    data.ctrl[:6] = qpos[:6]
    data.ctrl[6:] = 60e3
    return oracle, data, jax.tree.map(lambda x: x[None], fields)


def kinds(oracle, data):
    """Numbers of contacts between two fingers and of a finger with the object."""
    names = [
        [mujoco.mj_id2name(oracle, mujoco.mjtObj.mjOBJ_GEOM, int(g)) for g in pair]
        for pair in data.contact.geom
    ]
    fingers = [sum(n.startswith("finger") for n in pair) for pair in names]
    held = sum("finger" in a + b and "object" in a + b for a, b in names)
    return fingers.count(2), held


@pytest.fixture(scope="module")
def driven():
    """Scene and one compiled step to convergence, for every state of this module."""
    with jax.enable_x64(True):
        scene = small.pinch("sphere", **SETTINGS)
        engine = StructuredEngine(scene, iterations=200, evaluations=20, tolerance=1e-26)
        return scene, engine, jax.jit(engine.step)


@pytest.mark.parametrize("seed", range(6))
def test_accelerations_equal_mujoco_on_curled_hands(driven, seed):
    """Fingers touch one another and the object, sliding at up to a metre a second."""
    scene, engine, step = driven
    with jax.enable_x64(True):
        oracle, data, fields = curled(scene, seed, bend=0.75 + 0.05 * seed, height=0.07)
        mujoco.mj_forward(oracle, data)
        state = lanes_state(engine, scene, fields, data.qpos, data.qvel)
        new, info = step(hand_lanes(scene, fields), state, jnp.asarray(data.ctrl)[:, None])
        acc = (np.asarray(engine.qvel(new))[0] - data.qvel) / scene.discretization.timestep
        error = np.linalg.norm(acc - data.qacc) / np.linalg.norm(data.qacc)
        print(seed, kinds(oracle, data), error, float(info.residual.max()), int(info.iterations))
        between, held = kinds(oracle, data)
        assert between > 0
        # As without these contacts: a difference of velocities, and MuJoCo's own rounding.
        assert error < 1e-8, (between, held, error)
