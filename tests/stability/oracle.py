"""MuJoCo C as the judge of single steps, and forces that it reads off states."""

import mujoco
import numpy as np

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from tests.helpers import grasps, oracles
from tests.stability.bench import bench
from tests.stability.table import Found

TIGHT = {"float32": 1e-10, "float64": 1e-24}
"""Newton decrement at which only a precision's rounding is left of a step's forces."""

ROUNDING = {"float32": 1e-4, "float64": 1e-8}
"""Relative error of accelerations.  Float64: a difference of velocities over a step loses two of 16
digits, and MuJoCo's own Newton stops at rounding of its cost.  Float32: places 0.1 m from the palm
are rounded to 1e-8 m, which a contact of 2 to 4 kN/m turns into 4e-5 N, and links weigh 5 g."""

STATES = 250
"""States of a world's path that are compared with MuJoCo C, spread evenly over it."""


def along(base, step, precision, make, least=1, rounding=1.0) -> Found:
    """Accelerations along whole paths of the structured engine against MuJoCo C.

    Args:
      base: The scene.
      step: Factor on its time step.
      precision: The precision.
      make: A bench to (fields, ctrl) or (fields, ctrl, qpos, qvel).
      least: Contacts that must exist at once somewhere, so that a path that touches nothing fails.
      rounding: Factor on float32's bound, where what it assumes does not hold.

    Returns:
      The largest relative error of all compared states, in float32 that of 19 of 20: rounding
      decides there whether a pair a few nanometres apart touches, and a contact's damping acts at
      once.
    """
    b = bench(base, "structured", step, precision, TIGHT[precision])
    fields, ctrl, *start = make(b)
    found = b.path(fields, ctrl, *start)
    stride = max(1, ctrl.shape[1] // STATES)
    errors, _, touching = oracles.against_mujoco(b.scene, fields, ctrl, found, stride)
    assert touching.max() >= least, "nothing touches: the case would be vacuous"
    error = errors.max() if precision == "float64" else np.quantile(errors, 0.95)
    note = f"{errors.size} states, up to {touching.max()} contacts"
    bound = ROUNDING[precision] * (rounding if precision == "float32" else 1.0)
    return Found(error if np.isfinite(found.qpos).all() else np.inf, bound, note)


class Reader:
    """MuJoCo C's model of a world, which reads states and never steps."""

    def __init__(self, the_scene, fields, world=0):
        self.scene, self.lay = the_scene, model.layout(the_scene)
        self.fields = grasps.nth(fields, world)
        self.model = world_model(the_scene, self.fields)
        self.model.opt.tolerance, self.model.opt.iterations = 0.0, 200
        self.data = mujoco.MjData(self.model)

    def at(self, qpos, qvel=None, ctrl=None):
        """Sets a state and computes everything of it; returns MuJoCo's data."""
        d = self.data
        d.qpos[:] = qpos
        d.qvel[:] = 0.0 if qvel is None else qvel
        if ctrl is not None:
            d.ctrl[:] = ctrl
        mujoco.mj_forward(self.model, d)
        return d

    def pushes(self):
        """Contacts of the present state: names of both geoms, normal force [N] and MuJoCo's row."""
        found, force = [], np.zeros(6)
        for i, c in enumerate(self.data.contact):
            mujoco.mj_contactForce(self.model, self.data, i, force)
            names = [
                mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_GEOM, int(g)) for g in c.geom
            ]
            found.append((names, force[0], c))
        return found
