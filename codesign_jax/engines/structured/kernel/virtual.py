"""Virtual accelerations: the one linear system that the derivative of a step solves.

H lambda = v, with v the cotangent of the step's accelerations and H the matrix of a Newton step at
the solution, contacts as they are there: one elimination, however many iterations found it.
"""

from typing import Any

import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import grip, grip_sweep
from codesign_jax.engines.structured.kernel.contact_sets import BoundContacts, zeros
from codesign_jax.engines.structured.kernel.coupling import Coupling
from codesign_jax.engines.structured.kernel.linear_system import Elimination
from codesign_jax.engines.structured.kernel.memory import choose, loop
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.problem import Iterate
from codesign_jax.engines.structured.lanewise import Lanes, lanewise
from codesign_jax.engines.structured.linear import elimination as el

ITERATIONS = 300
"""Largest number of conjugate gradients: more than Newton's method needs, whose steps may err."""


class Virtual(Elimination):
    """The elimination with a right side that acts on the joints alone.

    The right side of the fingers' joints is read from the scratch table, "acc_bar"; that of wrist
    and object stands in the place of their smooth forces, see `palm`.
    """

    def accelerations(self, i: Any, alpha: Lanes) -> list[Lanes]:
        """See `Elimination`."""
        return [_none(v) for v in self.problem.read("acc_bar", "motion", item=i)]

    def smooth(self, i: Any) -> list[Lanes]:
        """See `Elimination`."""
        smooth, right = self.problem.read("smooth", "acc_bar", item=i)
        return [_none(smooth), right]

    def push(self, contacts: BoundContacts, item: Any, alpha: Lanes) -> tuple[Lanes, Lanes]:
        """See `Elimination`."""
        matrix, wrench = contacts.push(item, alpha)
        return matrix, _none(wrench)

    def between_fingers(self, pairs: BoundPairs, alpha: Lanes) -> None:
        """See `Elimination`."""
        pairs.update_constraints(alpha)
        pairs.clear_wrenches()
        if grip.kept(self.problem):
            grip_sweep.push(self.problem, pairs)

    def solve(self) -> Iterate:
        """Solves the system; leaves the joints' part in the scratch table.

        Returns:
          Virtual accelerations of the wrist, and virtual motions of palm and object. Those of the
          links stay behind as "virtual" of the joints and "chain.along" of the links.
        """
        problem, size = self.problem, self.block.size
        still = zeros((), self.like)
        node, work = self.backward(still)
        palm = problem.palm
        none = Iterate(*(_none(v) for v in (palm.smooth_wrist, *[palm.smooth_object] * 2)))
        step, done = self.at_palm(none, node, self.slot_pushes(still))
        if (pairs := problem.pairs) is not None:
            done = done._replace(work=lanewise(jnp.add, done.work, work))
            exact = float(jnp.finfo(self.like.dtype).eps) ** 1.5
            coupling = Coupling(problem, pairs, done, tolerance=exact, iterations=ITERATIONS)
            idle = jnp.zeros_like(self.like) > 0
            touching = pairs.touching_now()
            step = choose(touching, lambda: coupling.correct(step, idle), step, size)
        self._substitute(step)
        return step

    def _substitute(self, step: Iterate) -> None:
        problem = self.problem

        def one(i: Any, parent: Lanes) -> Lanes:
            axes, *factors = problem.read("axes", "w", "g", "z", item=i)

            def move(axes, factors, parent, obj):
                return el.substitute(axes, el.Factors(*factors), parent, obj)

            virtual, along = lanewise(move, axes, factors, parent, step.object_motion)
            problem.write("virtual", virtual, i)
            problem.write("chain.along", along, i + 1)
            return along

        parent = problem.widened(step.palm_motion)
        problem.write("chain.along", parent, 0)
        loop(self.links, one, parent, self.block.size)


def palm_problem(palm: Any, wrist: Lanes, obj: Lanes) -> Any:
    """Palm, wrist and object with the right side of wrist and object as their only forces."""
    return palm._replace(smooth_palm=_none(palm.smooth_palm), smooth_object=obj, smooth_wrist=wrist)


def _none(value: Lanes) -> Lanes:
    return lanewise(jnp.zeros_like, value)
