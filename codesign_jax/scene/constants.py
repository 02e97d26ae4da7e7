"""The numbers of a scene: checks of them, batches of them, and what a trial changes in them.

>>> import dataclasses
>>> from codesign_jax import constants, scene
>>> grasping = scene.load("paper")
>>> mars = dataclasses.replace(grasping, gravity=3.7)  # m/s^2
>>> constants.check(mars)
>>> dataclasses.replace(mars, gravity=-3.7)
Traceback (most recent call last):
codesign_jax.scene.schema.InputError: scene.gravity = -3.7 is outside [0, 100] m/s^2
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import Scene, check_together, draws, mesh_margins, schema
from codesign_jax.types import Trial


def check(scene: Scene) -> None:
    """Checks numbers before anything runs; of traced ones only shapes can be checked.

    Args:
      scene: The scene; its leaves of shape () or (n,), with the same n.

    Raises:
      InputError: With every number that is none, not finite, of another shape or outside the range
        of its file; or if contacts of the palm would begin farther from a mesh than its distances
        reach.
    """
    # One that was read, as it is in each of many calls.
    plain = all(type(v) is float for v in jax.tree.leaves(scene))
    (_check_once if plain else _check)(scene)


def _check(scene: Scene) -> None:
    ranges = dict(_paths(schema.ranges(scene)))
    leaves = dict(_paths(scene))
    problems = []
    lengths = {np.shape(v) for v in leaves.values()} - {()}
    for path, value in leaves.items():
        problems += _leaf_problems(path, value, ranges[path], len(lengths) > 1)
    # Without compilation (`jax.disable_jit`) the numbers of a bare scene are known as well.
    if not problems and scene.hand.parameter and _known(scene):
        problems = check_together(scene, "scene")
    if problems:
        raise schema.InputError(problems)
    mesh_margins.refuse(scene.objects, scene.hand.palm.contact_radius)


_check_once = functools.lru_cache(maxsize=64)(_check)


def _paths(tree: Any) -> Iterator[tuple[str, Any]]:
    for path, value in jax.tree_util.tree_leaves_with_path(tree):
        yield jax.tree_util.keystr(path).lstrip("."), value


def _leaf_problems(path: str, value: Any, expected: schema.Range, mixed: bool) -> list[str]:
    key = f"scene.{path}"
    shape = np.shape(value)
    if len(shape) > 1 or (shape and mixed):
        words = "numbers have shape (), or all of them the same (n,)"
        return [schema.Problem("size", f"{key} has shape {shape}: {words}")]
    if isinstance(value, jax.core.Tracer):
        return []
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "fiu" and numbers.dtype != jnp.bfloat16:
        return [schema.Problem("type", f"{key} = {value!r} must be a number")]
    every = numbers.astype(float).reshape(-1)
    problems = (schema.near_problem(key, float(v), expected) for v in np.unique(every))
    return [p for p in problems if p][:1]


def _known(scene: Scene) -> bool:
    leaves = jax.tree.leaves(scene)
    return all(np.ndim(v) == 0 and not isinstance(v, jax.core.Tracer) for v in leaves)


def batch_axes(tree: Any) -> Any:
    """The axes of `jax.vmap` over numbers: 0 of leaves with a leading axis, None of others."""
    return jax.tree.map(lambda v: 0 if np.ndim(v) else None, tree)


def with_trial(scene: Scene, trial: Trial) -> Scene:
    """The scene with a trial's factors on its numbers.

    Those are the friction of all contacts, the shear modulus and the masses of fingers and palm;
    and the constants of `Scene.drawn`.
    """
    if trial.constants is not None:
        scene = draws.applied(scene, scene.drawn, trial.constants)
    hand = scene.hand
    objects = scene.objects
    contact = scene.contact
    fixtures = scene.fixture
    if trial.stiffness is not None:
        material = _scaled(hand.material, trial.stiffness, "shear_modulus")
        hand = dataclasses.replace(hand, material=material)
    if trial.hand_mass is not None:
        material = _scaled(hand.material, trial.hand_mass, "density")
        palm = _scaled(hand.palm, trial.hand_mass, "mass")
        hand = dataclasses.replace(hand, material=material, palm=palm)
    if trial.friction is not None:
        shapes = tuple(_scaled(shape, trial.friction, "friction") for shape in objects.object)
        table = _scaled(objects.table, trial.friction, "friction")
        objects = dataclasses.replace(objects, object=shapes, table=table)
        names = "finger_table_friction", "finger_finger_friction", "finger_palm_friction"
        contact = _scaled(contact, trial.friction, *names)
        fixtures = tuple(
            f if f.friction is None else _scaled(f, trial.friction, "friction") for f in fixtures
        )
    changes = {"hand": hand, "objects": objects, "contact": contact, "fixture": fixtures}
    return dataclasses.replace(scene, **changes)


def _scaled(table: Any, factor: Any, *names: str) -> Any:
    return schema.replaced(table, **{name: factor * getattr(table, name) for name in names})
