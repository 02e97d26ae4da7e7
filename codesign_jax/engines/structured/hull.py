"""Contacts of the skinned hull: points that follow a link and its parent in parts.

A vertex with weight w on the link of joint i (frame T_i, joint at p) and 1 - w on the link before
has the images x1 = T_i(v) and x0 = T_{i-1}(v) and lies at x = (1 - w) x0 + w x1.  Velocities of
rigid bodies are affine in the point, so that the blend of the two images' velocities is exactly
  dx = V_{i-1}(x) + w dtheta x (x1 - p),
the parent's velocity at the vertex itself and a share of the joint's own rotation dtheta = S_i dq_i
about the image on the link: no common point has to be assumed.  A contact adds its offset from the
vertex to the contact point to both.  With the relative motion m = (angular, linear, joint's
rotation) of nine components a contact is the matrix X'KX, X = [-[r], 1, -[lever]] with lever =
w (x1 + offset - p); the sums over a joint's vertices enter the elimination of that joint.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.constants import WorldConstants, apply_columns, turn_columns
from codesign_jax.engines.structured.contact import (
    Contacts,
    constraint_update,
    contact_inertia,
)
from codesign_jax.engines.structured.elimination import JointTerms
from codesign_jax.engines.structured.kinematics import Kinematics
from codesign_jax.engines.structured.lanes import Stages, contract
from codesign_jax.model import hull
from codesign_jax.scene import Scene


class Vertices(NamedTuple):
    """Contact points of the hull; rows are the joints and the tip, see `model.hull.Slots`.

    Attributes:
      point: From the object's centre along the world's axes, shape (3, row, k, finger, world).
      image: Images on the rows' links, from their joints, same shape.
      weight: Weights of those links, shape (row, k, 1, 1).
      share: Contact stiffness relative to the scene's, shape (row, k, finger, world).
    """

    point: jax.Array
    image: jax.Array
    weight: jax.Array
    share: jax.Array


def places(scene: Scene, hand: WorldConstants) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The vertices on their links, which do not change with the hand's pose.

    Args:
      scene: The scene.
      hand: The hand.

    Returns:
      Places in the frame of the row's link, or, with the same numbers, of the link before it if
      that is shifted to the row's joint [m], shape (3, row, k, finger, world); and `Vertices`'
      weight and share.
    """
    s, dtype = hull.slots(scene), hand.offset.dtype
    along, across, up, weight, *area = (
        jnp.asarray(v[..., None, None], dtype) for v in (s.along, s.across, s.up, s.weight, *s.area)
    )
    assert hand.section is not None
    height, _, segment, width = hand.section
    local = jnp.stack([along * segment, across * width + 0.0 * along, up * height])
    surface = area[0] * segment * width + area[1] * segment * height + area[2] * width * height
    return local, weight, surface / width**2


def vertices(scene: Scene, hand: WorldConstants, kin: Kinematics) -> Vertices:
    """Places the hull's contact points."""
    local, weight, share = places(scene, hand)
    base = turn_columns(kin.palm, hand.mount)
    before = jnp.concatenate([base[:, :, None], kin.link], 2)[:, :, :, None]
    after = jnp.concatenate([kin.link, kin.link[:, :, -1:]], 2)[:, :, :, None]
    joint = jnp.concatenate([kin.origin, kin.origin[:, -1:]], 1)[:, :, None]
    image = apply_columns(after, local)
    blend = (1.0 - weight) * apply_columns(before, local) + weight * image
    return Vertices(joint + blend, image, weight, share)


def attach(run: Stages, contacts: Contacts, skin: Vertices) -> Contacts:
    """Makes contacts of the vertices, as of spheres without a radius, follow their two links.

    The vertices that touch come first in every row and lane: sums end after the last of them.
    """

    def ordered(c: Contacts, skin: Vertices) -> tuple[jax.Array, ...]:
        lever = skin.weight * (skin.image + c.point - skin.point)
        order = jnp.argsort(~c.active, axis=1, stable=True)
        each = (c.point, c.normal, c.distance, lever, skin.share)
        return tuple(
            jnp.take_along_axis(x, order if x.ndim == order.ndim else order[None], axis=x.ndim - 3)
            for x in each
        )

    point, normal, distance, lever, share = run(ordered, contacts, skin)
    cone = contacts.cone
    tangent = None if cone.tangent is None else cone.tangent * share
    cone = cone._replace(normal=cone.normal * share, tangent=tangent)
    return Contacts(point, normal, distance, cone, lever)


def across_joints(palm: jax.Array, links: jax.Array) -> jax.Array:
    """Motion of each row's first link and of the joint after it, shape (9, row, finger, world)."""
    first = palm[:, None] + jnp.zeros_like(links[:, :1])
    before = jnp.concatenate([first, links], 1)
    turning = jnp.concatenate([links[:3] - before[:3, :-1], jnp.zeros_like(first[:3])], 1)
    return jnp.concatenate([before, turning])


def inertia(run: Stages, c: Contacts, jar: jax.Array) -> jax.Array:
    """Contact inertia of the rows at jar, shape (9, 9, row, finger, world)."""

    def evaluate(point, normal, distance, lever, stiff, tangent, jar) -> jax.Array:
        cone = c.cone._replace(normal=stiff, tangent=tangent)
        vertex = Contacts(point, normal, distance, cone, lever)
        matrix = contact_inertia(vertex, constraint_update(vertex, jar).hessian)
        return jnp.stack([matrix[i, j] for i, j in _UPPER])

    each = (c.point, c.normal, c.distance, c.lever, c.cone.normal, c.cone.tangent, jar)
    upper = _sum_vertices(run, c, evaluate, each, len(_UPPER))
    place = {ij: n for n, ij in enumerate(_UPPER)}
    rows = [jnp.stack([upper[place[min(i, j), max(i, j)]] for j in range(9)]) for i in range(9)]
    return jnp.stack(rows)


def _sum_vertices(
    run: Stages, c: Contacts, function: Callable, each: tuple, size: int
) -> jax.Array:
    """Sums over the vertices of each row that touch in any lane, one vertex after the other.

    All vertices' matrices would not fit a CPU's cache, and most vertices, such as those on a
    finger's back, touch nothing; those that do come first, see `attach`.

    Args:
      run: Runs the stages.
      c: The contacts.
      function: From the arrays of one vertex of each row, shape (..., row, finger, world), to
        an array of shape (size, row, finger, world).
      each: Arrays of shape (..., row, k, finger, world), or None.
      size: The size.
    """
    rows, k, *lanes = c.distance.shape
    arrays, structure = jax.tree.flatten(each)
    # Rows and planes to the compiler, as in `scan_links`.
    planes = [x.reshape(-1, k, lanes[0] * lanes[1]) for x in arrays]

    def add(i: jax.Array, sums: jax.Array) -> jax.Array:
        vertex = [
            jax.lax.dynamic_index_in_dim(p, i, 1, keepdims=False).reshape(*x.shape[:-3], *lanes)
            for p, x in zip(planes, arrays, strict=True)
        ]
        return sums + run(function, *jax.tree.unflatten(structure, vertex))

    zero = jnp.zeros((size, rows, *lanes), c.distance.dtype)
    return jax.lax.fori_loop(0, c.active.sum(1).max(), add, zero)


_UPPER = [(i, j) for i in range(9) for j in range(i, 9)]


def joint_terms(axes: jax.Array, inertias: dict[str, jax.Array]) -> JointTerms:
    """What the contacts of the rows add to the elimination of their joints, without forces.

    Args:
      axes: Motion subspaces, shape (link, axis, 6, finger, world).
      inertias: Contact inertia, (9, 9, row, finger, world), by pair of bodies.
    """
    turn = jnp.moveaxis(axes[:, :, :3], 0, 2)  # (axis, 3, link, finger, world)
    result = None
    for name, inertia in inertias.items():
        mixed = contract(turn[:, :, None], inertia[None, 6:, :, :-1], 1)  # (axis, 9, link, ...)
        parent = mixed[:, :6]
        own = contract(turn[:, None], mixed[None, :, 6:], 2)
        obj = parent if name.endswith("object") else jnp.zeros_like(parent)
        new = JointTerms(own, parent, obj, jnp.zeros_like(own[0]))
        result = new if result is None else jax.tree.map(jnp.add, result, new)
    assert result is not None
    return result
