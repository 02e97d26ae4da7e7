"""A block's memory in a step: its tables with their references, and what is read of them."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_list import ContactLayout
from codesign_jax.engines.structured.kernel.memory import Block, BoundTable, MemoryLayout
from codesign_jax.engines.structured.kernel.rows import (
    FingerState,
    Hand,
    Record,
    Scratch,
    World,
    WorldOptions,
)
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws.cones import friction_by_contact
from codesign_jax.engines.structured.laws.rings import grown, growth_factors
from codesign_jax.engines.structured.laws.step_numbers import step_numbers
from codesign_jax.model import Layout
from codesign_jax.model.layout import hinge_sign, palm_touches, sections_grow
from codesign_jax.scene import Scene

PALM_CONSTANTS = (
    World.palm_mass,
    World.palm_centre,
    World.palm_inertia,
    World.wrist_damping,
    World.wrist_armature,
    World.object_mass,
    World.object_inertia,
    WorldOptions.wrist_stiffness,
)
"""Constants of the worlds that `palm_and_object` takes beside `laws.step_numbers`; some scenes lack
the last one."""
LINK_CONSTANTS = (
    Hand.offset,
    Hand.mass,
    Hand.centre,
    Hand.inertia,
    Hand.stiffness,
    Hand.damping,
    Hand.armature,
)
"""Constants of each link that `link_forces` takes."""
FINGER_CONSTANTS = (Hand.gain, Hand.section, Hand.threshold, Hand.law)
"""Constants of each finger, of each link of tapered ones, that it takes; some scenes lack all but
the first."""


class KernelLayout:
    """What the parts of a kernel know of its tables, which `memory_tables.Tables` lays out."""

    scene: Scene
    lay: Layout  # Where the scene's joints and bodies are in MuJoCo's model
    links: int  # Moving links of a finger
    axes: int  # Axes of a joint
    fingers: int  # Fingers of a block, a power of two
    num_fingers: int  # Those of the scene
    block: int  # Worlds of a block
    size: int  # Its lanes
    team: int  # Lanes of a finger
    columns: int  # Columns of the tables of fingers, which the lanes of a team share
    rings_per_link: int  # Rings or contact spheres of a link
    palm_groups: int  # Those of the palm, for each finger's lanes
    hull: bool  # Whether fingers have rings
    meshes: bool  # Whether there are objects with meshes
    support_points: int  # Support points of a mesh
    lists: list[ContactLayout]  # The contacts of each pair of bodies
    self_list: ContactLayout | None  # Those of the hand with itself, one of `lists`
    record: Record | None  # What a rollout records of its contacts
    held: dict[str, int]  # What contacts hold of friction, see `model.held`
    # Rows of the tables; `onchip` with teams only.
    hand: MemoryLayout
    world: MemoryLayout
    finger_state: MemoryLayout
    world_state: MemoryLayout
    scratch: MemoryLayout
    onchip: MemoryLayout
    # Rows of what is recorded of a step, with `record` only.
    recorded: MemoryLayout

    @property
    def has_slots(self) -> bool:
        """Whether there are contacts in slots: those of the hand with itself."""
        return self.self_list is not None

    @property
    def tapered(self) -> bool:
        """Whether sections of a finger differ from its base to its tip."""
        return self.scene.hand.section.tapered

    @property
    def by_elements(self) -> bool:
        """Whether finite elements give the law of a finger's section."""
        return self.scene.hand.section.law == "elements"

    @property
    def grows(self) -> bool:
        """Whether sections of fingers grow with their pressure."""
        return sections_grow(self.scene)

    @property
    def palm_touches(self) -> bool:
        """Whether the palm has contacts with object or table."""
        return palm_touches(self.scene)

    @property
    def friction_by_point(self) -> bool:
        """Whether the object's points on table and fixtures have a friction each."""
        return friction_by_contact(self.scene, "object_table")


class References(NamedTuple):
    """Pallas' references to a block's tables: rows of `rows` by lanes, or by worlds."""

    hand: Any  # `rows.Hand`, shape (row, lane)
    world: Any  # `rows.World`, shape (row, world)
    finger_state: Any  # `rows.FingerState`, shape (row, lane)
    world_state: Any  # `rows.WorldState`, shape (row, world)
    scratch: Any  # `rows.Scratch` and more, shape (row, lane)
    grid: Any = None  # Distances of all meshes, shape (n,); None without meshes
    onchip: Any = None  # `rows.Chip`, shared memory, shape (row, lane); None without teams


class StepMemory:
    """A block's tables with their references.

    Attributes:
      layout: Their rows, and what the kernel knows of the scene.
      block: The lanes.
      grid: Distances of all meshes, a reference; None without meshes.
      like: Zeros of the lanes' shape and type.
    """

    def __init__(self, layout: KernelLayout, block: Block, references: References):
        """Binds the rows of the tables to their references."""
        self.layout = layout
        self.block = block
        self.grid = references.grid
        self.hand = BoundTable(layout.hand, references.hand)
        self.world = BoundTable(layout.world, references.world, block.world)
        self.finger_state = BoundTable(layout.finger_state, references.finger_state)
        self.world_state = BoundTable(layout.world_state, references.world_state, block.world)
        self.scratch = BoundTable(layout.scratch, references.scratch)
        onchip = references.onchip
        self.onchip = None if onchip is None else BoundTable(layout.onchip, onchip)
        self.like = jnp.zeros((layout.size,), references.finger_state.dtype)

    def _table(self, name: str) -> BoundTable:
        tables = self.hand, self.finger_state, self.scratch, self.onchip
        return next(t for t in tables if t is not None and name in t)

    def read(self, name: str, item: Any = 0) -> Lanes:
        """Reads from the table of fingers that has the name."""
        return self._table(name).read(name, item)

    def write(self, name: str, value: Lanes, item: Any = 0) -> None:
        """Writes to it."""
        self._table(name).write(name, value, item)

    def constant(self, name: str) -> Lanes:
        """A constant of the worlds."""
        return self.world.read(name)

    def ring(self, item: Any, lane: Any = None) -> Lanes:
        """Numbers of fingers' rings at the pressure of the step, see `rings.grown`.

        Args:
          item: The rings; of each lane, if there are lanes.
          lane: The lanes whose rings they are, None for the lanes' own; see `BoundTable.gather`.
        """
        numbers = self.item_of(self.hand, Hand.ring, item, lane)
        if not self.layout.grows:
            return numbers
        return lanewise(grown, numbers, self.growth_of(item, lane))

    def growth_of(self, ring: Any, lane: Any = None) -> Lanes:
        """Height and width of rings' sections over those without pressure; arguments as `ring`."""
        return self.item_of(self.scratch, Scratch.grown, self.section_of(ring), lane)

    def section_of(self, ring: Any) -> Any:
        """Item of a ring's section among the rows of `rows.SECTION`."""
        if not self.layout.tapered:
            return jnp.zeros_like(ring) if jnp.ndim(ring) else 0
        if isinstance(ring, int):
            return ring // self.layout.rings_per_link
        return jax.lax.div(ring, jnp.full_like(ring, self.layout.rings_per_link))

    def item_of(self, table: BoundTable, name: str, item: Any, lane: Any = None) -> Lanes:
        """An item of the lanes' own fingers, or one of each lane's fingers."""
        return table.read(name, item) if lane is None else table.gather(name, item, lane)

    def grow(self, pressure: Lanes) -> None:
        """Stores how much larger sections are at the pressures of the chambers."""

        def section(i: Any, x: jax.Array) -> jax.Array:
            factors = lanewise(growth_factors, self.hand.read(Hand.growth, i), pressure)
            self.scratch.write(Scratch.grown, factors, i)
            return x

        count = self.layout.links if self.layout.tapered else 1
        jax.lax.fori_loop(0, count, section, jnp.int32(0))

    def palm_constants(self) -> dict[str, Lanes]:
        """Constants that `palm_and_object` takes, by name, of those that the scene has."""
        constants = {n: self.constant(n) for n in PALM_CONSTANTS if n in self.world}
        return constants | self.step_numbers()

    def link_constants(self, i: Any) -> dict[str, Lanes]:
        """Constants that `link_forces` takes, by name, of those that the scene has."""
        constants = {n: self.hand.read(n, i) for n in LINK_CONSTANTS}
        row = i if self.layout.tapered else 0
        constants |= {n: self.hand.read(n, row) for n in FINGER_CONSTANTS if n in self.hand}
        return constants | self.step_numbers()

    def step_numbers(self) -> dict[str, Lanes]:
        """Those of `laws.step_numbers` that the scene has, by name."""
        return {n: self.constant(n) for n in step_numbers(self.layout.scene)}

    def joint(self, i: Any) -> dict[str, Lanes]:
        """Angles, velocities and accelerations of a joint, by name."""
        return {n: self.finger_state.read(n, i) for n in FingerState.fields()}

    def order(self, i: Any) -> Lanes:
        """In which order a joint's hinges follow one another, see `hinge_sign`."""
        sign = hinge_sign(jnp.asarray(i)).astype(self.like.dtype)
        return lanes([self.like + sign], (), wide=True)
