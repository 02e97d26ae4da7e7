"""Parameters to batched model fields, as a pure function: one topology, no recompile."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.model import morphology
from codesign_jax.model.layout import (
    Layout,
    contact_invweight,
    geom_bounds,
    implicit_damping,
    layout,
    mounts,
    object_quat,
    object_size,
    palm_points,
    wrist_springs,
)
from codesign_jax.model.spec import SOLIMP, compile_template, palm_inertia
from codesign_jax.scene import Constants, Scene, by_structure
from codesign_jax.scene.constants import with_trial
from codesign_jax.types import Params, Trial


class ModelFields(NamedTuple):
    """The fields of mjModel that depend on parameters, trial and constants, and the start state.

    Every array has MuJoCo's name and shape for one world, `gravity` and `impratio` those of
    mjOption, but for three: `start` is the initial qpos, shape (nq,); `section` has height, wall,
    segment length and width of the fingers [m], shape (finger, 4), with the effect `neo_hookean` or
    the surface "hull", None without; and `constants` are the world's numbers with the trial's
    factors, from which engines take what MuJoCo has no field for: limits, the cost's window, and
    friction by pair of bodies.
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
    start: jax.Array
    constants: Constants
    section: jax.Array | None = None

    @property
    def of_model(self) -> dict[str, jax.Array]:
        """The fields of mjModel by name, those of its mjOption as "opt.name"."""
        others, options = ("start", "section", "constants"), ("gravity", "impratio")
        fields = {k: v for k, v in self._asdict().items() if k not in others}
        return {f"opt.{k}" if k in options else k: v for k, v in fields.items()}


def joint_springs(scene: Scene, params: Params) -> tuple[jax.Array, jax.Array]:
    """Returns physical stiffness [N m/rad] and damping [N m s/rad] of every dof, (nv,) each.

    Finger joints have k = EI / l and GJ / l for a segment of length l and damping beta k
    (Kelvin-Voigt); the six wrist dofs those of the hand file; the object's are free.
    """
    lay, hand = layout(scene), scene.hand
    beam = morphology.finger_beams(hand, params)
    segment = params.length / lay.links
    by_axis = {"bend": beam.bending, "lateral": beam.lateral, "twist": beam.torsion}
    finger = jnp.stack([by_axis[name] / segment for name in lay.axes], -1)
    finger = jnp.broadcast_to(finger[:, None, :], lay.dofs.shape).reshape(-1)
    springs = wrist_springs(scene)
    wrist, wrist_damping = (jnp.stack([jnp.asarray(x, finger.dtype) for x in v]) for v in springs)
    free = jnp.zeros(6, finger.dtype)
    stiffness = jnp.concatenate([wrist, finger, free])
    return stiffness, jnp.concatenate([wrist_damping, hand.material.damping_time * finger, free])


def model_fields(scene: Scene, params: Params, trial: Trial) -> ModelFields:
    """Returns the batched model fields and the start state of one world; pure, vmap it for batches.

    Args:
      scene: The scene; of `Scene.with_constants` if its numbers are traced.
      params: Parameters of the hand; all physics in the float type of these.
      trial: The trial's object and noise.
    """
    template, lay, dtype = compile_template(scene), layout(scene), params.length.dtype
    scene = _in_type(with_trial(scene, trial), dtype)
    beam = morphology.finger_beams(scene.hand, params)

    def base(name: str) -> jax.Array:
        return jnp.asarray(getattr(template, name), dtype)

    segment = params.length / lay.links
    extents = _extents(segment, lay)
    masses = beam.line_density[:, None] * extents
    size, object_mass, object_inertia, rest = object_size(scene, trial)
    bodies = np.concatenate([lay.stubs[:, None], lay.bodies], 1)
    mount_pos, mount_quat = mounts(scene, params.spread)
    offsets = jnp.concatenate(
        [segment[:, None] / 2, jnp.broadcast_to(segment[:, None], masses[:, 2:].shape)], 1
    )
    palm = scene.hand.palm
    mass = base("body_mass").at[1].set(palm.mass).at[bodies].set(masses)
    mass = mass.at[lay.object].set(object_mass)
    h = scene.discretization.timestep
    stiffness, damping = joint_springs(scene, params)
    implicit = implicit_damping(scene, stiffness, damping)
    geom_size, rbound, aabb = _geom_fields(scene, params, size, base)
    bias = base("actuator_biasprm").at[:6, 1].set(-stiffness[:6])
    gain = base("actuator_gainprm").at[:6, 0].set(stiffness[:6])
    friction, solref, solimp = _pairs(scene, dtype)
    return ModelFields(
        body_pos=base("body_pos").at[lay.stubs].set(mount_pos).at[lay.bodies, 0].set(offsets),
        body_quat=base("body_quat").at[lay.stubs].set(mount_quat),
        body_ipos=_centres(base("body_ipos"), bodies, extents, params.height)
        .at[1, 2]
        .set(palm.thickness / 2),
        body_mass=mass,
        body_subtreemass=_subtree_mass(lay, mass, masses, base("body_subtreemass")),
        body_inertia=_link_inertia(scene, params, base("body_inertia"), bodies, masses, extents)
        .at[lay.object]
        .set(object_inertia)
        .at[1]
        .set(jnp.stack(palm_inertia(scene))),
        geom_pos=_sphere_positions(scene, params, extents, base("geom_pos")),
        geom_size=geom_size,
        geom_rbound=rbound,
        geom_aabb=aabb,
        # The wrist's springs are its position actuators; only the fingers have passive ones.
        jnt_stiffness=base("jnt_stiffness").at[lay.dofs].set(stiffness[lay.dofs]),
        dof_damping=implicit,
        dof_armature=h * implicit,
        # MuJoCo takes the inertia of a free body from this constant; of other bodies it does not.
        dof_M0=base("dof_M0").at[-6:-3].set(object_mass).at[-3:].set(object_inertia),
        actuator_gainprm=gain.at[6:, 0].set(beam.moment_per_pressure),
        actuator_biasprm=bias,
        # Declared, not derived; see contact_invweight.  The world keeps zero.
        body_invweight0=base("body_invweight0").at[1:].set(contact_invweight(scene)),
        pair_friction=friction,
        pair_solref=solref,
        pair_solimp=solimp,
        gravity=jnp.zeros(3, dtype).at[2].set(-scene.gravity_on),
        impratio=scene.contact.friction_ratio,
        start=_start(scene, params, trial, rest),
        constants=scene.constants(),
        section=_section(scene, params),
    )


def _in_type(scene: Scene, dtype: Any) -> Scene:
    """The scene with its numbers as arrays of a float type."""
    return scene.with_constants(jax.tree.map(lambda v: jnp.asarray(v, dtype), scene.constants()))


def _section(scene: Scene, params: Params) -> jax.Array | None:
    if not (scene.effects.neo_hookean or scene.effects.surface == "hull"):
        return None
    width = scene.hand.section.width + 0 * params.height
    return jnp.stack([params.height, params.wall, params.length / layout(scene).links, width], -1)


@by_structure
def _pair_kinds(scene: Scene) -> np.ndarray:
    """Which friction each of the template's contact pairs has, an index into `_frictions`."""
    template, lay = compile_template(scene), layout(scene)
    shapes = len(scene.objects.object)
    kinds = np.zeros(template.npair, np.int32)  # see layout: one width in every precision
    for i, pair in enumerate(zip(template.pair_geom1, template.pair_geom2, strict=True)):
        touched = np.isin(lay.object_geoms, pair)
        if 0 in pair:  # the table
            kinds[i] = shapes if touched.any() else shapes + 1
        else:
            kinds[i] = np.argmax(touched) if touched.any() else shapes + 2
    return kinds


def _frictions(scene: Scene) -> jax.Array:
    """Coefficients of the hand on each shape, table on object, table on hand, between fingers."""
    shapes, c = [shape.friction for shape in scene.objects.object], scene.contact
    rest = [scene.objects.table.friction, c.finger_table_friction, c.finger_finger_friction]
    return jnp.stack([*shapes, *rest])


def _pairs(scene: Scene, dtype: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """MuJoCo's friction (pair, 5), solref (pair, 2) and solimp (pair, 5) of the contact pairs."""
    c, kinds = scene.contact, _pair_kinds(scene)
    slide = _frictions(scene)[kinds]
    spin, roll = (v + 0 * slide for v in (c.torsional_friction, c.rolling_friction))
    solref = jnp.stack([c.time_constant, jnp.ones((), dtype)])
    solimp = jnp.stack([c.impedance, c.impedance, *(jnp.asarray(v, dtype) for v in SOLIMP)])
    solref, solimp = (jnp.broadcast_to(v, (len(kinds), v.size)) for v in (solref, solimp))
    return jnp.stack([slide, slide, spin, roll, roll], -1), solref, solimp


def softening_moments(scene: Scene, fields: ModelFields, angles: Any) -> Any:
    """Moments that take the linear springs of the bend joints to the neo-Hookean law [N m].

    MuJoCo's springs stay as they are, and with them the implicit step, which is stable as the law's
    tangent is at most the spring's; what the law lacks is applied as a force known from the step's
    start.

    Args:
      scene: The scene.
      fields: Fields with `section`; leading axes as `angles`.
      angles: Bend angles [rad], shape (..., finger, link); NumPy or JAX arrays.

    Returns:
      Moments, shaped as `angles`.
    """
    assert fields.section is not None
    height, wall, segment, width = (fields.section[..., i : i + 1] for i in range(4))
    stiffness = fields.jnt_stiffness[..., layout(scene).dofs[..., 0]]
    return stiffness * angles * morphology.softening(angles / segment, height, wall, width=width)


def _extents(segment: jax.Array, lay: Layout) -> jax.Array:
    """Length of each body of a finger, shape (finger, N + 1): half segments at both ends."""
    factor = np.ones(lay.links + 1)
    factor[[0, -1]] = 0.5
    return segment[:, None] * factor


def _centres(
    ipos: jax.Array, bodies: np.ndarray, extents: jax.Array, height: jax.Array
) -> jax.Array:
    ipos = ipos.at[bodies, 0].set(extents / 2)
    return ipos.at[bodies, 2].set(jnp.broadcast_to(height[:, None] / 2, bodies.shape))


def _link_inertia(
    scene: Scene,
    params: Params,
    inertia: jax.Array,
    bodies: np.ndarray,
    masses: jax.Array,
    extents: jax.Array,
) -> jax.Array:
    """Inertia of each link as the block extent x width x height."""
    width, height = jnp.asarray(scene.hand.section.width), params.height[:, None]
    return inertia.at[bodies].set(
        jnp.stack(morphology.block_inertia(masses, extents, width, height), -1)
    )


def _subtree_mass(lay: Layout, mass: jax.Array, masses: jax.Array, subtree: jax.Array) -> jax.Array:
    tails = jnp.cumsum(masses[:, ::-1], 1)[:, ::-1]
    hand = mass[1] + tails[:, 0].sum()
    subtree = subtree.at[lay.stubs].set(tails[:, 0]).at[lay.bodies].set(tails[:, 1:])
    total = hand + mass[lay.object]
    return subtree.at[0].set(total).at[1].set(hand).at[lay.object].set(mass[lay.object])


def _sphere_positions(
    scene: Scene, params: Params, extents: jax.Array, geom_pos: jax.Array
) -> jax.Array:
    """Spheres spread evenly over each moving link, tangent to the bottom layer, and the palm's."""
    lay = layout(scene)
    if lay.palm.size:
        geom_pos = geom_pos.at[lay.palm].set(palm_points(scene))
    if not lay.spheres.size:
        return geom_pos
    k = lay.spheres.shape[2]
    along = extents[:, 1:, None] * (np.arange(k) + 0.5) / k
    up = jnp.broadcast_to(params.height[:, None, None] / 2, lay.spheres.shape)
    return geom_pos.at[lay.spheres, 0].set(along).at[lay.spheres, 2].set(up)


def _geom_fields(
    scene: Scene, params: Params, size: jax.Array, base
) -> tuple[jax.Array, jax.Array, jax.Array]:
    lay = layout(scene)
    geom_size, rbound, aabb = base("geom_size"), base("geom_rbound"), base("geom_aabb")
    if lay.palm.size:
        radius = scene.hand.palm.contact_radius
        geom_size, rbound = geom_size.at[lay.palm, 0].set(radius), rbound.at[lay.palm].set(radius)
        aabb = aabb.at[lay.palm, 3:].set(radius)
    if lay.spheres.size:
        radius = jnp.broadcast_to(params.height[:, None, None] / 2, lay.spheres.shape)
        geom_size = geom_size.at[lay.spheres, 0].set(radius)
        rbound = rbound.at[lay.spheres].set(radius)
        aabb = aabb.at[lay.spheres, 3:].set(radius[..., None])
    for i, shape in enumerate(scene.objects.object):
        g = lay.object_geoms[i]
        r, half = geom_bounds(shape.type, size[i])
        geom_size, rbound, aabb = (
            geom_size.at[g].set(size[i]),
            rbound.at[g].set(r),
            aabb.at[g, 3:].set(half),
        )
    return geom_size, rbound, aabb


def _start(scene: Scene, params: Params, trial: Trial, rest: jax.Array) -> jax.Array:
    """Start state: palm at the arm's first pose, straight fingers, object at rest."""
    arm, tilt, dtype = params.arm, trial.arm_tilt, params.arm.dtype
    height = jnp.asarray(scene.arm.start_height, dtype)
    wrist = jnp.stack([arm[0], arm[1], height, arm[3] + tilt[0], arm[5], tilt[1] - arm[4]])
    fingers = jnp.zeros(layout(scene).dofs.size, dtype)
    parts = [wrist, fingers, trial.position, rest[None], object_quat(scene, trial)]
    return jnp.concatenate(parts).astype(dtype)
