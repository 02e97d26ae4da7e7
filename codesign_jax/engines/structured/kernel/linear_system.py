"""Eliminates the fingers from their tips, then wrist and object: Newton's linear system."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.coupling import Eliminated
from codesign_jax.engines.structured.kernel.memory import choose, either, full, loop, upper, zeros
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.problem import Iterate, Palm, Problem, make_body
from codesign_jax.engines.structured.kernel.rows import Again, FingerState, Hand, Scratch
from codesign_jax.engines.structured.kernel.sides import Sides
from codesign_jax.engines.structured.lanes import contract, dot, sum_fingers, total
from codesign_jax.engines.structured.lanewise import Lanes, lanewise


def load_link(node, body, link_acc, smooth, self_wrench):
    """Adds a link's inertia, and the forces that its acceleration leaves unbalanced, to a node."""
    link = make_body(*body)
    push = smooth - link.times(link_acc)
    push = push if self_wrench is None else push + self_wrench
    return node._replace(p=node.p + link.matrix(), r=node.r + push)


def eliminate_joint(node, axes, armature, tau, acc):
    """Eliminates a joint; with the product of its force and its step."""
    tau = tau - armature * acc
    y = contract(axes, node.r[None], 1) + tau
    node, kept = el.eliminate(node, axes, armature, tau)
    return node, kept, dot(y, kept.factors.z)


def eliminate_free_joint(node, *forces):
    """`eliminate_joint` of a subtree that does not touch the object: c, q and r_object are 0."""
    new, kept, more = eliminate_joint(node._replace(c=None), *forces)
    factors = kept.factors._replace(g=jnp.zeros_like(kept.factors.w))
    return new._replace(c=node.c), kept._replace(factors=factors), more


class Elimination:
    """The elimination of one step's problem."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.block = problem.block
        self.links = problem.links
        self.like = problem.like

    def backward(self, alpha: Lanes, between: ContactList | None) -> tuple[el.Quadratic, Lanes]:
        """Eliminates the fingers from their tips.

        Accelerations and jar move by `alpha`, the length of the last step, first: so they
        are read once an iteration.

        Args:
          alpha: Length of the last step, lanes of a world.
          between: Contacts of the hand with itself that count; None without any.

        Returns:
          The sum over the fingers, and the product of their forces with the step so far.
        """
        problem = self.problem
        if problem.chambers:
            problem.chambers.move(alpha)
        if problem.sides and between:
            self.between_fingers(problem.sides, between, alpha)

        def step(i: Any, carry: tuple) -> tuple:
            node, work = carry
            acc, link_acc = self.accelerations(i, alpha)
            smooth, tau = self.smooth(i)
            axes, armature = problem.read(Scratch.axes, Hand.armature, item=i)
            self_wrench = problem.sides.wrench_on(i + 1) if problem.sides else None
            node = node._replace(p=full(node.p), q=full(node.q))
            node = lanewise(load_link, node, problem.body_of(i), link_acc, smooth, self_wrench)
            for contacts in problem.per_link:
                node = self.add_contacts(node, contacts, at(i), alpha)
            forces = axes, armature, tau, acc

            def eliminated(eliminate: Callable) -> tuple[el.Quadratic, Lanes]:
                new, kept, more = lanewise(eliminate, node, *forces)
                for name, value in zip(
                    (Scratch.w, Scratch.g, Scratch.z), kept.factors, strict=True
                ):
                    problem.write(name, value, i)
                if between or problem.chambers:
                    problem.write(Again.inverse, kept.inverse, i)
                return new._replace(p=upper(new.p), q=upper(new.q)), more

            ways = (partial(eliminated, eliminate_joint), partial(eliminated, eliminate_free_joint))
            if last_touching is None:
                node, more = ways[1]()
            else:
                node, more = either(i <= last_touching, *ways, self.block.size)
            return node, lanewise(jnp.add, work, more) if between else work

        empty = [zeros(s, self.like) for s in ((21,), (6, 6), (21,), (6,), (6,))]
        start = (el.Quadratic(*empty), zeros((), self.like))
        last_touching = self.last_on_object()
        node, work = loop(self.links, step, start, self.block.size, reverse=True)
        if problem.chambers:
            node, work = problem.chambers.close(node, work)
        if between:
            node = node._replace(r=problem.add_palm_wrench(node.r))
            work = self.block.sum(work)
        node = self.block.sum(node)
        return node._replace(p=full(node.p), q=full(node.q)), work

    # What is on the right side: here the forces that an iterate leaves unbalanced

    def accelerations(self, i: Any, alpha: Lanes) -> list[Lanes]:
        """Accelerations of a joint and of the link behind it."""
        return [self.problem.move(name, i, alpha) for name in (FingerState.acc, Scratch.link_acc)]

    def smooth(self, i: Any) -> list[Lanes]:
        """Smooth forces on a link and on the joint before it."""
        return self.problem.read(Scratch.smooth, Scratch.tau, item=i)

    def of_contacts(self, contacts: ContactList, item: Item, alpha: Lanes) -> tuple[Lanes, Lanes]:
        """Contact inertia (6, 6, ...) and wrench (6, ...) of an item's contacts at a step's length.

        Args:
          contacts: A contact list.
          item: The item: a link, or a group.
          alpha: Length of the last Newton step, by which jar is still behind, lanes of a world.
        """
        return contacts.inertia_and_wrench(item, alpha)

    def between_fingers(self, sides: Sides, between: ContactList, alpha: Lanes) -> None:
        """Lays the forces of the hand's contacts with itself on their sides."""
        sides.update_constraints(between, alpha)

    def add_contacts(
        self, node: el.Quadratic, contacts: ContactList, item: Item, alpha: Lanes
    ) -> Any:
        def add() -> el.Quadratic:
            return lanewise(
                _add, node, *self.of_contacts(contacts, item, alpha), contacts.layout.on_object
            )

        return choose(contacts.touching(item), add, node, self.block.size)

    def last_on_object(self) -> jax.Array | None:
        """Last link with contacts with the object, -1 for none; None if the scene has none."""
        on_object = [c for c in self.problem.per_link if c.layout.on_object]

        def later(i: Any, last: jax.Array) -> jax.Array:
            return jnp.where(on_object[0].touching(at(i)), jnp.asarray(i, jnp.int32), last)

        return jax.lax.fori_loop(0, self.links, later, jnp.int32(-1)) if on_object else None

    def of_dealt_contacts(self, alpha: Lanes) -> dict[str, tuple[Lanes, Lanes]]:
        """Contact inertia and wrench of the palm's and the object's contacts; see `backward`."""
        pushes = {}
        for c in self.problem.dealt:

            def add(item: Item, carry: tuple, c: ContactList = c) -> tuple:
                matrix, wrench = self.of_contacts(c, item, alpha)
                return lanewise(
                    lambda a, b: jax.tree.map(jnp.add, a, b), carry, (upper(matrix), wrench)
                )

            start = (zeros((21,), self.like), zeros((6,), self.like))
            triangle, wrench = self.block.sum(c.fold(add, start))
            pushes[c.layout.name] = (full(triangle), wrench)
        return pushes

    def at_palm(self, now: Iterate, node: el.Quadratic, slots: dict) -> tuple[Iterate, Eliminated]:
        """Solves for wrist and object; slots: what `of_dealt_contacts` returns."""
        rigid = self.problem.rigid

        def solve(now: Iterate, palm: Palm, node: el.Quadratic, pushes: dict) -> tuple:
            node, wrist = with_palm(now, palm, node, pushes)
            if rigid:
                obj = el.solve_object(node.q, node.r_object)
                none = jnp.zeros_like(obj)
                step = Iterate(none, none, obj)
                return step, Eliminated(None, None, node.q, dot(node.r_object, obj))
            armature = palm.armature
            work = []
            axes = (palm.axes, el.wrist_slides(armature))
            kept = []
            for subspace, inertia, twist in zip(
                axes, (armature[3:], armature[:3]), (wrist[3:], wrist[:3]), strict=True
            ):
                y = contract(subspace, node.r[None], 1) + twist
                node, new = el.eliminate(node, subspace, inertia, twist)
                kept.append(new)
                work.append(dot(y, new.factors.z))
            obj = el.solve_object(node.q, node.r_object)
            first, slides_acc = el.substitute(axes[1], kept[1].factors, jnp.zeros_like(obj), obj)
            second, palm_acc = el.substitute(axes[0], kept[0].factors, slides_acc, obj)
            step = Iterate(jnp.concatenate([first, second]), palm_acc, obj)
            work = total([*work, dot(node.r_object, obj)])
            return step, Eliminated(kept[0], kept[1], node.q, work)

        step, done = lanewise(solve, now, self.problem.palm, node, slots)
        if self.problem.chambers:
            self.problem.chambers.substitute(Scratch.z, step.palm_acc, step.object_acc)
        return step, done


def with_palm(
    now: Iterate, palm: Palm, node: el.Quadratic, pushes: dict
) -> tuple[el.Quadratic, Any]:
    """Adds palm and object, and what acts on them, to the fingers.

    Returns:
      The objective, and the forces that an iterate leaves unbalanced on the wrist's joints.
    """
    push, pull, twist = palm.unbalanced(now)
    inertia_of_palm = palm.palm.matrix()
    obj = palm.object.matrix()
    p, c, q, r, ro = (sum_fingers(v) for v in node)
    p = p + inertia_of_palm
    r = r + push
    q = q + obj
    ro = ro + pull
    if "object_table" in pushes:
        inertia, wrench = pushes["object_table"]
        q = q + inertia
        ro = ro + wrench
    if "palm_table" in pushes:
        inertia, wrench = pushes["palm_table"]
        p = p + inertia
        r = r + wrench
    if "palm_object" in pushes:
        inertia, wrench = pushes["palm_object"]
        p = p + inertia
        c = c + inertia
        q = q + inertia
        r = r + wrench
        ro = ro - wrench
    return el.Quadratic(p, c, q, r, ro), twist


def _add(node: el.Quadratic, matrix, wrench, on_object: bool) -> el.Quadratic:
    p, c, q, r, ro = node
    p = p + matrix
    r = r + wrench
    if on_object:
        c = c + matrix
        q = q + matrix
        ro = ro - wrench
    return el.Quadratic(p, c, q, r, ro)
