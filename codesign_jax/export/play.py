"""Plays exported grasps in plain MuJoCo: python play.py box.xml (or box.mjb; several at once)."""

import os
import sys

import mujoco
import numpy as np


def play(model, controls):
    """Simulates a grasp; returns when the object was lost [s], and distances and states."""
    data = mujoco.MjData(model)
    times = controls[:, 0]
    record = []
    weights = model.numeric("hand_centre").data  # of the bodies, in the centre of the hand
    lost, begin, end = model.numeric("lost").data  # from this distance [m] and in these time steps
    mujoco.mj_resetDataKeyframe(model, data, 0)  # the key frame "start"
    for row in controls:
        before = np.concatenate([data.qpos, data.qvel])
        data.ctrl = row[1:]
        mujoco.mj_step(model, data)  # leaves the bodies' centres of before the step in xipos
        away = np.linalg.norm(data.body("object").xipos - weights @ data.xipos)
        sound = np.nan if any(data.warning.number) else 1.0  # MuJoCo warns of bad numbers
        record.append(sound * np.array([away, *before]))
    distance = np.array(record)[:, 0]
    states = np.array(record)[:, 1:]
    steps = np.arange(len(times))
    away = (distance >= lost) & (steps >= begin) & (steps < end)
    return times[away][0] if away.any() else np.inf, distance, states


if __name__ == "__main__":
    if not sys.argv[1:] or not all(map(os.path.isfile, sys.argv[1:])):
        sys.exit(__doc__)
    for path in sys.argv[1:]:
        binary = path.endswith(".mjb")
        load = mujoco.MjModel.from_binary_path if binary else mujoco.MjModel.from_xml_path
        controls = np.loadtxt(path[:-4] + "_controls.csv", delimiter=",", skiprows=1)
        when, distance, _ = play(load(path), controls)
        kept = "failed: MuJoCo warned" if np.isnan(distance).any() else "kept"
        print(f"{path}: {kept if np.isinf(when) else f'lost at {when:.2f} s'}")
