"""A finger that comes loose and strikes another one: how deep it goes, and how hard it pushes."""

from dataclasses import replace
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from codesign_jax import model, scene
from codesign_jax.engines import make_engine
from scripts.contact_depths import in_tube, tube
from tests.helpers import grasps, oracles

DURATION = 0.16
"""Of a strike and what follows [s]."""
OFF = ("finger_object", "palm_object", "finger_table", "palm_table", "object_table", "finger_palm")


def two_fingers(timestep, **changes):
    """A finger that hangs down and one across its way, like a winner's; table__key=value."""
    found = {
        "discretization": {"timestep": timestep},
        "effects": {name: False for name in (*OFF, "gravity", "disturb", "ungrasp")},
        "hand.material.shear_modulus": 35e3,
        "hand.section.width": 0.024,
    }
    for key, value in changes.items():
        table, name = key.split("__")
        found.setdefault(table, {})[name] = value
    hand, box = grasps.DATA / "pinch.toml", grasps.DATA / "box.toml"
    loaded = scene.load("paper", hand_name=hand, object_set=box, overrides=found)
    one, two = loaded.hand.finger
    one = replace(one, radius=None, base=(0.045, 0.0), tilt=90.0, spread=0.0)
    two = replace(two, radius=None, base=(0.0, -0.08), azimuth=90.0, tilt=45.0, spread=1.0)
    return replace(loaded, hand=replace(loaded.hand, finger=(one, two)))


class Strikes(NamedTuple):
    """Of each world.

    Attributes:
      depth: The largest depth of a finger in the other one [m].
      impulse: On the struck finger, about the axis of its first joint [N m s].
      wrist: What contacts push the wrist by, whose sum over both fingers is nothing [N s].
      speed: The fastest that the striking tip moves [m/s].
    """

    depth: np.ndarray
    impulse: np.ndarray
    wrist: np.ndarray
    speed: np.ndarray


def strike(the_scene, count=18):
    """Lets one finger loose under pressure, in worlds of other sizes and directions each."""
    random = np.random.default_rng(4)
    hand, trial = grasps.hand_world(the_scene)
    params = grasps.repeat(hand, count)
    length = random.uniform([0.13, 0.15], [0.17, 0.18], (count, 2))
    height, wall = np.full((count, 2), 0.022), np.full((count, 2), 0.0022)
    pressure = np.stack([random.uniform(25e3, 40e3, count), np.zeros(count)], 1)
    spread = np.radians(random.uniform(-20, 20, count))
    params = params._replace(
        length=length, height=height, wall=wall, pressure=pressure, spread=spread
    )
    with jax.enable_x64(True):
        trials = grasps.repeat(trial, count)
        fields, _ = grasps.batch_inputs(the_scene, params, trials)
        fields = jax.tree.map(np.asarray, fields)
        steps = round(DURATION / the_scene.discretization.timestep)
        ctrl = np.zeros((count, steps, 8))
        ctrl[..., :6] = fields.start[:, None, :6]
        ctrl[..., 6:] = pressure[:, None]
        found = oracles.path(make_engine("structured", the_scene), fields, ctrl)
    every = [_of_world(the_scene, params, trials, ctrl, found, w) for w in range(count)]
    return Strikes(*(np.array(v) for v in zip(*every, strict=True)))


def _of_world(the_scene, params, trials, ctrl, found, world):
    """Numbers of `Strikes`."""
    own, trial = grasps.nth(params, world), grasps.nth(trials, world)
    compiled, h = model.compile_model(the_scene, own, trial), the_scene.discretization.timestep
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, lay = mujoco.MjData(compiled), model.layout(the_scene)
    qpos, qvel = found.qpos[world], found.qvel[world]
    place, turn, force, speed = [], [], [], 0.0
    for k in range(len(qpos) - 1):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[k], qvel[k], ctrl[world, k]
        mujoco.mj_forward(compiled, data)
        place.append(data.xpos.copy())
        turn.append(data.xmat.reshape(-1, 3, 3).copy())
        # What the step's acceleration leaves to contacts.
        data.qacc[:] = (qvel[k + 1] - qvel[k]) / h
        mujoco.mj_inverse(compiled, data)
        force.append(data.qfrc_inverse - data.qfrc_actuator)
        if k:
            tip = lay.bodies[0, -1]
            speed = max(speed, np.linalg.norm(place[-1][tip] - place[-2][tip]) / h)
    place, turn, force = np.stack(place), np.stack(turn), np.stack(force)
    width = the_scene.hand.section.width
    one, two = (
        tube(place[:, b], turn[:, [stub, *b]], (float(n), width, float(v)))
        for stub, b, n, v in zip(lay.stubs, lay.bodies, own.length, own.height, strict=True)
    )
    depth = max(in_tube(one.rings, two).max(), in_tube(two.rings, one).max())
    total = h * force.sum(0)
    wrist = np.abs(h * force[:, :3]).sum(0).max()
    return depth, abs(total[lay.dofs[1, 0, 0]]), wrist, speed
