"""A Newton step on the contact problem by elimination, from the tips to the object.

A contact acts on a link as a wrench and a 6 x 6 contact inertia X'KX: the cost is that of a chain.
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
    respond,
)
from codesign_jax.engines.structured.kinematics import Acc
from codesign_jax.engines.structured.lanes import (
    Stages,
    cross,
    dot,
    scan_links,
    spatial,
    sum_axis,
    sum_fingers,
    sum_items,
)
from codesign_jax.engines.structured.problem import (
    Forces,
    Matrices,
    Problem,
    Spatial,
    on_links,
    relative,
    work,
)


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
        return el.eliminate(run, run(add_link, node, own), axes, arm, tau, joint)

    # Sums over all links at once: the recursion then slices fewer arrays.
    terms = {n: v for n, v in pushes.items() if n.startswith("finger")}
    skin = {n: v for n, v in pushes.items() if n.startswith("hull")}
    joints = run(hull.joint_terms, kin.axes, skin) if skin else None
    terms |= _of_links(skin, slice(1, None))
    own = run(link_terms, problem.matrix.link, force.link, terms), joints
    links = (kin.axes, hand.armature, force.finger)
    node, factors = scan_links(next_joint, _nothing(force.link[:, 0]), links, own, reverse=True)
    if skin:  # what the first joints' rows add to the palm
        zero = jnp.zeros_like(node.p), jnp.zeros_like(node.r)
        node = run(lambda n, s: add_link(n, link_terms(*zero, _of_links(s, 0))), node, skin)
    node = run(add_palm, node, problem.matrix, force, pushes)
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
    slide_axes = wrist_slides(arm)
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
    descent = decrement(-work(run, force, step, motion), pushes, motion, None)
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
