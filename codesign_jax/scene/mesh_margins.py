"""Margins around meshes in which distances are needed: where contacts of the hand begin.

Beyond its grid a mesh's distance is taken for larger than it is, so that a contact would begin
late. A scene that is read has grids for its hand; one that was put together otherwise is refused.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.core
import numpy as np

from codesign_jax.scene import schema
from codesign_jax.scene.hand_tables import LEAST_REACH, UNITS, Hand, Numbers, per_finger
from codesign_jax.scene.objects import ObjectSet

_STEP = 0.005
"""Step of larger ones [m]: hands that differ a little share grids and programs."""
_DEVIATIONS = 2
"""Standard deviations of the size noise by which an object may be smaller than its mesh."""


def needed(radius: float, size_noise: float) -> float:
    """Margin around a mesh, in its nominal size, in which distances are needed [m].

    Args:
      radius: Largest radius of a contact sphere [m].
    """
    margin = radius / (1 - _DEVIATIONS * size_noise)
    return LEAST_REACH if margin <= LEAST_REACH else math.ceil(margin / _STEP - 1e-9) * _STEP


def contact_radius(hand: Hand) -> float:
    """Largest radius [m] of the contact spheres of a hand, in any design of its table or presets.

    Spheres of a finger have half its height as their radius.
    """
    heights = [
        high * UNITS[row.unit][1]
        for row in hand.parameter
        if row.name in ("height", "tip_height")
        for numbers in [row.high, *_widened(hand)]
        for high in per_finger(numbers, 1)
    ]
    return max([hand.palm.contact_radius, *(height / 2 for height in heights)])


def _widened(hand: Hand) -> list[Numbers]:
    names = ("height", "tip_height")
    free = [f for preset in hand.preset for f in preset.free if f.name in names]
    return [f.high for f in free if f.high is not None]


def fit(objects: ObjectSet, hand: Hand) -> ObjectSet:
    """The set with the distances of its meshes as far out as the hand needs."""
    if not any(shape.mesh for shape in objects.object):
        return objects
    margin = needed(contact_radius(hand), objects.noise.size)
    shapes = (
        dataclasses.replace(shape, mesh=shape.mesh.reaching(margin)) if shape.mesh else shape
        for shape in objects.object
    )
    return dataclasses.replace(objects, object=tuple(shapes))


def refuse(objects: ObjectSet, radius: Any) -> None:
    """Refuses contact spheres that are larger than the distances of the set's meshes reach.

    Args:
      radius: Radii of contact spheres [m], any shape; of traced ones nothing is known.
    """
    if any(isinstance(v, jax.core.Tracer) for v in (radius, objects.noise.size)):
        return
    largest = float(np.max(radius))
    noise = float(np.max(objects.noise.size))
    margin = needed(largest * (1 - 1e-6), noise)
    problems = [
        f"object {shape.name!r}: distances reach {1e3 * shape.mesh.reach:g} mm from its surface, "
        f"contact spheres of radius {1e3 * largest:g} mm need {1e3 * margin:g} mm: raise the "
        "bounds of `height` or palm.contact_radius in the hand file, and read the scene again"
        for shape in objects.object
        if shape.mesh and shape.mesh.reach < margin
    ]
    if problems:
        raise schema.InputError(problems)
