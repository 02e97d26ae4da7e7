"""Hard cases 11 and 26 to 28: objects that slide, tip over, spin, and that show an edge."""

import dataclasses
import functools

import numpy as np
from scipy import integrate

from codesign_jax.scene import objects
from tests.helpers import grasps
from tests.helpers.tables import GRAVITY, MU
from tests.stability.bench import bench, pinch
from tests.stability.hold import lifted
from tests.stability.oracle import Reader, along
from tests.stability.table import BOTH, Found, case
from tests.stability.touch import CUBOID, at_height, held, worlds

AGAINST_C = "accelerations along the path against MuJoCo C, relative"
HALF = 0.030  # half a side of the cuboid, and radius of the sphere [m]


# --- 11: sliding -----------------------------------------------------------------------------


@case(11, "cuboid slides to rest", "error of v / mu g, relative", engines=BOTH)
def slides_to_rest(engine, step, precision):
    """The cuboid, pushed at 2 m/s over the table, stops after v / mu g = 0.41 s.

    The table's normal is fixed in the engine's frame, so that a slope is a push instead.
    """
    b = bench(pinch(), engine, step, precision)
    fields = worlds(b, CUBOID)
    qpos, qvel = fields.start.copy(), np.zeros((1, fields.start.shape[1] - 1))
    qpos[0, 2], qpos[0, -5], qvel[0, -6] = 1.0, HALF - 1e-4, 2.0
    raised = fields._replace(start=qpos)
    speed = b.run(raised, held(b, raised, 1.0), qpos, qvel).object_velocity[0, :, 0]
    stopped = np.argmax(speed < 0.01) * b.h
    assert speed[-1] < 0.01, "it never stops"
    # As on the incline: the elliptic cone makes a sliding object hop.
    return Found(abs(stopped * MU * GRAVITY / 2.0 - 1), 0.15, f"stops after {stopped:.2f} s")


# --- 26: tipping and flipping ----------------------------------------------------------------


@functools.cache
def rough():
    """A table on which nothing slides."""
    base = pinch()
    table = objects.Table(friction=5.0)
    return dataclasses.replace(base, objects=dataclasses.replace(base.objects, table=table))


def tilted(b, angle, seconds):
    """Path of the cuboid let go on one lower edge, leaning over it by an angle [rad]."""
    fields = worlds(b, CUBOID)
    qpos = fields.start.copy()
    qpos[0, 2] = 1.0
    qpos[0, -5] = HALF * (np.sin(angle) + np.cos(angle)) - 1e-4
    qpos[0, -4:] = [np.cos(angle / 2), 0, np.sin(angle / 2), 0]
    raised = fields._replace(start=qpos)
    history = b.run(raised, held(b, raised, seconds), qpos)
    return 2 * np.arctan2(history.qpos[0, :, -2], history.qpos[0, :, -4])


def rocking(angle, time):
    """Angle of a rigid cube that turns about its edge: 8/3 a^2 phi'' = sqrt(2) a g sin(...)."""
    rate = 3 * np.sqrt(2) * GRAVITY / (8 * HALF)
    path = integrate.solve_ivp(
        lambda _, y: [y[1], rate * np.sin(y[0] - np.pi / 4)], (0, time), [angle, 0.0], rtol=1e-10
    )
    return path.y[0, -1]


OVER = (26, "cuboid let go on its edge, 10 % from balance")
TWICE = {"engines": BOTH, "quick": "mujoco"}


@case(*OVER, "turn in 0.1 s against a rigid body's, relative", **TWICE)
def tips(engine, step, precision):
    """A tenth of a second after it is let go 10 % before and beyond the balance of 45 degrees."""
    b, worst = bench(rough(), engine, step, precision), 0.0
    for share in (0.9, 1.1):
        start = share * np.pi / 4
        turned = tilted(b, start, 0.1)[-1] - start
        worst = max(worst, abs(turned / (rocking(start, 0.1) - start) - 1))
    # Semi-implicit Euler turns t (t + h) / t^2 as far: 10 % at t = 10 h; and the edge gives way.
    return Found(worst, 0.15)


@case(*OVER, "angle of the face it comes to rest on, error", unit="rad", **TWICE)
def flips(engine, step, precision):
    """Before the balance it falls back onto its face, beyond it onto the next one, and rests."""
    b, worst = bench(rough(), engine, step, precision), 0.0
    for share, expected in ((0.9, 0.0), (1.1, np.pi / 2)):
        angle = tilted(b, share * np.pi / 4, 3.0)
        worst = max(worst, abs(angle[-1] - expected))
    return Found(worst, 1e-3)


# --- 27: edges -------------------------------------------------------------------------------


def edge_first(b):
    """A grasp of the cuboid by two opposite vertical edges: turned by 45 degrees, tilted a bit."""
    params, trial = grasps.hand_world(b.scene, length=0.09, pressure=190e3)
    params = at_height(params, 0.05)
    trial = trial._replace(yaw=np.array(np.pi / 4), arm_tilt=np.array([0.03, 0.02]))
    return b.fields([params], [trial]), b.commands([params], [trial])


@case(27, "cuboid grasped by two edges", AGAINST_C, steps=(1.0, 0.5))
def edges(engine, step, precision):
    """Spheres of the fingers on an edge, where the normal turns by 90 degrees."""
    return along(pinch(), step, precision, edge_first, least=5)


# --- 28: spin --------------------------------------------------------------------------------


@functools.cache
def full():
    return pinch(effects__friction="full")


def spun(b):
    """The lifted cuboid, spun at 20 rad/s about the line between the two fingers."""
    fields, ctrl = lifted(b, 1.0)
    history = bench(full(), "structured", b.h / full().discretization.timestep, "float64").run(
        fields, ctrl
    )
    qpos, qvel = history.qpos[:, -1], history.qvel[:, -1].copy()
    turn = Reader(b.scene, fields).at(qpos[0]).xmat[-1].reshape(3, 3)
    qvel[0, -3:] += turn.T @ [20.0, 0, 0]
    return fields, np.repeat(ctrl[:, -1:], round(1 / b.h), 1), qpos, qvel


@case(28, "full friction: a held box is spun", AGAINST_C, steps=(1.0, 0.5))
def held_spin(engine, step, precision):
    """Torsion and rolling in six dimensions of the cone, while the object turns in the grip."""
    return along(full(), step, precision, spun, least=2)
