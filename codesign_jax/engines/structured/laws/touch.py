"""One contact of a ring or sphere with a distance field: look, aim, look again, touch.

A field is a function that looks: from points (3, ...) to their distance from a body (...) and the
gradient of the distance (3, ...), a unit vector in world axes.  The object, the table, fixtures and
the palm's disc are fields.  The adjoint's residual and `overlaps` call `touch` for all of them, the
kernel its two stages, `facing` and `ring_place`, with a test of the gap between them.

Rings are given by their numbers, shape (8, ...), see `rings.Ring`.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import apply_columns, directly
from codesign_jax.engines.structured.laws import rings
from codesign_jax.engines.structured.laws.rings import Facing, Place, Ring


def touch(
    surface: str,
    numbers: Any,
    frame: Any,
    centre: Any,
    first: tuple[Any, Any],
    look: Callable[[Any], tuple[Any, Any]],
    *,
    plane: bool = False,
    apply: Callable = directly,
) -> Place:
    """Contacts of rings, or spheres, of a body with a distance field.

    Args:
      surface: The scene's `effects.surface`, "hull" for rings or "spheres".
      numbers: Their numbers, shape (8, ...).
      frame: The body's frame, columns (3, 3, ...).
      centre: Their centres [m], world axes, shape (3, ...); see `ring_centre`.
      first: What `look` found at the centres.
      look: The field.
      plane: Whether the field is that of a plane, which looks alike from everywhere.
      apply: Evaluates apply(stage, *args): `lanewise` in a kernel, `once` over whole arrays.
    """
    if surface == "spheres":
        return apply(ball_on_field, numbers, centre, *first)
    faced = facing(numbers, frame, centre, first, look, plane=plane, apply=apply)
    return apply(ring_place, numbers, frame, centre, faced)


def facing(
    numbers: Any,
    frame: Any,
    centre: Any,
    first: tuple[Any, Any],
    look: Callable[[Any], tuple[Any, Any]],
    *,
    plane: bool = False,
    apply: Callable = directly,
) -> Facing:
    """The first half of `touch` of rings: how they face the field, and at which gap."""
    if plane:
        offset = apply(jnp.zeros_like, centre)
        return apply(ring_facing, numbers, frame, offset, *first)
    offset = apply(aim, numbers, frame, *first)
    again = look(apply(jnp.add, centre, offset))
    return apply(ring_facing, numbers, frame, offset, *again)


# Stages


def ring_centre(origin: jax.Array, frame: jax.Array, numbers: jax.Array) -> jax.Array:
    """Centre of a ring on a body, from the body's origin and frame."""
    return origin + apply_columns(frame, numbers[:3])


def ring_centres(origin: jax.Array, frame: jax.Array, numbers: jax.Array) -> jax.Array:
    """Centres of k rings on a body; numbers of shape (8, k, ...)."""
    return ring_centre(origin[:, None], frame[:, :, None], numbers)


def aim(
    numbers: jax.Array, frame: jax.Array, distance: jax.Array, gradient: jax.Array
) -> jax.Array:
    """From centres to where the field is looked at again, see `rings.aim`."""
    return rings.aim(Ring.of(numbers), frame, distance, gradient)


def ring_facing(
    numbers: jax.Array,
    frame: jax.Array,
    offset: jax.Array,
    distance: jax.Array,
    normal: jax.Array,
) -> Facing:
    """How rings face a field, see `rings.facing_field`."""
    return rings.facing_field(Ring.of(numbers), frame, offset, distance, normal)


def ring_place(numbers: jax.Array, frame: jax.Array, centre: jax.Array, facing: Facing) -> Place:
    """Contacts of rings with what they face, see `rings.place`."""
    return rings.place(Ring.of(numbers), frame, centre, facing)


def ring_reach(numbers: jax.Array) -> jax.Array:
    """Distance of rings' farthest points from their centres [m]."""
    return rings.farthest(Ring.of(numbers).half)


def ball_on_field(
    numbers: jax.Array, centre: jax.Array, distance: jax.Array, normal: jax.Array
) -> Place:
    """Contacts of spheres, all of whose half axes are the radius; see `rings.ball_on_field`."""
    return rings.ball_on_field(numbers[3] * numbers[6], centre, distance, normal)
