"""The tables of a block in memory: their rows for a scene, and a batch's arrays packed into them.

Tables of constants, state and scratch are in global memory; `onchip` is in a GPU's shared memory,
see `rows.Chip`.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.kernel import objects, rows, shared_memory
from codesign_jax.engines.structured.kernel import record as recording
from codesign_jax.engines.structured.kernel.contact_sets import ContactSet
from codesign_jax.engines.structured.kernel.memory import MemoryLayout, lengthen
from codesign_jax.engines.structured.kernel.rows import (
    Again,
    Air,
    Chip,
    FingerState,
    Group,
    Hand,
    Record,
    Scratch,
    Search,
    Shared,
    World,
    WorldOptions,
    WorldState,
)
from codesign_jax.engines.structured.kernel.self_contacts import SelfContactSet, pair_slots
from codesign_jax.engines.structured.kernel.step_memory import KernelLayout
from codesign_jax.engines.structured.kernel.team_contacts import (
    TeamSdfContactSet,
    TeamSelfContactSet,
)
from codesign_jax.engines.structured.laws import shapes, surroundings
from codesign_jax.engines.structured.laws.kinematics import Acc, State
from codesign_jax.engines.structured.laws.step_numbers import step_numbers
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.judge import verdict
from codesign_jax.model import held, layout
from codesign_jax.model.held import palm_groups, rings_of_link
from codesign_jax.model.layout import touches_itself
from codesign_jax.scene import Scene
from codesign_jax.scene.section_numbers import Numbers

GATHERING = ("gpu",)
"""Backends whose lanes read rows of their own as fast as a common one."""


class Tables(KernelLayout):
    """Contacts and tables of a scene's kernel for one size of block."""

    remembers: tuple[type[rows.Rows], ...] = ()
    """What slots of self-contacts have further."""

    def __init__(
        self,
        scene: Scene,
        *,
        backend: str,
        width: int,
        team: int | None = None,
        record: Record | None = None,
    ):
        self.backend = backend
        self.scene = scene
        self.lay = layout(scene)
        self.hull = scene.effects.surface == "hull"
        n, self.links, self.axes = self.lay.dofs.shape
        self.fingers = held.lanes(scene)
        self.team = team or shared_memory.lanes_of_a_finger(scene, backend, self.fingers)
        # A slot of a team is one contact, a ring's are as many as the fields.
        if scene.fixture or scene.effects.air_mass:
            self.team = 1
        # On a GPU a team's block is one world: nothing depends on what others do.
        single_world = self.team > 1 and backend == "gpu"
        self.num_fingers = n
        self.block = 1 if single_world else max(1, width // (self.fingers * self.team))
        self.columns = self.fingers * self.block
        self.size = self.columns * self.team
        self.rings_per_link = rings_of_link(scene)
        self.palm_groups = palm_groups(scene)
        self.meshes = bool(shapes.mesh_indices(scene))
        self.support_points = objects.support_points(scene)
        self.record = record
        self.self_set = self._self_set()
        self.sets = self._sets()
        for contacts in self.sets:
            contacts.stores_all = bool(record and record.touch and contacts.on_object)
        self.held = held.held(scene)
        self._tables()

    def _self_set(self) -> SelfContactSet | None:
        e = self.scene.effects
        between = e.finger_finger and self.num_fingers > 1
        if not (between or e.finger_palm or touches_itself(self.scene)):
            return None
        block = (self.fingers, self.block)
        slots = pair_slots(self.scene)
        options = {"gathers": self.gathers, "remembers": self.remembers}
        if self.team == 1:
            return SelfContactSet(self.scene, block, self.links, slots, **options)
        block = (*block, self.team)
        return TeamSelfContactSet(self.scene, block, self.links, slots, **options)

    def _sets(self) -> list[ContactSet]:
        e = self.scene.effects
        k = self.rings_per_link
        n = len(surroundings.fields(self.scene))
        make = partial(ContactSet, self.scene, size=self.size)
        on = {"finger_object": k * e.finger_object, "finger_table": n * k * e.finger_table}
        fields = make if self.team == 1 else partial(TeamSdfContactSet, self.scene, self)
        sets = [fields(name, self.links, on[name]) for name in on if on[name]]
        sets += [self.self_set] if self.self_set else []
        on = {"palm_object": int(e.palm_object), "palm_table": n * e.palm_table}
        sets += [make(name, self.palm_groups, on[name]) for name in on if on[name]]
        groups = -(-surroundings.slots(self.scene) // self.fingers)
        on_table = [make("object_table", groups, 1)] if e.object_table and groups else []
        return [*sets, *on_table]

    @property
    def gathers(self) -> bool:
        """Whether lanes read rows of their own."""
        return self.backend in GATHERING or self.team > 1

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of the axes of `rows`."""
        points = max(1, self.support_points // self.fingers)
        return {
            rows.ONE: 1,
            rows.LINK: self.links,
            rows.BODY: self.links + 1,
            rows.END: self.links + 2,
            rows.SECTION: self.links if self.tapered else 1,
            rows.RING: self.links * self.rings_per_link,
            rows.PALM_GROUP: self.palm_groups,
            rows.SUPPORT: points,
            rows.PAIRING: self.held.get("finger_finger", 0),
            rows.AXES: self.axes,
            rows.LAW: len(Numbers._fields) + 1,
            rows.FRICTIONS: 2 * len(surroundings.fields(self.scene)),
            rows.LANES: shared_memory.TEAM,
            rows.SPARE: shared_memory.TEAM - 6,
        }

    def _groups(self, *tables: type[rows.Rows]) -> dict[str, Group]:
        """The rows that the scene has of declared ones, in their order."""
        groups: dict[str, Group] = {}
        for table in tables:
            groups |= table.groups(self, self.sizes)
        return groups

    def _tables(self) -> None:
        """Lays out all tables."""
        self.hand = MemoryLayout(True, **self._groups(Hand))
        self.world = MemoryLayout(False, **self._world_groups())
        state = self._groups(FingerState)
        warm_start = {name: state.pop(name) for name in (FingerState.acc,)}
        hold = {f"held.{name}": (n, (3,)) for name, n in self.held.items()}
        self.finger_state = MemoryLayout(True, **state, **hold, **warm_start)
        self.world_state = MemoryLayout(False, **self._groups(WorldState))
        scratch = self._scratch_groups()
        if self.team > 1:
            onchip = self._groups(Chip, Shared)
            self.onchip = MemoryLayout.by_item(True, **onchip)
            elsewhere = {*onchip, *shared_memory.UNUSED}
            scratch = {name: group for name, group in scratch.items() if name not in elsewhere}
        self.scratch = MemoryLayout.by_item(True, **scratch)
        if self.record is not None:
            self.recorded = MemoryLayout(True, **recording.groups(self))

    def _world_groups(self) -> dict[str, Group]:
        """Constants of worlds: of palm, wrist, object, verdict and contacts."""
        groups = self._groups(World)
        groups |= dict.fromkeys(verdict.Bounds._fields, (1, ()))
        for contacts in self.sets:
            groups |= contacts.cone_rows()
        groups |= {name: (1, number.shape) for name, number in step_numbers(self.scene).items()}
        return groups | self._groups(WorldOptions)

    def _scratch_groups(self) -> dict[str, Group]:
        """What a step leaves for its parts: bodies, forces, factors, contacts."""
        groups = self._groups(Scratch)
        for contacts in self.sets:
            groups |= contacts.groups()
        if self.scene.effects.air_mass:
            groups |= self._groups(Air)
        if self.has_slots or self.scene.effects.air_mass:
            groups |= self._groups(Again)
        if self.has_slots:
            groups |= self._groups(Search)
        return groups

    def path_rows(self, states: bool) -> tuple[int, int]:
        """Numbers of rows of the state's tables that a path has: all, or the positions."""
        if states:
            return self.finger_state.rows, self.world_state.rows
        return self.finger_state.offset["finger_vel"], self.world_state.offset["wrist_vel"]


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
