"""Reverse-mode derivative of a step's accelerations by the implicit function theorem.

The accelerations a of a step are where the gradient of its objective vanishes,
  F(a, theta) = M a - tau - J' f(J a - aref) = 0,
with theta all data of the step.  By the implicit function theorem a cotangent v of a gives theta
the cotangent -lambda' dF/dtheta with H lambda = v, and H = dF/da is the symmetric matrix of a
Newton step at a: one elimination, however many iterations the kernel took to find a.  lambda' F,
the power of the unbalanced forces along the virtual accelerations lambda, is a scalar that the
factored form gives without J or M.
"""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.contact import Contacts, constraint_update
from codesign_jax.engines.structured.kinematics import Acc
from codesign_jax.engines.structured.lanes import Stages, dot, sum_items
from codesign_jax.engines.structured.newton import linear_solve
from codesign_jax.engines.structured.problem import (
    Forces,
    Problem,
    Spatial,
    inertial_forces,
    inner,
    propagate,
    relative,
)


@jax.custom_vjp
def accelerations(
    predicate: jax.Array | None, problem: Problem, velocity: Spatial, acc: Acc
) -> Acc:
    """The accelerations themselves, as the function of problem and velocity that they are.

    Args:
      predicate: See `Stages`.
      problem: The step's problem.
      velocity: Spatial velocities of the bodies.
      acc: Its solution, which gets no derivative of its own.
    """
    del predicate, problem, velocity
    return acc


def _forward(predicate: jax.Array | None, problem: Problem, velocity: Spatial, acc: Acc):
    return acc, (predicate, problem, velocity, acc)


def _backward(saved: tuple, cotangent: Acc):
    predicate, problem, velocity, acc = saved
    run = Stages(predicate)
    virtual = adjoint(run, problem, velocity, acc, cotangent)

    def power(problem: Problem, velocity: Spatial) -> jax.Array:
        return residual_power(run, problem, velocity, acc, virtual).sum()

    value, pull = jax.vjp(power, problem, velocity)
    return None, *pull(-jnp.ones_like(value)), None


accelerations.defvjp(_forward, _backward)


def adjoint(run: Stages, problem: Problem, velocity: Spatial, acc: Acc, cotangent: Acc) -> Acc:
    """Solves H lambda = cotangent by elimination, H the Newton matrix at the solution acc."""
    motion = propagate(run, problem.kin, acc)
    jar = {
        n: run(lambda *v, n=n: _jar(n, *v), c, motion, velocity)
        for n, c in problem.contacts.items()
    }
    force = Forces(
        palm=jnp.zeros_like(motion.palm),
        link=jnp.zeros_like(motion.link),
        object=cotangent.object,
        wrist=cotangent.wrist,
        finger=cotangent.finger,
    )
    return linear_solve(run, problem, force, jar)


def residual_power(
    run: Stages, problem: Problem, velocity: Spatial, acc: Acc, virtual: Acc
) -> jax.Array:
    """Power lambda' F of the unbalanced forces at acc along virtual, shape (1, world)."""
    if problem.palm_acc is not None:  # data of the step, not a solution
        acc = acc._replace(wrist=problem.palm_acc)
    motion = propagate(run, problem.kin, acc)
    along = propagate(run, problem.kin, virtual)
    inertial = inertial_forces(run, problem, acc, motion)
    force = Forces(*(m - s for m, s in zip(inertial, problem.smooth, strict=True)))
    power = inner(run, force, virtual, along)
    for name, c in problem.contacts.items():

        def pushed(c: Contacts, motion: Spatial, velocity: Spatial, along: Spatial, name=name):
            force = constraint_update(c, _jar(name, c, motion, velocity)).force
            return sum_items(dot(force, c.relative(relative(name, along, c))))

        power = power - run(pushed, c, motion, velocity, along)
    return power


def _jar(name: str, c: Contacts, motion: Spatial, velocity: Spatial) -> jax.Array:
    """J a - aref of a set of contacts."""
    speed = c.relative(relative(name, velocity, c))
    return c.relative(relative(name, motion, c)) - c.reference(speed)
