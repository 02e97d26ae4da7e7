"""How far to go along a Newton step: the cost's slopes along it, and where it is lowest."""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.memory import anywhere, loop, solid, zeros
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.problem import (
    Iterate,
    Palm,
    Problem,
    make_body,
    relative,
)
from codesign_jax.engines.structured.kernel.rows import FingerState, Hand, Scratch, Side
from codesign_jax.engines.structured.lanes import dot, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

FAR = 3e38
"""No upper end of a bracket yet; finite, as a GPU kernel has no test for infinity."""
LINE_TOLERANCE = 0.01
"""Slope at which a line search ends, over the first one: MuJoCo's default `ls_tolerance`."""


class LineSearch:
    """The line search of one step's problem."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.block = problem.block
        self.links = problem.links
        self.like = problem.like

    def prepare(
        self, now: Iterate, step: Iterate, between: ContactList | None
    ) -> tuple[Lanes, Lanes, Lanes]:
        """Substitutes back and prepares the line search.

        Args:
          now: The iterate.
          step: The Newton step of wrist, palm and object.
          between: Contacts of the hand with itself that count; None without any.

        Returns:
          Slope and curvature of the smooth part, and the contacts' slope, all at 0, (1, world).
        """
        problem = self.problem

        def substitute(parent, obj, body, link_acc, smooth, tau, axes, armature, acc, factors):
            a, moved = el.substitute(axes, el.Factors(*factors), parent, obj)
            link = make_body(*body)
            force = smooth - link.times(link_acc)
            joints = [(armature[k] * acc[k] - tau[k]) * a[k] for k in range(a.shape[0])]
            slope = total(joints) - dot(force, moved)
            stiff = total([armature[k] * a[k] * a[k] for k in range(a.shape[0])])
            return a, moved, slope, stiff + dot(link.times(moved), moved)

        def link(i: Any, carry: tuple) -> tuple:
            parent, slope, curvature, contact_slope = carry
            names = (
                Scratch.link_acc,
                Scratch.smooth,
                Scratch.tau,
                Scratch.axes,
                Hand.armature,
                FingerState.acc,
            )
            a, moved, s, c = lanewise(
                substitute,
                parent,
                step.object_acc,
                problem.body_of(i),
                *problem.read(*names, item=i),
                problem.read(Scratch.w, Scratch.g, Scratch.z, item=i),
            )
            problem.write(Scratch.step_acc, a, i)
            problem.write(Scratch.step_link_acc, moved, i)
            if problem.sides:
                problem.sides.put(Side.link_acc, moved, i + 1)
            terms = [contact_slope]
            for contacts in problem.per_link:
                rel = relative(contacts.layout.name, moved, step.palm_acc, step.object_acc)
                terms.append(contacts.prepare_linesearch(at(i), rel))
            contact_slope = lanewise(lambda t: total(t), terms)
            slope, curvature = lanewise(lambda a, b, c, d: (a + b, c + d), slope, s, curvature, c)
            return moved, slope, curvature, contact_slope

        none = zeros((), self.like)
        parent = problem.widened(step.palm_acc)
        if problem.sides:
            problem.sides.put(Side.link_acc, parent, 0)
        _, slope, curvature, contact_slope = loop(
            self.links, link, (parent, none, none, none), self.block.size
        )
        if problem.chambers:
            curvature = lanewise(jnp.add, curvature, problem.chambers.curvature())
        slopes = [contact_slope]
        if problem.sides and between:
            slopes.append(problem.sides.prepare_all(between))
        contact_slope = lanewise(lambda t: total(t), slopes)
        contact_slope = self.prepare_slots(contact_slope, step)
        slope, curvature, contact_slope = self.block.sum((slope, curvature, contact_slope))
        slope, curvature = lanewise(with_palm_and_object, now, step, problem.palm, slope, curvature)
        return slope, curvature, contact_slope

    def prepare_slots(self, touch: Lanes, step: Iterate) -> Lanes:
        """Adds the slopes of the palm's and the object's contacts along the step."""
        for contacts in self.problem.dealt:

            def add(item: Item, sum_: Lanes, contacts: ContactList = contacts) -> Lanes:
                rel = relative(contacts.layout.name, None, step.palm_acc, step.object_acc)
                return lanewise(jnp.add, sum_, contacts.prepare_linesearch(item, rel))

            touch = contacts.fold(add, touch)
        return touch

    def total(self, sums: list[Lanes]) -> list[Lanes]:
        """Sums of lanes over the fingers of each world."""
        return self.block.sum(sums)

    def contact_slopes(self, alpha: Lanes, between: ContactList | None) -> list[Lanes]:
        """First and second derivative of the contacts' cost by the step length, at alpha.

        Args:
          alpha: Length of the step, lanes of a world.
          between: As in `prepare`.
        """

        def add(item: Item, sums: list, lists: list) -> list:
            for contacts in lists:
                new = contacts.slopes(item, alpha)
                sums = lanewise(lambda a, b: jax.tree.map(jnp.add, a, b), sums, new)
            return sums

        problem = self.problem
        sums = [zeros((), self.like)] * 2
        if lists := problem.per_link:
            sums = loop(self.links, lambda i, s: add(at(i), s, lists), sums, self.block.size)
        for c in problem.dealt:
            sums = c.fold(lambda item, s, c=c: add(item, s, [c]), sums)
        if between:
            sums = between.slopes_of_all(alpha, sums)
        return sums

    def find(
        self,
        slope: Lanes,
        curvature: Lanes,
        first: Lanes,
        floor: jax.Array,
        evaluations: int,
        between: ContactList | None,
    ) -> Lanes:
        """Step length, lanes of a world.

        Args:
          slope: Slope of the smooth part at 0; `curvature`: its curvature; `first`: slope of the
            contacts.
          floor: Slope that is small enough.
          evaluations: Largest number of evaluations.
          between: As in `prepare`.
        """

        def evaluate(alpha: Lanes, among: ContactList | None) -> tuple[Lanes, Lanes]:
            of_contacts = self.total(self.contact_slopes(alpha, among))
            return lanewise(with_contacts, slope, curvature, alpha, *of_contacts)

        def body(carry: list) -> list:
            count = carry[0]
            old = rebuild(carry[1:])
            # A world that has found its step length keeps it: it must not depend on other worlds.
            left = jnp.abs(carry[-1]) > goal
            searching = lanes([left], (), wide=False)
            derivative, second = evaluate(old[0], between.masked(left) if between else None)
            new = (*lanewise(refine, *old[:3], derivative, second), derivative)
            new = [lanewise(jnp.where, searching, a, b) for a, b in zip(new, old, strict=True)]
            return [count + 1, *solid(tuple(new), self.block.size)[0]]

        def going(carry: list) -> jax.Array:
            return (carry[0] < evaluations) & anywhere(jnp.abs(carry[-1]) > goal)

        goal = jnp.maximum(floor, LINE_TOLERANCE * jnp.abs(lanewise(jnp.add, slope, first).lane))
        unit = lanewise(jnp.ones_like, slope)
        none = lanewise(jnp.zeros_like, slope)
        far = lanewise(lambda x: jnp.full_like(x, FAR), slope)
        start, rebuild = solid((unit, none, far, far), self.block.size)
        return rebuild(jax.lax.while_loop(going, body, [jnp.int32(0), *start])[1:])[0]


def with_palm_and_object(now: Iterate, step: Iterate, palm: Palm, slope, curvature):
    """Adds wrist, palm and object to the smooth part's slope and curvature."""
    push, pull, twist = palm.unbalanced(now)
    slope = slope - dot(push, step.palm_acc) - dot(pull, step.object_acc)
    slope = slope - dot(twist, step.wrist)
    bent = dot(palm.palm.times(step.palm_acc), step.palm_acc)
    bent = bent + dot(palm.object.times(step.object_acc), step.object_acc)
    return slope, curvature + bent + dot(palm.armature * step.wrist, step.wrist)


def with_contacts(slope, curvature, alpha, contact_slope, contact_curvature):
    """Slope at alpha of the smooth part and of contacts, and curvature."""
    return slope + alpha * curvature + contact_slope, curvature + contact_curvature


def refine(
    alpha: jax.Array, low: jax.Array, high: jax.Array, first: jax.Array, second: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Next step length and bracket from the derivatives at alpha: Newton, else bisection."""
    low = jnp.where(first <= 0, alpha, low)
    high = jnp.where(first > 0, alpha, high)
    guess = alpha - first / jnp.maximum(second, 1e-30)
    inside = (guess >= low) & (guess <= high)
    middle = jnp.where(high > 1e30, 2.0 * low, 0.5 * (low + high))
    return jnp.where(inside, guess, middle), low, high
