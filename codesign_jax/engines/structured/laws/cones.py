"""Parameters of the friction cones of every world, from the scene's numbers, once a rollout."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.laws.contact import Cone
from codesign_jax.model.held import keeps
from codesign_jax.model.layout import contact_mass, dissipation, friction_ratio
from codesign_jax.scene import Scene


class Cones(NamedTuple):
    """Cones by what touches; None where nothing of it does."""

    finger_object: Cone | None  # Fingers or palm on the object
    finger_table: Cone | None  # Fingers or palm on the table
    object_table: Cone | None  # The object on the table
    finger_finger: Cone | None  # Fingers on one another and on themselves
    finger_palm: Cone | None  # Fingers on the palm's disc


def which_cone(pair: str) -> str:
    """The field of `Cones` for a pair of bodies: the palm's contacts have the fingers' cones."""
    same = {
        "palm_object": "finger_object",
        "palm_table": "finger_table",
        "finger_itself": "finger_finger",
    }
    return same.get(pair, pair)


def make_cone(scene: Scene, friction: Any, *, bodies: int, ratio: Any, stiffer: Any = 1.0) -> Cone:
    """A contact's parameters, see `contact`.

    Args:
      scene: The scene; its numbers may be arrays.
      bodies: Bodies other than the world in the contact: against the world it is twice as stiff.
      ratio: How much harder friction is.
      stiffer: Stiffness over `contact.normal_stiffness`.
    """
    h = scene.discretization.timestep
    surface = {"ahead": scene.effects.surface == "hull"}
    normal_mass = 2.0 / bodies * stiffer * contact_mass(scene, **surface)
    reference = 1.0 / (h * (h + dissipation(scene, **surface))), 1.0 / h + 0.0 * normal_mass
    if scene.effects.friction == "none":
        return Cone(normal_mass, None, None, None, *reference)  # type: ignore[arg-type]
    impratio = friction_ratio(scene, ratio, **surface)
    tangential_mass = impratio * normal_mass
    return Cone(normal_mass, tangential_mass, friction, friction / jnp.sqrt(impratio), *reference)


def make_cones(scene: Scene, shape: jax.Array) -> Cones:
    """The cones of worlds; the scene's numbers and the objects' indices have one shape."""
    on_object = scene.objects.object[0].friction
    for i, other in enumerate(scene.objects.object[1:], 1):
        on_object = jnp.where(shape == i, other.friction, on_object)
    e = scene.effects
    c = scene.contact
    ratio = c.held_friction_ratio if keeps(scene) else c.friction_ratio
    two_skins = partial(make_cone, scene, bodies=2, ratio=ratio)
    one_skin = partial(make_cone, scene, bodies=1, ratio=ratio)
    # MuJoCo has one impratio for all contacts, so that spheres, which it simulates too, do here.
    between = c.finger_finger_friction_ratio if e.surface == "hull" else c.friction_ratio
    stiffer = c.finger_palm_stiffness / c.normal_stiffness
    return Cones(
        finger_object=two_skins(on_object) if e.finger_object or e.palm_object else None,
        finger_table=one_skin(c.finger_table_friction) if e.finger_table or e.palm_table else None,
        object_table=one_skin(scene.objects.table.friction) if e.object_table else None,
        finger_finger=(
            two_skins(c.finger_finger_friction, ratio=between)
            if e.finger_finger or e.finger_itself
            else None
        ),
        finger_palm=(
            two_skins(c.finger_palm_friction, ratio=between, stiffer=stiffer)
            if e.finger_palm
            else None
        ),
    )


def friction_by_contact(scene: Scene, pair: str) -> bool:
    """Whether contacts of a pair of bodies have friction one by one, and not by the pair."""
    rubs = any(fixture.friction is not None for fixture in scene.fixture)
    return rubs and pair.endswith("_table") and scene.effects.friction != "none"


def frictions(scene: Scene) -> jax.Array | None:
    """Coulomb coefficients of the hand, then of the object, on table and fixtures, shape (n, ...).

    They are in the order of `surroundings.fields`; None if all have the table's.
    """
    if not friction_by_contact(scene, "object_table"):
        return None
    tables = scene.contact.finger_table_friction, scene.objects.table.friction
    coefficients = []
    for table in tables:
        coefficients += [table] * scene.effects.table
        for fixture in scene.fixture:
            coefficients.append(table if fixture.friction is None else fixture.friction)
    return jnp.stack([jnp.asarray(v) for v in coefficients])
