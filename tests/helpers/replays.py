"""Frames of grasps for viewers."""

import mujoco
import numpy as np

from codesign_jax import model
from codesign_jax.report import animation
from codesign_jax.types import Outcome
from tests.helpers import grasps


def bent_grasp(the_scene):
    """Three frames of a hand with random joint angles, as a replay."""
    params, trial = grasps.hand_world(the_scene, length=0.11, height=0.018)
    data = mujoco.MjData(model.compile_model(the_scene, params, trial))
    turn = np.random.default_rng(0).uniform(-0.4, 0.4, (3, data.qpos.size - 7))
    qpos = np.tile(data.qpos, (3, 1))
    qpos[:, :-7] += turn
    return animation.Replay(params, trial, Outcome(*np.zeros(4)), qpos)
