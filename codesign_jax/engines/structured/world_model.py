"""Constants of a rollout: the rows of the kernel's tables by name, with the worlds last.

They are computed for one finger and one world; `jax.vmap` puts fingers, then worlds, behind.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanes import apply_columns, dot, rotation_columns, total
from codesign_jax.engines.structured.laws.air import straight_volume
from codesign_jax.engines.structured.laws.cones import Cones, frictions, make_cones
from codesign_jax.engines.structured.laws.meshes import MeshLanes, mesh_lanes
from codesign_jax.engines.structured.laws.rings import RING_OVERLAP
from codesign_jax.engines.structured.laws.step_numbers import step_numbers
from codesign_jax.judge.verdict import Bounds, bounds
from codesign_jax.model import ModelFields, layout
from codesign_jax.model.held import rings_of_link
from codesign_jax.model.layout import (
    RING_TIP,
    implicit_spring,
    palm_points,
    palm_touches,
    ring_places,
    wrist_springs,
)
from codesign_jax.model.morphology import at_joints
from codesign_jax.model.spec import palm_inertia
from codesign_jax.scene import Scene

PALM = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Places of the rings that the palm's disc is made of, and their half axes, in half radii."""


class WorldModel(NamedTuple):
    """Hand and object of every world, all lengths SI, in the rows that `rows` declares.

    An array has the axes of its row in `rows.Hand` or `rows.World`, then those of the lanes,
    (finger, world) or (1, world).  What the scene's effects do not need is None.
    """

    mount: jax.Array  # Columns of the bases' orientations in the palm frame, (3, 3, finger, world)
    base: jax.Array  # Base positions in the palm frame, shape (3, finger, world)
    # Centre of the half segments at the palm in the palm frame, shape (3, finger, world)
    stub_centre: jax.Array
    # Weights of palm's half segment and links in the hand's centre, (link + 1, finger, world)
    centre_weight: jax.Array
    # Bending moment per pressure, shape (1, finger, world); of tapered fingers (link, ...)
    gain: jax.Array
    offset: jax.Array  # Joint positions along the previous link, shape (link, finger, world)
    mass: jax.Array  # Link masses, same shape
    centre: jax.Array  # Link centres of mass in the link frame, shape (link, 3, finger, world)
    inertia: jax.Array  # Principal inertia of the links, shape (link, 3, finger, world)
    stiffness: jax.Array  # Joint stiffness, shape (link, axis, finger, world)
    damping: jax.Array  # Joint damping with the implicit term, same shape
    armature: jax.Array  # Joint armature with the implicit terms, same shape
    palm_mass: jax.Array  # Mass of the palm with the half segments, shape (1, world)
    palm_centre: jax.Array  # Its centre of mass in the palm frame, shape (3, 1, world)
    palm_inertia: jax.Array  # Its inertia tensor about that centre, shape (3, 3, 1, world)
    wrist_stiffness: jax.Array  # Stiffness of the wrist's springs, shape (6, 1, world)
    wrist_damping: jax.Array  # Damping with the implicit term, shape (6, 1, world)
    wrist_armature: jax.Array  # Armature with the implicit terms, shape (6, 1, world)
    object_mass: jax.Array  # Shape (1, world)
    object_inertia: jax.Array  # Principal inertia, shape (3, 1, world)
    object_size: jax.Array  # Sizes of the object's shape, shape (3, 1, world)
    object_id: jax.Array  # Index of the object's shape, int32 of shape (1, world)
    mesh: MeshLanes | None  # Meshes of the worlds
    cones: Cones  # Parameters of the contacts
    bounds: Bounds  # When a world is decided, of shape (1, world) each
    # Those of `laws.step_numbers` that the scene has, by name, shape (..., 1, world)
    step_numbers: dict[str, jax.Array]
    # Numbers of `laws.rings.Ring` of the fingers' rings or spheres, link by link, shape
    # (link * k, 8, finger, world)
    ring: jax.Array | None
    palm_ring: jax.Array | None  # The same of the palm's, shape (ring, 8, 1, world)
    # Height, wall, segment length and width of the fingers at their joints, shape
    # (1, 4, finger, world); of tapered fingers (link, ...)
    section: jax.Array | None
    # Numbers of `model.morphology.thresholds`, shape (1, 3, finger, world), of tapered fingers
    # (link, ...)
    threshold: jax.Array | None
    law: jax.Array | None  # See `ModelFields`, shape (1, n, finger, world), of tapered (link, ...)
    growth: jax.Array | None  # Likewise, shape (1, 4, finger, world), of tapered (link, ...)
    first_pressure: jax.Array | None  # Likewise, shape (finger, world)
    volume: jax.Array | None  # Of a straight finger's chamber, shape (finger, world)
    # Radius and half the thickness of the palm's disc, shape (2, 1, world)
    palm_disc: jax.Array | None
    air: jax.Array | None  # Exponent of the air and the atmosphere's pressure, shape (2, 1, world)
    friction: jax.Array | None  # See `cones.frictions`, shape (n, 1, world)

    def by_row(self) -> dict[str, Any]:
        """The arrays by the names of their rows, but for those of meshes."""
        arrays = self._asdict()
        cones = arrays.pop("cones")._asdict()
        arrays |= arrays.pop("bounds")._asdict() | arrays.pop("step_numbers")
        for name, cone in cones.items():
            if cone is not None:
                arrays[f"cone.{name}"] = jnp.stack([v for v in cone if v is not None])
        return arrays


def world_constants(scene: Scene, fields: ModelFields) -> WorldModel:
    """Constants of batched model fields, leading axis (world,).

    A rollout asks for them at its start and in the engine, and traces them once.
    """

    # Apart from what is around it, XLA rounds it alike in every program. Each array by itself: one
    # that the scene's effects do not ask for leaves the program.
    def apart(tree: Any) -> Any:
        return jax.tree.map(jax.lax.optimization_barrier, tree)

    return apart(_world_constants(scene.structure, apart(fields)))


@partial(jax.jit, static_argnums=0)
def _world_constants(scene: Scene, fields: ModelFields) -> WorldModel:
    hand = jax.vmap(partial(_world, scene), out_axes=-1)(fields)
    # Grids are the scene's: worlds look up where theirs are.
    return hand._replace(mesh=mesh_lanes(scene, hand.object_id, hand.object_size))


OF_FINGERS = {
    name: 0
    for name in (
        "base mount offset mass centre inertia stiffness damping armature gain spheres share "
        "section threshold tip law growth first_pressure"
    ).split()
}
"""Model fields with a leading axis (finger,), for `jax.vmap`."""


def _world(scene: Scene, fields: ModelFields) -> WorldModel:
    """The constants of one world, without meshes."""
    by_finger = ModelFields(**(dict.fromkeys(ModelFields._fields) | OF_FINGERS))  # type: ignore[arg-type]
    fingers = jax.vmap(partial(_finger, scene), (by_finger,), -1)(fields)
    numbers = fields.constants
    lay = layout(scene)
    world = {
        **_palm(numbers, fields, fingers),
        **_wrist(numbers, fields.mass.dtype),
        "object_mass": fields.object_mass,
        "object_inertia": fields.object_inertia,
        "object_size": fields.object_size[fields.shape],
        "object_id": fields.shape,
        "cones": make_cones(numbers, fields.shape),
        "bounds": bounds(numbers),
        "step_numbers": {k: n.value(numbers) for k, n in step_numbers(scene).items()},
        "palm_ring": _palm_rings(numbers, fields) if palm_touches(scene) else None,
        "palm_disc": _disc(numbers) if lay.disc.size or lay.palm.size else None,
        "air": _air(numbers) if scene.effects.air_mass else None,
        "friction": frictions(numbers),
    }
    lanes = jax.tree.map(lambda v: jnp.asarray(v)[..., None], world)
    return WorldModel(**fingers, **lanes, mesh=None)


def _finger(scene: Scene, fields: ModelFields) -> dict[str, Any]:
    """The constants of one finger by their names in `WorldModel`.

    Args:
      scene: The scene.
      fields: Fields of which those of `OF_FINGERS` are the finger's.
    """
    mount = rotation_columns(fields.mount)
    centre = _along_and_up(fields.centre)
    # Half segments at the palm and at the tip weigh half.
    weight = np.ones(len(fields.mass), fields.mass.dtype)
    weight[[0, -1]] = 0.5
    section = None if fields.section is None else _joint_sections(scene, fields)
    volume = None
    if scene.effects.air_mass:
        assert section is not None
        volume = straight_volume(fields.gain, section, len(fields.offset))
    return {
        "mount": mount,
        "base": fields.base,
        "stub_centre": fields.base + apply_columns(mount, centre[0]),
        "centre_weight": weight * fields.share,
        "gain": fields.gain,
        "offset": fields.offset,
        "mass": fields.mass[1:],
        "centre": centre[1:],
        "inertia": fields.inertia[1:],
        "stiffness": fields.stiffness,
        "damping": fields.damping,
        "armature": fields.armature,
        "ring": ring_numbers(scene, fields) if rings_of_link(scene) else None,
        "section": section,
        "threshold": fields.threshold,
        "law": fields.law,
        "growth": fields.growth,
        "first_pressure": fields.first_pressure,
        "volume": volume,
    }


def _along_and_up(places: jax.Array) -> jax.Array:
    """Places in links' frames from those along and up, (..., 2) to (..., 3)."""
    along = places[..., 0]
    return jnp.stack([along, jnp.zeros_like(along), places[..., 1]], -1)


def _sections(fields: ModelFields, places: np.ndarray) -> tuple[Any, Any, Any]:
    """Height, wall and width of a finger at places along it, shape (place,) each.

    Places are 0 at the base and 1 at the tip.  Their axis has length 1 where fingers are not
    tapered.
    """
    assert fields.section is not None
    base = [fields.section[k][None] for k in (0, 1, 3)]
    if fields.tip is None:
        return base[0], base[1], base[2]
    along = np.asarray(places, fields.section.dtype)
    sizes = [a + along * (b - a) for a, b in zip(base, fields.tip, strict=True)]
    return sizes[0], sizes[1], sizes[2]


def _joint_sections(scene: Scene, fields: ModelFields) -> jax.Array:
    """See `WorldModel.section`, of one finger."""
    assert fields.section is not None
    height, wall, width = _sections(fields, at_joints(scene.discretization.links))
    return jnp.stack([height, wall, 0 * height + fields.section[2], width], 1)


def ring_numbers(scene: Scene, fields: ModelFields) -> jax.Array:
    """Numbers of a finger's rings or spheres, shape (link * k, 8), k of a link.

    The numbers of an item are those of `laws.rings.Ring`: centre in the link's frame, half axes
    (a sphere's radius), length of the finger that it stands for in widths, and 1 for the tip.

    Args:
      scene: The scene, for its surface and discretization.
      fields: One finger's fields: `section` [m], shape (4,), and `tip`, shape (3,) or None; of
        spheres `spheres` alone, shape (N, k, 2).
    """
    if scene.effects.surface == "spheres":
        place, radius = jnp.unstack(fields.spheres, axis=-1)
        none = jnp.zeros_like(place)
        columns = [place, none, radius, radius, radius, radius, none + 1.0, none]
        return jnp.stack(columns, -1).reshape(-1, len(columns))
    assert fields.section is not None
    segment, skin_width = fields.section[2:]
    links = scene.discretization.links
    k = rings_of_link(scene)
    along = ring_places(links, k)
    places = (along + np.arange(links)[:, None] + 0.5) / links
    height, _, width = _sections(fields, places.ravel())
    length = np.full((links, k), 1.0 / k)
    length[-1] *= 0.5
    half = RING_OVERLAP * length
    half[-1, -1] = RING_TIP
    tip = np.zeros((links, k))
    tip[-1, -1] = 1.0
    along, length, half, tip = (v.ravel() for v in (along, length, half, tip))
    columns = [along * segment, 0.0, 0.5 * height, half * segment, 0.5 * width, 0.5 * height]
    # The skin is as stiff everywhere: a narrower section stands for less of it.
    if fields.tip is None:
        widths = length * segment / width
    else:
        widths = length * segment * width / skin_width**2
    columns += [widths, tip]
    return jnp.stack([jnp.broadcast_to(jnp.asarray(v, width.dtype), tip.shape) for v in columns], 1)


def _palm_rings(scene: Scene, fields: ModelFields) -> jax.Array:
    """Numbers of the palm's rings or spheres, see `WorldModel.palm_ring`, shape (ring, 8).

    Args:
      scene: Numbers of one world.
      fields: Its fields.
    """
    dtype = fields.mass.dtype
    if scene.effects.surface == "spheres":
        points = palm_points(scene)
        radius = scene.hand.palm.contact_radius
        rows = [[*point, radius, radius, radius, 1.0, 0.0] for point in jnp.unstack(points)]
    else:
        assert fields.section is not None
        radius, thick = jnp.unstack(_disc(scene))
        width = fields.section[0, 3]
        half = 0.5 * radius
        widths = 4.0 * half**2 / width**2
        rows = [[x * half, y * half, thick, half, half, thick, widths, 0.0] for x, y in PALM]
    return jnp.stack([jnp.stack([jnp.asarray(v, dtype) for v in row]) for row in rows])


def _disc(scene: Scene) -> jax.Array:
    palm = scene.hand.palm
    return jnp.stack([jnp.asarray(palm.radius), jnp.asarray(palm.thickness) / 2])


def _air(scene: Scene) -> jax.Array:
    p = scene.pneumatics
    return jnp.stack([jnp.asarray(p.exponent), jnp.asarray(p.atmosphere)])


def _wrist(scene: Scene, dtype: Any) -> dict[str, jax.Array]:
    """The wrist's stiffness, damping and armature with the implicit terms, shape (6,), by field.

    Args:
      scene: Numbers of one world.
      dtype: Type of the arrays.
    """

    def joints(values: list) -> jax.Array:
        return jnp.stack([jnp.asarray(v, dtype) for v in values])

    stiffness, wrist_damping = map(joints, wrist_springs(scene))
    rigid = not scene.effects.wrist
    damping, armature = implicit_spring(scene, stiffness, wrist_damping, rigid=rigid)
    return {
        "wrist_stiffness": stiffness,
        "wrist_damping": damping,
        "wrist_armature": armature,
    }


def _palm(scene: Scene, fields: ModelFields, fingers: dict[str, Any]) -> dict[str, jax.Array]:
    """Mass, centre and inertia of the palm with its half segments, in the palm frame, by field.

    Args:
      scene: Numbers of one world.
      fields: Its fields.
      fingers: Its fingers' constants.
    """
    palm = scene.hand.palm
    mount = fingers["mount"]
    none = jnp.zeros_like(palm.mass)
    masses = jnp.concatenate([jnp.asarray(palm.mass)[None], fields.mass[:, 0]])
    palm_centre = jnp.stack([none, none, palm.thickness / 2])[:, None]
    centres = jnp.concatenate([palm_centre, fingers["stub_centre"]], 1)
    unit = jnp.eye(3, dtype=masses.dtype)[:, :, None]
    frames = jnp.concatenate([unit, mount], 2)
    disc = jnp.stack(palm_inertia(scene))[:, None]
    principal = jnp.concatenate([disc, fields.inertia[:, 0].T], 1)
    mass = masses.sum()
    centre = (masses * centres).sum(1) / mass
    away = centres - centre[:, None]
    turned = total([principal[k] * frames[k][:, None] * frames[k][None] for k in range(3)])
    shift = masses * (dot(away, away) * unit - away[:, None] * away[None])
    return {
        "palm_mass": mass,
        "palm_centre": centre,
        "palm_inertia": (turned + shift).sum(2),
    }
