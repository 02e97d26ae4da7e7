"""Constants of a rollout in lane layout, taken from the model fields."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanes import dot, total
from codesign_jax.engines.structured.laws.cones import Cones, frictions, make_cones
from codesign_jax.engines.structured.laws.meshes import MeshLanes, mesh_lanes
from codesign_jax.engines.structured.laws.step_numbers import step_numbers
from codesign_jax.judge.verdict import Bounds, bounds
from codesign_jax.model import Layout, ModelFields, layout
from codesign_jax.model.layout import implicit_spring, palm_points, wrist_springs
from codesign_jax.model.morphology import at_joints
from codesign_jax.model.spec import palm_inertia
from codesign_jax.scene import Scene


class WorldModel(NamedTuple):
    """Hand and object of every world; lanes are (finger, world) or (1, world), all lengths SI."""

    # Columns of the finger bases' orientations in the palm frame, shape (3, 3, finger, world)
    mount: jax.Array
    base: jax.Array  # Base positions in the palm frame, shape (3, finger, world)
    share: jax.Array  # Share of a finger in the hand's centre, see `ModelFields`, (finger, world)
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
    # Those of `laws.step_numbers` that the scene has, by name, shape (..., 1, world)
    step_numbers: dict[str, jax.Array]
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
    # See `ModelFields`, shape (1, number, finger, world), of tapered fingers (link, number, finger,
    # world); None with the law "chamber"
    law: jax.Array | None = None


def sections(hand: WorldModel, places: np.ndarray) -> tuple[Any, Any, Any]:
    """Height, wall and width of fingers at places along them, (place, finger, world) each.

    Places are 0 at the base and 1 at the tip.  Their axis has length 1 where fingers are not
    tapered.
    """
    assert hand.section is not None
    base = [hand.section[k][None] for k in (0, 1, 3)]
    if hand.tip is None:
        return base[0], base[1], base[2]
    along = np.asarray(places, hand.section.dtype)[:, None, None]
    sizes = [a + along * (b - a) for a, b in zip(base, hand.tip, strict=True)]
    return sizes[0], sizes[1], sizes[2]


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
    numbers = jax.tree.map(lambda v: v[None], fields.constants)

    def last(array: jax.Array) -> jax.Array:
        return jnp.moveaxis(array, 0, -1)

    def by_link(array: jax.Array) -> jax.Array:
        """(world, finger, link, ...) to (link, ..., finger, world)."""
        return last(jnp.moveaxis(array, 1, -1))

    def vectors(array: jax.Array) -> jax.Array:
        """(world, finger, ..., 3) to (3, ..., finger, world)."""
        return last(jnp.moveaxis(jnp.moveaxis(array, -1, 1), 2, -1))

    mount = rotation_columns(vectors(fields.mount))
    base = vectors(fields.base)
    centre = vectors(_along_and_up(fields.centre))
    stub_centre = base + apply_columns(mount, centre[:, 0])
    inertia = vectors(fields.inertia)
    shape = fields.shape
    picked = jnp.take_along_axis(fields.object_size, shape[:, None, None], axis=1)[:, 0]
    object_size = last(picked)[:, None]
    palm_point, palm_radius = _palm_points(numbers, lay, fields.object_mass[None])
    no_spheres = lay.spheres.size == 0
    return WorldModel(
        mount=mount,
        base=base,
        share=last(fields.share),
        offset=by_link(fields.offset),
        mass=by_link(fields.mass)[1:],
        centre=centre[:, 1:],
        inertia=inertia[:, 1:],
        stiffness=by_link(fields.stiffness),
        damping=by_link(fields.damping),
        armature=by_link(fields.armature),
        gain=by_link(fields.gain) if scene.hand.section.tapered else last(fields.gain[..., 0]),
        sphere=jnp.zeros((0,)) if no_spheres else vectors(_along_and_up(fields.spheres)),
        radius=jnp.zeros((0,)) if no_spheres else by_link(fields.spheres[..., 1]),
        stub_centre=stub_centre,
        **_palm(numbers, fields, stub_centre, inertia[:, 0], mount),
        palm_point=palm_point,
        palm_radius=palm_radius,
        **_wrist(numbers, fields.object_mass[None]),
        object_mass=fields.object_mass[None],
        object_inertia=last(fields.object_inertia)[:, None],
        object_size=object_size,
        object_id=shape[None],
        mesh=mesh_lanes(scene, shape[None], object_size),
        cones=make_cones(numbers, shape[None]),
        friction=frictions(numbers),
        bounds=bounds(numbers),
        step_numbers={k: jnp.asarray(n.value(numbers)) for k, n in step_numbers(scene).items()},
        section=None if fields.section is None else fields.section.transpose(2, 1, 0),
        tip=None if fields.tip is None else fields.tip.transpose(2, 1, 0),
        threshold=None if fields.threshold is None else fields.threshold.transpose(2, 3, 1, 0),
        law=None if fields.law is None else fields.law.transpose(2, 3, 1, 0),
        palm_disc=_disc(numbers) if lay.disc.size or lay.palm.size else None,
        air=_air(numbers) if scene.effects.air_mass else None,
    )


def _disc(scene: Scene) -> jax.Array:
    palm = scene.hand.palm
    return jnp.stack([jnp.asarray(palm.radius), jnp.asarray(palm.thickness) / 2])


def _air(scene: Scene) -> jax.Array:
    p = scene.pneumatics
    return jnp.stack([jnp.asarray(p.exponent), jnp.asarray(p.atmosphere)])


def _along_and_up(places: jax.Array) -> jax.Array:
    """Places in links' frames from those along and up, (..., 2) to (..., 3)."""
    along = places[..., 0]
    return jnp.stack([along, jnp.zeros_like(along), places[..., 1]], -1)


def _wrist(scene: Scene, like: jax.Array) -> dict[str, jax.Array]:
    """The wrist's stiffness, damping and armature with the implicit terms, by field.

    Their shape is (6, 1, world).

    Args:
      scene: Numbers of shape (1, world).
      like: An array of that shape.
    """

    def rows(values: list) -> jax.Array:
        return jnp.stack([jnp.broadcast_to(jnp.asarray(v, like.dtype), like.shape) for v in values])

    stiffness, wrist_damping = map(rows, wrist_springs(scene))
    rigid = not scene.effects.wrist
    damping, armature = implicit_spring(scene, stiffness, wrist_damping, rigid=rigid)
    return {
        "wrist_stiffness": stiffness,
        "wrist_damping": damping,
        "wrist_armature": armature,
    }


def _palm_points(scene: Scene, lay: Layout, like: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Centres (3, sphere, world) and radii (sphere, world) of the palm's contact spheres."""
    count = len(lay.palm)
    if not count:
        return jnp.zeros((3, 0, like.shape[1]), like.dtype), jnp.zeros((0, like.shape[1]))
    radius = jnp.broadcast_to(scene.hand.palm.contact_radius, (count, like.shape[1]))
    return jnp.moveaxis(palm_points(scene)[:, :, 0], 0, 1), radius


def _palm(
    scene: Scene, fields: ModelFields, centres: jax.Array, inertia: jax.Array, mount: jax.Array
) -> dict[str, jax.Array]:
    """Mass, centre and inertia of the palm with its half segments, in the palm frame, by field.

    Args:
      scene: Numbers of shape (1, world).
      centres: Centres of the half segments there, shape (3, finger, world).
      inertia: Their principal inertia, same shape.
      mount: Columns of their orientations, shape (3, 3, finger, world).
    """
    palm = scene.hand.palm
    none = jnp.zeros_like(palm.mass)
    masses = jnp.concatenate([palm.mass, fields.mass[:, :, 0].T])
    palm_centre = jnp.stack([none, none, palm.thickness / 2])
    centres = jnp.concatenate([palm_centre, centres], 1)
    eye = jnp.broadcast_to(
        jnp.eye(3, dtype=masses.dtype)[:, :, None, None], (3, 3, *palm_centre.shape[1:])
    )
    frames = jnp.concatenate([eye, mount], 2)
    principal = jnp.concatenate([jnp.stack(palm_inertia(scene)), inertia], 1)
    mass = masses.sum(0, keepdims=True)
    centre = (masses * centres).sum(1, keepdims=True) / mass
    away = centres - centre
    turned = total([principal[k] * frames[k][:, None] * frames[k][None] for k in range(3)])
    unit = jnp.eye(3, dtype=masses.dtype)[:, :, None, None]
    shift = masses * (dot(away, away) * unit - away[:, None] * away[None])
    return {
        "palm_mass": mass,
        "palm_centre": centre,
        "palm_inertia": (turned + shift).sum(2, keepdims=True),
    }
