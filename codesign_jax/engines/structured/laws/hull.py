"""Contacts of the skinned hull: points that follow a link and its parent in parts.

A vertex with weight w on the link of joint i (frame T_i, joint at p) and 1 - w on the link before
has the images x1 = T_i(v) and x0 = T_{i-1}(v) and lies at x = (1 - w) x0 + w x1.  Velocities of
rigid bodies are affine in the point, so that the blend of the two images' velocities is exactly
  dx = V_{i-1}(x) + w dtheta x (x1 - p),
the parent's velocity at the vertex itself and a share of the joint's own rotation dtheta = S_i dq_i
about the image on the link.  The two images need no contact point in common.  A contact adds its
offset from the vertex to the contact point to both.  With the relative motion m = (angular, linear,
joint's rotation) of nine components a contact is the matrix X'KX, X = [-[r], 1, -[lever]] with
lever = w (x1 + offset - p); the sums over a joint's vertices enter the elimination of that joint.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.laws.contact import Contacts
from codesign_jax.engines.structured.laws.kinematics import Kinematics
from codesign_jax.engines.structured.world_model import WorldModel, apply_columns, turn_columns
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


def places(scene: Scene, hand: WorldModel) -> tuple[jax.Array, jax.Array, jax.Array]:
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


def vertices(scene: Scene, hand: WorldModel, kin: Kinematics) -> Vertices:
    """Places the hull's contact points."""
    local, weight, share = places(scene, hand)
    base = turn_columns(kin.palm, hand.mount)
    before = jnp.concatenate([base[:, :, None], kin.link], 2)[:, :, :, None]
    after = jnp.concatenate([kin.link, kin.link[:, :, -1:]], 2)[:, :, :, None]
    joint = jnp.concatenate([kin.origin, kin.origin[:, -1:]], 1)[:, :, None]
    image = apply_columns(after, local)
    blend = (1.0 - weight) * apply_columns(before, local) + weight * image
    return Vertices(joint + blend, image, weight, share)


def attach(contacts: Contacts, skin: Vertices) -> Contacts:
    """Makes contacts of the vertices, as of spheres without a radius, follow their two links.

    The vertices that touch come first in every row and lane: sums end after the last of them.
    """
    lever = skin.weight * (skin.image + contacts.point - skin.point)
    cone = contacts.cone
    tangent = None if cone.tangent is None else cone.tangent * skin.share
    cone = cone._replace(normal=cone.normal * skin.share, tangent=tangent)
    return contacts._replace(cone=cone, lever=lever)


def across_joints(palm: jax.Array, links: jax.Array) -> jax.Array:
    """Motion of each row's first link and of the joint after it, shape (9, row, finger, world)."""
    first = palm[:, None] + jnp.zeros_like(links[:, :1])
    before = jnp.concatenate([first, links], 1)
    turning = jnp.concatenate([links[:3] - before[:3, :-1], jnp.zeros_like(first[:3])], 1)
    return jnp.concatenate([before, turning])


def across(before: jax.Array, after: jax.Array, obj: jax.Array | None) -> jax.Array:
    """Motion of a row, of nine components, relative to the object or to what is at rest."""
    first = before if obj is None else before - obj
    return jnp.concatenate([first, after[:3] - before[:3]])


def ball_around(joint, before, after, ball):
    """Centre (3, 1, ...) and radius (1, ...) of a ball around a row's vertices.

    The link before the joint holds the straight row's centre somewhere else: the radius grows by
    that distance.
    """
    radius, up = ball[0], ball[1]
    apart = up * (after[2] - before[2])
    centre = joint + up * after[2]
    return centre[:, None], radius + jnp.sqrt(dot(apart, apart))[None]


def placed(vertex, joint, before, after):
    """Place (3, 1, ...), image (3, 1, ...), weight (1, ...) and share (1, 1, ...) of a vertex."""
    local, weight, share = vertex[:3], vertex[3], vertex[4]
    image = apply_columns(after, local)
    point = joint + (1.0 - weight) * apply_columns(before, local) + weight * image
    return point[:, None], image[:, None], weight[None], share[None, None]


def lever(weight, image, where, point):
    """Lever of a vertex's contact: how far it is from the joint that it follows in part."""
    return weight * (image + where - point)
