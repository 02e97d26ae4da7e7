"""Contact forces as rollouts record them, in the terms of `types.Forces`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.engines.structured.kernel.rollout import Outputs
from codesign_jax.engines.structured.kernel.rows import Record
from codesign_jax.engines.structured.laws.kinematics import State
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.model.held import PALM_RINGS
from codesign_jax.model.layout import layout, touches_itself
from codesign_jax.scene import Scene
from codesign_jax.types import Forces, Touch

Recorded = dict[str, jax.Array]
"""What a kernel has recorded, by contact list and field, shape (world, time, item, ..., finger)."""


def of_rollout(program: Program, out: Outputs, worlds: int) -> Forces:
    """Forces of a recorded rollout, every array with leading axes (world, time).

    Those of steps that a world did not take are of no use.
    """
    none = jnp.zeros((worlds, out.trace.shape[1], program.fingers), out.trace.dtype)
    return _summed(program, program.by_name(out.recorded, worlds), none)


def forces(
    scene: Scene, hand: WorldModel, state: State, pressure: jax.Array, *, touch: bool = False
) -> Forces:
    """Forces of the step from states by the accelerations that they have.

    Args:
      state: States before the step, with the friction that contacts held then.
      pressure: Pressures of the chambers in the step [Pa], shape (world, finger).
      touch: Whether to tell the object's contacts ring by ring, `Forces.touch`.

    Returns:
      The forces, every array with a leading axis (world,).
    """
    program, out = _of_states(scene, hand, state, pressure, Record(touch=touch))
    every = of_rollout(program, out, state.wrist.shape[-1])
    return jax.tree.map(lambda v: v[:, 0], every)


def contact_energy(scene: Scene, hand: WorldModel, state: State, pressure: jax.Array) -> jax.Array:
    """Energy of the springs of all contacts and of the friction that they hold [J], shape (world,).

    See `holding.stored_energy`; arguments as `forces`.
    """
    program, out = _of_states(scene, hand, state, pressure, Record(energy=True))
    recorded = program.by_name(out.recorded, state.wrist.shape[-1])
    total = jnp.zeros_like(state.wrist[0, 0])
    for contacts in program.lists:
        energy = recorded[f"{contacts.name}.energy"]
        if contacts.of_hand:
            # Both fingers of a pair have the contact; rows of a finger with itself have it once.
            single = np.arange(contacts.slots.rows) < contacts.with_itself
            energy = energy * np.where(single, 1.0, 0.5)[:, None, None]
        total = total + energy.reshape(len(total), -1).sum(1)
    return total


def shapes(scene: Scene, worlds: int, dtype: Any) -> Forces:
    """Shapes of the forces of so many worlds, without `Forces.touch`."""
    program = _program(scene, dtype, worlds, Record())
    blocks = -(-worlds // program.block)

    def summed() -> Forces:
        recorded = jnp.zeros((blocks, 1, program.recorded.rows, program.size), dtype)
        none = jnp.zeros((worlds, 1, program.fingers), dtype)
        every = _summed(program, program.by_name(recorded, worlds), none)
        return jax.tree.map(lambda v: v[:, 0], every)

    return jax.eval_shape(summed)


def _program(scene: Scene, dtype: Any, worlds: int, record: Record) -> Program:
    """A program whose steps keep the accelerations that states have."""
    return Program.here(scene, Limits(0, 0, 0.0), dtype, worlds, team=1, record=record)


def _of_states(
    scene: Scene, hand: WorldModel, state: State, pressure: jax.Array, record: Record
) -> tuple[Program, Outputs]:
    """What one step from states writes, with the accelerations that they have."""
    worlds = state.wrist.shape[-1]
    program = _program(scene, state.wrist.dtype, worlds, record)
    h = scene.discretization.timestep
    # By these commands a rigid wrist has the state's accelerations.
    arm = state.wrist + h * (state.wrist_vel + h * state.acc.wrist)
    arm = arm.reshape(6, -1).T
    ctrl = jnp.concatenate([arm, pressure], 1)
    return program, program.execute(program.inputs(hand, state, ctrl[:, None]))


def _summed(program: Program, recorded: Recorded, none: jax.Array) -> Forces:
    """Sums of what a kernel has recorded, every array with leading axes (world, time).

    Args:
      none: Zeros of each finger of a block, shape (world, time, finger).
    """
    fingers = program.scene.num_fingers
    vector = jnp.zeros((*none.shape[:2], 1, 3, none.shape[2]), none.dtype)

    def net(name: str) -> jax.Array:
        """Force of a list on each lane, shape (world, time, 3, finger)."""
        return recorded.get(f"{name}.force", vector)[:, :, 0]

    def of_fingers(name: str) -> jax.Array:
        return jnp.moveaxis(net(name)[..., :fingers], -1, -2)

    def of_body(name: str) -> jax.Array:
        return net(name).sum(-1)

    fields = [c.name for c in program.lists if not c.of_hand]
    depth = {name: recorded[f"{name}.depth"].max((2, 3)) for name in fields}
    between, on_palm, more = _between_fingers(program, recorded, none)
    grip = recorded.get("finger_object.pressing", vector[:, :, :, 0])[:, :, 0]
    return Forces(
        finger=-of_fingers("finger_object"),
        palm=-of_body("palm_object"),
        table=of_body("object_table"),
        grip=grip[..., :fingers],
        finger_table=of_fingers("finger_table"),
        palm_table=of_body("palm_table"),
        finger_finger=between[..., :fingers, :fingers],
        finger_palm=on_palm[..., :fingers],
        depth=depth | more,
        touch=_touches(program, recorded) if program.record and program.record.touch else None,
    )


def _between_fingers(
    program: Program, recorded: Recorded, none: jax.Array
) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
    """Normal forces between fingers (..., finger, finger) and on the palm (..., finger); depths.

    Args:
      none: As in `_summed`.
    """
    lanes = none.shape[2]
    between = jnp.zeros((*none.shape, lanes), none.dtype)
    pressing = recorded.get("finger_finger.pressing")  # (world, time, row, 2, finger)
    if pressing is None:
        return between, none, {}
    self_contacts = program.self_list
    assert self_contacts is not None
    finger = np.arange(lanes)
    for row in range(self_contacts.slots.rows):
        partner = finger ^ (row + self_contacts.first)
        between = between.at[:, :, finger, partner].set(pressing[:, :, row, 0])
    deepest = recorded["finger_finger.depth"].max(4)
    effects = program.scene.effects
    depth = {}
    if effects.finger_finger and program.scene.num_fingers > 1:
        pairs = deepest[:, :, int(self_contacts.with_itself) :, 0]
        depth["finger_finger"] = pairs.max(2)
    if touches_itself(program.scene):
        depth["finger_itself"] = deepest[:, :, 0, 0]
    if effects.finger_palm:
        depth["finger_palm"] = deepest[:, :, 0, 1]
    return between, pressing[:, :, 0, 1] if self_contacts.with_itself else none, depth


def _touches(program: Program, recorded: Recorded) -> dict[str, Touch]:
    """The object's contacts with the rings of fingers and palm, if the scene has them."""
    scene = program.scene
    touches = {}
    if "finger_object.force" in recorded:
        count = program.links * program.rings_per_link

        def by_ring(values: jax.Array) -> jax.Array:
            """(world, time, ring, 3, lane) as (world, time, finger, ring, 3)."""
            return jnp.moveaxis(values[:, :, :count, :, : scene.num_fingers], 4, 2)

        touches["finger"] = _touch(recorded, "finger_object", by_ring)
    if "palm_object.force" in recorded:
        spheres = layout(scene).palm.size
        rings = PALM_RINGS if scene.effects.surface == "hull" else spheres

        def by_palm_ring(values: jax.Array) -> jax.Array:
            """(world, time, group, 3, lane) as (world, time, ring, 3); dealt to the lanes."""
            dealt = jnp.moveaxis(values, 4, 3)
            return dealt.reshape(*dealt.shape[:2], -1, 3)[:, :, :rings]

        touches["palm"] = _touch(recorded, "palm_object", by_palm_ring)
    return touches


def _touch(recorded: Recorded, name: str, by_ring: Callable) -> Touch:
    """Contacts of the object ring by ring.

    Args:
      by_ring: From values (world, time, item, component, lane) to (world, time, ..., component).
    """
    point, normal, force = (
        by_ring(recorded[f"{name}.ring_{n}"]) for n in ("point", "normal", "force")
    )
    pressing = (normal * force).sum(-1, keepdims=True)
    gap = by_ring(
        jnp.broadcast_to(
            recorded[f"{name}.ring_gap"][:, :, :, None], recorded[f"{name}.ring_point"].shape
        )
    )
    return Touch(
        point=point,
        normal=normal,
        gap=gap[..., 0],
        pressing=pressing[..., 0],
        tangential=pressing * normal - force,
    )
