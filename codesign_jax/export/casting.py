"""A finger and the moulds that cast it, as solids in millimetres.

Frame: that of the finger's base, x along the finger, y across, z up from the inextensible bottom
layer.  The finger is the design's: a block of length x width x height around a chamber with walls
of one thickness on all sides, each of which may change linearly from base to tip.  The design is a
beam and says nothing of ends, inlet and moulds; how they are made is ours.  Behind the base, at
x < 0, the block goes on as a solid root, which `palm` holds.

A finger is cast in two steps.  First the shell, all but the bottom wall, back downwards in a tray
around a core that hangs from bars over the tray's rim; the mould is open between the bars, where
silicone is poured in and air leaves.  A pin through the tray's end into the core keeps the inlet
free.  Then the bottom wall, on the inextensible fabric that lies on
the floor of a second tray; the cured shell is set into it and bonds.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import manifold3d
import numpy as np

from codesign_jax.export.process import FABRIC, Process, Size, inlet

Line = Callable[[float], float]
"""A number that changes linearly along a finger."""

BAR = 6.0
SPACING = 40.0
OVERLAP = 5.0
"""Width of the core's bars, largest distance between two, and how deep parts sit in a mould."""
SEGMENTS = 32
"""Corners of the inlet's section."""
PIN = 3.0
"""How deep the inlet's pin stands in the core [mm]."""


class Parts(NamedTuple):
    """Solids of a finger, each in its place in the finger's frame."""

    finger: manifold3d.Manifold  # the finger, hollow
    tray: manifold3d.Manifold  # mould of the shell; it opens downwards
    core: manifold3d.Manifold  # the core with its bars and the frame that sits on the tray
    base: manifold3d.Manifold  # mould of the bottom wall


def parts(size: Size, process: Process) -> Parts:
    """Builds a finger and its moulds."""
    return Parts(_finger(size, process), _tray(size, process), _core(size, process),
                 _base(size, process))  # fmt: skip


def prism(
    x: tuple[float, float], half: Line, low: Line, high: Line, grow: Callable | None = None
) -> manifold3d.Manifold:
    """The body from x[0] to x[1], -half to half and low to high, whose faces are plane."""
    corners = []
    for end, side in zip(x, (-1, 1), strict=True):
        for level in (low, high):
            at = end + side * grow(end, level(end)) if grow else end
            z = level(at)
            wide = half(at) + (grow(at, z) if grow else 0.0)
            corners += [[at, -wide, z], [at, wide, z]]
    return manifold3d.Manifold.hull_points(np.array(corners))


def _rim(size: Size) -> Line:
    return lambda x: size.at(x).wall


def shifted(line: Line, by: float) -> Line:
    return lambda x: line(x) + by


def half_width(size: Size) -> Line:
    return lambda x: size.at(x).width / 2


def _chamber(size: Size) -> tuple[Line, Line, Line]:
    return (
        lambda x: size.at(x).chamber[0] / 2,
        _rim(size),
        lambda x: size.at(x).height - size.at(x).wall,
    )


def _finger(size: Size, process: Process) -> manifold3d.Manifold:
    block = prism(size.ends, half_width(size), lambda x: 0.0, lambda x: size.at(x).height)
    finger = block - prism(size.chamber_ends, *_chamber(size))
    radius = inlet(size, process) / 2
    if radius:
        start, end = size.chamber_ends
        reach = min(1.0, (end - start) / 2)
        finger -= _tube(size, radius, -size.root - 1.0, start + reach)
    return finger


def _tube(size: Size, radius: float, start: float, end: float) -> manifold3d.Manifold:
    """A cylinder along the finger in the middle of its base."""
    tube = manifold3d.Manifold.cylinder(end - start, radius, radius, SEGMENTS)
    return tube.rotate([0, 90, 0]).translate([start, 0, size.base.height / 2])


def pin(size: Size, process: Process) -> manifold3d.Manifold:
    """The pin that keeps the inlet free, from outside of the tray into the core."""
    start, end = size.chamber_ends
    outside = -size.root - 4 * process.mould_wall - process.clearance
    radius = inlet(size, process) / 2
    return _tube(size, radius, outside, start + min(PIN, (end - start) / 2))


def _pinned(part: manifold3d.Manifold, size: Size, process: Process) -> manifold3d.Manifold:
    """A mould with the hole of the pin."""
    return part - pin(size, process) if inlet(size, process) else part


def slope(size: Size, process: Process, x: float, z: float) -> float:
    """How much wider than the design side faces of tray and core are there, on each side."""
    middle = (size.at(x).wall + size.at(x).height) / 2
    return math.tan(math.radians(process.draft)) * (middle - z)


def _around(size: Size, grow: Line, low: Line, high: Line) -> manifold3d.Manifold:
    return prism(size.ends, half_width(size), low, high, lambda x, z: grow(x))


def _tray(size: Size, process: Process) -> manifold3d.Manifold:
    rim = _rim(size)

    def top(x):
        return size.at(x).height

    outer = _around(size, _outside(size, process), rim, shifted(top, process.mould_wall))
    # The cavity goes on below its opening, so that no two faces coincide there.
    cavity = size.ends, half_width(size), shifted(rim, -1.0), top
    return _pinned(outer - prism(*cavity, lambda x, z: slope(size, process, x, z)), size, process)


def _at_rim(size: Size, process: Process) -> Line:
    return lambda x: slope(size, process, x, size.at(x).wall)


def _outside(size: Size, process: Process) -> Line:
    return shifted(_at_rim(size, process), process.mould_wall)


def overlap(size: Size) -> float:
    return min(OVERLAP, *((s.height - s.wall) / 2 for s in (size.base, size.tip)))


def _core(size: Size, process: Process) -> manifold3d.Manifold:
    wall = process.mould_wall
    rim = _rim(size)
    ends = size.chamber_ends
    half, low, high = _chamber(size)
    drafted = lambda x, z: slope(size, process, x, z)  # noqa: E731
    core = prism(ends, half, shifted(low, -wall / 2), high, drafted)
    inside = shifted(_outside(size, process), process.clearance)
    below = shifted(rim, -wall)
    depth = overlap(size)
    frame = _around(size, shifted(inside, wall), below, shifted(rim, depth))
    frame -= _around(size, inside, rim, shifted(rim, depth + 1.0))
    opening = _at_rim(size, process)
    frame -= _around(size, opening, shifted(below, -1.0), shifted(rim, 1.0))
    spine = prism(ends, half, below, rim)
    across = lambda x: size.at(x).width / 2 + inside(x)  # noqa: E731
    bars = [prism((x - w / 2, x + w / 2), across, below, rim) for x, w in bars_of(size)]
    solid = manifold3d.Manifold.batch_boolean([core, frame, spine, *bars], manifold3d.OpType.Add)
    return _pinned(solid, size, process)


def bars_of(size: Size) -> list[tuple[float, float]]:
    """Middle along the finger, and width, of the bars that hold the core."""
    start, end = size.chamber_ends
    width = min(BAR, end - start)
    span = end - start - width
    if span < 2 * BAR:  # no opening is left between two
        return [((start + end) / 2, width)]
    middles = np.linspace(start + width / 2, end - width / 2, 1 + math.ceil(span / SPACING))
    return [(float(x), width) for x in middles]


def _base(size: Size, process: Process) -> manifold3d.Manifold:
    wall = process.mould_wall
    rim = _rim(size)
    wide = _at_rim(size, process)
    top = shifted(rim, overlap(size))
    room = shifted(wide, process.clearance)
    outer = _around(size, shifted(room, wall), lambda x: -wall, top)
    outer -= _around(size, wide, lambda x: 0.0, shifted(top, 1.0))
    outer -= _around(size, room, rim, shifted(top, 1.0))
    # The fabric leaves upwards behind the root.
    behind = -size.root - room(-size.root) - FABRIC, -size.root
    return outer - prism(behind, half_width(size), rim, shifted(top, 1.0))
