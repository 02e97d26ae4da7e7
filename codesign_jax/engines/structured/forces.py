"""Contact forces of states, as sums over the contacts that a kernel stores."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.kernel.contact_forces import ForceProgram
from codesign_jax.engines.structured.kernel.self_contacts import SelfContactSet
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.laws.kinematics import State
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.model.held import PALM_RINGS
from codesign_jax.model.layout import layout, touches_itself
from codesign_jax.scene import Scene
from codesign_jax.types import Forces, Touch


def forces(scene: Scene, hand: WorldModel, state: State, *, touch: bool = False) -> Forces:
    """Forces of the step from states by the accelerations that they have.

    Args:
      state: States before the step, with the friction that contacts held then.
      touch: Whether to tell the object's contacts ring by ring, `Forces.touch`.

    Returns:
      The forces, every array with a leading axis (world,).
    """
    program = ForceProgram.of(scene, state.wrist.dtype, state.wrist.shape[-1])
    stored = program.stored(hand, state)
    return _summed(program, stored, state.position, touch=touch)


def contact_energy(scene: Scene, hand: WorldModel, state: State) -> jax.Array:
    """Energy of the springs of all contacts and of the friction that they hold [J], shape (world,).

    See `holding.stored_energy`.
    """
    program = ForceProgram.of(scene, state.wrist.dtype, state.wrist.shape[-1])
    stored = program.stored(hand, state)
    total = jnp.zeros_like(state.wrist[0, 0])
    for contacts in program.sets:
        energy = stored[f"{contacts.name}.energy"]
        if isinstance(contacts, SelfContactSet):
            # Both fingers of a pair have the contact; rows of a finger with itself have it once.
            single = np.arange(contacts.rows) < contacts.with_itself
            energy = energy * np.where(single, 1.0, 0.5)[:, None, None, None]
        total = total + energy.reshape(-1, total.shape[0]).sum(0)
    return total


def shapes(scene: Scene, worlds: int, dtype: Any) -> Forces:
    """Shapes of the forces of so many worlds, without `Forces.touch`."""
    program = ForceProgram.of(scene, dtype, worlds)
    position = jax.ShapeDtypeStruct((3, 1, worlds), dtype)

    def summed(stored: dict[str, jax.Array], position: jax.Array) -> Forces:
        return _summed(program, stored, position, touch=False)

    return jax.eval_shape(summed, program.shapes(worlds, dtype), position)


def _summed(
    program: ForceProgram, stored: dict[str, jax.Array], position: jax.Array, *, touch: bool
) -> Forces:
    """Sums of what `ForceProgram.stored` returns.

    Args:
      position: The object's centre, from which contact points are counted, shape (3, 1, world).
    """
    scene = program.scene
    fingers = scene.num_fingers
    lane = program.fingers, position.shape[-1]
    none = jnp.zeros((1, 3, 1, *lane), position.dtype)

    def net(name: str) -> jax.Array:
        """Sums over a set's contacts on each lane, shape (3, lane, world)."""
        return stored.get(f"{name}.force", none).sum((0, 2))

    def of_fingers(force: jax.Array) -> jax.Array:
        return jnp.moveaxis(force[:, :fingers], (2, 1), (0, 1))

    def of_body(force: jax.Array) -> jax.Array:
        return force.sum(1).T

    grip = none[0, 0, 0]
    if "finger_object.force" in stored:
        grip = _pressing(stored, "finger_object").sum((0, 1))
    fields = [s.name for s in program.sets if not isinstance(s, SelfContactSet)]
    depth = {name: _deepest(stored, name) for name in fields}
    between, on_palm, more = _between_fingers(program, stored, none[0, 0, 0])
    return Forces(
        finger=-of_fingers(net("finger_object")),
        palm=-of_body(net("palm_object")),
        table=of_body(net("object_table")),
        grip=grip[:fingers].T,
        finger_table=of_fingers(net("finger_table")),
        palm_table=of_body(net("palm_table")),
        finger_finger=jnp.moveaxis(between[:fingers, :fingers], -1, 0),
        finger_palm=on_palm[:fingers].T,
        depth=depth | more,
        touch=_touches(program, stored, position) if touch else None,
    )


def _between_fingers(
    program: ForceProgram, stored: dict[str, jax.Array], none: jax.Array
) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
    """Normal forces between fingers, shape (lane, lane, world), and on the palm; largest depths.

    Args:
      none: Zeros of the shape (lane, world).
    """
    lanes, worlds = none.shape
    between = jnp.zeros((lanes, lanes, worlds), none.dtype)
    pressing = stored.get("finger_finger.pressing")
    if pressing is None:
        return between, none, {}
    (self_contacts,) = (s for s in program.sets if isinstance(s, SelfContactSet))
    finger = np.arange(lanes)
    for row in range(self_contacts.rows):
        partner = finger ^ (row + self_contacts.first)
        between = between.at[finger, partner].set(pressing[row, 0])
    deepest = stored["finger_finger.depth"].max(2)
    effects = program.scene.effects
    depth = {}
    if effects.finger_finger and program.scene.num_fingers > 1:
        depth["finger_finger"] = deepest[int(self_contacts.with_itself) :, 0].max(0)
    if touches_itself(program.scene):
        depth["finger_itself"] = deepest[0, 0]
    if effects.finger_palm:
        depth["finger_palm"] = deepest[0, 1]
    return between, pressing[0, 1] if self_contacts.with_itself else none, depth


def _touches(
    program: ForceProgram, stored: dict[str, jax.Array], position: jax.Array
) -> dict[str, Touch]:
    """The object's contacts with the rings of fingers and palm, if the scene has them."""
    scene = program.scene
    touches = {}
    if "finger_object.force" in stored:

        def by_ring(values: jax.Array) -> jax.Array:
            # (link, component, ring of the link, finger, world)
            rings = jnp.moveaxis(values[:, :, :, : scene.num_fingers], (4, 3), (0, 1))
            # (world, finger, link, component, ring of the link)
            rings = jnp.swapaxes(rings, 3, 4)
            return rings.reshape(*rings.shape[:2], -1, rings.shape[4])

        touches["finger"] = _touch(stored, "finger_object", position, by_ring)
    if "palm_object.force" in stored:
        spheres = layout(scene).palm.size
        count = PALM_RINGS if scene.effects.surface == "hull" else spheres

        def by_palm_ring(values: jax.Array) -> jax.Array:
            # (group, component, 1, lane, world): the groups' rings are dealt to the lanes.
            rings = jnp.moveaxis(values[:, :, 0], (3, 1), (0, 3))
            return rings.reshape(rings.shape[0], -1, rings.shape[3])[:, :count]

        touches["palm"] = _touch(stored, "palm_object", position, by_palm_ring)
    return touches


def _touch(stored: dict[str, jax.Array], name: str, position: jax.Array, by_ring: Any) -> Touch:
    """Contacts of the object ring by ring.

    Args:
      by_ring: From values (item, component, k, lane, world) to (world, ..., ring, component).
    """
    point = stored[f"{name}.point"] + position[:, None]
    normal = stored[f"{name}.normal"]
    force = stored[f"{name}.force"]
    pressing = _pressing(stored, name)[:, None]
    return Touch(
        point=by_ring(point),
        normal=by_ring(normal),
        gap=by_ring(stored[f"{name}.gap"][:, None])[..., 0],
        pressing=by_ring(pressing)[..., 0],
        tangential=by_ring(pressing * normal - force),
    )


def _pressing(stored: dict[str, jax.Array], name: str) -> jax.Array:
    """Normal forces of a set's contacts, shape (item, k, lane, world)."""
    normal, force = (jnp.moveaxis(stored[f"{name}.{field}"], 1, 0) for field in ("normal", "force"))
    return dot(normal, force)


def _deepest(stored: dict[str, jax.Array], name: str) -> jax.Array:
    """Largest depth of a set's contacts, shape (world,)."""
    touches = stored[f"{name}.share"] > 0
    depth = jnp.where(touches, jnp.maximum(-stored[f"{name}.gap"], 0.0), 0.0)
    return depth.reshape(-1, depth.shape[-1]).max(0)
