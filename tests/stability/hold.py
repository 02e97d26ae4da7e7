"""Hard cases 12 and 13: an object between two fingers that press on it."""

import numpy as np

from codesign_jax import model
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
    fields, ctrl = the_bench.fields([params], [trial]), the_bench.commands([params], [trial])
    ctrl = ctrl[:, : round(4.5 / the_bench.h)]
    return fields, np.concatenate(
        [ctrl, np.repeat(ctrl[:, -1:], round(seconds / the_bench.h), 1)], 1
    )


def firm(name="paper_spheres"):
    stiff, slow = FIRM.normal_stiffness, FIRM.friction_ratio
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
    return Found(slip[-1] - slip[0], 60 * CREEP, f"creeps at {1e3 * rate:.3f} mm/s in the end")


def grip(reader):
    """Load that the present normal forces carry at the friction limit [N].

    mu N for a normal on a side of the box; on its lower edge, where normals point down by n_z,
    N (mu sqrt(1 - n_z^2) + n_z).
    """
    loads = []
    for names, force, c in reader.pushes():
        if any("finger" in n for n in names):
            down, mu = c.frame[2], c.friction[0]
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
    mass = fields.body_mass[0, -1]
    masses = 1 + 0.02 * np.maximum(time - 5.5, 0) / mass
    history = b.run(fields, ctrl, masses=masses)
    below = hanging(history)
    start = round(5.5 / b.h)
    fast = np.diff(below[start:]) / b.h > 0.02
    assert fast.any(), "it never slips"
    when = start + int(np.argmax(fast))
    load = mass * masses[when // CHUNK] * GRAVITY
    factor = masses[when // CHUNK]
    reader, grips = Reader(b.scene, loaded(fields, factor)), []
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
    link = fields.body_mass[0, model.layout(b.scene).bodies[0, 0]]
    trial = trial._replace(mass=2000 * link / fields.body_mass[0, -1])
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
