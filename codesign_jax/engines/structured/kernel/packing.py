"""Arrays of a batch to the tables of its blocks, and back."""

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.kernel import objects
from codesign_jax.engines.structured.kernel.memory import lengthened
from codesign_jax.engines.structured.kernel.pair_search import TIP, ring_places
from codesign_jax.engines.structured.kernel.tables import PALM, Tables
from codesign_jax.engines.structured.laws.air import volumes
from codesign_jax.engines.structured.laws.kinematics import Acc, State
from codesign_jax.engines.structured.world_model import WorldModel, joint_sections, sections
from codesign_jax.model.layout import palm_touches
from codesign_jax.scene import Scene

LENGTH = 6
"""Which of a ring's numbers is its length: with none it is no ring, but can be divided by."""


class Packing(Tables):
    """Packs the constants, states and controls of worlds; unpacks states and recorded rows."""

    def pack_hand(self, hand: WorldModel) -> tuple[jax.Array, jax.Array]:
        """The hand's tables; padded fingers have no mass."""
        worlds, n = hand.object_id.shape[1], self.num_fingers
        dtype, lane = hand.mass.dtype, (n, worlds)
        links_first = ("centre", "inertia")
        arrays = {
            k: jnp.moveaxis(v, 1, 0) if k in links_first and v.size else v
            for k, v in hand._asdict().items()
        }
        arrays |= hand.bounds._asdict()
        for name, cone in hand.cones._asdict().items():
            if cone is None:
                continue
            arrays[f"cone.{name}"] = jnp.stack([v for v in cone if v is not None])
        # Weights of the segments in the hand's centre: half segments at the palm and at the tip.
        share = np.ones(self.links + 1, dtype)
        share[[0, -1]] = 0.5
        arrays["share"] = jnp.broadcast_to(share[:, None, None], (self.links + 1, *lane))
        if palm_touches(self.scene):
            arrays["palm_ring"] = self._palm_slots(hand)
        if "section" in self.hand.groups:
            arrays["section"] = joint_sections(hand, self.links)
        if hand.air is not None:
            arrays["volume"] = volumes(hand, self.links)
        if self.k:
            arrays["ring"] = ring_numbers(self.scene, hand, self.k)
        if hand.mesh is not None:
            arrays |= objects.rows(hand.mesh, self.fingers, dtype)
        extra = self.fingers - n
        if extra:
            for name in ("share", "mass", "inertia", "gain"):
                pad = [(0, 0)] * (arrays[name].ndim - 2) + [(0, extra), (0, 0)]
                arrays[name] = jnp.pad(arrays[name], pad)
            if self.k:
                ring = jnp.pad(arrays["ring"], [(0, 0), (0, 0), (0, extra), (0, 0)], "edge")
                arrays["ring"] = ring.at[:, LENGTH, n:].set(0.0)
        wide = {k: self._widen(arrays[k]) for k in self.hand.groups}
        arrays["object_id"] = hand.object_id.astype(dtype)
        narrow = {k: arrays[k] for k in self.world.groups}
        if self.team > 1:  # XLA rounds alike however many worlds it lays out
            wide, narrow = jax.lax.optimization_barrier((wide, narrow))
        return self.hand.pack(self.fingers, self.block, **wide), self.world.pack(
            1, self.block, **narrow
        )

    def _widen(self, array: jax.Array) -> jax.Array:
        """Fingers up to a power of two."""
        return lengthened(array, array.ndim - 2, self.fingers)

    def _palm_slots(self, hand: WorldModel) -> jax.Array:
        """The palm's rings or spheres, shared out among the lanes."""
        numbers, f = palm_numbers(self.scene, hand), self.fingers
        extra = self.palm_groups * f - len(numbers)
        padded = jnp.pad(numbers, [(0, extra), (0, 0), (0, 0)], "edge")
        padded = padded.at[len(numbers) :, LENGTH].set(0.0)
        return jnp.moveaxis(padded.reshape(self.palm_groups, f, 8, -1), 1, 2)

    def pack_state(self, state: State) -> tuple[jax.Array, jax.Array]:
        """The state's tables; padded worlds do not go on."""
        arrays = state._asdict() | {"acc_wrist": state.acc.wrist, "acc_object": state.acc.object}
        finger_state = {
            "finger": state.finger,
            "finger_vel": state.finger_vel,
            "acc": state.acc.finger,
        }
        if self.held:
            finger_state["grip"] = state.grip
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
        ctrl = lengthened(ctrl, 0, worlds + -worlds % self.block)
        blocks = jnp.moveaxis(ctrl.reshape(-1, self.block, steps, ctrl.shape[2]), 1, 3)
        arm, pressure = blocks[:, :, :6], blocks[:, :, 6:]
        pad = [(0, 0)] * 2 + [(0, self.fingers - self.num_fingers), (0, 0)]
        return arm, jnp.pad(pressure, pad).reshape(*arm.shape[:2], self.columns)

    def path_rows(self, states: bool) -> tuple[int, int]:
        """Numbers of rows of the state's tables that are recorded: all, or the positions."""
        if states:
            return self.finger_state.rows, self.world_state.rows
        return self.finger_state.offset["finger_vel"], self.world_state.offset["wrist_vel"]

    def path(self, fingers: jax.Array, worlds: jax.Array, states: bool) -> dict[str, jax.Array]:
        """Coordinates of recorded rows (block, time, row, lane or world)."""
        steps, size = fingers.shape[1], self.links * self.axes
        names = [("qpos", "finger", ("wrist", "position", "quat"))]
        if states:
            names += [("qvel", "finger_vel", ("wrist_vel", "linear_vel", "angular_vel"))]
            names += [("acc", "acc", ("acc_wrist", "acc_object"))]
        found = {}
        for name, joint, others in names:
            rows = self.finger_state.offset[joint] + np.arange(size)
            split = (-1, steps, size, self.fingers, self.block)
            joints = fingers[:, :, rows].reshape(split)[..., : self.num_fingers, :]
            joints = joints.transpose(0, 4, 1, 3, 2)  # (block, world, time, finger, link and axis)
            joints = joints.reshape(-1, steps, self.num_fingers * size)
            where = [(self.world_state.offset[o], self.world_state.groups[o][1][0]) for o in others]
            rows = np.concatenate([np.arange(first, first + count) for first, count in where])
            rest = jnp.moveaxis(worlds[:, :, rows], 3, 1).reshape(-1, steps, rows.size)
            found[name] = jnp.concatenate([rest[..., :6], joints, rest[..., 6:]], -1)
        if states and self.held:
            count = 3 * self.held
            rows = self.finger_state.offset["grip"] + np.arange(count)
            held = fingers[:, :, rows].reshape(-1, steps, count, self.fingers, self.block)
            held = jnp.moveaxis(held[..., : self.num_fingers, :], 4, 1)
            found["held"] = held.reshape(-1, steps, count * self.num_fingers)
        return found

    def rows_of(self, qpos: jax.Array, qvel: jax.Array | None = None) -> tuple:
        """Rows (world, time, row, finger or 1) of coordinates, or of their cotangents; see `path`.

        Args:
          qpos: Generalized positions, shape (world, time, nq).
          qvel: Generalized velocities, shape (world, time, nv); without them positions' rows only.
        """
        joints, others, end = [], [], 6 + self.lay.dofs.size
        for x in (qpos,) if qvel is None else (qpos, qvel):
            finger = x[:, :, 6:end].reshape(*x.shape[:2], self.num_fingers, -1)
            joints.append(jnp.swapaxes(finger, 2, 3))
            others.append(jnp.concatenate([x[:, :, :6], x[:, :, end:]], 2))
        fill = [(0, 0)] * 3 + [(0, self.fingers - self.num_fingers)]
        return jnp.pad(jnp.concatenate(joints, 2), fill), jnp.concatenate(others, 2)[..., None]

    def rows_of_end(self, last: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`rows_of` of cotangents of `Trace.last`, or of its beginning without what is held.

        Only positions, velocities and what is held have some.
        """
        nq, nv = 13 + self.lay.dofs.size, 12 + self.lay.dofs.size
        fingers, worlds = self.rows_of(last[:, None, :nq], last[:, None, nq : nq + nv])
        held = last[:, nq + 2 * nv + 3 :].reshape(len(last), 1, -1, self.num_fingers)
        fill = [(0, 0)] * 3 + [(0, self.fingers - self.num_fingers)]
        found = jnp.concatenate([fingers, jnp.pad(held, fill)], 2), worlds
        rows = self.path_rows(states=True)
        return tuple(
            jnp.pad(x, [(0, 0), (0, 0), (0, n - x.shape[2]), (0, 0)])
            for x, n in zip(found, rows, strict=True)
        )  # type: ignore[return-value]

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
        wide = self.finger_state.unpack(finger_state, self.fingers, self.num_fingers, worlds)
        narrow = self.world_state.unpack(world_state, 1, 1, worlds)
        acc = Acc(narrow.pop("acc_wrist"), wide.pop("acc"), narrow.pop("acc_object"))
        return State(**wide, **narrow, acc=acc)


def ring_numbers(scene: Scene, hand: WorldModel, k: int) -> jax.Array:
    """Numbers of the fingers' rings or spheres, see `rings.Ring`, (link * k, 8, finger, world)."""
    if scene.effects.surface == "spheres":
        one = jnp.ones_like(hand.radius)
        rows = [*hand.sphere, *[hand.radius] * 3, one, 0.0 * one]
        return jnp.stack(rows, 2).reshape(-1, 8, *one.shape[2:])
    assert hand.section is not None
    segment, own = hand.section[2:]
    links = scene.discretization.links
    along = ring_places(links, k)
    places = (along + np.arange(links)[:, None] + 0.5) / links
    height, _, width = sections(hand, places.ravel())
    length = np.full((links, k), 1.0 / k)
    length[-1] *= 0.5
    half = 0.6 * length
    half[-1, -1] = TIP
    along, length, half = (v.reshape(-1, 1, 1) for v in (along, length, half))
    tip = (np.arange(links * k) == links * k - 1).reshape(-1, 1, 1)
    rows = [along * segment, 0.0, 0.5 * height, half * segment, 0.5 * width, 0.5 * height]
    # The skin is as stiff everywhere: a narrower section stands for less of it.
    widths = length * segment / width if hand.tip is None else length * segment * width / own**2
    rows += [widths, tip.astype(width.dtype)]
    shape = (links * k, *segment.shape)
    return jnp.stack([jnp.broadcast_to(jnp.asarray(v, width.dtype), shape) for v in rows], 1)


def palm_numbers(scene: Scene, hand: WorldModel) -> jax.Array:
    """Numbers of the rings or spheres of the palm, as `ring_numbers`, (item, 8, world)."""
    if scene.effects.surface == "spheres":
        one = jnp.ones_like(hand.palm_radius)
        rows = [*hand.palm_point, *[hand.palm_radius] * 3, one, 0.0 * one]
        return jnp.stack(rows, 1)
    assert hand.palm_disc is not None and hand.section is not None
    (radius, thick), width = hand.palm_disc[:, 0], hand.section[3, 0]
    half = 0.5 * radius
    rows = [
        [x * half, y * half, thick, half, half, thick, 4.0 * half**2 / width**2, 0.0 * half]
        for x, y in PALM
    ]
    return jnp.stack([jnp.stack(row) for row in rows])
