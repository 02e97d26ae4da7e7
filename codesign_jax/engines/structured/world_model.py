"""Constants of a rollout in lane layout, taken from the same model fields as every engine uses."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanes import dot, total
from codesign_jax.engines.structured.laws.cones import Cones, frictions, make_cones
from codesign_jax.engines.structured.laws.meshes import MeshLanes, mesh_lanes
from codesign_jax.model import Layout, ModelFields, layout
from codesign_jax.model.morphology import at_joints
from codesign_jax.scene import Scene
from codesign_jax.verdict import Bounds, bounds


class WorldModel(NamedTuple):
    """Hand and object of every world; lanes are (finger, world) or (1, world), all lengths SI."""

    # Columns of the finger bases' orientations in the palm frame, shape (3, 3, finger, world)
    mount: jax.Array
    base: jax.Array  # Base positions in the palm frame, shape (3, finger, world)
    offset: jax.Array  # Joint positions along the previous link, shape (link, finger, world)
    mass: jax.Array  # Link masses, shape (link, finger, world)
    centre: jax.Array  # Link centres of mass in the link frame, shape (3, link, finger, world)
    inertia: jax.Array  # Principal inertia of the links, shape (3, link, finger, world)
    stiffness: jax.Array  # Joint stiffness, shape (link, axis, finger, world)
    damping: jax.Array  # Joint damping with the implicit term, same shape
    armature: jax.Array  # Joint armature with the implicit terms, same shape
    # Bending moment per pressure, shape (finger, world); of tapered fingers (link, finger, world)
    gain: jax.Array
    sphere: jax.Array  # Sphere centres in the link frame, shape (3, link, k, finger, world)
    radius: jax.Array  # Sphere radii, shape (link, k, finger, world)
    # Centre of the half segments at the palm in the palm frame, shape (3, finger, world)
    stub_centre: jax.Array
    palm_mass: jax.Array  # Mass of the palm with the half segments, shape (1, world)
    palm_centre: jax.Array  # Its centre of mass in the palm frame, shape (3, 1, world)
    palm_inertia: jax.Array  # Its inertia tensor about that centre, shape (3, 3, 1, world)
    # Centres of the palm's contact spheres in the palm frame, shape (3, sphere, world); empty
    # without palm contacts
    palm_point: jax.Array
    palm_radius: jax.Array  # Their radii, shape (sphere, world)
    wrist_stiffness: jax.Array  # Stiffness of the wrist's springs, shape (6, 1, world)
    wrist_damping: jax.Array  # Damping with the implicit term, shape (6, 1, world)
    wrist_armature: jax.Array  # Armature with the implicit terms, shape (6, 1, world)
    object_mass: jax.Array  # Shape (1, world)
    object_inertia: jax.Array  # Principal inertia, shape (3, 1, world)
    object_size: jax.Array  # Sizes of the object's shape, shape (3, 1, world)
    object_id: jax.Array  # Index of the object's shape, shape (1, world)
    mesh: MeshLanes | None  # Meshes of the worlds; None if the scene has none
    cones: Cones  # Parameters of the contacts
    bounds: Bounds  # When a world is decided, of shape (1, world) each
    # Magnitude of gravity [m/s^2], shape (1, world); None without the effect
    gravity: jax.Array | None = None
    # Height, wall, segment length and width of the fingers at their bases, shape (4, finger,
    # world); None where no effect needs them, see `ModelFields`
    section: jax.Array | None = None
    # Height, wall and width at the tips, shape (3, finger, world); None without taper
    tip: jax.Array | None = None
    # Radius and half the thickness of the palm's disc, shape (2, 1, world); None where nothing
    # touches it
    palm_disc: jax.Array | None = None
    # Numbers of `model.morphology.thresholds`, shape (1, 3, finger, world), of tapered fingers
    # (link, 3, finger, world); None without the effect `lateral_threshold`
    threshold: jax.Array | None = None
    # Exponent of the air and the atmosphere's pressure, shape (2, 1, world); None without the
    # effect `air_mass`
    air: jax.Array | None = None
    # See `cones.frictions`, shape (n, 1, world); None where all is as the table
    friction: jax.Array | None = None


def sections(hand: WorldModel, places: np.ndarray) -> tuple[Any, Any, Any]:
    """Height, wall and width of fingers at shares of their length, (place, finger, world) each.

    The axis of the places has length 1 where fingers are not tapered.
    """
    assert hand.section is not None
    base = [hand.section[k][None] for k in (0, 1, 3)]
    if hand.tip is None:
        return base[0], base[1], base[2]
    share = np.asarray(places, hand.section.dtype)[:, None, None]
    found = [a + share * (b - a) for a, b in zip(base, hand.tip, strict=True)]
    return found[0], found[1], found[2]


def joint_sections(hand: WorldModel, links: int) -> jax.Array:
    """As `WorldModel.section`, at each joint, shape (link, 4, finger, world); see `sections`."""
    assert hand.section is not None
    height, wall, width = sections(hand, at_joints(links))
    return jnp.stack([height, wall, 0 * height + hand.section[2], width], 1)


def rotation_columns(quat: jax.Array) -> jax.Array:
    """Columns of the rotation matrix of unit quaternions, (4, ...) to (3 columns, 3, ...)."""
    w, x, y, z = jnp.unstack(quat)
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]),
            jnp.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]),
            jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def apply_columns(columns: jax.Array, v: jax.Array) -> jax.Array:
    """Rotates vectors: columns times components, (3, 3, ...) and (3, ...); items broadcast."""
    parts = jnp.unstack(_items(columns, v))
    return total([column * x for column, x in zip(parts, jnp.unstack(v), strict=True)])


def apply_rows(columns: jax.Array, v: jax.Array) -> jax.Array:
    """Rotates vectors back, the inverse of `apply_columns`: rows times components."""
    parts = jnp.unstack(_items(columns, v), axis=1)
    return total([row * x for row, x in zip(parts, jnp.unstack(v), strict=True)])


def turn_columns(columns: jax.Array, frames: jax.Array) -> jax.Array:
    """Rotates frames given by their columns, (3, 3, ...) both: `apply_columns` of each column."""
    turned = apply_columns(columns[:, :, None], jnp.moveaxis(frames, 1, 0))
    return jnp.moveaxis(turned, 1, 0)


def _items(columns: jax.Array, v: jax.Array) -> jax.Array:
    """The columns with as many axes of items, behind the first two, as the vectors have."""
    missing = v.ndim + 1 - columns.ndim
    if missing <= 0:
        return columns
    return columns.reshape(3, 3, *[1] * missing, *columns.shape[2:])


def world_constants(scene: Scene, fields: ModelFields) -> WorldModel:
    """Transposes batched model fields, leading axis (world,), into lane layout.

    A rollout asks for them at its start and in the engine, and traces them once.
    """

    # Apart from what is around it, XLA rounds it alike in every program. Each array by itself: one
    # that the scene's effects do not ask for leaves the program.
    def apart(tree: Any) -> Any:
        return jax.tree.map(jax.lax.optimization_barrier, tree)

    return apart(_world_constants(scene.structure, apart(fields)))


@partial(jax.jit, static_argnums=0)
def _world_constants(scene: Scene, fields: ModelFields) -> WorldModel:
    lay = layout(scene)

    def last(array: jax.Array) -> jax.Array:
        return jnp.moveaxis(array, 0, -1)

    def by_link(array: jax.Array, ids: np.ndarray) -> jax.Array:
        """(world, item, ...) at ids (finger, link, ...) to (..., link, ..., finger, world)."""
        picked = jnp.moveaxis(array[:, ids], 1, -1)  # (world, link, ..., finger)
        return last(picked)

    def vectors(array: jax.Array, ids: np.ndarray) -> jax.Array:
        picked = jnp.moveaxis(array[:, ids], -1, 1)  # (world, 3, finger, ...)
        return last(jnp.moveaxis(picked, 2, -1))

    mount = rotation_columns(vectors(fields.body_quat, lay.stubs))
    base = vectors(fields.body_pos, lay.stubs)
    stub_centre = base + apply_columns(mount, vectors(fields.body_ipos, lay.stubs))
    palm = _palm(fields, lay.stubs, mount, stub_centre, last)
    sizes = fields.geom_size[:, lay.object_geoms]
    shape = fields.shape
    picked = jnp.take_along_axis(sizes, shape[:, None, None], axis=1)[:, 0]
    object_size = last(picked)[:, None]
    no_spheres = lay.spheres.size == 0
    numbers = jax.tree.map(lambda v: v[None], fields.constants)
    return WorldModel(
        mount=mount,
        base=base,
        offset=by_link(fields.body_pos[..., 0], lay.bodies),
        mass=by_link(fields.body_mass, lay.bodies),
        centre=vectors(fields.body_ipos, lay.bodies),
        inertia=vectors(fields.body_inertia, lay.bodies),
        stiffness=by_link(fields.jnt_stiffness, lay.dofs),
        damping=by_link(fields.dof_damping, lay.dofs),
        armature=by_link(fields.dof_armature, lay.dofs),
        gain=_gain(fields, lay, last),
        sphere=jnp.zeros((0,)) if no_spheres else vectors(fields.geom_pos, lay.spheres),
        radius=jnp.zeros((0,)) if no_spheres else by_link(fields.geom_size[..., 0], lay.spheres),
        stub_centre=stub_centre,
        palm_mass=palm[0],
        palm_centre=palm[1],
        palm_inertia=palm[2],
        palm_point=jnp.moveaxis(last(fields.geom_pos[:, lay.palm]), 0, 1),
        palm_radius=last(fields.geom_size[:, lay.palm, 0]),
        wrist_stiffness=last(fields.actuator_gainprm[:, :6, 0])[:, None],
        wrist_damping=last(fields.dof_damping[:, :6])[:, None],
        wrist_armature=last(fields.dof_armature[:, :6])[:, None],
        object_mass=last(fields.body_mass[:, lay.object])[None],
        object_inertia=last(fields.body_inertia[:, lay.object])[:, None],
        object_size=object_size,
        object_id=shape[None],
        mesh=mesh_lanes(scene, shape[None], object_size),
        cones=make_cones(numbers, shape[None]),
        friction=frictions(numbers),
        bounds=bounds(numbers),
        gravity=-fields.gravity[None, :, 2] if scene.effects.gravity else None,
        section=None if fields.section is None else fields.section.transpose(2, 1, 0),
        tip=None if fields.tip is None else fields.tip.transpose(2, 1, 0),
        threshold=None if fields.threshold is None else fields.threshold.transpose(2, 3, 1, 0),
        palm_disc=_disc(numbers) if lay.disc.size or lay.palm.size else None,
        air=_air(numbers) if scene.effects.air_mass else None,
    )


def _disc(scene: Scene) -> jax.Array:
    palm = scene.hand.palm
    return jnp.stack([jnp.asarray(palm.radius), jnp.asarray(palm.thickness) / 2])


def _air(scene: Scene) -> jax.Array:
    p = scene.pneumatics
    return jnp.stack([jnp.asarray(p.exponent), jnp.asarray(p.atmosphere)])


def _gain(fields: ModelFields, lay: Layout, last: Callable) -> jax.Array:
    of_finger = last(fields.actuator_gainprm[:, 6 : 6 + len(lay.stubs), 0])
    if fields.wrap_prm is None:
        return of_finger
    share = fields.wrap_prm.reshape(-1, len(lay.stubs), lay.links)
    return share.transpose(2, 1, 0) * of_finger


def _palm(fields: ModelFields, stubs: np.ndarray, mount: jax.Array, stub_centre: jax.Array, last):
    """Mass, centre and inertia of the palm with its half segments, in the palm frame."""
    masses = jnp.concatenate([last(fields.body_mass[:, 1])[None], last(fields.body_mass[:, stubs])])
    palm_centre = last(fields.body_ipos[:, 1])[:, None]
    centres = jnp.concatenate([palm_centre, stub_centre], 1)
    palm_principal = last(fields.body_inertia[:, 1])[:, None]
    stub_principal = last(jnp.moveaxis(fields.body_inertia[:, stubs], -1, 1))
    eye = jnp.broadcast_to(
        jnp.eye(3, dtype=masses.dtype)[:, :, None, None], (3, 3, *palm_centre.shape[1:])
    )
    frames = jnp.concatenate([eye, mount], 2)
    principal = jnp.concatenate([palm_principal, stub_principal], 1)
    mass = masses.sum(0, keepdims=True)
    centre = (masses * centres).sum(1, keepdims=True) / mass
    away = centres - centre
    own = total([principal[k] * frames[k][:, None] * frames[k][None] for k in range(3)])
    unit = jnp.eye(3, dtype=masses.dtype)[:, :, None, None]
    shift = masses * (dot(away, away) * unit - away[:, None] * away[None])
    return mass, centre, (own + shift).sum(2, keepdims=True)
