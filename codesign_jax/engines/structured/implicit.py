"""Reverse-mode derivative of a step's solution by the implicit function theorem.

The accelerations a of a step are where the gradient of its objective vanishes,
  F(a, theta) = M a - tau - J' f(J a - aref) = 0,
with theta all data of the step.  By the implicit function theorem a cotangent v of a gives theta
the cotangent -lambda' dF/dtheta with H lambda = v, and H = dF/da is the symmetric matrix of the
last Newton step: one more elimination, however many iterations the solution took.  lambda' F, the
power of the unbalanced forces along the virtual accelerations lambda, is a scalar that the
factored form gives without J or M.
"""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import solver
from codesign_jax.engines.structured.contact import Contacts, respond
from codesign_jax.engines.structured.kinematics import Acc
from codesign_jax.engines.structured.lanes import Stages, cross, dot, spatial, sum_items
from codesign_jax.engines.structured.newton import linear_solve, respond_all
from codesign_jax.engines.structured.problem import (
    Forces,
    Problem,
    Spatial,
    inertial_forces,
    propagate,
    relative,
    work,
)
from codesign_jax.engines.structured.solver import Solution


def solve(
    run: Stages,
    problem: Problem,
    velocity: Spatial,
    start: Acc,
    *,
    iterations: int,
    evaluations: int,
    tolerance: float,
) -> Solution:
    """`solver.solve` with a reverse-mode derivative; the same values.

    The accelerations are differentiable in problem and velocity.  The warm start gets no gradient:
    the solution does not depend on it.  Residual and iterations pass none.

    Args:
      run: Runs the stages.
      problem: The problem.
      velocity: Spatial velocities of the bodies.
      start: Warm start.
      iterations: As in `solver.solve`; 0 takes the start for the solution.
      evaluations: As in `solver.solve`.
      tolerance: As in `solver.solve`.
    """
    # Numbers of the scene stay numbers: as arguments they would become arrays of another type.
    leaves, tree = jax.tree.flatten((run.predicate, problem, velocity, start))
    traced = [isinstance(v, jax.Array) for v in leaves]

    def parts(arrays: list[jax.Array]) -> tuple[Stages, Problem, Spatial, Acc]:
        given = iter(arrays)
        filled = [next(given) if t else v for v, t in zip(leaves, traced, strict=True)]
        predicate, *rest = jax.tree.unflatten(tree, filled)
        return Stages(predicate), *rest

    @jax.custom_vjp
    def converged(arrays: list[jax.Array]) -> Solution:
        run, problem, velocity, start = parts(arrays)
        if not iterations:
            return Solution(start, jnp.zeros_like(start.wrist[0]), jnp.zeros((), jnp.int32))
        limits = {"iterations": iterations, "evaluations": evaluations, "tolerance": tolerance}
        return solver.solve(run, problem, velocity, start, **limits)

    def forward(arrays: list[jax.Array]):
        solution = converged(arrays)
        return solution, (arrays, solution.acc)

    def backward(saved: tuple, cotangent: Solution):
        arrays, acc = saved
        run, problem, velocity, _ = parts(arrays)
        virtual = adjoint(run, problem, velocity, acc, cotangent.acc)

        def power(arrays: list[jax.Array]) -> jax.Array:
            run, problem, velocity, _ = parts(arrays)
            return residual_power(run, problem, velocity, acc, virtual).sum()

        value, pull = jax.vjp(power, arrays)
        return pull(-jnp.ones_like(value))

    converged.defvjp(forward, backward)
    return converged([v for v, t in zip(leaves, traced, strict=True) if t])


def adjoint(run: Stages, problem: Problem, velocity: Spatial, acc: Acc, cotangent: Acc) -> Acc:
    """Solves H lambda = cotangent by the elimination of a Newton step at the solution acc."""
    motion = propagate(run, problem.kin, acc)
    runs = {n: run.only_if(c.active.any()) for n, c in problem.contacts.items()}
    jar = {
        n: runs[n](lambda *v, n=n: _jar(n, *v), c, motion, velocity)
        for n, c in problem.contacts.items()
    }
    pushes, pairs = respond_all(runs, problem.contacts, jar, motion)
    pushes = {n: (inertia, jnp.zeros_like(wrench)) for n, (inertia, wrench) in pushes.items()}
    if pairs is not None:
        pairs = pairs._replace(push=jnp.zeros_like(pairs.push))
    turning, moving = cotangent.object[:3], cotangent.object[3:]
    # The object's accelerations are at its centre, its spatial force at the origin.
    force = Forces(
        palm=jnp.zeros_like(motion.palm),
        link=jnp.zeros_like(motion.link),
        object=spatial(turning + cross(problem.kin.object_pos, moving), moving),
        wrist=cotangent.wrist,
        finger=cotangent.finger,
    )
    # As far as rounding allows: the derivative has no further Newton step to mend it.
    tolerance = float(jnp.finfo(motion.link.dtype).eps) ** 1.5
    return linear_solve(run, problem, force, pushes, pairs, tolerance=tolerance)[0]


def residual_power(
    run: Stages, problem: Problem, velocity: Spatial, acc: Acc, virtual: Acc
) -> jax.Array:
    """Power lambda' F of the unbalanced forces at acc along virtual, shape (1, world)."""
    if problem.arm is not None:  # data of the step, not a solution
        acc = acc._replace(wrist=problem.arm)
    motion = propagate(run, problem.kin, acc)
    along = propagate(run, problem.kin, virtual)
    inertial = inertial_forces(run, problem, acc, motion)
    force = Forces(*(m - s for m, s in zip(inertial, problem.smooth, strict=True)))
    power = work(run, force, virtual, along)
    for name, c in problem.contacts.items():

        def pushed(c: Contacts, motion: Spatial, velocity: Spatial, along: Spatial, name=name):
            force = respond(c, _jar(name, c, motion, velocity)).force
            return sum_items(dot(force, c.relative(relative(name, along, c))))

        active = run.only_if(c.active.any())
        power = power - active(pushed, c, motion, velocity, along)
    return power


def _jar(name: str, c: Contacts, motion: Spatial, velocity: Spatial) -> jax.Array:
    """J a - aref of a set of contacts."""
    speed = c.relative(relative(name, velocity, c))
    return c.relative(relative(name, motion, c)) - c.reference(speed)
