"""Parameters and a trial to the numbers of a world, as a pure function: no recompile for others."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.model import morphology
from codesign_jax.model.layout import (
    implicit_spring,
    layout,
    mounts,
    object_pose,
    object_size,
    sections_grow,
    wrist_springs,
)
from codesign_jax.scene import Scene, key_frames, section_law, section_numbers
from codesign_jax.scene.constants import with_trial
from codesign_jax.types import Params, Trial

ABSENT = 1e-6
"""Length [m] with which a finger of length 0 is computed: it weighs less than a milligram."""
AWAY = (0.0, 0.0, 0.25)
"""Where it stands in the palm's frame [m]: above the palm, where no other finger reaches."""
UPWARDS = (0.5**0.5, 0.0, -(0.5**0.5), 0.0)
"""Its orientation: it points away from the palm."""


class ModelFields(NamedTuple):
    """The hand and the object of a world as numbers, and the state in which it starts.

    They are in the order of fingers and links; `mujoco_fields` makes MuJoCo's arrays of them. A
    finger has N + 1 bodies, of which the first one, half a segment, belongs to the palm, and N
    joints with an axis each for `layout.joint_axes`.

    Attributes:
      base: Base points of the fingers in the palm frame [m], shape (finger, 3).
      mount: Their orientations, unit quaternions, shape (finger, 4).
      offset: Place of each joint along the body before it [m], shape (finger, N).
      mass: Masses of the bodies [kg], shape (finger, N + 1).
      centre: Their centres of mass from their beginnings: along and up [m], shape
        (finger, N + 1, 2).
      inertia: Their principal inertia [kg m^2], shape (finger, N + 1, 3).
      stiffness: Stiffness of the joints [N m/rad], shape (finger, N, axis).
      damping: Their damping with the implicit term [N m s/rad], same shape; see
        `layout.implicit_spring`.
      armature: Their armature, which has implicit terms only [kg m^2], same shape.
      gain: Bending moment per pressure [m^3], shape (finger, 1), of tapered fingers (finger, N).
      spheres: Place along the link and radius of the contact spheres [m], shape (finger, N, k, 2)
        with k spheres a link; k is 0 with the surface "hull".
      on_palm: Whether a sphere may touch the palm, 1 or 0, shape (finger, N, k); None in scenes
        where no sphere may.
      object_mass: The object's mass [kg], shape ().
      object_inertia: Its principal inertia [kg m^2], shape (3,).
      object_size: Sizes of all shapes of the object set [m], shape (shape, 3).
      shape: Index of the trial's object in the object set, int32 of shape ().
      share: Share of each finger in the hand's centre, times their number, shape (finger,): 1, but
        for a hand with a finger of length 0, which is absent.
      start: Initial qpos in MuJoCo's order, shape (nq,), or the state in which another rollout
        ended, `Trace.last`, see `RolloutState`.
      constants: The scene's numbers with the trial's factors. Engines read from them everything
        that does not depend on the design: limits, the cost's window, friction by pair of bodies.
      section: Height, wall, segment length and width of the fingers [m], shape (finger, 4); None
        where neither `neo_hookean`, `air_mass` nor a hull needs them.
      threshold: Numbers of `morphology.thresholds`; None without the effect `lateral_threshold`.
      tip: Height, wall and width at the tips of tapered fingers [m], shape (finger, 3), or None.
      law: What `section_law` needs of the sections at the joints, and last the length of a segment
        [m], shape (finger, N, number), N = 1 where they are alike; None with the law "chamber".
      growth: How the sections at the joints grow, `section_growth.Growth`, shape (finger, N, 4),
        N = 1 where they are alike; None without the effect `section_growth`.
      first_pressure: Pressures with which the key frames begin [Pa], shape (finger,); likewise.
    """

    base: jax.Array
    mount: jax.Array
    offset: jax.Array
    mass: jax.Array
    centre: jax.Array
    inertia: jax.Array
    stiffness: jax.Array
    damping: jax.Array
    armature: jax.Array
    gain: jax.Array
    spheres: jax.Array
    on_palm: jax.Array | None
    object_mass: jax.Array
    object_inertia: jax.Array
    object_size: jax.Array
    shape: jax.Array
    share: jax.Array
    start: jax.Array
    constants: Scene
    section: jax.Array | None = None
    threshold: jax.Array | None = None
    tip: jax.Array | None = None
    law: jax.Array | None = None
    growth: jax.Array | None = None
    first_pressure: jax.Array | None = None

    @property
    def num_dofs(self) -> int:
        """Degrees of freedom nv: of the wrist, the joints and the object."""
        return 12 + int(np.prod(self.stiffness.shape[-3:]))

    @property
    def qpos(self) -> jax.Array:
        """Generalized positions at the start, shape (..., nq)."""
        return self.start[..., : self.num_dofs + 1]

    @property
    def qvel(self) -> Any:
        """Generalized velocities at the start, shape (..., nv); zero unless `start` has them."""
        nv = self.num_dofs
        speeds = self.start[..., nv + 1 : 2 * nv + 1]
        if speeds.shape[-1]:
            return speeds
        return np.zeros((*self.start.shape[:-1], nv), self.start.dtype)


def joint_springs(scene: Scene, params: Params) -> tuple[jax.Array, jax.Array]:
    """Returns physical stiffness [N m/rad] and damping [N m s/rad] of every dof, (nv,) each.

    Finger joints have those of `morphology.joint_springs`, the six wrist dofs those of the hand
    file; the object's are free.
    """
    lay = layout(scene)
    each = finger_springs(scene, params)
    finger, joint_damping = (picked(v.ravel(), lay.hinges) for v in each)
    springs = wrist_springs(scene)
    wrist, wrist_damping = (jnp.stack([jnp.asarray(x, finger.dtype) for x in v]) for v in springs)
    free = jnp.zeros(6, finger.dtype)
    stiffness = jnp.concatenate([wrist, finger, free])
    return stiffness, jnp.concatenate([wrist_damping, joint_damping, free])


def finger_springs(scene: Scene, params: Params) -> tuple[jax.Array, jax.Array]:
    """Physical stiffness and damping of the fingers' joints, shape (finger, N, axis) each."""
    lay = layout(scene)
    hand = scene.hand
    beams = morphology.finger_beams(hand, params, lay.links)
    stiffness, damping = morphology.joint_springs(hand, params, beams, lay.links, lay.axes)
    return jnp.broadcast_to(stiffness, lay.dofs.shape), jnp.broadcast_to(damping, lay.dofs.shape)


def model_fields(scene: Scene, params: Params, trial: Trial) -> ModelFields:
    """Returns the numbers of one world; pure, vmap it for batches.

    A finger of length 0 is absent, so that a hand with fewer fingers is data of the same program:
    it is computed as one of a micrometre, which has no weight to speak of, stands where nothing
    reaches it, and does not count in the hand's centre.

    Args:
      scene: The scene; its numbers may be traced.
      params: Parameters of the hand; all physics in the float type of these.
      trial: The trial's object and noise.
    """
    lay = layout(scene)
    dtype = params.length.dtype
    present = params.length != 0  # what is no number, or below 0, is refused as such
    params = params._replace(length=jnp.where(present, params.length, ABSENT))
    scene = _in_type(with_trial(scene, trial), dtype)
    beam = morphology.finger_beams(scene.hand, params, lay.links)
    links = morphology.segments(scene.hand, params, lay.links)
    bodies = links.mass.shape
    centre = [jnp.broadcast_to(v, bodies) for v in (links.along, links.up)]
    base, mount = (
        jnp.where(present[:, None], here, jnp.asarray(there, dtype))
        for here, there in zip(mounts(scene.hand, params.spread), (AWAY, UPWARDS), strict=True)
    )
    stiffness, own_damping = finger_springs(scene, params)
    damping, armature = implicit_spring(scene, stiffness, own_damping)
    size, object_mass, object_inertia = object_size(scene.objects, trial)
    threshold = None
    if scene.effects.lateral_threshold:
        threshold = morphology.thresholds(scene.hand, params, beam, lay.links)
    fields = ModelFields(
        base=base,
        mount=mount,
        offset=links.offset,
        mass=links.mass,
        centre=jnp.stack(centre, -1),
        inertia=links.inertia,
        stiffness=stiffness,
        damping=damping,
        armature=armature,
        gain=beam.moment_per_pressure,
        spheres=_spheres(scene, params, links),
        on_palm=_on_palm(scene, params),
        object_mass=object_mass,
        object_inertia=object_inertia,
        object_size=size,
        shape=jnp.asarray(trial.shape, jnp.int32),
        share=present * (len(lay.bodies) / jnp.maximum(present.sum(), 1)),
        start=_start(scene, params, trial),
        constants=scene.bare,
        section=_section(scene, params),
        threshold=threshold,
        tip=None if params.tip is None else jnp.stack(params.tip, -1),
        law=_law(scene, params),
        **_growth(scene, params),
    )
    return _in_type(fields, dtype)


def picked(array: jax.Array, places: np.ndarray) -> jax.Array:
    """The array at places that are known to be in it, without operations that check them."""
    return array.at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _in_type(tree: Any, dtype: Any) -> Any:
    def cast(value: Any) -> jax.Array:
        return value if getattr(value, "dtype", None) == jnp.int32 else jnp.asarray(value, dtype)

    return jax.tree.map(cast, tree)


def _spheres(scene: Scene, params: Params, links: morphology.Segments) -> jax.Array:
    shape = layout(scene).spheres.shape
    if not np.prod(shape):
        return jnp.zeros((*shape, 2), params.length.dtype)
    along = morphology.sphere_places(links.extent, shape[2])
    radius = morphology.sphere_radii(scene.hand, params, *shape[1:])
    return jnp.stack([along, jnp.broadcast_to(radius, shape)], -1)


def _on_palm(scene: Scene, params: Params) -> jax.Array | None:
    lay = layout(scene)
    if not (lay.disc.size and lay.spheres.size):
        return None
    return morphology.spheres_on_palm(scene.hand, params, *lay.spheres.shape[1:])


def _section(scene: Scene, params: Params) -> jax.Array | None:
    e = scene.effects
    if not (e.neo_hookean or e.air_mass or e.surface == "hull"):
        return None
    width = scene.hand.section.width + 0 * params.height
    return jnp.stack([params.height, params.wall, params.length / layout(scene).links, width], -1)


def _law(scene: Scene, params: Params) -> jax.Array | None:
    if scene.hand.section.law == "chamber":
        return None
    links = layout(scene).links
    numbers = morphology.law_numbers(scene.hand, params, links)
    segment = (params.length / links)[:, None]
    return jnp.stack(jnp.broadcast_arrays(*numbers, segment), -1)


def _growth(scene: Scene, params: Params) -> dict[str, jax.Array]:
    if not sections_grow(scene):
        return {}
    places = morphology.at_joints(layout(scene).links)
    grows = morphology.growth_numbers(scene.hand, params, places)
    return {
        "growth": jnp.stack(jnp.broadcast_arrays(*grows), -1),
        "first_pressure": key_frames.first_pressure(scene, params),
    }


def section_springs(
    scene: Scene, fields: ModelFields, angles: Any, pressure: Any
) -> tuple[Any, Any, Any]:
    """Moments of the joints by the law of their sections, see `section_law.at_joint`.

    Args:
      fields: Fields with `law`; leading axes as `angles`.
      angles: Angles of the joints [rad], shape (..., finger, N, axis); NumPy or JAX arrays.
      pressure: Of the chambers [Pa], shape (..., finger).

    Returns:
      Moments [N m], and damping and armature with the implicit terms, see
      `layout.implicit_spring`, each shaped as `angles`.
    """
    assert fields.law is not None
    axes = layout(scene).axes
    *numbers, segment = (fields.law[..., k] for k in range(fields.law.shape[-1]))
    by_axis = [{n: v[..., k] for k, n in enumerate(axes)} for v in (fields.stiffness, angles)]
    held, more = section_law.at_joint(
        section_numbers.Numbers(*numbers), segment, by_axis[0], pressure[..., None], by_axis[1]
    )
    numpy = angles.__array_namespace__()
    moments = numpy.stack([-held[name] for name in axes], -1)
    added = numpy.stack([more[name] for name in axes], -1)
    damping, armature = implicit_spring(scene, added, 0.0 * added)
    return moments, fields.damping + damping, fields.armature + armature


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
    stiffness = fields.stiffness[..., 0]
    return stiffness * angles * morphology.softening(angles / segment, height, wall, width=width)


def _start(scene: Scene, params: Params, trial: Trial) -> jax.Array:
    tilt = trial.arm_tilt
    dtype = params.arm.dtype
    x, y, z, roll, pitch, yaw = key_frames.poses(scene, params, 1)[0]
    wrist = jnp.stack([x, y, z, roll + tilt[0], yaw, tilt[1] - pitch])
    fingers = jnp.zeros(layout(scene).dofs.size, dtype)
    rest, quat = object_pose(scene.objects, trial)
    parts = [wrist, fingers, trial.position, rest[None], quat]
    return jnp.concatenate(parts).astype(dtype)
