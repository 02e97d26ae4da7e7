"""MuJoCo C, which reads contacts and their forces off states."""

import mujoco
import numpy as np

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from tests.helpers import grasps


class Reader:
    """MuJoCo C's model of a world, which reads states and never steps."""

    def __init__(self, the_scene, fields, world=0):
        self.scene = the_scene
        self.lay = model.layout(the_scene)
        self.fields = grasps.nth(fields, world)
        self.model = world_model(the_scene, self.fields)
        self.model.opt.tolerance = 0.0
        self.model.opt.iterations = 200
        self.data = mujoco.MjData(self.model)
        self.armature = np.diag(self.model.dof_armature)

    def at(self, qpos, qvel=None, ctrl=None):
        """Sets a state and computes everything of it; returns MuJoCo's data."""
        d = self.data
        d.qpos[:] = qpos
        d.qvel[:] = 0.0 if qvel is None else qvel
        if ctrl is not None:
            d.ctrl[:] = ctrl
        mujoco.mj_forward(self.model, d)
        return d

    def kinetic(self, qpos, qvel, dofs):
        """Kinetic energy [J] of some velocities, without the inertia of implicit springs."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_crb(self.model, self.data)
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, full)
        moving = np.zeros(self.model.nv)
        moving[dofs] = np.asarray(qvel)[dofs]
        return 0.5 * moving @ (full - self.armature) @ moving

    def pushes(self):
        """Contacts of the present state: names of both geoms, normal force [N] and MuJoCo's row."""
        contacts = []
        force = np.zeros(6)
        for i, c in enumerate(self.data.contact):
            mujoco.mj_contactForce(self.model, self.data, i, force)
            names = [
                mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_GEOM, int(g)) for g in c.geom
            ]
            contacts.append((names, force[0], c))
        return contacts
