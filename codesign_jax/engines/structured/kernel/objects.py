"""The grasped object of each world inside a kernel: primitives and meshes, side by side.

What no lane of a block has is skipped: a block of primitives reads no grid, and one of meshes
computes no primitive.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.kernel.memory import Block, BoundTable, anywhere, choose, loop
from codesign_jax.engines.structured.kernel.rows import World
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import meshes, shapes
from codesign_jax.engines.structured.laws.meshes import GridLanes, MeshLanes
from codesign_jax.scene import Scene

_LAST = 1e9  # beyond any index of a support point


class MeshMemory(NamedTuple):
    """A block's memory of meshes."""

    values: Any  # Grid values of all meshes of the scene, a reference to a flat array
    # Reads the support points of a row, one for each finger's lane, shape (3,)
    support: Callable[[Any], Lanes]
    rows: int  # Number of these rows
    grid: GridLanes  # The grid of each world's mesh
    reach: Lanes  # Distance of the farthest support point from the centre [m], lanes of a world
    meshed: Lanes  # Which worlds have a mesh, lanes of a world


class WorldObject(NamedTuple):
    """Objects of a block's worlds."""

    size: Lanes  # Sizes of the primitives, shape (3,), lanes of a world
    shape: Lanes  # Index of each world's object in the scene, a float, lanes of a world
    block: Block  # The lanes
    mesh: MeshMemory | None  # Meshes; None if the scene has none


def support_points(scene: Scene) -> int:
    """Support points that each mesh of a scene has, zero without meshes."""
    mesh = meshes.tables(scene)
    return 0 if mesh is None else mesh.support.shape[1]


def rows(mesh: MeshLanes, fingers: int, dtype: Any) -> dict[str, jax.Array]:
    """Arrays for `Hand.support`, whose points are dealt to lanes, and for the grid in `World`."""
    support = mesh.support
    if support.shape[1] < fingers:
        support = jnp.tile(support, (1, fingers // support.shape[1], 1))
    dealt = support.reshape(3, -1, fingers, support.shape[2])
    reach = jnp.sqrt((support**2).sum(0).max(0))[None]
    grid = {k: v.astype(dtype) for k, v in mesh.grid._asdict().items()}
    return {"support": dealt.swapaxes(0, 1)} | {
        f"grid_{k}": v for k, v in (grid | {"reach": reach}).items()
    }


def read(
    scene: Scene, block: Block, world: BoundTable, hand: BoundTable, values: Any
) -> WorldObject:
    """The object of each lane's world.

    Args:
      scene: The scene.
      block: The lanes.
      world: Constants of the worlds.
      hand: Constants of the fingers, which have the support points of meshes.
      values: Reference to the distances of all meshes, shape (n,); None without meshes.
    """
    size = world.read(World.object_size)
    shape = world.read(World.object_id)
    if values is None:
        return WorldObject(size, shape, block, None)
    indices = np.array(shapes.mesh_indices(scene), np.int32)
    meshed = lanewise(lambda s: jnp.isin(s.astype(jnp.int32), indices), shape)
    memory = MeshMemory(
        values,
        partial(hand.read, "support"),
        hand.layout.groups["support"][0],
        GridLanes(*(world.read(f"grid_{name}") for name in GridLanes._fields)),
        world.read(World.grid_reach),
        meshed,
    )
    return WorldObject(size, shape, block, memory)


def _for_both(
    scene: Scene,
    world_object: WorldObject,
    primitive: Callable,
    meshed: Callable,
    like: Any,
    near: jax.Array | None = None,
) -> Any:
    """Results of primitive() and meshed() on the lanes that have such an object.

    Lanes that are not `near`, by default none, may get zeros for a mesh.
    """
    if world_object.mesh is None:
        return primitive()
    mine = world_object.mesh.meshed.lane
    size = world_object.block.size
    if len(shapes.mesh_indices(scene)) == len(scene.objects.object):
        return meshed() if near is None else choose(anywhere(near), meshed, like, size)
    plain = choose(anywhere(~mine), primitive, like, size)
    other = choose(anywhere(mine if near is None else near & mine), meshed, like, size)

    return lanewise(_pick, world_object.mesh.meshed, other, plain)


def signed_distance(scene: Scene, world_object: WorldObject, local: Lanes) -> tuple[Lanes, Lanes]:
    """Signed distance (...) and unit gradient (3, ...) at points (3, ...) of the object's frame."""

    def primitive() -> tuple[Lanes, Lanes]:
        def compute(size, shape, local):
            return shapes.primitive_distance(scene, size, shape.astype(jnp.int32), local)

        return lanewise(compute, world_object.size, world_object.shape, local)

    def meshed() -> tuple[Lanes, Lanes]:
        assert world_object.mesh is not None
        grid = world_object.mesh.grid
        cell = lanewise(meshes.locate, grid, local)
        values = _gather(
            world_object.mesh.values, lanewise(meshes.corners, grid, cell), local.dtype
        )
        return lanewise(meshes.interpolate, grid, cell, values)

    none = lanewise(lambda p: (jnp.zeros_like(p[0]), jnp.zeros_like(p)), local)
    return _for_both(scene, world_object, primitive, meshed, none)


def distance_of(scene: Scene, local: jax.Array, variables: dict, fixed: dict) -> tuple:
    """`signed_distance` as a function of arrays that has a derivative.

    Args:
      scene: The scene.
      local: Points (3, ...) in the object's frame.
      variables: Sizes of the object, and origin, cell and factor of a mesh's grid, by name.
      fixed: Index of the object and, with meshes, first value and nodes of the grid, whether the
        object is a mesh, and the distances at the corners of the points' cells, see `cell_values`.
    """
    nearest = None
    shape = fixed["object_id"].astype(jnp.int32)
    if len(shapes.mesh_indices(scene)) < len(scene.objects.object):
        nearest = shapes.primitive_distance(scene, variables["object_size"], shape, local)
    if "meshed" in fixed:
        grid = GridLanes(**{k: (variables | fixed)[f"grid_{k}"] for k in GridLanes._fields})
        new = meshes.interpolate(grid, meshes.locate(grid, local), fixed["values"])
        nearest = new if nearest is None else _pick(fixed["meshed"], new, nearest)
    assert nearest is not None
    return nearest


def cell_values(world_object: WorldObject, local: Lanes) -> Lanes:
    """Distances at the corners of the grid cells in which points (3, ...) lie, shape (8, ...)."""
    assert world_object.mesh is not None
    grid = world_object.mesh.grid
    index = lanewise(lambda g, p: meshes.corners(g, meshes.locate(g, p)), grid, local)
    return _gather(world_object.mesh.values, index, local.dtype)


def points_of(scene: Scene, variables: dict, fixed: dict) -> jax.Array:
    """`table_points` as a function of arrays that has a derivative.

    Args:
      scene: The scene.
      variables: Columns, sizes and, of meshes, factor of the object, by name.
      fixed: As in `distance_of`; of meshes the points themselves, in the object's frame, and the
        factor that they have.
    """
    points = None
    shape = fixed["object_id"].astype(jnp.int32)
    columns = variables["columns"][:, :, 0]
    if len(shapes.mesh_indices(scene)) < len(scene.objects.object):
        points = shapes.primitive_points(scene, variables["object_size"][:, 0], shape, columns)
    if "meshed" in fixed:
        support = fixed["support"] * (variables["grid_factor"] / fixed["factor"])
        new = meshes.turned(columns, support)
        points = new if points is None else _pick(fixed["meshed"], new, points)
    assert points is not None
    return points


def _pick(mine: jax.Array, first: Any, second: Any) -> Any:
    return jax.tree.map(partial(jnp.where, mine), first, second)


def _gather(ref: Any, index: Lanes, dtype: Any) -> Lanes:
    parts = np.empty(index.parts.shape, object)
    for at, where in np.ndenumerate(index.parts):
        parts[at] = ref[(where,)].astype(dtype)
    return Lanes(parts, index.shape, dtype)


def table_points(scene: Scene, world_object: WorldObject, columns: Lanes, height: Lanes) -> Lanes:
    """Four points that may touch the table, from the centre, shape (3, 4, world).

    Height is that of the objects' centres above the table.
    """

    def primitive() -> Lanes:
        def compute(size, shape, columns):
            shape = shape.astype(jnp.int32)
            return shapes.primitive_points(scene, size[:, 0], shape, columns[:, :, 0])

        return lanewise(compute, world_object.size, world_object.shape, columns)

    def meshed() -> Lanes:
        search = partial(_search, world_object, columns)
        (first,) = search(lambda *a: (meshes.lowest(*a),))
        (second,) = search(lambda *a: (meshes.farthest(*a),), first)
        lowest = [first, second, *search(meshes.beside, first, second)]
        return lanewise(lambda points: jnp.concatenate(points, 1), lowest)

    near = None
    if world_object.mesh is not None:
        # A mesh whose centre is higher than its farthest point touches nothing: the search for
        # its points is left out, and zeros, its centre, touch nothing either.
        clear = lanewise(jnp.subtract, height, world_object.mesh.reach)
        near = clear.lane < 0
    none = lanewise(lambda c: jnp.zeros((3, 4, c.shape[-1]), c.dtype), columns)
    return _for_both(scene, world_object, primitive, meshed, none, near)


def _search(
    world_object: WorldObject, columns: Lanes, scores: Callable, *known: Lanes
) -> list[Lanes]:
    """The support points with the largest scores, from the centre, shape (3,), lanes of a world.

    Each finger's lane goes through its part of the points; then the lanes of a world compare.
    Scores takes points (3, finger, world), their indices and known points, see `meshes.lowest`.
    """
    assert world_object.mesh is not None
    block = world_object.block
    support = world_object.mesh.support
    dtype = columns.dtype
    finger = block.finger.astype(dtype)

    def compare(columns, point, index, known, best):
        point = meshes.turned(columns[:, :, 0], point)
        new = scores(point, index, *known)
        if best is None:
            return [(score, index, point) for score in new]
        better = [score > old[0] for score, old in zip(new, best, strict=True)]
        now = [(score, index, point) for score in new]
        return [
            jax.tree.map(partial(jnp.where, b), n, o)
            for b, n, o in zip(better, now, best, strict=True)
        ]

    def row(k: Any, best: Any) -> Any:
        place = finger + block.fingers * jnp.asarray(k).astype(dtype)
        index = lanes([place], (), wide=True)
        return lanewise(compare, columns, support(k), index, known, best)

    best = loop(
        world_object.mesh.rows - 1, lambda k, best: row(k + 1, best), row(0, None), block.size
    )
    return [_among_fingers(block, *b) for b in best]


def _among_fingers(block: Block, score: Lanes, index: Lanes, point: Lanes) -> Lanes:
    """The point of the finger's lane with the largest score, of equal ones the first."""
    mine = score.lane == block.fold(score.lane, jnp.maximum)
    chosen = block.fold(jnp.where(mine, index.lane, _LAST), jnp.minimum)
    mine = mine & (index.lane == chosen)
    parts = [block.fold(jnp.where(mine, p, 0.0), jnp.add) for p in point.parts.ravel()]
    return lanes(parts, (3,), wide=False)
