"""MuJoCo C step by step: what the engines' common interface does not report."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import mujoco
import numpy as np

from codesign_jax.engines.mujoco import world_model
from codesign_jax.model import ModelFields, layout
from codesign_jax.scene import Scene

Visit = Callable[[mujoco.MjModel, mujoco.MjData, int], None]
"""Called with a world before step k, all fields of its data those of the state before it."""


def each_world(function: Callable[[int], Any], count: int) -> list[Any]:
    """Results of a function of the world's index, worlds in threads: MuJoCo frees Python's lock."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with ThreadPoolExecutor(min(cores or 1, count)) as pool:
        return list(pool.map(function, range(count)))


def model_of(scene: Scene, fields: ModelFields, world: int) -> mujoco.MjModel:
    """MuJoCo's model of one world of a batch of fields."""
    return world_model(scene, jax.tree.map(lambda x: x[world], fields))


def advance(
    model: mujoco.MjModel, start: np.ndarray, ctrl: np.ndarray, steps: Iterable[int], visit: Visit
) -> None:
    """Steps a world through its controls and shows it before some of the steps.

    Args:
      model: The world's model.
      start: Start qpos.
      ctrl: Controls, shape (time, nu).
      steps: Steps k, ascending, before which it is shown, the time step's forces computed; the
        number of controls means the end.
      visit: Sees it.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = start
    shown = iter([*steps, -1])
    following = next(shown)
    for k in range(len(ctrl) + 1):
        data.ctrl[:] = ctrl[min(k, len(ctrl) - 1)]
        if k == following:
            mujoco.mj_forward(model, data)
            visit(model, data, k)
            following = next(shown)
        if following < 0:
            return
        mujoco.mj_step(model, data)


def tips(scene: Scene, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Finger tips [m], shape (finger, 3), on the bottom layer, after `mj_kinematics`."""
    lay = layout(scene)
    last = lay.bodies[:, -1]
    # A half segment follows the last joint; its centre of mass lies halfway along it.
    along = 2 * model.body_ipos[last, 0]
    frames = data.xmat[last].reshape(-1, 3, 3)
    return data.xpos[last] + frames[:, :, 0] * along[:, None]


def grip(scene: Scene, model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Sum of the normal forces of fingers and palm on the object [N], after `mj_forward`."""
    contact, lay = data.contact, layout(scene)
    geoms = np.asarray(contact.geom)
    if not len(geoms):
        return 0.0
    on_object = np.isin(geoms, lay.object_geoms)
    other = np.where(on_object[:, :1], geoms[:, 1:], geoms[:, :1])[:, 0]
    touching = on_object.any(1) & (other != 0)  # geom 0 is the table
    rows = np.asarray(contact.efc_address)[touching]
    return float(data.efc_force[rows[rows >= 0]].sum())
