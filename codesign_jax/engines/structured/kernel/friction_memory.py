"""Friction that fingers hold on one another from step to step, in the kernel and in its adjoint.

Its law is `holding.held`.  The state has three numbers for each pairing of the fingers, "grip" of
both fingers' lanes, equal and opposite: all contacts of two fingers share it.  A step leaves what
it ends with in "new_grip".

The state after a step is a quotient of sums over contacts, of their forces f(jar(a, theta)).  With
b the cotangents of the sums it adds to the step's derivative two things: -J' K r, with r = b times
the sums' derivative by f, to the cotangent of the accelerations, for which `AdjointSolve` solves;
and b times the sums to the scalar whose derivative by theta is taken (`residual`).
"""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.cotangents import only_on, pull
from codesign_jax.engines.structured.kernel.finger_contacts import BoundPairs, Pairing
from codesign_jax.engines.structured.kernel.memory import tree_add_scaled
from codesign_jax.engines.structured.kernel.problem import Problem
from codesign_jax.engines.structured.kernel.shared_memory import team_sum
from codesign_jax.engines.structured.kernel.slots import any_of, only
from codesign_jax.engines.structured.lanes import dot, sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, holding

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.adjoint_step import ReverseStep
    from codesign_jax.engines.structured.kernel.step import Step


def kept(problem: Problem) -> bool:
    """Whether the scene has it."""
    return "new_grip" in problem.m.scratch.groups


def of_row(step: "Step", pairs: BoundPairs, row: Any) -> list[Lanes]:
    """What the fingers of a pairing's row hold, (3,) or nothing if the scene has no such state."""
    if not step.p.held:
        return []
    return [step.p.finger_state.read(step.finger_state, "grip", row + pairs.set.first)]


def clear(step: "Step") -> None:
    """Begins a step: fingers that do not touch hold nothing."""
    like = jnp.zeros((step.p.size,), step.finger_state.dtype)
    for item in range(step.p.held):
        step.p.scratch.write(step.scratch, "new_grip", zeros((3,), like), item)


def store(step: "Step", good: jax.Array) -> None:
    """Ends a step of the worlds that have moved."""
    state, mask = step.p.finger_state, lanes([good], (), wide=False)
    for item in range(step.p.held):
        new = step.p.scratch.read(step.scratch, "new_grip", item)
        old = state.read(step.finger_state, "grip", item)
        state.write(step.finger_state, "grip", lanewise(jnp.where, mask, new, old), item)


def sums(pairs: BoundPairs, row: Any, alpha: Lanes, grip: Lanes) -> Lanes:
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

    found = pairs.fold(row, one, zeros((4,), jnp.zeros((pairs.set.size,), pairs.ref.dtype)))
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


def reverse(step: "ReverseStep", pairs: BoundPairs, go: Lanes) -> None:
    """Cotangents of the sums of `holding.hold`, of those of the state after the step.

    Leaves them as "grip_bar", and the state's as those before a step of which contacts add their
    part (`leave`).  What a finger holds is the opposite of what its partner holds.

    Args:
      step: The step.
      pairs: Its contacts, at the accelerations of the step.
      go: Worlds that took it.
    """
    state, still = step.p.finger_state, zeros((), step.like)

    for item in range(step.p.held):
        row, mine = item - pairs.set.first, state.read(step.bars.finger_state, "grip", item)
        bars = zeros((4,), step.like)
        if 0 <= row < pairs.set.rows:
            found = sums(pairs, row, still, state.read(step.finger_state, "grip", item))
            theirs = pairs.pairing(row).swap(mine)
            both = lanewise(jnp.subtract, mine, theirs) if item else mine
            (bars,) = pull(holding.quotient, (found,), (), only_on(go, both))
        step.p.scratch.write(step.scratch, "grip_bar", bars, item)
        rest = only_on(lanewise(jnp.logical_not, go), mine)
        state.write(step.bars.finger_state, "grip", rest, item)


def _item(pairing: Pairing) -> jax.Array:
    """Number of a pairing's state on the lanes."""
    return pairing.number


def at(step: "ReverseStep", pairing: Pairing) -> tuple[Lanes, ...]:
    """What the lanes' fingers hold, and "grip_bar"; nothing if the scene has no such state."""
    if not step.p.held:
        return ()
    item, lane, p = _item(pairing), step.block.lane, step.p
    held = p.finger_state.gather(step.finger_state, "grip", item, lane)
    return held, p.scratch.gather(step.scratch, "grip_bar", item, lane)


def leave(step: "ReverseStep", pairing: Pairing, found: tuple) -> None:
    """Adds a contact's cotangents of `at` to those of the state."""
    if not found:
        return
    item, lane, state = _item(pairing), step.block.lane, step.p.finger_state
    old = state.gather(step.bars.finger_state, "grip", item, lane)
    new = lanewise(jnp.add, old, found[0])
    state.scatter(step.bars.finger_state, "grip", new, item, lane)


def push(problem: Problem, pairs: BoundPairs) -> None:
    """Loads the links with what "grip_bar" asks of the step's accelerations.

    A change of jar changes a contact's force by -K; with r the derivative of the sums by the
    force, the cotangent of jar is -K r.
    """
    (table, ref), (state, own) = problem.m.table("grip_bar"), problem.m.table("grip")
    contacts, lane = pairs.set.contacts, problem.block.lane

    def of_held(force, place, cone, held, bars):
        return held_work(contacts(place, cone), force, held, bars)

    def load(item: Any, pairing: Pairing) -> None:
        which, side, jar = _item(pairing), pairs.own_side(item), pairs.read("jar", item)

        def response(place, cone, jar):
            return contact.constraint_update(contacts(place, cone), jar).force

        force = lanewise(response, side.place, pairs.cone, jar)
        held = state.gather(own, "grip", which, lane)
        bars = table.gather(ref, "grip_bar", which, lane)
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
