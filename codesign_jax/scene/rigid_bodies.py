"""Objects as rigid bodies: how they are turned, where they come to rest, which inertia is possible.

An orientation is three angles or a quaternion.  Roll, pitch and yaw [deg] turn about the axes x, y
and z of the world, in this order; a quaternion is (w, x, y, z).

>>> from codesign_jax.scene import rigid_bodies
>>> [round(v, 3) for v in rigid_bodies.turned((90.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))]
[0.707, 0.707, 0.0, 0.0]
"""

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

_STABLE = re.compile(r"stable(?::([1-9][0-9]?))?")
_ALIKE = 0.02
"""Poses are one if height of the centre and moment about the vertical differ by less [ours]: a
lying cylinder rests on each of its facets."""
_NEUTRAL = 1e-6
"""Share of its height by which a body has to sink for it to fall: less is rounding."""


class Resting(NamedTuple):
    """A pose in which an object rests on the table."""

    orientation: tuple[float, ...]  # of the frame of its file, a unit quaternion (w, x, y, z)
    probability: float  # how often it comes to rest so, dropped in any orientation


def turned(orientation: Sequence[float], base: Sequence[float]) -> tuple[float, ...]:
    """A body's quaternion (w, x, y, z) in the world.

    Args:
      orientation: Of the frame of its file, three angles [deg] or four numbers.
    """
    from scipy.spatial.transform import Rotation  # takes a while to import

    if len(orientation) == 3:
        turn = Rotation.from_euler("xyz", orientation, degrees=True)
    else:
        turn = Rotation.from_quat(np.roll(orientation, -1))
    return _quaternion(turn * Rotation.from_quat(np.roll(base, -1)))


def _quaternion(turn: Any) -> tuple[float, ...]:
    """(w, x, y, z) with w >= 0 of SciPy's rotation."""
    return tuple(float(v) for v in np.roll(turn.as_quat(canonical=True), 1))


def up(quaternion: Any) -> list[Any]:
    """The vertical in the frame of a body of this orientation, three numbers."""
    w, x, y, z = quaternion
    return [2 * (x * z - w * y), 2 * (y * z + w * x), w * w + z * z - x * x - y * y]


def orientation_problem(orientation: Sequence[float]) -> str | None:
    """The problem with an orientation, or None."""
    if len(orientation) not in (3, 4):
        return "must be roll, pitch and yaw in degrees, or a quaternion w, x, y, z"
    norm = float(np.linalg.norm(orientation))
    if len(orientation) == 4 and abs(norm - 1) > 1e-3:
        return f"must be a unit quaternion w, x, y, z: its norm is {norm:.4g}"
    return None


def stable(points: np.ndarray, inertia: Sequence[float], base: Sequence[float]) -> list[Resting]:
    """Poses in which a body rests, by trimesh's `compute_stable_poses`, the most probable first.

    Those that are alike count as one, see `_ALIKE`: that which is turned least of those that are at
    least half as probable as the most probable, with the yaw nearest to the file's.

    Args:
      points: Vertices of the convex hull from the centre of mass [m], shape (point, 3).
      inertia: Principal moments per mass [m^2].
    """
    import trimesh
    from scipy.spatial.transform import Rotation

    size = np.abs(points).max()  # trimesh merges faces by lengths in units of the file
    hull = trimesh.PointCloud(points / size).convex_hull
    poses, chances = trimesh.poses.compute_stable_poses(hull, center_mass=np.zeros(3), seed=0)
    base_rotation = Rotation.from_quat(np.roll(base, -1)).as_matrix().T
    groups = []
    total = sum(inertia)
    for turn, chance in zip(poses[:, :3, :3], chances, strict=True):
        height = -(points @ turn[2]).min()
        moment = np.dot(turn[2] ** 2, inertia)
        for group in groups:
            near = abs(height - group[0]) < _ALIKE * height
            if near and abs(moment - group[1]) < _ALIKE * total:
                group[2].append((chance, _levelled(turn @ base_rotation)))
                break
        else:
            groups.append((height, moment, [(chance, _levelled(turn @ base_rotation))]))
    resting = []
    for _, _, members in groups:
        most = max(chance for chance, _ in members)
        likely = [turn for chance, turn in members if chance > most / 2]
        least = Rotation.from_matrix(max(likely, key=_plainness))
        resting.append(Resting(_quaternion(least), float(sum(chance for chance, _ in members))))
    return sorted(resting, key=lambda pose: -pose.probability)


def _levelled(turn: np.ndarray) -> np.ndarray:
    """The rotation with the yaw that brings it nearest to none."""
    yaw = np.arctan2(turn[0, 1] - turn[1, 0], turn[0, 0] + turn[1, 1])
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ turn


def _plainness(turn: np.ndarray) -> tuple[float, float]:
    # How little it turns, then how near its axes are to those of the world.
    return round(float(np.trace(turn)), 6), float(np.abs(turn).max(0).sum())


def chosen(pose: str, find_poses: Callable[[], list[Resting]]) -> Resting | str:
    """The pose of this name, or what is wrong with it."""
    match = _STABLE.fullmatch(pose)
    if match is None:
        return 'must be "stable", or "stable:2" for the second most probable pose'
    index = int(match[1] or 1)
    poses = find_poses()
    if index <= len(poses):
        return poses[index - 1]
    some = ", ".join(f"{i} ({100 * p.probability:.0f} %)" for i, p in enumerate(poses[:9], 1))
    return f"asks for pose {index}: it has {len(poses)} stable poses, {some}"


def fall(
    height: Callable[[np.ndarray], np.ndarray], vertical: Sequence[float]
) -> tuple[int, float]:
    """By how much a body turns [deg] and sinks [m], put on the table without speed, until it rests.

    It turns where its centre sinks, a degree after the other.

    Args:
      height: Height of its centre on a table of these normals in its frame, shape (3, n), to (n,).
    """
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    now = np.asarray(vertical, float)
    tilt = np.deg2rad(1.0)
    start = low = float(height(now[:, None])[0])
    for degrees in range(180):
        side = np.cross(now, np.eye(3)[np.abs(now).argmin()])
        side /= np.linalg.norm(side)
        circle = np.outer(side, np.cos(around)) + np.outer(np.cross(now, side), np.sin(around))
        ring = np.cos(tilt) * now[:, None] + np.sin(tilt) * circle
        heights = height(ring)
        if not heights.min() < low * (1 - _NEUTRAL):
            return degrees, start - low
        now = ring[:, heights.argmin()]
        low = float(heights.min())
    return 180, start - low


def tensor(inertia: Sequence[float]) -> np.ndarray:
    """A symmetric tensor of three diagonal numbers, or six: xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = (*inertia, 0.0, 0.0, 0.0)[:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_problem(inertia: Sequence[float], mass: float, radius: float) -> str | None:
    """Why no body has this inertia about its centre of mass, or None.

    Args:
      mass: Its mass [kg].
      radius: Distance of its farthest point from the centre of mass [m].
    """
    if len(inertia) not in (3, 6):
        return "must have three numbers, xx, yy and zz, or six, with xy, xz and yz"
    a, b, c = np.linalg.eigvalsh(tensor(inertia))
    moments = f"its principal moments are {a:.4g}, {b:.4g} and {c:.4g} kg m^2"
    if a <= 0:
        return f"must be positive about every axis: {moments}"
    if c > (a + b) * (1 + 1e-9):
        return f"is of no body: {moments}, and the largest is more than the sum of the others"
    if c > (most := mass * radius**2):
        return (
            f"is of no body of {mass:g} kg that reaches {1e3 * radius:.3g} mm from its centre of "
            f"mass: {moments}, more than {most:.4g} kg m^2"
        )
    return None
