"""Recorded contact forces: what a step writes of its contacts when its accelerations are known.

The force of a contact is a function of its place and of its jar (`contact.constraint_update`).  A
recording rollout writes sums of it for each pair of bodies, and with `rows.Record.touch` the force
of each ring on the object beside its place.  Jar is the one at the end of the step: where a world's
iteration ends, `settle` adds the last step of Newton's method to it, and a chord step behind that.
"""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import friction_memory
from codesign_jax.engines.structured.kernel.contact_list import (
    SELF,
    ContactLayout,
    ContactList,
    force_of_jar,
    make_contacts,
)
from codesign_jax.engines.structured.kernel.memory import BoundTable, choose, each, zeros
from codesign_jax.engines.structured.kernel.placement import Item
from codesign_jax.engines.structured.kernel.problem import Iterate, Problem, relative
from codesign_jax.engines.structured.kernel.rows import (
    Contact,
    ForceSum,
    Group,
    PairForce,
    Scratch,
    Slot,
    TouchForce,
    WorldState,
)
from codesign_jax.engines.structured.kernel.shared_memory import team_sum
from codesign_jax.engines.structured.kernel.step_contacts import StepContacts
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanes import dot, sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import holding


def groups(layout: Any) -> dict[str, Group]:
    """Rows that a kernel's layout records, by the name of a contact list and of a field."""
    recorded: dict[str, Group] = {}
    for contacts in layout.lists:
        for table in tables(layout, contacts):
            for field, group in table.groups(layout.record, contacts.sizes).items():
                recorded[f"{contacts.name}.{field}"] = group
    return recorded


def tables(layout: Any, contacts: ContactLayout) -> tuple:
    """The declarations of what is recorded of a list."""
    if contacts.of_hand:
        return (PairForce,)
    return (ForceSum, TouchForce) if contacts.stores_all else (ForceSum,)


def settle(problem: Problem, alpha: Lanes, ends: jax.Array, chord: Iterate) -> None:
    """Moves jar to the end of the step, of worlds whose iteration ends.

    Args:
      problem: The solver's problem.
      alpha: Length of Newton's last step.
      ends: Lanes of these worlds, bool, shape (lane,).
      chord: Change of the accelerations of wrist, palm and object by a chord step behind it; that
        of the links is `Scratch.chord_link_acc`. Self-contacts have none, see `ChordStep`.
    """
    mask = lanes([ends], (), wide=True)
    step = problem.memory

    def moved(contacts: ContactList, item: Item) -> Lanes:
        jar = contacts.read(Contact.jar, item)
        return lanewise(_moved, mask, jar, alpha, contacts.read(Contact.jar_step, item))

    def put(contacts: ContactList, item: Item, jar: Lanes) -> None:
        old = contacts.read(Contact.jar_step, item)
        contacts.write(Contact.jar, jar, item)
        contacts.write(Contact.jar_step, lanewise(_zero_where, mask, old), item)

    for contacts in (*problem.per_link, *problem.dealt):

        def settle_item(item: Item, contacts: ContactList = contacts) -> None:
            def store() -> None:
                jar = moved(contacts, item)
                if Scratch.chord_link_acc in step.scratch:
                    acc = _chord_of(problem, contacts, item, chord)
                    jar = lanewise(jnp.add, jar, contacts.relative_acceleration(item, acc))
                put(contacts, item, jar)

            jax.lax.cond(contacts.touching(item), store, lambda: None)

        contacts.each(settle_item)
    if problem.self_contacts is not None:
        self_contacts = problem.self_contacts

        def settle_slot(item: Item) -> None:
            put(self_contacts, item, moved(self_contacts, item))

        self_contacts.masked(ends).each(settle_slot)
    if Scratch.chord_link_acc in step.scratch:
        each(problem.links, lambda i: step.scratch.write(
            Scratch.chord_link_acc, zeros((6,), step.like), i
        ))  # fmt: skip


def _chord_of(problem: Problem, contacts: ContactList, item: Item, chord: Iterate) -> Lanes:
    """Change of a list's relative acceleration by the chord step, shape (6,)."""
    name = contacts.layout.name
    link = None
    if contacts.layout.per_link:
        link = problem.memory.scratch.read(Scratch.chord_link_acc, item.number)
    return relative(name, link, chord.palm_acc, chord.object_acc)


def write(step: StepMemory, step_contacts: StepContacts, table: BoundTable) -> None:
    """Writes the forces of the step's contacts, at its accelerations; before it is integrated.

    Args:
      step: The step's memory.
      step_contacts: The step's contacts, whose jar is that of its accelerations, see `settle`.
      table: Where they are written, rows of `rows.ForceSum`, `TouchForce` and `PairForce`.
    """
    for contacts in step_contacts.field_contacts.values():
        _write_list(step, contacts, step_contacts.columns, table)
    if (pairs := step_contacts.self_contacts) is not None:
        each(pairs.layout.slots.rows, lambda slot_row: _write_pairing(step, pairs, slot_row, table))


def _write_list(step: StepMemory, contacts: ContactList, columns: Lanes, table: BoundTable) -> None:
    """Writes what a list's contacts do, and with `stores_all` each of them."""
    name = contacts.layout.name
    energy = f"{name}.{ForceSum.energy}" in table
    none = [zeros((3,), step.like), *[zeros((), step.like)] * (2 + energy)]

    def add(item: Item, sums: list[Lanes]) -> list[Lanes]:
        def added() -> list[Lanes]:
            numbers = contacts.place(item), contacts.cone_at(item), contacts.read(Contact.jar, item)
            held = None
            if energy:
                held = friction_memory.held_by_item(step, contacts, columns, item)
            return lanewise(_add_item, sums, *numbers, None if held is None else held[0])

        return choose(contacts.touching(item), added, sums, contacts.size)

    force, pressing, depth, *stored = contacts.fold(add, none)
    if contacts.layout.placement.shared:
        force, pressing = (team_sum(step.block, v) for v in (force, pressing))
        depth = _most_of_team(step, depth)
    fields = [ForceSum.force, ForceSum.pressing, ForceSum.depth, ForceSum.energy]
    for field, value in zip(fields, (force, pressing, depth, *stored), strict=False):
        table.write(f"{name}.{field}", value)
    if contacts.layout.stores_all:
        _write_rings(step, contacts, table)


def _write_rings(step: StepMemory, contacts: ContactList, table: BoundTable) -> None:
    """Writes place and force of each of a list's rings, those that do not touch as well."""
    position = step.world_state.read(WorldState.position)

    def put(item: Item) -> None:
        place = contacts.place(item)
        numbers = place, contacts.cone_at(item), contacts.read(Contact.jar, item)
        force = lanewise(force_of_jar, *numbers)
        point = lanewise(lambda x, p: x + p[:, None], place.point, position)
        values = point, place.normal, place.gap, force
        for field, value in zip(TouchForce.fields(), values, strict=True):
            contacts.record(table, f"{contacts.layout.name}.{field}", value, item)

    contacts.each(put)


def _write_pairing(
    step: StepMemory, contacts: ContactList, slot_row: Any, table: BoundTable
) -> None:
    """Writes what the fingers of a pairing do to one another, to themselves and to the palm."""
    energy = f"{SELF}.{PairForce.energy}" in table
    hold = friction_memory.held_by_pairing(step, contacts, slot_row) if energy else []

    def add(item: Item, sums: list[Lanes]) -> list[Lanes]:
        itself = item.pairing.itself
        palm = jnp.zeros_like(step.like)
        if itself is not None:
            other = contacts.read(Slot.other_side, item).lane
            palm = jnp.where(itself & (other < 0.5), 1.0, palm)
        side = lanes([palm], (), wide=True)
        numbers = contacts.place(item), contacts.cone_at(item), contacts.read(Contact.jar, item)
        held = [lanewise(jnp.multiply, h, contacts.held_part(item)) for h in hold]
        return lanewise(_add_slot, sums, side, *numbers, *held)

    none = [zeros((2,), step.like)] * (2 + energy)
    pressing, depth, *stored = contacts.fold_row(slot_row, add, none)
    if contacts.layout.placement.shared:
        pressing = team_sum(step.block, pressing)
        depth = _most_of_team(step, depth)
    fields = [PairForce.pressing, PairForce.depth, PairForce.energy]
    for field, value in zip(fields, (pressing, depth, *stored), strict=False):
        table.write(f"{SELF}.{field}", value, slot_row)


def _most_of_team(step: StepMemory, value: Lanes) -> Lanes:
    parts = [step.block.over_team(p, jnp.maximum) for p in value.parts.ravel()]
    return lanes(parts, value.shape[:-2], wide=True)


# Stages that the kernel evaluates lane by lane


def _moved(mask, jar, alpha, step):
    return jnp.where(mask, jar + alpha * step, jar)


def _zero_where(mask, value):
    return jnp.where(mask, 0.0, value)


def _add_item(sums, place, cone, jar, held_friction):
    """Adds an item's contacts to force, normal force and, if there is a sum for it, energy."""
    total, pressing, depth, *stored = sums
    force = force_of_jar(place, cone, jar)
    if stored:
        contacts = make_contacts(place, cone)
        stored = [stored[0] + sum_axis(holding.stored_energy(contacts, held_friction), 0)]
    pressing = pressing + sum_axis(dot(place.normal, force), 0)
    return [total + sum_axis(force, 1), pressing, _deeper(depth, place), *stored]


def _deeper(depth, place):
    for k in range(place.gap.shape[0]):
        depth = jnp.maximum(depth, jnp.where(place.share[k] > 0, -place.gap[k], 0.0))
    return depth


def _add_slot(sums, palm, place, cone, jar, held_friction=None):
    """Adds a slot's contact to a pairing's sums; palm: 1 for one with the palm, else 0."""
    pressing, depth, *stored = sums
    side = jnp.stack([1.0 - palm, palm])
    force = sum_axis(dot(place.normal, force_of_jar(place, cone, jar)), 0)
    deep = _deeper(jnp.zeros_like(palm), place)
    if stored:
        held_friction = None if held_friction is None else held_friction[:, None]
        contacts = make_contacts(place, cone)
        energy = sum_axis(holding.stored_energy(contacts, held_friction), 0)
        stored = [stored[0] + side * energy]
    return [pressing + side * force, jnp.maximum(depth, side * deep), *stored]
