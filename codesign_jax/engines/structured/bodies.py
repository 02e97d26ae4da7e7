"""Where the bodies are in a state, and how they move: what every engine shows policies."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from codesign_jax.engines.base import Bodies, Pose
from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.laws.kinematics import kinematics
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import ModelFields
from codesign_jax.model.layout import layout
from codesign_jax.scene import Scene


def observer(scene: Scene, fields: ModelFields) -> Callable[[jax.Array], Bodies]:
    """A function of states, see `Engine.observe`."""
    hand = world_constants(scene, fields)

    def observe(state: jax.Array) -> Bodies:
        lanes = coordinates.reset(scene, fields._replace(start=state))
        motion = kinematics(hand, layout(scene).axes, lanes)

        def pose(place: jax.Array, columns: jax.Array) -> Pose:
            """From lanes (3, ...) about the object and (column, 3, ...) with the worlds last."""
            place = place + lanes.position.reshape(3, *[1] * (place.ndim - 2), -1)
            return Pose(
                jnp.moveaxis(place, (-1, 0), (0, -1)),
                jnp.moveaxis(columns, (-1, 1, 0), (0, -2, -1)),
            )

        none = jnp.zeros_like(motion.place)
        velocity = motion.object_vel[:, 0].T
        joint, rate = (jnp.moveaxis(v, (3, 2), (0, 1)) for v in (lanes.finger, lanes.finger_vel))
        return Bodies(
            joint=joint,
            joint_velocity=rate,
            palm=pose(motion.place[:, 0], motion.palm[:, :, 0]),
            link=pose(jnp.swapaxes(motion.origin, 1, 2), jnp.swapaxes(motion.link, 2, 3)),
            object=pose(none[:, 0], motion.object[:, :, 0]),
            object_velocity=jnp.concatenate([velocity[:, 3:], velocity[:, :3]], 1),
        )

    return observe
