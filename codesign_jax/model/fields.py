"""Parameters to batched model fields, as a pure function: one topology, no recompile."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.model import morphology, pairs
from codesign_jax.model.layout import (
    Layout,
    contact_invweight,
    friction_ratio,
    geom_bounds,
    implicit_spring,
    layout,
    mounts,
    object_pose,
    object_size,
    palm_points,
    wrist_springs,
)
from codesign_jax.model.spec import compile_template, palm_inertia
from codesign_jax.scene import Scene, by_structure, key_frames
from codesign_jax.scene.constants import with_trial
from codesign_jax.types import Params, Trial


class ModelFields(NamedTuple):
    """The fields of mjModel that depend on parameters, trial and constants, and the start state.

    Every array has MuJoCo's name and shape for one world, `gravity` and `impratio` those of
    mjOption, but for five: `start` is the initial qpos, shape (nq,), or the state in which another
    rollout ended, `Trace.last`, see `RolloutState`; `section` has height, wall, segment length and
    width of the fingers [m], shape (finger, 4), where `neo_hookean`, `air_mass` or a hull needs
    them;
    `threshold` has the numbers of `morphology.thresholds`, with the effect `lateral_threshold`;
    `tip` has height, wall and width at the tips of tapered fingers, shape (finger, 3), and
    `constants` are the world's numbers with the trial's factors, from which engines take what
    MuJoCo has no field for: limits, the cost's window, and friction by pair of bodies.
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
    shape: jax.Array
    constants: Scene
    section: jax.Array | None = None
    threshold: jax.Array | None = None
    tip: jax.Array | None = None
    wrap_prm: jax.Array | None = None
    # Of fingers of spheres that touch the palm: a short one's first spheres do not
    pair_margin: jax.Array | None = None

    @property
    def qpos(self) -> jax.Array:
        """Generalized positions at the start, shape (..., nq)."""
        return self.start[..., : self.dof_damping.shape[-1] + 1]

    @property
    def qvel(self) -> Any:
        """Generalized velocities at the start, shape (..., nv); zero unless `start` has them."""
        nv = self.dof_damping.shape[-1]
        given = self.start[..., nv + 1 : 2 * nv + 1]
        return given if given.shape[-1] else np.zeros(self.dof_damping.shape, self.start.dtype)

    @property
    def of_model(self) -> dict[str, jax.Array]:
        """The fields of mjModel by name, those of its mjOption as "opt.name"."""
        others = ("start", "shape", "section", "threshold", "tip", "constants")
        options = ("gravity", "impratio")
        given = {k: v for k, v in self._asdict().items() if v is not None}
        fields = {k: v for k, v in given.items() if k not in others}
        return {f"opt.{k}" if k in options else k: v for k, v in fields.items()}


def joint_springs(scene: Scene, params: Params) -> tuple[jax.Array, jax.Array]:
    """Returns physical stiffness [N m/rad] and damping [N m s/rad] of every dof, (nv,) each.

    Finger joints have those of `morphology.joint_springs`, the six wrist dofs those of the hand
    file; the object's are free.
    """
    lay = layout(scene)
    hand = scene.hand
    beams = morphology.finger_beams(hand, params, lay.links)
    each = morphology.joint_springs(hand, params, beams, lay.links, lay.axes)
    finger, own = (_picked(jnp.broadcast_to(v, lay.dofs.shape).ravel(), lay.hinges) for v in each)
    springs = wrist_springs(scene)
    wrist, wrist_damping = (jnp.stack([jnp.asarray(x, finger.dtype) for x in v]) for v in springs)
    free = jnp.zeros(6, finger.dtype)
    stiffness = jnp.concatenate([wrist, finger, free])
    return stiffness, jnp.concatenate([wrist_damping, own, free])


def model_fields(scene: Scene, params: Params, trial: Trial) -> ModelFields:
    """Returns the batched model fields and the start state of one world; pure, vmap it for batches.

    Args:
      scene: The scene; its numbers may be traced.
      params: Parameters of the hand; all physics in the float type of these.
      trial: The trial's object and noise.
    """
    template = compile_template(scene)
    lay = layout(scene)
    dtype = params.length.dtype
    scene = _in_type(with_trial(scene, trial), dtype)
    beam = morphology.finger_beams(scene.hand, params, lay.links)

    def filled(name: str, *parts: tuple[Any, Any]) -> jax.Array:
        return _filled(getattr(template, name), dtype, *parts)

    links = morphology.segments(scene.hand, params, lay.links)
    gains = beam.moment_per_pressure
    extents = links.extent
    masses = links.mass
    size, object_mass, object_inertia = object_size(scene.objects, trial)
    bodies = np.concatenate([lay.stubs[:, None], lay.bodies], 1)
    mount_pos, mount_quat = mounts(scene.hand, params.spread)
    palm = scene.hand.palm
    stiffness, damping = joint_springs(scene, params)
    rigid = not scene.effects.wrist
    wrist = implicit_spring(scene, stiffness[:6], damping[:6], rigid=rigid)
    others = implicit_spring(scene, stiffness[6:], damping[6:])
    damping, armature = (jnp.concatenate(parts) for parts in zip(wrist, others, strict=True))
    geom_size, rbound, aabb = _geom_fields(scene, params, size, filled)
    friction, solref, solimp = _pairs(scene, dtype)
    return ModelFields(
        body_pos=filled("body_pos", (lay.stubs, mount_pos), ((lay.bodies, 0), links.offset)),
        body_quat=filled("body_quat", (lay.stubs, mount_quat)),
        body_ipos=filled(
            "body_ipos",
            ((bodies, 0), links.along),
            ((bodies, 2), links.up),
            ((1, 2), palm.thickness / 2),
        ),
        body_mass=filled("body_mass", (1, palm.mass), (bodies, masses), (lay.object, object_mass)),
        body_subtreemass=filled("body_subtreemass", *_subtree_mass(lay, palm, masses, object_mass)),
        body_inertia=filled(
            "body_inertia",
            (bodies, links.inertia),
            (lay.object, object_inertia),
            (1, jnp.stack(palm_inertia(scene))),
        ),
        geom_pos=filled("geom_pos", *_sphere_positions(scene, params, extents)),
        geom_size=geom_size,
        geom_rbound=rbound,
        geom_aabb=aabb,
        # The wrist's springs are its position actuators; only the fingers have passive ones.
        jnt_stiffness=filled("jnt_stiffness", (lay.dofs, _picked(stiffness, lay.dofs))),
        dof_damping=damping,
        dof_armature=armature,
        # MuJoCo takes the inertia of a free body from this constant; of other bodies it does not.
        dof_M0=filled("dof_M0", (slice(-6, -3), object_mass), (slice(-3, None), object_inertia)),
        actuator_gainprm=filled(
            "actuator_gainprm",
            ((slice(6), 0), stiffness[:6]),
            ((slice(6, None), 0), gains[:, 0]),
        ),
        actuator_biasprm=filled("actuator_biasprm", ((slice(6), 1), -stiffness[:6])),
        # Declared, not derived; see contact_invweight.  The world keeps zero.
        body_invweight0=filled("body_invweight0", (slice(1, None), contact_invweight(scene))),
        pair_friction=friction,
        pair_solref=solref,
        pair_solimp=solimp,
        gravity=_filled(np.zeros(3), dtype, (2, -scene.gravity_on)),
        impratio=friction_ratio(scene, scene.contact.friction_ratio),
        start=_start(scene, params, trial),
        shape=jnp.asarray(trial.shape, jnp.int32),
        constants=scene.bare,
        section=_section(scene, params),
        threshold=(
            morphology.thresholds(scene.hand, params, beam, lay.links)
            if scene.effects.lateral_threshold
            else None
        ),
        wrap_prm=None if params.tip is None else (gains / gains[:, :1]).reshape(-1),
        tip=None if params.tip is None else jnp.stack(params.tip, -1),
        pair_margin=_margins(scene, params) if lay.disc.size and lay.spheres.size else None,
    )


def _filled(base: np.ndarray, dtype: Any, *parts: tuple[Any, Any]) -> jax.Array:
    """An array with other numbers in known places, where the last part wins.

    One gather of all numbers: a CPU's XLA makes a loop of every `.at[places].set(values)`.
    """
    source = np.arange(base.size, dtype=np.int32).reshape(base.shape)
    numbers = [jnp.asarray(base, dtype).ravel()]
    count = base.size
    for places, given in parts:
        values = jnp.asarray(given, dtype)
        source[places] = np.arange(count, count + values.size).reshape(values.shape)
        numbers.append(values.ravel())
        count += values.size
    return _picked(jnp.concatenate(numbers), source)


def _picked(array: jax.Array, places: np.ndarray) -> jax.Array:
    # Without operations that check the places.
    return array.at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _in_type(scene: Scene, dtype: Any) -> Scene:
    return jax.tree.map(lambda v: jnp.asarray(v, dtype), scene)


def _section(scene: Scene, params: Params) -> jax.Array | None:
    e = scene.effects
    if not (e.neo_hookean or e.air_mass or e.surface == "hull"):
        return None
    width = scene.hand.section.width + 0 * params.height
    return jnp.stack([params.height, params.wall, params.length / layout(scene).links, width], -1)


@by_structure
def _pair_kinds(scene: Scene) -> np.ndarray:
    template = compile_template(scene)
    lay = layout(scene)
    kinds = np.zeros(template.npair, np.int32)  # see layout: one width in every precision
    for i, pair in enumerate(zip(template.pair_geom1, template.pair_geom2, strict=True)):
        touched = np.isin(lay.object_geoms, pair)
        if min(pair) <= len(scene.fixture):  # the table or a fixture
            table = pairs.OBJECT_TABLE if touched.any() else pairs.HAND_TABLE
            kinds[i] = pairs.around(scene, min(pair), table)
        elif np.isin(lay.disc, pair).any():
            kinds[i] = pairs.PALM
        else:
            kinds[i] = np.argmax(touched) if touched.any() else pairs.FINGERS
    return np.where(kinds < 0, kinds + len(pairs.frictions(scene)), kinds).astype(np.int32)


def _pairs(scene: Scene, dtype: Any) -> list[jax.Array]:
    """MuJoCo's friction (pair, 5), solref (pair, 2) and solimp (pair, 5) of the contact pairs."""
    kinds = _pair_kinds(scene)
    found = (pairs.frictions(scene), pairs.impedances(scene))
    own = (jnp.stack([jnp.asarray(v, dtype) for v in values])[kinds] for values in found)
    return [
        jnp.stack([jnp.broadcast_to(jnp.asarray(v, dtype), len(kinds)) for v in row], -1)
        for row in pairs.numbers(scene, *own)
    ]


def _margins(scene: Scene, params: Params) -> jax.Array:
    """MuJoCo's margin of the contact pairs [m], shape (pair,)."""
    lay = layout(scene)
    template = compile_template(scene)
    geoms = np.stack([template.pair_geom1, template.pair_geom2], 1)
    on_palm = (geoms == lay.disc).any(1)
    sphere = np.where(on_palm, geoms.max(1) - lay.spheres.min(), 0)  # behind the disc
    free = morphology.spheres_on_palm(scene.hand, params, *lay.spheres.shape[1:])
    margins = pairs.margin(_picked(jnp.ravel(free), sphere))
    return jnp.where(on_palm, margins, 0.0).astype(params.length.dtype)


def softening_moments(scene: Scene, fields: ModelFields, angles: Any) -> Any:
    """Moments that take the linear springs of the bend joints to the neo-Hookean law [N m].

    MuJoCo's springs stay as they are, and with them the implicit step, which is stable as the law's
    tangent is at most the spring's; what the law lacks is applied as a force known from the step's
    start.

    Args:
      fields: Fields with `section`; leading axes as `angles`.
      angles: Bend angles [rad], shape (..., finger, link); NumPy or JAX arrays.

    Returns:
      Moments, shaped as `angles`.
    """
    assert fields.section is not None
    height, wall, segment, width = (fields.section[..., i : i + 1] for i in range(4))
    if fields.tip is not None:
        places = morphology.at_joints(layout(scene).links)
        ends = zip((height, wall, width), range(3), strict=True)
        height, wall, width = (a + (fields.tip[..., i : i + 1] - a) * places for a, i in ends)
    stiffness = fields.jnt_stiffness[..., layout(scene).dofs[..., 0]]
    return stiffness * angles * morphology.softening(angles / segment, height, wall, width=width)


def _subtree_mass(lay: Layout, palm: Any, masses: jax.Array, object_mass: jax.Array) -> list[tuple]:
    tails = jnp.cumsum(masses[:, ::-1], 1)[:, ::-1]
    hand = palm.mass + tails[:, 0].sum()
    fingers = [(lay.stubs, tails[:, 0]), (lay.bodies, tails[:, 1:])]
    return [*fingers, (0, hand + object_mass), (1, hand), (lay.object, object_mass)]


def _sphere_positions(scene: Scene, params: Params, extents: jax.Array) -> list[tuple]:
    lay = layout(scene)
    parts: list[tuple] = [(lay.palm, palm_points(scene))] if lay.palm.size else []
    if lay.disc.size:
        parts.append(((lay.disc, 2), jnp.asarray(scene.hand.palm.thickness) / 2))
    if not lay.spheres.size:
        return parts
    count = lay.spheres.shape[2]
    along = morphology.sphere_places(extents, count)
    up = morphology.sphere_radii(scene.hand, params, lay.links, count)
    return [*parts, ((lay.spheres, 0), along), ((lay.spheres, 2), up)]


def _geom_fields(
    scene: Scene, params: Params, size: jax.Array, filled: Callable
) -> tuple[jax.Array, jax.Array, jax.Array]:
    lay = layout(scene)
    sizes: list[tuple] = []
    radii: list[tuple] = []
    boxes: list[tuple] = []
    palm = scene.hand.palm
    spheres = [(lay.palm, palm.contact_radius)] if lay.palm.size else []
    if lay.spheres.size:
        count = lay.spheres.shape[2]
        radius = morphology.sphere_radii(scene.hand, params, lay.links, count)
        spheres.append((lay.spheres, radius))
    for where, radius in spheres:
        sizes.append(((where, 0), radius))
        radii.append((where, radius))
        boxes.append(((where, slice(3, None)), jnp.asarray(radius)[..., None]))
    solids = [
        (g, s.type, size[i])
        for i, (g, s) in enumerate(zip(lay.object_geoms, scene.objects.object, strict=True))
    ]
    if lay.disc.size:
        disc = jnp.stack([jnp.asarray(v) for v in (palm.radius, palm.thickness / 2, 0.0)])
        solids.append((lay.disc[0], "cylinder", disc))
    for g, kind, extent in solids:
        radius, half = geom_bounds(kind, extent)
        sizes.append((g, extent))
        radii.append((g, radius))
        boxes.append(((g, slice(3, None)), half))
    return filled("geom_size", *sizes), filled("geom_rbound", *radii), filled("geom_aabb", *boxes)


def _start(scene: Scene, params: Params, trial: Trial) -> jax.Array:
    tilt = trial.arm_tilt
    dtype = params.arm.dtype
    x, y, z, roll, pitch, yaw = key_frames.poses(scene, params, 1)[0]
    wrist = jnp.stack([x, y, z, roll + tilt[0], yaw, tilt[1] - pitch])
    fingers = jnp.zeros(layout(scene).dofs.size, dtype)
    rest, quat = object_pose(scene.objects, trial)
    parts = [wrist, fingers, trial.position, rest[None], quat]
    return jnp.concatenate(parts).astype(dtype)
