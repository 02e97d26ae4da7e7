"""The linear system of a derivative with contacts between fingers, which couple the chains.

With these contacts the Newton matrix is H = P + F: P is what one elimination solves, F couples two
fingers.  H x = g is solved by conjugate gradients preconditioned with P, started at z = P^-1 g
(Nocedal and Wright, Numerical Optimization, 2006, ch. 5).  P^-1 H is the identity but for three
directions a contact, so that the iteration ends after at most 3 n + 1 steps for n contacts, and
often far earlier.  Since H >= P, the residual r has |x - H^-1 g|_H^2 <= r'P^-1 r, which is known:
that is where it stops.  All residuals are J'L for spatial forces L on the links, which is all that
has to be stored.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.contact import Contacts, constraint_update
from codesign_jax.engines.structured.finger_pairs import (
    each_block,
    ends_of,
    on_links,
    relative,
    store,
)
from codesign_jax.engines.structured.lanes import Stages, dot, sum_axis, sum_fingers

ITERATIONS = 60
"""Largest number of conjugate gradient steps; a longer one would be of rounding."""


class Coupling(NamedTuple):
    """Stiffness of the contacts between fingers at a solution.

    Attributes:
      contacts: The contacts.
      hessian: Their Hessians, upper triangles, shape (6, slot, 1, world).
    """

    contacts: Contacts
    hessian: jax.Array

    def apply(self, run: Stages, links: jax.Array) -> jax.Array:
        """F: forces on the links, (6, link, finger, world), of the links' motion."""

        def force(part: Contacts, hessian: jax.Array, links: jax.Array) -> jax.Array:
            d = part.relative(relative(links, ends_of(part).link))
            xx, xy, xz, yy, yz, zz = hessian
            rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
            return jnp.stack([dot(jnp.stack(r), d) for r in rows])

        def add(sums: jax.Array, _: jax.Array, part: Contacts, hessian: jax.Array) -> jax.Array:
            pushed = run(force, part, hessian, links)
            return run(lambda s, c, f: s + on_links(c, f, s), sums, part, pushed)

        return each_block(self.contacts, add, (self.hessian,), jnp.zeros_like(links))


def coupling(run: Stages, c: Contacts, jar: jax.Array) -> Coupling:
    """Evaluates the contacts between fingers at jar."""

    def add(hessian: jax.Array, at: jax.Array, part: Contacts, jar: jax.Array) -> jax.Array:
        return store(hessian, run(lambda c, j: constraint_update(c, j).hessian, part, jar), at)

    empty = jnp.zeros((6, *c.distance.shape), jar.dtype)
    return Coupling(c, each_block(c, add, (jar,), empty))


def product(force: jax.Array, links: jax.Array) -> jax.Array:
    """Work of forces on the links, both (6, link, finger, world), shape (1, world)."""
    return sum_fingers(sum_axis(dot(force, links), 0))


def correct(
    run: Stages,
    pairs: Coupling,
    start: tuple,
    descent: jax.Array,
    precondition: Callable[[jax.Array], tuple],
) -> tuple:
    """Solves (P + F) x = g by preconditioned conjugate gradients, as far as rounding allows.

    Args:
      run: Runs the stages of the pairs.
      pairs: F.
      start: z = P^-1 g as accelerations and spatial motion.
      descent: g'z, shape (1, world).
      precondition: P^-1 J'L of forces L on the links, as accelerations and spatial motion.

    Returns:
      x as accelerations and spatial motion.
    """
    # Squared error of x, relative to its squared size, both as measured by H.
    tolerance = float(jnp.finfo(descent.dtype).eps) ** 1.5

    def apply(motion) -> jax.Array:
        return pairs.apply(run, motion.link)

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
        return jax.lax.while_loop(going, body, first)[0]

    r = -apply(start[1])
    return jax.lax.cond(pairs.contacts.active.any(), iterate, lambda _: start, r)
