"""Closed forms of a beam beside MuJoCo's chain: what the number of links alone costs."""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy import optimize, special

from codesign_jax import model
from codesign_jax.model import morphology
from codesign_jax.scene import Scene, hand, load
from codesign_jax.types import Params, Trial
from scripts.accuracy.settings import merge

LENGTH, HEIGHT, WALL = 0.1, 0.02, 0.005
"""Dimensions of the finger [m]; errors relative to the length do not depend on them."""


def elastica(load: float) -> tuple[float, float]:
    """Tip of a cantilever under a dead transverse load (Bisshopp and Drucker 1945).

    Args:
      load: alpha = P L^2 / E I.

    Returns:
      Transverse deflection and axial shortening, both over L.
    """

    def phi(k: float) -> float:
        return np.arcsin(1 / (k * np.sqrt(2)))

    def gap(k: float) -> float:
        return special.ellipk(k**2) - special.ellipkinc(phi(k), k**2) - np.sqrt(load)

    k = float(optimize.brentq(gap, np.sqrt(0.5) + 1e-12, 1 - 1e-12, xtol=1e-15))  # type: ignore[arg-type]
    w = 1 - 2 / np.sqrt(load) * (special.ellipe(k**2) - special.ellipeinc(phi(k), k**2))
    u = 1 - np.sqrt(2 * np.sin(np.arcsin(2 * k**2 - 1)) / load)
    return float(w), float(u)


def arc(turn: float) -> tuple[float, float]:
    """Tip of a beam bent by a moment to an arc: lateral offset and axial shortening, over L.

    Args:
      turn: Angle of the tip [rad], M L / E I.
    """
    return (1 - np.cos(turn)) / turn, 1 - np.sin(turn) / turn


def finger_scene(links: int) -> Scene:
    """One horizontal finger on a stiff wrist that bends only, without gravity or contact."""
    off = dict.fromkeys(
        ("lateral_bending", "twist", "finger_object", "finger_table", "palm_object", "palm_table"),
        False,
    )
    # The dead load's own stiffness is explicit: a short step keeps it stable.
    sizes = {"discretization": {"links": links, "timestep": 0.002}}
    off = off | {"surface": "spheres", "finger_finger": False, "finger_palm": False}
    scene = load("paper", overrides=merge(sizes, {"effects": off}))
    mount = hand.Finger(azimuth=0.0, spread=0.0, radius=0.0, tilt=0.0)
    wrist = hand.Wrist(1e5, 1e4, 1e3, 1e2)
    one = dataclasses.replace(scene.hand, finger=(mount,), wrist=wrist)
    return dataclasses.replace(scene, hand=one, gravity=0.0)


class Finger:
    """MuJoCo's chain of one finger; loads act at the tip's bottom layer.

    Attributes:
      scene: The scene.
      layout: Where things are in the model.
      model: MuJoCo's model.
      data: Its state.
      length: Length of the finger [m].
      links: Number of segments.
      beam: Its properties as a beam.
    """

    def __init__(
        self, scene: Scene, length: float = LENGTH, height: float = HEIGHT, wall: float = WALL
    ):
        """Compiles the finger of a scene, 0.3 m above the table; dimensions in m."""
        self.scene, self.layout = scene, model.layout(scene)
        self.length, self.links = length, scene.discretization.links
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
        *,
        steps: int = 20_000,
        rest: float = 1e-9,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The tip, see `tip`, under a load of fixed direction, after steps until nothing moves.

        Args:
          force: Force on the tip in the palm's frame [N], shape (3,).
          torque: Moment on it [N m], shape (3,).
          pressure: Pressure [Pa].
          steps: Time steps after which it must be at rest.
          rest: Largest speed at rest [rad/s or m/s].

        Raises:
          RuntimeError: If it is not at rest.
        """
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


def errors(links: int, loads: tuple[float, ...], turns: tuple[float, ...]) -> dict[str, float]:
    """Distance of the chain's tip from the closed form, over L, by name of the load.

    Args:
      links: Number of segments.
      loads: Dead transverse loads at the tip, alpha = P L^2 / E I.
      turns: Angles to which the pressure bends the finger [deg], growing.
    """
    found = {}
    for alpha in loads:
        finger = Finger(finger_scene(links))
        load = alpha * finger.beam.bending / LENGTH**2
        found[f"elastica {alpha:g}"] = _away(finger.settle(force=(0, 0, -load)), elastica(alpha))
    finger = Finger(finger_scene(links))
    for turn in turns:  # in growing order: a jump would swing the finger through itself
        angle = np.deg2rad(turn)
        pressure = angle * finger.beam.bending / LENGTH / finger.beam.moment_per_pressure
        found[f"arc {turn:g} deg"] = _away(finger.settle(pressure=pressure), arc(angle))
    return found


def _away(tip: tuple[np.ndarray, np.ndarray], exact: tuple[float, float]) -> float:
    """Distance of a tip from a lateral offset and an axial shortening, over L."""
    x, _, z = tip[0] / LENGTH
    return float(np.hypot(-z - exact[0], 1 - x - exact[1]))
