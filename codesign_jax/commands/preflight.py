"""Limits of stiffness, pressure and reach, checked before anything is simulated.

The scene's own checks look at one number at a time; these look at what a design makes of them.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import model, rollout, start
from codesign_jax.scene import Constants, Scene
from codesign_jax.types import Params

SHAKE_STEPS = 20
"""Fewest time steps in a period of the shaking: the sampled sine then misses 1.2 % of its peak."""
SINK = 1e-3
"""Depth at rest [m] above which a contact is called soft: the paper's objects are 60 mm wide."""


class Findings(NamedTuple):
    """What was found; each entry names the design, the value, its limit and the reason.

    Attributes:
      refusals: What must not be simulated.
      warnings: What may be, but may not mean what it seems to.
    """

    refusals: list[str]
    warnings: list[str]


def check(scene: Scene, designs: Params, names: list[str] | None = None) -> Findings:
    """Checks designs against the scene's limits; simulates nothing.

    Args:
      scene: The scene.
      designs: Parameters with leading axis (design,).
      names: What to call the designs; by default "design 0" and so on.
    """
    designs = Params._make(np.asarray(v, float) for v in designs)
    count = designs.length.shape[0]
    names = names or [f"design {i}" for i in range(count)]
    report = Findings([], _scene_warnings(scene))
    sound = []
    for i, name in enumerate(names):
        one = Params(*(v[i] for v in designs))
        problems = _sections(scene, one, name)
        report.refusals.extend(problems)
        sound.append(not problems)
        if not problems:
            report.warnings.extend(_reach(scene, one, name))
    if any(sound):
        keep = np.array(sound)
        kept = Params(*(v[keep] for v in designs))
        report.refusals.extend(
            _overlaps(scene, kept, [n for n, s in zip(names, sound, strict=True) if s])
        )
    return report


def _scene_warnings(scene: Scene) -> list[str]:
    h, found = scene.discretization.timestep, []
    rate = scene.arm.shake_frequency
    if scene.effects.disturb and rate * h * SHAKE_STEPS > 1:
        found.append(
            f"arm.shake_frequency = {rate:g} Hz has {1 / (rate * h):.1f} time steps of {h:g} s in "
            f"a period: below {SHAKE_STEPS} the shaking is not the sine asked for"
        )
    for i, finger in enumerate(scene.hand.finger):
        if 0 < abs(finger.tilt) <= math.pi / 2:
            found.append(
                f"hand.finger.{i}.tilt = {finger.tilt:g} deg leaves the palm nearly flat; did you "
                f"mean {math.degrees(finger.tilt):.3g}? (radians given where degrees are expected)"
            )
    for shape in scene.objects.object:
        stiffness = scene.contact.normal_stiffness
        sunk = shape.mass * scene.gravity / (2 * stiffness)
        if sunk > SINK:
            found.append(
                f"object {shape.name!r} of {shape.mass:g} kg sinks {1e3 * sunk:.1f} mm into the "
                f"table on one contact: contact.normal_stiffness = {stiffness:g} N/m is soft for "
                "its weight"
            )
    return found


def _sections(scene: Scene, one: Params, name: str) -> list[str]:
    """Why a design's numbers are no hand."""
    if not all(np.isfinite(v).all() for v in one):
        return [f"{name}: a parameter is not a finite number"]
    found = []
    for f in range(scene.num_fingers):
        where = f"{name}: finger {f}"
        length, height, wall = (float(v[f]) for v in (one.length, one.height, one.wall))
        if length <= 0 or wall <= 0:
            found.append(f"{where}: length {length:g} m and wall {wall:g} m must be positive")
        if 2 * wall >= min(height, scene.hand.section.width):
            found.append(
                f"{where}: walls of {wall:g} m leave no air chamber in a section of {height:g} m "
                f"by {scene.hand.section.width:g} m"
            )
            continue
        if one.pressure[f] > (limit := scene.hand.pressure_limit.of(height, wall)) * (1 + 1e-6):
            found.append(
                f"{where}: pressure {one.pressure[f]:.4g} Pa is above the limit of "
                f"{limit:.4g} Pa for a wall of {wall:g} m"
            )
    return found


def _reach(scene: Scene, one: Params, name: str) -> list[str]:
    """Warns if no finger can come down to the object's top, even straight."""
    if not scene.effects.finger_object:
        return []
    palm = scene.arm.zero_height + float(one.arm[2])
    tilt = np.deg2rad([f.tilt for f in scene.hand.finger])
    lowest = float((palm - one.length * np.sin(tilt)).min())
    # An arm that is turned may bring a finger lower, by no more than its whole length.
    turned = float(palm - one.length.max() - max(f.base_distance for f in scene.hand.finger))
    top = max(2 * shape.radius for shape in scene.objects.object)
    if turned > top:
        return [
            f"{name}: the fingers end {1e3 * (lowest - top):.0f} mm above the tallest object "
            f"(palm at {1e3 * palm:.0f} mm): nothing can be touched"
        ]
    return []


def _overlaps(scene: Scene, designs: Params, names: list[str]) -> list[str]:
    """Refuses designs that start deep inside the table, an object or themselves, without noise."""
    numbers = jax.tree.map(np.float32, scene.constants())
    singles = Params(*(v.astype(np.float32) for v in designs))
    with_objects, fingers, palm = map(np.asarray, _depths(scene.structure, numbers, singles))
    limit = scene.limits.penetration
    found = []
    for i, name in enumerate(names):
        inside = [
            (
                deep,
                f"starts {1e3 * deep:.0f} mm inside the table or object {shape.name!r}",
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
        found += [
            f"{name}: {what} (limits.penetration = {1e3 * limit:g} mm); {remedy}"
            for deep, what, remedy in inside
            if not deep <= limit
        ]
    return found


@functools.partial(jax.jit, static_argnums=0)
def _depths(scene: Scene, numbers: Constants, designs: Params) -> tuple[jax.Array, ...]:
    """What `start.invalid_start` judges by, each of shape (object, design); one program for all."""
    own = scene.with_constants(numbers)

    def of_shape(index: jax.Array) -> tuple[jax.Array, ...]:
        trial = rollout.nominal_trial(scene)._replace(shape=index)
        fields = jax.vmap(lambda p: model.model_fields(own, p, trial))(designs)
        tests = start.depth, start.depth_between, start.depth_in_palm
        return tuple(test(scene, fields) for test in tests)

    return jax.lax.map(of_shape, jnp.arange(len(scene.objects.object)))
