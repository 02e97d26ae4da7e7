"""The Newton system of the contact problem by elimination, from the tips to the object.

A contact acts on a link as a wrench and a 6 x 6 contact inertia X'KX: the cost is that of a chain.
The kernel sums links, palm and contacts with the functions of this module; `linear_solve` is the
one system that a derivative solves, in plain JAX.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import coupling, hull
from codesign_jax.engines.structured import elimination as el
from codesign_jax.engines.structured.contact import Contacts, constraint_update, contact_inertia
from codesign_jax.engines.structured.kinematics import Acc
from codesign_jax.engines.structured.lanes import Stages, scan_links, sum_axis, sum_fingers
from codesign_jax.engines.structured.problem import (
    Forces,
    Matrices,
    Problem,
    Spatial,
    inner,
    on_links,
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


def linear_solve(run: Stages, problem: Problem, force: Forces, jar: dict[str, jax.Array]) -> Acc:
    """Solves (M + J'KJ) x = force, K the Hessians of the contacts.

    Args:
      run: Runs the stages.
      problem: The problem.
      force: The right side.
      jar: J a - aref of every contact, where the Hessians are taken.
    """
    between = "finger_finger"
    inertias = {
        name: _inertia(run, name, c, jar[name])
        for name, c in problem.contacts.items()
        if name != between
    }
    done = eliminate(run, problem, force, inertias, keep=between in jar)
    x, motion = substitute(run, problem, done)
    if between not in jar:
        return x
    pairs = coupling.coupling(run, problem.contacts[between], jar[between])

    def again(links: jax.Array) -> tuple[Acc, Spatial]:
        return substitute(run, problem, eliminate_again(run, problem, done, links))

    return coupling.correct(run, pairs, (x, motion), inner(run, force, x, motion), again)[0]


def eliminate(
    run: Stages,
    problem: Problem,
    force: Forces,
    inertias: dict[str, jax.Array],
    *,
    keep: bool = False,
) -> Eliminated:
    """Eliminates all joints from the tips to the object.

    Args:
      run: Runs the stages.
      problem: The problem.
      force: The right side.
      inertias: Contact inertia (6, 6, ...) by pair of bodies, summed over a body's contacts.
      keep: Whether to keep what `eliminate_again` needs.
    """
    kin, hand = problem.kin, problem.hand

    def next_joint(node: el.Quadratic, link: tuple):
        (axes, armature, tau), (own, joint) = link
        node = run(add_link, node, own)
        node, kept = el.eliminate_and_keep(run, node, axes, armature, tau, joint)
        return node, kept if keep else kept._replace(inverse=())

    # Sums over all links at once: the recursion then slices fewer arrays.
    skin = {n: v for n, v in inertias.items() if n.startswith("hull")}
    others = {n: _still(v) for n, v in inertias.items() if n not in skin}
    joints = run(hull.joint_terms, kin.axes, skin) if skin else None
    terms = {n: v for n, v in others.items() if n.startswith("finger")}
    terms |= _of_links(skin, slice(1, None))
    own = run(link_terms, problem.matrix.link, force.link, terms), joints
    links = (kin.axes, hand.armature, force.finger)
    held = any(n.endswith("_object") for n in inertias)
    node = _nothing(force.link[:, 0], held)
    node, fingers = scan_links(next_joint, node, links, own, reverse=True)
    if skin:  # what the first joints' rows add to the palm
        zero = jnp.zeros_like(node.p), jnp.zeros_like(node.r)
        node = run(lambda n, s: add_link(n, link_terms(*zero, _of_links(s, 0))), node, skin)
    node = run(add_palm, node, problem.matrix, force, others)
    if problem.palm_acc is not None:  # known: no step
        return Eliminated(fingers, None, None, node.q, node.r_object)
    armature, wrist = hand.wrist_armature, force.wrist
    node, hinges = el.eliminate_and_keep(run, node, kin.wrist_axes, armature[3:], wrist[3:])
    node, slides = el.eliminate_and_keep(run, node, wrist_slides(armature), armature[:3], wrist[:3])
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
    """Back substitution: the solution in the joints and its spatial motion."""
    kin, like = problem.kin, done.fingers.factors.w[0, 0]
    joints, palm, obj = _palm_step(run, problem, done)

    def next_link(parent: jax.Array, link: tuple):
        a, motion = run(el.substitute, *link[0], parent, obj)
        return motion, (a, motion)

    _, (fingers, motions) = scan_links(
        next_link, palm + jnp.zeros_like(like), (kin.axes, done.fingers.factors)
    )
    acc = Acc(jnp.concatenate(joints), fingers, obj)
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


def _still(inertia: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A contact inertia with the wrench of zero that the system of a derivative has."""
    return inertia, jnp.zeros_like(inertia[0])


def _of_links(skin: dict[str, jax.Array], rows: slice | int) -> dict:
    """The hull's contacts as those of the links before its rows."""
    return {n.replace("hull", "finger"): _still(v[:6, :6, rows]) for n, v in skin.items()}


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


def _inertia(run: Stages, name: str, c: Contacts, jar: jax.Array) -> jax.Array:
    """Contact inertia of a pair of bodies, summed over the contacts of each body."""

    def summed(c: Contacts, jar: jax.Array) -> jax.Array:
        matrix = contact_inertia(c, constraint_update(c, jar).hessian)
        return sum_axis(matrix, 3) if on_links(name) else sum_fingers(matrix)

    return hull.inertia(run, c, jar) if c.lever is not None else run(summed, c, jar)
