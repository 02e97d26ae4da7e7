"""Closed forms of a beam beside MuJoCo's chain: what the number of links alone costs."""

import dataclasses

import mujoco
import numpy as np
from scipy import optimize, special

from codesign_jax import hand, model, morphology
from codesign_jax.accuracy.settings import merge
from codesign_jax.scene import Scene, load
from codesign_jax.types import Params, Trial

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
    scene = load("paper", overrides=merge(sizes, {"effects": off}))
    mount = hand.Finger(azimuth=0.0, spread=0.0, radius=0.0, tilt=0.0)
    wrist = hand.Wrist(1e5, 1e4, 1e3, 1e2)
    one = dataclasses.replace(scene.hand, finger=(mount,), wrist=wrist)
    return dataclasses.replace(scene, hand=one, gravity=0.0)


class Finger:
    """MuJoCo's chain of one finger; it is loaded until nothing moves."""

    def __init__(self, links: int):
        """Compiles the finger."""
        self.scene = finger_scene(links)
        self.links, self.last = links, model.layout(self.scene).bodies[0, -1]
        one, zero = np.ones(1), np.zeros(())
        params = Params(LENGTH * one, HEIGHT * one, WALL * one, zero, np.zeros(6), 0 * one)
        trial = Trial(np.int32(0), np.zeros(2), zero, np.zeros(2), np.ones(()), np.ones(()))
        self.model = model.compile_model(self.scene, params, trial)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[2] = self.data.ctrl[2] = 0.3
        material = self.scene.hand.material
        self.beam = morphology.beam(
            HEIGHT,
            WALL,
            width=self.scene.hand.section.width,
            shear_modulus=material.shear_modulus,
            density=material.density,
        )

    def tip(self) -> np.ndarray:
        """Tip in the frame of the finger's root [m], shape (3,); the data's kinematics are used."""
        d = self.data
        palm, frame = (d.xmat[b].reshape(3, 3) for b in (1, self.last))
        end = d.xpos[self.last] + frame @ [LENGTH / self.links / 2, 0, 0]
        return palm.T @ (end - d.xpos[1])

    def settle(self, load: float = 0.0, turn: float = 0.0, steps: int = 20_000) -> np.ndarray:
        """Tip at rest over L: lateral offset and axial shortening, shape (2,).

        Args:
          load: Dead transverse load at the tip, alpha = P L^2 / E I.
          turn: Angle to which the pressure bends the finger [rad].
          steps: Time steps after which it must be at rest.

        Raises:
          RuntimeError: If it is not.
        """
        m, d, force = self.model, self.data, load * self.beam.bending / LENGTH**2
        d.ctrl[6] = turn * self.beam.bending / LENGTH / self.beam.moment_per_pressure
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        for _ in range(steps):
            palm = d.xmat[1].reshape(3, 3)
            end, d.qfrc_applied[:] = d.xpos[1] + palm @ self.tip(), 0.0
            down = palm @ [0, 0, -force]
            mujoco.mj_applyFT(m, d, down, np.zeros(3), end, self.last, d.qfrc_applied)
            mujoco.mj_step(m, d)
            # The object, last in qvel, falls or rests; it is not what is waited for.
            if d.time > 0.1 and np.abs(d.qvel[:-6]).max() < 1e-9:
                break
        else:
            raise RuntimeError(f"a finger of {self.links} links did not come to rest")
        mujoco.mj_kinematics(m, d)
        x, _, z = self.tip() / LENGTH
        return np.array([-z, 1 - x])


def errors(links: int, loads: tuple[float, ...], turns: tuple[float, ...]) -> dict[str, float]:
    """Distance of the chain's tip from the closed form, over L, by name of the load."""
    found = {}
    for alpha in loads:
        tip = Finger(links).settle(load=alpha)
        found[f"elastica {alpha:g}"] = float(np.linalg.norm(tip - elastica(alpha)))
    finger = Finger(links)
    for turn in turns:  # in growing order: a jump would swing the finger through itself
        tip = finger.settle(turn=np.deg2rad(turn))
        found[f"arc {turn:g} deg"] = float(np.linalg.norm(tip - arc(np.deg2rad(turn))))
    return found
