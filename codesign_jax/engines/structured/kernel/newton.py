"""Newton's method with exact line search, inside a kernel: links in loops, numbers in registers.

A step minimises over the accelerations a
  1/2 (a - a_s)' M (a - a_s) + sum_c s_c(J_c a - aref_c),
MuJoCo's contact problem, M with armature and implicit terms.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import friction_memory, record
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.coupling import Coupling, Eliminated
from codesign_jax.engines.structured.kernel.last_step import (
    LARGEST,
    LENGTHS,
    STEADY,
    ChordStep,
    steady,
)
from codesign_jax.engines.structured.kernel.linear_system import Elimination
from codesign_jax.engines.structured.kernel.linesearch import FAR, LINE_TOLERANCE, LineSearch
from codesign_jax.engines.structured.kernel.memory import (
    any_of,
    anywhere,
    choose,
    loop,
    solid,
    tree_add_scaled,
)
from codesign_jax.engines.structured.kernel.problem import Iterate, Palm, Problem
from codesign_jax.engines.structured.kernel.rows import FingerState
from codesign_jax.engines.structured.kernel.team_solver import (
    TeamCoupling,
    TeamElimination,
    TeamLineSearch,
)
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise


class Limits(NamedTuple):
    """How hard each step is solved."""

    # Largest number of Newton iterations; with none the accelerations stay those of the state
    iterations: int
    evaluations: int  # Largest number of line-search evaluations of an iteration
    tolerance: float  # Relative Newton decrement at which a world has converged


class Convergence(NamedTuple):
    """How the iteration stands: relative decrement, lanes of a world; count, a scalar."""

    decrement: Any
    count: jax.Array


class Newton:
    """The solver of one step in a kernel."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.block = problem.block
        single_lanes = problem.block.team == 1
        self.elimination = (Elimination if single_lanes else TeamElimination)(problem)
        self.search = (LineSearch if single_lanes else TeamLineSearch)(problem)
        self.coupling = Coupling if single_lanes else TeamCoupling
        # A chord's step would take a GPU as long as it saves: there an iteration ends without one.
        pairs = problem.self_contacts
        self.accepts_steady = pairs is not None and pairs.layout.slots.gathers
        chords = pairs is not None and not pairs.layout.slots.gathers
        self.chord = ChordStep(problem) if chords and single_lanes else None

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

        def unless_converged(before, alpha, decrement):
            # A world that has converged keeps its iterate: it must not depend on other worlds.
            going = before > tolerance
            return jnp.where(going, alpha, 0.0), jnp.where(going, decrement, before)

        def body(carry: list) -> list:
            count = carry[0]
            now, before, last = rebuild(carry[1:])
            busy = waiting & (before.lane > tolerance)
            # A world that has converged keeps its iterate, so its contacts need not be looked at.
            between = problem.between(busy)
            step, done = self.direction(now, last, ~busy, between)
            slope, curvature, first = self.search.prepare(now, step, between)
            decrement, scale = lanewise(_decrement, slope, first, problem.palm, now.object_acc)
            floor = jnp.where(busy, LINE_TOLERANCE * tolerance * scale.lane, FAR)
            alpha = self.search.find(slope, curvature, first, floor, evaluations, between)
            alpha, decrement = lanewise(unless_converged, before, alpha, decrement)
            newton = alpha  # of the contacts, which the chord's step does not move
            now = lanewise(tree_add_scaled, alpha, now, step)
            behind_newton = now
            if self.chord:
                likely = busy & (decrement.lane > tolerance) & (decrement.lane <= LARGEST)
                iterate = now, alpha, decrement
                confirm = partial(self.confirm, *iterate, done, scale, likely, tolerance)
                now, alpha, decrement = choose(anywhere(likely), confirm, iterate, self.block.size)
            if self.accepts_steady:
                largest = STEADY * tolerance
                likely = busy & (decrement.lane > tolerance) & (decrement.lane <= largest)
                accept = partial(self.accept_steady, decrement, alpha, likely, tolerance)
                decrement = choose(anywhere(likely), accept, decrement, self.block.size)
            if friction_memory.any_held(problem) or problem.memory.layout.record:
                ends = busy & ((decrement.lane <= tolerance) | (count + 1 >= iterations))
                self._end(newton, ends, now, behind_newton)
            return [count + 1, *solid((now, decrement, alpha), self.block.size)[0]]

        def going(carry: list) -> jax.Array:
            return (carry[0] < iterations) & anywhere(waiting & (carry[-2] > tolerance))

        far = lanewise(lambda a: jnp.full_like(a[0], FAR), now.wrist)
        none = lanewise(lambda a: jnp.zeros_like(a[0]), now.wrist)
        start, rebuild = solid((now, far, none), self.block.size)
        count, *arrays = jax.lax.while_loop(going, body, [jnp.int32(0), *start])
        now, decrement, last = rebuild(arrays)
        loop(
            problem.links,
            lambda i, _: (problem.move(FingerState.acc, i, last), [])[1],
            [],
            self.block.size,
        )
        return now, Convergence(decrement, count)

    def _end(self, alpha: Lanes, ends: jax.Array, now: Iterate, behind_newton: Iterate) -> None:
        """Leaves behind what contacts hold, and where they are recorded their jar.

        Args:
          alpha: Length of Newton's last step.
          ends: Lanes of the worlds whose iteration ends.
          now: The iterate at the end; `behind_newton`: before a chord step.
        """
        problem = self.problem
        if friction_memory.any_held(problem):
            friction_memory.keep(problem, alpha, ends)
        if problem.memory.layout.record:
            chord = lanewise(partial(jax.tree.map, jnp.subtract), now, behind_newton)
            any_of(ends, lambda: record.settle(problem, alpha, ends, chord))

    def accept_steady(
        self, decrement: Lanes, alpha: Lanes, likely: jax.Array, tolerance: float
    ) -> Lanes:
        """The decrement, or the tolerance where the step that it is of is taken as the last one.

        Args:
          decrement: The decrement; `alpha`: length of the step.
          likely: Lanes of worlds whose decrement is near the tolerance, see `STEADY`.
        """
        ends = likely & steady(self.problem, alpha, self.problem.between(likely))
        newton = (alpha.lane > LENGTHS[0]) & (alpha.lane < LENGTHS[1])
        mask = lanes([ends & newton], (), wide=False)
        return lanewise(lambda e, r: jnp.where(e, tolerance, r), mask, decrement)

    def confirm(
        self,
        now: Iterate,
        alpha: Lanes,
        decrement: Lanes,
        done: Eliminated,
        scale: Lanes,
        likely: jax.Array,
        tolerance: float,
    ) -> tuple[Iterate, Lanes, Lanes]:
        """Ends the iteration of worlds whose next decrement would be below the tolerance.

        Args:
          now: The iterate behind the step; `alpha`: its length; `decrement`: relative decrement
            before.
          done: What `direction` left of the palm's elimination.
          scale: Scale of the decrement.
          likely: Lanes of worlds whose decrement is to be looked at.

        Returns:
          Iterate, length and decrement, see `ChordStep`; the length is that of "step_acc".
        """
        chord = self.chord
        between = self.problem.between(likely)
        size = self.block.size
        assert chord is not None

        def look(likely: jax.Array) -> tuple[Iterate, Lanes, Lanes]:
            more, work = chord.step(now, done, alpha, between)
            new = lanewise(jnp.divide, work, scale)
            converged = likely & (new.lane >= 0) & (new.lane <= tolerance)
            taken = converged if between is None else converged & ~between.touching_worlds()

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
            small = lanes([converged], (), wide=False)
            return there, length, lanewise(jnp.where, small, new, decrement)

        ending = likely & steady(self.problem, alpha, None)
        as_was = now, alpha, decrement
        return choose(anywhere(ending), lambda: look(ending), as_was, size)

    def direction(
        self, now: Iterate, last: Lanes, idle: jax.Array, between: ContactList | None
    ) -> tuple[Iterate, Eliminated]:
        """Newton's step: the fingers' factors, and the step of wrist and object.

        Args:
          now: The iterate.
          last: Length of the last step, lanes of a world.
          idle: Lanes whose step is of no use.
          between: Contacts of the hand with itself in the other worlds; None without any.
        """
        node, work = self.elimination.backward(last, between)
        step, done = self.elimination.at_palm(now, node, self.elimination.of_dealt_contacts(last))
        if between is None:
            return step, done
        done = done._replace(work=lanewise(jnp.add, done.work, work))

        def correct() -> Iterate:
            return self.coupling(self.problem, between, done).correct(step, idle)

        return choose(between.touching_now(), correct, step, self.block.size), done


WEIGHT_SQUARE = 100.0
"""Square of an acceleration of about g [m^2/s^4], whatever the scene's gravity is: the solver's
tolerance is relative to the objective at this acceleration."""


def _decrement(slope, first, palm: Palm, object_acc):
    # Typical size of the objective: object and palm at g, plus the object's present acceleration.
    mass = palm.object.mass
    scale = WEIGHT_SQUARE * (mass + palm.palm.mass) + mass * dot(object_acc[3:], object_acc[3:])
    return jnp.maximum(-slope - first, 0.0) / scale, scale
