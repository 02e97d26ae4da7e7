"""Newton's method with exact line search on MuJoCo's primal contact problem, without forming J, M or H.

minimise over a:  1/2 (a - a_s)' M (a - a_s) + sum_c s_c(J_c a - aref_c), M with armature and implicit terms.
A contact acts on a link as a wrench and a 6 x 6 contact inertia X'KX; one elimination from the finger tips
to the object solves the Newton system (docs/structured-engine.md).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import elimination as el
from codesign_jax.engines.structured.contact import (
    Contacts,
    Line,
    contact_inertia,
    contact_wrench,
    line,
    respond,
    slopes,
    sum_items,
)
from codesign_jax.engines.structured.hand import HandLanes
from codesign_jax.engines.structured.inertia import Bodies, Smooth
from codesign_jax.engines.structured.kinematics import Acc, Kinematics
from codesign_jax.engines.structured.lanes import cross, dot, spatial, sum_fingers, total


class Spatial(NamedTuple):
    """Spatial motion of palm (6, 1, world), links (6, link, finger, world), object (6, 1, world)."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array


class ContactSet(NamedTuple):
    """Contacts by the pair of bodies that they join; None where the scene has none.

    Attributes:
      finger_object: Items (link, k, finger).
      finger_table: Items (link, k, finger).
      palm_object: Items (sphere,).
      palm_table: Items (sphere,).
      object_table: Items (slot,).
    """

    finger_object: Contacts | None
    finger_table: Contacts | None
    palm_object: Contacts | None
    palm_table: Contacts | None
    object_table: Contacts


class Problem(NamedTuple):
    """One step's problem: everything that does not change from iteration to iteration."""

    hand: HandLanes
    kin: Kinematics
    body: Bodies
    smooth: Smooth
    contacts: ContactSet


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


def propagate(kin: Kinematics, acc: Acc) -> Spatial:
    """Spatial accelerations J a of all bodies, without velocity terms."""
    palm = spatial(jnp.zeros_like(acc.wrist[:3]), acc.wrist[:3])
    palm = palm + total([kin.wrist_axes[k] * acc.wrist[3 + k] for k in range(3)])
    link, links = palm, []
    for i, axes in enumerate(kin.axes):
        link = link + total([axes[a] * acc.finger[i, a] for a in range(axes.shape[0])])
        links.append(link)
    return Spatial(palm, jnp.stack(links, 1), _object_motion(kin, acc.object))


def _object_motion(kin: Kinematics, acc: jax.Array) -> jax.Array:
    """Spatial motion at the origin from (angular, linear at the object's centre)."""
    return spatial(acc[:3], acc[3:] + cross(kin.object_pos, acc[:3]))


def relative(name: str, motion: Spatial) -> jax.Array:
    """Relative spatial motion of a pair of bodies, with the items' axes."""
    obj = motion.object
    if name == "finger_object":
        return jnp.stack([motion.link[i] - obj[i] for i in range(6)])[:, :, None]
    return {
        "finger_table": motion.link[:, :, None],
        "palm_object": motion.palm - obj,
        "palm_table": motion.palm,
        "object_table": obj,
    }[name]


def _present(contacts: ContactSet) -> list[tuple[str, Contacts]]:
    return [(n, c) for n, c in zip(contacts._fields, contacts, strict=True) if c is not None]


def residual_jar(problem: Problem, motion: Spatial, velocity: Spatial) -> dict[str, jax.Array]:
    """jar = J a - aref of every contact."""
    return {
        name: c.relative(relative(name, motion)) - c.reference(c.relative(relative(name, velocity)))
        for name, c in _present(problem.contacts)
    }


def _item_sum(values: jax.Array) -> jax.Array:
    """Sum over all item axes, shape (1, world)."""
    while values.ndim > 2:
        values = sum_items(values, 0)
    return sum_fingers(values)


class _Gradient(NamedTuple):
    """Negative gradient: spatial forces on the bodies and joint forces, and the inertial pieces."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array
    wrist: jax.Array
    finger: jax.Array


def _smooth_residual(problem: Problem, acc: Acc, motion: Spatial) -> _Gradient:
    """Smooth forces minus inertia times acceleration."""
    hand, body, smooth = problem.hand, problem.body, problem.smooth
    return _Gradient(
        smooth.palm - body.palm.times(motion.palm),
        smooth.link - body.link.times(motion.link),
        smooth.object - body.object.times(motion.object),
        smooth.wrist - hand.wrist_armature * acc.wrist,
        smooth.finger - hand.armature * acc.finger,
    )


def _work(force: _Gradient, acc: Acc, motion: Spatial) -> jax.Array:
    """Power-like product of forces and accelerations, shape (1, world)."""
    links = dot(force.link, motion.link)
    joints = _item_sum(force.finger * acc.finger) + dot(force.wrist, acc.wrist)
    return (
        _item_sum(links) + dot(force.palm, motion.palm) + dot(force.object, motion.object) + joints
    )


def newton_step(
    problem: Problem, force: _Gradient, jar: dict[str, jax.Array]
) -> tuple[Acc, Spatial, jax.Array]:
    """Solves (M + J'WJ) p = -gradient by elimination from the tips to the object.

    Returns:
      The step in the joints, its spatial motion, and its product with the contact forces, (1, world).
    """
    kin, contacts = problem.kin, problem.contacts
    inertia, wrench = {}, {}
    for name, c in _present(contacts):
        response = respond(c, jar[name])
        matrix, push = contact_inertia(c, response.hessian), contact_wrench(c, response.force)
        if name.startswith("finger"):
            matrix, push = sum_items(matrix, 3), sum_items(push, 2)
        else:
            matrix, push = sum_fingers(matrix), sum_fingers(push)
        inertia[name], wrench[name] = matrix, push
    link_p, link_r = problem.body.link.matrix(), force.link
    palm_p, palm_r = problem.body.palm.matrix(), force.palm
    object_q = problem.body.object.matrix() + inertia["object_table"]
    object_r = force.object + wrench["object_table"]
    for name in ("finger_object", "finger_table"):
        if name in inertia:
            link_p, link_r = link_p + inertia[name], link_r + wrench[name]
    for name in ("palm_object", "palm_table"):
        if name in inertia:
            palm_p, palm_r = palm_p + inertia[name], palm_r + wrench[name]
    coupling, push = inertia.get("finger_object"), wrench.get("finger_object")
    factors = []
    node = None
    for i in reversed(range(len(kin.axes))):
        p, r = link_p[:, :, i], link_r[:, i]
        zero = jnp.zeros_like(p)
        c = zero if coupling is None else coupling[:, :, i]
        ro = jnp.zeros_like(r) if push is None else -push[:, i]
        if node is None:
            node = el.Quadratic(p, c, c, r, ro)
        else:
            node = el.Quadratic(
                node.p + p, node.c + c, node.q + c, node.r + r, node.r_object + ro
            )
        node, f = el.eliminate(node, kin.axes[i], problem.hand.armature[i], force.finger[i])
        factors.append(f)
    assert node is not None
    node = el.Quadratic(*(sum_fingers(v) for v in node))
    palm_c, palm_w = inertia.get("palm_object"), wrench.get("palm_object")
    node = el.Quadratic(
        node.p + palm_p,
        node.c if palm_c is None else node.c + palm_c,
        node.q + object_q + (0.0 if palm_c is None else palm_c),
        node.r + palm_r,
        node.r_object + object_r - (0.0 if palm_w is None else palm_w),
    )
    arm = problem.hand.wrist_armature
    node, hinges = el.eliminate(node, kin.wrist_axes, arm[3:], force.wrist[3:])
    slide_axes = _slides(arm)
    node, slides = el.eliminate(node, slide_axes, arm[:3], force.wrist[:3])
    obj = el.solve_object(node.q, node.r_object)
    base = jnp.zeros_like(obj)
    first = el.substitute(slides, base, obj)
    palm = total([slide_axes[k] * first[k] for k in range(3)])
    second = el.substitute(hinges, palm, obj)
    palm = palm + total([kin.wrist_axes[k] * second[k] for k in range(3)])
    link, links, fingers = palm, [], []
    for axes, f in zip(kin.axes, reversed(factors), strict=True):
        a = el.substitute(f, link, obj)
        link = link + total([axes[k] * a[k] for k in range(axes.shape[0])])
        link = jnp.stack([link[k] for k in range(6)])
        fingers.append(a)
        links.append(link)
    angular = obj[:3]
    acc = Acc(
        jnp.concatenate([first, second]),
        jnp.stack(fingers),
        spatial(angular, obj[3:] - cross(kin.object_pos, angular)),
    )
    motion = Spatial(palm, jnp.stack(links, 1), obj)
    pushed = dot(motion.object, wrench["object_table"])
    for name in ("palm_object", "palm_table"):
        if name in wrench:
            pushed = pushed + dot(relative(name, motion), wrench[name])
    for name in ("finger_object", "finger_table"):
        if name in wrench:
            pushed = pushed + _item_sum(dot(relative(name, motion)[:, :, 0], wrench[name]))
    return acc, motion, pushed


def _slides(like: jax.Array) -> jax.Array:
    """Motion subspace of the three wrist slides, shape (3, 6, 1, world)."""
    eye = jnp.eye(3, 6, 3, dtype=like.dtype)[:, :, None, None]
    return jnp.broadcast_to(eye, (3, 6, *like.shape[1:]))


def line_search(
    problem: Problem,
    jar: dict[str, jax.Array],
    step: dict[str, jax.Array],
    slope: jax.Array,
    curvature: jax.Array,
    evaluations: int,
) -> jax.Array:
    """Minimises along the step by safeguarded Newton on the convex objective's derivative.

    Args:
      problem: The problem.
      jar: J a - aref of every contact.
      step: J p of every contact.
      slope: Derivative of the smooth part at 0, shape (1, world).
      curvature: Its second derivative, same shape.
      evaluations: Number of evaluations.

    Returns:
      Step length, shape (1, world).
    """
    rays: dict[str, tuple[Contacts, Line]] = {
        n: (c, line(c, jar[n], step[n])) for n, c in _present(problem.contacts)
    }

    def evaluate(alpha: jax.Array) -> tuple[jax.Array, jax.Array]:
        first, second = slope + alpha * curvature, curvature
        for c, ray in rays.values():
            f, s = slopes(c, ray, alpha)
            first, second = first + _item_sum(f), second + _item_sum(s)
        return first, second

    low, high = jnp.zeros_like(slope), jnp.full_like(slope, jnp.inf)
    alpha = jnp.ones_like(slope)
    for _ in range(evaluations):
        first, second = evaluate(alpha)
        low, high = jnp.where(first <= 0, alpha, low), jnp.where(first > 0, alpha, high)
        guess = alpha - first / jnp.maximum(second, 1e-30)
        inside = (guess >= low) & (guess <= high)
        middle = jnp.where(jnp.isinf(high), 2.0 * low, 0.5 * (low + high))
        alpha = jnp.where(inside, guess, middle)
    return alpha


def solve(
    problem: Problem, velocity: Spatial, start: Acc, *, iterations: int, evaluations: int, tolerance: float
) -> Solution:
    """Solves one step's contact problem.

    Args:
      problem: The problem.
      velocity: Spatial velocities of the bodies.
      start: Warm start.
      iterations: Largest number of Newton iterations.
      evaluations: Line-search evaluations per iteration.
      tolerance: Newton decrement, relative to the objective's scale, below which a world is done.
    """
    motion = propagate(problem.kin, start)
    jar = residual_jar(problem, motion, velocity)

    def body(carry):
        acc, motion, jar, _, count = carry
        force = _smooth_residual(problem, acc, motion)
        step, step_motion, pushed = newton_step(problem, force, jar)
        slope = -_work(force, step, step_motion)
        inertial = _Gradient(
            problem.body.palm.times(step_motion.palm),
            problem.body.link.times(step_motion.link),
            problem.body.object.times(step_motion.object),
            problem.hand.wrist_armature * step.wrist,
            problem.hand.armature * step.finger,
        )
        curvature = _work(inertial, step, step_motion)
        decrement = jnp.maximum(pushed - slope, 0.0)
        jar_step = {
            n: c.relative(relative(n, step_motion)) for n, c in _present(problem.contacts)
        }
        alpha = line_search(problem, jar, jar_step, slope, curvature, evaluations)
        # Below rounding the slope has no sign: a full Newton step is then the better one.
        acc = jax.tree.map(lambda a, p: a + alpha * p, acc, step)
        motion = jax.tree.map(lambda a, p: a + alpha * p, motion, step_motion)
        jar = jax.tree.map(lambda a, p: a + alpha * p, jar, jar_step)
        return acc, motion, jar, decrement / _scale(problem, motion), count + 1

    def going(carry):
        return (carry[4] < iterations) & jnp.any(carry[3] > tolerance)

    infinite = jnp.full_like(start.wrist[0], jnp.inf)
    acc, _, _, residual, count = jax.lax.while_loop(
        going, body, (start, motion, jar, infinite, jnp.zeros((), jnp.int32))
    )
    return Solution(acc, residual, count)


def _scale(problem: Problem, motion: Spatial) -> jax.Array:
    """Typical size of the objective: palm and object under gravity, plus their present motion."""
    mass, palm = problem.hand.object_mass, problem.hand.palm_mass
    weight = 100.0 * (mass + palm)
    return weight + mass * dot(motion.object[3:], motion.object[3:])
