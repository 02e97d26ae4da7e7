"""Contacts between spheres of different fingers, which couple the chains.

Every sphere of one finger is a candidate against every sphere of another; pairs of fingers are in
the lexical order (0, 1), (0, 2), ..., the relative motion is the first finger's minus the second's.
Items have the axes (link, k, link of the second, k of the second, pair, world).

With these contacts the Newton matrix is H = P + F: P is what one elimination solves, F couples two
fingers.  H x = g is solved by conjugate gradients preconditioned with P, started at z = P^-1 g
(Nocedal and Wright, Numerical Optimization, 2006, ch. 5).  P^-1 H is the identity but for three
directions a contact, so that the iteration ends after at most 3 n + 1 steps for n contacts, and
often far earlier.  Since H >= P, the residual r has |x - H^-1 g|_H^2 <= r'P^-1 r, which is known:
that is where it stops.  All residuals are J'L for spatial forces L on the links, which is all that
has to be stored.  A result that does not descend gives way to z, which always does; the exact line
search thus decreases the objective in every Newton step however early the iteration is cut off.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.collision import make_cone
from codesign_jax.engines.structured.contact import Contacts, contact_wrench, respond
from codesign_jax.engines.structured.lanes import Stages, dot, sum_axis, sum_fingers, total
from codesign_jax.scene import Scene

ITERATIONS = 60
"""Largest number of conjugate gradient steps; a longer one would be of rounding."""


def finger_pairs(fingers: int) -> list[tuple[int, int]]:
    """Pairs of fingers."""
    return list(itertools.combinations(range(fingers), 2))


def _both(x: jax.Array, fingers_axis: int) -> tuple[jax.Array, jax.Array]:
    """Values of the first and the second fingers of all pairs, stacked along the finger axis."""
    pairs = finger_pairs(x.shape[fingers_axis])

    def pick(side: int) -> jax.Array:
        return jnp.concatenate(
            [jax.lax.slice_in_dim(x, p[side], p[side] + 1, axis=fingers_axis) for p in pairs],
            fingers_axis,
        )

    return pick(0), pick(1)


def contacts(scene: Scene, centre: jax.Array, radius: jax.Array) -> Contacts:
    """Contacts of all pairs of spheres.

    Args:
      scene: The scene.
      centre: Sphere centres, shape (3, link, k, finger, world).
      radius: Radii, shape (link, k, finger, world).
    """
    a, b = _both(centre, 3)
    a, b = a[:, :, :, None, None], b[:, None, None]
    ra, rb = _both(radius, 2)
    ra, rb = ra[:, :, None, None], rb[None, None]
    away = a - b
    square = dot(away, away)
    apart = square > 0
    length = jnp.sqrt(jnp.where(apart, square, 1.0))
    # Concentric spheres have no normal: MuJoCo takes the x axis, from the first to the second.
    fallback = jnp.stack([-jnp.ones_like(square), 0 * square, 0 * square])
    normal = jnp.where(apart, away / length, fallback)
    gap = jnp.where(apart, length, 0.0) - (ra + rb)
    point = a - normal * (ra + 0.5 * gap)
    cone = make_cone(scene, scene.contact.finger_finger_friction, bodies=2)
    return Contacts(point, normal, gap, cone)


def relative(links: jax.Array) -> jax.Array:
    """Relative spatial motion of all pairs of links, shape (6, link, 1, link, 1, pair, world)."""
    first, second = _both(links, 2)
    return first[:, :, None, None, None] - second[:, None, None, :, None]


def link_wrench(c: Contacts, force: jax.Array) -> jax.Array:
    """Spatial forces on the links, shape (6, link, finger, world), from those on the contacts."""
    wrench = sum_axis(sum_axis(contact_wrench(c, force), 4), 2)  # (6, link, link, pair, world)
    first, second = sum_axis(wrench, 2), sum_axis(wrench, 1)
    pairs = first.shape[2]
    fingers = next(n for n in range(2, pairs + 2) if len(finger_pairs(n)) == pairs)
    sums = []
    for f in range(fingers):
        terms = [first[:, :, i] for i, p in enumerate(finger_pairs(fingers)) if p[0] == f]
        terms += [-second[:, :, i] for i, p in enumerate(finger_pairs(fingers)) if p[1] == f]
        sums.append(total(terms))
    return jnp.stack(sums, 2)


class Coupling(NamedTuple):
    """Response of the pairs of fingers at an iterate.

    Attributes:
      contacts: The contacts.
      hessian: Their Hessians, upper triangles, shape (6, ...).
      push: Their forces on the links, shape (6, link, finger, world).
    """

    contacts: Contacts
    hessian: jax.Array
    push: jax.Array

    def apply(self, links: jax.Array) -> jax.Array:
        """F: forces on the links, (6, link, finger, world), of the links' motion."""
        d = self.contacts.relative(relative(links))
        xx, xy, xz, yy, yz, zz = self.hessian
        rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        return link_wrench(self.contacts, jnp.stack([dot(jnp.stack(r), d) for r in rows]))


def coupling(run: Stages, c: Contacts, jar: jax.Array) -> Coupling:
    """Evaluates the pairs of fingers at jar."""

    def evaluate(c: Contacts, jar: jax.Array) -> tuple[jax.Array, jax.Array]:
        response = respond(c, jar)
        return response.hessian, link_wrench(c, response.force)

    return Coupling(c, *run(evaluate, c, jar))


def product(force: jax.Array, links: jax.Array) -> jax.Array:
    """Work of forces on the links, both (6, link, finger, world), shape (1, world)."""
    return sum_fingers(sum_axis(dot(force, links), 0))


def correct(
    run: Stages,
    pairs: Coupling,
    start: tuple,
    descent: jax.Array,
    idle: jax.Array,
    precondition: Callable[[jax.Array], tuple],
    tolerance: float,
) -> tuple:
    """Solves (P + F) x = g by preconditioned conjugate gradients.

    Args:
      run: Runs the stages of the pairs.
      pairs: F.
      start: z = P^-1 g as accelerations and spatial motion.
      descent: g'z, shape (1, world).
      idle: Worlds for which nothing is done, shape (1, world).
      precondition: P^-1 J'L of forces L on the links, as accelerations and spatial motion.
      tolerance: Squared error of x, relative to its squared size, both as measured by H.

    Returns:
      x as accelerations and spatial motion.
    """

    def apply(motion) -> jax.Array:
        return run(lambda p, v: p.apply(v), pairs, motion.link)

    def plus(x, scale, p):
        return jax.tree.map(lambda a, b: a + scale * b, x, p)

    def body(carry: tuple) -> tuple:
        x, gx, r, p, q, rz, count = carry
        fp = apply(p[1])
        going = rz > tolerance * jnp.abs(gx)
        # q = P p in forces, so that p'H p = p'q + p'F p and g'p = z'q.
        curvature = product(q + fp, p[1].link)
        alpha = jnp.where(going, rz / jnp.where(curvature > 0, curvature, 1.0), 0.0)
        x, r = plus(x, alpha, p), r - alpha * (q + fp)
        gx = gx + alpha * product(q, start[1].link)
        z = precondition(r)
        new = jnp.maximum(product(r, z[1].link), 0.0)
        beta = new / jnp.where(rz > 0, rz, 1.0)
        return x, gx, r, plus(z, beta, p), r + beta * q, jnp.where(going, new, rz), count + 1

    def going(carry: tuple) -> jax.Array:
        return (carry[6] < ITERATIONS) & jnp.any(carry[5] > tolerance * jnp.abs(carry[1]))

    def iterate(r: jax.Array) -> tuple:
        z = precondition(r)
        rz = jnp.maximum(product(r, z[1].link), 0.0)
        first = (start, descent, r, z, r, rz, jnp.zeros((), jnp.int32))
        x, gx, *_ = jax.lax.while_loop(going, body, first)
        return jax.tree.map(lambda a, b: jnp.where(gx > 0, a, b), x, start)

    r = jnp.where(idle, 0.0, -apply(start[1]))
    return jax.lax.cond(pairs.contacts.active.any(), iterate, lambda _: start, r)
