"""Finger tips before first contact: against the elastica, and in motion against the reference."""

from typing import Any

import mujoco
import numpy as np

from scripts.accuracy import oracle, worlds
from scripts.accuracy.settings import Setting

# A quick grasp in the air: the arm comes down in 0.3 s, the fingers are inflated in the next 0.3 s,
# and the hand is shaken. Nothing touches, and no world ends early.
IN_THE_AIR = {
    "effects": {
        "finger_object": False,
        "finger_table": False,
        "palm_object": False,
        "palm_table": False,
        "ungrasp": False,
    },
    "phases": {"approach": 0.3, "inflate": 0.6, "lift": 0.9, "disturb": 2.4, "ungrasp": 3.0},
    "cost": {"lost_distance": 1.0},
}
EVERY = 0.02
"""Time between compared states [s]: a multiple of every time step."""


def _inputs(setting: Setting, hands: int, seconds: float, dtype: type):
    """Scene in the air, fields and controls of its first seconds."""
    scene = setting.scene(IN_THE_AIR)
    chosen = worlds.paired(worlds.designs(scene, hands), worlds.trials(scene, 6))
    fields, ctrl = worlds.inputs(scene, chosen, dtype)
    return scene, fields, ctrl[:, : round(seconds / scene.discretization.timestep)]


def exact(setting: Setting, hands: int, seconds: float) -> np.ndarray:
    """Tips by MuJoCo C; see `motion`."""
    with worlds.floats(True) as dtype:
        scene, fields, ctrl = _inputs(setting, hands, seconds, dtype)
    stride = round(EVERY / scene.discretization.timestep)
    shown = range(0, ctrl.shape[1], stride)

    def run(world: int) -> np.ndarray:
        found: list[np.ndarray] = []
        model = oracle.model_of(scene, fields, world)
        # The object on the table is the only contact: without it there is nothing to solve.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        visit = lambda m, d, _k: found.append(oracle.tips(scene, m, d))  # noqa: E731
        oracle.advance(model, fields.start[world], ctrl[world], shown, visit)
        return np.array(found)

    return np.array(oracle.each_world(run, hands))


def motion(setting: Setting, hands: int, seconds: float) -> np.ndarray:
    """Tips of hands in the air [m], shape (hand, time, finger, 3), every `EVERY` from the start.

    Args:
      setting: The setting.
      hands: Number of hands, in turn random and good ones.
      seconds: Simulated time.
    """
    if setting.engine == "mujoco":
        return exact(setting, hands, seconds)
    import jax

    with worlds.floats(setting.wide) as dtype:
        scene, fields, ctrl = _inputs(setting, hands, seconds, dtype)
        engine = setting.make(scene)
        run = jax.jit(lambda f, c: engine.rollout(f, c, trajectory=True).qpos)
        stride = round(EVERY / scene.discretization.timestep)
        qpos = np.asarray(run(fields, ctrl)[:, ::stride], np.float64)

    def place(world: int) -> np.ndarray:
        model = oracle.model_of(scene, fields, world)
        data, found = mujoco.MjData(model), []
        for state in qpos[world]:
            data.qpos[:] = state
            mujoco.mj_kinematics(model, data)
            found.append(oracle.tips(scene, model, data))
        return np.array(found)

    return np.array(oracle.each_world(place, hands))


def compare(tips: np.ndarray, reference: np.ndarray) -> dict[str, Any]:
    """Distances of tips from the reference's [mm]: root mean square over all, largest, by hand."""
    away = 1e3 * np.linalg.norm(tips - reference, axis=-1)
    by_hand = np.sqrt((away**2).mean((1, 2)))
    return {
        "tip_rms_mm": float(np.sqrt((away**2).mean())),
        "tip_max_mm": float(away.max()),
        "tip_rms_mm_by_hand": [round(float(v), 6) for v in by_hand],
    }
