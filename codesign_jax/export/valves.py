"""Pressures of the key frames as a short table for regulators."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from codesign_jax.export.tables import write_table
from codesign_jax.model import morphology
from codesign_jax.scene import InputError, Scene, key_frames
from codesign_jax.scene.hand_tables import partition
from codesign_jax.types import Params

VALVES = "valves.csv"


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


def lines(scene: Scene, params: Params) -> list[tuple[int, ...]]:
    """Fingers of each pressure line; the first fingers of the lines ascend.

    Raises:
      InputError: If the design has more pressures than the hand has lines.
    """
    count = scene.num_fingers
    valves = scene.hand.valves
    if most := valves.searched(count):
        courses: dict[tuple[float, ...], list[int]] = {}
        for finger, course in enumerate(key_pressures(scene, params)[:, 1:].T):
            courses.setdefault(tuple(np.round(course, 4)), []).append(finger)
        groups = [tuple(fingers) for fingers in courses.values()]
        if len(groups) > most:
            words = f"the design needs {len(groups)} pressure lines, and the hand has valves.lines"
            raise InputError.of("geometry", f"{words} = {most}")
        return groups
    return partition(valves.known(count), count)


def name_of(line: int, fingers: Sequence[int]) -> str:
    """A line's name on the build sheet: that of its finger, or its number and its fingers."""
    if len(fingers) == 1:
        return f"finger {fingers[0]}"
    return f"line {line} (fingers {', '.join(map(str, fingers))})"


def line_pressures(scene: Scene, params: Params) -> np.ndarray:
    """Time [s] and commanded pressure of each line [kPa], shape (row, 1 + line)."""
    first = [min(fingers) for fingers in lines(scene, params)]
    rows = key_pressures(scene, params)
    return rows[:, [0, *(1 + k for k in first)]]


def line_limits(scene: Scene, params: Params) -> np.ndarray:
    """Limit of each line's pressure by the walls of its fingers [kPa], shape (line,)."""
    limits = 1e-3 * np.asarray(morphology.pressure_limits(scene.hand, params))
    return np.array([limits[[*fingers]].min() for fingers in lines(scene, params)])


def _times(scene: Scene, params: Params) -> np.ndarray:
    return np.asarray(key_frames.times(scene, params)) + scene.phases.settle


def write(folder: Path, scene: Scene, params: Params) -> Path:
    """Writes the table of the pressure lines."""
    rows = line_pressures(scene, params)
    head = ["time_s", *(f"pressure_{i}_kPa" for i in range(rows.shape[1] - 1))]
    return write_table(folder / VALVES, head, [[f"{v:.9g}" for v in row] for row in rows])
