"""Hard case 9: momentum of a free hand and an object that collide, linear and angular."""

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
from tests.stability.touch import SPHERE, held, worlds


@functools.cache
def floating(**effects):
    """The pinch hand without wrist springs or dampers, and no gravity."""
    base = pinch(
        effects__finger_table=False,
        solver__tolerance=1e-16,
        solver__iterations=100,
        **{f"effects__{name}": value for name, value in effects.items()},
    )
    free = dataclasses.replace(base.hand, wrist=hand.Wrist(0.0, 0.0, 0.0, 0.0))
    return dataclasses.replace(base, hand=free, gravity=0.0)


def collision(base, engine, step, precision, *, bend=0.0):
    """A sphere of 0.5 m/s hits a finger of a hand at rest: model, history of 0.6 s, momentum.

    Fingers that are bent at the start spring open, and if they cross they push one another first.
    """
    # Solved as far as the precision goes: what is left of a force is left of the momentum.
    tolerance = {"float32": 1e-12, "float64": 1e-24}[precision]
    b = bench(base, engine, step, precision, tolerance)
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
    qpos[0, model.layout(b.scene).dofs[..., 0]] = bend
    fields = fields._replace(start=qpos)
    history = b.run(fields, held(b, fields, 0.6) * 0, qpos, qvel)
    assert np.abs(history.object_velocity[0, -1, 1] + 0.5) > 0.01, "the sphere met nothing"
    return compiled, history, np.array([0.0, -0.5 * compiled.body_mass[-1], 0.0])


MOMENTUM = {"float32": 1e-4, "float64": 1e-10}


FREE = "free hand and object collide"


def impulses(base, engine, step, precision, **start):
    """What each step's accelerations add to linear and angular momentum, relative, (2,)."""
    compiled, history, first = collision(base, engine, step, precision, **start)
    data, h, worst = mujoco.MjData(compiled), compiled.opt.timestep, np.zeros(2)
    acc, vel, kind = np.zeros(6), np.zeros(6), mujoco.mjtObj.mjOBJ_BODY
    for k in range(history.qpos.shape[1] - 1):
        data.qpos[:], data.qvel[:] = history.qpos[0, k], history.qvel[0, k]
        mujoco.mj_fwdPosition(compiled, data)
        mujoco.mj_fwdVelocity(compiled, data)
        data.qacc[:] = (history.qvel[0, k + 1].astype(float) - data.qvel) / h
        mujoco.mj_rnePostConstraint(compiled, data)
        linear, angular = np.zeros(3), np.zeros(3)
        for body in range(1, compiled.nbody):
            mujoco.mj_objectAcceleration(compiled, data, kind, body, acc, 0)
            mujoco.mj_objectVelocity(compiled, data, kind, body, vel, 0)
            frame = data.ximat[body].reshape(3, 3)
            inertia = frame @ np.diag(compiled.body_inertia[body]) @ frame.T
            force = compiled.body_mass[body] * acc[3:]
            linear += force
            # Euler's equation of the body, and its force's moment about the origin.
            angular += inertia @ acc[:3] + np.cross(vel[:3], inertia @ vel[:3])
            angular += np.cross(data.xipos[body], force)
        worst = np.maximum(worst, [np.abs(linear).max() * h, np.abs(angular).max() * h])
    # The palm, about which things turn, is 1 m above the origin.
    return worst / np.linalg.norm(first)


def skin():
    """The hull, whose vertices follow two links, and contact between fingers; MuJoCo C has none."""
    return floating(surface="hull", finger_finger=True)


CROSSED = 0.9
"""Angle of every joint [rad] at which the tips of the two fingers stand in one another."""


@functools.cache
def meeting(step, precision):
    """Impulses of fingers that push one another; without that contact they go another way."""
    apart = floating(surface="hull", finger_finger=False)
    paths = [
        collision(base, "structured", step, precision, bend=CROSSED)[1].qpos[0]
        for base in (skin(), apart)
    ]
    assert np.abs(paths[0] - paths[1])[0, 6:-7].max() > 0.01, "the fingers do not touch"
    return impulses(skin(), "structured", step, precision, bend=CROSSED)


def register(column, kind, what):
    """Contact forces act in pairs, and their moments too as they act on one line."""

    def found(values, precision):
        return Found(values[column], MOMENTUM[precision])

    @case(9, FREE, f"{what} that a step adds, relative", name=kind, engines=BOTH, quick="mujoco")
    def spheres(engine, step, precision):
        return found(impulses(floating(), engine, step, precision), precision)

    hull = {"steps": (1.0, 0.5)}
    title = "free hand with the hull and object collide"

    @case(9, title, f"{what} that a step adds, relative", name=f"hull_{kind}", **hull)
    def hulls(engine, step, precision):
        return found(impulses(skin(), engine, step, precision), precision)

    title = "free hand with the hull whose fingers push one another"

    @case(9, title, f"{what} that a step adds, relative", name=f"meeting_{kind}", **hull)
    def fingers(engine, step, precision):
        return found(meeting(step, precision), precision)


register(0, "impulse", "impulse")
register(1, "angular_impulse", "angular impulse")
