"""Primitive shapes of objects: all that is known of one but its distance, a record by name.

`engines/structured/laws/shapes.py` has the distances, by the same names.

The functions of a record take the three sizes of a shape [m], those it lacks zero, as numbers or
arrays.  A shape's frame is MuJoCo's: the origin is the centre, which half a turn about any axis
leaves in place, and an axis of revolution is z.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

_SEGMENTS = 64  # of drawn circles


class Primitive(NamedTuple):
    """A shape of objects."""

    sizes: tuple[str, ...]  # what each number of its `size` is
    geom: str  # name of MuJoCo's geom type
    # Orientation on the table before the trial's yaw, as a unit quaternion (w, x, y, z)
    upright: tuple[float, float, float, float]
    # How far it reaches from its centre in a direction [m], a function of its sizes and of a unit
    # vector in its own frame, shape (3,): on a table with this normal it rests so high
    reach: Callable[[Any, Any], Any]
    volume: Callable[[Any], Any]  # volume [m^3], a function of its sizes
    # Distance of its farthest point from the centre [m], a function of its sizes
    radius: Callable[[Any], Any]
    # Of its bounding box in its own frame [m], three numbers, likewise
    half_extents: Callable[[Any], tuple[Any, ...]]
    # Principal inertia of the solid per mass [m^2], three numbers, likewise
    inertia: Callable[[Any], tuple[Any, ...]]
    triangles: Callable[[Any], Any]  # its surface as a trimesh.Trimesh, likewise


def block_inertia(mass: Any, x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    """Principal inertia of a solid block with edges x, y, z [m] about its centre [kg m^2]."""
    return mass * (y**2 + z**2) / 12, mass * (x**2 + z**2) / 12, mass * (x**2 + y**2) / 12


def _across(up: Any) -> Any:
    """Share of a unit vector across the axis; along it the root keeps a slope that is finite."""
    return (up[0] ** 2 + up[1] ** 2 + 1e-37) ** 0.5


def _cylinder_inertia(size: Any) -> tuple[Any, ...]:
    across = size[0] ** 2 / 4 + size[1] ** 2 / 3
    return across, across, size[0] ** 2 / 2


def _capsule_inertia(size: Any) -> tuple[Any, ...]:
    """Cylinder and two half balls, whose centres of mass lie 3/8 r beyond the cylinder's ends."""
    radius = size[0]
    half = size[1]
    ball = 4 * radius / (6 * half + 4 * radius)  # share of the mass
    side, _, along = _cylinder_inertia(size)
    tips = 2 / 5 * radius**2 + half**2 + 3 / 4 * radius * half
    across = (1 - ball) * side + ball * tips
    return across, across, (1 - ball) * along + ball * 2 / 5 * radius**2


def _box_triangles(size: Any) -> Any:
    import trimesh  # takes a while to import

    return trimesh.creation.box(2 * np.asarray(size))


def _cylinder_triangles(size: Any) -> Any:
    import trimesh

    return trimesh.creation.cylinder(size[0], 2 * size[1], sections=_SEGMENTS)


def _capsule_triangles(size: Any) -> Any:
    import trimesh

    return trimesh.creation.capsule(2 * size[1], size[0], count=[_SEGMENTS, _SEGMENTS])


def _sphere_triangles(size: Any) -> Any:
    import trimesh

    return trimesh.creation.icosphere(4, size[0])


_STANDING = (1.0, 0.0, 0.0, 0.0)

PRIMITIVES = {
    "box": Primitive(
        sizes=("half length in x", "half length in y", "half height"),
        geom="mjGEOM_BOX",
        upright=_STANDING,
        reach=lambda size, up: sum(size[i] * abs(up[i]) for i in range(3)),
        volume=lambda size: 8 * size[0] * size[1] * size[2],
        radius=lambda size: (size[0] ** 2 + size[1] ** 2 + size[2] ** 2) ** 0.5,
        half_extents=lambda size: (size[0], size[1], size[2]),
        inertia=lambda size: block_inertia(1.0, *(2 * v for v in size)),
        triangles=_box_triangles,
    ),
    "cylinder": Primitive(
        sizes=("radius", "half height"),
        geom="mjGEOM_CYLINDER",
        upright=_STANDING,
        reach=lambda size, up: size[0] * _across(up) + size[1] * abs(up[2]),
        volume=lambda size: 2 * np.pi * size[0] ** 2 * size[1],
        radius=lambda size: (size[0] ** 2 + size[1] ** 2) ** 0.5,
        half_extents=lambda size: (size[0], size[0], size[1]),
        inertia=_cylinder_inertia,
        triangles=_cylinder_triangles,
    ),
    "capsule": Primitive(
        sizes=("radius", "half length without the caps"),
        geom="mjGEOM_CAPSULE",
        # It lies along x: on its tip it would fall over.
        upright=(0.5**0.5, 0.0, 0.5**0.5, 0.0),
        reach=lambda size, up: size[0] + size[1] * abs(up[2]),
        volume=lambda size: np.pi * size[0] ** 2 * (2 * size[1] + 4 / 3 * size[0]),
        radius=lambda size: size[0] + size[1],
        half_extents=lambda size: (size[0], size[0], size[0] + size[1]),
        inertia=_capsule_inertia,
        triangles=_capsule_triangles,
    ),
    "sphere": Primitive(
        sizes=("radius",),
        geom="mjGEOM_SPHERE",
        upright=_STANDING,
        reach=lambda size, up: size[0] + 0 * up[2],
        volume=lambda size: 4 / 3 * np.pi * size[0] ** 3,
        radius=lambda size: size[0],
        half_extents=lambda size: (size[0],) * 3,
        inertia=lambda size: (0.4 * size[0] ** 2,) * 3,
        triangles=_sphere_triangles,
    ),
}


def check(kind: str, names: Any) -> None:
    """Raises an error if what is given by name is not given for exactly the primitives."""
    if wrong := set(names) ^ set(PRIMITIVES):
        raise TypeError(f"{kind} and primitives have other names: {', '.join(sorted(wrong))}")
