"""Contact geometry: spheres against the object and the table, the object on the table."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanes import apply_columns, apply_rows, cross, dot, once
from codesign_jax.engines.structured.laws import meshes
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.scene import Scene, primitives

_TINY = 1e-12


def in_object(columns: jax.Array, point: jax.Array) -> jax.Array:
    """Points (3, ...) from the object's centre along the world's axes in the object's frame."""
    return apply_rows(columns, point)


def table_distance(height: jax.Array, point: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Height of points (3, ...) above the table, and its gradient; `height` is the origin's."""
    gap = point[2] + height
    zero = jnp.zeros_like(gap)
    return gap, jnp.stack([zero, zero, zero + 1.0])


def disc_distance(
    point: jax.Array, place: jax.Array, frame: jax.Array, size: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Signed distance of a point from the palm's disc, and its gradient.

    Args:
      place: Place of the palm's frame, which is on the disc's underside.
      size: Radius and half the thickness of the disc.
    """
    local = apply_rows(frame, point - place)
    distance, slope = cylinder(size, jnp.stack([local[0], local[1], local[2] - size[1]]))
    return distance, apply_columns(frame, slope)


def signed_distance(
    scene: Scene, hand: WorldModel, local: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Signed distance and unit gradient in the object's frame, for the shape of each world."""
    indices = mesh_indices(scene)
    if len(indices) == len(scene.objects.object):
        return meshes.signed_distance(hand.mesh, local)  # type: ignore[arg-type]
    distance, gradient = primitive_distance(scene, hand.object_size, hand.object_id, local)
    if not indices:
        return distance, gradient
    mine = jnp.isin(hand.object_id, jnp.array(indices))
    other = meshes.signed_distance(hand.mesh, local)  # type: ignore[arg-type]
    return jnp.where(mine, other[0], distance), jnp.where(mine, other[1], gradient)


def mesh_indices(scene: Scene) -> list[int]:
    """Indices of the object set's meshes."""
    return [i for i, s in enumerate(scene.objects.object) if s.type == "mesh"]


def primitive_distance(
    scene: Scene, size: jax.Array, shape: jax.Array, local: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """As `signed_distance`, for a scene's primitives; worlds with a mesh get any primitive's."""
    return _by_kind(scene, shape, {k: partial(s.distance, size, local) for k, s in SHAPES.items()})


def _by_kind(scene: Scene, shape: jax.Array, functions: dict[str, Callable]) -> Any:
    """What the function for the kind of each world's object returns, a tree of arrays."""
    kinds = [s.type for s in scene.objects.object]
    result = None
    for kind in dict.fromkeys(k for k in kinds if k in functions):
        new = functions[kind]()
        if result is None:
            result = new
            continue
        mine = jnp.isin(shape, jnp.array([i for i, k in enumerate(kinds) if k == kind]))
        result = jax.tree.map(partial(jnp.where, mine), new, result)
    assert result is not None
    return result


def _sphere(size: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
    length = jnp.sqrt(dot(p, p) + _TINY**2)
    return length - size[0], p / length


def _box(size: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
    sign = jnp.where(p < 0, -1.0, 1.0).astype(p.dtype)
    excess = jnp.abs(p) - size.reshape(3, *([1] * (p.ndim - size.ndim)), *size.shape[1:])
    outside = jnp.maximum(excess, 0.0)
    square = dot(outside, outside)
    length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    deepest = jnp.maximum(jnp.maximum(excess[0], excess[1]), excess[2])
    first = excess[0] >= deepest
    second = ~first & (excess[1] >= deepest)
    face = jnp.stack([first, second, ~first & ~second]).astype(p.dtype)
    is_out = square > 0
    gradient = jnp.where(is_out, outside / length, face)
    return jnp.where(is_out, length, deepest), sign * gradient


def cylinder(size: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Signed distance of points (3, ...) from a cylinder (radius, half height), and gradient."""
    radial = jnp.sqrt(p[0] ** 2 + p[1] ** 2 + _TINY**2)
    sign = jnp.where(p[2] < 0, -1.0, 1.0).astype(p.dtype)
    side = radial - size[0]
    cap = jnp.abs(p[2]) - size[1]
    out_side = jnp.maximum(side, 0.0)
    out_cap = jnp.maximum(cap, 0.0)
    square = out_side**2 + out_cap**2
    is_out = square > 0
    length = jnp.sqrt(jnp.where(is_out, square, 1.0))
    nearer_side = side > cap
    g_side = jnp.where(is_out, out_side / length, nearer_side.astype(p.dtype))
    g_cap = jnp.where(is_out, out_cap / length, (~nearer_side).astype(p.dtype))
    gradient = jnp.stack([g_side * p[0] / radial, g_side * p[1] / radial, g_cap * sign])
    return jnp.where(is_out, length, jnp.maximum(side, cap)), gradient


def _capsule(size: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
    nearest = jnp.maximum(jnp.minimum(p[2], size[1]), -size[1])  # on the segment within
    return _sphere(size, jnp.stack([p[0], p[1], p[2] - nearest]))


def lowest_points(scene: Scene, hand: WorldModel, columns: jax.Array) -> jax.Array:
    """Points of the object that may touch a table, from its centre, shape (3, 4, world).

    Four slots as in MuJoCo's plane colliders: the four lower corners of a box; the lower rim's
    lowest point, its upper counterpart and two more on the lower rim, 120 degrees apart, of a
    cylinder; the lowest point of each cap of a capsule (two slots); that of a sphere (one); four
    spread-out ones among the lowest support points of a mesh.
    """

    def points(size: jax.Array, columns: jax.Array) -> jax.Array:
        indices = mesh_indices(scene)
        arms = None
        if len(indices) < len(scene.objects.object):
            arms = primitive_points(scene, size, hand.object_id, columns)
        if indices:
            new = meshes.table_points(hand.mesh, columns)  # type: ignore[arg-type]
            mine = jnp.isin(hand.object_id, jnp.array(indices))
            arms = new if arms is None else jnp.where(mine, new, arms)
        assert arms is not None
        return arms

    return once(points, hand.object_size[:, 0], columns[:, :, 0])


def primitive_points(
    scene: Scene, size: jax.Array, shape: jax.Array, columns: jax.Array
) -> jax.Array:
    """Points of a scene's primitives that may touch the table, from the centre, (3, 4, world)."""
    return _by_kind(scene, shape, {k: partial(s.points, size, columns) for k, s in SHAPES.items()})


def on_table(arms: jax.Array, height: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts of an object's points (3, slot, world) with the table: point, normal and gap."""
    gap = arms[2] + height
    zero = jnp.zeros_like(gap)
    normal = jnp.stack([zero, zero, zero + 1.0])
    return arms - 0.5 * gap * normal, normal, gap


_AWAY = 1e3  # an unused slot hangs this far above the table


def _box_corners(size: jax.Array, columns: jax.Array) -> jax.Array:
    """Of each opposite pair of corners the lower one, shape (3, 4, world)."""
    edges = [size[k] * columns[k] for k in range(3)]
    corners = []
    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        corner = edges[0] + a * edges[1] + b * edges[2]
        corners.append(jnp.where(corner[2] > 0, -corner, corner))
    return jnp.stack(corners, 1)


def _rim_points(size: jax.Array, columns: jax.Array) -> jax.Array:
    """MuJoCo's cylinder points, shape (3, 4, world)."""
    axis = jnp.where(columns[2, 2] > 0, -columns[2], columns[2])  # towards the table
    down = jnp.stack([axis[2] * axis[0], axis[2] * axis[1], axis[2] * axis[2] - 1.0])
    square = dot(down, down)
    flat = square < _TINY
    length = jnp.sqrt(jnp.where(flat, 1.0, square))
    # A disc parallel to the table has no lowest rim point: take the body's x axis.
    radial = jnp.where(flat, columns[0], down / length) * size[0]
    half = axis * size[1]
    across = cross(radial, axis)
    across_length = jnp.sqrt(jnp.maximum(dot(across, across), _TINY**2))
    across = across / across_length * size[0] * np.sqrt(3.0) / 2
    lower = half + radial
    upper = radial - half
    return jnp.stack([lower, upper, half - 0.5 * radial + across, half - 0.5 * radial - across], 1)


def _lowest_point(size: jax.Array, columns: jax.Array) -> jax.Array:
    zero = jnp.zeros_like(size[0])
    lowest = jnp.stack([zero, zero, -size[0]])
    away = jnp.stack([zero, zero, zero + _AWAY])
    return jnp.stack([lowest, away, away, away], 1)


def _cap_points(size: jax.Array, columns: jax.Array) -> jax.Array:
    """The lowest point of each cap of a capsule, shape (3, 4, world)."""
    lowest = _lowest_point(size, columns)
    end = size[1] * columns[2]
    return jnp.stack([lowest[:, 0] + end, lowest[:, 0] - end, lowest[:, 2], lowest[:, 3]], 1)


class ShapeFunctions(NamedTuple):
    """Functions of a primitive's sizes, for lanes: see `primitive_distance`, `primitive_points`."""

    # Sizes (3, 1, world) and points (3, ...) of the object's frame to the signed distance (...) and
    # its unit gradient (3, ...)
    distance: Callable
    # Sizes (3, world) and columns of the orientation (3, 3, world) to the up to four points that
    # can touch the table, from the centre (3, 4, world); unused ones are `_AWAY`
    points: Callable


SHAPES = {
    "box": ShapeFunctions(_box, _box_corners),
    "cylinder": ShapeFunctions(cylinder, _rim_points),
    "capsule": ShapeFunctions(_capsule, _cap_points),
    "sphere": ShapeFunctions(_sphere, _lowest_point),
}
primitives.check("distances", SHAPES)
