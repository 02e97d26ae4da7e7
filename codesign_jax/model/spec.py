"""Scene to MjSpec and MjModel: the template once a scene, and fresh compiles of single hands."""

import contextlib
import functools
import itertools
from typing import Any

import jax
import mujoco
import numpy as np

from codesign_jax.model import hull, morphology, pairs
from codesign_jax.model.layout import (
    AXES,
    RIGID,
    WRIST,
    contact_invweight,
    first_on_palm,
    friction_ratio,
    geom_sizes,
    hinge_order,
    implicit_spring,
    layout,
    mounts,
    object_pose,
    object_size,
    palm_points,
    palm_touches,
    wrist_springs,
)
from codesign_jax.model.morphology import Beam
from codesign_jax.reuse import quickly_compiled
from codesign_jax.scene import Scene, by_structure
from codesign_jax.scene.constants import with_trial
from codesign_jax.scene.hand import Hand
from codesign_jax.scene.objects import ObjectSet
from codesign_jax.scene.primitives import PRIMITIVES
from codesign_jax.types import Params, Tip, Trial


@by_structure
def compile_template(scene: Scene) -> mujoco.MjModel:
    """Compiles the template model of a scene's structure, once.

    Its numbers are those of `template_world` and mean nothing: `model_fields` has a world's, but
    for the scale of the solver's tolerance, `stat.meaninertia`, which all worlds share.
    """
    return compile_model(scene, *template_world(scene))


def template_world(scene: Scene) -> tuple[Params, Trial]:
    """Parameters and trial of the template, as NumPy arrays."""
    ones = np.ones(scene.num_fingers)
    params = Params(0.1 * ones, 0.02 * ones, 0.004 * ones, np.zeros(()), np.zeros(6), 0.0 * ones)
    if scene.hand.section.tapered:
        params = params._replace(tip=Tip(0.015 * ones, 0.003 * ones, 0.02 * ones))
    zero = np.zeros(())
    unit = np.ones(())
    return params, Trial(np.int32(0), np.zeros(2), zero, np.zeros(2), *[unit] * 5)


# Models are compiled in float64 whatever the caller's mode, also inside a traced function.
@contextlib.contextmanager
def _float64():
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        yield


def compile_model(
    scene: Scene, params: Params, trial: Trial, *, visual: bool = False
) -> mujoco.MjModel:
    """Compiles a fresh MuJoCo model of one hand and one trial from concrete values.

    Args:
      params: Parameters as concrete arrays.
      trial: The trial as concrete arrays.
      visual: Adds geoms that only a renderer needs (finger blocks, palm disc).
    """
    model = build_spec(scene, params, trial, visual=visual).compile()
    # Declared, not derived; see contact_invweight.  The world keeps zero.
    model.body_invweight0[1:] = contact_invweight(scene)
    if not scene.effects.wrist:
        # The solver's tolerance is relative to this scale, which is the moving masses'.
        moving = model.dof_M0 - RIGID * (np.arange(model.nv) < 6)
        model.stat.meaninertia = moving.mean()
    return model


@functools.partial(quickly_compiled, static_argnums=0)
def _numbers(links: int, hand: Hand, objects: ObjectSet, params: Params, trial: Trial) -> tuple:
    """Beams, mounts, and the object's size and orientation; one program, not one an operation."""
    beams = morphology.finger_beams(hand, params, links)
    place = mounts(hand, params.spread)
    return beams, place, object_size(objects, trial), object_pose(objects, trial)


@_float64()
def build_spec(
    scene: Scene, params: Params, trial: Trial, *, visual: bool = False
) -> mujoco.MjSpec:
    """Builds the MjSpec of one hand and one trial; arguments as `compile_model`."""
    spec = mujoco.MjSpec()
    scene = with_trial(scene, jax.tree.map(np.asarray, trial))
    _options(scene, spec)
    world = spec.worldbody
    world.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.05], **_PASSIVE)
    for i, fixture in enumerate(scene.fixture):
        plane = fixture.type == "plane"
        geom = getattr(mujoco.mjtGeom, f"mjGEOM_{fixture.type.upper()}")
        size = [1, 1, 0.05] if plane else fixture.half_sizes
        place = {"pos": fixture.position, "quat": fixture.quaternion, "rgba": _COLORS["fixture"]}
        world.add_geom(name=f"fixture_{i}", type=geom, size=size, **place, **_PASSIVE)
    if not scene.effects.table:
        world.geoms[0].rgba = [0, 0, 0, 0]
    _add_palm(scene, spec, visual)
    bodies = scene.bare.hand, scene.bare.objects
    *_, params, _ = every = jax.tree.map(np.asarray, (*bodies, params, trial))
    beams, place, solid, pose = jax.tree.map(np.asarray, _numbers(layout(scene).links, *every))
    for f in range(scene.num_fingers):
        _add_finger(scene, spec, params, f, beams, (place[0][f], place[1][f]), visual)
    _add_object(scene, spec, trial, solid, pose, visual)
    _add_pairs(scene, spec, params)
    return spec


_PASSIVE = {"contype": 0, "conaffinity": 0}  # contacts come from explicit pairs only
_COLORS = {
    "object": (0.85, 0.55, 0.2, 1),
    "finger": (0.35, 0.55, 0.75, 1),
    "palm": (0.3, 0.3, 0.35, 1),
    "fixture": (0.62, 0.6, 0.55, 1),
}


def _options(scene: Scene, spec: mujoco.MjSpec) -> None:
    o = spec.option
    o.timestep = scene.discretization.timestep
    o.gravity = [0, 0, -scene.gravity_on]
    o.integrator = mujoco.mjtIntegrator.mjINT_EULER
    o.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    o.solver = mujoco.mjtSolver.mjSOL_NEWTON
    o.iterations = scene.solver.iterations
    o.ls_iterations = scene.solver.ls_iterations
    o.tolerance = scene.solver.tolerance
    o.impratio = friction_ratio(scene, scene.contact.friction_ratio)
    bits = mujoco.mjtDisableBit
    # Without autoreset a world that went bad stays bad, so that it is seen.
    o.disableflags = bits.mjDSBL_EULERDAMP | bits.mjDSBL_AUTORESET | bits.mjDSBL_ISLAND
    if not scene.effects.wrist:
        # From the last step's accelerations the solver stops where the heavy palm's cost hides what
        # the fingers' still lacks: tips were off by 7 mm with a ball at rest on the table.
        o.disableflags |= bits.mjDSBL_WARMSTART


def _hinge(
    body: mujoco.MjsBody,
    name: str,
    axis: tuple[int, ...],
    kind=mujoco.mjtJoint.mjJNT_HINGE,
    **kwargs,
):
    return body.add_joint(name=name, type=kind, axis=axis, pos=[0, 0, 0], **kwargs)


def palm_inertia(scene: Scene) -> list[Any]:
    """Principal inertia of the palm, a disc, about its centre [kg m^2]."""
    p = scene.hand.palm
    return [p.mass * v for v in PRIMITIVES["cylinder"].inertia((p.radius, p.thickness / 2))]


def _add_palm(scene: Scene, spec: mujoco.MjSpec, visual: bool) -> None:
    p = scene.hand.palm
    body = spec.worldbody.add_body(name="palm")
    body.explicitinertial = True
    body.mass = p.mass
    body.ipos = [0, 0, p.thickness / 2]
    body.inertia = palm_inertia(scene)
    axes = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
    axes |= {"roll": axes["x"], "yaw": axes["z"], "pitch": axes["y"]}
    for name, stiffness, damping in zip(WRIST, *wrist_springs(scene), strict=True):
        linear = len(name) == 1
        kind = mujoco.mjtJoint.mjJNT_SLIDE if linear else mujoco.mjtJoint.mjJNT_HINGE
        rigid = not scene.effects.wrist
        damping, armature = implicit_spring(scene, stiffness, damping, rigid=rigid)
        _hinge(body, f"wrist_{name}", axes[name], kind, damping=damping, armature=armature)
        actuator = spec.add_actuator(
            name=f"arm_{name}", target=f"wrist_{name}", trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = stiffness
        actuator.biasprm[1] = -stiffness
    if palm_touches(scene):
        for i, point in enumerate(np.asarray(palm_points(scene))):
            _sphere(body, f"palm_{i}", point, p.contact_radius)
    if visual or scene.effects.finger_palm:
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER
        size = [p.radius, p.thickness / 2, 0]
        pos = [0, 0, p.thickness / 2]
        body.add_geom(
            name="palm_disc", type=kind, size=size, pos=pos, rgba=_COLORS["palm"], **_PASSIVE
        )


def _sphere(body: mujoco.MjsBody, name: str, pos, radius: float) -> None:
    kind = mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_geom(name=name, type=kind, size=[radius, 0, 0], pos=pos, group=3, **_PASSIVE)


def _add_finger(
    scene: Scene,
    spec: mujoco.MjSpec,
    params: Params,
    f: int,
    beams: Beam,
    mount: tuple[np.ndarray, np.ndarray],
    visual: bool,
) -> None:
    lay = layout(scene)
    hand = scene.hand
    count = lay.spheres.shape[2]
    many = (lay.links, lay.spheres.shape[2])
    links = morphology.segments(hand, params, lay.links)
    springs = [
        np.broadcast_to(v[f], (lay.links, len(lay.axes)))
        for v in morphology.joint_springs(hand, params, beams, lay.links, lay.axes)
    ]
    spheres = morphology.sphere_places(links.extent, count)[f]
    radii = np.broadcast_to(morphology.sphere_radii(hand, params, *many)[f], many)
    up = np.broadcast_to(links.up[f], lay.links + 1)
    gains = np.broadcast_to(beams.moment_per_pressure[f], lay.links)
    width = np.broadcast_to(
        morphology.sections(hand, params, np.linspace(0, 1, lay.links + 1)).width[0], lay.links + 1
    )
    tendon = spec.add_tendon(name=f"chamber_{f}")
    body = spec.body("palm")
    for i in range(lay.links + 1):
        body = body.add_body(name=f"finger_{f}_link_{i}")
        if i == 0:
            body.pos, body.quat = mount
        else:
            body.pos = [links.offset[f, i - 1], 0, 0]
        body.explicitinertial = True
        body.mass = links.mass[f, i]
        body.ipos = [links.along[f, i], 0, up[i]]
        body.inertia = links.inertia[f, i]
        if visual and scene.effects.surface == "spheres":
            half = [links.extent[f, i] / 2, width[i] / 2, up[i]]
            _add_block(body, f"finger_{f}_block_{i}", half)
        if i == 0:
            continue
        for name in hinge_order(scene, i - 1):
            stiffness, joint_damping = (v[i - 1, lay.axes.index(name)] for v in springs)
            damping, armature = implicit_spring(scene, stiffness, joint_damping)
            spring = {"stiffness": stiffness, "damping": damping, "armature": armature}
            _hinge(body, f"finger_{f}_{name}_{i}", AXES[name], **spring)
        tendon.wrap_joint(f"finger_{f}_bend_{i}", gains[i - 1] / gains[0])
        for j, (x, radius) in enumerate(zip(spheres[i - 1], radii[i - 1], strict=True)):
            _sphere(body, f"finger_{f}_sphere_{i}_{j}", [x, 0, radius], radius)
    actuator = spec.add_actuator(
        name=f"pressure_{f}", target=f"chamber_{f}", trntype=mujoco.mjtTrn.mjTRN_TENDON
    )
    # Pressure [Pa] in, bending moment [N m] at every joint out: a constant torque, not a moving
    # rest angle.
    actuator.gainprm[0] = gains[0]
    if visual and scene.effects.surface == "hull":
        _add_skin(scene, spec, params, f)


def _add_block(body: mujoco.MjsBody, name: str, half: list[float]) -> None:
    """A link's block, which is for looking at only, around the link's centre of mass."""
    kind = mujoco.mjtGeom.mjGEOM_BOX
    color = _COLORS["finger"]
    body.add_geom(name=name, type=kind, size=half, pos=body.ipos, rgba=color, **_PASSIVE)


def _add_skin(scene: Scene, spec: mujoco.MjSpec, params: Params, f: int) -> None:
    """The finger's hull as MuJoCo's skin, which is for looking at only."""
    length = float(params.length[f])
    height = float(params.height[f])
    tip = None if params.tip is None else Tip(*(float(v[f]) for v in params.tip))
    mesh = hull.hull(scene)
    origins = hull.link_origins(scene, length)
    skin = spec.add_skin(name=f"finger_{f}_hull", rgba=_COLORS["finger"])
    skin.vert = hull.rest(scene, length, height, tip=tip).ravel()
    skin.face = mesh.face.ravel()
    followed = [np.nonzero((mesh.link == i) & (mesh.weight > 0)) for i in range(len(origins))]
    skin.bodyname = [f"finger_{f}_link_{i}" for i in range(len(origins))]
    skin.vertid = [vertex.tolist() for vertex, _ in followed]
    skin.vertweight = [mesh.weight[where].tolist() for where in followed]
    skin.bindpos = np.column_stack([origins, 0 * origins, 0 * origins]).ravel()
    skin.bindquat = np.tile([1.0, 0, 0, 0], len(origins))


def _add_object(
    scene: Scene,
    spec: mujoco.MjSpec,
    trial: Trial,
    solid: tuple[np.ndarray, ...],
    pose: tuple[np.ndarray, np.ndarray],
    visual: bool,
) -> None:
    sizes, mass, inertia = solid
    sizes = geom_sizes(sizes, int(trial.shape), np)
    rest, quat = pose
    body = spec.worldbody.add_body(name="object", pos=[*np.asarray(trial.position), float(rest)])
    body.quat = quat
    body.explicitinertial = True
    body.mass = float(mass)
    body.inertia = inertia
    body.ipos = [0, 0, 0]
    body.iquat = [1, 0, 0, 0]
    body.add_freejoint(name="object")
    for i, shape in enumerate(scene.objects.object):
        active = i == int(trial.shape)
        color = _COLORS["object"] if active or not visual else (0, 0, 0, 0)
        # MuJoCo's meshes are convex and of one size in all worlds: a model carries the bounding box
        # instead, and engines that collide by MuJoCo's geoms refuse meshes (engines/base.py).
        kind = getattr(mujoco.mjtGeom, shape.primitive.geom)
        geom = body.add_geom(name=f"object_{i}", type=kind, rgba=color, **_PASSIVE)
        geom.size = np.asarray(sizes[i])
        if shape.mesh and active and visual:
            geom.type = mujoco.mjtGeom.mjGEOM_MESH
            geom.meshname = f"object_{i}"
            vertices = shape.mesh.vertices * float(trial.size)
            spec.add_mesh(
                name=f"object_{i}", uservert=vertices.ravel(), userface=shape.mesh.faces.ravel()
            )


def add_pair(
    scene: Scene, spec: mujoco.MjSpec, first: str, second: str, kind: int
) -> mujoco.MjsPair:
    """Adds a contact pair."""
    condim = {"none": 1, "coulomb": 3}[scene.effects.friction]
    pair = spec.add_pair(geomname1=first, geomname2=second, condim=condim)
    properties = pairs.frictions(scene)[kind], pairs.impedances(scene)[kind]
    pair.friction, pair.solref, pair.solimp = pairs.numbers(scene, *properties)
    return pair


def surroundings(scene: Scene, table: int) -> list[tuple[str, int]]:
    """Geoms of table and fixtures that may be touched, and the kinds of pairs with them."""
    names = ["table", *(f"fixture_{i}" for i in range(len(scene.fixture)))]
    geoms = [(name, pairs.around(scene, i, table)) for i, name in enumerate(names)]
    return geoms if scene.effects.table else geoms[1:]


def _add_pairs(scene: Scene, spec: mujoco.MjSpec, params: Params) -> None:
    e = scene.effects
    lay = layout(scene)
    fingers = [f"finger_{f}_sphere_{i + 1}_{j}" for f, i, j in np.ndindex(lay.spheres.shape)]
    palm = [f"palm_{i}" for i in range(len(lay.palm))]
    add = functools.partial(add_pair, scene, spec)
    for i in range(len(scene.objects.object)):
        for other, kind in surroundings(scene, pairs.OBJECT_TABLE) if e.object_table else []:
            add(other, f"object_{i}", kind)
        for name in (fingers if e.finger_object else []) + (palm if e.palm_object else []):
            add(name, f"object_{i}", i)
    for name in (fingers if e.finger_table else []) + (palm if e.palm_table else []):
        for other, kind in surroundings(scene, pairs.FINGER_TABLE):
            add(other, name, kind)
    if e.finger_finger:
        for first, second in itertools.combinations(fingers, 2):
            if first.split("_")[1] != second.split("_")[1]:
                add(first, second, pairs.FINGERS)
    if e.finger_palm and fingers:
        free = morphology.spheres_on_palm(scene.hand, params, *lay.spheres.shape[1:])
        for name, may in zip(fingers, np.ravel(free), strict=True):
            if int(name.split("_")[3]) >= first_on_palm(lay.links):
                add(name, "palm_disc", pairs.PALM).margin = pairs.margin(may)
