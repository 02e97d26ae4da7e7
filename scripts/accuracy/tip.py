"""Finger tips in a fast motion in the air, against MuJoCo C with a short step and many links."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from codesign_jax import model, rollout
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import world_model
from codesign_jax.scene import Scene, load, parameters
from scripts.accuracy.budget import VARIANTS
from scripts.shared import output, provenance, work

# A quick grasp in the air: the arm comes down in 0.3 s, the fingers are inflated in the next 0.3 s,
# and the hand is shaken. Nothing touches, and no world ends early.
IN_THE_AIR = {
    "effects": {
        **dict.fromkeys(("finger_finger", "finger_palm", "finger_object", "finger_table"), False),
        **dict.fromkeys(("palm_object", "palm_table", "ungrasp"), False),
    },
    "phases": {"approach": 0.3, "inflate": 0.6, "lift": 0.9, "disturb": 2.4, "ungrasp": 3.0},
    "cost": {"lost_distance": 1.0},
}
EVERY = 0.02
"""Time between compared states [s]: a multiple of every time step."""
HANDS, SECONDS = 12, 2.4
REFERENCE = (1e-4, 40, "least")
"""Time step [s], links and damping of the motion that stands for the truth, by MuJoCo C."""


def motion(
    setting: tuple[float, int, str], engine: str = "structured", hands: int = HANDS,
    seconds: float = SECONDS,
) -> np.ndarray:  # fmt: skip
    """Tips of hands in the air [m], shape (hand, time, finger, 3), every `EVERY` from the start."""
    step, links, damping = setting
    sizes = {"timestep": step, "links": links, "spring_damping": damping}
    scene = load("paper", overrides={**IN_THE_AIR, "discretization": sizes})
    stride, count = round(EVERY / step), round(seconds / step)
    vectors = np.asarray(work.designs(scene, hands))
    drawn = rollout.sample_trials(scene, jax.random.key(work.SEED), work.TRIALS)
    with jax.enable_x64(engine == "mujoco"):
        float_type = np.float64 if engine == "mujoco" else np.float32
        params = jax.vmap(lambda v: parameters.unflatten(scene.hand, v))(vectors)
        trials = jax.tree.map(lambda x: np.asarray(x)[np.arange(hands) % work.TRIALS], drawn)
        cast = lambda x: np.asarray(x).astype(float_type) if x.dtype.kind == "f" else x  # noqa: E731
        made = work.inputs(scene, work.Worlds(*jax.tree.map(cast, (params, trials))))
        fields, ctrl = jax.tree.map(np.asarray, made)
        ctrl = ctrl[:, :count]
        if engine != "mujoco":
            run = jax.jit(
                lambda f, c: make_engine(engine, scene).rollout(f, c, trajectory=True).qpos
            )
            qpos = np.asarray(run(fields, ctrl)[:, ::stride], np.float64)

    def of_world(world: int) -> np.ndarray:
        compiled = world_model(scene, jax.tree.map(lambda x: x[world], fields))
        if engine != "mujoco":
            return np.array([tips(scene, compiled, state) for state in qpos[world]])
        # The object on the table is the only contact: without it there is nothing to solve.
        compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data, found = mujoco.MjData(compiled), []
        data.qpos[:] = fields.start[world]
        for k in range(ctrl.shape[1]):
            if k % stride == 0:
                found.append(tips(scene, compiled, data.qpos))
            data.ctrl[:] = ctrl[world, k]
            mujoco.mj_step(compiled, data)
        return np.array(found)

    return np.array(_each(of_world, hands))


def _each(function: Callable[[int], Any], count: int) -> list[Any]:
    """Results of worlds in threads: MuJoCo frees Python's lock."""
    with ThreadPoolExecutor(min(len(os.sched_getaffinity(0)), count)) as pool:
        return list(pool.map(function, range(count)))


def tips(scene: Scene, compiled: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Finger tips of a state [m], shape (finger, 3), on the bottom layer."""
    data, last = mujoco.MjData(compiled), model.layout(scene).bodies[:, -1]
    data.qpos[:] = qpos
    mujoco.mj_kinematics(compiled, data)
    # A half segment follows the last joint; its centre of mass lies halfway along it.
    along = 2 * compiled.body_ipos[last, 0]
    return data.xpos[last] + data.xmat[last].reshape(-1, 3, 3)[:, :, 0] * along[:, None]


def error(found: np.ndarray, exact: np.ndarray) -> float:
    """Root mean square distance of tips [mm]."""
    return float(1e3 * np.sqrt((np.linalg.norm(found - exact, axis=-1) ** 2).mean()))


def measure(folder: Path, commit: str | None) -> None:
    """Writes the error of every variant's step, links and damping to tips.json."""
    named = {}
    for name, variant in VARIANTS.items():
        found = variant.scene().discretization
        named[name] = (found.timestep, found.links, found.spring_damping)
    exact = motion(REFERENCE, "mujoco")
    errors = {s: error(motion(s), exact) for s in dict.fromkeys(named.values())}
    content = {"tip_rms_mm": {n: errors[s] for n, s in named.items()}}
    output.write_json(folder / "tips.json", content | {"made": provenance.measurement(commit)})
