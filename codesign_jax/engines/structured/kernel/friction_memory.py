"""Friction that contacts hold from step to step, in the kernel and in its adjoint.

Its law is `holding.held`.  What is held is state, `model.held`:

* A contact of a distance field, of fingers, palm and object with object, table and fixtures, holds
  three numbers of its own, along the object's axes if it is on the object, which it turns with, and
  else along the world's.  Within a step they are `Contact.held_friction`, first those before the
  step, then those behind it.
* Fingers that touch one another hold three numbers for each of their pairings, on both fingers'
  lanes, equal and opposite: all contacts of two fingers share them, as none of them stays at one
  ring.  A step leaves what it ends with in "new_held_friction".

The state after a step is a quotient of sums over contacts, of their forces f(jar(a, theta)).  With
b the cotangents of the sums it adds to the step's derivative two things: -J' K r, with r = b times
the sums' derivative by f, to the cotangent of the accelerations, for which `AdjointSolve` solves;
and b times the sums to the scalar whose derivative by theta is taken (`residual`).
"""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_list import ContactList, make_contacts
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables, only_on, plus, pull
from codesign_jax.engines.structured.kernel.memory import any_of, tree_add_scaled, zeros
from codesign_jax.engines.structured.kernel.pairing import FingerPairing
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.problem import Problem
from codesign_jax.engines.structured.kernel.rows import Contact, HeldBar, Scratch, Slot, Virtual
from codesign_jax.engines.structured.kernel.shared_memory import team_sum
from codesign_jax.engines.structured.kernel.sides import OwnSide, Sides
from codesign_jax.engines.structured.kernel.step_contacts import StepContacts
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanes import apply_columns, apply_rows, dot, sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, holding

BETWEEN_FINGERS = "held.finger_finger"
"""What fingers hold on one another, a row a pairing."""


def any_held(problem: Problem) -> bool:
    """Whether any contact of the scene holds friction."""
    return bool(problem.memory.layout.held)


def pairings(step: StepMemory) -> int:
    """Pairings of fingers that hold on one another."""
    return step.layout.held.get("finger_finger", 0)


def held_by_pairing(step: StepMemory, self_contacts: ContactList, slot_row: Any) -> list[Lanes]:
    """What the fingers of a pairing's row hold, (3,) or nothing if the scene has no such state."""
    if not pairings(step):
        return []
    return [step.finger_state.read(BETWEEN_FINGERS, slot_row + self_contacts.layout.first)]


def held_by_item(
    step: StepMemory, contacts: ContactList, columns: Lanes, item: Item
) -> tuple[Lanes, Lanes] | None:
    """What an item's contacts hold, (3, k): along the world's axes, and as the state has it.

    Args:
      step: The step's memory.
      contacts: The item's list.
      columns: Columns of the object's orientation, shape (3, 3, 1, world).
      item: The item.

    Returns:
      None if the list's contacts hold nothing.
    """
    if not contacts.layout.holds:
        return None
    name = f"held.{contacts.layout.name}"
    if jnp.ndim(item.number):
        row = step.finger_state.gather(name, item.number, step.block.column)
        held_friction = lanewise(lambda v: v[:, None], row)
    else:
        k = contacts.layout.k
        rows = [step.finger_state.read(name, item.number * k + j) for j in range(k)]
        held_friction = lanewise(lambda rows: jnp.stack(rows, 1), rows)
    if not contacts.layout.on_object:
        return held_friction, held_friction
    return lanewise(in_world, columns, held_friction), held_friction


def in_world(columns: jax.Array, held_friction: jax.Array) -> jax.Array:
    """What contacts on the object hold, along the world's axes."""
    return apply_columns(columns, held_friction)


def clear(step: StepMemory) -> None:
    """Begins a step: fingers that do not touch hold nothing."""
    for item in range(pairings(step)):
        step.scratch.write(Scratch.new_held_friction, zeros((3,), step.like), item)


def store(step: StepMemory, step_contacts: StepContacts, good: jax.Array) -> None:
    """Ends a step of the worlds that have moved.

    Args:
      step: The step's memory.
      step_contacts: The step's contacts.
      good: Lanes of these worlds, bool, shape (lane,).
    """
    state = step.finger_state
    mask = lanes([good], (), wide=False)
    for item in range(pairings(step)):
        new = step.scratch.read(Scratch.new_held_friction, item)
        old = state.read(BETWEEN_FINGERS, item)
        state.write(BETWEEN_FINGERS, lanewise(jnp.where, mask, new, old), item)
    for contacts in step_contacts.field_contacts.values():
        if contacts.layout.holds:
            _store(step, contacts, mask)


def _store(step: StepMemory, contacts: ContactList, mask: Lanes) -> None:
    """Ends a step of a list's contacts; what does not touch holds nothing."""
    name = f"held.{contacts.layout.name}"
    state = step.finger_state
    k = contacts.layout.k

    def after(mask: jax.Array, share: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(mask, jnp.where(share > 0, new, 0.0), old)

    def store_item(item: jax.Array, x: jax.Array) -> jax.Array:
        share = contacts.read(Contact.share, at(item))
        new = contacts.read(Contact.held_friction, at(item))
        for j in range(k):
            old = state.read(name, item * k + j)
            state.write(name, lanewise(after, mask, share[j], new[:, j], old), item * k + j)
        return x

    jax.lax.fori_loop(0, step.layout.held[contacts.layout.name] // k, store_item, jnp.int32(0))


def sums(self_contacts: ContactList, slot_row: Any, alpha: Lanes, held_friction: Lanes) -> Lanes:
    """Sums of `holding.hold`, (4,), of a row's contacts where the last step has moved jar.

    Args:
      self_contacts: The hand's contacts with itself.
      slot_row: The row of slots, a scalar.
      alpha: Length of Newton's last step.
      held_friction: What the row's fingers hold before the step, (3,).
    """

    def add(sums, place, cone, alpha, jar, step, held_friction, counts):
        c = make_contacts(place, cone)
        force = contact.constraint_update(c, tree_add_scaled(alpha, jar, step)).force
        return sums + counts * sum_axis(holding.hold(c, force, held_friction[:, None]), 1)

    def slot(item: Item, sums: Lanes) -> Lanes:
        jar = self_contacts.read(Contact.jar, item)
        step = self_contacts.read(Contact.jar_step, item)
        counts = self_contacts.held_part(item)
        contact_numbers = self_contacts.place(item), self_contacts.cone_at(item)
        return lanewise(add, sums, *contact_numbers, alpha, jar, step, held_friction, counts)

    added = self_contacts.fold_row(slot_row, slot, zeros((4,), self_contacts.like))
    return added if self_contacts.block.team == 1 else team_sum(self_contacts.block, added)


def keep(problem: Problem, alpha: Lanes, which: jax.Array) -> None:
    """Keeps what contacts of worlds hold whose iteration ends with a step of this length.

    Args:
      problem: The solver's problem.
      alpha: Length of Newton's last step.
      which: Lanes of these worlds, bool, shape (lane,).
    """
    some = [c for c in (*problem.per_link, *problem.dealt) if c.layout.holds]

    def keep_all() -> None:
        for contacts in some:
            _keep_of_list(problem, contacts, alpha, lanes([which], (), wide=True))

    if some:
        any_of(which, keep_all)
    if pairings(problem.memory):
        _keep_of_fingers(problem, alpha, which)


def _keep_of_list(problem: Problem, contacts: ContactList, alpha: Lanes, mask: Lanes) -> None:
    """Keeps what a list's contacts hold behind the step, in the worlds of the mask."""
    axes = held_axes(problem, contacts)

    def after(mask, place, cone, alpha, jar, step, old, axes):
        new = behind(make_contacts(place, cone), jar + alpha * step, old, axes)
        return jnp.where(mask, new, old)

    def keep_item(item: Item) -> None:
        def store() -> None:
            place = contacts.place(item)
            cone = contacts.cone_at(item)
            fields = Contact.jar, Contact.jar_step, Contact.held_friction
            jar, step, old = (contacts.read(name, item) for name in fields)
            new = lanewise(after, mask, place, cone, alpha, jar, step, old, axes)
            contacts.write(Contact.held_friction, new, item)

        jax.lax.cond(contacts.touching(item), store, lambda: None)

    contacts.each(keep_item)


def held_axes(problem: Problem, contacts: ContactList) -> Lanes | None:
    """Columns of the axes along which contacts hold, None for the world's."""
    return problem.columns if contacts.layout.on_object else None


def behind(
    contacts: contact.Contacts, jar: jax.Array, before: jax.Array, axes: jax.Array | None
) -> jax.Array:
    """What contacts hold behind a step, of what they hold before it, (3, ...) along their axes.

    Args:
      jar: Theirs at the step's accelerations.
      axes: Columns of their axes; None for the world's.
    """
    held_friction = before if axes is None else apply_columns(axes, before)
    force = contact.constraint_update(contacts, jar).force
    held_after = holding.quotient(holding.hold(contacts, force, held_friction))
    return held_after if axes is None else apply_rows(axes, held_after)


def _keep_of_fingers(problem: Problem, alpha: Lanes, which: jax.Array) -> None:
    self_contacts = problem.self_contacts
    assert self_contacts is not None

    among = self_contacts.masked(which)

    def keep_all() -> None:
        mask = lanes([which], (), wide=True)
        first = self_contacts.layout.first

        def keep_row(slot_row: jax.Array, x: jax.Array) -> jax.Array:
            before, old = problem.read(
                BETWEEN_FINGERS, Scratch.new_held_friction, item=slot_row + first
            )
            new = lanewise(holding.quotient, sums(among, slot_row, alpha, before))
            problem.write(
                Scratch.new_held_friction, lanewise(jnp.where, mask, new, old), slot_row + first
            )
            return x

        jax.lax.fori_loop(0, self_contacts.layout.slots.rows, keep_row, jnp.int32(0))

    any_of(which & among.touching_worlds(), keep_all)


def reverse(
    step: StepMemory, step_contacts: StepContacts, bars: CotangentTables, go: Lanes
) -> None:
    """Leaves the cotangents of what contacts hold after the step to the contacts.

    As "held_bar" of each, and as "sums_bar" of fingers on one another.  The state's become those
    before a step of which contacts add their part.

    Args:
      step: The step's memory.
      step_contacts: The step's contacts.
      bars: The tables of cotangents.
      go: Worlds that took the step, bool, lanes of a world.
    """
    for contacts in step_contacts.field_contacts.values():
        if contacts.layout.holds:
            _reverse(step, bars, contacts, go)
    if pairings(step):
        assert step_contacts.self_contacts is not None
        _reverse_fingers(step, bars, step_contacts.self_contacts, go)


def _reverse(step: StepMemory, bars: CotangentTables, contacts: ContactList, go: Lanes) -> None:
    """Leaves the cotangents of a list's contacts as "held_bar"."""
    rest = lanewise(jnp.logical_not, go)

    def reverse_item(item: Item) -> None:
        held_bar = held_bars(bars, contacts, item)
        contacts.write(HeldBar.held_bar, only_on(go, held_bar), item)
        _write_bars(bars, contacts, item, only_on(rest, held_bar))

    contacts.each(reverse_item)


def held_bars(bars: CotangentTables, contacts: ContactList, item: Item) -> Lanes:
    """Cotangents of what an item's contacts hold, (3, k)."""
    name = f"held.{contacts.layout.name}"
    k = contacts.layout.k
    rows = [bars.finger_state.read(name, item.number * k + j) for j in range(k)]
    return lanewise(lambda rows: jnp.stack(rows, 1), rows)


def _write_bars(bars: CotangentTables, contacts: ContactList, item: Item, value: Lanes) -> None:
    name = f"held.{contacts.layout.name}"
    k = contacts.layout.k
    for j in range(k):
        bars.finger_state.write(name, value[:, j], item.number * k + j)


def add_held(bars: CotangentTables, contacts: ContactList, item: Item, held: dict) -> None:
    """Adds an item's cotangents of what its contacts hold to those of the state."""
    if contacts.layout.holds:
        old = held_bars(bars, contacts, item)
        _write_bars(bars, contacts, item, plus(old, held[Contact.held_friction]))


def wrench_of_cotangents(problem: Problem, contacts: ContactList, item: Item) -> Lanes:
    """Wrench (6,) of what "held_bar" of an item's contacts asks of the step's accelerations.

    It is the cotangent of jar, through the force, of what they hold behind the step.
    """
    axes = held_axes(problem, contacts)

    def of_jar(jar, place, cone, held, bars, axes):
        return sum_axis(dot(bars, behind(make_contacts(place, cone), jar, held, axes)), 0)

    def wrench(place, cone, change):
        return sum_axis(contact.contact_wrench(make_contacts(place, cone), change), 1)

    def wrenches() -> list[Lanes]:
        place = contacts.place(item)
        cone = contacts.cone_at(item)
        jar, held, bars = (
            contacts.read(n, item) for n in (Contact.jar, Contact.held_friction, HeldBar.held_bar)
        )
        unit = lanes([problem.like + 1.0], (), wide=True)
        (change,) = pull(of_jar, (jar,), (place, cone, held, bars, axes), unit)
        return [lanewise(wrench, place, cone, change)]

    return contacts.if_touching(item, wrenches, [(6,)])[0]


def _reverse_fingers(
    step: StepMemory, bars: CotangentTables, self_contacts: ContactList, go: Lanes
) -> None:
    """Makes the cotangents of the state after the step those of the sums of `holding.hold`.

    What a finger holds is the opposite of what its partner holds.
    """
    state = bars.finger_state
    no_step = zeros((), step.like)

    for item in range(pairings(step)):
        slot_row = item - self_contacts.layout.first
        mine = state.read(BETWEEN_FINGERS, item)
        sums_bar = zeros((4,), step.like)
        if 0 <= slot_row < self_contacts.layout.slots.rows:
            ended = sums(
                self_contacts, slot_row, no_step, step.finger_state.read(BETWEEN_FINGERS, item)
            )
            theirs = self_contacts.pairing(slot_row).swap(mine)
            both = lanewise(jnp.subtract, mine, theirs) if item else mine
            (sums_bar,) = pull(holding.quotient, (ended,), (), only_on(go, both))
        step.scratch.write(Virtual.sums_bar, sums_bar, item)
        rest = only_on(lanewise(jnp.logical_not, go), mine)
        state.write(BETWEEN_FINGERS, rest, item)


def held_and_cotangents(
    step: StepMemory, pairing: FingerPairing
) -> tuple[dict[str, Lanes], dict[str, Lanes]]:
    """What the lanes' fingers hold and "sums_bar", by name; nothing without such a state."""
    if not pairings(step):
        return {}, {}
    item = pairing.number
    lane = step.block.lane
    held = step.finger_state.gather(BETWEEN_FINGERS, item, lane)
    sums_bar = step.scratch.gather(Virtual.sums_bar, item, lane)
    return {Contact.held_friction: held}, {Virtual.sums_bar: sums_bar}


def add_pairing_cotangents(
    bars: CotangentTables, pairing: FingerPairing, held: dict[str, Lanes]
) -> None:
    """Adds a contact's cotangents of what fingers hold to those of the state."""
    if not held:
        return
    item = pairing.number
    lane = bars.block.lane
    state = bars.finger_state
    new = lanewise(jnp.add, state.gather(BETWEEN_FINGERS, item, lane), held[Contact.held_friction])
    state.scatter(BETWEEN_FINGERS, new, item, lane)


def load_cotangents(problem: Problem, sides: Sides, self_contacts: ContactList) -> None:
    """Loads the links with what "sums_bar" asks of the step's accelerations.

    A change of jar changes a contact's force by -K; with r the derivative of the sums by the
    force, the cotangent of jar is -K r.
    """
    lane = problem.block.lane

    def of_held(force, place, cone, held, bars):
        return held_work(make_contacts(place, cone), force, held, bars)

    def force_of(item: Item, side: OwnSide) -> Lanes:
        which = item.pairing.number
        cone = self_contacts.cone_at(item)
        jar = self_contacts.read(Contact.jar, item)

        def response(place, cone, jar):
            return contact.constraint_update(make_contacts(place, cone), jar).force

        force = lanewise(response, side.place, cone, jar)
        held = problem.memory.finger_state.gather(BETWEEN_FINGERS, which, lane)
        bars = problem.memory.scratch.gather(Virtual.sums_bar, which, lane)
        unit = lanes([problem.like + 1.0], (), wide=True)
        (r,) = pull(of_held, (force,), (side.place, cone, held, bars), unit)
        r = lanewise(jnp.multiply, self_contacts.held_part(item), r)
        hessian = self_contacts.read(Slot.hessian, item)
        return lanewise(jnp.negative, self_contacts.times_hessian(hessian, r))

    sides.lay_each(self_contacts, force_of)


def held_work(
    contacts: contact.Contacts, force: jax.Array, held_friction: jax.Array, bars: jax.Array
) -> jax.Array:
    """Cotangents of the sums of `holding.hold` times what contacts add to them."""
    return sum_axis(dot(bars[:, None], holding.hold(contacts, force, held_friction[:, None])), 0)
