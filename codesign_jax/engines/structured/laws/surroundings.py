"""What does not move: the table and the scene's fixtures, as distance fields and as edges.

Points are from the object's centre along the world's axes, as in `shapes`; `position` is that
centre in the world, shape (3, ...).  A fixture's numbers are the scene's structure.  All functions
consist of arithmetic on components, so that they take arrays and lanes.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanes import cross, directly, dot
from codesign_jax.engines.structured.laws import shapes
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.model.held import EDGES, ROUND, object_points
from codesign_jax.scene import Scene
from codesign_jax.scene.tables import Fixture

Field = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""From position and points to distances and their gradients."""


def fields(scene: Scene) -> list[Field]:
    """Distance fields of the table, if the scene has it, and of the fixtures."""
    table = [_table] if scene.effects.table else []
    return [*table, *(partial(distance, fixture) for fixture in scene.fixture)]


def _table(position: jax.Array, point: jax.Array) -> tuple[jax.Array, jax.Array]:
    return shapes.table_distance(position[2], point)


def turn_of(fixture: Fixture) -> np.ndarray:
    """Rotation matrix of a fixture's frame."""
    w, x, y, z = fixture.quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _turned(matrix: np.ndarray, vector: jax.Array) -> jax.Array:
    rows = [sum(float(m) * vector[k] for k, m in enumerate(row)) for row in matrix]
    return jnp.stack(rows)  # type: ignore[arg-type]


def _from_centre(fixture: Fixture, point: jax.Array) -> jax.Array:
    away = jnp.stack([point[k] - float(fixture.position[k]) for k in range(3)])
    return _turned(turn_of(fixture).T, away)


def _in_world(position: jax.Array, point: jax.Array) -> jax.Array:
    items = [1] * (point.ndim - position.ndim)
    return point + position.reshape(3, *items, *position.shape[1:])


def distance(
    fixture: Fixture, position: jax.Array, point: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Signed distance of points (3, ...) from a fixture, and its gradient in the world's axes."""
    local = _from_centre(fixture, _in_world(position, point))
    zero = jnp.zeros_like(local[0])
    if fixture.type == "plane":
        gap = local[2]
        slope = jnp.stack([zero, zero, zero + 1.0])
    else:
        size = jnp.stack([zero + float(s) for s in fixture.half_sizes])
        gap, slope = shapes.SHAPES[fixture.type].distance(size, local)
    return gap, _turned(turn_of(fixture), slope)


def towards(fixture: Fixture, position: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance of the object's centre from a fixture, and axes of which the last one leads away.

    Returns:
      The distance (...), and rows of a rotation, shape (3, 3, ...).
    """
    gap, normal = distance(fixture, position, jnp.zeros_like(position))
    ones = jnp.ones_like(gap)
    zero = jnp.zeros_like(gap)
    aside = jnp.where(
        jnp.abs(normal[2]) < 0.9, jnp.stack([zero, zero, ones]), jnp.stack([ones, zero, zero])
    )
    first = cross(aside, normal)
    first = first / jnp.sqrt(dot(first, first))
    return gap, jnp.stack([first, cross(normal, first), normal])


def edges(fixture: Fixture, position: jax.Array) -> jax.Array:
    """Points of the fixture's edges that are nearest to the object, shape (3, point, ...).

    Of a box they are on the four edges of the face that the object's centre is before, of a
    cylinder on the nearer rim.
    """
    local = _from_centre(fixture, position)
    size = [float(s) for s in fixture.half_sizes]
    if fixture.type == "cylinder":
        radial = jnp.sqrt(local[0] ** 2 + local[1] ** 2 + 1e-12)
        scale = size[0] / radial
        end = jnp.where(local[2] < 0, -size[1], size[1])
        points = [jnp.stack([scale * local[0], scale * local[1], end])]
    else:
        excess = [jnp.abs(local[k]) - size[k] for k in range(3)]
        near = [jnp.minimum(jnp.maximum(local[k], -size[k]), size[k]) for k in range(3)]
        side = [jnp.where(local[k] < 0, -size[k], size[k]) for k in range(3)]
        points = []
        for edge in range(4):
            point = None
            for k in (2, 1, 0):
                a = (k + 1) % 3
                b = (k + 2) % 3
                across, along = (a, b) if edge < 2 else (b, a)
                corner: list[Any] = [None] * 3
                corner[k] = side[k]
                corner[along] = near[along]
                corner[across] = jnp.zeros_like(side[k]) + (1 if edge % 2 else -1) * size[across]
                new = jnp.stack(corner)
                first = (excess[k] >= excess[a]) & (excess[k] >= excess[b])
                point = new if point is None else jnp.where(first, new, point)
            points.append(point)
    turn = turn_of(fixture)
    return jnp.stack(
        [
            jnp.stack([v + float(fixture.position[k]) for k, v in enumerate(_turned(turn, p))])
            - position
            for p in points
        ],
        1,
    )


def faced(rows: jax.Array, columns: jax.Array) -> jax.Array:
    """Columns of the object's orientation in axes of which the last one leads away, see `towards`.

    On them a fixture is where the table is in the world's.
    """
    turned = [jnp.stack([dot(rows[r], columns[c]) for r in range(3)]) for c in range(3)]
    return jnp.stack(turned)


def object_on(
    fixture: Fixture, position: jax.Array, rows: jax.Array, arms: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts of an object's points with a fixture: point, normal (3, point, world) and gap.

    Args:
      position: The object's centre, shape (3, 1, world).
      rows: See `towards`, shape (3, 3, 1, world).
      arms: Points that would touch a table in these axes, from the centre, shape (3, point, world).
    """
    turned = [sum(rows[r, i] * arms[r] for r in range(3)) for i in range(3)]
    point = jnp.stack(turned)  # type: ignore[arg-type]
    gap, normal = distance(fixture, position, point)
    return point - 0.5 * gap * normal, normal, gap


def edge_on(
    point: jax.Array, gap: jax.Array, gradient: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts of the `edges` with the object, by its distance and gradient: point, normal, gap."""
    return point - 0.5 * gap * gradient, -gradient, gap


def object_places(
    scene: Scene,
    position: Any,
    columns: Any,
    shape: Any,
    points: Callable[[Any, Any, int | None], Any],
    on_object: Callable[[Any, int], tuple[Any, Any]],
    apply: Callable = directly,
) -> list[Place]:
    """Contacts of the object with table and fixtures, points of shape (3, point, world).

    A fixture with edges has theirs behind those of the object's own points, see `edges`.

    Args:
      scene: The scene.
      position: The object's centre [m], shape (3, 1, world).
      columns: Columns of its orientation, shape (3, 3, 1, world).
      shape: Index of the object in the scene, shape (1, world).
      points: Points that would touch a table in axes, shape (3, point, world): from the columns in
        these axes, the height above the table, and the fixture's number, None for the table.
      on_object: The object's distance field: from points and a fixture's number.
      apply: As in `touch.touch`.
    """
    places = []
    if scene.effects.table:
        height = position[2]
        places.append(apply(_points_on_table, points(columns, height, None), height))
    flat = [i for i, other in enumerate(scene.objects.object) if other.type not in ROUND]
    for j, fixture in enumerate(scene.fixture):
        gap, rows = apply(partial(towards, fixture), position)
        arms = points(apply(faced, rows, columns), gap, j)
        places.append(apply(partial(_points_on_fixture, fixture), position, rows, arms))
        if flat and EDGES[fixture.type]:
            point = apply(partial(edges, fixture), position)
            faces = partial(_edges_on_faces, tuple(flat))
            places.append(apply(faces, shape, point, *on_object(point, j)))
    return places


def _points_on_table(arms: jax.Array, height: jax.Array) -> Place:
    point, normal, gap = shapes.on_table(arms, height)
    return Place(point, normal, gap, jnp.ones_like(gap))


def _points_on_fixture(
    fixture: Fixture, position: jax.Array, rows: jax.Array, arms: jax.Array
) -> Place:
    point, normal, gap = object_on(fixture, position, rows, arms)
    return Place(point, normal, gap, jnp.ones_like(gap))


def _edges_on_faces(
    flat: tuple[int, ...], shape: jax.Array, point: jax.Array, gap: jax.Array, gradient: jax.Array
) -> Place:
    """Contacts of edges with objects that have faces; a round one's own point touches alone."""
    on, normal, gap = (v[..., 0, :] for v in edge_on(point, gap, gradient))
    faces = jnp.isin(shape.astype(jnp.int32), jnp.array(flat))
    return Place(on, normal, gap, jnp.where(faces, jnp.ones_like(gap), 0.0))


def slots(scene: Scene) -> int:
    """How many points of object, table and fixtures may touch."""
    return sum(object_points(scene))


def touched(scene: Scene, pair: str, count: int) -> list[int]:
    """Which of `cones.frictions` the contacts of a pair of bodies have.

    Rings or spheres look at each field `count` times; of the object it is known.
    """
    each = object_points(scene)
    if pair == "object_table":
        return [len(each) + i for i, points in enumerate(each) for _ in range(points)]
    return [i for i in range(len(each)) for _ in range(count)]
