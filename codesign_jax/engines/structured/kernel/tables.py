"""What the kernel of a scene keeps in memory: its contacts, and the rows of its tables."""

from functools import partial

from codesign_jax import verdict
from codesign_jax.engines.structured.kernel import chambers, objects, pair_search, teams
from codesign_jax.engines.structured.kernel.contact_sets import ContactSet
from codesign_jax.engines.structured.kernel.memory import MemoryLayout
from codesign_jax.engines.structured.kernel.pairs import PairSet, pair_slots
from codesign_jax.engines.structured.kernel.slots import SlotSet
from codesign_jax.engines.structured.kernel.team_slots import TeamFieldSet, TeamPairSet
from codesign_jax.engines.structured.laws import shapes, surroundings
from codesign_jax.engines.structured.laws.cones import own_friction
from codesign_jax.model import layout
from codesign_jax.model.layout import pairings_held, palm_touches, touches_itself
from codesign_jax.scene import Scene

PALM = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Places of the rings that the palm's disc is made of, and their half axes, in half radii."""
GATHERING = ("gpu",)
"""Backends whose lanes read rows of their own as fast as a common one."""


def rings_of_link(scene: Scene) -> int:
    """Rings or contact spheres of a link."""
    e, spheres = scene.effects, layout(scene).spheres
    if e.surface == "spheres":
        return spheres.shape[-1] if spheres.size else 0
    between = e.finger_finger or e.finger_palm or e.finger_itself
    return scene.discretization.hull_rings * int(between or e.finger_object or e.finger_table)


class Tables:
    """Contacts and tables of a scene's kernel for one size of block.

    Attributes:
      links: Moving links of a finger; `axes`: axes of a joint.
      fingers: Fingers of a block, a power of two; `num_fingers`: those of the scene.
      block: Worlds of a block; `size`: its lanes.
      team: Lanes of a finger; `columns`: columns of the tables of fingers, which they share.
      k: Rings or contact spheres of a link; `palm_groups`: of the palm, for each finger's lanes.
      sets: The contacts.
      hand: Rows of the hand's table; likewise `world`, `finger_state`, `world_state`, `scratch`,
        and with teams `onchip`.
    """

    remembers: tuple[str, ...] = ()
    """Further numbers of the slots of contacts between fingers."""

    def __init__(self, scene: Scene, *, backend: str, width: int, team: int | None = None):
        """Lays out the memory, see `Program`."""
        self.backend = backend
        self.scene, self.lay = scene, layout(scene)
        self.hull = scene.effects.surface == "hull"
        n, self.links, self.axes = self.lay.dofs.shape
        self.fingers = 1 << (n - 1).bit_length()
        self.team = team or teams.lanes_of_a_finger(scene, backend, self.fingers)
        # A slot of a team is one contact, a ring's are as many as the fields.
        if scene.fixture or scene.effects.air_mass:
            self.team = 1
        # On a GPU a team's block is one world: nothing depends on what others do.
        alone = self.team > 1 and backend == "gpu"
        self.num_fingers = n
        self.block = 1 if alone else max(1, width // (self.fingers * self.team))
        self.columns = self.fingers * self.block
        self.size = self.columns * self.team
        e = scene.effects
        self.between = (e.finger_finger and n > 1) or e.finger_palm or touches_itself(scene)
        self.k = rings_of_link(scene)
        self.palm_groups = -(-(len(PALM) if self.hull else self.lay.palm.size) // self.fingers)
        self.meshes = bool(shapes.mesh_indices(scene))
        self.sets = self._sets()
        self.held = pairings_held(scene)
        self.slotted = any(isinstance(s, SlotSet) for s in self.sets)
        self._tables()

    def _sets(self) -> list[ContactSet]:
        e, k, n = self.scene.effects, self.k, len(surroundings.fields(self.scene))
        make = partial(ContactSet, self.scene, size=self.size)
        on = {"finger_object": k * e.finger_object, "finger_table": n * k * e.finger_table}
        fields = make if self.team == 1 else partial(TeamFieldSet, self.scene, self)
        sets = [fields(name, self.links, on[name]) for name in on if on[name]]
        if self.between:
            block, slots = (self.fingers, self.block), pair_slots(self.scene)
            how = {"gathers": self.gathers, "remembers": self.remembers}
            if self.team == 1:
                sets.append(PairSet(self.scene, block, self.links, slots, **how))
            else:
                block = (*block, self.team)
                sets.append(TeamPairSet(self.scene, block, self.links, slots, **how))
        on = {"palm_object": int(e.palm_object), "palm_table": n * e.palm_table}
        sets += [make(name, self.palm_groups, on[name]) for name in on if on[name]]
        groups = -(-surroundings.slots(self.scene) // self.fingers)
        on_table = [make("object_table", groups, 1)] if e.object_table and groups else []
        return [*sets, *on_table]

    @property
    def tapered(self) -> bool:
        """Whether the sections of fingers change along them."""
        return self.scene.hand.section.tapered

    @property
    def rows(self) -> int:
        """Rows of what each finger has one of, or each of its links if it is tapered."""
        return self.links if self.tapered else 1

    @property
    def gathers(self) -> bool:
        """Whether lanes read rows of their own."""
        return self.backend in GATHERING or self.team > 1

    def _tables(self) -> None:
        n, a = self.links, self.axes
        one: tuple[int, ...] = ()
        more = {"ring": (n * self.k, (8,))} if self.k else {}
        if palm_touches(self.scene):
            more |= {"palm_ring": (self.palm_groups, (8,))}
        if self.scene.effects.neo_hookean:
            more |= {"section": (self.rows, (4,))}
        if self.scene.effects.lateral_threshold:
            more |= {"threshold": (self.rows, (3,))}
        if self.scene.effects.air_mass:
            more |= {"volume": (1, one)}
        support, grid = objects.tables(self.scene, self.fingers)
        self.hand = MemoryLayout(
            True,
            mount=(1, (3, 3)),
            base=(1, (3,)),
            stub_centre=(1, (3,)),
            share=(n + 1, one),
            gain=(self.rows, one),
            offset=(n, one),
            mass=(n, one),
            centre=(n, (3,)),
            inertia=(n, (3,)),
            stiffness=(n, (a,)),
            damping=(n, (a,)),
            armature=(n, (a,)),
            **more,
            **support,
        )
        some: dict[str, tuple[int, tuple[int, ...]]] = {}
        for contacts in self.sets:
            some |= contacts.cone_rows()
        if self.scene.effects.gravity:
            some |= {"gravity": (1, one)}
        if own_friction(self.scene, "object_table"):
            some |= {"friction": (1, (2 * len(surroundings.fields(self.scene)),))}
        if self.scene.effects.wrist:
            some |= {"wrist_stiffness": (1, (6,))}
        if self.scene.effects.finger_palm:
            some |= {"palm_disc": (1, (2,))}
        if self.scene.effects.air_mass:
            some |= {"air": (1, (2,))}
        self.world = MemoryLayout(
            False,
            palm_mass=(1, one),
            palm_centre=(1, (3,)),
            palm_inertia=(1, (3, 3)),
            wrist_damping=(1, (6,)),
            wrist_armature=(1, (6,)),
            object_mass=(1, one),
            object_inertia=(1, (3,)),
            object_size=(1, (3,)),
            object_id=(1, one),
            **grid,
            **dict.fromkeys(verdict.Bounds._fields, (1, one)),
            **some,
        )
        held = {"grip": (self.held, (3,))} if self.held else {}
        joint = n, (a,)
        self.finger_state = MemoryLayout(True, finger=joint, finger_vel=joint, **held, acc=joint)
        world_state = dict(wrist=6, position=3, quat=4, wrist_vel=6, linear_vel=3, angular_vel=3)
        world_state |= dict(step=1, going=1, speed=1, acc_wrist=6, acc_object=6)
        self.world_state = MemoryLayout(
            False, **{name: (1, (size,)) for name, size in world_state.items()}
        )
        fields: dict[str, tuple[int, tuple[int, ...]]] = {
            "axes": (n, (a, 6)),
            "body_centre": (n, (3,)),
            "tensor": (n, (6,)),
            "motion": (n, (6,)),
            "smooth": (n, (6,)),
            "tau": (n, (a,)),
            "w": (n, (a, 6)),
            "g": (n, (a, 6)),
            "z": (n, (a,)),
            "step_acc": (n, (a,)),
            "step_motion": (n, (6,)),
            "new_finger": (n, (a,)),
            "new_finger_vel": (n, (a,)),
        }
        if self.scene.effects.lateral_threshold:
            fields |= {"armature_now": (n, (a,))}
        if self.held:
            fields |= {"new_grip": (self.held, (3,))}
        for contacts in self.sets:
            fields |= contacts.groups()
        if self.scene.effects.air_mass:
            fields |= chambers.fields(n, a)
        if self.slotted or self.scene.effects.air_mass:
            fields |= {"inverse": (n, (a, a)), "z_again": (n, (a,))}
        if any(isinstance(s, PairSet) for s in self.sets):
            fields |= pair_search.fields(n)
        if self.team > 1:
            onchip = teams.fields(n, a)
            self.onchip = MemoryLayout.by_item(True, **onchip)
            fields = {name: f for name, f in fields.items() if name not in {*onchip, *teams.UNUSED}}
        self.scratch = MemoryLayout.by_item(True, **fields)
