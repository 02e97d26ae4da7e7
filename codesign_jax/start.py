"""Whether a world may start: sound model fields, and no bodies deep inside one another."""

from functools import partial

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.constants import world_constants
from codesign_jax.engines.structured.kinematics import straight
from codesign_jax.engines.structured.lanes import Stages
from codesign_jax.model import ModelFields, layout
from codesign_jax.scene import Scene
from codesign_jax.types import Status


def invalid_start(scene: Scene, fields: ModelFields) -> jax.Array:
    """Returns INVALID_START for worlds that cannot start, shape (world,) int32, else 0.

    A world is refused if a field is not finite, a moving body has no mass or inertia, a spring or
    damper is negative (walls that leave no chamber, a negative length), or if at the start any two
    bodies that may touch overlap by more than the scene's limit of penetration: soft contacts would
    drive them apart with energy that no actuator gave.

    Args:
      scene: The scene.
      fields: Model fields with leading axis (world,).
    """
    fields = jax.lax.stop_gradient(fields)  # a verdict has no derivative
    bad = ~(depth(scene, fields) <= fields.constants.limits.penetration)
    for value in jax.tree.leaves(fields):
        bad |= ~jnp.isfinite(value.reshape(value.shape[0], -1)).all(1)
    moving = layout(scene).bodies.ravel()
    for value in (fields.body_mass[:, moving], fields.body_inertia[:, moving]):
        bad |= ~(value.reshape(value.shape[0], -1) > 0).all(1)
    for value in (fields.jnt_stiffness, fields.dof_damping, fields.dof_armature):
        bad |= ~(value >= 0).all(1)
    return jnp.where(bad, int(Status.INVALID_START), 0).astype(jnp.int32)


@partial(jax.jit, static_argnums=0)
def depth(scene: Scene, fields: ModelFields) -> jax.Array:
    """Deepest overlap of any contact at the start [m], shape (world,).

    The structured engine's contacts serve every engine: same spheres, shapes and pairs.  Fingers
    are straight.
    """
    engine = StructuredEngine(scene, kernel=False)
    state, hand = engine.reset(fields), world_constants(scene, fields)
    contacts = engine.contacts(Stages(None), hand, straight(hand, state), state.wrist[2])
    found = [(-c.distance).reshape(-1, c.distance.shape[-1]).max(0) for c in contacts.values()]
    return jnp.stack(found).max(0)
