"""Hard case 32: belt friction. A limp finger over a fixed cylinder holds exp(mu theta) times."""

import dataclasses
import functools

import numpy as np

from codesign_jax import model
from codesign_jax.scene import hand
from tests.helpers import grasps
from tests.helpers.tables import GRAVITY
from tests.stability.bench import bench
from tests.stability.oracle import TIGHT
from tests.stability.table import BOTH, Found, case

RADIUS, FRICTION, LINKS = 0.05, 0.3, 30
RUN_UP, HANGING = 0.03, 0.05  # straight parts before and behind the cylinder [m]
LOAD = 0.1  # mass at the tip [kg]
MASS, INERTIA = 3.0, 1000.0  # of the cylinder [kg, kg m^2]: it goes on turning
STIFFNESS = 2000.0  # [N/m]
SPIN, WAIT, TIME = -0.02, 1.0, 2.0  # the cylinder's [rad/s]; times to settle and to measure [s]


@functools.cache
def belt():
    """One finger that bends only, its palm below it; the cylinder lies on a table of ice."""
    off = ("lateral_bending", "twist", "finger_table", "palm_object", "palm_table", "wrist")
    base = grasps.pinch(
        "cylinder",
        links=LINKS,
        contact__friction_ratio=30.0,
        contact__normal_stiffness=STIFFNESS,
        solver__tolerance=1e-16,
        solver__iterations=100,
        **{f"effects__{name}": False for name in off},
    )
    one = dataclasses.replace(
        base.hand, finger=(hand.Finger(azimuth=0.0, spread=0.0, radius=0.0, tilt=90.0),)
    )
    thing = dataclasses.replace(base.objects.object[0], size=(RADIUS, 0.03), friction=FRICTION)
    table = dataclasses.replace(base.objects.table, friction=0.0)
    things = dataclasses.replace(base.objects, object=(thing,), table=table)
    return dataclasses.replace(base, hand=one, objects=things)


def laid_over(b):
    """Fields of the belt: light, limp, loaded at the tip, laid over the cylinder from +x to -x."""
    length = RUN_UP + np.pi * RADIUS + HANGING
    params, trial = grasps.hand_world(b.scene, length=length)
    params = params._replace(arm=np.array([RADIUS, 0, RADIUS - RUN_UP, np.pi, 0, 0]))
    fields, lay = b.fields([params], [trial]), model.layout(b.scene)
    # What is left of the implicit inertia holds still what tension alone would make whip.
    links, joints = lay.bodies[0], lay.dofs[0, :, 0]
    for name, where, factor in (
        ("body_mass", links, 0.05),
        ("body_inertia", links, 0.05),
        ("jnt_stiffness", joints, 1e-3),
        ("dof_damping", joints, 1.0),
        ("dof_armature", joints, 1.0),
    ):
        getattr(fields, name)[0, where] *= factor
    fields.body_mass[0, links[-1]] = LOAD
    fields.body_mass[0, -1] = fields.dof_M0[0, -6:-3] = MASS
    fields.body_inertia[0, -1] = fields.dof_M0[0, -3:] = INERTIA
    along = (np.arange(LINKS) + 0.5) * length / LINKS
    bent = (along > RUN_UP) & (along < RUN_UP + np.pi * RADIUS)
    fields.start[0, :6] = params.arm
    fields.start[0, joints] = np.where(bent, np.pi / bent.sum(), 0.0)
    quarter = np.sqrt(0.5)  # the axis along y
    fields.start[0, -7:] = [
        0,
        0,
        RADIUS - MASS * GRAVITY / (8 * STIFFNESS),
        quarter,
        -quarter,
        0,
        0,
    ]
    return fields, params.arm


@case(
    32,
    "belt of 30 links over a turning cylinder",
    "tension ratio against e^(mu theta), relative",
    engines=BOTH,
    steps=(1.0, 0.5),
)
def capstan(engine, step, precision):
    """The cylinder turns under the belt, whose root is held: (T1 - T2) R is what slows it.

    T2 carries the load at the tip; T1 follows from the cylinder's angular momentum, that is from
    the impulses of all contacts, since single forces of a sliding contact hop.
    """
    # Links of 0.1 g are nothing to the decrement that a grasp is solved to.
    b = bench(belt(), engine, step, precision, TIGHT[precision])
    fields, arm = laid_over(b)
    qvel = np.zeros((1, fields.start.shape[1] - 1))
    qvel[0, -1] = SPIN
    ctrl = b.hold(WAIT + TIME, np.r_[arm, 0.0])
    history = b.run(fields, ctrl, qvel=qvel)
    last, first = ctrl.shape[1] - 1, round(WAIT / b.h)
    slowed = history.qvel[0, last, -1] - history.qvel[0, first, -1]
    hanging = (LOAD + 0.001) * GRAVITY  # and a fifth of the belt
    ratio = 1 + INERTIA * slowed / ((last - first) * b.h) / (RADIUS * hanging)
    expected = np.exp(FRICTION * np.pi)
    # A chain's links of 9 degrees hold 0.1 % more than a belt; the hops of a second average out.
    note = f"holds {ratio:.2f} times, e^(mu pi) {expected:.2f}"
    return Found(abs(ratio / expected - 1), 0.01, note)
