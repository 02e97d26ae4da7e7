"""MuJoCo's arrays of a world, for the engines `mujoco` and `mjx` and for models of one world."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.model import pairs
from codesign_jax.model.fields import ModelFields, picked
from codesign_jax.model.layout import (
    Layout,
    contact_invweight,
    friction_ratio,
    geom_bounds,
    geom_sizes,
    implicit_spring,
    layout,
    palm_points,
    wrist_springs,
)
from codesign_jax.model.spec import compile_template, palm_inertia
from codesign_jax.scene import Scene, by_structure


class MujocoFields(NamedTuple):
    """The fields of mjModel that depend on parameters, trial and constants.

    Every array has MuJoCo's name and shape for one world, `gravity` and `impratio` those of
    mjOption.
    """

    body_pos: jax.Array
    body_quat: jax.Array
    body_ipos: jax.Array
    body_mass: jax.Array
    body_subtreemass: jax.Array
    body_inertia: jax.Array
    geom_pos: jax.Array
    geom_size: jax.Array
    geom_rbound: jax.Array
    geom_aabb: jax.Array
    jnt_stiffness: jax.Array
    dof_damping: jax.Array
    dof_armature: jax.Array
    dof_M0: jax.Array
    actuator_gainprm: jax.Array
    actuator_biasprm: jax.Array
    body_invweight0: jax.Array
    pair_friction: jax.Array
    pair_solref: jax.Array
    pair_solimp: jax.Array
    gravity: jax.Array
    impratio: jax.Array
    wrap_prm: jax.Array | None = None
    # Of fingers of spheres that touch the palm: a short one's first spheres do not
    pair_margin: jax.Array | None = None

    @property
    def of_model(self) -> dict[str, jax.Array]:
        """The fields of mjModel by name, those of its mjOption as "opt.name"."""
        options = ("gravity", "impratio")
        arrays = {k: v for k, v in self._asdict().items() if v is not None}
        return {f"opt.{k}" if k in options else k: v for k, v in arrays.items()}


def mujoco_fields(scene: Scene, fields: ModelFields, numpy: Any = jnp) -> MujocoFields:
    """Returns MuJoCo's arrays of one world; pure, vmap it for batches.

    Args:
      scene: A scene of the structure of the fields'; its numbers are not read.
      fields: The world's.
      numpy: The module that computes: NumPy outside of JAX, in float64 as MuJoCo C wants it.
    """
    template = compile_template(scene)
    lay = layout(scene)
    dtype = fields.mass.dtype
    numbers = fields.constants

    def filled(name: str, *parts: tuple[Any, Any]) -> jax.Array:
        return _filled(numpy, getattr(template, name), dtype, *parts)

    wrist, damping, armature = _dofs(numpy, scene, fields)
    gain = numpy.broadcast_to(fields.gain, lay.dofs.shape[:2])
    tapered = scene.hand.section.tapered
    # The law of sections has the moments of springs and chambers, which engines apply.
    passive = 1.0 if fields.law is None else 0.0
    geom_size, rbound, aabb = _geom_fields(numpy, scene, fields, filled)
    friction, solref, solimp = _pairs(numpy, numbers, dtype)
    return MujocoFields(
        **_body_fields(numpy, lay, fields, filled),
        geom_pos=filled("geom_pos", *_sphere_positions(numpy, numbers, fields)),
        geom_size=geom_size,
        geom_rbound=rbound,
        geom_aabb=aabb,
        # The wrist's springs are its position actuators; only the fingers have passive ones.
        jnt_stiffness=filled("jnt_stiffness", (lay.dofs, passive * fields.stiffness)),
        dof_damping=damping,
        dof_armature=armature,
        # MuJoCo takes the inertia of a free body from this constant; of other bodies it does not.
        dof_M0=filled(
            "dof_M0",
            (slice(-6, -3), fields.object_mass),
            (slice(-3, None), fields.object_inertia),
        ),
        actuator_gainprm=filled(
            "actuator_gainprm",
            ((slice(6), 0), wrist),
            ((slice(6, None), 0), passive * gain[:, 0]),
        ),
        actuator_biasprm=filled("actuator_biasprm", ((slice(6), 1), -wrist)),
        pair_friction=friction,
        pair_solref=solref,
        pair_solimp=solimp,
        gravity=_filled(numpy, np.zeros(3), dtype, (2, -numbers.gravity_on)),
        impratio=friction_ratio(numbers, numbers.contact.friction_ratio),
        wrap_prm=(gain / gain[:, :1]).reshape(-1) if tapered else None,
        pair_margin=None if fields.on_palm is None else _margins(numpy, scene, fields.on_palm),
    )


def _body_fields(
    numpy: Any, lay: Layout, fields: ModelFields, filled: Callable[..., jax.Array]
) -> dict[str, jax.Array]:
    """Places, masses and inertias of all bodies, by the names of MuJoCo's arrays."""
    numbers = fields.constants
    palm = numbers.hand.palm
    body = lay.object
    bodies = np.concatenate([lay.stubs[:, None], lay.bodies], 1)
    return dict(
        body_pos=filled("body_pos", (lay.stubs, fields.base), ((lay.bodies, 0), fields.offset)),
        body_quat=filled("body_quat", (lay.stubs, fields.mount)),
        body_ipos=filled(
            "body_ipos",
            ((bodies, 0), fields.centre[..., 0]),
            ((bodies, 2), fields.centre[..., 1]),
            ((1, 2), palm.thickness / 2),
        ),
        body_mass=filled(
            "body_mass", (1, palm.mass), (bodies, fields.mass), (body, fields.object_mass)
        ),
        body_subtreemass=filled(
            "body_subtreemass", *_subtree_mass(numpy, lay, palm, fields.mass, fields.object_mass)
        ),
        body_inertia=filled(
            "body_inertia",
            (bodies, fields.inertia),
            (body, fields.object_inertia),
            (1, numpy.stack(palm_inertia(numbers))),
        ),
        # Declared, not derived; see contact_invweight.  The world keeps zero.
        body_invweight0=filled("body_invweight0", (slice(1, None), contact_invweight(numbers))),
    )


def _dofs(numpy: Any, scene: Scene, fields: ModelFields) -> tuple[Any, Any, Any]:
    """Stiffness of the wrist's dofs (6,), and damping and armature of all dofs, (nv,) each."""
    lay = layout(scene)
    dtype = fields.mass.dtype
    springs = wrist_springs(fields.constants)
    stiffness, damping = (numpy.stack([numpy.asarray(v, dtype) for v in k]) for k in springs)
    rigid = not scene.effects.wrist
    wrist = implicit_spring(fields.constants, stiffness, damping, rigid=rigid)
    free = numpy.zeros(6, dtype)

    def by_dof(wrist: Any, joints: Any) -> Any:
        return numpy.concatenate([wrist, _picked(numpy, joints.ravel(), lay.hinges), free])

    return stiffness, by_dof(wrist[0], fields.damping), by_dof(wrist[1], fields.armature)


def _picked(numpy: Any, array: Any, places: np.ndarray) -> Any:
    return array[places] if numpy is np else picked(array, places)


def _filled(numpy: Any, base: np.ndarray, dtype: Any, *parts: tuple[Any, Any]) -> jax.Array:
    """An array with other numbers in known places, where the last part wins.

    One gather of all numbers: a CPU's XLA makes a loop of every `.at[places].set(values)`.
    """
    source = np.arange(base.size, dtype=np.int32).reshape(base.shape)
    numbers = [numpy.asarray(base, dtype).ravel()]
    count = base.size
    for places, part in parts:
        values = numpy.asarray(part, dtype)
        source[places] = np.arange(count, count + values.size).reshape(values.shape)
        numbers.append(values.ravel())
        count += values.size
    return _picked(numpy, numpy.concatenate(numbers), source)


@by_structure
def _pair_kinds(scene: Scene) -> np.ndarray:
    template = compile_template(scene)
    lay = layout(scene)
    kinds = np.zeros(template.npair, np.int32)  # see layout: one width in every precision
    for i, pair in enumerate(zip(template.pair_geom1, template.pair_geom2, strict=True)):
        touched = np.isin(lay.object_geoms, pair)
        if min(pair) <= len(scene.fixture):  # the table or a fixture
            table = pairs.OBJECT_TABLE if touched.any() else pairs.FINGER_TABLE
            kinds[i] = pairs.around(scene, min(pair), table)
        elif np.isin(lay.disc, pair).any():
            kinds[i] = pairs.PALM
        else:
            kinds[i] = np.argmax(touched) if touched.any() else pairs.FINGERS
    return np.where(kinds < 0, kinds + len(pairs.frictions(scene)), kinds).astype(np.int32)


def _pairs(numpy: Any, scene: Scene, dtype: Any) -> list[jax.Array]:
    """MuJoCo's friction (pair, 5), solref (pair, 2) and solimp (pair, 5) of the contact pairs."""
    kinds = _pair_kinds(scene)
    tables = (pairs.frictions(scene), pairs.impedances(scene))
    columns = (numpy.stack([numpy.asarray(v, dtype) for v in values])[kinds] for values in tables)
    return [
        numpy.stack([numpy.broadcast_to(numpy.asarray(v, dtype), len(kinds)) for v in row], -1)
        for row in pairs.numbers(scene, *columns)
    ]


def _margins(numpy: Any, scene: Scene, on_palm: jax.Array) -> jax.Array:
    """MuJoCo's margin of the contact pairs [m], shape (pair,)."""
    lay = layout(scene)
    template = compile_template(scene)
    geoms = np.stack([template.pair_geom1, template.pair_geom2], 1)
    with_disc = (geoms == lay.disc).any(1)
    sphere = np.where(with_disc, geoms.max(1) - lay.spheres.min(), 0)  # behind the disc
    margins = pairs.margin(_picked(numpy, on_palm.ravel(), sphere))
    return numpy.where(with_disc, margins, 0.0)


def _subtree_mass(
    numpy: Any, lay: Layout, palm: Any, masses: jax.Array, object_mass: jax.Array
) -> list[tuple]:
    tails = numpy.cumsum(masses[:, ::-1], 1)[:, ::-1]
    hand = palm.mass + tails[:, 0].sum()
    fingers = [(lay.stubs, tails[:, 0]), (lay.bodies, tails[:, 1:])]
    return [*fingers, (0, hand + object_mass), (1, hand), (lay.object, object_mass)]


def _sphere_positions(numpy: Any, scene: Scene, fields: ModelFields) -> list[tuple]:
    lay = layout(scene)
    parts: list[tuple] = [(lay.palm, palm_points(scene, numpy))] if lay.palm.size else []
    if lay.disc.size:
        parts.append(((lay.disc, 2), numpy.asarray(scene.hand.palm.thickness) / 2))
    if not lay.spheres.size:
        return parts
    along, radius = (fields.spheres[..., i] for i in range(2))
    return [*parts, ((lay.spheres, 0), along), ((lay.spheres, 2), radius)]


def _geom_fields(
    numpy: Any, scene: Scene, fields: ModelFields, filled: Callable
) -> tuple[jax.Array, jax.Array, jax.Array]:
    lay = layout(scene)
    sizes: list[tuple] = []
    radii: list[tuple] = []
    boxes: list[tuple] = []
    palm = fields.constants.hand.palm
    spheres = [(lay.palm, palm.contact_radius)] if lay.palm.size else []
    if lay.spheres.size:
        spheres.append((lay.spheres, fields.spheres[..., 1]))
    for where, radius in spheres:
        sizes.append(((where, 0), radius))
        radii.append((where, radius))
        boxes.append(((where, slice(3, None)), numpy.asarray(radius)[..., None]))
    shapes = scene.objects.object
    extents = geom_sizes(fields.object_size, fields.shape, numpy)
    solids = [
        (g, s.type, extents[i])
        for i, (g, s) in enumerate(zip(lay.object_geoms, shapes, strict=True))
    ]
    if lay.disc.size:
        disc = numpy.stack([numpy.asarray(v) for v in (palm.radius, palm.thickness / 2, 0.0)])
        solids.append((lay.disc[0], "cylinder", disc))
    for g, kind, extent in solids:
        radius, half = geom_bounds(kind, extent, numpy)
        sizes.append((g, extent))
        radii.append((g, radius))
        boxes.append(((g, slice(3, None)), half))
    return filled("geom_size", *sizes), filled("geom_rbound", *radii), filled("geom_aabb", *boxes)
