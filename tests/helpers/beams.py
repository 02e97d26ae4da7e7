"""One finger of the package, built as every hand is, that rests under loads; the elastica."""

import dataclasses
import functools
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy import optimize, special

from codesign_jax import model
from codesign_jax.model import morphology
from codesign_jax.scene import hand
from codesign_jax.types import Params, Trial
from tests.helpers.grasps import off, pinch


@functools.cache
def finger_scene(
    links,
    *,
    bending_only=True,
    gravity=0.0,
    timestep=0.01,
    shear_modulus=70e3,
    beta=6e-3,
    damping="added",
):
    without = "finger_object finger_table palm_object palm_table"
    the_scene = pinch(
        "sphere",
        links,
        discretization__timestep=timestep,
        discretization__spring_damping=damping,
        **off(without + " lateral_bending twist" * bending_only),
    )
    one = dataclasses.replace(
        the_scene.hand,
        finger=(hand.Finger(azimuth=0.0, spread=0.0, radius=0.0, tilt=0.0),),
        wrist=hand.Wrist(1e5, 1e4, 1e3, 1e2),
        material=dataclasses.replace(
            the_scene.hand.material, shear_modulus=shear_modulus, damping_time=beta
        ),
    )
    return dataclasses.replace(the_scene, hand=one, gravity=gravity)


def elastica(load: float) -> tuple[float, float]:
    """How far a cantilever's tip moves down and back over L, by a dead load alpha = P L^2 / E I.

    Bisshopp and Drucker (1945).
    """

    def phi(k: float) -> float:
        return np.arcsin(1 / (k * np.sqrt(2)))

    def gap(k: float) -> float:
        return special.ellipk(k**2) - special.ellipkinc(phi(k), k**2) - np.sqrt(load)

    k = float(optimize.brentq(gap, np.sqrt(0.5) + 1e-12, 1 - 1e-12, xtol=1e-15))  # type: ignore[arg-type]
    w = 1 - 2 / np.sqrt(load) * (special.ellipe(k**2) - special.ellipeinc(phi(k), k**2))
    u = 1 - np.sqrt(2 * np.sin(np.arcsin(2 * k**2 - 1)) / load)
    return float(w), float(u)


class Finger:
    """MuJoCo's chain of one finger; loads act at the tip's bottom layer."""

    def __init__(
        self, links: int, length: float = 0.1, height: float = 0.02, wall: float = 0.005, **options
    ):
        """Compiles the finger of `finger_scene`, 0.3 m above the table; dimensions in m."""
        self.scene = scene = finger_scene(links, **options)
        self.layout, self.length, self.links = model.layout(scene), length, links
        one, zero = np.ones(1), np.zeros(())
        params = Params(length * one, height * one, wall * one, zero, np.zeros(6), 0 * one)
        trial = Trial(np.int32(0), np.zeros(2), zero, np.zeros(2), np.ones(()), np.ones(()))
        self.model = model.compile_model(scene, params, trial)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[2] = self.data.ctrl[2] = 0.3
        material = scene.hand.material
        self.beam = morphology.beam(
            height,
            wall,
            width=scene.hand.section.width,
            shear_modulus=material.shear_modulus,
            density=material.density,
        )

    def tip(self) -> tuple[np.ndarray, np.ndarray]:
        """Position [m], (3,), and orientation, (3, 3), of the tip in the frame of the root."""
        palm, frame = (self.data.xmat[b].reshape(3, 3) for b in (1, self.layout.bodies[0, -1]))
        return palm.T @ (self._end() - self.data.xpos[1]), palm.T @ frame

    def _end(self) -> np.ndarray:
        d, last = self.data, self.layout.bodies[0, -1]
        return d.xpos[last] + d.xmat[last].reshape(3, 3) @ [self.length / self.links / 2, 0, 0]

    def settle(
        self,
        force: Sequence[float] = (0, 0, 0),
        torque: Sequence[float] = (0, 0, 0),
        pressure: float = 0.0,
        steps: int = 3000,
        rest: float = 1e-10,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The tip under a load of fixed direction in the palm's frame, at rest to rounding."""
        m, d, last = self.model, self.data, self.layout.bodies[0, -1]
        d.ctrl[6] = pressure
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        for _ in range(steps):
            palm, d.qfrc_applied[:] = d.xmat[1].reshape(3, 3), 0.0
            load = palm @ force, palm @ torque
            mujoco.mj_applyFT(m, d, *load, self._end(), last, d.qfrc_applied)
            mujoco.mj_step(m, d)
            # The object, last in qvel, falls or rests; it is not what is waited for.
            if d.time > 0.1 and np.abs(d.qvel[:-6]).max() < rest:
                break
        else:
            raise RuntimeError(f"a finger of {self.links} links did not come to rest")
        mujoco.mj_kinematics(m, d)
        return self.tip()
