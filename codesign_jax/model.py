"""Scene to MuJoCo model, once a scene; parameters to batched model fields, as a pure function.

One MjSpec template a scene fixes the topology.  Each finger is a chain of `links` equal segments with its
joints at the segments' midpoints, so the first half segment is welded to the palm.  A ball joint is three
hinges on one body in the order bend (y), lateral (z), twist (x): the middle angle stays far from 90 degrees
and each axis has its own stiffness.  Link frames have x along the finger, y across (the bend axis) and z up
from the inextensible bottom layer; positive bending curls the tip towards that layer.

Springs are integrated linearly implicitly in every engine by the same substitution for diagonal stiffness K
and damping D and time step h: dof_damping = D + h K and dof_armature = h (D + h K), integrator Euler with
eulerdamp disabled.  MuJoCo then solves (M + h D + h^2 K) a = tau - K q - (D + h K) v.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import morphology, objects
from codesign_jax.morphology import Beam
from codesign_jax.scene import Scene
from codesign_jax.types import Params, Trial

# An object body carries one geom for each shape of the set; those that a trial does not use shrink to this
# fraction, deep inside the one in use, where nothing touches them.
INACTIVE = 1e-3
# Wrist hinges turn in the order roll (x), yaw (z), pitch (y).  Yaw is in the middle, where +-90 degrees is
# singular, because the disturbance adds up to 40 degrees to roll and pitch but nothing to yaw.
WRIST = ("x", "y", "z", "roll", "yaw", "pitch")
_AXES = {"bend": (0, 1, 0), "lateral": (0, 0, 1), "twist": (1, 0, 0)}
_GEOM = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}


class Layout(NamedTuple):
    """Where a scene's parts lie in the model's arrays.

    Attributes:
      links: Number of segments N of a finger.
      axes: Names of the joint axes that are on, in hinge order.
      stubs: Body ids of the half segments at the palm, shape (finger,).
      bodies: Body ids of the moving links, shape (finger, N).
      object: Body id of the object.
      dofs: Dof (and joint) ids of the finger hinges, shape (finger, N, axis).
      spheres: Geom ids of the finger spheres, shape (finger, N, k); empty without finger contacts.
      object_geoms: Geom ids of the object's shapes, shape (shape,).
      centre_weights: Weight of each body in the hand centre, the mean position of the segments, (nbody,).
    """

    links: int
    axes: tuple[str, ...]
    stubs: np.ndarray
    bodies: np.ndarray
    object: int
    dofs: np.ndarray
    spheres: np.ndarray
    object_geoms: np.ndarray
    centre_weights: np.ndarray


class ModelFields(NamedTuple):
    """The fields of mjModel that depend on parameters and trial, by MuJoCo's names, and the start state.

    Every array has MuJoCo's shape for one world; `start` is the initial qpos, shape (nq,).
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
    actuator_gainprm: jax.Array
    start: jax.Array


def joint_axes(scene: Scene) -> tuple[str, ...]:
    """Names of the finger joints' axes that the scene's effects call for, in hinge order."""
    on = {"bend": True, "lateral": scene.effects.lateral_bending, "twist": scene.effects.twist}
    return tuple(name for name in _AXES if on[name])


@functools.cache
def layout(scene: Scene) -> Layout:
    """Returns the index layout of a scene's model."""
    n, links, axes = scene.num_fingers, scene.discretization.links, joint_axes(scene)
    stubs = 2 + np.arange(n) * (links + 1)
    bodies = stubs[:, None] + 1 + np.arange(links)
    dofs = 6 + np.arange(n * links * len(axes)).reshape(n, links, len(axes))
    touching = scene.effects.finger_object or scene.effects.finger_table
    k = scene.discretization.spheres_per_link if touching else 0
    first = 1 + (len(_palm_points(scene)) if scene.effects.palm_contact else 0)
    spheres = first + np.arange(n * links * k).reshape(n, links, k)
    shapes = first + n * links * k + np.arange(len(scene.objects.object))
    weights = np.zeros(3 + n * (links + 1))
    weights[bodies] = 1.0 / (n * links)
    weights[[*stubs, *bodies[:, -1]]] = 0.5 / (n * links)
    return Layout(links, axes, stubs, bodies, len(weights) - 1, dofs, spheres, shapes, weights)


def contact_invweight(scene: Scene) -> float:
    """Inverse weight declared for every body in contact [1/kg].

    MuJoCo's soft contact has normal stiffness k_n = k d / ((1 - d) sum(invweight)) with
    k = 1 / (d timeconst)^2 at damping ratio 1.  Declaring invweight instead of deriving it from masses makes
    k_n a material number in N/m, independent of finger size and time step.  A finger-object contact sums
    two bodies; a contact with the table has one and is twice as stiff.
    """
    c = scene.contact
    k = 1.0 / (c.impedance * c.time_constant) ** 2
    return k * c.impedance / ((1.0 - c.impedance) * 2.0 * c.normal_stiffness)


def _palm_points(scene: Scene) -> np.ndarray:
    """Centres of the palm's contact spheres in the palm frame, whose origin is on the underside."""
    p = scene.hand.palm
    ring = p.contact_ring * np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    return np.column_stack([ring, np.full(len(ring), p.contact_radius)])


def _mounts(scene: Scene, spread: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Base position (finger, 3) and orientation (finger, 4) of the fingers in the palm frame."""
    fingers = scene.hand.finger
    azimuth = jnp.deg2rad(np.array([f.azimuth for f in fingers]))
    azimuth = azimuth + np.array([f.spread for f in fingers]) * spread
    radius, tilt = (np.array([getattr(f, k) for f in fingers]) for k in ("radius", "tilt"))
    zero, tilt = jnp.zeros_like(azimuth), np.deg2rad(tilt)
    position = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), zero], -1)
    # Rotation about z by the azimuth, then about y by the tilt: x leaves the palm outwards and down.
    ca, sa, ct, st = jnp.cos(azimuth / 2), jnp.sin(azimuth / 2), np.cos(tilt / 2), np.sin(tilt / 2)
    return position, jnp.stack([ca * ct, -sa * st, ca * st, sa * ct], -1)


def _object_size(scene: Scene, trial: Trial) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Geom sizes (shape, 3), mass (), principal inertia (3,) and resting height () of a trial's object."""
    shapes = scene.objects.object
    full = np.array([[*s.size, 0.0, 0.0][:3] for s in shapes])
    size = trial.size * full
    mass = trial.mass * jnp.array([s.mass for s in shapes])[trial.shape]
    unit = jnp.stack([_unit_inertia(s.type, size[i]) for i, s in enumerate(shapes)])[trial.shape]
    rest = {"box": 2, "cylinder": 1, "sphere": 0}
    height = jnp.stack([size[i, rest[s.type]] for i, s in enumerate(shapes)])[trial.shape]
    active = jnp.arange(len(shapes)) == trial.shape
    return jnp.where(active[:, None], size, INACTIVE * size), mass, mass * unit, height


def _unit_inertia(kind: str, size: jax.Array) -> jax.Array:
    """Principal inertia per mass of a solid primitive [m^2], shape (3,)."""
    if kind == "box":
        return jnp.stack(morphology.block_inertia(jnp.ones(()), 2 * size[0], 2 * size[1], 2 * size[2]))
    if kind == "cylinder":
        across = size[0] ** 2 / 4 + size[1] ** 2 / 3
        return jnp.stack([across, across, size[0] ** 2 / 2])
    return jnp.full((3,), 0.4) * size[0] ** 2


def _geom_bounds(kind: str, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bounding radius () and axis-aligned half extents (3,) of a primitive."""
    if kind == "box":
        return jnp.linalg.norm(size), size
    if kind == "cylinder":
        return jnp.hypot(size[0], size[1]), jnp.stack([size[0], size[0], size[1]])
    return size[0], jnp.full((3,), 1.0) * size[0]


def joint_springs(scene: Scene, params: Params) -> tuple[jax.Array, jax.Array]:
    """Returns physical stiffness and damping of every dof, each of shape (nv,) [N m/rad, N m s/rad].

    Finger joints have k = EI / l and GJ / l for a segment of length l and damping beta k (Kelvin-Voigt);
    the six wrist dofs those of the hand file; the object's are free.
    """
    lay, hand = layout(scene), scene.hand
    beam = morphology.finger_beams(hand, params)
    segment = params.length / lay.links
    by_axis = {"bend": beam.bending, "lateral": beam.lateral, "twist": beam.torsion}
    finger = jnp.stack([by_axis[name] / segment for name in lay.axes], -1)
    finger = jnp.broadcast_to(finger[:, None, :], lay.dofs.shape).reshape(-1)
    w = hand.wrist
    wrist = jnp.array([w.linear_stiffness] * 3 + [w.angular_stiffness] * 3, finger.dtype)
    wrist_damping = jnp.array([w.linear_damping] * 3 + [w.angular_damping] * 3, finger.dtype)
    free = jnp.zeros(6, finger.dtype)
    stiffness = jnp.concatenate([wrist, finger, free])
    return stiffness, jnp.concatenate([wrist_damping, hand.material.damping_time * finger, free])


def model_fields(scene: Scene, params: Params, trial: Trial) -> ModelFields:
    """Returns the batched model fields and the start state of one world; pure, vmap it for batches.

    Args:
      scene: The scene (static).
      params: Parameters of the hand; all physics in the float type of these.
      trial: The trial's object and noise.
    """
    template, lay = compile_template(scene), layout(scene)
    beam = morphology.finger_beams(scene.hand, params)
    dtype = params.length.dtype

    def base(name: str) -> jax.Array:
        return jnp.asarray(getattr(template, name), dtype)

    segment = params.length / lay.links
    extents = _extents(segment, lay)
    masses = beam.line_density[:, None] * extents
    size, object_mass, object_inertia, rest = _object_size(scene, trial)
    bodies = np.concatenate([lay.stubs[:, None], lay.bodies], 1)
    mount_pos, mount_quat = _mounts(scene, params.spread)
    offsets = jnp.concatenate([segment[:, None] / 2, jnp.broadcast_to(segment[:, None], masses[:, 2:].shape)], 1)
    mass = base("body_mass").at[bodies].set(masses).at[lay.object].set(object_mass)
    h = scene.discretization.timestep
    stiffness, damping = joint_springs(scene, params)
    implicit = damping + h * stiffness
    geom_size, rbound, aabb = _geom_fields(scene, params, size, base)
    return ModelFields(
        body_pos=base("body_pos").at[lay.stubs].set(mount_pos).at[lay.bodies, 0].set(offsets),
        body_quat=base("body_quat").at[lay.stubs].set(mount_quat),
        body_ipos=_centres(base("body_ipos"), bodies, extents, params.height),
        body_mass=mass,
        body_subtreemass=_subtree_mass(lay, mass, masses, base("body_subtreemass")),
        body_inertia=_link_inertia(scene, params, base("body_inertia"), bodies, masses, extents)
        .at[lay.object]
        .set(object_inertia),
        geom_pos=_sphere_positions(scene, params, extents, base("geom_pos")),
        geom_size=geom_size,
        geom_rbound=rbound,
        geom_aabb=aabb,
        # The wrist's springs are its position actuators; only the fingers have passive ones.
        jnt_stiffness=base("jnt_stiffness").at[lay.dofs].set(stiffness[lay.dofs]),
        dof_damping=implicit,
        dof_armature=h * implicit,
        actuator_gainprm=base("actuator_gainprm").at[6:, 0].set(beam.moment_per_pressure),
        start=_start(scene, params, trial, rest),
    )


def _extents(segment: jax.Array, lay: Layout) -> jax.Array:
    """Length of each body of a finger, shape (finger, N + 1): half segments at both ends."""
    factor = np.ones(lay.links + 1)
    factor[[0, -1]] = 0.5
    return segment[:, None] * factor


def _centres(ipos: jax.Array, bodies: np.ndarray, extents: jax.Array, height: jax.Array) -> jax.Array:
    ipos = ipos.at[bodies, 0].set(extents / 2)
    return ipos.at[bodies, 2].set(jnp.broadcast_to(height[:, None] / 2, bodies.shape))


def _link_inertia(
    scene: Scene, params: Params, inertia: jax.Array, bodies: np.ndarray, masses: jax.Array, extents: jax.Array
) -> jax.Array:
    """Inertia of each link as the block extent x width x height."""
    width, height = jnp.asarray(scene.hand.section.width), params.height[:, None]
    return inertia.at[bodies].set(jnp.stack(morphology.block_inertia(masses, extents, width, height), -1))


def _subtree_mass(lay: Layout, mass: jax.Array, masses: jax.Array, subtree: jax.Array) -> jax.Array:
    tails = jnp.cumsum(masses[:, ::-1], 1)[:, ::-1]
    hand = mass[1] + tails[:, 0].sum()
    subtree = subtree.at[lay.stubs].set(tails[:, 0]).at[lay.bodies].set(tails[:, 1:])
    total = hand + mass[lay.object]
    return subtree.at[0].set(total).at[1].set(hand).at[lay.object].set(mass[lay.object])


def _sphere_positions(scene: Scene, params: Params, extents: jax.Array, geom_pos: jax.Array) -> jax.Array:
    """Spheres spread evenly over each moving link, tangent to the bottom layer."""
    lay = layout(scene)
    if not lay.spheres.size:
        return geom_pos
    k = lay.spheres.shape[2]
    along = extents[:, 1:, None] * (np.arange(k) + 0.5) / k
    up = jnp.broadcast_to(params.height[:, None, None] / 2, lay.spheres.shape)
    return geom_pos.at[lay.spheres, 0].set(along).at[lay.spheres, 2].set(up)


def _geom_fields(scene: Scene, params: Params, size: jax.Array, base) -> tuple[jax.Array, jax.Array, jax.Array]:
    lay = layout(scene)
    geom_size, rbound, aabb = base("geom_size"), base("geom_rbound"), base("geom_aabb")
    if lay.spheres.size:
        radius = jnp.broadcast_to(params.height[:, None, None] / 2, lay.spheres.shape)
        geom_size = geom_size.at[lay.spheres, 0].set(radius)
        rbound = rbound.at[lay.spheres].set(radius)
        aabb = aabb.at[lay.spheres, 3:].set(radius[..., None])
    for i, shape in enumerate(scene.objects.object):
        g = lay.object_geoms[i]
        r, half = _geom_bounds(shape.type, size[i])
        geom_size, rbound, aabb = geom_size.at[g].set(size[i]), rbound.at[g].set(r), aabb.at[g, 3:].set(half)
    return geom_size, rbound, aabb


def _start(scene: Scene, params: Params, trial: Trial, rest: jax.Array) -> jax.Array:
    """Start state: palm at the arm frame's first pose, straight fingers, object at rest on the table."""
    arm, tilt, dtype = params.arm, trial.arm_tilt, params.arm.dtype
    height = jnp.asarray(scene.arm.start_height, dtype)
    wrist = jnp.stack([arm[0], arm[1], height, arm[3] + tilt[0], arm[5], arm[4] + tilt[1]])
    zero = jnp.zeros((), dtype)
    quat = jnp.stack([jnp.cos(trial.yaw / 2), zero, zero, jnp.sin(trial.yaw / 2)])
    fingers = jnp.zeros(layout(scene).dofs.size, dtype)
    return jnp.concatenate([wrist, fingers, trial.position, rest[None], quat]).astype(dtype)


@functools.cache
def compile_template(scene: Scene) -> mujoco.MjModel:
    """Compiles the scene's template model, with the contact's declared inverse weights; once a scene."""
    n = scene.num_fingers
    table = {p.name: p.default for p in scene.hand.parameter}
    with jax.ensure_compile_time_eval():
        params = Params(
            length=np.full(n, table["length"] * 1e-3),
            height=np.full(n, table["height"] * 1e-3),
            wall=np.full(n, table["wall"] * 1e-3),
            spread=np.float64(np.deg2rad(table["spread"])),
            arm=np.zeros(6),
            pressure=np.zeros(n),
        )
        trial = Trial(np.int32(0), np.zeros(2), np.float64(0), np.zeros(2), np.float64(1), np.float64(1))
        return compile_model(scene, params, trial)


def compile_model(scene: Scene, params: Params, trial: Trial, *, visual: bool = False) -> mujoco.MjModel:
    """Compiles a fresh MuJoCo model of one hand and one trial from concrete values.

    Args:
      scene: The scene.
      params: Parameters as concrete arrays.
      trial: The trial as concrete arrays.
      visual: Adds geoms that only a renderer needs (finger blocks, palm disc).
    """
    model = build_spec(scene, params, trial, visual=visual).compile()
    # Declared, not derived; see contact_invweight.  The world keeps zero.
    model.body_invweight0[1:] = contact_invweight(scene)
    return model


def build_spec(scene: Scene, params: Params, trial: Trial, *, visual: bool = False) -> mujoco.MjSpec:
    """Builds the MjSpec of one hand and one trial; arguments as `compile_model`."""
    spec = mujoco.MjSpec()
    _options(scene, spec)
    world = spec.worldbody
    world.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.05], **_PASSIVE)
    _add_palm(scene, spec, visual)
    beams = morphology.finger_beams(scene.hand, jax.tree.map(np.asarray, params))
    for f in range(scene.num_fingers):
        beam = Beam(*(float(np.asarray(v)[f]) for v in beams))
        _add_finger(scene, spec, params, f, beam, visual)
    _add_object(scene, spec, trial, visual)
    _add_pairs(scene, spec)
    return spec


_PASSIVE = {"contype": 0, "conaffinity": 0}  # contacts come from explicit pairs only
_COLORS = {"object": (0.85, 0.55, 0.2, 1), "finger": (0.35, 0.55, 0.75, 1), "palm": (0.3, 0.3, 0.35, 1)}


def _options(scene: Scene, spec: mujoco.MjSpec) -> None:
    o = spec.option
    o.timestep, o.gravity = scene.discretization.timestep, [0, 0, -scene.gravity]
    o.integrator, o.cone = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtCone.mjCONE_ELLIPTIC
    o.solver = mujoco.mjtSolver.mjSOL_NEWTON
    o.iterations, o.ls_iterations = scene.solver.iterations, scene.solver.ls_iterations
    o.tolerance, o.impratio = scene.solver.tolerance, scene.contact.friction_ratio
    bits = mujoco.mjtDisableBit
    # Without autoreset a world that went bad stays bad, so that it is seen.
    o.disableflags = bits.mjDSBL_EULERDAMP | bits.mjDSBL_AUTORESET | bits.mjDSBL_ISLAND



def _hinge(body: mujoco.MjsBody, name: str, axis: tuple[int, ...], kind=mujoco.mjtJoint.mjJNT_HINGE, **kwargs):
    return body.add_joint(name=name, type=kind, axis=axis, pos=[0, 0, 0], **kwargs)


def _add_palm(scene: Scene, spec: mujoco.MjSpec, visual: bool) -> None:
    p, w, h = scene.hand.palm, scene.hand.wrist, scene.discretization.timestep
    body = spec.worldbody.add_body(name="palm")
    body.explicitinertial, body.mass, body.ipos = True, p.mass, [0, 0, p.thickness / 2]
    across = p.mass * (p.radius**2 / 4 + p.thickness**2 / 12)
    body.inertia = [across, across, p.mass * p.radius**2 / 2]
    axes = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
    axes |= {"roll": axes["x"], "yaw": axes["z"], "pitch": axes["y"]}
    for name in WRIST:
        linear = len(name) == 1
        stiffness = w.linear_stiffness if linear else w.angular_stiffness
        damping = w.linear_damping if linear else w.angular_damping
        kind = mujoco.mjtJoint.mjJNT_SLIDE if linear else mujoco.mjtJoint.mjJNT_HINGE
        implicit = damping + h * stiffness
        _hinge(body, f"wrist_{name}", axes[name], kind, damping=implicit, armature=h * implicit)
        actuator = spec.add_actuator(
            name=f"arm_{name}", target=f"wrist_{name}", trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0], actuator.biasprm[1] = stiffness, -stiffness
    if scene.effects.palm_contact:
        for i, point in enumerate(_palm_points(scene)):
            _sphere(body, f"palm_{i}", point, p.contact_radius)
    if visual:
        kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [p.radius, p.thickness / 2, 0]
        pos = [0, 0, p.thickness / 2]
        body.add_geom(name="palm_disc", type=kind, size=size, pos=pos, rgba=_COLORS["palm"], **_PASSIVE)


def _sphere(body: mujoco.MjsBody, name: str, pos, radius: float) -> None:
    kind = mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_geom(name=name, type=kind, size=[radius, 0, 0], pos=pos, group=3, **_PASSIVE)


def _add_finger(
    scene: Scene, spec: mujoco.MjSpec, params: Params, f: int, beam: Beam, visual: bool
) -> None:
    lay, width, h = layout(scene), scene.hand.section.width, scene.discretization.timestep
    length, height = float(params.length[f]), float(params.height[f])
    segment = length / lay.links
    mount_pos, mount_quat = _mounts(scene, np.asarray(params.spread))
    tendon = spec.add_tendon(name=f"chamber_{f}")
    body = spec.body("palm")
    by_axis = {"bend": beam.bending, "lateral": beam.lateral, "twist": beam.torsion}
    for i in range(lay.links + 1):
        body = body.add_body(name=f"finger_{f}_link_{i}")
        if i == 0:
            body.pos, body.quat = np.asarray(mount_pos)[f], np.asarray(mount_quat)[f]
        else:
            body.pos = [segment / 2 if i == 1 else segment, 0, 0]
        extent = segment / 2 if i in (0, lay.links) else segment
        body.explicitinertial, body.mass = True, beam.line_density * extent
        body.ipos = [extent / 2, 0, height / 2]
        body.inertia = np.array(morphology.block_inertia(body.mass, extent, width, height))  # type: ignore[arg-type]
        if visual:
            kind, half = mujoco.mjtGeom.mjGEOM_BOX, [extent / 2, width / 2, height / 2]
            name = f"finger_{f}_block_{i}"
            body.add_geom(name=name, type=kind, size=half, pos=body.ipos, rgba=_COLORS["finger"], **_PASSIVE)
        if i == 0:
            continue
        for name in lay.axes:
            stiffness = by_axis[name] / segment
            implicit = scene.hand.material.damping_time * stiffness + h * stiffness
            joint = f"finger_{f}_{name}_{i}"
            _hinge(body, joint, _AXES[name], stiffness=stiffness, damping=implicit, armature=h * implicit)
        tendon.wrap_joint(f"finger_{f}_bend_{i}", 1.0)
        for j in range(lay.spheres.shape[2]):
            x = extent * (j + 0.5) / lay.spheres.shape[2]
            _sphere(body, f"finger_{f}_sphere_{i}_{j}", [x, 0, height / 2], height / 2)
    actuator = spec.add_actuator(
        name=f"pressure_{f}", target=f"chamber_{f}", trntype=mujoco.mjtTrn.mjTRN_TENDON
    )
    # Pressure [Pa] in, bending moment [N m] at every joint out: a constant torque, not a moving rest angle.
    actuator.gainprm[0] = beam.moment_per_pressure


def _add_object(scene: Scene, spec: mujoco.MjSpec, trial: Trial, visual: bool) -> None:
    sizes, mass, inertia, rest = (np.asarray(v) for v in _object_size(scene, jax.tree.map(np.asarray, trial)))
    body = spec.worldbody.add_body(name="object", pos=[*np.asarray(trial.position), float(rest)])
    yaw = float(trial.yaw) / 2
    body.quat = [np.cos(yaw), 0, 0, np.sin(yaw)]
    body.explicitinertial, body.mass, body.inertia = True, float(mass), inertia
    body.ipos, body.iquat = [0, 0, 0], [1, 0, 0, 0]
    body.add_freejoint(name="object")
    for i, shape in enumerate(scene.objects.object):
        color = _COLORS["object"] if i == int(trial.shape) or not visual else (0, 0, 0, 0)
        size = np.asarray(sizes[i])
        body.add_geom(name=f"object_{i}", type=_GEOM[shape.type], size=size, rgba=color, **_PASSIVE)


def _add_pairs(scene: Scene, spec: mujoco.MjSpec) -> None:
    """Explicit contact pairs: the contact list is the scene's, not a filter's."""
    e, c, lay = scene.effects, scene.contact, layout(scene)
    fingers = [
        f"finger_{f}_sphere_{i + 1}_{j}"
        for f, i, j in np.ndindex(lay.spheres.shape)
    ]
    palm = [f"palm_{i}" for i in range(len(_palm_points(scene)))] if e.palm_contact else []

    def add(first: str, second: str, friction: float) -> None:
        pair = spec.add_pair(geomname1=first, geomname2=second, condim=3)
        pair.friction = [friction, friction, 0.005, 0.0001, 0.0001]
        pair.solref = [c.time_constant, 1.0]
        pair.solimp = [c.impedance, c.impedance, 0.001, 0.5, 2.0]

    for i, shape in enumerate(scene.objects.object):
        add("table", f"object_{i}", scene.objects.table.friction)
        for name in [*(fingers if e.finger_object else []), *palm]:
            add(name, f"object_{i}", shape.friction)
    for name in [*(fingers if e.finger_table else []), *palm]:
        add("table", name, c.finger_table_friction)


__all__ = [
    "INACTIVE",
    "Layout",
    "ModelFields",
    "build_spec",
    "compile_model",
    "compile_template",
    "contact_invweight",
    "joint_axes",
    "joint_springs",
    "layout",
    "model_fields",
    "objects",
]
