"""Parameters of the friction cones of every world, from the scene's numbers, once a rollout."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.laws.contact import Cone
from codesign_jax.model import contact_invweight
from codesign_jax.model.layout import palm_impedance
from codesign_jax.scene import Scene


class Cones(NamedTuple):
    """Cones by what touches; their numbers have shape (1, world).  None where nothing of it does.

    Attributes:
      hand_object: Fingers, hull or palm on the object.
      hand_table: Fingers, hull or palm on the table.
      object_table: The object on the table.
      finger_finger: Fingers on one another.
      finger_palm: Fingers on the palm's disc.
    """

    hand_object: Cone | None
    hand_table: Cone | None
    object_table: Cone | None
    finger_finger: Cone | None
    finger_palm: Cone | None


def which_cone(pair: str) -> str:
    """The field of `Cones` for a pair of bodies, which is named as in `problem.relative`."""
    if pair in Cones._fields:
        return pair
    return "hand_object" if pair.endswith("_object") else "hand_table"


def make_cone(
    scene: Scene, friction: Any, *, bodies: int, impratio: Any = None, impedance: Any = None
) -> Cone:
    """MuJoCo's contact parameters for constant impedance (its Computation chapter).

    Args:
      scene: The scene; its numbers may be arrays.
      friction: Coulomb coefficient.
      bodies: Bodies other than the world in the contact, whose declared inverse weights add.
      impratio: MuJoCo's impratio, by default `contact.friction_ratio`.
      impedance: By default `contact.impedance`.
    """
    c = scene.contact
    impratio = c.friction_ratio if impratio is None else impratio
    impedance = c.impedance if impedance is None else impedance
    grows = {}
    if scene.effects.soft_touch:
        spring, _ = _reference(scene, impedance)
        least = scene.discretization.timestep**2 * spring
        grows = {"growth": 1.0 / c.touch_depth + 0.0 * least, "least": least}
    regularizer = (1.0 - impedance) / impedance * contact_invweight(scene) * bodies
    reference = _reference(scene, impedance)
    if scene.effects.friction == "none":
        return Cone(1.0 / regularizer, None, None, None, *reference, **grows)
    ratio = friction / jnp.sqrt(impratio)
    tangent = impratio / regularizer
    cone = Cone(1.0 / regularizer, tangent, friction, ratio, *reference, **grows)
    if scene.effects.friction != "full":
        return cone
    least = jnp.maximum(friction, 1e-5)  # MuJoCo's mjMINMU
    return cone._replace(spin=c.torsional_friction / least, roll=c.rolling_friction / least)


def make_cones(scene: Scene, shape: jax.Array) -> Cones:
    """The cones of a batch.

    Args:
      scene: The scene, its numbers of shape (1, world).
      shape: Index of each world's object, shape (1, world).
    """
    on_object = scene.objects.object[0].friction
    for i, other in enumerate(scene.objects.object[1:], 1):
        on_object = jnp.where(shape == i, other.friction, on_object)
    e, c = scene.effects, scene.contact
    two, one = partial(make_cone, scene, bodies=2), partial(make_cone, scene, bodies=1)
    # MuJoCo has one impratio for all contacts, so that spheres, which it simulates too, do here.
    between = c.finger_finger_friction_ratio if e.surface == "hull" else c.friction_ratio
    return Cones(
        hand_object=two(on_object) if e.finger_object or e.palm_object else None,
        hand_table=one(c.finger_table_friction) if e.finger_table or e.palm_table else None,
        object_table=one(scene.objects.table.friction) if e.object_table else None,
        finger_finger=two(c.finger_finger_friction, impratio=between) if e.finger_finger else None,
        finger_palm=(
            two(c.finger_palm_friction, impratio=between, impedance=palm_impedance(scene))
            if e.finger_palm
            else None
        ),
    )


def _reference(scene: Scene, impedance: Any) -> tuple[Any, Any]:
    """Spring and damper coefficients of aref."""
    time = scene.contact.time_constant
    return 1.0 / (impedance * time) ** 2 * impedance, 2.0 / (impedance * time)
