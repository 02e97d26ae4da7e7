"""Makes objects/household: eight shapes beyond the primitives, as closed meshes in millimetres.

The set household has each as it stands in its file, household_poses in each of its stable poses.

Every shape is a tube: a row of loops joined by quadrilaterals, whose ends are closed by shrinking
to a point, by joining the first loop, or by a flat cap.
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh
from trimesh.exchange.stl import export_stl

from codesign_jax import objects

FOLDER = Path(__file__).parent.parent / "objects"
HEAD = """\
# Eight shapes beyond the primitives, made by scripts/make_objects.py; all numbers are [chosen].
# Meshes need the structured engine.  SI units except for the files', which are in millimetres.
name = "{name}"
description = "Capsule, cone, torus, ring segment, mug, bottle, superquadric and L-bracket{origin}"

[noise]                    # standard deviations, as in the paper's set
position = 0.005
orientation = 5.0
mass = 0.05
size = 0.05

[table]
friction = 0.5
"""
ENTRY = """
[[object]]
name = "{name}"
type = "mesh"
file = "household/{name}.stl"
unit = "mm"
mass = 0.1
friction = 0.8
"""
LEAST = 0.1
"""Probability of the poses of the set household_poses."""
Part = tuple[np.ndarray, np.ndarray]


def turn(count: int, until: float = 360.0) -> np.ndarray:
    """Angles of `count` steps from 0, the last one left out [rad]."""
    return np.deg2rad(until) * np.arange(count) / count


def tube(loops: np.ndarray, *, closed: bool = False, capped: bool = False) -> Part:
    """Joins loops of shape (loop, point, 3); a cap is a fan around the first point of its loop."""
    rows, n, _ = loops.shape
    index = np.arange(rows * n).reshape(rows, n)
    a = index if closed else index[:-1]
    b = np.roll(index, -1, 0) if closed else index[1:]
    a_next = np.roll(a, -1, 1)
    b_next = np.roll(b, -1, 1)
    # The two faces of quadrilateral (row, point) are 2 (row n + point) and the next.
    faces = np.stack([np.stack([a, a_next, b_next], -1), np.stack([a, b_next, b], -1)], 2)
    parts = [faces.reshape(-1, 3)]
    if capped:
        fan = np.stack([np.zeros(n - 2, int), np.arange(2, n), np.arange(1, n - 1)], 1)
        parts += [fan, index[-1, 0] + fan[:, ::-1]]
    return loops.reshape(-1, 3), np.concatenate(parts)


def rings(profile: np.ndarray, sectors: int) -> np.ndarray:
    """Loops of a body of revolution about z from its profile of (radius, height)."""
    angle = turn(sectors)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    return profile[:, None, :1] * circle + profile[:, None, 1:] * [0, 0, 1]


def arc(radius: float, centre: tuple[float, float], start: float, stop: float, count: int):
    """Points of a circular arc in the (radius, height) plane, angles in degrees."""
    angle = np.deg2rad(np.linspace(start, stop, count))
    return np.stack([centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)], -1)


def capsule() -> Part:
    """Lies along x, 76 mm long and 52 mm thick."""
    profile = np.vstack([arc(26, (0, -12), -90, 0, 9), arc(26, (0, 12), 0, 90, 9)])
    return tube(rings(profile, 32)[..., [2, 0, 1]])


def cone() -> Part:
    """Stands on its base of 68 mm."""
    return tube(rings(np.array([[0, 0], [34, 0], [22.7, 22], [11.3, 44], [0, 66.0]]), 40))


def torus() -> Part:
    """Lies flat, 72 mm across and 24 mm thick."""
    return tube(rings(arc(12, (24, 0), 0, 360, 25)[:-1], 36), closed=True)


def ring_segment() -> Part:
    """Two thirds of a ring with a rectangular section, 68 mm across and 40 mm high."""
    angle = np.deg2rad(np.linspace(60, 300, 33))
    section = np.array([[19, 0], [34, 0], [34, 40], [19, 40.0]])
    x, y = (section[:, 0] * f(angle)[:, None] for f in (np.cos, np.sin))
    return tube(np.stack([x, y, np.broadcast_to(section[:, 1], x.shape)], -1), capped=True)


def mug() -> Part:
    """58 mm across with walls of 6 mm; the handle joins two holes of 2 x 2 quadrilaterals."""
    sectors = 32
    heights = np.linspace(0, 66, 13)
    outside = np.stack([np.full(13, 29.0), heights], -1)
    inside = np.stack([np.full(7, 23.0), np.linspace(66, 8, 7)], -1)
    loops = rings(np.vstack([[[0, 0]], outside, inside, [[0, 8]]]), sectors)
    vertices, faces = tube(loops)
    keep = np.ones(len(faces), bool)
    low = 3
    high = 11
    ring = ((-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1))
    for row in (low, high):
        for r in (row - 1, row):
            for s in (sectors - 1, 0):
                keep[2 * (r * sectors + s) :][:2] = False
    corners = {row: np.array([loops[row + r, s % sectors] for r, s in ring]) for row in (low, high)}
    handle = tube(_handle(corners[high], corners[low]))
    return np.vstack([vertices, handle[0]]), np.vstack([faces[keep], handle[1] + len(vertices)])


def _handle(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    """Loops along a half ellipse outwards, from one hole's rim to the mirrored other's."""
    start = upper.mean(0)
    end = lower.mean(0)
    middle = (start + end) / 2
    reach = (start - end)[2] / 2
    side = upper[:, 1]
    tall = upper[:, 2] - start[2]
    inset = upper[:, 0] - start[0]  # the rims lie on the round wall
    loops = []
    for angle in np.linspace(np.pi / 2, -np.pi / 2, 17):
        c = np.cos(angle)
        s = np.sin(angle)
        centre = middle + [0.85 * reach * c, 0, reach * s]
        loop = centre + np.outer(tall, [c, 0, s]) + np.outer(side, [0, 1, 0])
        loop[:, 0] += inset * abs(s) ** 8
        loops.append(loop)
    return np.stack(loops)


def bottle() -> Part:
    """86 mm high, 56 mm across, with a neck of 26 mm; solid."""
    foot = arc(5, (23, 5), -90, 0, 5)
    shoulder = arc(15, (13, 44), 0, 80, 8)
    neck = np.array([[13, 63], [13, 80], [12, 86], [0, 86.0]])
    return tube(rings(np.vstack([[[0, 0]], foot, [[28, 25]], shoulder, neck]), 40))


def superquadric() -> Part:
    """Between a box and an ellipsoid: exponents 0.5, half sizes 28, 32 and 30 mm."""

    def power(x: np.ndarray) -> np.ndarray:
        return np.sign(x) * np.sqrt(np.abs(np.round(x, 12)))

    up = np.deg2rad(np.linspace(-90, 90, 21))[:, None]
    around = turn(40)
    flat = power(np.cos(up))
    x = 28 * flat * power(np.cos(around))
    y = 32 * flat * power(np.sin(around))
    return tube(np.stack([x, y, np.broadcast_to(30 * power(np.sin(up)), x.shape)], -1))


def bracket() -> Part:
    """An L of two legs of 64 mm, 22 mm thick and 44 mm wide, standing on one of them."""
    outline = np.array([[22, 22], [22, 64], [0, 64], [0, 0], [64, 0], [64, 22.0]])
    loops = [np.column_stack([outline[:, 0], np.full(6, y), outline[:, 1]]) for y in (0.0, 44.0)]
    return tube(np.stack(loops), capped=True)


SHAPES = {
    "capsule": capsule,
    "cone": cone,
    "torus": torus,
    "ring_segment": ring_segment,
    "mug": mug,
    "bottle": bottle,
    "superquadric": superquadric,
    "bracket": bracket,
}


def finish(part: Part) -> trimesh.Trimesh:
    """Joins points that coincide, turns the faces outwards, puts the lowest point on z = 0."""
    mesh = trimesh.Trimesh(np.round(part[0], 6), part[1], process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    if mesh.volume < 0:
        mesh.invert()
    assert mesh.is_watertight and mesh.is_winding_consistent
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    return mesh


def main() -> None:
    parser = argparse.ArgumentParser(description="Makes the household object set.")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder of object files")
    folder = parser.parse_args().out
    (folder / "household").mkdir(parents=True, exist_ok=True)
    for name, make in SHAPES.items():
        mesh = finish(make())
        path = folder / "household" / f"{name}.stl"
        path.write_bytes(export_stl(mesh))
        size = " x ".join(f"{v:.0f}" for v in mesh.extents)
        print(f"{name}: {size} mm, {mesh.volume / 1e3:.0f} cm^3, {len(mesh.faces)} faces")
    entries = [ENTRY.format(name=name) for name in SHAPES]
    _write(folder / "household.toml", "", entries)
    posed = []
    for entry, shape in zip(entries, objects.load(folder / "household.toml").object, strict=True):
        for k, pose in enumerate(shape.resting(), 1):
            if pose.probability > LEAST:
                text = entry.replace(f'name = "{shape.name}"', f'name = "{shape.name}_{k}"')
                posed.append(f'{text}pose = "stable:{k}"  # {100 * pose.probability:.0f} %\n')
    _write(folder / "household_poses.toml", ", in each stable pose", posed)


def _write(path: Path, origin: str, entries: list[str]) -> None:
    path.write_text(HEAD.format(name=path.stem, origin=origin) + "".join(entries), encoding="utf-8")


if __name__ == "__main__":
    main()
