"""Newton's method of `solver`, inside a kernel: links in loops, numbers in registers."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import grip, solver
from codesign_jax.engines.structured.kernel.chord import LARGEST, Chord
from codesign_jax.engines.structured.kernel.coupling import Coupling, Eliminated
from codesign_jax.engines.structured.kernel.linear_system import Elimination
from codesign_jax.engines.structured.kernel.linesearch import LINE_TOLERANCE, LineSearch
from codesign_jax.engines.structured.kernel.memory import anywhere, choose, loop, solid
from codesign_jax.engines.structured.kernel.problem import Iterate, Palm, Problem
from codesign_jax.engines.structured.kernel.slots import only
from codesign_jax.engines.structured.kernel.team_solver import (
    TeamCoupling,
    TeamElimination,
    TeamLineSearch,
)
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise


class Quality(NamedTuple):
    """How the iteration stands: relative decrement, lanes of a world; count, a scalar."""

    residual: Any
    count: jax.Array


class Newton:
    """The solver of one step in a kernel."""

    def __init__(self, problem: Problem):
        """Takes the step's problem."""
        self.problem, self.block = problem, problem.block
        one = problem.block.team == 1
        self.elimination = (Elimination if one else TeamElimination)(problem)
        self.search = (LineSearch if one else TeamLineSearch)(problem)
        self.coupling = Coupling if one else TeamCoupling
        # A GPU's lanes wait for the one that needs most iterations, so that it gains nothing there.
        vectors = one and problem.slotted and not problem.slotted[0].set.gathers
        self.chord = Chord(problem) if vectors else None

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
        problem = self.problem

        def hold(before, alpha, residual):
            # A world that has converged keeps its iterate: it must not depend on other worlds.
            going = before > tolerance
            return jnp.where(going, alpha, 0.0), jnp.where(going, residual, before)

        def body(carry: list) -> list:
            count, (now, before, last) = carry[0], rebuild(carry[1:])
            busy = waiting & (before.lane > tolerance)
            # A world that has converged keeps its iterate, so its contacts need not be looked at.
            with only(problem.slotted, busy):
                step, done = self.direction(now, last, ~busy)
                slope, curvature, first = self.search.prepare(now, step)
                residual, scale = lanewise(_residual, slope, first, problem.palm, now.object_motion)
                floor = jnp.where(busy, LINE_TOLERANCE * tolerance * scale.lane, solver.FAR)
                alpha = self.search.find(slope, curvature, first, floor, evaluations)
            alpha, residual = lanewise(hold, before, alpha, residual)
            now = lanewise(solver.tree_add_scaled, alpha, now, step)
            if self.chord:
                likely = busy & (residual.lane > tolerance) & (residual.lane <= LARGEST)
                found = now, alpha, residual
                confirm = partial(self.confirm, *found, done, scale, likely, tolerance)
                now, alpha, residual = choose(anywhere(likely), confirm, found, self.block.size)
            if grip.kept(problem):
                ends = busy & ((residual.lane <= tolerance) | (count + 1 >= iterations))
                grip.settle(problem, alpha, ends)
            return [count + 1, *solid((now, residual, alpha), self.block.size)[0]]

        def going(carry: list) -> jax.Array:
            return (carry[0] < iterations) & anywhere(waiting & (carry[-2] > tolerance))

        far = lanewise(lambda a: jnp.full_like(a[0], solver.FAR), now.wrist)
        none = lanewise(lambda a: jnp.zeros_like(a[0]), now.wrist)
        start, rebuild = solid((now, far, none), self.block.size)
        count, *arrays = jax.lax.while_loop(going, body, [jnp.int32(0), *start])
        now, residual, last = rebuild(arrays)
        loop(problem.links, lambda i, _: (problem.move("acc", i, last), [])[1], [], self.block.size)
        return now, Quality(residual, count)

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
          now: The iterate behind the step.
          alpha: Length of the step.
          residual: Relative decrement before it.
          done: What `direction` left of the palm's elimination.
          scale: Scale of the decrement.
          likely: Lanes of worlds whose decrement is to be looked at.
          tolerance: Relative Newton decrement.

        Returns:
          Iterate, length and decrement, see `Chord`; the length belongs to "step_acc" of the links.
        """
        chord, pairs, size = self.chord, self.problem.pairs, self.block.size
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

        Args:
          now: The iterate.
          last: Length of the last step, see `Elimination.backward`.
          idle: Lanes of worlds whose step is of no use.
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
    scale = solver.scale(palm.object.mass, palm.palm.mass, motion)
    return jnp.maximum(-slope - first, 0.0) / scale, scale
