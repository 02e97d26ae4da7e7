"""A finger and the moulds that cast it, as solids in millimetres.

Frame: that of the finger's base, x along the finger, y across, z up from the inextensible bottom
layer.  The finger is the design's: a block of length x width x height around a chamber with walls
of one thickness on all sides.  The design is a beam and says nothing of ends, inlet and moulds; how
they are made is ours.

A finger is cast in two steps.  First the shell, all but the bottom wall, back downwards in a tray
around a core that hangs from bars over the tray's rim; the mould is open between the bars, where
silicone is poured in and air leaves.  Then the bottom wall, on the inextensible fabric that lies on
the floor of a second tray; the cured shell is set into it and bonds.
"""

import math
from typing import NamedTuple

import manifold3d
import numpy as np

from codesign_jax.export.process import Process, Size, inlet

BAR, SPACING, OVERLAP = 6.0, 40.0, 5.0
"""Width of the core's bars, largest distance between two, and how deep parts sit in a mould."""
SEGMENTS = 32
"""Corners of the inlet's section."""


class Parts(NamedTuple):
    """Solids of a finger, each in its place in the finger's frame.

    Attributes:
      finger: The finger, hollow.
      tray: Mould of the shell; it opens downwards.
      core: The core with its bars and the frame that sits on the tray.
      base: Mould of the bottom wall.
    """

    finger: manifold3d.Manifold
    tray: manifold3d.Manifold
    core: manifold3d.Manifold
    base: manifold3d.Manifold


def parts(size: Size, process: Process) -> Parts:
    """Builds a finger and its moulds.

    Args:
      size: The finger's dimensions.
      process: What the design does not say.
    """
    return Parts(_finger(size, process), _tray(size, process), _core(size, process),
                 _base(size, process))  # fmt: skip


def _box(x: tuple[float, float], y: float, z: tuple[float, float]) -> manifold3d.Manifold:
    """A box from x[0] to x[1], -y to y and z[0] to z[1]."""
    cube = manifold3d.Manifold.cube([x[1] - x[0], 2 * y, z[1] - z[0]])
    return cube.translate([x[0], -y, z[0]])


def _chamber(size: Size) -> tuple[tuple[float, float], float, tuple[float, float]]:
    """Bounds of the chamber, as `_box` takes them."""
    across = (size.end, size.length - size.end)
    return across, size.chamber[1] / 2, (size.wall, size.height - size.wall)


def _finger(size: Size, process: Process) -> manifold3d.Manifold:
    block = _box((0, size.length), size.width / 2, (0, size.height))
    found = block - _box(*_chamber(size))
    radius = inlet(size, process) / 2
    if radius:
        reach = size.end + min(1.0, size.chamber[0] / 2) + 1.0
        tube = manifold3d.Manifold.cylinder(reach, radius, radius, SEGMENTS)
        found -= tube.rotate([0, 90, 0]).translate([-1.0, 0, size.height / 2])
    return found


def slope(size: Size, process: Process, z: float) -> float:
    """How much wider than the design side faces of tray and core are at a height, on each side."""
    middle = (size.wall + size.height) / 2
    return math.tan(math.radians(process.draft)) * (middle - z)


def _drafted(
    size: Size, process: Process, x: tuple[float, float], y: float, z: tuple[float, float]
) -> manifold3d.Manifold:
    """A box whose side faces have the draft."""
    corners = []
    for height in z:
        s = slope(size, process, height)
        corners += [[a, b, height] for a in (x[0] - s, x[1] + s) for b in (-y - s, y + s)]
    return manifold3d.Manifold.hull_points(np.array(corners))


def _around(size: Size, grow: float, z: tuple[float, float]) -> manifold3d.Manifold:
    """A box around the finger's outline, grown by as much on each side."""
    return _box((-grow, size.length + grow), size.width / 2 + grow, z)


def _tray(size: Size, process: Process) -> manifold3d.Manifold:
    wall, opening = process.mould_wall, size.wall
    outer = _around(size, _outside(size, process), (opening, size.height + wall))
    # The cavity goes on below its opening, so that no two faces coincide there.
    cavity = (0, size.length), size.width / 2, (opening - 1.0, size.height)
    return outer - _drafted(size, process, *cavity)


def _outside(size: Size, process: Process) -> float:
    """How far the tray goes beyond the finger's outline on each side."""
    return process.mould_wall + slope(size, process, size.wall)


def _core(size: Size, process: Process) -> manifold3d.Manifold:
    """Core, spine and bars, and a frame that lies on the tray's rim and reaches around it."""
    wall, rim = process.mould_wall, size.wall
    (start, end), half, (low, high) = _chamber(size)
    core = _drafted(size, process, (start, end), half, (low - wall / 2, high))
    inside = _outside(size, process) + process.clearance
    depth = min(OVERLAP, (size.height - rim) / 2)
    frame = _around(size, inside + wall, (rim - wall, rim + depth))
    frame -= _around(size, inside, (rim, rim + depth + 1.0))
    frame -= _around(size, slope(size, process, rim), (rim - wall - 1.0, rim + 1.0))
    spine = _box((start, end), half, (rim - wall, rim))
    across = size.width / 2 + inside
    bars = [_box((x - w / 2, x + w / 2), across, (rim - wall, rim)) for x, w in bars_of(size)]
    return manifold3d.Manifold.batch_boolean([core, frame, spine, *bars], manifold3d.OpType.Add)


def bars_of(size: Size) -> list[tuple[float, float]]:
    """Middle along the finger, and width, of the bars that hold the core."""
    start, end = size.end, size.length - size.end
    width = min(BAR, end - start)
    span = end - start - width
    if span < 2 * BAR:  # no opening is left between two
        return [((start + end) / 2, width)]
    middles = np.linspace(start + width / 2, end - width / 2, 1 + math.ceil(span / SPACING))
    return [(float(x), width) for x in middles]


def _base(size: Size, process: Process) -> manifold3d.Manifold:
    """A tray as deep as the bottom wall, and above that wide enough to set the shell into it."""
    wall, wide = process.mould_wall, slope(size, process, size.wall)
    top = size.wall + min(OVERLAP, (size.height - size.wall) / 2)
    outer = _around(size, wide + process.clearance + wall, (-wall, top))
    outer -= _around(size, wide, (0.0, top + 1.0))
    return outer - _around(size, wide + process.clearance, (size.wall, top + 1.0))
