"""Contact forces of a step, from the state before it and the accelerations that it found.

A step's contact forces are those that its accelerations leave to the contacts: the laws of contact
at both.  They are functions of what a rollout records, and no part of the kernel.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import assembly
from codesign_jax.engines.structured.assembly import HandContacts
from codesign_jax.engines.structured.lanes import dot, once
from codesign_jax.engines.structured.laws import holding
from codesign_jax.engines.structured.laws.contact import Contacts, constraint_update
from codesign_jax.engines.structured.laws.kinematics import (
    Acc,
    Kinematics,
    Spatial,
    State,
    kinematics,
    propagate,
    relative,
)
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.model import layout
from codesign_jax.scene import Scene
from codesign_jax.types import Forces, Touch


def forces(
    scene: Scene, hand: WorldModel, state: State, acc: Acc, *, touch: bool = False
) -> Forces:
    """Forces of a step of a batch, every array with a leading axis (world,).

    The states are those before the step, with the friction that contacts held then.

    Args:
      touch: Whether to tell the object's contacts ring by ring, `Forces.touch`.
    """
    kin = kinematics(hand, layout(scene).axes, state)
    velocity = Spatial(kin.palm_vel, kin.vel, kin.object_vel)
    motion = propagate(kin, acc)
    found = assembly.contacts(scene, hand, kin, state.position, velocity)
    fingers = scene.num_fingers
    worlds = state.wrist.shape[-1]
    none = jnp.zeros((3, fingers, worlds), state.wrist.dtype)
    net = {name: none[:, :1] for name in ("palm_object", "palm_table", "object_table")}
    net |= {name: none for name in ("finger_object", "finger_table")}
    grip = none[0]
    depth = {}
    rings = {}
    hold = assembly.grips(scene, state.held, kin)
    for name, contacts in found.items():
        own = hold.get(name)
        acting = once(partial(_acting, name), contacts, motion, velocity, own)
        force, normal = once(partial(_sums, name), contacts, acting)
        net[name] = force
        if name == "finger_object":
            grip = normal
        if touch and name in ("finger_object", "palm_object"):
            rings[name.removesuffix("_object")] = once(_touch, contacts, acting, state.position)
        depth[name] = _deepest(contacts)
    between, on_palm, more = _of_hand(scene, hand, kin, state.held, (motion, velocity))
    depth |= more

    def each(force: jax.Array) -> jax.Array:
        return jnp.moveaxis(force, (2, 1), (0, 1))

    def alone(force: jax.Array) -> jax.Array:
        return force[:, 0].T

    return Forces(
        finger=-each(net["finger_object"]),
        palm=-alone(net["palm_object"]),
        table=alone(net["object_table"]),
        grip=grip.T,
        finger_table=each(net["finger_table"]),
        palm_table=alone(net["palm_table"]),
        finger_finger=jnp.moveaxis(between, -1, 0),
        finger_palm=on_palm.T,
        depth=depth,
        touch=rings if touch else None,
    )


def _of_hand(
    scene: Scene,
    hand: WorldModel,
    kin: Kinematics,
    hold: jax.Array,
    motions: tuple[Spatial, Spatial],
) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
    """Normal forces between fingers, (finger, finger, world), and on the palm; largest depths.

    Args:
      hold: As in `State`.
      motions: Accelerations and velocities of the bodies.
    """
    fingers = scene.num_fingers
    worlds = kin.place.shape[-1]
    dtype = kin.place.dtype
    between = jnp.zeros((fingers, fingers, worlds), dtype)
    on_palm = jnp.zeros((fingers, worlds), dtype)
    depth = {}
    motion, velocity = motions
    for name, these in assembly.hand_contacts(scene, hand, kin, velocity, hold).items():
        normal = once(_pressing, these, motion, velocity)
        depth[name] = _deepest(these.contacts)
        one, two = these.fingers
        if name == "finger_palm":
            on_palm = normal
        else:
            between = between.at[one, two].set(normal).at[two, one].set(normal)
    return between, on_palm, depth


def _acting(
    name: str, contacts: Contacts, motion: Spatial, velocity: Spatial, hold: jax.Array | None
) -> jax.Array:
    """Forces of a set's contacts on the first body, shape (3, ...).

    The first body is the finger, the palm, or the object on the table; hold is the friction that
    they hold, if they do.
    """
    speed = contacts.relative(relative(name, velocity))
    jar = contacts.relative(relative(name, motion)) - contacts.reference(speed)
    jar = jar if hold is None else jar + holding.held(contacts, hold)
    return _force(contacts, jar)


def _sums(name: str, contacts: Contacts, force: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sums over a set's contacts: forces, shape (3, finger or 1, world), and normal forces."""
    normal = dot(contacts.normal, force)
    lanes = force.shape[-2:]
    if not name.startswith("finger"):
        lanes = 1, lanes[1]
    return force.reshape(3, -1, *lanes).sum(1), normal.reshape(-1, *lanes).sum(0)


def _touch(contacts: Contacts, force: jax.Array, position: jax.Array) -> Touch:
    """The contacts ring by ring, with axes (world, finger, ring), or (world, ring) of the palm.

    Args:
      contacts: Of fingers, items (link, ring of the link, finger, world), or of the palm, items
        (ring, world), with the object.
      force: Forces on the hand, shape (3, ...).
      position: The object's centre, from which contact points are counted, shape (3, 1, world).
    """
    pressing = dot(contacts.normal, force)

    def by_ring(values: jax.Array) -> jax.Array:
        values = jnp.broadcast_to(values, pressing.shape)
        if values.ndim == 2:
            return values.T
        return jnp.moveaxis(values.reshape(-1, *values.shape[2:]), 0, 2).swapaxes(0, 1)

    def vectors(values: Any) -> jax.Array:
        return jnp.stack([by_ring(v) for v in values], -1)

    return Touch(
        point=vectors([x + origin for x, origin in zip(contacts.point, position, strict=True)]),
        normal=vectors(contacts.normal),
        gap=by_ring(contacts.gap),
        pressing=by_ring(pressing),
        tangential=vectors(pressing * contacts.normal - force),
    )


def _pressing(met: HandContacts, motion: Spatial, velocity: Spatial) -> jax.Array:
    """Sums of the normal forces of the pairs' contacts, shape (pair, world)."""
    force = _force(met.contacts, met.jar(motion, velocity))
    return dot(met.contacts.normal, force).sum(0)


def _force(contacts: Contacts, jar: jax.Array) -> jax.Array:
    return jnp.where(contacts.active, constraint_update(contacts, jar).force[:3], 0.0)


def _deepest(contacts: Contacts) -> jax.Array:
    """Largest depth of a set's contacts, shape (world,)."""
    depth = jnp.where(contacts.active, jnp.maximum(-contacts.gap, 0.0), 0.0)
    return depth.reshape(-1, depth.shape[-1]).max(0)
