"""Whether a world may start: sound model fields, and no bodies deep inside one another."""

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import assembly
from codesign_jax.engines.structured.coordinates import reset
from codesign_jax.engines.structured.laws.kinematics import Kinematics, straight
from codesign_jax.engines.structured.world_model import (
    WorldModel,
    apply_columns,
    world_constants,
)
from codesign_jax.model import ModelFields, layout
from codesign_jax.scene import Scene
from codesign_jax.types import Status


def invalid_start(scene: Scene, fields: ModelFields) -> jax.Array:
    """Returns INVALID_START for worlds that cannot start, shape (world,) int32, else 0.

    A world is refused if a field is not finite, a moving body has no mass or inertia, a spring or
    damper is negative (walls that leave no chamber, a negative length), or if at the start any two
    bodies that may touch overlap by more than the scene's limit of penetration: soft contacts would
    drive them apart with energy that no actuator gave.
    """
    fields = jax.lax.stop_gradient(fields)  # a verdict has no derivative
    scene = scene.structure
    deep = jnp.maximum(depth(scene, fields), depth_between(scene, fields))
    deep = jnp.maximum(deep, depth_in_palm(scene, fields))
    bad = ~(deep <= fields.constants.limits.penetration)
    # Constants in their ranges have a finite sum, for which XLA writes one loop; as rows of an
    # array they would be one loop each.
    bad |= ~jnp.isfinite(sum(jax.tree.leaves(fields.constants)))
    others = jax.tree.leaves(fields._replace(constants=()))
    bad |= ~jnp.isfinite(_rows(*others)).all(1)
    moving = layout(scene).bodies.ravel()
    bad |= ~(_rows(fields.body_mass[:, moving], fields.body_inertia[:, moving]) > 0).all(1)
    bad |= ~(_rows(fields.jnt_stiffness, fields.dof_damping, fields.dof_armature) >= 0).all(1)
    return jnp.where(bad, int(Status.INVALID_START), 0).astype(jnp.int32)


def _rows(*arrays: jax.Array) -> jax.Array:
    """All numbers of each world, of arrays with leading axis (world,), shape (world, number)."""
    return jnp.concatenate([x.reshape(x.shape[0], -1) for x in arrays], 1)


@partial(jax.jit, static_argnums=0)
def depth(scene: Scene, fields: ModelFields) -> jax.Array:
    """Deepest overlap of a finger, the palm or the object with another of them or the table [m].

    The structured engine's contacts serve every engine: same spheres, shapes and pairs.  Fingers
    are straight; how deep they stand in one another says `depth_between`.
    """
    alone = dataclasses.replace(scene.effects, finger_finger=False)
    hand, kin, position = _straight(scene, fields)
    scene = dataclasses.replace(scene, effects=alone)
    every = assembly.contacts(scene, hand, kin, position)
    found = [(-c.distance).reshape(-1, c.distance.shape[-1]).max(0) for c in every.values()]
    if not found:
        return jnp.zeros(fields.body_mass.shape[0], fields.body_mass.dtype)
    return jnp.stack(found).max(0)


@partial(jax.jit, static_argnums=0)
def depth_between(scene: Scene, fields: ModelFields) -> jax.Array:
    """Deepest overlap of two straight fingers that may touch [m], shape (world,).

    As spheres around the links' middles, as high as the section: the vertices of two hulls in one
    and the same place would not stand inside one another.
    """
    worlds = fields.start.shape[0]
    count = scene.num_fingers
    if not scene.effects.finger_finger or count == 1:
        return jnp.full((worlds,), -jnp.inf, fields.start.dtype)
    hand, kin, _ = _straight(scene, fields)
    up = hand.centre[2]
    middle = kin.origin + apply_columns(kin.link, hand.centre)
    deepest = []
    for a, b in itertools.combinations(range(count), 2):
        away = middle[:, :, None, a] - middle[:, None, :, b]
        reach = up[:, None, a] + up[None, :, b]
        deepest.append((reach - jnp.sqrt((away**2).sum(0))).reshape(-1, worlds).max(0))
    return jnp.stack(deepest).max(0)


@partial(jax.jit, static_argnums=0)
def depth_in_palm(scene: Scene, fields: ModelFields) -> jax.Array:
    """Deepest overlap of a straight finger with the palm's disc [m], shape (world,).

    By the rings or spheres that touch it in a simulation, of those that may.
    """
    if not scene.effects.finger_palm:
        return jnp.full((fields.start.shape[0],), -jnp.inf, fields.start.dtype)
    hand, kin, _ = _straight(scene, fields)
    return assembly.depth_in_palm(scene, hand, kin)


@partial(jax.jit, static_argnums=0)
def _straight(scene: Scene, fields: ModelFields) -> tuple[WorldModel, Kinematics, jax.Array]:
    """Worlds with straight fingers, and the place of the object's centre, (3, 1, world)."""
    state = reset(scene, fields)
    hand = world_constants(scene, fields)
    return hand, straight(hand, state), state.position
