"""An object on its table under tilted gravity, by MuJoCo C."""

import mujoco
import numpy as np

from codesign_jax import model
from tests.helpers.grasps import hand_world, pinch

MASS = 0.1
GRAVITY = 9.81
MU = 0.5


class Table:
    """The object on its table, the hand high above, under gravity tilted by an angle.

    A flat object has its centre 3 mm above the table, so that a slope does not shift the load from
    one side of it to the other.
    """

    def __init__(self, shape, angle=0.0, *, flat=False, **settings):
        self.scene = pinch(shape, links=1, solver__tolerance=1e-12, **settings)
        params, trial = hand_world(self.scene)
        self.model = model.compile_model(self.scene, params, trial)
        tilted = [GRAVITY * np.sin(angle), 0, -GRAVITY * np.cos(angle)]
        self.model.opt.gravity[:] = tilted
        self.data = mujoco.MjData(self.model)
        # The wrist follows the arm; without it the tilted gravity would pull the hand down.
        self.data.qpos[2] = self.data.ctrl[2] = 1.0
        if flat:
            geom = model.layout(self.scene).object_geoms[0]
            self.model.geom_size[geom, {"box": 2, "cylinder": 1}[shape]] = 0.003
            self.data.qpos[-5] = 0.003

    def run(self, seconds):
        """Positions (time, 3) and velocities (time, 3) of the object."""
        rows = []
        for _ in range(round(seconds / self.model.opt.timestep)):
            mujoco.mj_step(self.model, self.data)
            rows.append([self.data.qpos[-7:-4].copy(), self.data.qvel[-6:-3].copy()])
        return np.array(rows).swapaxes(0, 1)
