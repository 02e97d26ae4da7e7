"""A step's problem: bodies, forces and contacts, and how bodies move with the joints."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import once, scan_links, spatial, total
from codesign_jax.engines.structured.laws.contact import Contacts
from codesign_jax.engines.structured.laws.inertia import Bodies, Smooth
from codesign_jax.engines.structured.laws.kinematics import Acc, Kinematics
from codesign_jax.engines.structured.world_model import WorldModel


class Spatial(NamedTuple):
    """Spatial motion: palm (6, 1, world), links (6, link, finger, world), object as palm."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array


class Matrices(NamedTuple):
    """Spatial inertia: palm (6, 6, 1, world), links (6, 6, link, finger, world), object."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array


class Problem(NamedTuple):
    """One step's problem: everything that does not change from iteration to iteration.

    Attributes:
      hand: The hand.
      kin: Kinematics.
      body: Inertia of the bodies.
      matrix: The same as matrices.
      smooth: Smooth forces.
      contacts: Contacts by pair of bodies.
      palm_acc: Prescribed accelerations of the palm's coordinates, shape (6, 1, world); None with a
        compliant wrist, whose accelerations are unknowns.
    """

    hand: WorldModel
    kin: Kinematics
    body: Bodies
    matrix: Matrices
    smooth: Smooth
    contacts: dict[str, Contacts]
    palm_acc: jax.Array | None = None


def palm_motion(wrist: jax.Array, axes: jax.Array) -> jax.Array:
    """The palm's spatial acceleration of the wrist's slides and hinges."""
    moving = spatial(jnp.zeros_like(wrist[:3]), wrist[:3])
    return moving + total([axes[k] * wrist[3 + k] for k in range(3)])


def next_motion(parent: jax.Array, axes: jax.Array, a: jax.Array) -> jax.Array:
    """A link's spatial acceleration from its parent's and its joint's."""
    return parent + total([axes[k] * a[k] for k in range(axes.shape[0])])


def propagate(kin: Kinematics, acc: Acc) -> Spatial:
    """Spatial accelerations J a of all bodies, without velocity terms."""
    palm = once(palm_motion, acc.wrist, kin.wrist_axes)

    def step(parent: jax.Array, link: tuple):
        motion = once(next_motion, parent, *link[0])
        return motion, motion

    first = palm + jnp.zeros_like(kin.vel[:, 0])
    _, links = scan_links(step, first, (kin.axes, acc.finger))
    return Spatial(palm, jnp.moveaxis(links, 0, 1), acc.object)


def relative(name: str, motion: Spatial) -> jax.Array:
    """Relative spatial motion of a pair of bodies, with axes for the contacts' items."""
    obj = motion.object
    if name == "finger_object":
        return jnp.stack([motion.link[i] - obj[i] for i in range(6)])[:, :, None]
    return {
        "finger_table": motion.link[:, :, None],
        "palm_object": motion.palm - obj,
        "palm_table": motion.palm,
        "object_table": obj,
    }[name]


class Forces(NamedTuple):
    """Forces on the bodies, (6, ...), and on the joints, shaped as `Smooth`."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array
    wrist: jax.Array
    finger: jax.Array
