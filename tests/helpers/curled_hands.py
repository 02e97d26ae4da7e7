"""Hands whose fingers touch one another, and one step of many by the kernel."""

import jax
import mujoco
import numpy as np

from codesign_jax import model
from tests.helpers import grasps


def state(the_scene, seed, bend, height, length=0.1):
    """Fields, qpos, qvel and ctrl of a hand with random joint angles about a bend; all moves."""
    fields, _ = grasps.world_inputs(the_scene, *grasps.hand_world(the_scene, length=length))
    random = np.random.default_rng(seed)
    lay = model.layout(the_scene)
    qpos = np.array(fields.start)
    angles = 0.1 * random.normal(size=lay.dofs.shape)
    angles[..., 0] += bend
    qpos[2] = height
    qpos[lay.dofs] = angles
    qvel = 0.3 * random.normal(size=len(qpos) - 1)
    return fields, qpos, qvel, np.append(qpos[:6], [60e3] * the_scene.num_fingers)


def curled(the_scene, seed, bend, height, length=0.1):
    """Model, data and lanes of a `state`, with the object between the fingers."""
    oracle = model.compile_model(the_scene, *grasps.hand_world(the_scene, length=length))
    oracle.opt.tolerance = 0.0
    oracle.opt.iterations = 200
    oracle.opt.ls_iterations = 50
    data = mujoco.MjData(oracle)
    world = state(the_scene, seed, bend, height, length)
    fields, data.qpos[:], data.qvel[:], data.ctrl[:] = world
    return oracle, data, jax.tree.map(lambda x: x[None], fields)


def kinds(oracle, data):
    """Numbers of contacts between two fingers and of a finger with the object."""
    names = [
        [mujoco.mj_id2name(oracle, mujoco.mjtObj.mjOBJ_GEOM, int(g)) for g in pair]
        for pair in data.contact.geom
    ]
    fingers = [sum(n.startswith("finger") for n in pair) for pair in names]
    on_object = sum("finger" in a + b and "object" in a + b for a, b in names)
    return fingers.count(2), on_object


def on_palm(oracle, data):
    """Number of contacts with the palm's disc."""
    return int((data.contact.geom == oracle.geom("palm_disc").id).any(1).sum())


def batched(worlds):
    """Fields, qpos, qvel and ctrl of several (model, data, fields)."""
    fields = jax.tree.map(lambda *x: np.concatenate(x), *(f for _, _, f in worlds))
    data = [d for _, d, _ in worlds]
    return fields, *(np.stack([getattr(d, n) for d in data]) for n in ("qpos", "qvel", "ctrl"))
