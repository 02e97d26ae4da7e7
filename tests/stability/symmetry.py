"""Hard case 21: a scene that is mirrored or turned is the same scene."""

import functools

import numpy as np
from scipy.spatial.transform import Rotation

from codesign_jax import model
from tests.helpers import grasps
from tests.stability.bench import bench, pinch
from tests.stability.table import Found, case_of_both_scenes

LIFTED = 4.5
"""End of the lift [s]: the object hangs in the hand.  The shaking would turn the arm, whose Euler
angles are not covariant."""

EXACT = {"solver__tolerance": 1e-16, "solver__iterations": 100}
EXACTLY = {"float32": 1e-10, "float64": 1e-24}
"""Newton decrement of the structured engine at which only rounding is left."""

SUNK = 1e-4
"""Depth of the object in the table at the start [m]: at zero, rounding decides whether they touch,
and an object that falls for a step is g h^2 = 1 mm lower."""

SAME = {"float32": 1e-4, "float64": 1e-9}
"""Largest difference of places [m or rad].  In float32 the object is 0.2 m below the palm, whose
frame the engine computes in."""


DIFFERENCE = "largest difference of places"


@functools.cache
def rigid(name):
    """Without the wrist, whose springs act on Euler angles: no frame is special."""
    return pinch(name, effects__wrist=False, **EXACT)


def asymmetric(b):
    """Fields, controls and start of a grasp off the middle, tilted and turned, without spread."""
    params, trial = grasps.hand_world(b.scene, length=0.09, pressure=150e3, spread=0.0)
    params = params._replace(
        length=np.array([0.090, 0.094]), arm=params.arm + 0.05 * (np.arange(6) == 2)
    )
    trial = trial._replace(
        position=np.array([0.003, 0.002]), yaw=np.array(0.2), arm_tilt=np.array([0.05, 0.03])
    )
    fields = b.fields([params], [trial])
    fields.start[0, -5] -= SUNK
    return fields, b.commands([params], [trial])[:, : round(LIFTED / b.h)]


def compare(b, image, engine_places, bound=None) -> Found:
    """Runs a grasp and its image, both at rest at the start.

    Args:
      b: The bench.
      image: Function of poses (..., 6) of the wrist and of qpos to those of the image.
      engine_places: Function of qpos of the first run to qpos of the second one.
      bound: Bound on the difference instead of `SAME`.
    """
    fields, ctrl = asymmetric(b)
    turned = ctrl.copy()
    turned[..., :6] = image(ctrl[..., :6])
    start = engine_places(fields.start)
    original = b.run(fields, ctrl)
    copy = b.run(fields, turned, start)
    difference = np.abs(engine_places(original.qpos) - copy.qpos).max()
    lifted = original.object[0, -1, 2] - original.object[0, 0, 2]
    assert lifted > 0.1, "the object stayed behind: the case would be vacuous"
    bound = bound or SAME["float64" if b.wide else "float32"]
    return Found(difference, bound, "to the end of the lift")


def mirror_pose(pose):
    """y to -y: a pose (..., x, y, z, roll, yaw, pitch)."""
    return pose * np.array([1, -1, 1, -1, -1, 1])


@case_of_both_scenes(21, "mirrored scene", DIFFERENCE, unit="m or rad")
def mirrored(name, engine, step, precision):
    """Mirrored in the plane of the two fingers: each is its own image."""
    b = bench(rigid(name), engine, step, precision, EXACTLY[precision])
    dofs = model.layout(b.scene).dofs

    def places(qpos):
        image = np.array(qpos, float)
        image[..., :6] = mirror_pose(image[..., :6])
        image[..., dofs[..., 1:].ravel()] *= -1  # lateral bending and twist
        image[..., -7:] *= [1, -1, 1, 1, -1, 1, -1]
        return image

    return compare(b, mirror_pose, places)


TURN = Rotation.from_euler("z", 37, degrees=True)


def turn_pose(pose):
    """A pose about the vertical axis through the origin."""
    flat = np.reshape(pose, (-1, 6))
    turned = (TURN * Rotation.from_euler("XZY", flat[:, 3:])).as_euler("XZY")
    return np.concatenate([TURN.apply(flat[:, :3]), turned], 1).reshape(np.shape(pose))


@case_of_both_scenes(21, "scene turned by 37 degrees", DIFFERENCE, unit="m or rad")
def turned(name, engine, step, precision):
    """Turned by 37 degrees, which no float is exact in."""
    b = bench(rigid(name), engine, step, precision, EXACTLY[precision])

    def places(qpos):
        image = np.array(qpos, float)
        image[..., :6] = turn_pose(image[..., :6])
        shape = image.shape[:-1]
        last = image[..., -7:].reshape(-1, 7)
        spun = TURN * Rotation.from_quat(last[:, [4, 5, 6, 3]])
        quat = spun.as_quat()[:, [3, 0, 1, 2]]
        quat *= np.sign((quat * quat[:1]).sum(1))[:, None] * np.sign(quat[0, 0])
        image[..., -7:] = np.c_[TURN.apply(last[:, :3]), quat].reshape(*shape, 7)
        return image

    # MuJoCo C has a wrist of 1e9 kg in the place of none: 1e-16 of that weighs on the joints.
    return compare(b, turn_pose, places, bound=1e-6 if engine == "mujoco" else None)
