"""How the arm is turned: one sign and one order of its angles, wherever an export has them.

The design's angles are those of Table I, of the console, of the studio and of control files.  The
model's hinge of the pitch turns the other way (`control.actuated`); only files for MuJoCo have it.

>>> from codesign_jax.export import pose
>>> fingers = pose.rotation(roll=0.0, yaw=0.0, pitch=90.0).apply([0, 0, -1])  # down at 0 degrees
>>> [round(float(v)) for v in fingers]
[1, 0, 0]
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from codesign_jax.model.layout import WRIST

ANGLES = ("roll", "yaw", "pitch")
"""The order in which the angles turn, and in which every table has them."""
CONVENTION = (
    "Frame: the table's, z up, origin on the table at the object's nominal place. At roll, yaw and "
    "pitch 0 the palm lies level, its fingers point down, finger base points are where the table "
    "of mounts has them. The arm is turned by roll about x, then by yaw about its own z axis, then "
    "by pitch about its own y axis. A positive roll swings the fingers towards +y, a positive "
    "pitch towards +x, a positive yaw turns the hand anticlockwise seen from above. So roll and "
    "yaw are right-handed and pitch is left-handed: a robot with right-handed angles takes minus "
    "pitch, R = Rx(roll) Rz(yaw) Ry(-pitch), or the quaternion, which needs no convention."
)
"""Sign and order of the angles in words."""


def rotation(roll: Any, yaw: Any, pitch: Any) -> Rotation:
    """Orientation of the arm frame, from its own axes to the table's.

    Args:
      roll: Angles [deg], of any one shape, as are the next two.
    """
    return Rotation.from_euler("XZY", np.stack([roll, yaw, -np.asarray(pitch)], -1), degrees=True)


def quaternion(roll: Any, yaw: Any, pitch: Any) -> np.ndarray:
    """The orientation as w, x, y, z with w >= 0, shape (..., 4); arguments as of `rotation`."""
    x, y, z, w = rotation(roll, yaw, pitch).as_quat(canonical=True).T
    return np.stack([w, x, y, z], -1)


def of_controls(controls: np.ndarray) -> np.ndarray:
    """Pose of the arm frame: x, y, z [mm], roll, yaw, pitch [deg], shape (time, 6).

    Args:
      controls: A model's controls in SI units, shape (time, nu), whose first columns are `WRIST`.
    """
    pose = controls[:, : len(WRIST)] * ([1e3] * 3 + [180 / np.pi] * 3)
    pose[:, WRIST.index("pitch")] *= -1
    return pose
