"""Friction that two bodies hold on one another from step to step, the effect `friction_memory`."""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.laws.contact import Contacts


def held(contacts: Contacts, held_friction: jax.Array) -> jax.Array:
    """What a contact's jar has of the friction that its two bodies hold, shaped as jar.

    With the effect `friction_memory` the tangential force of a contact that sticks is
      f = -D_t (a + b v) - E g,
    with its elastic normal force E = D K |gap|, K the stiffness of its reference acceleration, and
    g the friction coefficient that the two bodies used in the step before, see `hold`.  Below the
    cone the force so grows until nothing moves,
    where without g it keeps v in proportion to f.  The cone bounds it as before: a spring of
    tangential stiffness D_t b / h with a slider (Cundall and Strack 1979, Geotechnique 29, 47).

    Args:
      held_friction: g, world axes, shape (3, ...).
    """
    cone = contacts.cone
    n = contacts.normal
    # A slot in which a lane has no contact may have no stiffness either.
    some = contacts.active & (cone.tangential_mass > 0)
    elastic = jnp.where(some, _elastic(contacts) / jnp.where(some, cone.tangential_mass, 1.0), 0.0)
    return elastic * (held_friction - dot(n, held_friction) * n)


def hold(contacts: Contacts, force: jax.Array, held_friction: jax.Array) -> jax.Array:
    """What a contact adds to the friction that its two bodies hold, shape (4, ...).

    The quotient of the sums over their contacts is the next g: minus the tangential forces over
    the normal ones.  Where E is the larger one it counts in their place, so that g is at most mu.
    A contact leaves the part of g along its own normal as it is: without it bodies at rest that
    touch with several normals would lose g as fast as those differ.

    Args:
      held_friction: As in `held`.
    """
    n = contacts.normal
    force = force[:3]
    normal_force = dot(n, force)
    weight = jnp.where(contacts.active, jnp.maximum(normal_force, _elastic(contacts)), 0.0)
    return jnp.concatenate(
        [(normal_force + weight * dot(n, held_friction)) * n - force, weight[None]]
    )


def stored_energy(contacts: Contacts, held_friction: jax.Array | None) -> jax.Array:
    """Energy of contacts' springs [J]: the normal one's, and that of `held`, if there is any."""
    cone = contacts.cone
    energy = _elastic(contacts) * jnp.maximum(-contacts.gap, 0.0) / 2
    if held_friction is None or cone.tangential_mass is None:
        return energy
    tangent = held(contacts, held_friction)[:3] / cone.damper
    return energy + cone.tangential_mass * dot(tangent, tangent) / 2


def _elastic(contacts: Contacts) -> jax.Array:
    """Normal force of a contact at rest."""
    cone = contacts.cone
    return cone.normal_mass * cone.spring * jnp.maximum(-contacts.gap, 0.0)


def quotient(sums: jax.Array) -> jax.Array:
    """Friction that two bodies hold, from the sums of `hold`; none where nothing touches."""
    some = sums[3] > 0
    return jnp.where(some, sums[:3] / jnp.where(some, sums[3], 1.0), 0.0)
