"""How an iteration is ended without another one: with the matrix that is there, or with none."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.coupling import Eliminated, solve_palm_again
from codesign_jax.engines.structured.kernel.memory import loop, tree_add_scaled, zeros
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.problem import Iterate, Problem, make_body
from codesign_jax.engines.structured.kernel.rows import Again, FingerState, Hand, Scratch
from codesign_jax.engines.structured.kernel.shared_memory import team_sum
from codesign_jax.engines.structured.lanes import contract, dot, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

LARGEST = 1e-3
"""Decrement of an iteration behind which the next one is likely to be below the tolerance."""


STEADY = 100.0
"""Decrement, over the tolerance, of an iteration that is a GPU's last one if its step is steady.

It is if no contact changes its zone along it: the cost is then quadratic, but for the middle zone,
and the next decrement far smaller.  An H100 does 1.1 times as many grasps of winners; of 8,448
verdicts 0.07 % change, and 0.11 % if the objects are displaced by a micrometre.
"""
LENGTHS = (0.7, 1.4)
"""Lengths of such a step; at others than Newton's, 1, the cost is not quadratic."""


def steady(problem: Problem, alpha: Lanes, between: ContactList | None) -> jax.Array:
    """Whether no contact of a world goes to another zone along the last step, (lane,).

    Args:
      alpha: Length of the step.
      between: Contacts of the hand with itself that count; None for none.
    """
    block = problem.block
    count = zeros((), problem.like)

    def add(item: Item, sums: Lanes, contacts: ContactList) -> Lanes:
        return lanewise(jnp.add, sums, contacts.changes(item, alpha))

    lists = [*problem.dealt, *problem.per_link, *([between] if between else [])]
    for contacts in lists:
        count = contacts.fold(partial(add, contacts=contacts), count)
    if block.team > 1:
        count = team_sum(block, count)
    return block.sum(count).lane == 0


class ChordStep:
    """The chord method's step behind a Newton step, of which the last matrix is left.

    Most time steps end with an iteration whose decrement is already below the tolerance. Its matrix
    is all but that of the iteration before, if no contact has gone to another zone of its cone: the
    cost is quadratic in two of the three zones, and smooth in the third. So the forces that the
    last step has left unbalanced are eliminated with the matrix that is there: the chord method
    (Ortega and Rheinboldt, Iterative Solution of Nonlinear Equations in Several Variables, 1970,
    ch. 7), at a sixth of an iteration's cost, and their decrement is what the iteration would have
    found.

    The matrix P lacks the self-contacts, whose cost is convex: with them the decrement
    is smaller than the one that P gives. Such a world does not go along the step, as P may be too
    soft.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.block = problem.block
        self.links = problem.links
        self.like = problem.like

    def step(
        self, now: Iterate, done: Eliminated, alpha: Lanes, between: ContactList | None
    ) -> tuple[Iterate, Lanes]:
        """The step of wrist, palm and object; leaves the fingers' part in "z_again".

        Args:
          now: The iterate behind the last step, of wrist, palm and object.
          done: What is left of the palm's elimination.
          alpha: Length of the last step, by which those of the links are still to be moved.
          between: Contacts of the hand with itself that count; None without any.

        Returns:
          The step, and the forces' product with it and that of the fingers: the squared decrement.
        """
        problem = self.problem
        if chambers := problem.chambers:
            chambers.move(alpha)
        if problem.sides and between:
            problem.sides.update_wrenches(between, alpha)

        def again(alpha, carry, body, moved, forces, factors, pushes, self_wrench):
            r, ro, work = carry
            axes, armature, *kept = factors
            acc, link_acc = (a + alpha * b for a, b in moved)
            smooth, tau = forces
            push = total([smooth - make_body(*body).times(link_acc), *pushes.values()])
            ro = total([ro, *(-w for name, w in pushes.items() if name == "finger_object")])
            tau = tau - armature * acc
            r = r + push if self_wrench is None else r + push + self_wrench
            y = contract(axes, r[None], 1) + tau
            kept = el.Kept(el.Factors(kept[0], kept[1], kept[0]), kept[2])
            r, ro, new = el.eliminate_again(axes, kept, r, ro, tau)
            return (r, ro, work + dot(y, new.z)), new.z

        def link(i: Any, carry: tuple) -> tuple:
            names = [
                (FingerState.acc, Scratch.step_acc),
                (Scratch.link_acc, Scratch.step_link_acc),
            ]
            moved = [problem.read(*rows, item=i) for rows in names]
            pushes = {c.layout.name: c.wrench(at(i), alpha) for c in problem.per_link}
            self_wrench = problem.sides.wrench_on(i + 1) if problem.sides else None
            factors = problem.read(
                Scratch.axes, Hand.armature, Scratch.w, Scratch.g, Again.inverse, item=i
            )
            forces = problem.read(Scratch.smooth, Scratch.tau, item=i)
            args = alpha, carry, problem.body_of(i), moved, forces, factors, pushes, self_wrench
            carry, z = lanewise(again, *args)
            problem.write(Again.z_again, z, i)
            return carry

        none = zeros((6,), self.like)
        start = none, none, zeros((), self.like)
        r, ro, work = loop(self.links, link, start, self.block.size, reverse=True)
        if chambers:
            r, ro, less = chambers.close_again(Again.z_again, r, ro)
            work = lanewise(jnp.subtract, work, less)
        r = problem.add_palm_wrench(r) if between else r
        r, ro, work = self.block.sum((r, ro, work))
        given = now, problem.palm, done, r, ro, work, self._pushes(alpha)
        step, work = lanewise(self._at_palm, *given)
        if chambers:
            chambers.substitute(Again.z_again, step.palm_acc, step.object_acc)
        return step, work

    def _pushes(self, alpha: Lanes) -> dict[str, Lanes]:
        """Wrenches of the contacts of palm and object, by name."""
        pushes = {}
        for c in self.problem.dealt:

            def add(item: Item, sums: Lanes, c: ContactList = c) -> Lanes:
                return lanewise(jnp.add, sums, c.wrench(item, alpha))

            wrench = c.fold(add, zeros((6,), self.like))
            pushes[c.layout.name] = self.block.sum(wrench)
        return pushes

    @staticmethod
    def _at_palm(now: Iterate, palm, done: Eliminated, r, ro, work, pushes: dict) -> tuple:
        r = r + palm.smooth_palm - palm.palm.times(now.palm_acc)
        ro = ro + palm.smooth_object - palm.object.times(now.object_acc)
        for name, wrench in pushes.items():
            r = r + wrench if name.startswith("palm") else r
            ro = ro - wrench if name == "palm_object" else ro
            ro = ro + wrench if name == "object_table" else ro
        twist = palm.smooth_wrist - palm.armature * now.wrist
        return solve_palm_again(done, palm.axes, palm.armature, r, ro, twist, work)

    def take(self, step: Iterate, alpha: Lanes, taken: jax.Array) -> None:
        """Makes "step_acc" what leads behind the chord's step with length 1, where it is taken.

        Alpha is the length of the Newton step before it.
        """
        problem = self.problem
        mask = lanes([taken], (), wide=True)

        def move(parent, obj, axes, factors, before, alpha, taken):
            a, link_acc = el.substitute(axes, el.Factors(*factors), parent, obj)
            return link_acc, jnp.where(taken, tree_add_scaled(alpha, a, before), before)

        def link(i: Any, parent: Lanes) -> Lanes:
            axes, before = problem.read(Scratch.axes, Scratch.step_acc, item=i)
            factors = problem.read(Scratch.w, Scratch.g, Again.z_again, item=i)
            args = step.object_acc, axes, factors, before, alpha, mask
            link_acc, acc = lanewise(move, parent, *args)
            problem.write(Scratch.step_acc, acc, i)
            if Scratch.chord_link_acc in problem.memory.scratch:
                change = lanewise(lambda t, v: jnp.where(t, v, 0.0), mask, link_acc)
                problem.write(Scratch.chord_link_acc, change, i)
            return link_acc

        loop(self.links, link, problem.widened(step.palm_acc), self.block.size)
