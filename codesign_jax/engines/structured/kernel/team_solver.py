"""Newton's linear system, conjugate gradients and line search by teams, see `shared_memory`."""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel.contact_list import (
    ContactList,
    make_contacts,
    symmetric_times,
)
from codesign_jax.engines.structured.kernel.coupling import Coupling, Eliminated
from codesign_jax.engines.structured.kernel.linear_system import Elimination, with_palm
from codesign_jax.engines.structured.kernel.linesearch import LineSearch, with_palm_and_object
from codesign_jax.engines.structured.kernel.memory import choose, loop, zeros
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.problem import Iterate, Problem, make_body, relative
from codesign_jax.engines.structured.kernel.rows import (
    Again,
    Chip,
    FingerState,
    Hand,
    Scratch,
    Shared,
    Side,
    TeamRing,
)
from codesign_jax.engines.structured.kernel.shared_memory import (
    AGAIN,
    FORCES,
    TEAM,
    UNUSED,
    TeamRows,
    chosen,
    team_sum,
)
from codesign_jax.engines.structured.kernel.sides import Sides
from codesign_jax.engines.structured.lanes import contract, dot, inverse_spd, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact


class TeamLanes:
    """A problem's numbers as the lanes of a team share them."""

    def __init__(self, problem: Problem):
        memory = problem.memory
        block = problem.block
        self.problem = problem
        self.block = block
        self.like = problem.like
        assert memory.onchip is not None
        self.chip = TeamRows(block, memory.onchip)
        self.scratch = TeamRows(block, memory.scratch)
        self.forces = self.mask(block.mate == FORCES)

    def mask(self, which: jax.Array, *, wide: bool = True) -> Lanes:
        return lanes([which], (), wide=wide)

    def as_lanes(self, value: jax.Array) -> Lanes:
        return lanes([value], (), wide=True)

    def axes(self, i: Any) -> Lanes:
        """A joint's motion subspace, all of it on all lanes, shape (axis, 6)."""
        return self.problem.read(Scratch.axes, item=i)[0][:, :6]

    def spread(self, **columns: Lanes) -> list[Lanes]:
        """Columns (row,) of the lanes as matrices on all lanes, shape (row, TEAM)."""
        for name, value in columns.items():
            self.chip.put_rows(getattr(Shared, name), value)
        return self.problem.read(*(getattr(Shared, name) for name in columns))

    def vector(self, component: jax.Array) -> Lanes:
        """Components of lanes as a vector on all lanes, shape (6,)."""
        self.chip.put(Shared.f, component)
        return self.problem.read(Shared.f)[0][:6]

    def column(self, matrix: Lanes, forces: Lanes) -> Lanes:
        """The lanes' columns of a matrix (6, 6) and of forces (6,) that all lanes have."""
        masks = [self.mask(self.block.mate == k) for k in range(6)]

        def pick(matrix, forces, at, masks):
            component = jnp.where(at, forces, 0.0)
            for k, mask in enumerate(masks):
                component = jnp.where(mask, matrix[:, k], component)
            return component

        return lanewise(pick, matrix, forces, self.forces, masks)

    def eliminate(
        self, node: list[Lanes], axes: Lanes, armature: Lanes, more: Lanes
    ) -> tuple[list[Lanes], el.Kept, Lanes]:
        """`elimination.eliminate` by columns.

        Args:
          node: The lanes' columns of P with r, of C, and of Q with r_o, shape (6,) each.
          more: What joint forces add to the columns of U with y.

        Returns:
          The columns left; those of w with z and of g, and D^-1; the lane's part of y'z.
        """

        def project(p, c, axes, more):
            return contract(axes, p[None], 1) + more, contract(axes, c[None], 1)

        def invert(axes, u, armature):
            n = axes.shape[0]
            eye = jnp.eye(n, dtype=axes.dtype)[:, :, None, None]
            return inverse_spd(contract(axes[:, None], u[None], 2) + eye * armature[:, None])

        def reduce(node, u, h, columns, inverse, forces):
            w, g = (contract(inverse, v[None], 1) for v in columns)
            work = jnp.where(forces, dot(columns[0], w), 0.0)
            g = jnp.where(forces, -w, g)
            p, c, q = node
            p = p - contract(u, w[:, None], 0)
            c = c - contract(u, g[:, None], 0)
            q = q - contract(h, g[:, None], 0)
            return [p, c, q], w, g, work

        columns = lanewise(project, *node[:2], axes, more)
        u, h = (v[:, :6] for v in self.spread(u=columns[0], h=columns[1]))
        inverse = lanewise(invert, axes, u, armature)
        node, w, g, work = lanewise(reduce, node, u, h, columns, inverse, self.forces)
        return node, el.Kept(el.Factors(w, g, None), inverse), work  # type: ignore[arg-type]

    def accelerations(
        self, kept: el.Kept, parent: jax.Array, obj: jax.Array, z: Lanes | None, at: int = FORCES
    ) -> Lanes:
        """Joint accelerations of the lanes' components of the parent and the object.

        Lanes without a component have zero.  Without z a lane, `at`, has the joint accelerations at
        rest in its column of w.
        """
        at_rest = self.mask(self.block.mate == at)

        def part(w, g, parent, obj, at_rest):
            moved = g * obj - w * parent
            return moved if z is not None else jnp.where(at_rest, w, moved)

        w, g, _ = kept.factors
        accs = self.as_lanes(parent), self.as_lanes(obj)
        acc = team_sum(self.block, lanewise(part, w, g, *accs, at_rest))
        return acc if z is None else lanewise(jnp.add, acc, z)

    def again(self, axes: list, kept: el.Kept, r: jax.Array, ro: jax.Array) -> tuple:
        """`elimination.eliminate_again` of the lanes' components; also the joint accelerations.

        Axes are the lanes' components; zero on lanes without one.
        """
        y = [self.block.over_team(s * r, jnp.add) for s in axes]

        def reduce(kept, r, ro, y):
            w, g, _ = kept.factors
            return r - dot(w, y), ro + dot(g, y), contract(kept.inverse, y[None], 1)

        value = lanes(y, (len(y),), wide=True)
        r, ro, z = lanewise(reduce, kept, self.as_lanes(r), self.as_lanes(ro), value)
        return r.lane, ro.lane, z  # pyright: ignore[reportAttributeAccessIssue]  # lanewise gives Lanes

    def link(self, i: Any) -> el.Kept:
        """What the elimination keeps of a link; its spatial vectors lie across a team's lanes."""
        factors = el.Factors(self.chip.rows(Chip.w, i), self.chip.rows(Chip.g, i), None)  # type: ignore[arg-type]
        return el.Kept(factors, self.problem.read(Again.inverse, item=i)[0])

    def outward(self, i: Any, parent: jax.Array, obj: jax.Array, at: int) -> tuple:
        """A joint's accelerations and its link's, by components; see `accelerations`."""
        a = self.accelerations(self.link(i), parent, obj, None, at)
        axes = self.chip.rows(Chip.axes, i)
        return a, lanewise(lambda p, s, a: p + dot(s, a), self.as_lanes(parent), axes, a).lane

    def narrowed(self, value: Lanes) -> Lanes:
        """What is the same on all lanes of a world, as its own."""
        return Lanes(value.parts, (*value.shape[:-2], 1, value.shape[-1]), value.dtype)

    def wrist(self, kept: list[el.Kept], axes: list[Lanes], obj: Lanes, z: list | None) -> Iterate:
        """Substitutes back at the wrist: slides, then hinges."""
        palm_acc = lanewise(jnp.zeros_like, obj)
        joints = []
        part = chosen(self.block, obj)
        for k in (1, 0):
            a = self.accelerations(kept[k], chosen(self.block, palm_acc), part, z and z[k])
            joints.append(a)
            palm_acc = lanewise(add_joint, palm_acc, axes[k], a)
        wrist = lanewise(lambda a: jnp.concatenate(a), joints)
        return Iterate(self.narrowed(wrist), self.narrowed(palm_acc), obj)


class TeamElimination(Elimination):
    """The elimination by columns."""

    def __init__(self, problem: Problem):
        super().__init__(problem)
        self.team = TeamLanes(problem)
        self.rings = problem.memory.layout.rings_per_link
        ones = jnp.ones_like(self.like)
        unit = [jnp.where(self.block.mate == k, ones, 0.0) for k in range(6)]
        self.unit = lanes(unit, (6,), wide=True)

    def backward(self, alpha: Lanes, between: ContactList | None) -> tuple[Any, Lanes]:
        """See `Elimination`; the node is the lanes' columns of P with r, C, and Q with r_o."""
        problem = self.problem
        team = self.team
        sides = problem.sides
        assert sides is not None and between is not None
        sides.update_constraints(between, alpha)
        for contacts in problem.per_link:
            self._update_rings(contacts, alpha)

        def add_link(p, forces, force, column):
            return p + jnp.where(forces, force, column)

        def joint(armature, tau, acc, forces):
            return jnp.where(forces, tau - armature * acc, 0.0)

        def step(i: Any, carry: tuple) -> tuple:
            (p, c, q), work = carry
            axes = team.axes(i)
            acc = problem.move(FingerState.acc, i, alpha)
            part = team.chip.get(Chip.link_acc, i) + alpha.lane * team.chip.get(
                Chip.step_link_acc, i
            )
            team.chip.put(Chip.link_acc, part, i)
            column = team.chip.rows(Chip.matrix, i)
            (link_acc,) = problem.read(Scratch.link_acc, item=i)
            force = team.scratch.get(Scratch.smooth, i) - lanewise(dot, column, link_acc).lane
            force = team.vector(force + team.scratch.get(Side.wrench, i + 1))
            p = lanewise(add_link, p, team.forces, force, column)
            tau, armature = problem.read(Scratch.tau, Hand.armature, item=i)
            more = lanewise(joint, armature, tau, acc, team.forces)
            node, kept, done = team.eliminate(
                self.with_contacts([p, c, q], i), axes, armature, more
            )
            for name, value in zip((Chip.w, Chip.g), kept.factors[:2], strict=True):
                team.chip.put_rows(name, value, i)
            problem.write(Again.inverse, kept.inverse, i)
            return node, lanewise(jnp.add, work, done)

        none = zeros((6,), self.like)
        start = [none] * 3, zeros((), self.like)
        (p, c, q), work = loop(self.links, step, start, self.block.size, reverse=True)
        first = sides.wrench_on(0)
        p = lanewise(add_link, p, team.forces, first, none)
        whole = self.block.fold(self.block.over_team(work.lane, jnp.add), jnp.add)
        return self.block.sum((p, c, q)), lanes([whole], (), wide=False)

    def _update_rings(self, contacts: ContactList, alpha: Lanes) -> None:
        """Adds the last step of the line search to jar; stores Hessians and forces of rings."""

        def store(item: Item) -> None:
            def touches() -> None:
                force = contacts.update_constraint(item, contacts.place(item), alpha)
                contacts.write(TeamRing.force, force, item)

            jax.lax.cond(contacts.touching(item), touches, lambda: None)

        contacts.each(store)

    def _columns(self, contacts: ContactList, i: Any) -> Lanes:
        """The lanes' columns (6,) of the sum of X'KX over the contacts of link i's rings.

        The lanes of the forces have their wrench.
        """

        def column(sums, place, cone, hessian, force, unit, forces):
            c = make_contacts(place, cone)
            response = jnp.where(forces, force, symmetric_times(hessian, c.relative(unit[:, None])))
            return sums + contact.contact_wrench(c, response)[:, 0]

        sums = zeros((6,), self.like)
        for item in (at(i * self.rings + j) for j in range(self.rings)):

            def add(item: Item = item, sums: Lanes = sums) -> Lanes:
                kept = [contacts.read(name, item) for name in (TeamRing.hessian, TeamRing.force)]
                args = contacts.place(item), contacts.cone_at(item), *kept
                return lanewise(column, sums, *args, self.unit, self.team.forces)

            sums = choose(contacts.touching(item), add, sums, self.block.size)
        return sums

    def with_contacts(self, node: list[Lanes], i: Any) -> list[Lanes]:
        """Adds the contacts of a link's rings to a node's columns."""

        def add(node, columns, held, forces):
            p, c, q = node
            return [p + columns, c + held, q + jnp.where(forces, -held, held)]

        none = zeros((6,), self.like)
        forces = self.team.forces
        for contacts in self.problem.per_link:
            columns = self._columns(contacts, i)
            node = lanewise(
                add, node, columns, columns if contacts.layout.on_object else none, forces
            )
        return node

    def at_palm(self, now: Iterate, node: Any, slots: dict) -> tuple[Iterate, Eliminated]:
        """Solves for wrist, palm and object once the links are eliminated.

        Args:
          now: The iterate.
          node: What the links leave for palm and object.
          slots: Contact inertia and wrench of the palm's and the object's contacts, by pair of
            bodies.

        Returns:
          The Newton step of wrist, palm and object, and what is eliminated.
        """
        team = self.team
        rigid = self.problem.rigid

        def palm_and_object(now, palm, pushes):
            none = jnp.zeros_like(palm.smooth_palm)
            square = jnp.zeros((6, *none.shape), none.dtype)
            empty = el.Quadratic(square, square, square, none, none)
            return with_palm(now, palm, empty, pushes)

        palm = self.problem.palm
        whole, twist = lanewise(palm_and_object, now, palm, slots)
        none = lanewise(jnp.zeros_like, whole.r)
        added = [
            team.column(matrix, force)
            for matrix, force in ((whole.p, whole.r), (whole.c, none), (whole.q, whole.r_object))
        ]
        node = lanewise(_plus, list(node), added)
        kept = []
        work = [zeros((), self.like)]
        axes = [palm.axes, lanewise(el.wrist_slides, palm.armature)]
        for k, joint in enumerate((slice(3, 6), slice(0, 3))):
            if rigid:
                break
            y = lanewise(lambda t, f: jnp.where(f, t, 0.0), twist[joint], team.forces)
            node, new, done = team.eliminate(node, axes[k], palm.armature[joint], y)
            kept.append(new)
            work.append(done)
        (q,) = team.spread(q=node[2])
        square = team.narrowed(q[:, :6])
        ro = team.narrowed(q[:, FORCES])
        obj = lanewise(el.solve_object, square, ro)
        part = self.block.over_team(lanewise(lambda w: total(w), work).lane, jnp.add)
        part = lanewise(lambda w, r, o: w + dot(r, o), lanes([part], (), wide=False), ro, obj)
        if rigid:
            none = lanewise(jnp.zeros_like, obj)
            return Iterate(none, none, obj), Eliminated(None, None, square, part)
        step = team.wrist(kept, axes, obj, None)
        return step, Eliminated(kept[0], kept[1], square, part)


class TeamCoupling(Coupling):
    """Conjugate gradients whose sweeps are by components."""

    def __init__(self, problem: Problem, *rest: Any):
        super().__init__(problem, *rest)
        self.team = TeamLanes(problem)

    def again(self) -> Iterate:
        team = self.team
        none = jnp.zeros_like(self.problem.like)

        def step(i: Any, carry: tuple) -> tuple:
            r, ro = (v.lane for v in carry)
            axes = [team.chip.get(Chip.axes, i, TEAM * k) for k in range(self._axes)]
            r = r + team.scratch.get(Side.wrench, i + 1)
            r, ro, z = team.again(axes, team.link(i), r, ro)
            for k, part in enumerate(z.parts.ravel()):
                self._row(i, k, AGAIN, part)
            return team.as_lanes(r), team.as_lanes(ro)

        start = team.as_lanes(none), team.as_lanes(none)
        r, ro = loop(self.links, step, start, self.block.size, reverse=True)
        r = r.lane + team.scratch.get(Side.wrench, 0)
        r, ro = (self.block.fold(v, jnp.add) for v in (r, ro.lane))
        return self._wrist(r, ro)

    @property
    def _axes(self) -> int:
        return self.team.chip.layout.groups[Chip.axes][1][0]

    def _row(self, i: Any, k: int, lane: int, value: jax.Array | None = None) -> jax.Array:
        """A lane's number in row k of w, on all lanes; or stores it."""
        table = self.team.chip.layout
        ref = self.team.chip.ref
        place = i * table.stride[Chip.w] + (table.offset[Chip.w] + TEAM * k + lane)
        if value is not None:
            ref[place] = value
        return ref[place]

    def _add_correction(self) -> None:
        def add(i: Any, x: jax.Array) -> jax.Array:
            for k in range(self._axes):
                self._row(i, k, FORCES, self._row(i, k, FORCES) + self._row(i, k, AGAIN))
            return x

        jax.lax.fori_loop(0, self.links, add, jnp.int32(0))

    def _wrist(self, r: jax.Array, ro: jax.Array) -> Iterate:
        team = self.team
        done = self.done
        palm = self.problem.palm
        z = []
        kept = [done.hinges, done.slides]
        axes = [palm.axes, lanewise(el.wrist_slides, palm.armature)]
        for k, factors in enumerate(kept):
            if factors is None:
                break
            parts = [chosen(self.block, axes[k][n]) for n in range(3)]
            r, ro, new = team.again(parts, factors, r, ro)
            z.append(new)
        force = team.narrowed(team.vector(ro))
        obj = lanewise(el.solve_object, done.q, force)
        if not z:
            none = lanewise(jnp.zeros_like, obj)
            return Iterate(none, none, obj)
        return team.wrist(kept, axes, obj, z)  # type: ignore[arg-type]

    def substitute(self, z: str, step: Iterate) -> None:
        """Leaves the links' accelerations with the sides of the contacts.

        Args:
          z: Row of what the elimination leaves of each joint, shape (axis, ...).
          step: Accelerations of palm and object, shape (6, ...) each.
        """
        team = self.team
        at = FORCES if z == Scratch.z else AGAIN
        palm, obj = (chosen(self.block, v) for v in (step.palm_acc, step.object_acc))

        def link(i: Any, parent: Lanes) -> Lanes:
            _, link_acc = team.outward(i, parent.lane, obj, at)
            team.scratch.put(Side.link_acc, link_acc, i + 1)
            return team.as_lanes(link_acc)

        self.sides.put(Side.link_acc, self.problem.widened(step.palm_acc), 0)
        loop(self.links, link, team.as_lanes(palm + 0 * obj), self.block.size)


class TeamLineSearch(LineSearch):
    """The line search of which each lane has a part."""

    def __init__(self, problem: Problem):
        super().__init__(problem)
        self.team = TeamLanes(problem)
        self.rings = problem.memory.layout.rings_per_link

    def prepare(
        self, now: Iterate, step: Iterate, between: ContactList | None
    ) -> tuple[Lanes, Lanes, Lanes]:
        """Substitutes back and prepares the line search.

        Args:
          now: The iterate.
          step: The Newton step of wrist, palm and object.
          between: Contacts of the hand with itself that count.

        Returns:
          Slope and curvature of the smooth part, and the contacts' slope, all at 0, (1, world).
        """
        problem = self.problem
        team = self.team
        sides = problem.sides
        assert sides is not None and between is not None
        palm, obj = (chosen(self.block, v) for v in (step.palm_acc, step.object_acc))
        first = team.as_lanes(jnp.where(self.block.mate == 0, jnp.ones_like(self.like), 0.0))

        def smooth(sums, column, link_acc, moved, smooth, part, first, armature, acc, tau, a):
            slope, curvature = sums
            joints = total([(armature[k] * acc[k] - tau[k]) * a[k] for k in range(a.shape[0])])
            stiff = total([armature[k] * a[k] * a[k] for k in range(a.shape[0])])
            slope = slope + first * joints - (smooth - dot(column, link_acc)) * part
            return [slope, curvature + first * stiff + dot(column, moved) * part]

        def link(i: Any, carry: tuple) -> tuple:
            parent, sums = carry
            a, part = team.outward(i, parent.lane, obj, FORCES)
            problem.write(Scratch.step_acc, a, i)
            team.chip.put(Chip.step_link_acc, part, i)
            team.scratch.put(Side.link_acc, part, i + 1)
            numbers = problem.read(Hand.armature, FingerState.acc, Scratch.tau, item=i)
            push = team.as_lanes(team.scratch.get(Scratch.smooth, i))
            column = team.chip.rows(Chip.matrix, i)
            link_acc, moved = problem.read(Scratch.link_acc, Scratch.step_link_acc, item=i)
            sums = lanewise(
                smooth, sums, column, link_acc, moved, push, team.as_lanes(part), first, *numbers, a
            )
            return team.as_lanes(part), sums

        sides.put(Side.link_acc, problem.widened(step.palm_acc), 0)
        start = team.as_lanes(palm + 0 * obj), [zeros((), self.like)] * 2
        _, (slope, curvature) = loop(self.links, link, start, self.block.size)
        touch = self.prepare_slots(zeros((), self.like), step)
        terms = [lanewise(jnp.multiply, touch, first), sides.prepare_all(between)]
        for contacts in problem.per_link:
            terms.append(self._prepare_rings(contacts, sides, step))
        touch = lanewise(lambda t: total(t), terms)
        slope, curvature, touch = self.total([slope, curvature, touch])
        slope, curvature = lanewise(with_palm_and_object, now, step, problem.palm, slope, curvature)
        return slope, curvature, touch

    def _prepare_rings(self, contacts: ContactList, sides: Sides, step: Iterate) -> Lanes:
        """`prepare_linesearch` of the fingers' rings; slopes at 0, each on its lane."""

        def add(item: Item, sums: Lanes) -> Lanes:
            row = jax.lax.div(item.number, jnp.full_like(item.number, self.rings)) + 1
            link_acc = sides.table.gather(Side.link_acc, row, self.block.column)
            acc = relative(contacts.layout.name, link_acc, step.palm_acc, step.object_acc)
            return lanewise(jnp.add, sums, contacts.prepare_linesearch(item, acc))

        return contacts.fold(add, zeros((), self.like))

    def total(self, sums: list[Lanes]) -> list[Lanes]:
        """Sums of lanes over the teams of each world."""
        return self.block.sum([team_sum(self.block, v) for v in sums])

    def contact_slopes(self, alpha: Lanes, between: ContactList | None) -> list[Lanes]:
        """Slope and curvature of the contacts' cost along the step, sums of each finger's contacts.

        Args:
          alpha: Length of the step, lanes of a world.
          between: Contacts of the hand with itself that count.
        """
        problem = self.problem
        sums = [zeros((), self.like)] * 2
        first = self.team.as_lanes(jnp.where(self.block.mate == 0, jnp.ones_like(self.like), 0.0))

        def plus(sums: list[Lanes], new: list[Lanes]) -> list[Lanes]:
            return lanewise(lambda a, b: jax.tree.map(jnp.add, a, b), sums, new)

        for c in problem.dealt:
            sums = c.fold(lambda item, s, c=c: plus(s, c.slopes(item, alpha)), sums)
        sums = [lanewise(jnp.multiply, v, first) for v in sums]
        for c in problem.per_link:
            sums = c.fold(lambda item, s, c=c: plus(s, c.slopes(item, alpha)), sums)
        assert between is not None
        return between.slopes_of_all(alpha, sums)


def team_rows(stored: dict[str, Lanes], body: tuple) -> dict[str, Lanes]:
    """What a link leaves for the solver, with columns in rows of eight; `rows.Chip`."""

    def wide(axes, *body):
        matrix = make_body(*body).matrix()
        return tuple(
            jnp.concatenate([m, jnp.zeros((len(m), TEAM - 6, *m.shape[2:]), m.dtype)], 1)
            for m in (axes, matrix)
        )

    axes, matrix = lanewise(wide, stored[Scratch.axes], *body)
    unused = UNUSED
    return {k: v for k, v in stored.items() if k not in unused} | {
        Chip.axes: axes,
        Chip.matrix: matrix,
    }


def add_joint(parent, axes, a):
    """A body's spatial acceleration from its parent's and its joint's."""
    return parent + contract(axes, a[:, None], 0)


def _plus(first, second):
    return [a + b for a, b in zip(first, second, strict=True)]
