"""How much larger a finger's section is under pressure, in height and in width.

Pressure rounds a section, at the most until its thread, which keeps its length, is a circle: of
diameter 2 (w + h - 4 z d) / pi, with walls z d outside of it on both sides, where z is the thread's
depth in a wall d.  The largest growth of height and width is thus the outer diameter over h and
over w, less one.  How far a section has come on the way to the circle follows from the moment p b^2
at the ends of a side b, over the resistance G d^2 of a wall.  The height, by the top, b = w, grows
in proportion at first; the width, by the sides, b = h, begins with the square, because the bulging
top pulls its corners inwards.  docs/notes/section.md compares both with finite elements.
"""

from typing import Any, NamedTuple

import numpy as np

from codesign_jax.scene.hand_tables import Hand

HIGHEST = 0.926
"""Largest growth of the height over that of the circle [fitted], by scripts.section.growth."""
HEIGHT_RATE = 0.0829
"""Share of p w^2 / (G d^2) that makes a section grow [fitted]; a clamped strip's moment is 1/12."""
WIDEST = 0.941
"""Largest growth of the width over that of the circle [fitted], as `HIGHEST`."""
WIDTH_RATE = 0.157
"""Share of p h^2 / (G d^2) that makes the width grow [fitted], as `HEIGHT_RATE`."""


class Growth(NamedTuple):
    """How sections grow; every entry has the shape of their heights.

    Attributes:
      height: Largest growth of the height over the height.
      width: Largest growth of the width over the width; negative for wide sections.
      height_rate: Growth of the height per pressure at first, over the largest one [1/Pa].
      width_rate: Inverse of the pressure at which the width has half of its growth [1/Pa].
    """

    height: Any
    width: Any
    height_rate: Any
    width_rate: Any


def growth(
    height: Any, wall: Any, width: Any, *, shear_modulus: Any, thread_depth: Any = 0.0
) -> Growth:
    """How sections grow.

    Args:
      height: Outer height h [m], any shape; NumPy or JAX arrays.
      wall: Thickness of the walls [m], broadcasting to it, as the others.
      width: Outer width [m].
      shear_modulus: G of the silicone [Pa].
      thread_depth: Place of the thread in the wall: 0 outside, 1 on the chamber.

    Returns:
      `Growth` of these sections, entries of the shape of `height`.
    """
    outside = 2 * thread_depth * wall
    circle = 2 * (width + height - 2 * outside) / np.pi + outside
    resists = shear_modulus * wall**2
    return Growth(
        height=HIGHEST * (circle / height - 1),
        width=WIDEST * (circle / width - 1),
        height_rate=HEIGHT_RATE * width**2 / resists,
        width_rate=WIDTH_RATE * height**2 / resists,
    )


def of_hand(hand: Hand, height: Any, wall: Any, width: Any) -> Growth:
    """`growth` of a hand's sections, with its silicone, its thread and its factor of pressure."""
    section = hand.section
    modulus = hand.material.shear_modulus / section.pressure_factor
    depth = section.thread_depth
    return growth(height, wall, width, shear_modulus=modulus, thread_depth=depth)


def factors(grows: Growth, pressure: Any) -> tuple[Any, Any]:
    """Height and width of sections over those without pressure.

    Args:
      grows: How they grow, see `growth`.
      pressure: Gauge pressure of their chambers [Pa], of the same shape or broadcasting to it; a
        vacuum leaves them as they are.

    Returns:
      The factors of height and of width, 1 without pressure.
    """
    numpy = pressure.__array_namespace__()
    over = numpy.maximum(pressure, 0.0)
    top = grows.height_rate * over
    side = (grows.width_rate * over) ** 2
    return (
        1 + grows.height * top / numpy.sqrt(1 + top * top),
        1 + grows.width * side / (1 + side),
    )
