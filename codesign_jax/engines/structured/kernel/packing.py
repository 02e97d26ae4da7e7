"""A batch's arrays packed into the tables of blocks, and what kernels wrote unpacked."""

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.kernel import objects
from codesign_jax.engines.structured.kernel.memory import lengthen
from codesign_jax.engines.structured.kernel.memory_tables import Tables
from codesign_jax.engines.structured.kernel.rows import Hand
from codesign_jax.engines.structured.laws.kinematics import Acc, State
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.model import held

LENGTH = 6
"""Which of a ring's numbers is its length: with none it is no ring, but can be divided by."""
MASSLESS = (Hand.centre_weight, Hand.mass, Hand.inertia, Hand.gain)
"""Constants that are zero on the lanes of no finger."""


class Packing(Tables):
    """Packs the constants, states and controls of worlds; unpacks states and paths."""

    def pack_hand(self, hand: WorldModel) -> tuple[jax.Array, jax.Array]:
        """The hand's tables; padded fingers have no mass."""
        dtype = hand.mass.dtype
        arrays = hand.by_row() | {"object_id": hand.object_id.astype(dtype)}
        if hand.palm_ring is not None:
            arrays["palm_ring"] = self._dealt(hand.palm_ring)
        if hand.mesh is not None:
            arrays |= objects.rows(hand.mesh, self.fingers, dtype)
        wide = {name: self._for_lanes(name, arrays[name]) for name in self.hand.groups}
        narrow = {name: arrays[name] for name in self.world.groups}
        if self.team > 1:  # Alike in the program of `StructuredEngine.tables` and in a rollout
            wide, narrow = jax.lax.optimization_barrier((wide, narrow))
        return (
            self.hand.pack(self.fingers, self.block, **wide),
            self.world.pack(1, self.block, **narrow),
        )

    def _for_lanes(self, name: str, array: jax.Array) -> jax.Array:
        """Constants of fingers (..., finger, world) with those of padded ones."""
        n = self.num_fingers
        wide = self._widen(array)
        if self.fingers == n:
            return wide
        if name in MASSLESS:
            return wide.at[..., n:, :].set(0.0)
        return wide.at[:, LENGTH, n:].set(0.0) if name == Hand.ring else wide

    def _widen(self, array: jax.Array) -> jax.Array:
        return lengthen(array, array.ndim - 2, self.fingers)

    def _dealt(self, rings: jax.Array) -> jax.Array:
        """The palm's rings (ring, 8, 1, world) in groups, one for each finger's lanes."""
        groups = self.palm_groups
        padded = lengthen(rings, 0, groups * self.fingers)
        padded = padded.at[len(rings) :, LENGTH].set(0.0)
        return jnp.moveaxis(padded[:, :, 0].reshape(groups, self.fingers, 8, -1), 1, 2)

    def pack_state(self, state: State) -> tuple[jax.Array, jax.Array]:
        """The state's tables; padded worlds do not go on."""
        arrays = state._asdict() | {"acc_wrist": state.acc.wrist, "acc_object": state.acc.object}
        finger_state = {
            "finger": state.finger,
            "finger_vel": state.finger_vel,
            "acc": state.acc.finger,
        }
        for name, numbers in held.rows(self.scene).items():
            held_friction = state.held[numbers]
            finger_state[f"held.{name}"] = held_friction.reshape(-1, 3, *held_friction.shape[1:])
        wide = {k: self._widen(v) for k, v in finger_state.items()}
        narrow = {k: arrays[k] for k in self.world_state.groups}
        packed = self.world_state.pack(1, self.block, **narrow)
        ids = np.arange(packed.shape[0] * self.block).reshape(-1, 1, self.block)
        going = np.arange(self.world_state.rows)[:, None] == self.world_state.offset["going"]
        packed = jnp.where(going & (ids >= state.wrist.shape[-1]), 0, packed)
        return self.finger_state.pack(self.fingers, self.block, **wide), packed

    def pack_controls(self, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Commands: arm (block, time, 6, world) and pressure (block, time, lane)."""
        worlds, steps, _ = ctrl.shape
        ctrl = lengthen(ctrl, 0, worlds + -worlds % self.block)
        blocks = jnp.moveaxis(ctrl.reshape(-1, self.block, steps, ctrl.shape[2]), 1, 3)
        arm = blocks[:, :, :6]
        pressure = blocks[:, :, 6:]
        pad = [(0, 0)] * 2 + [(0, self.fingers - self.num_fingers), (0, 0)]
        return arm, jnp.pad(pressure, pad).reshape(*arm.shape[:2], self.columns)

    def path(self, fingers: jax.Array, worlds: jax.Array, states: bool) -> dict[str, jax.Array]:
        """Coordinates of a path's rows (block, time, row, lane or world)."""
        steps = fingers.shape[1]
        size = self.links * self.axes
        names = [("qpos", "finger", ("wrist", "position", "quat"))]
        if states:
            names += [("qvel", "finger_vel", ("wrist_vel", "linear_vel", "angular_vel"))]
            names += [("acc", "acc", ("acc_wrist", "acc_object"))]
        coordinates = {}
        for name, joint, others in names:
            rows = self.finger_state.offset[joint] + self.lay.hinges[:size]
            split = (-1, steps, size, self.fingers, self.block)
            joints = fingers[:, :, rows].reshape(split)[..., : self.num_fingers, :]
            joints = joints.transpose(0, 4, 1, 3, 2)  # (block, world, time, finger, hinge)
            joints = joints.reshape(-1, steps, self.num_fingers * size)
            where = [(self.world_state.offset[o], self.world_state.groups[o][1][0]) for o in others]
            rows = np.concatenate([np.arange(first, first + count) for first, count in where])
            rest = jnp.moveaxis(worlds[:, :, rows], 3, 1).reshape(-1, steps, rows.size)
            coordinates[name] = jnp.concatenate([rest[..., :6], joints, rest[..., 6:]], -1)
        if states and self.held:
            count = 3 * sum(self.held.values())
            first = self.finger_state.offset[f"held.{next(iter(self.held))}"]
            hold = fingers[:, :, first : first + count]
            hold = hold.reshape(-1, steps, count, self.fingers, self.block)
            coordinates["held"] = jnp.moveaxis(hold, 4, 1).reshape(-1, steps, count * self.fingers)
        return coordinates

    def rows_of(self, qpos: jax.Array, qvel: jax.Array | None = None) -> tuple:
        """Rows (world, time, row, finger or 1) of coordinates, or of their cotangents; see `path`.

        Of positions alone if there are no velocities.
        """
        joints = []
        others = []
        end = 6 + self.lay.dofs.size
        for x in (qpos,) if qvel is None else (qpos, qvel):
            finger = x[:, :, self.lay.dofs].reshape(*x.shape[:2], self.num_fingers, -1)
            joints.append(jnp.swapaxes(finger, 2, 3))
            others.append(jnp.concatenate([x[:, :, :6], x[:, :, end:]], 2))
        fill = [(0, 0)] * 3 + [(0, self.fingers - self.num_fingers)]
        return jnp.pad(jnp.concatenate(joints, 2), fill), jnp.concatenate(others, 2)[..., None]

    def rows_of_end(self, last: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`rows_of` of cotangents of `Trace.last`, or of its beginning without what is held.

        Only positions, velocities and what is held have some.
        """
        nq = 13 + self.lay.dofs.size
        nv = 12 + self.lay.dofs.size
        fingers, worlds = self.rows_of(last[:, None, :nq], last[:, None, nq : nq + nv])
        hold = last[:, nq + 2 * nv + 3 :].reshape(len(last), 1, -1, self.fingers)
        cotangents = jnp.concatenate([fingers, hold], 2), worlds
        rows = self.path_rows(states=True)
        return tuple(
            jnp.pad(x, [(0, 0), (0, 0), (0, n - x.shape[2]), (0, 0)])
            for x, n in zip(cotangents, rows, strict=True)
        )  # type: ignore[return-value]

    def by_name(self, recorded: jax.Array | None, worlds: int) -> dict[str, jax.Array]:
        """What a rollout has recorded, by name, shape (world, time, item, ..., finger).

        Args:
          recorded: Rows of blocks, shape (block, time, row, lane); None where there are none.
        """
        if recorded is None:
            return {}
        rows = self.by_world(recorded, worlds)
        arrays = {}
        for name, (count, shape) in self.recorded.groups.items():
            first = self.recorded.offset[name]
            part = rows[:, :, first : first + count * self.recorded.stride[name]]
            arrays[name] = part.reshape(*rows.shape[:2], count, *shape, self.fingers)
        return arrays

    def by_world(self, rows: jax.Array, worlds: int) -> jax.Array:
        """Rows (block, time, row, lane or world) as (world, time, row, finger or 1)."""
        split = rows.reshape(*rows.shape[:3], -1, self.block)
        return jnp.moveaxis(split, 4, 1).reshape(-1, *split.shape[1:4])[:worlds]

    def by_block(self, rows: jax.Array) -> jax.Array:
        """Inverse of `by_world`; zeros fill the last block."""
        missing = -rows.shape[0] % self.block
        rows = jnp.pad(rows, [(0, missing)] + [(0, 0)] * 3)
        split = jnp.moveaxis(rows.reshape(-1, self.block, *rows.shape[1:]), 1, 4)
        return split.reshape(*split.shape[:3], -1)

    def unpack_state(self, finger_state: jax.Array, world_state: jax.Array, worlds: int) -> State:
        """Inverse of `pack_state`."""
        wide = self.finger_state.unpack(finger_state, self.fingers, self.fingers, worlds)
        lanes = self.fingers, worlds
        hold = [wide.pop(f"held.{name}").reshape(-1, *lanes) for name in self.held]
        hold = hold or [jnp.zeros((0, *lanes), finger_state.dtype)]
        wide = {name: v[..., : self.num_fingers, :] for name, v in wide.items()}
        narrow = self.world_state.unpack(world_state, 1, 1, worlds)
        acc = Acc(narrow.pop("acc_wrist"), wide.pop("acc"), narrow.pop("acc_object"))
        return State(**wide, **narrow, acc=acc, held=jnp.concatenate(hold))
