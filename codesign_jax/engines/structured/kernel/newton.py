"""Newton's method with exact line search, inside a kernel: links in loops, numbers in registers.

A step minimises over the accelerations a
  1/2 (a - a_s)' M (a - a_s) + sum_c s_c(J_c a - aref_c),
MuJoCo's contact problem, M with armature and implicit terms.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel import friction_memory
from codesign_jax.engines.structured.kernel.contact_sets import BoundContacts, zeros
from codesign_jax.engines.structured.kernel.coupling import Coupling, Eliminated, solve_palm_again
from codesign_jax.engines.structured.kernel.linear_system import Elimination
from codesign_jax.engines.structured.kernel.linesearch import FAR, LINE_TOLERANCE, LineSearch
from codesign_jax.engines.structured.kernel.memory import (
    anywhere,
    choose,
    loop,
    solid,
    tree_add_scaled,
)
from codesign_jax.engines.structured.kernel.problem import Iterate, Palm, Problem, make_body
from codesign_jax.engines.structured.kernel.slots import only
from codesign_jax.engines.structured.kernel.team_solver import (
    TeamCoupling,
    TeamElimination,
    TeamLineSearch,
)
from codesign_jax.engines.structured.lanes import contract, dot, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

LARGEST = 1e-3
"""Decrement of an iteration behind which the next one is likely to be below the tolerance."""


class ChordStep:
    """The chord method's step behind a Newton step, of which the last matrix is left.

    Most time steps end with an iteration whose decrement is already below the tolerance. Its matrix
    is all but that of the iteration before, if no contact has gone to another zone of its cone: the
    cost is quadratic in two of the three zones, and smooth in the third. So the forces that the
    last step has left unbalanced are eliminated with the matrix that is there: the chord method
    (Ortega and Rheinboldt, Iterative Solution of Nonlinear Equations in Several Variables, 1970,
    ch. 7), at a sixth of an iteration's cost, and their decrement is what the iteration would have
    found.

    The matrix P lacks the contacts between fingers, whose cost is convex: with them the decrement
    is smaller than the one that P gives. Such a world does not go along the step, as P may be too
    soft.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.block = problem.block
        self.links = problem.links
        self.like = problem.like

    def steady(self, alpha: Lanes) -> jax.Array:
        """Whether no contact of a world goes to another zone along the last step, (lane,)."""
        problem = self.problem
        count = zeros((), self.like)
        sets = [(self.links, c) for c in problem.fingers]
        sets += [(c.set.count, c) for c in problem.slots]
        for items, contacts in sets:

            def add(i: Any, sums: Lanes, contacts: BoundContacts = contacts) -> Lanes:
                return lanewise(jnp.add, sums, contacts.changes(i, alpha))

            count = loop(items, add, count, self.block.size)
        return self.block.sum(count).lane == 0

    def step(self, now: Iterate, done: Eliminated, alpha: Lanes) -> tuple[Iterate, Lanes]:
        """The step of wrist, palm and object; leaves the fingers' part in "z_again".

        Args:
          now: The iterate behind the last step, of wrist, palm and object.
          done: What is left of the palm's elimination.
          alpha: Length of the last step, by which those of the links are still to be moved.

        Returns:
          The step, and the forces' product with it and that of the fingers: the squared decrement.
        """
        problem = self.problem
        if chambers := problem.chambers:
            chambers.move(alpha)
        if problem.pairs:
            problem.pairs.update_wrenches(alpha)

        def again(alpha, carry, body, moved, forces, factors, pushes, pair):
            r, ro, work = carry
            axes, armature, *kept = factors
            acc, motion = (a + alpha * b for a, b in moved)
            smooth, tau = forces
            push = total([smooth - make_body(*body).times(motion), *pushes.values()])
            ro = total([ro, *(-w for name, w in pushes.items() if name == "finger_object")])
            tau = tau - armature * acc
            r = r + push if pair is None else r + push + pair
            y = contract(axes, r[None], 1) + tau
            kept = el.Kept(el.Factors(kept[0], kept[1], kept[0]), kept[2])
            r, ro, new = el.eliminate_again(axes, kept, r, ro, tau)
            return (r, ro, work + dot(y, new.z)), new.z

        def one(i: Any, carry: tuple) -> tuple:
            names = [("acc", "step_acc"), ("motion", "step_motion")]
            moved = [problem.read(*pair, item=i) for pair in names]
            pushes = {c.set.name: c.wrench(i, alpha) for c in problem.fingers}
            pair = problem.pairs.pushed(i + 1) if problem.pairs else None
            factors = problem.read("axes", "armature", "w", "g", "inverse", item=i)
            forces = problem.read("smooth", "tau", item=i)
            args = alpha, carry, problem.body_of(i), moved, forces, factors, pushes, pair
            carry, z = lanewise(again, *args)
            problem.write("z_again", z, i)
            return carry

        none = zeros((6,), self.like)
        start = none, none, zeros((), self.like)
        r, ro, work = loop(self.links, one, start, self.block.size, reverse=True)
        if chambers:
            r, ro, less = chambers.close_again("z_again", r, ro)
            work = lanewise(jnp.subtract, work, less)
        r = problem.add_first(r) if problem.pairs else r
        r, ro, work = self.block.sum((r, ro, work))
        given = now, problem.palm, done, r, ro, work, self._pushes(alpha)
        step, work = lanewise(self._at_palm, *given)
        if chambers:
            chambers.settle("z_again", step.palm_motion, step.object_motion)
        return step, work

    def _pushes(self, alpha: Lanes) -> dict[str, Lanes]:
        """Wrenches of the contacts of palm and object, by name."""
        pushes = {}
        for c in self.problem.slots:

            def add(i: Any, sums: Lanes, c: BoundContacts = c) -> Lanes:
                return lanewise(jnp.add, sums, c.wrench(i, alpha))

            found = loop(c.set.count, add, zeros((6,), self.like), self.block.size)
            pushes[c.set.name] = self.block.sum(found)
        return pushes

    @staticmethod
    def _at_palm(now: Iterate, palm, done: Eliminated, r, ro, work, pushes: dict) -> tuple:
        r = r + palm.smooth_palm - palm.palm.times(now.palm_motion)
        ro = ro + palm.smooth_object - palm.object.times(now.object_motion)
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
            a, motion = el.substitute(axes, el.Factors(*factors), parent, obj)
            return motion, jnp.where(taken, tree_add_scaled(alpha, a, before), before)

        def one(i: Any, parent: Lanes) -> Lanes:
            axes, before = problem.read("axes", "step_acc", item=i)
            factors = problem.read("w", "g", "z_again", item=i)
            args = step.object_motion, axes, factors, before, alpha, mask
            motion, acc = lanewise(move, parent, *args)
            problem.write("step_acc", acc, i)
            return motion

        loop(self.links, one, problem.widened(step.palm_motion), self.block.size)


class Convergence(NamedTuple):
    """How the iteration stands: relative decrement, lanes of a world; count, a scalar."""

    residual: Any
    count: jax.Array


class Newton:
    """The solver of one step in a kernel."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.block = problem.block
        one = problem.block.team == 1
        self.elimination = (Elimination if one else TeamElimination)(problem)
        self.search = (LineSearch if one else TeamLineSearch)(problem)
        self.coupling = Coupling if one else TeamCoupling
        # A GPU's lanes wait for the one that needs most iterations, so that it gains nothing there.
        vectors = one and problem.slotted and not problem.slotted[0].set.gathers
        self.chord = ChordStep(problem) if vectors else None

    def solve(
        self, now: Iterate, waiting: jax.Array, iterations: int, evaluations: int, tolerance: float
    ) -> tuple[Iterate, Convergence]:
        """Iterates until the relative decrement of every undecided world is small.

        Args:
          now: Warm start.
          waiting: Lanes of the undecided worlds.
          iterations: Largest number of Newton iterations; `evaluations`: of the line search.
        """
        problem = self.problem

        def hold(before, alpha, residual):
            # A world that has converged keeps its iterate: it must not depend on other worlds.
            going = before > tolerance
            return jnp.where(going, alpha, 0.0), jnp.where(going, residual, before)

        def body(carry: list) -> list:
            count = carry[0]
            now, before, last = rebuild(carry[1:])
            busy = waiting & (before.lane > tolerance)
            # A world that has converged keeps its iterate, so its contacts need not be looked at.
            with only(problem.slotted, busy):
                step, done = self.direction(now, last, ~busy)
                slope, curvature, first = self.search.prepare(now, step)
                residual, scale = lanewise(_residual, slope, first, problem.palm, now.object_motion)
                floor = jnp.where(busy, LINE_TOLERANCE * tolerance * scale.lane, FAR)
                alpha = self.search.find(slope, curvature, first, floor, evaluations)
            alpha, residual = lanewise(hold, before, alpha, residual)
            newton = alpha  # of the contacts, which the chord's step does not move
            now = lanewise(tree_add_scaled, alpha, now, step)
            if self.chord:
                likely = busy & (residual.lane > tolerance) & (residual.lane <= LARGEST)
                found = now, alpha, residual
                confirm = partial(self.confirm, *found, done, scale, likely, tolerance)
                now, alpha, residual = choose(anywhere(likely), confirm, found, self.block.size)
            if friction_memory.kept(problem):
                ends = busy & ((residual.lane <= tolerance) | (count + 1 >= iterations))
                friction_memory.settle(problem, newton, ends)
            return [count + 1, *solid((now, residual, alpha), self.block.size)[0]]

        def going(carry: list) -> jax.Array:
            return (carry[0] < iterations) & anywhere(waiting & (carry[-2] > tolerance))

        far = lanewise(lambda a: jnp.full_like(a[0], FAR), now.wrist)
        none = lanewise(lambda a: jnp.zeros_like(a[0]), now.wrist)
        start, rebuild = solid((now, far, none), self.block.size)
        count, *arrays = jax.lax.while_loop(going, body, [jnp.int32(0), *start])
        now, residual, last = rebuild(arrays)
        loop(problem.links, lambda i, _: (problem.move("acc", i, last), [])[1], [], self.block.size)
        return now, Convergence(residual, count)

    def confirm(
        self,
        now: Iterate,
        alpha: Lanes,
        residual: Lanes,
        done: Eliminated,
        scale: Lanes,
        likely: jax.Array,
        tolerance: float,
    ) -> tuple[Iterate, Lanes, Lanes]:
        """Ends the iteration of worlds whose next decrement would be below the tolerance.

        Args:
          now: The iterate behind the step; `alpha`: its length; `residual`: relative decrement
            before.
          done: What `direction` left of the palm's elimination.
          scale: Scale of the decrement.
          likely: Lanes of worlds whose decrement is to be looked at.

        Returns:
          Iterate, length and decrement, see `ChordStep`; the length is that of "step_acc".
        """
        chord = self.chord
        pairs = self.problem.pairs
        size = self.block.size
        assert chord is not None

        def look(likely: jax.Array) -> tuple[Iterate, Lanes, Lanes]:
            more, work = chord.step(now, done, alpha)
            new = lanewise(jnp.divide, work, scale)
            found = likely & (new.lane >= 0) & (new.lane <= tolerance)
            taken = found if pairs is None else found & ~pairs.touching_worlds()

            def take() -> tuple[Iterate, Lanes]:
                chord.take(more, alpha, taken)
                mask = lanes([taken], (), wide=False)
                there = lanewise(
                    lambda t, a, b: jax.tree.map(partial(jnp.where, t), a, b),
                    mask,
                    lanewise(lambda a, b: jax.tree.map(jnp.add, a, b), now, more),
                    now,
                )
                return there, lanewise(lambda t, a: jnp.where(t, 1.0, a), mask, alpha)

            there, length = choose(anywhere(taken), take, (now, alpha), size)
            small = lanes([found], (), wide=False)
            return there, length, lanewise(jnp.where, small, new, residual)

        with only(self.problem.slotted, likely):
            steady = likely & chord.steady(alpha)
            as_was = now, alpha, residual
            return choose(anywhere(steady), lambda: look(steady), as_was, size)

    def direction(self, now: Iterate, last: Lanes, idle: jax.Array) -> tuple[Iterate, Eliminated]:
        """Newton's step: the fingers' factors, and the step of wrist and object.

        Last is the length of the last step; the step of idle lanes is of no use.
        """
        pairs = self.problem.pairs
        node, work = self.elimination.backward(last)
        step, done = self.elimination.at_palm(now, node, self.elimination.slot_pushes(last))
        if pairs is None:
            return step, done
        done = done._replace(work=lanewise(jnp.add, done.work, work))

        def correct() -> Iterate:
            return self.coupling(self.problem, pairs, done).correct(step, idle)

        return choose(pairs.touching_now(), correct, step, self.block.size), done


def _residual(slope, first, palm: Palm, motion):
    # Typical size of the objective: object and palm at g, plus the object's present motion.
    mass = palm.object.mass
    scale = 100.0 * (mass + palm.palm.mass) + mass * dot(motion[3:], motion[3:])
    return jnp.maximum(-slope - first, 0.0) / scale, scale
