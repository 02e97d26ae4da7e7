"""Newton's method with exact line search on MuJoCo's contact problem, without J, M or H.

minimise over a:  1/2 (a - a_s)' M (a - a_s) + sum_c s_c(J_c a - aref_c), M with armature and
implicit terms. A contact acts on a link as a wrench and a 6 x 6 contact inertia X'KX; one
elimination from the finger tips to the object solves the Newton system.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import elimination as el
from codesign_jax.engines.structured import finger_pairs, hull
from codesign_jax.engines.structured.contact import (
    Contacts,
    contact_inertia,
    contact_wrench,
    line,
    respond,
    slopes,
)
from codesign_jax.engines.structured.hand import HandLanes
from codesign_jax.engines.structured.inertia import Bodies, Smooth
from codesign_jax.engines.structured.kinematics import Acc, Kinematics
from codesign_jax.engines.structured.lanes import (
    Stages,
    cross,
    dot,
    scan_links,
    spatial,
    sum_axis,
    sum_fingers,
    sum_items,
    total,
)


class Spatial(NamedTuple):
    """Spatial motion: palm (6, 1, world), links (6, link, finger, world), object as palm."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array


class Matrices(NamedTuple):
    """Spatial inertia: palm (6, 6, 1, world), links (6, 6, link, finger, world), object."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array


class Problem(NamedTuple):
    """One step's problem: everything that does not change from iteration to iteration.

    Attributes:
      hand: The hand.
      kin: Kinematics.
      body: Inertia of the bodies.
      matrix: The same as matrices.
      smooth: Smooth forces.
      contacts: Contacts by pair of bodies.
      arm: Prescribed accelerations of the palm's coordinates, shape (6, 1, world); None with a
        compliant wrist, whose accelerations are unknowns.
    """

    hand: HandLanes
    kin: Kinematics
    body: Bodies
    matrix: Matrices
    smooth: Smooth
    contacts: dict[str, Contacts]
    arm: jax.Array | None = None


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


def palm_motion(wrist: jax.Array, axes: jax.Array) -> jax.Array:
    """The palm's spatial acceleration of the wrist's slides and hinges."""
    moving = spatial(jnp.zeros_like(wrist[:3]), wrist[:3])
    return moving + total([axes[k] * wrist[3 + k] for k in range(3)])


def next_motion(parent: jax.Array, axes: jax.Array, a: jax.Array) -> jax.Array:
    """A link's spatial acceleration from its parent's and its joint's."""
    return parent + total([axes[k] * a[k] for k in range(axes.shape[0])])


def object_motion(acc: jax.Array, position: jax.Array) -> jax.Array:
    """The object's spatial acceleration from that at its centre."""
    return spatial(acc[:3], acc[3:] + cross(position, acc[:3]))


def propagate(run: Stages, kin: Kinematics, acc: Acc) -> Spatial:
    """Spatial accelerations J a of all bodies, without velocity terms."""
    palm = run(palm_motion, acc.wrist, kin.wrist_axes)

    def step(parent: jax.Array, link: tuple):
        motion = run(next_motion, parent, *link[0])
        return motion, motion

    first = palm + jnp.zeros_like(kin.vel[:, 0])
    _, links = scan_links(step, first, (kin.axes, acc.finger))
    obj = object_motion(acc.object, kin.object_pos)
    return Spatial(palm, jnp.moveaxis(links, 0, 1), obj)


def on_links(name: str) -> bool:
    """Whether the items of a set of contacts are of links or joints, several of each."""
    return name.startswith(("finger", "hull"))


def relative(name: str, motion: Spatial) -> jax.Array:
    """Relative spatial motion of a pair of bodies, with axes for the contacts' items."""
    obj = motion.object
    if name == "finger_finger":
        return finger_pairs.relative(motion.link)
    if name.startswith("hull"):
        moved = hull.across_joints(motion.palm, motion.link)
        if name == "hull_object":
            moved = jnp.concatenate([moved[:6] - obj[:, None], moved[6:]])
        return moved[:, :, None]
    if name == "finger_object":
        return jnp.stack([motion.link[i] - obj[i] for i in range(6)])[:, :, None]
    return {
        "finger_table": motion.link[:, :, None],
        "palm_object": motion.palm - obj,
        "palm_table": motion.palm,
        "object_table": obj,
    }[name]


class Forces(NamedTuple):
    """Forces on the bodies, (6, ...), and on the joints, shaped as `Smooth`."""

    palm: jax.Array
    link: jax.Array
    object: jax.Array
    wrist: jax.Array
    finger: jax.Array


def inertial_forces(run: Stages, problem: Problem, acc: Acc, motion: Spatial) -> Forces:
    """M a in factored form: spatial forces of the bodies and armature forces of the joints."""
    body, hand = problem.body, problem.hand
    return Forces(
        body.palm.times(motion.palm),
        run(lambda b, m: b.times(m), body.link, motion.link),
        body.object.times(motion.object),
        jnp.zeros_like(acc.wrist) if problem.arm is not None else hand.wrist_armature * acc.wrist,
        hand.armature * acc.finger,
    )


def work(run: Stages, force: Forces, acc: Acc, motion: Spatial) -> jax.Array:
    """Product of forces and accelerations over all bodies and joints, shape (1, world)."""

    def product(force: Forces, acc: Acc, motion: Spatial) -> jax.Array:
        links = sum_axis(dot(force.link, motion.link), 0)
        joints = sum_axis(sum_axis(force.finger * acc.finger, 0), 0)
        rest = dot(force.palm, motion.palm) + dot(force.object, motion.object)
        return sum_fingers(links + joints) + rest + dot(force.wrist, acc.wrist)

    return run(product, force, acc, motion)


def newton_step(
    run: Stages, problem: Problem, force: Forces, pushes: dict[str, tuple[jax.Array, jax.Array]]
) -> tuple[Acc, Spatial]:
    """Solves (M + J'WJ) p = -gradient by elimination from the tips to the object.

    Args:
      run: Runs the stages.
      problem: The problem.
      force: Smooth forces minus inertial forces.
      pushes: Contact inertia (6, 6, ...) and wrench (6, ...) by pair of bodies, summed over a
        body's contacts.

    Returns:
      The step in the joints and its spatial motion.
    """
    kin, hand = problem.kin, problem.hand

    def next_joint(node: el.Quadratic, link: tuple):
        (axes, arm, tau), (own, joint) = link
        return el.eliminate(run, run(_add_link, node, own), axes, arm, tau, joint)

    # Sums over all links at once: the recursion then slices fewer arrays.
    terms = {n: v for n, v in pushes.items() if n.startswith("finger")}
    skin = {n: v for n, v in pushes.items() if n.startswith("hull")}
    joints = run(hull.joint_terms, kin.axes, skin) if skin else None
    terms |= _of_links(skin, slice(1, None))
    own = run(_own, problem.matrix.link, force.link, terms), joints
    links = (kin.axes, hand.armature, force.finger)
    node, factors = scan_links(next_joint, _nothing(force.link[:, 0]), links, own, reverse=True)
    if skin:  # what the first joints' rows add to the palm
        zero = jnp.zeros_like(node.p), jnp.zeros_like(node.r)
        node = run(lambda n, s: _add_link(n, _own(*zero, _of_links(s, 0))), node, skin)
    node = run(_add_palm, node, problem.matrix, force, pushes)
    joints, palm, obj = _palm_step(run, problem, force, node)

    def next_link(parent: jax.Array, link: tuple):
        a, motion = run(el.substitute, *link[0], parent, obj)
        return motion, (a, motion)

    first_link = palm + jnp.zeros_like(force.link[:, 0])
    _, (fingers, motions) = scan_links(next_link, first_link, (kin.axes, factors))
    at_centre = spatial(obj[:3], obj[3:] - cross(kin.object_pos, obj[:3]))
    acc = Acc(jnp.concatenate(joints), fingers, at_centre)
    return acc, Spatial(palm, jnp.moveaxis(motions, 0, 1), obj)


def _palm_step(
    run: Stages, problem: Problem, force: Forces, node: el.Quadratic
) -> tuple[list[jax.Array], jax.Array, jax.Array]:
    """Steps of the wrist's joints, and spatial steps of palm and object."""
    if problem.arm is not None:  # known: no step
        obj = el.solve_object(run, node.q, node.r_object)
        return [jnp.zeros_like(problem.arm)], jnp.zeros_like(obj), obj
    arm, axes = problem.hand.wrist_armature, problem.kin.wrist_axes
    node, hinges = el.eliminate(run, node, axes, arm[3:], force.wrist[3:])
    slide_axes = _slides(arm)
    node, slides = el.eliminate(run, node, slide_axes, arm[:3], force.wrist[:3])
    obj = el.solve_object(run, node.q, node.r_object)
    first, palm = run(el.substitute, slide_axes, slides, jnp.zeros_like(obj), obj)
    second, palm = run(el.substitute, axes, hinges, palm, obj)
    return [first, second], palm, obj


def respond_all(
    runs: dict[str, Stages], contacts: dict[str, Contacts], jar: dict[str, jax.Array]
) -> tuple[dict[str, tuple[jax.Array, jax.Array]], finger_pairs.Coupling | None]:
    """What the contacts add to the Newton system: to its elimination, and between the fingers."""
    name = "finger_finger"
    pushes = {n: _push(runs[n], n, c, jar[n]) for n, c in contacts.items() if n != name}
    if name not in contacts:
        return pushes, None
    return pushes, finger_pairs.coupling(runs[name], contacts[name], jar[name])


def linear_solve(
    run: Stages,
    problem: Problem,
    force: Forces,
    pushes: dict[str, tuple[jax.Array, jax.Array]],
    pairs: finger_pairs.Coupling | None,
    idle: jax.Array | None = None,
    tolerance: float = 1e-6,
) -> tuple[Acc, Spatial]:
    """`newton_step` with the contacts between fingers, if the scene has them.

    Args:
      run: Runs the stages.
      problem: The problem.
      force: Smooth forces minus inertial forces.
      pushes: As in `newton_step`.
      pairs: The contacts between fingers.
      idle: Worlds whose step is of no use, shape (1, world).
      tolerance: Squared relative error of the step.
    """
    if pairs is None:
        return newton_step(run, problem, force, pushes)
    force = force._replace(link=force.link + pairs.push)
    step, motion = newton_step(run, problem, force, pushes)
    descent = _decrement(-work(run, force, step, motion), pushes, motion, None)
    none, still = jax.tree.map(jnp.zeros_like, (force, pushes))
    still = {n: (inertia, still[n][1]) for n, (inertia, _) in pushes.items()}

    def precondition(links: jax.Array) -> tuple[Acc, Spatial]:
        return newton_step(run, problem, none._replace(link=links), still)

    active = run.only_if(pairs.contacts.active.any())
    start = step, motion
    idle = jnp.zeros_like(descent, bool) if idle is None else idle
    return finger_pairs.correct(active, pairs, start, descent, idle, precondition, tolerance)


def _of_links(skin: dict, rows: slice | int) -> dict:
    """The hull's contacts as those of the links before its rows."""
    return {
        n.replace("hull", "finger"): (inertia[:6, :6, rows], wrench[:6, rows])
        for n, (inertia, wrench) in skin.items()
    }


def _nothing(like: jax.Array) -> el.Quadratic:
    """The objective beyond the finger tips, for vectors shaped as `like`, (6, finger, world)."""
    matrix = jnp.zeros((6, *like.shape), like.dtype)
    return el.Quadratic(matrix, matrix, matrix, jnp.zeros_like(like), jnp.zeros_like(like))


class Own(NamedTuple):
    """A link's own inertia, forces and contacts.

    Attributes:
      matrix: Inertia with that of all contacts, shape (6, 6, link, finger, world).
      push: Force with that of all contacts, shape (6, link, finger, world).
      object: The contacts with the object alone, alike, if the scene has them.
    """

    matrix: jax.Array
    push: jax.Array
    object: tuple[jax.Array, jax.Array] | None


def _own(matrix: jax.Array, push: jax.Array, terms: dict) -> Own:
    """Sums inertia, forces and contacts of the links."""
    for inertia, wrench in terms.values():
        matrix, push = matrix + inertia, push + wrench
    return Own(matrix, push, terms.get("finger_object"))


def _add_link(node: el.Quadratic, own: Own) -> el.Quadratic:
    """Adds a link's own inertia, forces and contacts to what its children left."""
    p, c, q, r, ro = node
    p, r = p + own.matrix, r + own.push
    if own.object is not None:
        coupling, wrench = own.object
        c, q, ro = c + coupling, q + coupling, ro - wrench
    return el.Quadratic(p, c, q, r, ro)


def _add_palm(node: el.Quadratic, matrix: Matrices, force: Forces, pushes: dict) -> el.Quadratic:
    """Sums the fingers and adds the palm, the object and their contacts."""
    p, c, q, r, ro = (sum_fingers(v) for v in node)
    p, r = p + matrix.palm, r + force.palm
    q, ro = q + matrix.object, ro + force.object
    if "object_table" in pushes:
        inertia, wrench = pushes["object_table"]
        q, ro = q + inertia, ro + wrench
    if "palm_table" in pushes:
        inertia, wrench = pushes["palm_table"]
        p, r = p + inertia, r + wrench
    if "palm_object" in pushes:
        inertia, wrench = pushes["palm_object"]
        p, c, q = p + inertia, c + inertia, q + inertia
        r, ro = r + wrench, ro - wrench
    return el.Quadratic(p, c, q, r, ro)


def _slides(like: jax.Array) -> jax.Array:
    """Motion subspace of the three wrist slides, shape (3, 6, 1, world)."""
    eye = jnp.eye(3, 6, 3, dtype=like.dtype)[:, :, None, None]
    return jnp.broadcast_to(eye, (3, 6, *like.shape[1:]))


def _push(stages: Stages, name: str, c: Contacts, jar: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Contact inertia and wrench of a pair of bodies, summed over the contacts of each body."""

    def summed(c: Contacts, hessian: jax.Array, force: jax.Array):
        matrix, wrench = contact_inertia(c, hessian), contact_wrench(c, force)
        if on_links(name):
            return sum_axis(matrix, 3), sum_axis(wrench, 2)
        return sum_fingers(matrix), sum_fingers(wrench)

    if c.lever is not None:
        return hull.push(stages, c, jar)
    response = stages(respond, c, jar)
    return stages(summed, c, response.hessian, response.force)


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
            if c.lever is None:
                f, s = run[n](summed, c, rays[n], alpha)
            else:
                f, s = hull.line_slopes(run[n], c, rays[n], alpha)
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
        return c.relative(relative(name, motion)) - c.reference(
            c.relative(relative(name, velocity))
        )

    motion = propagate(run, problem.kin, start)
    jar = {
        n: runs[n](lambda c, m, v, n=n: initial(n, c, m, v), c, motion, velocity)
        for n, c in contacts.items()
    }

    def body(carry):
        acc, motion, jar, before, count = carry
        inertial = inertial_forces(run, problem, acc, motion)
        force = Forces(*(s - m for s, m in zip(problem.smooth, inertial, strict=True)))
        pushes, pairs = respond_all(runs, contacts, jar)
        idle = None if pairs is None else before <= tolerance
        step, step_motion = linear_solve(run, problem, force, pushes, pairs, idle)
        slope = -work(run, force, step, step_motion)
        curvature = work(run, inertial_forces(run, problem, step, step_motion), step, step_motion)
        jar_step = {
            n: runs[n](lambda c, m, n=n: c.relative(relative(n, m)), c, step_motion)
            for n, c in contacts.items()
        }
        alpha = line_search(runs, contacts, jar, jar_step, slope, curvature, evaluations)
        # A world that is done stays as it is, so that its result does not depend on the others.
        done = before <= tolerance
        alpha = jnp.where(done, 0.0, alpha)
        residual = _decrement(slope, pushes, step_motion, pairs) / _scale(problem, motion)

        def advance(old, new):
            return jax.tree.map(lambda a, p: a + alpha * p, old, new)

        acc, motion, jar = advance((acc, motion, jar), (step, step_motion, jar_step))
        return acc, motion, jar, jnp.where(done, before, residual), count + 1

    def going(carry):
        return (carry[4] < iterations) & jnp.any(carry[3] > tolerance)

    infinite = jnp.full_like(start.wrist[0], jnp.inf)
    acc, _, _, residual, count = jax.lax.while_loop(
        going, body, (start, motion, jar, infinite, jnp.zeros((), jnp.int32))
    )
    return Solution(acc, residual, count)


def _solve_free(run: Stages, problem: Problem, start: Acc) -> Solution:
    """Without contacts the objective is quadratic: one elimination solves it."""
    motion = propagate(run, problem.kin, start)
    inertial = inertial_forces(run, problem, start, motion)
    force = Forces(*(s - m for s, m in zip(problem.smooth, inertial, strict=True)))
    step, _ = newton_step(run, problem, force, {})
    acc = jax.tree.map(jnp.add, start, step)
    return Solution(acc, jnp.zeros_like(start.wrist[0]), jnp.ones((), jnp.int32))


def _decrement(
    slope: jax.Array, pushes: dict, step: Spatial, pairs: finger_pairs.Coupling | None
) -> jax.Array:
    """Newton decrement -p'gradient, shape (1, world): twice the decrease that the step predicts."""
    pushed = -slope
    for name, (_, wrench) in pushes.items():
        product = dot(
            relative(name, step)[:, :, 0] if on_links(name) else relative(name, step),
            wrench,
        )
        pushed = pushed + sum_items(product)
    if pairs is not None:
        pushed = pushed + finger_pairs.product(pairs.push, step.link)
    return jnp.maximum(pushed, 0.0)


def scale(mass: jax.Array, palm: jax.Array, motion: jax.Array) -> jax.Array:
    """See `_scale`: of the object's and the palm's mass and the object's motion."""
    return 100.0 * (mass + palm) + mass * dot(motion[3:], motion[3:])


def _scale(problem: Problem, motion: Spatial) -> jax.Array:
    """Typical size of the objective: object and palm at g, plus the object's present motion."""
    return scale(problem.hand.object_mass, problem.hand.palm_mass, motion.object)
