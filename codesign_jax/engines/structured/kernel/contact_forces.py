"""The forces of a state's contacts as one kernel: a step's forward pass, with no solver behind it.

The forward pass finds the contacts of a state and their jar at its accelerations.  At those that
solved a step, the force of a contact is the one that the solver ended with: it is a function of jar
alone.  Here it is stored beside the contact's place, for every kind of contact in the same fields.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import friction_memory
from codesign_jax.engines.structured.kernel.contact_sets import (
    BoundContacts,
    ContactSet,
    begun,
    margin,
    with_held,
    zeros,
)
from codesign_jax.engines.structured.kernel.memory import Block, BoundTable, MemoryLayout
from codesign_jax.engines.structured.kernel.program import Inputs, Limits, Program, numbered
from codesign_jax.engines.structured.kernel.rows import Contact, Force, Group, PairForce, Slot
from codesign_jax.engines.structured.kernel.sdf_collision import SdfCollision
from codesign_jax.engines.structured.kernel.self_contacts import (
    BoundSelfContacts,
    SelfContactSet,
)
from codesign_jax.engines.structured.kernel.step import Step
from codesign_jax.engines.structured.lanes import dot, sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, holding
from codesign_jax.engines.structured.laws.contact import Cone
from codesign_jax.engines.structured.laws.kinematics import State
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.scene import Scene

FAR = 1e3
"""A gap that no ring has [m]."""


class ForceOutputs(NamedTuple):
    """What the kernel writes, tables of blocks."""

    stored: Any  # `ForceProgram.stored_rows`, shape (block, row, lane)
    scratch: Any  # Memory that is not read


class ForceProgram(Program):
    """Tables and kernel of the contact forces of states.

    Attributes:
      stored_rows: What the kernel stores: for each item of a contact set the `Place` of its k
        contacts, "force", shape (3, k): the force on the first body [N], world axes, which is
        the finger, the palm, or the object on table and fixtures, and "energy", shape (k,): that
        of `holding.stored_energy`. For each pairing of fingers `rows.PairForce`, shape (2,).
    """

    @classmethod
    def of(cls, scene: Scene, dtype: Any, worlds: int) -> "ForceProgram":
        """The program for this device, type and number of worlds."""
        unused = Limits(0, 0, 0.0)
        return cls.here(scene, unused, dtype, worlds, team=1)

    def _tables(self) -> None:
        super()._tables()
        groups: dict[str, Group] = {}
        for contacts in self.sets:
            of_pair = isinstance(contacts, SelfContactSet)
            groups |= contacts.groups_of(PairForce if of_pair else Force)
        self.stored_rows = MemoryLayout(True, **groups)

    def stored(self, hand: WorldModel, state: State) -> dict[str, jax.Array]:
        """What the kernel stores, by name, shape (item, ..., finger of the block, world).

        What does not touch has no share; where no finger touches another one, nothing is stored.
        """
        worlds = state.wrist.shape[-1]
        if not self.stored_rows.rows:
            return {}
        inputs = self.inputs(hand, state, self._commands(state))
        stored = self._run(inputs)
        unpacked = self.stored_rows.unpack(stored, self.fingers, self.fingers, worlds)
        return {name: unpacked[name] for name in self.stored_rows.groups}

    def shapes(self, worlds: int, dtype: Any) -> dict[str, jax.ShapeDtypeStruct]:
        """Shapes of what `stored` returns."""
        lane = self.fingers, worlds
        return {
            name: jax.ShapeDtypeStruct((count, *shape, *lane), dtype)
            for name, (count, shape) in self.stored_rows.groups.items()
        }

    def _commands(self, state: State) -> jax.Array:
        """Controls (world, 1, nu) by which a rigid wrist has the state's accelerations.

        Chambers have no part in contacts.
        """
        h = self.scene.discretization.timestep
        arm = state.wrist + h * (state.wrist_vel + h * state.acc.wrist)
        arm = arm.reshape(6, -1).T
        none = jnp.zeros((len(arm), self.num_fingers), arm.dtype)
        return jnp.concatenate([arm, none], 1)[:, None]

    def _run(self, inputs: Inputs) -> jax.Array:
        def shape(rows: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((len(inputs.arm), rows, self.size), inputs.arm.dtype)

        outputs = ForceOutputs(shape(self.stored_rows.rows), shape(self.scratch.rows))
        call = self.call(self._force_kernel, "forces", inputs, outputs)
        origin = repr((self.scene.structure, "forces"))
        scratch = (numbered(outputs).scratch,)
        return self.launch(call, inputs, outputs, origin, scratch=scratch, level=1).stored

    def _force_kernel(self, inputs: Inputs, out: ForceOutputs) -> None:
        block = Block(self.fingers, self.block)
        state = inputs.finger_start, inputs.world_start
        step = ForceStep(self, block, inputs.hand, inputs.world, *state, out.scratch, inputs.grid)
        commands = lanes([inputs.arm[0, k, block.world] for k in range(6)], (6,), wide=False)
        chamber = lanes([inputs.pressure[(0,)]], (), wide=True)
        step.store(BoundTable(self.stored_rows, out.stored), commands, chamber)


class ForceStep(Step):
    """The forward pass of a step, which stores the force of each contact."""

    stored: BoundTable

    def store(self, stored: BoundTable, arm: Lanes, pressure: Lanes) -> None:
        """Stores the forces of the state's contacts; arguments as `Step.assemble`."""
        self.stored = stored
        self.assemble(arm, pressure)
        self_contacts = self.contacts.get("finger_finger")
        if isinstance(self_contacts, BoundSelfContacts):
            self._store_self_contacts(self_contacts)

    def bound(self, contacts: ContactSet) -> BoundContacts:
        """See `Step`; contacts of fields are stored as soon as they are found."""
        if isinstance(contacts, SelfContactSet):
            return super().bound(contacts)
        return StoredContacts(contacts, self.stored, contacts.cone(self.constant))

    def fields(self, bodies: dict[str, Any], world_object: Any) -> SdfCollision:
        return EveryRing(self, bodies, world_object)

    def _store_self_contacts(self, contacts: BoundSelfContacts) -> None:
        def of_row(row: jax.Array, x: jax.Array) -> jax.Array:
            pairing = contacts.pairing(row)
            itself = pairing.itself
            hold = friction_memory.of_row(self, contacts, row)

            def add(item: Any, sums: list[Lanes]) -> list[Lanes]:
                palm = jnp.zeros_like(self.like)
                if itself is not None:
                    palm = jnp.where(
                        itself & (contacts.read(Slot.other, item).lane < 0.5), 1.0, palm
                    )
                side = lanes([palm], (), wide=True)
                with contacts.with_cone(row, item):
                    given = contacts.place(item), contacts.cone, contacts.read(Contact.jar, item)
                    held = [lanewise(jnp.multiply, h, contacts.holds(item, pairing)) for h in hold]
                    return lanewise(with_slot, sums, side, *given, *held)

            none = zeros((2,), self.like)
            for name, value in zip(
                PairForce.fields(), contacts.fold(row, add, [none] * 3), strict=True
            ):
                self.stored.write(f"{contacts.set.name}.{name}", value, row)
            return x

        jax.lax.fori_loop(0, contacts.set.rows, of_row, jnp.int32(0))


class StoredContacts(BoundContacts):
    """Contacts of a set whose forces are stored."""

    def create(
        self,
        item: Any,
        place: Place,
        acc: Lanes,
        vel: Lanes,
        friction: Lanes | None = None,
        hold: tuple[Lanes, Lanes] | None = None,
    ) -> None:
        """See `BoundContacts`."""
        cone = self.cone
        if friction is not None:
            cone = lanewise(Cone.of_friction, cone, friction[0])
        place, jar = lanewise(partial(begun, margin(self.set.scene)), place, cone, acc, vel)
        if hold is not None:
            jar = lanewise(with_held, jar, place, cone, hold[0])
        force = lanewise(solved_force, place, cone, jar)
        energy = lanewise(stored_energy, place, cone, None if hold is None else hold[0])
        for field, value in (place._asdict() | {"force": force, "energy": energy}).items():
            self.write(field, value, item)


class EveryRing(SdfCollision):
    """Tells the places of rings that are far from the object as well."""

    def closing_gap(self, numbers: Lanes, centre: Lanes, velocity: Lanes) -> Lanes:
        return lanewise(lambda numbers: FAR + 0.0 * numbers[6], numbers)


def solved_force(place, cone, jar):
    """Forces (3, k) of an item's contacts."""
    contacts = ContactSet.contacts(place, cone)
    force = contact.constraint_update(contacts, jar).force[:3]
    return jnp.where(contacts.active, force, 0.0)


def stored_energy(place, cone, held_friction):
    """Energies (k,) of an item's contacts."""
    return holding.stored_energy(ContactSet.contacts(place, cone), held_friction)


def with_slot(sums, palm, place, cone, jar, held_friction=None):
    """Adds a slot's contact to a pairing's `PairForce`; palm: 1 for one with the palm, else 0."""
    pressing, depth, energy = sums
    held_friction = None if held_friction is None else held_friction[:, None]
    stored = sum_axis(stored_energy(place, cone, held_friction), 0)
    force = sum_axis(dot(place.normal, solved_force(place, cone, jar)), 0)
    deep = jnp.where(place.share[0] > 0, jnp.maximum(-place.gap[0], 0.0), 0.0)
    side = jnp.stack([1.0 - palm, palm])
    return [pressing + side * force, jnp.maximum(depth, side * deep), energy + side * stored]
