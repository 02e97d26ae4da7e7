"""Hard case 14: the object spawned inside things."""

import dataclasses
import functools

import mujoco
import numpy as np

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from tests.helpers import grasps
from tests.stability.bench import bench, pinch
from tests.stability.table import BOTH, Found, case

SPHERE = 2
"""Place of the sphere in the paper's set."""


def worlds(the_bench, *shapes, **changes):
    """Fields of default hands, one for each object."""
    params, _ = grasps.hand_world(the_bench.scene, **changes)
    trials = [grasps.still(s) for s in shapes]
    return the_bench.fields([params] * len(shapes), trials)


def at_height(params, z):
    """The design with its arm at a height [m]."""
    return params._replace(arm=params.arm + z * (np.arange(6) == 2))


def holding_controls(the_bench, fields, seconds):
    """Controls that hold every hand where it starts, without pressure."""
    fingers = the_bench.scene.num_fingers
    rows = [np.r_[start[:6], np.zeros(fingers)] for start in fields.start]
    return the_bench.hold(seconds, *rows)


def middle_of_finger(compiled, data, qpos):
    """Centre of the middle sphere of the first finger."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(compiled, data)
    lay = model.layout(pinch())
    spheres = lay.spheres[0]
    return data.geom_xpos[spheres[len(spheres) // 2, 0]].copy()


# --- 14: spawned inside ----------------------------------------------------------------------


@functools.cache
def weightless():
    return dataclasses.replace(pinch(), gravity=0.0)


@case(
    14,
    "spawned 10 mm inside table, finger or palm",
    "speed at which it leaves",
    unit="m/s",
    engines=BOTH,
    quick="mujoco",
)
def spawned(engine, step, precision):
    """A sphere 10 mm deep in the table, in a finger's side, in the palm; without gravity, 1 s."""
    b = bench(weightless(), engine, step, precision)
    fields = worlds(b, SPHERE, SPHERE, SPHERE)
    compiled = world_model(b.scene, grasps.nth(fields, 0))
    data = mujoco.MjData(compiled)
    qpos = fields.start.copy()
    radius = compiled.geom_size[-1, 0]
    deep = 0.010
    qpos[0, -5] -= deep
    lay = model.layout(b.scene)
    finger = middle_of_finger(compiled, data, qpos[1])
    thick = compiled.geom_size[lay.spheres[0, 1, 0], 0]
    qpos[1, -7:-4] = finger + [0, radius + thick - deep, 0]
    qpos[2, -7:-4] = qpos[2, :3] - [0, 0, radius - deep]
    history = b.run(fields, holding_controls(b, fields, 1.0), qpos)
    speed = np.linalg.norm(history.object_velocity, axis=-1).max(1)
    note = "table {:.2f}, finger {:.2f}, palm {:.2f} m/s".format(*speed)
    return Found(speed.max(), 1.0, note)
