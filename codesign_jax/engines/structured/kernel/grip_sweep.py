"""The reverse pass of a step through the friction that fingers hold on one another, see `grip`.

The state after a step is a quotient of sums over contacts, of their forces f(jar(a, theta)).  With
b the cotangents of the sums it adds to the step's derivative two things: -J' K r, with r = b times
the sums' derivative by f, to the cotangent of the accelerations, for which `Virtual` solves; and b
times the sums to the scalar whose derivative by theta is taken (`powers`).
"""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import grip, powers
from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.problem import Problem
from codesign_jax.engines.structured.kernel.pull import only_on, pull
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, holding

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.reverse import ReverseStep


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
            found = grip.sums(pairs, row, still, state.read(step.finger_state, "grip", item))
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
        return powers.held_work(contacts(place, cone), force, held, bars)

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
