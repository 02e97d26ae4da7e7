"""Newton's method with exact line search on MuJoCo's contact problem, without J, M or H.

minimise over a:  1/2 (a - a_s)' M (a - a_s) + sum_c s_c(J_c a - aref_c), M with armature and
implicit terms. A contact acts on a link as a wrench and a 6 x 6 contact inertia X'KX; one
elimination from the finger tips to the object solves the Newton system.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import finger_pairs, hull
from codesign_jax.engines.structured.contact import (
    Contacts,
    line,
    slopes,
)
from codesign_jax.engines.structured.kinematics import Acc
from codesign_jax.engines.structured.lanes import (
    Stages,
    dot,
    sum_items,
)
from codesign_jax.engines.structured.newton import decrement, linear_solve, newton_step, respond_all
from codesign_jax.engines.structured.problem import (
    Forces,
    Problem,
    Spatial,
    inertial_forces,
    propagate,
    relative,
    work,
)


class Solution(NamedTuple):
    """Accelerations and how well they solve the problem.

    Attributes:
      acc: The accelerations.
      residual: Newton decrement relative to the objective's scale, shape (1, world).
      iterations: Newton iterations done, shape ().
    """

    acc: Acc
    residual: jax.Array
    iterations: jax.Array


def along(alpha: jax.Array, value: Any, step: Any) -> Any:
    """A tree of arrays moved by alpha times another one."""
    return jax.tree.map(lambda v, s: v + alpha * s, value, step)


FAR = 3e38
"""No upper end of a bracket yet; finite, as a GPU kernel has no test for infinity."""


def refine(
    alpha: jax.Array, low: jax.Array, high: jax.Array, first: jax.Array, second: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Next step length and bracket from the derivatives at alpha: Newton, else bisection."""
    low, high = jnp.where(first <= 0, alpha, low), jnp.where(first > 0, alpha, high)
    guess = alpha - first / jnp.maximum(second, 1e-30)
    inside = (guess >= low) & (guess <= high)
    middle = jnp.where(high > 1e30, 2.0 * low, 0.5 * (low + high))
    return jnp.where(inside, guess, middle), low, high


def line_search(
    run: dict[str, Stages],
    contacts: dict[str, Contacts],
    jar: dict[str, jax.Array],
    step: dict[str, jax.Array],
    slope: jax.Array,
    curvature: jax.Array,
    evaluations: int,
) -> jax.Array:
    """Minimises along the step by safeguarded Newton on the convex objective's derivative.

    Args:
      run: Runs the stages of each set of contacts.
      contacts: The contacts.
      jar: J a - aref of every contact.
      step: J p of every contact.
      slope: Derivative of the smooth part at 0, shape (1, world).
      curvature: Its second derivative, same shape.
      evaluations: Number of evaluations.

    Returns:
      Step length, shape (1, world).
    """
    rays = {n: run[n](line, c, jar[n], step[n]) for n, c in contacts.items()}

    def summed(c: Contacts, ray, alpha: jax.Array):
        return tuple(sum_items(v) for v in slopes(c, ray, alpha))

    def evaluate(_: int, carry: tuple):
        alpha, low, high = carry
        first, second = slope + alpha * curvature, curvature
        for n, c in contacts.items():
            if c.lever is not None:
                f, s = hull.line_slopes(run[n], c, rays[n], alpha)
            elif c.ends is not None:
                f, s = finger_pairs.line_slopes(run[n], c, rays[n], alpha)
            else:
                f, s = run[n](summed, c, rays[n], alpha)
            first, second = first + f, second + s
        return refine(alpha, low, high, first, second)

    start = (jnp.ones_like(slope), jnp.zeros_like(slope), jnp.full_like(slope, FAR))
    return jax.lax.fori_loop(0, evaluations, evaluate, start)[0]


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
    """Solves one step's contact problem.

    Args:
      run: Runs the stages.
      problem: The problem.
      velocity: Spatial velocities of the bodies.
      start: Warm start.
      iterations: Largest number of Newton iterations.
      evaluations: Line-search evaluations per iteration.
      tolerance: Newton decrement, relative to the objective's scale, below which a world is done.
    """
    contacts = problem.contacts
    if problem.arm is not None:
        start = start._replace(wrist=problem.arm)
    if not contacts:
        return _solve_free(run, problem, start)
    # A set without a contact in any world of the batch costs nothing: its stages return zeros.
    runs = {n: run.only_if(c.active.any()) for n, c in contacts.items()}

    def initial(name: str, c: Contacts, motion: Spatial, velocity: Spatial) -> jax.Array:
        speed = c.relative(relative(name, velocity, c))
        return c.relative(relative(name, motion, c)) - c.reference(speed)

    def jar_of(name: str, c: Contacts, motion: Spatial) -> jax.Array:
        if c.ends is not None:
            return finger_pairs.jar_of(runs[name], c, motion.link)
        return runs[name](lambda c, m: c.relative(relative(name, m, c)), c, motion)

    motion = propagate(run, problem.kin, start)
    jar = {
        n: runs[n](lambda c, m, v, n=n: initial(n, c, m, v), c, motion, velocity)
        for n, c in contacts.items()
    }

    def body(carry):
        acc, motion, jar, before, count = carry
        inertial = inertial_forces(run, problem, acc, motion)
        force = Forces(*(s - m for s, m in zip(problem.smooth, inertial, strict=True)))
        pushes, pairs = respond_all(runs, contacts, jar, motion)
        idle = None if pairs is None else before <= tolerance
        step, step_motion = linear_solve(run, problem, force, pushes, pairs, idle)
        slope = -work(run, force, step, step_motion)
        curvature = work(run, inertial_forces(run, problem, step, step_motion), step, step_motion)
        jar_step = {n: jar_of(n, c, step_motion) for n, c in contacts.items()}
        alpha = line_search(runs, contacts, jar, jar_step, slope, curvature, evaluations)
        # A world that is done stays as it is, so that its result does not depend on the others.
        done = before <= tolerance
        alpha = jnp.where(done, 0.0, alpha)
        residual = decrement(slope, pushes, step_motion, pairs) / _scale(problem, motion)

        acc, motion, jar = along(alpha, (acc, motion, jar), (step, step_motion, jar_step))
        return acc, motion, jar, jnp.where(done, before, residual), count + 1

    def going(carry):
        return (carry[4] < iterations) & jnp.any(carry[3] > tolerance)

    infinite = jnp.full_like(start.wrist[0], jnp.inf)
    acc, _, _, residual, count = jax.lax.while_loop(
        going, body, (start, motion, jar, infinite, jnp.zeros((), jnp.int32))
    )
    return Solution(acc, residual, count)


def _solve_free(run: Stages, problem: Problem, start: Acc) -> Solution:
    """Without contacts the objective is quadratic: one elimination solves it, from anywhere."""
    if problem.arm is None:
        acc, _ = newton_step(run, problem, Forces(*problem.smooth), {})
        return Solution(acc, jnp.zeros_like(start.wrist[0]), jnp.ones((), jnp.int32))
    motion = propagate(run, problem.kin, start)
    inertial = inertial_forces(run, problem, start, motion)
    force = Forces(*(s - m for s, m in zip(problem.smooth, inertial, strict=True)))
    step, _ = newton_step(run, problem, force, {})
    acc = jax.tree.map(jnp.add, start, step)
    return Solution(acc, jnp.zeros_like(start.wrist[0]), jnp.ones((), jnp.int32))


def scale(mass: jax.Array, palm: jax.Array, motion: jax.Array) -> jax.Array:
    """See `_scale`: of the object's and the palm's mass and the object's motion."""
    return 100.0 * (mass + palm) + mass * dot(motion[3:], motion[3:])


def _scale(problem: Problem, motion: Spatial) -> jax.Array:
    """Typical size of the objective: object and palm at g, plus the object's present motion."""
    return scale(problem.hand.object_mass, problem.hand.palm_mass, motion.object)
