"""What can be built, as a constraint of a search: `[limits]` of a scene, projected onto designs.

Each limit of the table has a closed form in the parameters, or is the root of one, so that nothing
is simulated to hold it: a pressure is lowered, a length, an angle or the arm's height is clipped.
The projection is differentiable wherever it is not exactly at a limit.
"""

import dataclasses
import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import section_law, section_numbers
from codesign_jax.scene.beams import strain_pressure
from codesign_jax.scene.hand_tables import Hand
from codesign_jax.scene.schema import Problem
from codesign_jax.scene.tables import Arm, Limits
from codesign_jax.types import Params

FLAT = 1e-12
"""Squared sine of a palm's tilt below which its rim counts as level: its slope is infinite there,
and the rim of a palm of 0.1 m is 0.1 um higher than that."""
PLACES = np.linspace(0, 1, 9)
"""Places along a tapered finger, shares of its length, whose sections are looked at."""


@dataclasses.dataclass(frozen=True)
class Buildable:
    """The limits of a scene with the numbers of hand and arm that they need.

    Attributes:
      limits: The scene's.
      width: Width of the fingers' section, of tapered ones at the base [m].
      shear_modulus: Of the silicone, over `moment_factor` [Pa].
      neo_hookean: Whether the bending law is that of a neo-Hookean wall.
      palm_radius: Radius of the palm [m].
      zero_height: Height of the palm at which `arm_z` is zero [m].
      stiffness: Stiffness of the wrist's slides [N/m].
      top: Height of the tallest object on the table [m].
      hand: The hand, where its section's law is "elements", or None.
    """

    limits: Limits
    width: float
    shear_modulus: float
    neo_hookean: bool
    palm_radius: float
    zero_height: float
    stiffness: float
    top: float
    hand: Hand | None = None

    def bounds(self, name: str, low: float, high: float) -> tuple[float, float]:
        """The bounds of a parameter [SI] within the limits that concern it alone."""
        if name == "length" and self.limits.finger_length is not None:
            least, most = self.limits.finger_length
            return max(low, least), min(high, most)
        if name in ("arm_roll", "arm_pitch") and self.limits.arm_tilt is not None:
            most = float(np.radians(self.limits.arm_tilt))
            return max(low, -most), min(high, most)
        return low, high

    def least_length(self, height: Any) -> Any:
        """Least length of fingers of a height [m], any shape."""
        return (self.limits.finger_slenderness or 0.0) * height

    def highest_pressure(self, table: Any, params: Params) -> Any:
        """Highest pressures of fingers [Pa], shape (..., finger).

        Args:
          table: Those of Table I.
          params: Parameters of hands, arrays of shape (..., finger).  No section of a tapered
            finger may bend as a whole finger of that section must not.

        By the law "elements" a finger that is held straight must not twist by itself either.
        """
        base = params.height, params.wall, self.width
        sections = [base]
        if params.tip is not None:
            sections = [
                tuple(a + (b - a) * share for a, b in zip(base, params.tip, strict=True))
                for share in PLACES
            ]
        caps = table
        for section in sections:
            strains = self._strains(section[0], params.length)
            for pressure in self._pressures(strains, section, params.length):
                caps = _smaller(caps, pressure)
        return caps * (1 - (self.limits.pressure_margin or 0.0))

    def least_height(self, roll: Any, pitch: Any, yaw: Any) -> Any:
        """Least `arm_z` [m] of an arm with these angles [rad], any shape."""
        rim = rim_drop(self.palm_radius, roll, pitch, yaw)
        heights = [-np.inf + 0 * rim]
        if self.limits.palm_clearance is not None:
            heights.append(rim + self.limits.palm_clearance)
        if self.limits.wrist_force is not None:
            yielded = self.limits.wrist_force / self.stiffness
            heights += [rim - yielded, self.top - yielded + 0 * rim]
        highest = heights[0]
        for height in heights[1:]:
            highest = jnp.maximum(highest, height)
        return highest - self.zero_height

    def _strains(self, height: Any, length: Any) -> list[Any]:
        """Strains of the top wall that a free finger must not exceed."""
        strains = []
        if self.limits.strain is not None:
            strains.append(self.limits.strain + 0 * height)
        if self.limits.free_bend is not None:
            strains.append(np.radians(self.limits.free_bend) * height / length)
        return strains

    def _pressures(self, strains: list[Any], section: tuple[Any, ...], length: Any) -> list[Any]:
        """Pressures that fingers of a section must not exceed."""
        height, wall, width = section
        if self.hand is not None:
            numbers = section_numbers.of_hand(self.hand, height, wall, width, length)
            bending = [section_law.strain_pressure(numbers, strain) for strain in strains]
            return [*bending, section_law.steady_pressure(numbers)]
        beam = {"width": width, "shear_modulus": self.shear_modulus}
        return [
            strain_pressure(strain, height, wall, **beam, neo_hookean=self.neo_hookean)
            for strain in strains
        ]


def buildable(hand: Hand, limits: Limits, arm: Arm, top: float, *, neo_hookean: bool) -> Any:
    """The limits that a search in a scene keeps; None if the scene has none.

    Args:
      hand: The scene's hand.
      limits: Its limits.
      arm: Its arm.
      top: Height of its tallest object [m].
      neo_hookean: Its bending law.
    """
    if limits == limits.of_worlds:
        return None
    return Buildable(
        limits,
        hand.section.width,
        # The pressure of a strain goes with the modulus over the moment's factor.
        hand.material.shear_modulus / hand.material.moment_factor,
        neo_hookean,
        hand.palm.radius,
        arm.zero_height,
        hand.wrist.linear_stiffness,
        top,
        hand if hand.section.law == "elements" else None,
    )


def problems(limits: Limits, where: str) -> list[str]:
    """What is wrong with numbers of `[limits]` that are each in range."""
    pair = limits.finger_length
    if pair is None:
        return []
    key = f"{where}.limits.finger_length = {list(pair)}"
    if len(pair) != 2:
        words = f"must have two entries, least and largest length [m], not {len(pair)}"
        return [Problem("size", f"{key} {words}")]
    if not pair[0] < pair[1]:
        return [Problem("order", f"{key}: the least length must be below the largest one")]
    return []


def rim_drop(radius: Any, roll: Any, pitch: Any, yaw: Any) -> Any:
    """How far the rim of a palm is below its centre [m], by the arm's angles [rad], any shape."""
    numpy = roll.__array_namespace__()
    up = numpy.cos(roll) * numpy.cos(pitch) + numpy.sin(roll) * numpy.sin(yaw) * numpy.sin(pitch)
    return radius * numpy.sqrt(numpy.maximum(1 - up**2, FLAT))


def on_lines(pressures: Any, highest: Any, lines: int) -> Any:
    """The nearest pressures of fingers that share so many pressure lines [Pa], shape (finger,).

    A line has the mean of its fingers' pressures, or the lowest of their highest ones. The fingers
    of a line follow one another in the order of their pressures, as the nearest groups of numbers
    do (W. D. Fisher, On grouping for maximum homogeneity, J. Am. Stat. Assoc. 53, 1958), and all
    groups of that kind are compared.

    Args:
      pressures: Pressures of the fingers [Pa], none above its highest, shape (finger,).
      highest: Highest pressures of the fingers [Pa], shape (finger,).
      lines: Number of lines, at most that of the fingers.
    """
    count = len(pressures)
    order = jnp.argsort(pressures)
    sorted_pressures = pressures[order]
    sorted_highest = highest[order]
    candidates = []
    for cuts in itertools.combinations(range(1, count), lines - 1):
        lengths = np.diff([0, *cuts, count])
        parts = np.split(np.arange(count), cuts)
        values = [_of_line(sorted_pressures[part], sorted_highest[part]) for part in parts]
        candidates.append(jnp.repeat(jnp.stack(values), lengths, total_repeat_length=count))
    groupings = jnp.stack(candidates)
    nearest = jnp.square(groupings - sorted_pressures).sum(-1).argmin()
    return jnp.zeros_like(pressures).at[order].set(groupings[nearest])


def _of_line(pressures: Any, highest: Any) -> Any:
    """Pressure of the line of some fingers [Pa]; equal pressures stay what they are."""
    mean = pressures[0] + (pressures - pressures[0]).mean()
    return jnp.minimum(mean, highest.min())


def _smaller(first: Any, second: Any) -> Any:
    """The smaller of two arrays; NumPy's stay NumPy's."""
    return first + (second - first) * (second < first)
