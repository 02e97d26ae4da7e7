"""How far to go along a Newton step: the cost's slopes along it, and where it is lowest."""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel.contact_sets import BoundContacts, zeros
from codesign_jax.engines.structured.kernel.memory import anywhere, loop, solid
from codesign_jax.engines.structured.kernel.problem import (
    Iterate,
    Palm,
    Problem,
    make_body,
    relative,
)
from codesign_jax.engines.structured.kernel.slots import only
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

    def prepare(self, now: Iterate, step: Iterate) -> tuple[Lanes, Lanes, Lanes]:
        """Substitutes back and prepares the line search.

        Returns:
          Slope and curvature of the smooth part, and the contacts' slope, all at 0, (1, world).
        """
        problem = self.problem

        def substitute(parent, obj, body, motion, smooth, tau, axes, armature, acc, factors):
            a, moved = el.substitute(axes, el.Factors(*factors), parent, obj)
            link = make_body(*body)
            force = smooth - link.times(motion)
            joints = [(armature[k] * acc[k] - tau[k]) * a[k] for k in range(a.shape[0])]
            slope = total(joints) - dot(force, moved)
            stiff = total([armature[k] * a[k] * a[k] for k in range(a.shape[0])])
            return a, moved, slope, stiff + dot(link.times(moved), moved)

        def link(i: Any, carry: tuple) -> tuple:
            parent, slope, curvature, contact_slope = carry
            names = ("motion", "smooth", "tau", "axes", "armature", "acc")
            a, moved, s, c = lanewise(
                substitute,
                parent,
                step.object_motion,
                problem.body_of(i),
                *problem.read(*names, item=i),
                problem.read("w", "g", "z", item=i),
            )
            problem.write("step_acc", a, i)
            problem.write("step_motion", moved, i)
            if problem.finger_pairs:
                problem.finger_pairs.put("motion", moved, i + 1)
            terms = [contact_slope]
            for contacts in problem.per_link:
                rel = relative(contacts.set.name, moved, step.palm_motion, step.object_motion)
                terms.append(contacts.prepare_linesearch(i, rel))
            contact_slope = lanewise(lambda t: total(t), terms)
            slope, curvature = lanewise(lambda a, b, c, d: (a + b, c + d), slope, s, curvature, c)
            return moved, slope, curvature, contact_slope

        none = zeros((), self.like)
        parent = problem.widened(step.palm_motion)
        if problem.finger_pairs:
            problem.finger_pairs.put("motion", parent, 0)
        _, slope, curvature, contact_slope = loop(
            self.links, link, (parent, none, none, none), self.block.size
        )
        if problem.chambers:
            curvature = lanewise(jnp.add, curvature, problem.chambers.curvature())
        between = [problem.finger_pairs.prepare_all()] if problem.finger_pairs else []
        contact_slope = lanewise(lambda t: total(t), [contact_slope, *between])
        contact_slope = self.prepare_slots(contact_slope, step)
        slope, curvature, contact_slope = self.block.sum((slope, curvature, contact_slope))
        slope, curvature = lanewise(_rest, now, step, problem.palm, slope, curvature)
        return slope, curvature, contact_slope

    def prepare_slots(self, touch: Lanes, step: Iterate) -> Lanes:
        """Adds the slopes of the palm's and the object's contacts along the step."""
        for contacts in self.problem.dealt:

            def add(i: Any, sum_: Lanes, contacts: BoundContacts = contacts) -> Lanes:
                rel = relative(contacts.set.name, None, step.palm_motion, step.object_motion)
                return lanewise(jnp.add, sum_, contacts.prepare_linesearch(i, rel))

            touch = loop(contacts.set.count, add, touch, self.block.size)
        return touch

    def total(self, sums: list[Lanes]) -> list[Lanes]:
        return self.block.sum(sums)

    def contact_slopes(self, alpha: Lanes) -> list[Lanes]:
        """First and second derivative of the contacts' cost by the step length, at alpha."""

        def add(i: Any, sums: list, sets: list) -> list:
            for contacts in sets:
                new = contacts.slopes(i, alpha)
                sums = lanewise(lambda a, b: jax.tree.map(jnp.add, a, b), sums, new)
            return sums

        problem = self.problem
        sums = [zeros((), self.like)] * 2
        if sets := problem.per_link:
            sums = loop(self.links, lambda i, s: add(i, s, sets), sums, self.block.size)
        for c in problem.dealt:
            sums = loop(c.set.count, lambda i, s, c=c: add(i, s, [c]), sums, self.block.size)
        if problem.finger_pairs:
            sums = problem.finger_pairs.slopes_of_all(alpha, sums)
        return sums

    def find(
        self, slope: Lanes, curvature: Lanes, first: Lanes, floor: jax.Array, evaluations: int
    ) -> Lanes:
        """Step length, lanes of a world.

        Args:
          slope: Slope of the smooth part at 0; `curvature`: its curvature; `first`: slope of the
            contacts.
          floor: Slope that is small enough.
          evaluations: Largest number of evaluations.
        """

        def evaluate(alpha: Lanes) -> tuple[Lanes, Lanes]:
            of_contacts = self.total(self.contact_slopes(alpha))
            return lanewise(with_contacts, slope, curvature, alpha, *of_contacts)

        def body(carry: list) -> list:
            count = carry[0]
            old = rebuild(carry[1:])
            # A world that has found its step length keeps it: it must not depend on other worlds.
            left = jnp.abs(carry[-1]) > goal
            searching = lanes([left], (), wide=False)
            with only(self.problem.in_slots, left):
                derivative, second = evaluate(old[0])
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


def _rest(now: Iterate, step: Iterate, palm: Palm, slope, curvature):
    """Adds wrist, palm and object to the smooth part's slope and curvature."""
    push, pull, twist = palm.unbalanced(now)
    slope = slope - dot(push, step.palm_motion) - dot(pull, step.object_motion)
    slope = slope - dot(twist, step.wrist)
    bent = dot(palm.palm.times(step.palm_motion), step.palm_motion)
    bent = bent + dot(palm.object.times(step.object_motion), step.object_motion)
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
