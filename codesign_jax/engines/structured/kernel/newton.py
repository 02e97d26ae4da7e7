"""Newton's method of `solver`, inside a kernel: links in loops, numbers in registers."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import elimination as el
from codesign_jax.engines.structured import newton
from codesign_jax.engines.structured.inertia import Body
from codesign_jax.engines.structured.kernel import hull, solver
from codesign_jax.engines.structured.kernel.contacts import BoundContacts, direct, zeros
from codesign_jax.engines.structured.kernel.coupling import Coupling, Eliminated
from codesign_jax.engines.structured.kernel.memory import (
    Block,
    MemoryLayout,
    anywhere,
    choose,
    full,
    loop,
    solid,
    upper,
)
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.slots import BoundSlots
from codesign_jax.engines.structured.lanes import contract, dot, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.problem import Forces, Matrices, object_acceleration


class Palm(NamedTuple):
    """What the solver needs of palm, wrist and object; lanes of a world."""

    palm: Body
    object: Body
    smooth_palm: Any
    smooth_object: Any
    smooth_wrist: Any
    armature: Any
    axes: Any
    position: Any


class Iterate(NamedTuple):
    """Accelerations of wrist and object, and motion of palm and object; lanes of a world."""

    wrist: Any
    object: Any
    palm_motion: Any
    object_motion: Any


class Quality(NamedTuple):
    """How the iteration stands: relative decrement, lanes of a world; count, a scalar."""

    residual: Any
    count: jax.Array


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


class Memory(NamedTuple):
    """A kernel's memory: tables with their refs, and the bound contact sets by name."""

    hand: MemoryLayout
    hand_ref: Any
    state: MemoryLayout
    state_ref: Any
    scratch: MemoryLayout
    scratch_ref: Any
    contacts: dict[str, BoundContacts]


def relative(name: str, link: Any, palm: Lanes, obj: Lanes) -> Lanes:
    """Relative motion of a pair of bodies."""
    difference = jnp.subtract
    if name == "finger_object":
        return lanewise(difference, link, obj)
    if name == "palm_object":
        return lanewise(difference, palm, obj)
    if name == "hull_object":
        return lanewise(lambda m, o: jnp.concatenate([m[:6] - o, m[6:]]), link, obj)
    alone = {"finger_table": link, "hull_table": link, "palm_table": palm, "object_table": obj}
    return alone[name]


LINE_TOLERANCE = 0.01
"""Slope at which a line search ends, over the first one: MuJoCo's default `ls_tolerance`."""


class Newton:
    """The solver of one step in a kernel."""

    def __init__(self, links: int, block: Block, m: Memory, palm: Palm, *, rigid: bool = False):
        """Takes the step's memory, in which the forward pass has left its results.

        Args:
          links: Moving links of a finger.
          block: The lanes.
          m: The memory.
          palm: Palm, wrist and object.
          rigid: Whether the wrist's accelerations are known, see `Problem.palm_acc`.
        """
        self.links, self.block, self.m, self.palm, self.rigid = links, block, m, palm, rigid
        self.pairs: BoundPairs | None = m.contacts.get("finger_finger")  # type: ignore[assignment]
        self.fingers = [m.contacts[n] for n in ("finger_object", "finger_table") if n in m.contacts]
        self.skin = [c for n, c in m.contacts.items() if n.startswith("hull_")]
        self.slots = [c for n, c in m.contacts.items() if not n.startswith(("finger", "hull_"))]
        self.like = jnp.zeros((block.size,), palm.armature.dtype)

    def read(self, *names: str, item: Any = 0) -> list[Lanes]:
        """Reads names from the table that has them."""
        m = self.m
        tables = ((m.hand, m.hand_ref), (m.state, m.state_ref), (m.scratch, m.scratch_ref))
        found = []
        for name in names:
            table, ref = next((t, r) for t, r in tables if name in t.groups)
            found.append(table.read(ref, name, item))
        return found

    def write(self, name: str, value: Lanes, item: Any) -> None:
        """Writes to the table that has the name."""
        m = self.m
        if name in m.state.groups:
            m.state.write(m.state_ref, name, value, item)
        else:
            m.scratch.write(m.scratch_ref, name, value, item)

    def move(self, name: str, item: Any, alpha: Lanes) -> Lanes:
        """Adds the last step to a link's "acc" or "motion", and returns the sum."""
        value = lanewise(solver.tree_add_scaled, alpha, *self.read(name, f"step_{name}", item=item))
        self.write(name, value, item)
        return value

    def body_of(self, item: Any) -> list[Lanes]:
        """Arguments of `make_body` for a link."""
        return self.read("mass", "body_centre", "tensor", item=item)

    def pair_push(self, i: Any) -> tuple[Lanes, Lanes | None]:
        """Forces of the contacts between fingers on a link and on the joint before it."""
        assert self.pairs is not None
        push = self.pairs.pushed(i + 1)[:6]
        return push, self.pairs.pushed(i)[6:] if self.pairs.set.skin else None

    def add_first(self, r: Lanes) -> Lanes:
        """Adds the contacts between fingers that act on the palm, those of the first joints."""
        assert self.pairs is not None
        if not self.pairs.set.skin:
            return r
        return lanewise(jnp.add, r, self.pairs.pushed(0)[:6])

    def widened(self, motion: Lanes) -> Lanes:
        """What belongs to a world, on all fingers."""
        return lanewise(jnp.add, motion, zeros(motion.shape[:-2], self.like))

    def backward(self, alpha: Lanes) -> tuple[el.Quadratic, Lanes]:
        """Eliminates the fingers from their tips.

        Args:
          alpha: Length of the last step, by which accelerations, motions and jar move first: so
            they are read once an iteration.

        Returns:
          The sum over the fingers, and the product of their forces with the step so far.
        """
        if self.pairs:
            self.pairs.update_constraints(alpha)

        def eliminate(node, body, motion, smooth, tau, axes, armature, acc, pushes, terms, pairs):
            link = make_body(*body)
            push, tau = smooth - link.times(motion), tau - armature * acc
            if pairs is not None:
                wrench, turned = pairs
                push = push + wrench
                tau = tau if turned is None else tau + contract(axes[:, :3], turned[None], 1)
            node = newton.add_link(node, newton.link_terms(link.matrix(), push, pushes))
            y = contract(axes, node.r[None], 1) + tau
            node, kept = el.eliminate_and_keep(direct, node, axes, armature, tau, terms)
            if terms is not None:
                y = y + terms.y
            return node, kept, dot(y, kept.factors.z)

        def step(i: Any, carry: tuple) -> tuple:
            node, work = carry
            acc, motion = self.move("acc", i, alpha), self.move("motion", i, alpha)
            pushes = {c.set.name: c.push(i, alpha) for c in self.fingers}
            smooth, tau, axes, armature = self.read("smooth", "tau", "axes", "armature", item=i)
            node = node._replace(p=full(node.p), q=full(node.q))
            rows = [self.row(c, i, axes, alpha) for c in self.skin]
            terms = add_terms([r.terms for r in rows]) if rows else None
            pairs = self.pair_push(i) if self.pairs else None
            forces = (motion, smooth, tau, axes, armature, acc, pushes, terms, pairs)
            node, kept, more = lanewise(eliminate, node, self.body_of(i), *forces)
            for name, value in zip(("w", "g", "z"), kept.factors, strict=True):
                self.write(name, value, i)
            if self.pairs:
                self.write("inverse", kept.inverse, i)
                work = lanewise(jnp.add, work, more)
            node = self.add_rows(node._replace(p=upper(node.p), q=upper(node.q)), rows)
            return node, work

        empty = [zeros(s, self.like) for s in ((21,), (6, 6), (21,), (6,), (6,))]
        tip = [self.row(c, self.links, None, alpha) for c in self.skin]
        node = self.add_rows(el.Quadratic(*empty), tip)
        start = node, zeros((), self.like)
        node, work = loop(self.links, step, start, self.block.size, reverse=True)
        if self.pairs:
            node, work = node._replace(r=self.add_first(node.r)), self.block.sum(work)
        node = self.block.sum(node)
        return node._replace(p=full(node.p), q=full(node.q)), work

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
            inertia, wrench = slots.push(row, alpha)
            if axes is None:
                return [*empty[:4], upper(inertia[:6, :6]), wrench[:6]]
            terms, matrix, force = lanewise(hull.row_terms, axes, inertia, wrench)
            return [*terms, upper(matrix), force]

        *terms, matrix, force = choose(used, compute, empty, self.block.size)
        if not slots.set.on_object:
            terms[2] = zeros(shapes[2], self.like)
        return Row(slots.set.on_object, used, el.JointTerms(*terms), matrix, force)

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
        for c in self.slots:

            def add(i: Any, carry: tuple, c: BoundContacts = c) -> tuple:
                matrix, wrench = c.push(i, alpha)
                return lanewise(
                    lambda a, b: jax.tree.map(jnp.add, a, b), carry, (upper(matrix), wrench)
                )

            start = (zeros((21,), self.like), zeros((6,), self.like))
            triangle, wrench = self.block.sum(loop(c.set.count, add, start, self.block.size))
            pushes[c.set.name] = (full(triangle), wrench)
        return pushes

    def at_palm(self, now: Iterate, node: el.Quadratic, slots: dict) -> tuple[Iterate, Eliminated]:
        """Solves for wrist and object; slots: what `slot_pushes` returns."""
        rigid = self.rigid

        def solve(now: Iterate, palm: Palm, node: el.Quadratic, pushes: dict) -> tuple:
            force = Forces(
                palm.smooth_palm - palm.palm.times(now.palm_motion),
                None,  # type: ignore[arg-type]
                palm.smooth_object - palm.object.times(now.object_motion),
                palm.smooth_wrist - palm.armature * now.wrist,
                None,  # type: ignore[arg-type]
            )
            matrices = Matrices(palm.palm.matrix(), None, palm.object.matrix())  # type: ignore[arg-type]
            node = newton.add_palm(node, matrices, force, pushes)
            if rigid:
                obj = el.solve_object(direct, node.q, node.r_object)
                none = jnp.zeros_like(obj)
                step = Iterate(none, object_acceleration(obj, palm.position), none, obj)
                return step, Eliminated(None, None, node.q, dot(node.r_object, obj))
            armature, work = palm.armature, []
            axes = (palm.axes, newton.wrist_slides(armature))
            kept = []
            for subspace, inertia, twist in zip(
                axes, (armature[3:], armature[:3]), (force.wrist[3:], force.wrist[:3]), strict=True
            ):
                y = contract(subspace, node.r[None], 1) + twist
                node, new = el.eliminate_and_keep(direct, node, subspace, inertia, twist)
                kept.append(new)
                work.append(dot(y, new.factors.z))
            obj = el.solve_object(direct, node.q, node.r_object)
            first, motion = el.substitute(axes[1], kept[1].factors, jnp.zeros_like(obj), obj)
            second, motion = el.substitute(axes[0], kept[0].factors, motion, obj)
            at_centre = object_acceleration(obj, palm.position)
            step = Iterate(jnp.concatenate([first, second]), at_centre, motion, obj)
            work = total([*work, dot(node.r_object, obj)])
            return step, Eliminated(kept[0], kept[1], node.q, work)

        return lanewise(solve, now, self.palm, node, slots)

    def direction(self, now: Iterate, last: Lanes, idle: jax.Array) -> Iterate:
        """Newton's step: the fingers' factors, and the step of wrist and object.

        Args:
          now: The iterate.
          last: Length of the last step, see `backward`.
          idle: Lanes of worlds whose step is of no use.
        """
        node, work = self.backward(last)
        step, done = self.at_palm(now, node, self.slot_pushes(last))
        pairs = self.pairs
        if pairs is None:
            return step
        done = done._replace(work=lanewise(jnp.add, done.work, work))

        def correct() -> Iterate:
            return Coupling(self, pairs, done).correct(step, idle)

        return choose(pairs.touching_now(), correct, step, self.block.size)

    def forward(self, now: Iterate, step: Iterate) -> tuple[Lanes, Lanes, Lanes]:
        """Substitutes back and prepares the line search.

        Returns:
          Slope and curvature of the smooth part, and the contacts' slope, all at 0, (1, world).
        """

        def substitute(parent, obj, body, motion, smooth, tau, axes, armature, acc, factors):
            a, moved = el.substitute(axes, el.Factors(*factors), parent, obj)
            link = make_body(*body)
            force = smooth - link.times(motion)
            joints = [(armature[k] * acc[k] - tau[k]) * a[k] for k in range(a.shape[0])]
            slope = total(joints) - dot(force, moved)
            stiff = total([armature[k] * a[k] * a[k] for k in range(a.shape[0])])
            return a, moved, slope, stiff + dot(link.times(moved), moved)

        def one(i: Any, carry: tuple) -> tuple:
            parent, slope, curvature, touch = carry
            names = ("motion", "smooth", "tau", "axes", "armature", "acc")
            a, moved, s, c = lanewise(
                substitute,
                parent,
                step.object_motion,
                self.body_of(i),
                *self.read(*names, item=i),
                self.read("w", "g", "z", item=i),
            )
            self.write("step_acc", a, i)
            self.write("step_motion", moved, i)
            if self.pairs:
                self.pairs.put_link(i, parent, moved)
            terms = [touch]
            for contacts in self.fingers:
                rel = relative(contacts.set.name, moved, step.palm_motion, step.object_motion)
                terms.append(contacts.prepare_linesearch(i, rel))
            terms += self.prepare_row(i, parent, moved, step)
            touch = lanewise(lambda t: total(t), terms)
            slope, curvature = lanewise(lambda a, b, c, d: (a + b, c + d), slope, s, curvature, c)
            return moved, slope, curvature, touch

        none = zeros((), self.like)
        parent = self.widened(step.palm_motion)
        if self.pairs:
            self.pairs.put_palm(parent)
        last, slope, curvature, touch = loop(
            self.links, one, (parent, none, none, none), self.block.size
        )
        tip = self.prepare_row(self.links, last, last, step)
        between = [self.pairs.prepare_all()] if self.pairs else []
        touch = lanewise(lambda t: total(t), [touch, *tip, *between])
        for contacts in self.slots:

            def add(i: Any, sum_: Lanes, contacts: BoundContacts = contacts) -> Lanes:
                rel = relative(contacts.set.name, None, step.palm_motion, step.object_motion)
                return lanewise(jnp.add, sum_, contacts.prepare_linesearch(i, rel))

            touch = loop(contacts.set.count, add, touch, self.block.size)
        slope, curvature, touch = self.block.sum((slope, curvature, touch))
        slope, curvature = lanewise(self._rest, now, step, self.palm, slope, curvature)
        return slope, curvature, touch

    def prepare_row(self, row: Any, before: Lanes, after: Lanes, step: Iterate) -> list[Lanes]:
        """Slopes of a row's contacts along the step of the links before and behind it."""
        if not self.skin:
            return []
        moved = lanewise(partial(hull.across, obj=None), before, after)
        names = [
            (c, relative(c.set.name, moved, step.palm_motion, step.object_motion))
            for c in self.skin
        ]
        return [c.prepare_linesearch(row, motion) for c, motion in names]

    @staticmethod
    def _rest(now: Iterate, step: Iterate, palm: Palm, slope, curvature):
        """Adds wrist, palm and object to the smooth part's slope and curvature."""
        push = palm.smooth_palm - palm.palm.times(now.palm_motion)
        pull = palm.smooth_object - palm.object.times(now.object_motion)
        twist = palm.smooth_wrist - palm.armature * now.wrist
        slope = slope - dot(push, step.palm_motion) - dot(pull, step.object_motion)
        slope = slope - dot(twist, step.wrist)
        bent = dot(palm.palm.times(step.palm_motion), step.palm_motion)
        bent = bent + dot(palm.object.times(step.object_motion), step.object_motion)
        return slope, curvature + bent + dot(palm.armature * step.wrist, step.wrist)

    def line_search(
        self,
        slope: Lanes,
        curvature: Lanes,
        first: Lanes,
        floor: jax.Array,
        evaluations: int,
    ) -> Lanes:
        """Step length, lanes of a world.

        Args:
          slope: Slope of the smooth part at 0.
          curvature: Its curvature.
          first: Slope of the contacts at 0.
          floor: Slope that is small enough, lanes of a world.
          evaluations: Largest number of evaluations.
        """

        def evaluate(alpha: Lanes) -> tuple[Lanes, Lanes]:
            def add(i: Any, sums: list, sets: list) -> list:
                for contacts in sets:
                    new = contacts.slopes(i, alpha)
                    sums = lanewise(lambda a, b: jax.tree.map(jnp.add, a, b), sums, new)
                return sums

            sums = [zeros((), self.like)] * 2
            for count, sets in ((self.links, self.fingers), (self.links + 1, self.skin)):
                if sets:
                    sums = loop(count, lambda i, s, c=sets: add(i, s, c), sums, self.block.size)
            for c in self.slots:
                sums = loop(c.set.count, lambda i, s, c=c: add(i, s, [c]), sums, self.block.size)
            if self.pairs:
                sums = self.pairs.slopes_of_all(alpha, sums)
            one, two = self.block.sum(sums)
            return lanewise(
                lambda s, c, a, f, g: (s + a * c + f, c + g), slope, curvature, alpha, one, two
            )

        def body(carry: list) -> list:
            count, old = carry[0], rebuild(carry[1:])
            one, two = evaluate(old[0])
            new = (*lanewise(solver.refine, *old[:3], one, two), one)
            # A world that has found its step length keeps it: it must not depend on other worlds.
            searching = lanes([jnp.abs(carry[-1]) > goal], (), wide=False)
            new = [lanewise(jnp.where, searching, a, b) for a, b in zip(new, old, strict=True)]
            return [count + 1, *solid(tuple(new), self.block.size)[0]]

        def going(carry: list) -> jax.Array:
            return (carry[0] < evaluations) & anywhere(jnp.abs(carry[-1]) > goal)

        goal = jnp.maximum(floor, LINE_TOLERANCE * jnp.abs(lanewise(jnp.add, slope, first).lane))
        one = lanewise(jnp.ones_like, slope)
        none = lanewise(jnp.zeros_like, slope)
        far = lanewise(lambda x: jnp.full_like(x, solver.FAR), slope)
        start, rebuild = solid((one, none, far, far), self.block.size)
        return rebuild(jax.lax.while_loop(going, body, [jnp.int32(0), *start])[1:])[0]

    def solve(
        self, now: Iterate, waiting: jax.Array, iterations: int, evaluations: int, tolerance: float
    ) -> tuple[Iterate, Quality]:
        """Iterates until every undecided world has converged.

        Args:
          now: Warm start.
          waiting: Lanes of the undecided worlds, which must converge.
          iterations: Largest number of iterations.
          evaluations: Largest number of line-search evaluations.
          tolerance: Relative Newton decrement.
        """

        def hold(before, alpha, residual):
            # A world that has converged keeps its iterate: it must not depend on other worlds.
            going = before > tolerance
            return jnp.where(going, alpha, 0.0), jnp.where(going, residual, before)

        def body(carry: list) -> list:
            count, (now, before, last) = carry[0], rebuild(carry[1:])
            step = self.direction(now, last, ~waiting | (before.lane <= tolerance))
            slope, curvature, first = self.forward(now, step)
            residual, scale = lanewise(_residual, slope, first, self.palm, now.object_motion)
            floor = LINE_TOLERANCE * tolerance * scale.lane
            floor = jnp.where(waiting & (before.lane > tolerance), floor, solver.FAR)
            alpha = self.line_search(slope, curvature, first, floor, evaluations)
            alpha, residual = lanewise(hold, before, alpha, residual)
            now = lanewise(solver.tree_add_scaled, alpha, now, step)
            return [count + 1, *solid((now, residual, alpha), self.block.size)[0]]

        def going(carry: list) -> jax.Array:
            return (carry[0] < iterations) & anywhere(waiting & (carry[-2] > tolerance))

        far = lanewise(lambda a: jnp.full_like(a[0], solver.FAR), now.wrist)
        none = lanewise(lambda a: jnp.zeros_like(a[0]), now.wrist)
        start, rebuild = solid((now, far, none), self.block.size)
        count, *arrays = jax.lax.while_loop(going, body, [jnp.int32(0), *start])
        now, residual, last = rebuild(arrays)
        loop(self.links, lambda i, _: (self.move("acc", i, last), [])[1], [], self.block.size)
        return now, Quality(residual, count)


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


def make_body(mass: jax.Array, centre: jax.Array, tensor: jax.Array) -> Body:
    """Body of a mass, a centre and the upper triangle xx, xy, xz, yy, yz, zz of a tensor."""
    xx, xy, xz, yy, yz, zz = (tensor[i] for i in range(6))
    rows = [jnp.stack(r) for r in ([xx, xy, xz], [xy, yy, yz], [xz, yz, zz])]
    return Body(mass, centre, jnp.stack(rows))


def triangle(tensor: jax.Array) -> jax.Array:
    """Upper triangle of a symmetric tensor (3, 3, ...)."""
    return jnp.stack([tensor[i, j] for i in range(3) for j in range(i, 3)])


def _residual(slope, first, palm: Palm, motion):
    scale = solver.scale(palm.object.mass, palm.palm.mass, motion)
    return jnp.maximum(-slope - first, 0.0) / scale, scale
