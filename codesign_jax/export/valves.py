"""Pressures of the key frames as a short table, and the program that sends them to regulators."""

from pathlib import Path

import numpy as np

from codesign_jax.export.tables import write_table
from codesign_jax.model import morphology
from codesign_jax.scene import Scene, key_frames
from codesign_jax.types import Params

VALVES = "valves.csv"
PLAYER = Path(__file__).with_name("play_valves.py")


def key_poses(scene: Scene, params: Params) -> np.ndarray:
    """Time [s] and pose of each key frame: x, y, z [mm], roll, pitch, yaw [deg], (frame, 7).

    Time counts from the start of the grasp, as in commands.csv: the object settles first.
    """
    pose = np.asarray(key_frames.poses(scene, params)) * ([1e3] * 3 + [180 / np.pi] * 3)
    return np.column_stack([_times(scene, params), pose])


def key_pressures(scene: Scene, params: Params) -> np.ndarray:
    """Time [s] and commanded pressure of each finger [kPa], shape (row, 1 + finger).

    Pressures are linear between rows.  A key frame whose values are held has a row more, at the
    time of the next frame, so that two rows of one time are a jump.
    """
    times = _times(scene, params)
    terms = key_frames.pressures(scene, params)
    zero = np.zeros((len(times), scene.num_fingers))
    pressures = 1e-3 * sum((np.asarray(v) * np.asarray(f) for v, f in terms), start=zero)
    rows: list[np.ndarray] = []
    for k, (time, row) in enumerate(zip(times, pressures, strict=True)):
        if k and scene.control.frame[k - 1].interpolation == "held":
            rows.append(np.append(time, pressures[k - 1]))
        rows.append(np.append(time, row))
    return np.array(rows)


def _times(scene: Scene, params: Params) -> np.ndarray:
    return np.asarray(key_frames.times(scene, params)) + scene.phases.settle


def write(folder: Path, scene: Scene, params: Params) -> Path:
    """Writes the table with the limits of the fingers' walls, and the program beside it."""
    limits = 1e-3 * np.asarray(morphology.pressure_limits(scene.hand, params))
    head = ["time_s", *(f"pressure_{i}_kPa" for i in range(scene.num_fingers))]
    # Rounded upwards in the fourth digit behind the point: a pressure at its limit stays legal.
    rows = [["# limit kPa", *(f"{v + 5e-4:.3f}" for v in limits)], head]
    rows += [[f"{v:.9g}" for v in row] for row in key_pressures(scene, params)]
    (folder / PLAYER.name).write_text(PLAYER.read_text(encoding="utf-8"), encoding="utf-8")
    return write_table(folder / VALVES, rows[0], rows[1:])
