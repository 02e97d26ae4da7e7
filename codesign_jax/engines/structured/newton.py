"""A Newton step on the contact problem by elimination, from the tips to the object.

A contact acts on a link as a wrench and a 6 x 6 contact inertia X'KX: the cost is that of a chain.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import coupling, hull
from codesign_jax.engines.structured import elimination as el
from codesign_jax.engines.structured.contact import (
    Contacts,
    contact_inertia,
    contact_wrench,
    respond,
)
from codesign_jax.engines.structured.kinematics import Acc
from codesign_jax.engines.structured.lanes import (
    Stages,
    dot,
    scan_links,
    sum_axis,
    sum_fingers,
    sum_items,
)
from codesign_jax.engines.structured.problem import (
    Forces,
    Matrices,
    Problem,
    Spatial,
    object_acceleration,
    on_links,
    relative,
    work,
)


class Eliminated(NamedTuple):
    """An eliminated Newton system, from the tips to the object.

    Attributes:
      fingers: Factors of the fingers' joints, leading axis (link,).
      hinges: Of the wrist's hinges; None with a rigid arm.
      slides: Of its slides; None with a rigid arm.
      q: Matrix that is left of the object, shape (6, 6, 1, world).
      r_object: Force that is left on it, shape (6, 1, world).
    """

    fingers: el.Kept
    hinges: el.Kept | None
    slides: el.Kept | None
    q: jax.Array
    r_object: jax.Array


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
    return substitute(run, problem, eliminate(run, problem, force, pushes))


def eliminate(
    run: Stages,
    problem: Problem,
    force: Forces,
    pushes: dict[str, tuple[jax.Array, jax.Array]],
    *,
    keep: bool = False,
) -> Eliminated:
    """First half of `newton_step`; keep: also what `eliminate_again` needs."""
    kin, hand = problem.kin, problem.hand

    def next_joint(node: el.Quadratic, link: tuple):
        (axes, arm, tau), (own, joint) = link
        node, kept = el.eliminate_and_keep(run, run(add_link, node, own), axes, arm, tau, joint)
        return node, kept if keep else kept._replace(inverse=())

    # Sums over all links at once: the recursion then slices fewer arrays.
    terms = {n: v for n, v in pushes.items() if n.startswith("finger")}
    skin = {n: v for n, v in pushes.items() if n.startswith("hull")}
    joints = run(hull.joint_terms, kin.axes, skin) if skin else None
    terms |= _of_links(skin, slice(1, None))
    own = run(link_terms, problem.matrix.link, force.link, terms), joints
    links = (kin.axes, hand.armature, force.finger)
    held = any(n.endswith("_object") for n in pushes)
    node = _nothing(force.link[:, 0], held)
    node, fingers = scan_links(next_joint, node, links, own, reverse=True)
    if skin:  # what the first joints' rows add to the palm
        zero = jnp.zeros_like(node.p), jnp.zeros_like(node.r)
        node = run(lambda n, s: add_link(n, link_terms(*zero, _of_links(s, 0))), node, skin)
    node = run(add_palm, node, problem.matrix, force, pushes)
    if problem.arm is not None:  # known: no step
        return Eliminated(fingers, None, None, node.q, node.r_object)
    arm, wrist = hand.wrist_armature, force.wrist
    node, hinges = el.eliminate_and_keep(run, node, kin.wrist_axes, arm[3:], wrist[3:])
    node, slides = el.eliminate_and_keep(run, node, wrist_slides(arm), arm[:3], wrist[:3])
    return Eliminated(fingers, hinges, slides, node.q, node.r_object)


def eliminate_again(
    run: Stages, problem: Problem, done: Eliminated, links: jax.Array
) -> Eliminated:
    """The same matrix with no forces but those on the links, shape (6, link, finger, world)."""
    kin, slides = problem.kin, wrist_slides(problem.hand.wrist_armature)

    def next_joint(node: tuple, link: tuple):
        (axes, kept), push = link
        r, ro, factors = el.eliminate_again(run, axes, kept, node[0] + push, node[1])
        return (r, ro), factors.z

    none = jnp.zeros_like(links[:, 0])
    each = (kin.axes, done.fingers)
    (r, ro), z = scan_links(next_joint, (none, none), each, links, reverse=True)
    r, ro = sum_fingers(r), sum_fingers(ro)
    fingers = done.fingers._replace(factors=done.fingers.factors._replace(z=z))
    if done.hinges is None or done.slides is None:
        return done._replace(fingers=fingers, r_object=ro)
    r, ro, hinges = el.eliminate_again(run, kin.wrist_axes, done.hinges, r, ro)
    _, ro, slides = el.eliminate_again(
        run, wrist_slides(problem.hand.wrist_armature), done.slides, r, ro
    )
    hinges, slides = done.hinges._replace(factors=hinges), done.slides._replace(factors=slides)
    return Eliminated(fingers, hinges, slides, done.q, ro)


def substitute(run: Stages, problem: Problem, done: Eliminated) -> tuple[Acc, Spatial]:
    """Second half of `newton_step`: the step in the joints and its spatial motion."""
    kin, like = problem.kin, done.fingers.factors.w[0, 0]
    joints, palm, obj = _palm_step(run, problem, done)

    def next_link(parent: jax.Array, link: tuple):
        a, motion = run(el.substitute, *link[0], parent, obj)
        return motion, (a, motion)

    _, (fingers, motions) = scan_links(
        next_link, palm + jnp.zeros_like(like), (kin.axes, done.fingers.factors)
    )
    acc = Acc(jnp.concatenate(joints), fingers, object_acceleration(obj, kin.object_pos))
    return acc, Spatial(palm, jnp.moveaxis(motions, 0, 1), obj)


def _palm_step(
    run: Stages, problem: Problem, done: Eliminated
) -> tuple[list[jax.Array], jax.Array, jax.Array]:
    """Steps of the wrist's joints, and spatial steps of palm and object."""
    obj = el.solve_object(run, done.q, done.r_object)
    if done.hinges is None or done.slides is None:
        return [jnp.zeros_like(problem.hand.wrist_armature)], jnp.zeros_like(obj), obj
    axes = wrist_slides(problem.hand.wrist_armature)
    first, palm = run(el.substitute, axes, done.slides.factors, jnp.zeros_like(obj), obj)
    second, palm = run(el.substitute, problem.kin.wrist_axes, done.hinges.factors, palm, obj)
    return [first, second], palm, obj


def respond_all(
    runs: dict[str, Stages],
    contacts: dict[str, Contacts],
    jar: dict[str, jax.Array],
    motion: Spatial,
) -> tuple[dict[str, tuple[jax.Array, jax.Array]], coupling.Coupling | None]:
    """What the contacts add to the Newton system: to its elimination, and between the fingers."""
    name = "finger_finger"
    pushes = {n: _push(runs[n], n, c, jar[n]) for n, c in contacts.items() if n != name}
    if name not in contacts:
        return pushes, None
    return pushes, coupling.coupling(runs[name], contacts[name], jar[name], motion.link)


def linear_solve(
    run: Stages,
    problem: Problem,
    force: Forces,
    pushes: dict[str, tuple[jax.Array, jax.Array]],
    pairs: coupling.Coupling | None,
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
    done = eliminate(run, problem, force, pushes, keep=True)
    step, motion = substitute(run, problem, done)
    descent = decrement(-work(run, force, step, motion), pushes, motion, None)

    def again(links: jax.Array) -> tuple[Acc, Spatial]:
        return substitute(run, problem, eliminate_again(run, problem, done, links))

    active = run.only_if(pairs.contacts.active.any())
    idle = jnp.zeros_like(descent, bool) if idle is None else idle
    start = step, motion
    return coupling.correct(active, pairs, start, descent, idle, again, tolerance)


def _of_links(skin: dict, rows: slice | int) -> dict:
    """The hull's contacts as those of the links before its rows."""
    return {
        n.replace("hull", "finger"): (inertia[:6, :6, rows], wrench[:6, rows])
        for n, (inertia, wrench) in skin.items()
    }


def _nothing(like: jax.Array, held: bool) -> el.Quadratic:
    """The objective beyond the finger tips, for vectors shaped as `like`, (6, finger, world).

    Args:
      like: Such a vector.
      held: Whether anything of the hand may touch the object: if not it is a body by itself.
    """
    matrix, none = jnp.zeros((6, *like.shape), like.dtype), jnp.zeros_like(like)
    if not held:
        return el.Quadratic(matrix, None, None, none, None)
    return el.Quadratic(matrix, matrix, matrix, none, none)


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


def link_terms(matrix: jax.Array, push: jax.Array, terms: dict) -> Own:
    """Sums inertia, forces and contacts of the links."""
    for inertia, wrench in terms.values():
        matrix, push = matrix + inertia, push + wrench
    return Own(matrix, push, terms.get("finger_object"))


def add_link(node: el.Quadratic, own: Own) -> el.Quadratic:
    """Adds a link's own inertia, forces and contacts to what its children left."""
    p, c, q, r, ro = node
    p, r = p + own.matrix, r + own.push
    if own.object is not None:
        coupling, wrench = own.object
        c, q, ro = c + coupling, q + coupling, ro - wrench
    return el.Quadratic(p, c, q, r, ro)


def add_palm(node: el.Quadratic, matrix: Matrices, force: Forces, pushes: dict) -> el.Quadratic:
    """Sums the fingers and adds the palm, the object and their contacts."""
    sums: Any = [None if v is None else sum_fingers(v) for v in node]
    p, c, q, r, ro = sums
    p, r = p + matrix.palm, r + force.palm
    q = matrix.object if q is None else q + matrix.object
    ro = force.object if ro is None else ro + force.object
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


def wrist_slides(like: jax.Array) -> jax.Array:
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


def decrement(
    slope: jax.Array, pushes: dict, step: Spatial, pairs: coupling.Coupling | None
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
        pushed = pushed + coupling.product(pairs.push, step.link)
    return jnp.maximum(pushed, 0.0)
