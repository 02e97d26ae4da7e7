"""Constants: checks of changed ones, batches of them, and what a trial changes in them.

>>> from codesign_jax import constants, scene
>>> grasping = scene.load("paper")
>>> mars = grasping.constants()._replace(gravity=3.7)  # m/s^2
>>> constants.check(grasping, mars)
>>> constants.check(grasping, mars._replace(gravity=-3.7))
Traceback (most recent call last):
codesign_jax.scene.schema.InputError: constants.gravity = -3.7 is outside [0, 100] m/s^2
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import Constants, Scene, check_together, reach, schema
from codesign_jax.types import Trial


def check(scene: Scene, constants: Constants) -> None:
    """Checks numbers before anything runs; of traced ones only names and shapes can be checked.

    Args:
      scene: The scene whose constants they replace.
      constants: The numbers; leaves of shape () or (n,), with the same n.

    Raises:
      InputError: With every key that is missing, unknown, not a number, not finite, of another
        shape or outside the range of its file; or if contacts of the palm would begin farther from
        a mesh than its distances reach.
    """
    problems = _structure_problems(scene, constants)
    if not problems:
        ranges = dict(_paths(Constants(**schema.ranges(scene)._asdict())))
        leaves = dict(_paths(constants))
        lengths = {np.shape(v) for v in leaves.values()} - {()}
        for path, value in leaves.items():
            problems += _leaf_problems(path, value, ranges[path], len(lengths) > 1)
    if not problems and _known(constants):
        problems = check_together(scene.with_constants(constants), "constants")
    if problems:
        raise schema.InputError(problems)
    radius, noise = constants.hand.palm.contact_radius, constants.objects.noise.size
    if not any(isinstance(v, jax.core.Tracer) for v in (radius, noise)):
        reach.refuse(scene.objects, float(np.asarray(radius).max()), float(np.asarray(noise).max()))


def _paths(tree: Any) -> Iterator[tuple[str, Any]]:
    """Leaves by key, such as hand.finger[0].tilt."""
    leaf = lambda v: isinstance(v, schema.Range)  # noqa: E731
    for path, value in jax.tree_util.tree_flatten_with_path(tree, is_leaf=leaf)[0]:
        yield jax.tree_util.keystr(path).lstrip("."), value


def _structure_problems(scene: Scene, constants: Any) -> list[str]:
    expected = scene.constants()
    if jax.tree.structure(constants) == jax.tree.structure(expected):
        return []
    given, wanted = dict(_paths(constants)), dict(_paths(expected))
    problems = [f"constants.{path} is missing" for path in wanted if path not in given]
    for path in given:
        if path not in wanted:
            problems.append(
                f"constants.{path} is no number of this scene; {schema.nearest(path, wanted)}"
            )
    return problems or ["constants has the right keys but is not nested as scene.constants()"]


def _leaf_problems(path: str, value: Any, expected: schema.Range, mixed: bool) -> list[str]:
    key, shape = f"constants.{path}", np.shape(value)
    if len(shape) > 1 or (shape and mixed):
        return [f"{key} has shape {shape}: numbers have shape (), or all of them the same (n,)"]
    if isinstance(value, jax.core.Tracer):
        return []
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "fiu" and numbers.dtype != jnp.bfloat16:
        return [f"{key} = {value!r} must be a number"]
    every = numbers.astype(float).reshape(-1)
    found = (_range_problem(key, float(v), expected) for v in np.unique(every))
    return [p for p in found if p][:1]


def _range_problem(key: str, value: float, expected: schema.Range) -> str | None:
    # The float32 nearest to a bound is inside.
    low, high = (b + side * 1e-6 * abs(b) for b, side in ((expected.low, -1), (expected.high, 1)))
    if low <= value <= high:
        return None
    return schema.range_problem(key, value, expected.unit, expected.low, expected.high)


def _known(constants: Constants) -> bool:
    """Whether every number is one number, and not traced."""
    leaves = jax.tree.leaves(constants)
    return all(np.ndim(v) == 0 and not isinstance(v, jax.core.Tracer) for v in leaves)


def batch_axes(constants: Constants) -> Constants:
    """The axes of `jax.vmap` over constants: 0 of leaves with a leading axis, None of numbers."""
    return jax.tree.map(lambda v: 0 if np.ndim(v) else None, constants)


def with_trial(scene: Scene, trial: Trial) -> Scene:
    """The scene with a trial's factors on its numbers.

    Those are the friction of all contacts, the shear modulus and the masses of fingers and palm.

    Args:
      scene: The scene.
      trial: One trial; its factors on the object's mass and size are applied by the model.
    """
    c = scene.constants()
    if trial.stiffness is not None:
        material = _scaled(c.hand.material, trial.stiffness, "shear_modulus")
        c = c._replace(hand=c.hand._replace(material=material))
    if trial.hand_mass is not None:
        material = _scaled(c.hand.material, trial.hand_mass, "density")
        palm = _scaled(c.hand.palm, trial.hand_mass, "mass")
        c = c._replace(hand=c.hand._replace(material=material, palm=palm))
    if trial.friction is not None:
        c = _with_friction(c, trial.friction)
    return scene.with_constants(c)


def _with_friction(c: Constants, factor: Any) -> Constants:
    shapes = tuple(_scaled(shape, factor, "friction") for shape in c.objects.object)
    table = _scaled(c.objects.table, factor, "friction")
    names = "finger_table_friction", "finger_finger_friction", "finger_palm_friction"
    contact = _scaled(c.contact, factor, *names)
    fixture = c.fixture and tuple(f and _scaled(f, factor, "friction") for f in c.fixture)
    objects = c.objects._replace(object=shapes, table=table)
    return c._replace(objects=objects, contact=contact, fixture=fixture)


def _scaled(table: Any, factor: Any, *names: str) -> Any:
    return table._replace(**{name: factor * getattr(table, name) for name in names})
