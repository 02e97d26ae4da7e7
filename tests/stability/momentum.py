"""Hard case 9: momentum of a free hand and an object that collide.  No scene has a free hand."""

import dataclasses
import functools

import mujoco
import numpy as np

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from codesign_jax.scene import hand
from tests.helpers import grasps
from tests.stability.bench import bench, pinch
from tests.stability.table import BOTH, Found, case
from tests.stability.touch import SPHERE, holding_controls, worlds

MOMENTUM = {"float32": 1e-4, "float64": 1e-10}
"""Bounds on what is lost of the sphere's momentum: rounding alone."""

TIGHT = {"float32": 1e-12, "float64": 1e-24}
"""Newton decrement: an unbalanced force would change the momentum."""

FREE = "free hand and object collide"


@functools.cache
def floating():
    """The pinch hand without wrist springs or dampers, and no gravity."""
    base = pinch(effects__finger_table=False, solver__tolerance=1e-16, solver__iterations=100)
    free = dataclasses.replace(base.hand, wrist=hand.Wrist(0.0, 0.0, 0.0, 0.0))
    return dataclasses.replace(base, hand=free, gravity=0.0)


@functools.cache
def collision(engine, step, precision):
    """A sphere of 0.5 m/s hits a finger of a hand at rest: model, history of 0.6 s, momentum."""
    b = bench(floating(), engine, step, precision, TIGHT[precision])
    fields = worlds(b, SPHERE)
    compiled = world_model(b.scene, grasps.nth(fields, 0))
    data = mujoco.MjData(compiled)
    qpos = fields.start.copy()
    qpos[0, 2] = 1.0
    data.qpos[:] = qpos[0]
    mujoco.mj_kinematics(compiled, data)
    qpos[0, -7:-4] = data.xpos[model.layout(b.scene).bodies[0, 1]] + [0, 0.07, 0]
    qvel = np.zeros((1, compiled.nv))
    qvel[0, -5] = -0.5
    history = b.run(fields, 0 * holding_controls(b, fields, 0.6), qpos, qvel)
    assert np.abs(history.object_velocity[0, -1, 1] + 0.5) > 0.01, "the sphere met nothing"
    return compiled, history, np.array([0.0, -0.5 * compiled.body_mass[-1], 0.0])


@case(9, FREE, "drift of linear momentum, relative", engines=BOTH)
def momentum(engine, step, precision):
    """Momentum of the state after each step."""
    compiled, history, first = collision(engine, step, precision)
    data = mujoco.MjData(compiled)
    worst = 0.0
    for qpos, qvel in zip(history.qpos[0], history.qvel[0], strict=True):
        data.qpos[:] = qpos
        data.qvel[:] = qvel
        mujoco.mj_fwdPosition(compiled, data)
        mujoco.mj_fwdVelocity(compiled, data)
        mujoco.mj_subtreeVel(compiled, data)
        total = data.subtree_linvel[0] * compiled.body_subtreemass[0]
        worst = max(worst, np.abs(total - first).max())
    return Found(worst / np.linalg.norm(first), MOMENTUM[precision])


def force_and_moment(compiled, data):
    """Sum of mass times acceleration of all bodies, and its moment about the origin."""
    acc = np.zeros(6)
    vel = np.zeros(6)
    force = np.zeros(3)
    moment = np.zeros(3)
    kind = mujoco.mjtObj.mjOBJ_BODY
    for body in range(1, compiled.nbody):
        mujoco.mj_objectAcceleration(compiled, data, kind, body, acc, 0)
        mujoco.mj_objectVelocity(compiled, data, kind, body, vel, 0)
        frame = data.ximat[body].reshape(3, 3)
        inertia = frame @ np.diag(compiled.body_inertia[body]) @ frame.T
        push = compiled.body_mass[body] * acc[3:]
        force += push
        # Euler's equation of the body, and the moment of its force.
        moment += inertia @ acc[:3] + np.cross(vel[:3], inertia @ vel[:3])
        moment += np.cross(data.xipos[body], push)
    return force, moment


def impulses(column, engine, step, precision):
    """Linear (0) or angular (1) momentum that a step's accelerations add, relative."""
    compiled, history, first = collision(engine, step, precision)
    data = mujoco.MjData(compiled)
    h = compiled.opt.timestep
    worst = 0.0
    for k in range(history.qpos.shape[1] - 1):
        data.qpos[:] = history.qpos[0, k]
        data.qvel[:] = history.qvel[0, k]
        mujoco.mj_fwdPosition(compiled, data)
        mujoco.mj_fwdVelocity(compiled, data)
        data.qacc[:] = (history.qvel[0, k + 1].astype(float) - data.qvel) / h
        mujoco.mj_rnePostConstraint(compiled, data)
        added = force_and_moment(compiled, data)[column]
        worst = max(worst, np.abs(added).max() * h)
    # The palm, about which bodies turn, is 1 m above the origin.
    return Found(worst / np.linalg.norm(first), MOMENTUM[precision])


for place, kind in enumerate(("impulse", "angular impulse")):
    register = case(
        9, FREE, f"{kind} that a step adds, relative", name=kind.replace(" ", "_"), engines=BOTH
    )
    register(functools.partial(impulses, place))
