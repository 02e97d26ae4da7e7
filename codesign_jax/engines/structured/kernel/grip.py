"""Friction that fingers hold on one another from step to step, in the kernel.

Its law is `holding.held`.  The state has three numbers for each pairing of the fingers, "grip" of
both fingers' lanes, equal and opposite: all contacts of two fingers share it.  A step leaves what
it ends with in "new_grip".
"""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.problem import Problem
from codesign_jax.engines.structured.kernel.slots import any_of, only
from codesign_jax.engines.structured.kernel.solver import tree_add_scaled
from codesign_jax.engines.structured.kernel.teams import team_sum
from codesign_jax.engines.structured.lanes import sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, holding

if TYPE_CHECKING:
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
