"""Hard cases 12, 13, 18, 38: an object between two fingers, or two pads, that press on it."""

import dataclasses
import functools

import numpy as np

from codesign_jax.scene.objects import Shape
from codesign_jax.scene.tables import Fixture
from tests.helpers import grasps
from tests.helpers.tables import GRAVITY
from tests.stability.bench import CHUNK, CREEP, FIRM, bench, loaded, pinch
from tests.stability.oracle import Reader
from tests.stability.table import BOTH, Found, case, case_of_both_scenes
from tests.stability.touch import at_height

# --- 12: pinch -------------------------------------------------------------------------------


def lifted(the_bench, seconds):
    """Fields and controls of the box lifted by two fingers and held for a time."""
    params, trial = grasps.hand_world(the_bench.scene, length=0.09, pressure=190e3)
    params = at_height(params, 0.05)
    fields = the_bench.fields([params], [trial])
    ctrl = the_bench.commands([params], [trial])
    ctrl = ctrl[:, : round(4.5 / the_bench.h)]
    return fields, np.concatenate(
        [ctrl, np.repeat(ctrl[:, -1:], round(seconds / the_bench.h), 1)], 1
    )


def firm(name="paper_spheres"):
    stiff = FIRM.normal_stiffness
    slow = FIRM.friction_ratio
    return pinch(name, contact__normal_stiffness=stiff, contact__friction_ratio=slow)


def hanging(history):
    """Object below the palm [m], (time,)."""
    return history.qpos[0, :, 2] - history.qpos[0, :, -5]


@case_of_both_scenes(
    12,
    "pinch held for 60 s",
    "slip of the object",
    unit="m",
)
def pinch_holds(name, engine, step, precision):
    """For a minute, from a second after the lift on."""
    b = bench(firm(name), engine, step, precision)
    slip = hanging(b.run(*lifted(b, 61.0)))[-round(60 / b.h) :]
    rate = (slip[-1] - slip[-round(30 / b.h)]) / 30
    return Found(abs(slip[-1] - slip[0]), 60 * CREEP, f"creeps at {1e3 * rate:.3f} mm/s in the end")


def grip(reader):
    """Load that the present normal forces carry at the friction limit [N].

    mu N for a normal on a side of the box; on its lower edge, where normals point down by n_z,
    N (mu sqrt(1 - n_z^2) + n_z).
    """
    loads = []
    for names, force, c in reader.pushes():
        if any("finger" in n for n in names):
            down = c.frame[2]
            mu = c.friction[0]
            loads.append(force * (mu * np.sqrt(1 - down**2) + down))
    return sum(loads)


@case(
    12,
    "pinch, mass ramped until it drops",
    "load when it slips over mu N, error",
    engines=BOTH,
    quick="mujoco",
)
def pinch_drops(engine, step, precision):
    """The object's mass grows by 20 g/s; slip is a relative speed of 20 mm/s, far above creep."""
    b = bench(firm(), engine, step, precision)
    fields, ctrl = lifted(b, 20.0)
    time = np.arange(0, ctrl.shape[1], CHUNK) * b.h
    mass = fields.object_mass[0]
    masses = 1 + 0.02 * np.maximum(time - 5.5, 0) / mass
    history = b.run(fields, ctrl, masses=masses)
    below = hanging(history)
    start = round(5.5 / b.h)
    fast = np.diff(below[start:]) / b.h > 0.02
    assert fast.any(), "it never slips"
    when = start + int(np.argmax(fast))
    load = mass * masses[when // CHUNK] * GRAVITY
    factor = masses[when // CHUNK]
    reader = Reader(b.scene, loaded(fields, factor))
    grips = []
    # A sliding contact hops, so the grip is the mean over the last tenth of a second.
    for k in range(when - round(0.1 / b.h), when):
        reader.at(history.qpos[0, k], history.qvel[0, k], ctrl[0, k + 1])
        grips.append(grip(reader))
    ratio = load / np.mean(grips)
    return Found(abs(ratio - 1), 0.1, f"slips at {load:.2f} N, {ratio:.3f} mu N")


# --- 13: mass ratio --------------------------------------------------------------------------


def pressed(b):
    """Links of 4 g close on a cuboid of 2000 times their mass, which the table carries."""
    params, trial = grasps.hand_world(b.scene, length=0.09, pressure=190e3)
    params = at_height(params, 0.05)
    fields = b.fields([params], [trial])
    link = fields.mass[0, 0, 1]
    trial = trial._replace(mass=2000 * link / fields.object_mass[0])
    fields = b.fields([params], [trial])
    ctrl = b.commands([params], [trial])[:, : round(3.5 / b.h)]
    return fields, np.concatenate([ctrl, np.repeat(ctrl[:, -1:], round(1.5 / b.h), 1)], 1)


HEAVY = (13, "mass ratio 2000 between object and link")


@case_of_both_scenes(*HEAVY, "largest speed at rest", unit="rad/s", quick="mujoco")
def heavy_rest(name, engine, step, precision):
    """Speed after 1.2 s of rest, of joints and of the object."""
    b = bench(pinch(name, discretization__links=10), engine, step, precision)
    history = b.run(*pressed(b))
    # Creep of 1 mm/s at 20 mm; a solver that loses digits to the mass ratio rattles.
    return Found(history.speed[0, -round(0.3 / b.h) :].max(), 0.05)


# --- 18: no limit cycle ----------------------------------------------------------------------


@case_of_both_scenes(
    18,
    "opposed fingers squeeze the box",
    "largest joint speed after 3.5 s of rest",
    unit="rad/s",
)
def squeeze(name, engine, step, precision):
    """Opposed fingers on the box from 3.5 s on; largest finger speed from 7 to 8 s."""
    b = bench(pinch(name), engine, step, precision)
    params, trial = grasps.hand_world(b.scene, length=0.09, pressure=190e3)
    fields = b.fields([at_height(params, 0.05)], [trial])
    ctrl = b.commands([at_height(params, 0.05)], [trial])[:, : round(3.5 / b.h)]
    ctrl = np.concatenate([ctrl, np.repeat(ctrl[:, -1:], round(4.5 / b.h), 1)], 1)
    history = b.run(fields, ctrl)
    late = np.abs(history.qvel[0, -round(1 / b.h) :, 6:-6]).max()
    # Creep of 1 mm/s at 100 mm is 0.01 rad/s; a limit cycle has rad/s.
    sunk = hanging(history)
    note = f"sinks by {1e3 * (sunk[-1] - sunk[-round(4.5 / b.h)]):.1f} mm in 4.5 s"
    return Found(late, 0.05, note)


# --- 38: two pads ----------------------------------------------------------------------------


RADIUS = 0.024
WEIGHT = 0.045
"""Radius [m] and mass [kg] of a capsule, which stands between two pads; google-deepmind/mujoco
issue 3328 has one of that mass, which slips down by 155 um/s at pads of 12 to 60 N."""
HANDS = "finger_object finger_table finger_finger finger_palm finger_itself palm_object palm_table"
PADS = 2.0, 3.9
"""Half the height of the pads, and where on them the capsule begins [m]."""


@functools.cache
def padded(press, share):
    """A scene of two pads that press on a capsule [N], with a share of the critical friction."""
    base = pinch("paper", **grasps.off(HANDS))
    # Two points of the capsule touch each pad, with twice the stiffness of two bodies.
    depth = press / (2 * 2 * base.contact.normal_stiffness)
    place = RADIUS - depth + 0.1
    wall = {"type": "box", "size": (0.1, 1.0, PADS[0])}
    pads = [Fixture(f"pad {s}", position=(s * place, 0.0, PADS[0]), **wall) for s in (-1, 1)]
    shape = Shape(name="capsule", type="capsule", size=(RADIUS, 0.020), mass=WEIGHT, friction=0.8)
    friction = share * WEIGHT * GRAVITY / (2 * press)
    table = dataclasses.replace(base.objects.table, friction=friction)
    objects = dataclasses.replace(base.objects, object=(shape,), table=table)
    return dataclasses.replace(base, fixture=tuple(pads), objects=objects)


def slipped(engine, step, precision, press, share, seconds):
    """How far the capsule goes in a time, and in its last half [m]."""
    b = bench(padded(press, share), engine, step, precision)
    fields, ctrl = lifted(b, 0.0)
    qpos = np.array(fields.start)
    qpos[:, -7:] = 0.0, 0.0, PADS[1], 1.0, 0.0, 0.0, 0.0
    height = b.run(fields, b.hold(seconds, ctrl[0, 0]), qpos).object[0, :, 2]
    return PADS[1] - height[-1], height[len(height) // 2] - height[-1]


PADDED = 38, "capsule of 45 g between two pads"


@case(*PADDED, "way in 5 s, at 12 and 60 N", unit="m", quick="structured")
def pads_hold(engine, step, precision):
    """With the paper's friction: it slips by the tangential springs' way alone."""
    slips = []
    for press in 12.0, 60.0:
        share = 0.8 * 2 * press / (WEIGHT * GRAVITY)
        slips.append(slipped(engine, step, precision, press, share, 5.0)[0])
    return Found(max(np.abs(slips)), 1e-5)


@case(*PADDED, "way in 5 s, at 1.02 and 1.10 of the critical friction", unit="m")
def pads_hold_at_the_limit(engine, step, precision):
    """Nothing moves any more in the last half."""
    slips = [slipped(engine, step, precision, 12.0, share, 5.0) for share in (1.02, 1.10)]
    late = max(abs(last) for _, last in slips)
    return Found(max(abs(way) for way, _ in slips), 1e-4, f"{late:.2g} m in the last half")


@case(*PADDED, "way in 0.5 s, at 0.90 and 0.98 of it", unit="m", lower=True)
def pads_let_go(engine, step, precision):
    """It slips: the cone of what is pressed by bodies that do not give way is oily."""
    slips = [slipped(engine, step, precision, 12.0, share, 0.5)[0] for share in (0.90, 0.98)]
    return Found(min(slips), 5e-3)
