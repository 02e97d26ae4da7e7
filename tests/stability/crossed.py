"""Hard case 34: a hull finger that is pulled along another one; its law: tests/test_rings.py."""

import dataclasses
import functools

import numpy as np

from codesign_jax import model, scene
from tests.helpers import grasps
from tests.stability.bench import bench
from tests.stability.table import Found, case

HEAVY = 1e9
"""Armature of what is to stay where it is [kg m^2]."""
LENGTH = 0.11


@functools.cache
def crossed():
    """The default scene's contact between two opposed fingers, and no other."""
    others = ("finger_object", "palm_object", "finger_table", "palm_table")
    others += ("finger_palm", "finger_itself")
    base = scene.load(
        "paper",
        hand_name=grasps.DATA / "pinch.toml",
        overrides={"effects": dict.fromkeys(others, False)},
    )
    return dataclasses.replace(base, gravity=0.0)


def straight(b, places, depths, roll):
    """Fields of two straight fingers that cross at right angles, the second above the first.

    Args:
      b: The bench.
      places: Where they cross, from either root over their length, shape (world, 2).
      depths: How deep their sections' outlines are in one another [m], shape (world,).
      roll: Turn of the first finger about its own axis.
    """
    params, trial = grasps.hand_world(b.scene, length=LENGTH)
    count = len(depths)
    fields = b.fields([params] * count, [trial] * count)
    fields.start[:, 2] = 1.0
    half, (first, second) = params.height[0] / 2, model.layout(b.scene).stubs
    x, y = LENGTH * places.T
    # A finger's axis is at half its height; the first one's is along x, at a height of zero.
    fields.body_quat[:, first] = np.cos(roll / 2), np.sin(roll / 2), 0, 0
    fields.body_pos[:, first] = np.array([0, half * np.sin(roll), -half * np.cos(roll)])
    fields.body_pos[:, first, 0] -= x
    fields.body_quat[:, second] = np.sqrt(0.5), 0, 0, np.sqrt(0.5)
    up = lowest(roll, b.scene.hand.section.width / 2, half) - depths
    fields.body_pos[:, second] = np.stack([0 * y, -y, up], 1)
    return fields


def lowest(roll, a, b):
    """Distance from the axis of |y/a|^4 + |z/b|^4 = 1 to its lowest tangent plane, turned."""
    y, z = abs(a * np.sin(roll)), abs(b * np.cos(roll))
    return (y ** (4 / 3) + z ** (4 / 3)) ** 0.75


HALF = "two crossed hull fingers that hold by friction_memory, half the friction limit"
HINGE = 0.02
"""Damping of the hinge [N m s/rad]: at rest after 10 ms on a skin of 4 kN/m at 60 mm."""
PLACED = np.array([[0.6, 0.6], [0.63, 0.57], [0.65, 0.7]])


def hinged(b, places, depth, roll, fingers):
    """Fields of rigid fingers, some of which turn about their first joints; and these joints."""
    lay = model.layout(b.scene)
    fields = straight(b, places, np.full(len(places), depth), roll)
    fields.dof_armature[:, : int(lay.dofs.max()) + 1] = HEAVY
    hinges = [lay.dofs[f, 0, 0] for f in fingers]
    for hinge in hinges:
        fields.dof_damping[:, hinge], fields.jnt_stiffness[:, hinge] = HINGE, 0.0
        fields.dof_armature[:, hinge] = b.h * HINGE  # implicit, as everywhere
    return fields, hinges


PRESSED = np.array([5.0, 15.0])
"""Forces that press the fingers together [N]."""
PRESS, PULL, REST = 0.7, 0.1, 1.0
"""Times in which the load and then the pull grow, and until the pull begins [s]."""
CREEPS = 4.5
"""Time from the pull on [s]: that of a grasp from lift to release."""


def pulled(share, seconds, step, precision):
    """Way [m] of a finger that is pulled along the other one by a share of the friction limit.

    The upper finger presses on the edge of the lower one, which lies on its side, so that it bends
    in the plane of contact.  Both are rigid and turn about their first joints, by their pressures.

    Returns:
      Ways from the pull on, shape (world, time); worlds are `PLACED` times `PRESSED`.
    """
    b = bench(crossed(), "structured", step, precision)
    places = np.repeat(PLACED, len(PRESSED), 0)
    load = np.tile(PRESSED, len(PLACED))
    fields, hinges = hinged(b, places, -0.3e-3, np.pi / 2, (0, 1))
    first = round(REST / b.h)
    start = np.c_[fields.start[:, :6], np.zeros((len(load), 2))]
    ctrl = b.hold(first * b.h + seconds, *start)
    arms = LENGTH * (places - 0.5 / model.layout(b.scene).links)
    time = np.arange(ctrl.shape[1]) * b.h
    pull = share * b.scene.contact.finger_finger_friction * load
    loads = (pull, np.clip((time - REST) / PULL, 0, 1)), (load, np.clip(time / PRESS, 0, 1))
    for f, (force, ramp) in enumerate(loads):
        moment = fields.actuator_gainprm[:, f - 2, 0]
        ctrl[:, :, 6 + f] = (force * arms[:, f] / moment)[:, None] * ramp
    turned = b.run(fields, ctrl).qpos[:, :, hinges[0]]
    way = np.tan(turned) * arms[:, :1]
    return way[:, first:] - way[:, first - 1 : first]


@case(34, HALF, "way in 4.5 s under 5 and 15 N", unit="m", precisions=("float64",))
def creeps(engine, step, precision):
    """Half the limit holds; above it the finger slides off and turns away."""
    way = pulled(0.5, CREEPS, step, precision)
    assert np.abs(pulled(1.3, 0.5, step, precision)).max(1).min() > 5e-3, "it holds above its limit"
    last = np.abs(way[:, -1] - way[:, round(-way.shape[1] / CREEPS)]).max()
    return Found(np.abs(way).max(), 1e-3, f"{1e9 * last:.2g} nm in the last second")
