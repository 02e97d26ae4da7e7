"""Hard cases 29 to 31: crossing fingers, a joint bent sideways to 90 degrees, rubber's own law."""

import functools

import numpy as np

from codesign_jax import model
from tests.helpers import grasps
from tests.stability.bench import bench, pinch
from tests.stability.oracle import Reader, along, exact
from tests.stability.table import BOTH, Found, case
from tests.stability.touch import SPHERE, at_height, held

AGAINST_C = "accelerations along the path against MuJoCo C, relative"
TWO = (1.0, 0.5)


# --- 29: contact between fingers -------------------------------------------------------------


@functools.cache
def crossing():
    """Two opposed fingers that touch one another, two spheres a link."""
    return pinch(effects__finger_finger=True, discretization__spheres_per_link=2)


def curling(b):
    """A whole grasp of the sphere by fingers that are longer than the object is wide."""
    params, trial = grasps.hand_world(b.scene, length=0.13, pressure=190e3, spread=0.3)
    params = at_height(params, 0.04)
    trial = trial._replace(shape=np.int32(SPHERE), position=np.array([0.002, 0.004]))
    return b.fields([params], [trial]), b.commands([params], [trial])


@case(29, "whole grasp of fingers that cross", AGAINST_C, steps=TWO)
def crossing_fingers(engine, step, precision):
    """From the approach to the release, wherever fingers meet, slide and let go of each other."""
    # In float32 both ends of such a contact are light, and what rounding makes of it adds up.
    found = along(crossing(), step, precision, curling, least=4, rounding=2.0)
    return found._replace(note=f"{found.note}, {between(step, precision)} states of crossing")


def between(step, precision):
    """States of the path, of 250, in which two fingers touch one another."""
    b = exact(crossing(), step, precision)
    fields, ctrl = curling(b)
    path, reader, count = b.path(fields, ctrl), Reader(b.scene, fields), 0
    for qpos in path.qpos[0, :: max(1, ctrl.shape[1] // 250)]:
        reader.at(qpos)
        count += any(all("finger" in name for name in names) for names, *_ in reader.pushes())
    assert count > 20, "the fingers hardly touch: the case would be vacuous"
    return count


# --- 30: lateral joint near 90 degrees -------------------------------------------------------


def sideways(b):
    """Lateral angles of 80 to 95 degrees, where bending and twist have one axis; then let go."""
    params, trial = grasps.hand_world(b.scene, length=0.12)
    fields = b.fields([params], [trial])
    qpos, random = np.repeat(fields.start, 4, 0), np.random.default_rng(30)
    qpos[:, 2] = [1.0, 1.0, 0.12, 0.10]  # two hands in the air, two that press on box and table
    dofs = model.layout(b.scene).dofs
    for world, angle in enumerate((80, 90, 90, 95)):
        qpos[world, dofs[:, world % 3, 1]] = np.deg2rad(angle) * np.array([1, -1])
    qvel = 2.0 * random.normal(size=(4, qpos.shape[1] - 1))
    qvel[:, -6:] = 0
    fields = b.fields([params] * 4, [trial] * 4)._replace(start=qpos)
    return fields, held(b, fields, 1.0), qpos, qvel


NEAR = (30, "lateral joints near 90 degrees")


@case(*NEAR, AGAINST_C, steps=TWO)
def lateral(engine, step, precision):
    return along(pinch(), step, precision, sideways, least=4)


@case(*NEAR, "energy of a released finger over its springs' first", engines=BOTH)
def through_ninety(engine, step, precision):
    """Energy that a finger gains while a joint springs back through 90 degrees, in the air.

    Against MuJoCo C's largest kinetic energy: released springs, and nothing else, drive it.
    """
    b = bench(pinch(), engine, step, precision)
    fields, ctrl, qpos, qvel = sideways(b)
    air = fields.start[:, 2] > 0.5
    history, worst = b.run(fields, ctrl, qpos, 0 * qvel), 0.0
    for world in np.flatnonzero(air):
        reader = Reader(b.scene, fields, world)
        k = reader.model.jnt_stiffness[6:-1]
        stored = 0.5 * (k * qpos[world, 6:-7] ** 2).sum()
        joints = slice(6, len(k) + 6)
        for q, v in zip(history.qpos[world], history.qvel[world], strict=True):
            spring = 0.5 * (k * q[6:-7] ** 2).sum()
            worst = max(worst, (spring + reader.kinetic(q, v, joints)) / stored)
    # Explicit Coriolis forces and the palm's motion may add a little; damping takes.
    return Found(worst, 1.05)


# --- 31: neo-Hookean -------------------------------------------------------------------------


@functools.cache
def rubber():
    return pinch(effects__neo_hookean=True)


def squeezing(b):
    """A whole grasp of the cuboid."""
    params, trial = grasps.hand_world(b.scene, length=0.09, pressure=150e3)
    params = at_height(params, 0.05)
    return b.fields([params], [trial]), b.commands([params], [trial])


LAW = (31, "neo-Hookean fingers")


@case(*LAW, f"whole grasp: {AGAINST_C}", steps=TWO)
def softening(engine, step, precision):
    return along(rubber(), step, precision, squeezing, least=5)
