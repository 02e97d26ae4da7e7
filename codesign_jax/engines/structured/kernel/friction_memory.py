"""Friction that fingers hold on one another from step to step, in the kernel and in its adjoint.

Its law is `holding.held`.  The state has three numbers for each pairing of the fingers, "grip" of
both fingers' lanes, equal and opposite: all contacts of two fingers share it.  A step leaves what
it ends with in "new_grip".

The state after a step is a quotient of sums over contacts, of their forces f(jar(a, theta)).  With
b the cotangents of the sums it adds to the step's derivative two things: -J' K r, with r = b times
the sums' derivative by f, to the cotangent of the accelerations, for which `AdjointSolve` solves;
and b times the sums to the scalar whose derivative by theta is taken (`residual`).
"""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables, only_on, pull
from codesign_jax.engines.structured.kernel.finger_contacts import (
    BoundFingerContacts,
    FingerPairing,
)
from codesign_jax.engines.structured.kernel.memory import tree_add_scaled
from codesign_jax.engines.structured.kernel.problem import Problem
from codesign_jax.engines.structured.kernel.shared_memory import team_sum
from codesign_jax.engines.structured.kernel.slots import any_of, only
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanes import dot, sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, holding


def kept(problem: Problem) -> bool:
    return "new_grip" in problem.m.scratch


def of_row(step: StepMemory, pairs: BoundFingerContacts, row: Any) -> list[Lanes]:
    """What the fingers of a pairing's row hold, (3,) or nothing if the scene has no such state."""
    if not step.p.held:
        return []
    return [step.finger_state.read("grip", row + pairs.set.first)]


def clear(step: StepMemory) -> None:
    """Begins a step: fingers that do not touch hold nothing."""
    for item in range(step.p.held):
        step.scratch.write("new_grip", zeros((3,), step.like), item)


def store(step: StepMemory, good: jax.Array) -> None:
    """Ends a step of the worlds that have moved."""
    state, mask = step.finger_state, lanes([good], (), wide=False)
    for item in range(step.p.held):
        new = step.scratch.read("new_grip", item)
        old = state.read("grip", item)
        state.write("grip", lanewise(jnp.where, mask, new, old), item)


def sums(pairs: BoundFingerContacts, row: Any, alpha: Lanes, grip: Lanes) -> Lanes:
    """Sums of `holding.hold`, (4,), of a row's contacts where the last step has moved jar."""
    contacts, pairing = pairs.set.contacts, pairs.pairing(row)

    def add(sums, place, cone, alpha, jar, step, grip, counts):
        c = contacts(place, cone)
        force = contact.constraint_update(c, tree_add_scaled(alpha, jar, step)).force
        return sums + counts * sum_axis(holding.hold(c, force, grip[:, None]), 1)

    def one(item: Any, sums: Lanes) -> Lanes:
        jar, step = pairs.read("jar", item), pairs.read("step", item)
        counts = pairs.holds(item, pairing)
        with pairs.with_cone(row, item):
            args = sums, pairs.place(item), pairs.cone, alpha, jar, step, grip, counts
            return lanewise(add, *args)

    found = pairs.fold(row, one, zeros((4,), pairs.like))
    return found if pairs.block.team == 1 else team_sum(pairs.block, found)


def settle(problem: Problem, alpha: Lanes, which: jax.Array) -> None:
    """Keeps what the fingers of worlds hold whose iteration ends with a step of this length."""
    pairs = problem.pairs
    assert pairs is not None

    def keep() -> None:
        mask, first = lanes([which], (), wide=True), pairs.set.first

        def one(row: jax.Array, x: jax.Array) -> jax.Array:
            before, old = problem.read("grip", "new_grip", item=row + first)
            new = lanewise(holding.quotient, sums(pairs, row, alpha, before))
            problem.write("new_grip", lanewise(jnp.where, mask, new, old), row + first)
            return x

        jax.lax.fori_loop(0, pairs.set.rows, one, jnp.int32(0))

    with only([pairs], which):
        any_of(which & pairs.touching_worlds(), keep)


def reverse(step: StepMemory, bars: CotangentTables, pairs: BoundFingerContacts, go: Lanes) -> None:
    """Makes the cotangents of the state after the step those of the sums of `holding.hold`.

    Leaves these as "grip_bar", and the state's as those before a step of which contacts add their
    part (`leave`).  What a finger holds is the opposite of what its partner holds.
    """
    state, still = bars.finger_state, zeros((), step.like)

    for item in range(step.p.held):
        row, mine = item - pairs.set.first, state.read("grip", item)
        found = zeros((4,), step.like)
        if 0 <= row < pairs.set.rows:
            ended = sums(pairs, row, still, step.finger_state.read("grip", item))
            theirs = pairs.pairing(row).swap(mine)
            both = lanewise(jnp.subtract, mine, theirs) if item else mine
            (found,) = pull(holding.quotient, (ended,), (), only_on(go, both))
        step.scratch.write("grip_bar", found, item)
        rest = only_on(lanewise(jnp.logical_not, go), mine)
        state.write("grip", rest, item)


def at(step: StepMemory, pairing: FingerPairing) -> tuple[Lanes, ...]:
    """What the lanes' fingers hold, and "grip_bar"; nothing if the scene has no such state."""
    if not step.p.held:
        return ()
    item, lane = pairing.number, step.block.lane
    held = step.finger_state.gather("grip", item, lane)
    return held, step.scratch.gather("grip_bar", item, lane)


def leave(bars: CotangentTables, pairing: FingerPairing, found: tuple) -> None:
    """Adds a contact's cotangents of `at` to those of the state."""
    if not found:
        return
    item, lane, state = pairing.number, bars.block.lane, bars.finger_state
    new = lanewise(jnp.add, state.gather("grip", item, lane), found[0])
    state.scatter("grip", new, item, lane)


def push(problem: Problem, pairs: BoundFingerContacts) -> None:
    """Loads the links with what "grip_bar" asks of the step's accelerations.

    A change of jar changes a contact's force by -K; with r the derivative of the sums by the
    force, the cotangent of jar is -K r.
    """
    contacts, lane = pairs.set.contacts, problem.block.lane

    def of_held(force, place, cone, held, bars):
        return held_work(contacts(place, cone), force, held, bars)

    def load(item: Any, pairing: FingerPairing) -> None:
        which, side, jar = pairing.number, pairs.own_side(item), pairs.read("jar", item)

        def response(place, cone, jar):
            return contact.constraint_update(contacts(place, cone), jar).force

        force = lanewise(response, side.place, pairs.cone, jar)
        held = problem.m.finger_state.gather("grip", which, lane)
        bars = problem.m.scratch.gather("grip_bar", which, lane)
        one = lanes([problem.like + 1.0], (), wide=True)
        (r,) = pull(of_held, (force,), (side.place, pairs.cone, held, bars), one)
        r = lanewise(jnp.multiply, pairs.holds(item, pairing), r)
        change = lanewise(jnp.negative, pairs.stiff(pairs.read("hessian", item), r))
        pairs.load(item, side, change, pairing)

    pairs.do(load)


def held_work(
    contacts: contact.Contacts, force: jax.Array, grip: jax.Array, bars: jax.Array
) -> jax.Array:
    """Cotangents of the sums of `holding.hold` times what contacts add to them."""
    return sum_axis(dot(bars[:, None], holding.hold(contacts, force, grip[:, None])), 0)
