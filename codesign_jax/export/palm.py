"""The palm and the bars that clamp the fingers to it, as solids in millimetres.

Frame: the palm's, z = 0 its underside, which is the simulation's.  A finger's root stands in a
pocket behind its base plane, so that all of its length bends.  The pocket is open at the finger's
back: the finger is laid in, its fabric folded up behind the root and over the back wall, and a bar
is screwed down on both.  The fabric, which does not stretch, carries the pull; the bar presses the
root into the pocket.  Nothing of this is the paper's: all sizes here are ours.
"""

import itertools
from typing import NamedTuple

import manifold3d
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from codesign_jax.export.casting import SEGMENTS, half_width, prism, shifted
from codesign_jax.export.process import (
    BACK,
    BAR,
    CHEEK,
    FABRIC,
    FLOOR,
    Process,
    Size,
    inlet,
)
from codesign_jax.model.layout import mounts
from codesign_jax.scene import Scene
from codesign_jax.types import Params

Solid = manifold3d.Manifold

PILOT = 2.5
PASS = 3.4
DEEP = 13.0
"""Holes of the bars' M3 screws in the palm and in the bar, and depth of the first [mm]."""
REACH = 60.0
"""How far from its base a finger has the room beside its seat to itself [mm]."""
FLANGES = ((31.5, "M5", 5.5, 10.0, 5.5), (20.0, "M4", 4.5, 8.0, 4.5), (14.0, "M3", 3.4, 6.5, 3.5))
"""Circles of four screws to the wrist: diameter, thread, hole, head, height of the head [mm].

The first is that of a robot's flange 31.5-4-M5 by ISO 9409-1."""
APART = (0.01, 0.017, 0.023, 0.031)
"""Differences of one seat and the next [mm]: equal ones meet in lines, which no file can say."""
SHORTEST = (1e-4, 1e-3, 3e-3, 1e-2, 3e-2)
"""Edges that may be shortened to nothing [mm], tried from the finest on; none is printed."""
INSIDE = 0.05
"""How far a web stays within what it joins [mm]."""
LOST = 0.2
"""Share of a seat's walls from which on they are missed."""
OVERLAP = 1.0
"""Volume from which on two bodies stand in one another [mm^3]."""


class Flange(NamedTuple):
    """Screws between palm and wrist."""

    diameter: float  # of their circle [mm]
    thread: str
    angle: float  # of the first one, from the palm's x axis [deg]
    sunk: bool  # whether their heads are below the palm's underside


class Palm(NamedTuple):
    """The palm's parts."""

    body: Solid
    bars: list[Solid]  # a clamp bar for each finger, in the frame of its base
    flange: Flange | None  # None: there is no room for one
    below: float  # how far the seats stand below the palm's underside [mm]
    problems: list[str]  # what cannot be built, a sentence each


def palm(scene: Scene, params: Params, sizes: list[Size], process: Process) -> Palm:
    """Builds the palm of a hand, whose fingers need a root.

    Seats differ by hundredths of a millimetre; where some of their faces still meet in a line,
    other differences are tried.  The last one stays, closed or not.
    """
    for step in APART:
        candidate = _palm(scene, params, sizes, process, [step * i for i in range(len(sizes))])
        if (body := without_short_edges(candidate.body)) is not None:
            return candidate._replace(body=body)
    return candidate


def without_short_edges(solid: Solid) -> Solid | None:
    """The solid without edges of which STL's float32 makes a point; None if that opens it."""
    for shortest in SHORTEST:
        simplified = solid.simplify(shortest)
        surface = simplified.to_mesh64()
        vertices = np.asarray(surface.vert_properties)[:, :3].astype(np.float32)
        faces = np.asarray(surface.tri_verts)
        if trimesh.Trimesh(vertices, faces, process=True).is_watertight:
            return simplified
    return None


def _palm(
    scene: Scene, params: Params, sizes: list[Size], process: Process, apart: list[float]
) -> Palm:
    places = frames(scene, params)
    seats = [
        _seat(size, place, more) for size, place, more in zip(sizes, places, apart, strict=True)
    ]
    pockets = [
        _placed(_pocket(size, process, more), place)
        for size, place, more in zip(sizes, places, apart, strict=True)
    ]
    holes = [
        hole
        for size, place in zip(sizes, places, strict=True)
        for hole in _holes(size, process, place)
    ]
    radius = 1e3 * scene.hand.palm.radius
    thickness = 1e3 * scene.hand.palm.thickness
    # Turned by an odd angle, so that no corner of it lies in a plane of symmetry.
    disc = Solid.cylinder(thickness, radius, radius, 4 * SEGMENTS).rotate([0, 0, 0.9])
    body = _sum([disc, *seats])
    if len(body.decompose()) > 1:
        webs = (
            _web(size, place, (radius, thickness), more)
            for size, place, more in zip(sizes, places, apart, strict=True)
        )
        body = _sum([body, *webs])
    taken = _sum([*pockets, *holes])
    body -= taken
    # Slivers of the disc that the fingers' room cuts off hold nothing.
    body, *slivers = sorted(body.decompose(), key=lambda piece: -piece.volume())
    flange, drilled = _flange(radius, thickness, taken)
    marks = [
        _count(i, size, place) for i, (size, place) in enumerate(zip(sizes, places, strict=True))
    ]
    body -= _sum([*drilled, *marks, _arrow(radius, thickness)])
    bars = [_bar(size, process) for size in sizes]
    problems = _collisions(sizes, places, bars, pockets)
    lost = _sum(slivers)
    for i, seat in enumerate(seats):
        wall = seat - taken
        if (wall ^ lost).volume() > LOST * wall.volume():
            problems.append(f"the seat of finger {i} is cut off from the palm by another's room")
    return Palm(body, bars, flange, max(0.0, -float(body.bounding_box()[2])), problems)


def frames(scene: Scene, params: Params) -> list[np.ndarray]:
    """Frames of the fingers' bases in the palm's, as 3 x 4 matrices [mm]."""
    position, turn = (np.asarray(v) for v in mounts(scene.hand, np.asarray(params.spread)))
    matrices = []
    for place, (w, x, y, z) in zip(position, turn, strict=True):
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        matrices.append(np.column_stack([rotation, 1e3 * place]))
    return matrices


def _placed(solid: Solid, frame: np.ndarray) -> Solid:
    return solid.transform(frame)


def _sum(solids: list[Solid]) -> Solid:
    return Solid.batch_boolean(solids, manifold3d.OpType.Add)


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> Solid:
    return Solid.cube(np.subtract(high, low)).translate(low)


def _steep(frame: np.ndarray) -> bool:
    """Whether a finger points far down."""
    return bool(frame[2, 0] <= -np.sin(np.pi / 4) and frame[2, 2] >= -1e-9)


def _edge(size: Size) -> float:
    """Half of a seat's width [mm]."""
    return max(size.base.width, size.at(-size.root).width) / 2 + CHEEK


def _block(size: Size, more: float = 0.0) -> Solid:
    edge = _edge(size) + more
    back = size.root + BACK + more
    # Beyond base plane and rim, where `_pocket` cuts it: two faces in one plane leave slivers.
    shrunk = max(0.0, -more)
    return _box((-back, -edge, -FLOOR - more), (0.75, edge, size.pressed + 0.5 - shrunk))


def _seat(size: Size, frame: np.ndarray, more: float) -> Solid:
    """A seat in the palm's frame, before its pocket is cut."""
    seat = _placed(_block(size, more), frame)
    # A finger that points far down needs no floor below the underside.
    return seat.trim_by_plane((0.0, 0.0, 1.0), 0.0) if _steep(frame) else seat


def _pocket(size: Size, process: Process, more: float) -> Solid:
    """What a finger needs for itself: root and way in, the room around its base, the bar's."""
    clear = process.clearance + more
    edge = _edge(size)
    ends = (-size.root - FABRIC - more, 1.0)
    top = lambda x: size.at(x).height  # noqa: E731
    # The floors are apart by hundredths of a millimetre, and the base's line lies in neither: all
    # three would meet in the line where the palm's underside ends, and leave slivers.
    floor = lambda x: -0.03 - more  # noqa: E731
    root = prism(ends, shifted(half_width(size), clear), floor, shifted(top, 50.0))
    reach = (-0.01, min(REACH, size.length))
    free = prism(
        reach, shifted(half_width(size), 1.0 + more), shifted(floor, 0.015), shifted(top, BAR + 1.0)
    )
    front = _box((0.0, -edge - 1.0, -FLOOR - 1.0), (1.5, edge + 1.0, size.pressed + 1.0))
    # The bar and the heads of its screws; the bar's neighbour may have walls there.
    back = size.root + BACK + 0.3 + more
    high = size.pressed + BAR + 4.0
    bar = _box((-back, -edge - 0.3 - more, size.pressed), (1.0, edge + 0.3 + more, high))
    return _sum([root, free, front, bar])


def screws(size: Size, process: Process) -> list[tuple[float, float]]:
    """Where the bar's screws stand in the frame of a finger's base, x and y [mm]."""
    beside = inlet(size, process) / 2 + PASS
    y = max(size.base.width / 4, beside)
    return [(-size.root - FABRIC - (BACK - FABRIC) / 2, side * y) for side in (-1, 1)]


def _holes(size: Size, process: Process, frame: np.ndarray) -> list[Solid]:
    rim = size.pressed
    start = -size.root + 1.0
    tube = (inlet(size, process) or 3.0) / 2 + 0.3
    way = Solid.cylinder(BACK + 3.0, tube, tube, SEGMENTS)
    middle = size.base.height / 2
    way = _placed(way.rotate([0, -90, 0]).translate([start, 0, middle]), frame)
    # Behind the seat the tube turns up, out of the palm's upper side.
    at = frame @ [start - BACK - 2.0, 0, middle, 1]
    # Turned by an odd angle: its corners would lie on those of the level hole of a level finger.
    up = Solid.cylinder(100.0, 1.5 * tube, 1.5 * tube, SEGMENTS).rotate([0, 0, 3.3])
    up = up.translate([*at])
    pilots = [
        Solid.cylinder(DEEP + 1.0, PILOT / 2, PILOT / 2, SEGMENTS).translate([x, y, rim - DEEP])
        for x, y in screws(size, process)
    ]
    return [way, up, *(_placed(pilot, frame) for pilot in pilots)]


def _bar(size: Size, process: Process) -> Solid:
    """A clamp bar in the frame of its finger's base, on the rim of the seat."""
    edge = _edge(size)
    rim = size.pressed
    bar = _box((-size.root - BACK, -edge, rim), (0.0, edge, rim + BAR))
    for x, y in screws(size, process):
        hole = Solid.cylinder(BAR + 2.0, PASS / 2, PASS / 2, SEGMENTS)
        bar -= hole.translate([x, y, rim - 1.0])
    return bar


def _web(size: Size, frame: np.ndarray, disc: tuple[float, float], more: float) -> Solid:
    """What joins a seat outside of the disc to its middle, within the disc's height if it can."""
    radius, thickness = disc
    inside = INSIDE + more
    core = Solid.cylinder(thickness - 2 * inside, radius / 2 + more, radius / 2 + more, SEGMENTS)
    # A little within the seat and the disc, so that no two faces coincide.
    seat = _placed(_block(size, -inside), frame)
    level = seat.trim_by_plane((0, 0, 1), inside).trim_by_plane((0, 0, -1), inside - thickness)
    return Solid.batch_hull([core.translate([0, 0, inside]), seat if level.is_empty() else level])


def _flange(radius: float, thickness: float, taken: Solid) -> tuple[Flange | None, list[Solid]]:
    """The widest circle of screws for which there is room, and their holes."""
    for diameter, thread, hole, head, high in FLANGES:
        if diameter / 2 + head / 2 + 2.0 > radius:
            continue
        sunk = thickness >= high + 4.0
        for angle in range(45, 135, 5):
            middles = [np.radians(angle + 90 * k) for k in range(4)]
            room = []
            holes = []
            for at in middles:
                place = [diameter / 2 * np.cos(at), diameter / 2 * np.sin(at), -1.0]
                # The head's way in is clear over all of the thickness, and a wall around it.
                wide = head / 2 + 1.5
                room.append(Solid.cylinder(thickness + 30, wide, wide, SEGMENTS).translate(place))
                through = Solid.cylinder(thickness + 30, hole / 2, hole / 2, SEGMENTS)
                holes.append(through.translate(place))
                if sunk:
                    top = Solid.cylinder(1.0 + high, head / 2, head / 2, SEGMENTS)
                    holes.append(top.translate(place))
            if (_sum(room) ^ taken).volume() < OVERLAP:
                return Flange(diameter, thread, float(angle % 90), sunk), holes
    return None, []


def _count(index: int, size: Size, frame: np.ndarray) -> Solid:
    """Dimples in the underside that count a finger from 1, from its base inwards."""
    inwards = -frame[:2, 2] if abs(frame[2, 0]) > abs(frame[2, 2]) else -frame[:2, 0]
    inwards = inwards / max(float(np.linalg.norm(inwards)), 1e-9)
    first = 6.0 if _steep(frame) else size.root + BACK + 4.0  # not in a floor below the underside
    dots = []
    for k in range(index + 1):
        x, y = frame[:2, 3] + (first + 3.0 * k) * inwards
        dots.append(Solid.sphere(1.0, SEGMENTS // 2).translate([x, y, 0.0]))
    return _sum(dots)


def _arrow(radius: float, thickness: float) -> Solid:
    """A groove in the upper side, from the middle to the palm's +x."""
    groove = _box((0.0, -0.7, thickness - 1.0), (radius + 30.0, 0.8, thickness + 50.0))
    return groove ^ Solid.cylinder(thickness, radius, radius, 4 * SEGMENTS)


def _root(size: Size) -> Solid:
    """A finger's root and the beginning of the finger."""
    return prism((-size.root, 5.0), half_width(size), lambda x: 0.0, lambda x: size.at(x).height)


def _collisions(
    sizes: list[Size], places: list[np.ndarray], bars: list[Solid], pockets: list[Solid]
) -> list[str]:
    problems = []
    roots = [_placed(_root(size), place) for size, place in zip(sizes, places, strict=True)]
    clamps = [_placed(bar, place) for bar, place in zip(bars, places, strict=True)]
    walls = [
        _placed(_block(size), place) - pocket
        for size, place, pocket in zip(sizes, places, pockets, strict=True)
    ]
    for i, j in itertools.combinations(range(len(sizes)), 2):
        if (roots[i] ^ roots[j]).volume() > OVERLAP:
            problems.append(f"the bases of fingers {i} and {j} stand in one another")
        elif (clamps[i] ^ clamps[j]).volume() > OVERLAP:
            problems.append(f"the clamp bars of fingers {i} and {j} meet: file their ends")
        elif max((walls[i] ^ pockets[j]).volume(), (walls[j] ^ pockets[i]).volume()) > OVERLAP:
            problems.append(f"the seat of one of fingers {i} and {j} cuts into the other's")
    return problems
