"""The arm's path: poses of the key frames, commands.csv, speeds, and the room behind the palm."""

import csv
import dataclasses
from pathlib import Path

import numpy as np

from codesign_jax.export import grasps, pose, tables
from codesign_jax.model.layout import WRIST
from codesign_jax.scene import Scene, key_frames
from codesign_jax.types import Params, Trial

COMMANDS = "commands.csv"
CLEARANCE = 5.0
"""Distance to the table that parts behind the palm keep [mm] [chosen]."""
LAST_LINK = 60.0
"""Radius of the last link of an arm [mm] [chosen]."""
LINK_LENGTH = 200.0
"""Length of the link, which counts where it points down [mm] [chosen]."""
LEAST_UPWARD = 0.05
"""Upward part of the palm's axis below which a spacer gains no height [chosen]."""

COLUMNS = {
    "time_s": "time from the start of the grasp",
    "phase": "approach, inflate, lift, disturb or ungrasp",
    "arm_x_mm": "position of the arm frame X_D, from the object's nominal place",
    "arm_y_mm": "likewise",
    "arm_z_mm": "height of the palm's underside above the table, if the wrist is not deflected",
    "arm_roll_deg": "orientation of X_D: turned about x by this angle, ...",
    "arm_yaw_deg": "... then about its own z, ...",
    "arm_pitch_deg": "... then about its own y; a positive angle, which is a left-handed turn, "
    "points the fingers towards +x, as in designs, control files and the build sheet",
    "arm_qw": "the same orientation as a unit quaternion w, x, y, z, for arms that take one",
    "arm_qx": "likewise",
    "arm_qy": "likewise",
    "arm_qz": "likewise",
    "pressure_0_kPa": "gauge pressure in the chamber of finger 0; a column for each finger",
}
"""Meaning of the columns of commands.csv, a row for each time step."""


def still(scene: Scene) -> Scene:
    """The scene without the shaking that tests a grasp; its phases stay."""
    arm = dataclasses.replace(scene.arm, shake_amplitude=0.0, shake_acceleration=0.0)
    return dataclasses.replace(scene, arm=arm)


def write(folder: Path, scene: Scene, params: Params, trial: Trial) -> Path:
    """Writes commands.csv: poses in mm and degrees, and pressures in kPa, without the shaking."""
    schedule = grasps.timed_controls(still(scene), params, trial)
    poses = pose.of_controls(schedule[:, 1:])
    pressures = 1e-3 * schedule[:, 1 + len(WRIST) :]
    values = np.column_stack([poses, pose.quaternion(*poses[:, 3:].T), pressures])
    names, ends = zip(*scene.phase_ends.items(), strict=True)
    rows = []
    for time, row in zip(schedule[:, 0], values, strict=True):
        # A step belongs to the phase in which it begins; 1e-9 s is rounding of k h.
        phase = names[min(int(np.searchsorted(ends, time + 1e-9, "right")), len(names) - 1)]
        # float32 has 7 digits; + 0.0 writes -0 as 0.
        rows.append([f"{time:.9g}", phase, *(f"{v + 0.0:.7g}" for v in row)])
    head = [*COLUMNS][:-1] + [f"pressure_{i}_kPa" for i in range(scene.num_fingers)]
    return tables.write_table(folder / COMMANDS, head, rows)


def key_poses(scene: Scene, params: Params) -> np.ndarray:
    """Time [s] and pose of each key frame: x, y, z [mm], roll, pitch, yaw [deg], (frame, 7).

    Time counts from the start of the grasp, as in commands.csv: the object settles first.
    """
    poses = key_frames.poses(scene, params, numpy=np) * ([1e3] * 3 + [180 / np.pi] * 3)
    times = np.asarray(key_frames.times(scene, params)) + scene.phases.settle
    return np.column_stack([times, poses])


def speeds(path: Path) -> tuple[float, float]:
    """Largest speed [mm/s] and turning speed [deg/s] between the rows of a commands.csv."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    times = np.array([float(row["time_s"]) for row in rows])
    places = np.array([[float(row[f"arm_{axis}_mm"]) for axis in "xyz"] for row in rows])
    angles = [[float(row[f"arm_{name}_deg"]) for row in rows] for name in pose.ANGLES]
    turns = pose.rotation(*angles)
    steps = np.diff(times)
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1) / steps
    turned = np.degrees((turns[:-1].inv() * turns[1:]).magnitude()) / steps
    return float(moved.max()), float(turned.max())


def upward(poses: np.ndarray) -> np.ndarray:
    """Upward part of the palm's axis at each key frame."""
    turns = pose.rotation(roll=poses[:, 4], yaw=poses[:, 6], pitch=poses[:, 5])
    return turns.as_matrix()[:, 2, 2]


def spacer(scene: Scene, params: Params) -> float | None:
    """Length of a rod behind the palm that gives an arm's last link room above the table [mm].

    The link is a cylinder of radius `LAST_LINK` along the palm's axis.  A point of it at a
    distance s behind the palm's underside and r from its axis is at least
    z + s u - r sqrt(1 - u^2) above the table, with u the upward part of the axis and z the height
    of the arm frame.

    Returns:
      0 if no rod is needed, None if the palm's back points down, so that none helps.
    """
    poses = key_poses(scene, params)
    up = upward(poses)
    across = np.sqrt(np.maximum(0.0, 1.0 - up**2))
    above = poses[:, 3] + 1e3 * scene.hand.palm.thickness * up
    lacking = LAST_LINK * across + CLEARANCE - above
    down = up < LEAST_UPWARD
    if (lacking - np.minimum(0.0, LINK_LENGTH * up))[down].max(initial=0.0) > 0:
        return None
    return float(np.max(lacking[~down] / up[~down], initial=0.0))
