"""Pinch grasps with effects, beside MuJoCo C."""

import jax
import numpy as np

from codesign_jax.engines.mujoco import world_model
from tests.helpers import grasps


@jax.enable_x64(True)
def setting(effects, shape="box", **changes):
    """Scene, MuJoCo C's model, fields and controls of a pinch grasp, in float64.

    Effects are a dictionary, in which a key such as objects__noise.tilt may change other tables.
    """
    keys = {k if "__" in k else f"effects__{k}": v for k, v in effects.items()}
    scene = grasps.pinch(shape, **keys)
    world, trial = grasps.hand_world(scene, **changes)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, -0.002]))
    fields, ctrl = grasps.world_inputs(scene, world, trial)
    ctrl = np.asarray(ctrl)
    oracle = world_model(scene, fields)
    oracle.opt.tolerance, oracle.opt.iterations, oracle.opt.ls_iterations = 0.0, 200, 50
    return scene, oracle, fields, ctrl
