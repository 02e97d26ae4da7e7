"""The tables of a block in memory: their rows for a scene.

Tables of constants, state and scratch are in global memory; `onchip` is in a GPU's shared memory,
see `rows.Chip`.
"""

from functools import partial

from codesign_jax.engines.structured.kernel import objects, rows, shared_memory
from codesign_jax.engines.structured.kernel import record as recording
from codesign_jax.engines.structured.kernel.contact_list import SELF, ContactLayout
from codesign_jax.engines.structured.kernel.memory import MemoryLayout
from codesign_jax.engines.structured.kernel.placement import Appended, Fixed
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
    Side,
    World,
    WorldOptions,
    WorldState,
)
from codesign_jax.engines.structured.kernel.step_memory import KernelLayout
from codesign_jax.engines.structured.laws import shapes, surroundings
from codesign_jax.engines.structured.laws.step_numbers import step_numbers
from codesign_jax.judge import verdict
from codesign_jax.model import held, layout
from codesign_jax.model.held import palm_groups, rings_of_link
from codesign_jax.model.layout import touches_itself
from codesign_jax.scene import Scene
from codesign_jax.scene.section_numbers import Numbers

GATHERING = ("gpu",)
"""Backends whose lanes read rows of their own as fast as a common one."""


def pair_slots(scene: Scene) -> int:
    """Slots of a pair of fingers; a world with more contacts fails (CONTACT_OVERFLOW).

    A ring has one contact with another finger, one with its own and one with the palm.
    """
    d = scene.discretization
    e = scene.effects
    if e.surface == "hull":
        return d.links * d.hull_rings * (2 if e.finger_palm and touches_itself(scene) else 1)
    return min(4 * d.links * d.spheres_per_link, (d.links * d.spheres_per_link) ** 2)


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
        self.lists = self._lists()
        self.self_list = next((c for c in self.lists if c.of_hand), None)
        self.held = held.held(scene)
        self._tables()

    def _lists(self) -> list[ContactLayout]:
        """The contacts of each pair of bodies that the scene has, and where they are."""
        e = self.scene.effects
        k = self.rings_per_link
        n = len(surroundings.fields(self.scene))
        touch = bool(self.record and self.record.touch)
        make = partial(ContactLayout, self.scene, touch=touch)
        of_fingers = Fixed(self.links)
        lists = []
        on = {"finger_object": k * e.finger_object, "finger_table": n * k * e.finger_table}
        for name in on:
            if on[name] and self.team == 1:
                lists.append(make(name, on[name], of_fingers))
            elif on[name]:
                lists.append(make(name, 1, Fixed(self.links * on[name], shared=True)))
        lists += self._of_hand()
        of_palm = Fixed(self.palm_groups)
        on = {"palm_object": int(e.palm_object), "palm_table": n * e.palm_table}
        lists += [make(name, on[name], of_palm) for name in on if on[name]]
        groups = -(-surroundings.slots(self.scene) // self.fingers)
        on_table = [make("object_table", 1, Fixed(groups))] if e.object_table and groups else []
        return [*lists, *on_table]

    def _of_hand(self) -> list[ContactLayout]:
        """The list of the hand's contacts with itself; empty without."""
        e = self.scene.effects
        between = e.finger_finger and self.num_fingers > 1
        alone = e.finger_palm or touches_itself(self.scene)
        if not (between or alone):
            return []
        # A row for each pairing of fingers, and one for contacts of a finger with itself and palm.
        rows = self.fingers - int(not alone) if e.finger_finger else 1
        slots = Appended(rows, pair_slots(self.scene), self.gathers, shared=self.team > 1)
        return [ContactLayout(self.scene, SELF, 1, slots, remembers=self.remembers)]

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
        for contacts in self.lists:
            groups |= contacts.cone_rows()
        groups |= {name: (1, number.shape) for name, number in step_numbers(self.scene).items()}
        return groups | self._groups(WorldOptions)

    def _scratch_groups(self) -> dict[str, Group]:
        """What a step leaves for its parts: bodies, forces, factors, contacts."""
        groups = self._groups(Scratch)
        for contacts in self.lists:
            groups |= contacts.groups()
            if contacts.of_hand:
                groups |= self._groups(Side)
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
