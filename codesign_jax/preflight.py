"""Before anything is simulated: which worlds may start, and warnings of scenes and designs.

`invalid_start` judges the worlds of a batch as a part of its program, by the overlap that the
structured engine finds in its first step, or by `engines.depths` for those that tell none; `notes`
and `refusals` judge named designs by the same depths and say in words what is wrong.  The scene's
own checks look at one number at a time; these look at the world that a design makes of them.
"""

import math
import operator
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import model
from codesign_jax.engines.depths import (
    depth,
    depth_between,
    depth_by_pair,
    depth_in_palm,
    largest_depth,
)
from codesign_jax.model import ModelFields, morphology
from codesign_jax.model.clearance import starts_apart
from codesign_jax.reuse import quickly_compiled
from codesign_jax.scene import Scene, key_frames
from codesign_jax.scene.parameters import DesignSpace, params_of
from codesign_jax.scene.schema import InputError, nearest
from codesign_jax.types import Params, Status, Trial

SHAKE_STEPS = 20
"""Fewest time steps in a period of the shaking: the sampled sine then misses 1.2 % of its peak."""
FALL = 5
"""Degrees by which an object turns until it rests above which it is said to topple: scans of things
that stand are a little oblique in their files."""
ROLL = 0.5e-3
"""How far it sinks besides [m]: a lying cylinder that is drawn with edges rolls onto a facet."""
ROOM = 0.01
"""Distance between fingers and the tallest object at the start that is advised [m] [chosen]."""
CLOSES = 20.0
"""Free bend of a finger below which it hardly closes a hand [deg] [chosen]: recommended hands bend
by more than 90."""
SINK = 1e-3
"""Depth at rest [m] above which a contact is called soft: the paper's objects are 60 mm wide."""


def nominal_trial(scene: Scene, shape: int | str = 0) -> Trial:
    """Returns a trial without noise for an object of the set, by index or name.

    Raises:
      InputError: If the set has no such object.
    """
    names = [s.name for s in scene.objects.object]
    if shape not in names and shape not in range(len(names)):
        hint = nearest(str(shape), names)
        raise InputError.of("unknown", f"object {shape!r} unknown in {scene.objects.name}; {hint}")
    index = names.index(shape) if isinstance(shape, str) else shape
    zero = jnp.zeros(())
    none = jnp.zeros(2)
    unity = jnp.ones(())
    return Trial(jnp.int32(index), none, zero, none, unity, unity, unity, unity, unity, none)


def invalid_start(scene: Scene, fields: ModelFields, deepest: jax.Array | None = None) -> jax.Array:
    """Returns INVALID_START for worlds that cannot start, shape (world,) int32, else 0.

    A world is refused if a field is not finite, a moving body has no mass or inertia, a spring or
    damper is negative (walls that leave no chamber, a negative length), or if at the start any two
    bodies that may touch overlap by more than the scene's limit of penetration: soft contacts would
    drive them apart with energy that no actuator gave.

    Args:
      deepest: Their largest overlaps [m], shape (world,), as `Trace.overlap` of an engine has them;
        None for those of `depths.largest_depth`, six thousand operations for XLA to compile.
    """
    fields = jax.lax.stop_gradient(fields)  # a verdict has no derivative
    scene = scene.structure
    if deepest is None:
        deepest = largest_depth(scene, fields)
    bad = ~(jax.lax.stop_gradient(deepest) <= fields.constants.limits.penetration)
    # Constants in their ranges have a finite sum, for which XLA writes one loop; as rows of an
    # array they would be one loop each.
    bad |= ~jnp.isfinite(sum(jax.tree.leaves(fields.constants)))
    others = jax.tree.leaves(fields._replace(constants=(), shape=()))
    bad |= ~jnp.isfinite(_rows(*others)).all(1)
    bad |= ~(_rows(fields.mass[:, :, 1:], fields.inertia[:, :, 1:]) > 0).all(1)
    bad |= ~(_rows(fields.stiffness, fields.damping, fields.armature) >= 0).all(1)
    return jnp.where(bad, int(Status.INVALID_START), 0).astype(jnp.int32)


def _rows(*arrays: jax.Array) -> jax.Array:
    """All numbers of each world, of arrays with leading axis (world,), shape (world, number)."""
    return jnp.concatenate([x.reshape(x.shape[0], -1) for x in arrays], 1)


def notes(
    scene: Scene,
    space: DesignSpace,
    designs: Mapping[str, np.ndarray],
    start: Callable[[Params], bool] = lambda designs: False,
) -> list[str]:
    """Warnings of named designs [SI units], and how exact the scene's meshes are.

    Args:
      start: Whether a simulation says that all of the designs start apart from everything, as
        `batch.Batch.start`: then no program is compiled that measures depths.
    """
    params = params_of(space, np.array([*designs.values()], np.float32))
    params = jax.tree.map(np.asarray, params)  # whose operations compile nothing
    problems = refusals(scene, params, [*designs], start)
    if problems:
        raise InputError(problems)
    lines = [f"warning: {text}" for text in warnings(scene, params, [*designs])]
    idle = [f"not searched: {name}, which has no effect: {why}" for name, why in space.idle]
    return lines + idle + mesh_notes(scene)


def warnings(scene: Scene, designs: Params, names: list[str]) -> list[str]:
    """What designs, arrays with leading axis (design,), may not mean as they seem to."""
    doubts = _scene_warnings(scene)
    each = [jax.tree.map(operator.itemgetter(i), designs) for i in range(len(names))]
    for design, name in zip(each, names, strict=True):
        doubts += _reach(scene, design, name) + _twists(scene, design, name)
    low = [text for design in each for text in low_starts(scene, design)]
    return doubts + low[:1] + _stiffness(scene, each)


def refusals(
    scene: Scene,
    designs: Params,
    names: list[str],
    start: Callable[[Params], bool] = lambda designs: False,
) -> list[str]:
    """Why designs, with leading axis (design,), must not be simulated; `start`: see `notes`."""
    limit = morphology.pressure_limits(scene.hand, designs)
    problems = [
        f"{names[i]}: finger {f}: pressure {designs.pressure[i, f]:.4g} Pa is above the limit of "
        f"{limit[i, f]:.4g} Pa for a wall of {designs.wall[i, f]:g} m"
        for i, f in np.argwhere(np.asarray(designs.pressure) > limit * (1 + 1e-6))
    ]
    each = [jax.tree.map(operator.itemgetter(i), designs) for i in range(len(names))]
    if problems or not (all(starts_apart(scene, design) for design in each) or start(designs)):
        problems += _overlaps(scene, designs, names)
    return problems


def mesh_notes(scene: Scene) -> list[str]:
    """Repairs of the scene's meshes and errors of their distances, which are built for it."""
    lines = []
    for shape in scene.objects.object:
        if shape.mesh:
            grid = shape.mesh.grid
            cell, error, worst = (1e3 * v for v in (grid.cell, grid.error, grid.worst))
            lines += [f"object {shape.name}: {line}" for line in shape.mesh.repairs]
            lines.append(
                f"object {shape.name}: distances on {cell:.2g} mm cells, error near the surface "
                f"below {error:.2g} mm (99 %), {worst:.2g} mm at worst"
            )
    return lines


def shaken_coarsely(scene: Scene) -> bool:
    """Whether a period of the shaking has fewer than `SHAKE_STEPS` time steps."""
    step = scene.discretization.timestep
    return bool(scene.effects.disturb and scene.arm.shake_frequency * step * SHAKE_STEPS > 1)


def _scene_warnings(scene: Scene) -> list[str]:
    h = scene.discretization.timestep
    doubts = key_frames.doubts(scene, "control")
    rate = scene.arm.shake_frequency
    if shaken_coarsely(scene):
        doubts.append(
            f"arm.shake_frequency = {rate:g} Hz has {1 / (rate * h):.1f} time steps of {h:g} s in "
            f"a period: below {SHAKE_STEPS} the shaking is not the sine asked for"
        )
    for i, finger in enumerate(scene.hand.finger):
        if 0 < abs(finger.tilt) <= math.pi / 2:
            doubts.append(
                f"hand.finger.{i}.tilt = {finger.tilt:g} deg leaves the palm nearly flat; did you "
                f"mean {math.degrees(finger.tilt):.3g}? (radians given where degrees are expected)"
            )
    if (tilt := scene.objects.noise.tilt) and not scene.phases.settle:
        doubts.append(
            f"noise.tilt = {tilt:g} deg puts objects askew on the table, and they fall while the "
            "hand comes: phases.settle = 1 gives them a second before"
        )
    for shape in scene.objects.object:
        angle, sunk = shape.fall
        if angle > FALL and sunk > ROLL:
            doubts.append(
                f"object {shape.name!r} does not rest as it is put on the table: it topples by "
                f'{angle} degrees before the hand comes; pose = "stable" in its [[object]] puts it '
                "as it comes to rest most often"
            )
        stiffness = scene.contact.normal_stiffness
        sunk = shape.mass * scene.gravity / (2 * stiffness)
        if sunk > SINK:
            doubts.append(
                f"object {shape.name!r} of {shape.mass:g} kg sinks {1e3 * sunk:.1f} mm into the "
                f"table on one contact: contact.normal_stiffness = {stiffness:g} N/m is soft for "
                "its weight"
            )
    return doubts


def _reach(scene: Scene, design: Params, name: str) -> list[str]:
    if not scene.effects.finger_object:
        return []
    palm = float(key_frames.poses(scene, design, numpy=np)[:, 2].min())
    tilt = np.deg2rad([f.tilt for f in scene.hand.finger])
    lowest = float((palm - design.length * np.sin(tilt)).min())
    # An arm that is turned may bring a finger lower, by no more than its whole length.
    turned = float(palm - design.length.max() - max(f.base_distance for f in scene.hand.finger))
    top = max(2 * shape.radius for shape in scene.objects.object)
    if turned > top:
        return [
            f"{name}: the fingers end {1e3 * (lowest - top):.0f} mm above the tallest object "
            f"(palm at {1e3 * palm:.0f} mm): nothing can be touched"
        ]
    return []


def low_starts(scene: Scene, design: Params) -> list[str]:
    """A warning where fingers reach below the top of the tallest object as the arm starts.

    Whether one then starts inside it depends on the arm's pose and on the trial's noise.
    """
    if not scene.effects.finger_object:
        return []
    x, y, height = (float(v) for v in key_frames.poses(scene, design, 1, np)[0][:3])
    longest = float(np.max(design.length))
    tallest = max(scene.objects.object, key=lambda shape: float(shape.height))
    noise = scene.objects.noise
    top = float(tallest.height) * (1 + 2 * float(noise.size))
    outside = np.hypot(x, y) > longest + float(tallest.radius)
    if height - longest > top or outside:
        return []
    needed = math.ceil(100 * (top + longest + ROOM)) / 100
    return [
        f"fingers of {1e3 * longest:.0f} mm begin {1e3 * (height - longest):.0f} mm above the "
        f"table, and object {tallest.name!r} is {1e3 * float(tallest.height):.0f} mm high: grasps "
        f"may begin with a finger inside it (INVALID_START); --set arm.start_height={needed:g} "
        "begins above it"
    ]


_BODIES = {
    "finger_object": "finger {finger} in object {object!r}",
    "finger_table": "finger {finger} in the table{fixture}",
    "palm_object": "the palm in object {object!r}",
    "palm_table": "the palm in the table{fixture}",
    "object_table": "object {object!r} in the table{fixture}",
    "finger_finger": "two fingers in one another",
    "finger_palm": "a finger in the palm",
}
"""Bodies that overlap, by the names of `depth_by_pair`."""
_LIFTED = ("finger_object", "finger_table", "palm_object", "palm_table")
"""Those that an arm which begins higher takes apart."""


def why_invalid(scene: Scene, design: Params, trial: Trial) -> list[str]:
    """Which bodies overlap too far for a grasp to start, deepest first, and what helps.

    Args:
      design: Parameters of one hand.
      trial: One trial.
    """
    singles = jax.tree.map(np.float32, (scene.bare, design))
    depths = jax.tree.map(lambda v: np.asarray(v)[..., 0], _depth_by_pair(*singles, trial))
    name = scene.objects.object[int(trial.shape)].name
    words = {"object": name, "fixture": " or a fixture" if scene.fixture else ""}
    inside = []
    for pair, deep in depths.items():
        text = _BODIES[pair].format(finger=int(np.argmax(deep)), **words)
        inside.append((float(np.max(deep)), text, pair))
    limit = float(scene.limits.penetration)
    deepest = sorted((row for row in inside if not row[0] <= limit), reverse=True)
    texts = [f"{text} by {1e3 * deep:.0f} mm" for deep, text, _ in deepest]
    if not texts:
        return []
    line = f"INVALID_START: {', '.join(texts)} at the start"
    higher = [deep for deep, _, pair in deepest if pair in _LIFTED]
    if higher and np.isfinite(higher[0]):
        height = math.ceil(100 * (scene.arm.start_height + higher[0] + ROOM)) / 100
        line += f"; --set arm.start_height={height:g} begins higher"
    return [line]


@jax.jit
def _depth_by_pair(scene: Scene, design: Params, trial: Trial) -> dict[str, jax.Array]:
    fields = jax.tree.map(lambda v: v[None], model.model_fields(scene, design, trial))
    return depth_by_pair(scene.structure, fields)


def _twists(scene: Scene, design: Params, name: str) -> list[str]:
    """A warning of fingers whose sections are unstable in twist, where their law has that."""
    if scene.hand.section.law == "chamber":
        return []
    return [
        f"{name}: finger {i} twists by itself where it is held straight at "
        f"{float(design.pressure[i]) / 1e3:.0f} kPa: thicker walls, less pressure or a thread that "
        "is wound there and back keep it from that"
        for i in np.flatnonzero(morphology.twists_by_itself(scene.hand, design))
    ]


def _stiffness(scene: Scene, designs: list[Params]) -> list[str]:
    """A warning where no finger of the designs bends far enough to close a hand."""
    law = bool(scene.effects.neo_hookean)
    bends = [morphology.free_bends(scene.hand, design, neo_hookean=law) for design in designs]
    most = float(np.degrees(np.abs(bends).max()))
    if most >= CLOSES:
        return []
    return [
        f"fingers bend by at most {most:.2g} degrees without load, too little to close around an "
        "object: a softer silicone, thinner walls, longer fingers or more pressure bend them "
        "further"
    ]


def _overlaps(scene: Scene, designs: Params, names: list[str]) -> list[str]:
    numbers = jax.tree.map(np.float32, scene.bare)
    singles = jax.tree.map(np.float32, designs)
    with_objects, fingers, palm = map(np.asarray, _depths(numbers, singles))
    fixtures = ", a fixture" if scene.fixture else ""
    limit = scene.limits.penetration
    problems = []
    for i, name in enumerate(names):
        inside = [
            (
                deep,
                f"starts {1e3 * deep:.0f} mm inside the table{fixtures} or object {shape.name!r}",
                f"raise arm.start_height = {scene.arm.start_height:g} m",
            )
            for shape, deep in zip(scene.objects.object, with_objects[:, i], strict=True)
        ]
        inside += [
            (
                fingers[0, i],
                f"fingers start {1e3 * fingers[0, i]:.0f} mm inside one another",
                "spread them, mount them further apart, or set effects.finger_finger = false",
            ),
            (
                palm[0, i],
                f"a finger starts {1e3 * palm[0, i]:.0f} mm inside the palm",
                "mount it further out or tilt it further down, or set effects.finger_palm = false",
            ),
        ]
        problems += [
            f"{name}: {overlap} (limits.penetration = {1e3 * limit:g} mm); {remedy}"
            for deep, overlap, remedy in inside
            if not deep <= limit
        ]
    return problems


@quickly_compiled
def _depths(scene: Scene, designs: Params) -> tuple[jax.Array, ...]:
    """What `invalid_start` judges by, each of shape (object, design); one program for all."""

    def of_shape(index: jax.Array) -> tuple[jax.Array, ...]:
        trial = nominal_trial(scene)._replace(shape=index)
        fields = jax.vmap(lambda p: model.model_fields(scene, p, trial))(designs)
        tests = depth, depth_between, depth_in_palm
        return tuple(test(scene.structure, fields) for test in tests)

    return jax.lax.map(of_shape, jnp.arange(len(scene.objects.object)))
