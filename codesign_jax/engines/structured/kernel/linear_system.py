"""Eliminates the fingers from their tips, then wrist and object: Newton's linear system."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import BoundContacts, zeros
from codesign_jax.engines.structured.kernel.coupling import Eliminated
from codesign_jax.engines.structured.kernel.memory import choose, either, full, loop, upper
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.problem import Iterate, Palm, Problem, make_body
from codesign_jax.engines.structured.kernel.slots import BoundSlots
from codesign_jax.engines.structured.lanes import contract, dot, total
from codesign_jax.engines.structured.lanewise import Lanes, lanewise
from codesign_jax.engines.structured.linear import elimination as el
from codesign_jax.engines.structured.linear.tree import Forces, Matrices


class Row(NamedTuple):
    """What a row of the hull adds to the elimination.

    Attributes:
      held: Whether its contacts are with the object.
      used: Whether there are any, a scalar.
      terms: What they add to the row's joint.
      matrix: Contact inertia of the link before it, upper triangle (21,).
      force: Its wrench.
    """

    held: bool
    used: jax.Array
    terms: el.JointTerms
    matrix: Lanes
    force: Lanes


class Elimination:
    """The elimination of one step's problem."""

    def __init__(self, problem: Problem):
        """Takes the problem."""
        self.problem = problem
        self.block, self.links, self.like = problem.block, problem.links, problem.like

    def backward(self, alpha: Lanes) -> tuple[el.Quadratic, Lanes]:
        """Eliminates the fingers from their tips.

        Args:
          alpha: Length of the last step, by which accelerations, motions and jar move first: so
            they are read once an iteration.

        Returns:
          The sum over the fingers, and the product of their forces with the step so far.
        """
        problem = self.problem
        if problem.pairs:
            self.between_fingers(problem.pairs, alpha)

        def eliminate(node, body, motion, smooth, tau, axes, armature, acc, pushes, terms, pairs):
            link = make_body(*body)
            push, tau = smooth - link.times(motion), tau - armature * acc
            if pairs is not None:
                wrench, turned = pairs
                push = push + wrench
                tau = tau if turned is None else tau + contract(axes[:, :3], turned[None], 1)
            node = el.add_link(node, el.link_terms(link.matrix(), push, pushes))
            y = contract(axes, node.r[None], 1) + tau
            node, kept = el.eliminate(node, axes, armature, tau, terms)
            if terms is not None:
                y = y + terms.y
            return node, kept, dot(y, kept.factors.z)

        def free(node, *forces):
            """`eliminate` where the subtree does not touch the object: c, q and r_object are 0."""
            new, kept, more = eliminate(node._replace(c=None), *forces)
            factors = kept.factors._replace(g=jnp.zeros_like(kept.factors.w))
            return new._replace(c=node.c), kept._replace(factors=factors), more

        def step(i: Any, carry: tuple) -> tuple:
            node, work = carry
            acc, motion = self.accelerations(i, alpha)
            pushes = {c.set.name: self.push(c, i, alpha) for c in problem.fingers}
            smooth, tau = self.smooth(i)
            axes, armature = problem.read("axes", "armature", item=i)
            node = node._replace(p=full(node.p), q=full(node.q))
            rows = [self.row(c, i, axes, alpha) for c in problem.skin]
            terms = add_terms([r.terms for r in rows]) if rows else None
            pairs = problem.pair_push(i) if problem.pairs else None
            forces = (motion, smooth, tau, axes, armature, acc, pushes, terms, pairs)
            forces = (problem.body_of(i), *forces)

            def eliminated(how: Callable) -> tuple[el.Quadratic, Lanes]:
                new, kept, more = lanewise(how, node, *forces)
                for name, value in zip(("w", "g", "z"), kept.factors, strict=True):
                    problem.write(name, value, i)
                if problem.slotted:
                    problem.write("inverse", kept.inverse, i)
                return new._replace(p=upper(new.p), q=upper(new.q)), more

            ways = (partial(eliminated, eliminate), partial(eliminated, free))
            node, more = either(i <= held, *ways, self.block.size) if rows else ways[0]()
            if problem.pairs:
                work = lanewise(jnp.add, work, more)
            return self.add_rows(node, rows), work

        empty = [zeros(s, self.like) for s in ((21,), (6, 6), (21,), (6,), (6,))]
        tip = [self.row(c, self.links, None, alpha) for c in problem.skin]
        node = self.add_rows(el.Quadratic(*empty), tip)
        start, held = (node, zeros((), self.like)), self.last_on_object()
        node, work = loop(self.links, step, start, self.block.size, reverse=True)
        if problem.pairs:
            node, work = node._replace(r=problem.add_first(node.r)), self.block.sum(work)
        node = self.block.sum(node)
        return node._replace(p=full(node.p), q=full(node.q)), work

    # What is on the right side: here the forces that an iterate leaves unbalanced

    def accelerations(self, i: Any, alpha: Lanes) -> list[Lanes]:
        """Accelerations of a joint and of the link behind it."""
        return [self.problem.move(name, i, alpha) for name in ("acc", "motion")]

    def smooth(self, i: Any) -> list[Lanes]:
        """Smooth forces on a link and on the joint before it."""
        return self.problem.read("smooth", "tau", item=i)

    def push(self, contacts: BoundContacts, item: Any, alpha: Lanes) -> tuple[Lanes, Lanes]:
        """Inertia and wrench of an item's contacts, see `BoundContacts.push`."""
        return contacts.push(item, alpha)

    def between_fingers(self, pairs: BoundPairs, alpha: Lanes) -> None:
        """Prepares contacts between fingers, see `BoundPairs.update_constraints`."""
        pairs.update_constraints(alpha)

    # Rows of the hull

    def row(self, slots: BoundSlots, row: Any, axes: Lanes | None, alpha: Lanes) -> "Row":
        """What a row of the hull adds to the elimination, see `hull.row_terms`.

        Args:
          slots: The row's contacts with the object or the table.
          row: The row.
          axes: Motion subspace of its joint; None for the tip, which has none.
          alpha: Length of the last step.
        """
        number = 1 if axes is None else axes.shape[0]
        shapes = ((number, number), (number, 6), (number, 6), (number,), (21,), (6,))
        empty = [zeros(s, self.like) for s in shapes]
        used = slots.used(row) > 0

        def compute() -> list[Lanes]:
            inertia, wrench = self.push(slots, row, alpha)
            if axes is None:
                return [*empty[:4], upper(inertia[:6, :6]), wrench[:6]]
            terms, matrix, force = lanewise(el.row_terms, axes, inertia, wrench)
            return [*terms, upper(matrix), force]

        *terms, matrix, force = choose(used, compute, empty, self.block.size)
        if not slots.set.on_object:
            terms[2] = zeros(shapes[2], self.like)
        return Row(slots.set.on_object, used, el.JointTerms(*terms), matrix, force)

    def last_on_object(self) -> jax.Array:
        """Last row of the hull with contacts with the object, a scalar; -1 if there is none."""
        held = [c for c in self.problem.skin if c.set.on_object]

        def later(row: Any, last: jax.Array) -> jax.Array:
            used = [c.used(row) > 0 for c in held]
            return jnp.where(used[0], jnp.asarray(row, jnp.int32), last) if used else last

        return jax.lax.fori_loop(0, self.links + 1, later, jnp.int32(-1))

    def add_rows(self, node: el.Quadratic, rows: list["Row"]) -> el.Quadratic:
        """Adds the rows' contacts to the links before them; p and q as triangles."""
        for row in rows:

            def add(row: Row = row, node: el.Quadratic = node) -> el.Quadratic:
                return lanewise(_add_row, node, row.matrix, full(row.matrix), row.force, row.held)

            node = choose(row.used, add, node, self.block.size)
        return node

    def slot_pushes(self, alpha: Lanes) -> dict[str, tuple[Lanes, Lanes]]:
        """Contact inertia and wrench of the palm's and the object's contacts; see `backward`."""
        pushes = {}
        for c in self.problem.slots:

            def add(i: Any, carry: tuple, c: BoundContacts = c) -> tuple:
                matrix, wrench = self.push(c, i, alpha)
                return lanewise(
                    lambda a, b: jax.tree.map(jnp.add, a, b), carry, (upper(matrix), wrench)
                )

            start = (zeros((21,), self.like), zeros((6,), self.like))
            triangle, wrench = self.block.sum(loop(c.set.count, add, start, self.block.size))
            pushes[c.set.name] = (full(triangle), wrench)
        return pushes

    def at_palm(self, now: Iterate, node: el.Quadratic, slots: dict) -> tuple[Iterate, Eliminated]:
        """Solves for wrist and object; slots: what `slot_pushes` returns."""
        rigid = self.problem.rigid

        def solve(now: Iterate, palm: Palm, node: el.Quadratic, pushes: dict) -> tuple:
            node, force = with_palm(now, palm, node, pushes)
            if rigid:
                obj = el.solve_object(node.q, node.r_object)
                none = jnp.zeros_like(obj)
                step = Iterate(none, none, obj)
                return step, Eliminated(None, None, node.q, dot(node.r_object, obj))
            armature, work = palm.armature, []
            axes = (palm.axes, el.wrist_slides(armature))
            kept = []
            for subspace, inertia, twist in zip(
                axes, (armature[3:], armature[:3]), (force.wrist[3:], force.wrist[:3]), strict=True
            ):
                y = contract(subspace, node.r[None], 1) + twist
                node, new = el.eliminate(node, subspace, inertia, twist)
                kept.append(new)
                work.append(dot(y, new.factors.z))
            obj = el.solve_object(node.q, node.r_object)
            first, motion = el.substitute(axes[1], kept[1].factors, jnp.zeros_like(obj), obj)
            second, motion = el.substitute(axes[0], kept[0].factors, motion, obj)
            step = Iterate(jnp.concatenate([first, second]), motion, obj)
            work = total([*work, dot(node.r_object, obj)])
            return step, Eliminated(kept[0], kept[1], node.q, work)

        return lanewise(solve, now, self.problem.palm, node, slots)


def with_palm(
    now: Iterate, palm: Palm, node: el.Quadratic, pushes: dict
) -> tuple[el.Quadratic, Forces]:
    """Adds palm and object, with the forces that an iterate leaves unbalanced, to the fingers."""
    force = Forces(
        palm.smooth_palm - palm.palm.times(now.palm_motion),
        None,  # type: ignore[arg-type]
        palm.smooth_object - palm.object.times(now.object_motion),
        palm.smooth_wrist - palm.armature * now.wrist,
        None,  # type: ignore[arg-type]
    )
    matrices = Matrices(palm.palm.matrix(), None, palm.object.matrix())  # type: ignore[arg-type]
    return el.add_palm(node, matrices, force, pushes), force


def add_terms(terms: list[el.JointTerms]) -> el.JointTerms:
    """Sums what the rows of several pairs of bodies add to a joint."""
    if len(terms) == 1:
        return terms[0]
    return lanewise(lambda *t: jax.tree.map(lambda *v: total(v), *t), *terms)


def _add_row(node: el.Quadratic, matrix, square, force, held: bool) -> el.Quadratic:
    p, c, q, r, ro = node
    p, r = p + matrix, r + force
    if held:
        c, q, ro = c + square, q + matrix, ro - force
    return el.Quadratic(p, c, q, r, ro)
