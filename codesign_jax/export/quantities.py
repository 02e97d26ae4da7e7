"""Numbers of the build sheet: what a hand takes of silicone, thread, air, screws and force."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from codesign_jax.export import arm, valves
from codesign_jax.export.process import BACK, Printed, Size
from codesign_jax.model import morphology
from codesign_jax.model.layout import mounts
from codesign_jax.scene import Scene, silicones
from codesign_jax.scene.hand import Material
from codesign_jax.scene.hand_tables import THREAD_PITCH
from codesign_jax.scene.silicones import Silicone
from codesign_jax.types import Params

PITCH = 1e3 * THREAD_PITCH
"""A turn of a thread that is wound there and back along a finger [mm]."""
FIRST_INFLATION = 0.2
"""Pressure at which the bend test begins, over the design's [chosen]: by the law of sections a
finger may bend several times further than by beam theory."""
SPARE = 0.2
"""Thread beyond what is wound, for ends and a second try, as a share [chosen]."""
LOSS = 0.15
"""Silicone that stays in cups and on moulds, as a share of what is cast [chosen]."""
ATMOSPHERE = 101.325
"""Standard pressure, at which flows are given [kPa]."""
REGULATORS = {100.0: "SMC ITV0010", 500.0: "SMC ITV0030", 900.0: "SMC ITV0050"}
"""Proportional regulators by the end of their range [kPa] (SMC's catalogue, series ITV)."""
PLASTIC = 1.24e-3
"""Density of printed PLA [g/mm^3]."""
ENGAGED = 8.0
"""Length of thread in the flange that is aimed at [mm] [chosen], within half a step of 5 mm."""
GRAVITY = 9.81
"""Acceleration of a test mass [m/s^2]."""


class FlangeScrews(NamedTuple):
    """Screws between palm and wrist."""

    thread: str
    length: float  # [mm]
    counterbore: float  # depth that their heads are sunk [mm]; 0: they stand on the underside
    clamped: float  # thickness of palm below the head [mm]
    diameter: float  # of their circle [mm]
    angle: float  # of the first one from the palm's x axis [deg]


def fabric(size: Size) -> tuple[float, float]:
    """Length and width of a finger's strip of fabric with the flap under the clamp bar [mm]."""
    behind = size.at(-size.root).height + BACK
    return size.length + size.root + behind, max(size.base.width, size.tip.width)


def thread(sizes: Sequence[Size]) -> float:
    """Thread that is wound around the fingers [m]."""
    middle = [(size, size.at(size.length / 2)) for size in sizes]
    return sum(2 * z.length / PITCH * 2 * (m.width + m.height) for z, m in middle) / 1e3


def bottom(size: Size) -> float:
    """Volume of a finger's bottom wall, which is cast by itself [mm^3]."""
    start, end = size.ends
    middle = (start + end) / 2
    areas = [s.width * s.wall for s in map(size.at, (start, middle, end))]
    return (end - start) * (areas[0] + 4 * areas[1] + areas[2]) / 6


def silicone_of(material: Material) -> Silicone | None:
    """The silicone that a hand names, or None where its material is numbers alone."""
    return silicones.get(material.silicone) if material.silicone else None


def nearest_silicone(material: Material, *, neo_hookean: bool) -> Silicone:
    """The silicone whose walls bend most like the hand's, by the ratio of their moduli.

    Args:
      material: The hand's.
      neo_hookean: Whether the hand's modulus belongs to the neo-Hookean law, as in its scene.
    """
    mine = material.shear_modulus
    if not neo_hookean:
        mine *= silicones.EQUAL_BEND  # the silicones' law is the neo-Hookean one

    def distance(other: Silicone) -> float:
        return max(mine / other.shear_modulus, other.shear_modulus / mine)

    return min(silicones.SILICONES.values(), key=distance)


def flows(scene: Scene, params: Params, sizes: Sequence[Size]) -> np.ndarray:
    """Air that fills each chamber as fast as is commanded, as wide as at rest [l/min, ANR].

    The volume of a chamber times the rise of its pressure over the standard pressure; shape
    (finger,).
    """
    rows = valves.key_pressures(scene, params)
    spans = np.diff(rows[:, 0])
    rises = np.diff(rows[:, 1:], axis=0)[spans > 0] / spans[spans > 0, None]
    litres = np.array([size.chamber_volume for size in sizes]) * 1e-6
    return 60 * litres * np.maximum(0.0, rises.max(0)) / ATMOSPHERE


def regulator_range(highest: float) -> float:
    """End of the smallest range of regulators that reaches a pressure [kPa]."""
    return next((v for v in REGULATORS if v >= highest), highest)


def flange_screws(thickness: float, printed: Printed | None) -> FlangeScrews | None:
    """Screws of the palm of a thickness [mm] to the wrist; None where there is no room for them."""
    if not printed or not printed.flange:
        return None
    diameter, thread_name, angle, sunk = printed.flange
    # The counterbore is as deep as the head, of the thread's diameter, and half a millimetre.
    counterbore = float(thread_name.removeprefix("M")) + 0.5 if sunk else 0.0
    clamped = thickness - counterbore
    length = 5 * math.floor((clamped + ENGAGED + 2.5) / 5)
    return FlangeScrews(thread_name, length, counterbore, clamped, diameter, angle)


def limit_strains(scene: Scene, params: Params) -> np.ndarray:
    """Strain of a free finger's upper wall at its limit of pressure, shape (finger,).

    Curvature times height, kappa h, of fingers without taper.
    """
    limits = morphology.pressure_limits(scene.hand, params)
    law = bool(scene.effects.neo_hookean)
    full = params._replace(pressure=limits)
    bends = np.asarray(morphology.free_bends(scene.hand, full, neo_hookean=law))
    return np.abs(bends) * np.asarray(params.height) / np.asarray(params.length)


def hand_mass(scene: Scene, sizes: Sequence[Size]) -> float:
    """Mass of the palm with what it bears, and of the fingers in front of it [kg]."""
    inside = sum(size.root * size.base.width * size.base.height for size in sizes)
    cast = sum(size.volume for size in sizes) - inside
    return scene.hand.palm.mass + 1e-9 * cast * scene.hand.material.density


def sag(scene: Scene, sizes: Sequence[Size]) -> float:
    """How far the hand's weight lowers the compliant wrist [mm]; 0 for a rigid one."""
    if not scene.effects.wrist:
        return 0.0
    return 1e3 * hand_mass(scene, sizes) * scene.gravity_on / scene.hand.wrist.linear_stiffness


def rim_clearance(scene: Scene, params: Params) -> tuple[float, float]:
    """Lowest height of the palm's rim over the table, as commanded [mm], and its time [s]."""
    poses = arm.key_poses(scene, params)
    radius = 1e3 * scene.hand.palm.radius
    heights = poses[:, 3] - radius * np.sqrt(np.maximum(0.0, 1.0 - arm.upward(poses) ** 2))
    lowest = int(np.argmin(heights))
    return float(heights[lowest]), float(poses[lowest, 0])


def tip_heights(scene: Scene, params: Params, corners: np.ndarray) -> np.ndarray:
    """Lowest heights of the straight fingers' tips over the table, as commanded [mm], (finger,).

    Args:
      scene: The scene.
      params: The design.
      corners: As of `sheet.corners`.
    """
    heights = []
    for _, _, _, z, roll, pitch, yaw in arm.key_poses(scene, params):
        turn = arm.pose.rotation(roll=roll, yaw=yaw, pitch=pitch).as_matrix()
        heights.append(z + (corners[:, 4:] @ turn[2]).min(1))
    return np.min(heights, 0)


def drop(scene: Scene, params: Params) -> tuple[float, float]:
    """From which height the object falls when the chambers are emptied [mm], and when [s].

    0 mm where no chamber is filled.
    """
    poses = arm.key_poses(scene, params)
    pressures = valves.key_pressures(scene, params)
    full = pressures[:, 1:].max(1) > 0
    if not full.any():
        return 0.0, 0.0
    end = float(pressures[full, 0][-1])
    height = np.interp(end, poses[:, 0], poses[:, 3]) - poses[:, 3].min()
    return float(height), end


def base_frames(scene: Scene, params: Params) -> tuple[np.ndarray, np.ndarray]:
    """Base points [m] and azimuths [rad] of the fingers, shape (finger, 2) and (finger,)."""
    position, _ = mounts(scene.hand, np.asarray(params.spread))
    azimuth = [np.radians(f.azimuth) + f.spread * float(params.spread) for f in scene.hand.finger]
    return np.asarray(position)[:, :2], np.array(azimuth)
