"""Newton steps with contacts between fingers, inside a kernel: conjugate gradients in their forces.

The method is that of `codesign_jax.engines.structured.coupling`: H = P + J'KJ, P what the
elimination solves, K the Hessians of the contacts between fingers and J their Jacobian.  The first
residual of x = P^-1 g is -J'KJx, and all later ones are J'f, f a force at each contact: iterates
need no memory but a few numbers a contact, and x = P^-1 (g + J's) with the sum s of the steps.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import elimination as el
from codesign_jax.engines.structured.coupling import ITERATIONS
from codesign_jax.engines.structured.kernel.contacts import direct, zeros
from codesign_jax.engines.structured.kernel.memory import anywhere, loop
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.lanes import contract, dot, sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.newton import wrist_slides
from codesign_jax.engines.structured.problem import object_acceleration

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.newton import Iterate, Newton

TOLERANCE = 1e-6
"""Squared error of a step, relative to its squared size, both as measured by H."""


class Eliminated(NamedTuple):
    """What the palm's elimination leaves for another right side; lanes of a world.

    Attributes:
      hinges: Of the wrist's hinges; None with a rigid arm.
      slides: Of its slides; None with a rigid arm.
      q: Matrix that is left of the object, shape (6, 6, 1, world).
      work: g'P^-1 g of the present right side, shape (1, world).
    """

    hinges: el.Kept | None
    slides: el.Kept | None
    q: Any
    work: Any


class Coupling:
    """Corrects a Newton step for the contacts between fingers."""

    def __init__(self, newton: "Newton", pairs: BoundPairs, done: Eliminated):
        """Takes an iteration's elimination."""
        self.newton, self.pairs, self.done = newton, pairs, done
        self.block, self.links = newton.block, newton.links

    def correct(self, step: "Iterate", idle: jax.Array) -> "Iterate":
        """Adds the correction to the fingers' factors z and returns the step of palm and object.

        Args:
          step: Step without the Hessians of these contacts.
          idle: Lanes of worlds whose step is of no use.
        """
        pairs, work = self.pairs, self.done.work.lane
        self.substitute("z", step)
        pairs.own_motion()
        busy = lanes([~idle], (), wide=False)

        def begin(item: Any, partner: jax.Array) -> None:
            change = pairs.relative(item, partner)
            pairs.write("first", change, item)
            left = lanewise(lambda b, f: jnp.where(b, -f, 0.0), busy, pairs.stiff(item, change))
            pairs.write("left", left, item)
            pairs.write("along", left, item)
            pairs.write("sum", lanewise(jnp.zeros_like, left), item)

        pairs.do(begin)
        size = self._precondition("moved")
        tolerance, like = TOLERANCE, jnp.zeros_like(size)

        def going(carry: tuple) -> jax.Array:
            count, size, work = carry
            return (count < ITERATIONS) & anywhere(size > tolerance * jnp.abs(work))

        def body(carry: tuple) -> tuple:
            count, size, work = carry
            goes = size > tolerance * jnp.abs(work)
            curvature = self._total(self._curvature)
            alpha = jnp.where(goes, size / jnp.where(curvature > 0, curvature, 1.0), like)
            work = work + alpha * self._total(self._gained)
            self._advance(lanes([alpha], (), wide=False))
            new = jnp.maximum(self._precondition("own"), 0.0)
            beta = new / jnp.where(size > 0, size, 1.0)
            self._turn(lanes([beta], (), wide=False))
            return count + 1, jnp.where(goes, new, size), work

        _, _, work = jax.lax.while_loop(going, body, (jnp.int32(0), size, work))
        # What does not descend gives way to the first step, which always does.
        kept = lanes([work > 0], (), wide=False)

        def keep(item: Any, partner: jax.Array) -> None:
            value = lanewise(lambda k, s: jnp.where(k, s, 0.0), kept, pairs.read("sum", item))
            pairs.write("sum", value, item)

        pairs.do(keep)
        more = self.again("sum")

        def add(i: Any, x: jax.Array) -> jax.Array:
            z = lanewise(jnp.add, *self.newton.read("z", "z_again", item=i))
            self.newton.write("z", z, i)
            return x

        jax.lax.fori_loop(0, self.links, add, jnp.int32(0))
        return lanewise(lambda a, b: jax.tree.map(jnp.add, a, b), step, more)

    def _total(self, function: Any) -> jax.Array:
        """Sum over a world's contacts of function(item), each counted once."""

        def add(item: Any, partner: jax.Array, sums: Lanes) -> Lanes:
            return lanewise(lambda s, v: s + 0.5 * sum_axis(v, 0), sums, function(item))

        sums = self.pairs.each(add, zeros((), self.newton.like))
        return self.block.fold(sums.lane, jnp.add)

    def _curvature(self, item: Any) -> Lanes:
        along, moved = self.pairs.read("along", item), self.pairs.read("moved", item)
        stiff = self.pairs.stiff(item, moved)
        return lanewise(lambda a, f, m: dot(a + f, m), along, stiff, moved)

    def _gained(self, item: Any) -> Lanes:
        return lanewise(dot, self.pairs.read("along", item), self.pairs.read("first", item))

    def _advance(self, alpha: Lanes) -> None:
        pairs = self.pairs

        def store(item: Any, partner: jax.Array) -> None:
            along, left = pairs.read("along", item), pairs.read("left", item)
            stiff = pairs.stiff(item, pairs.read("moved", item))
            left = lanewise(lambda a, r, p, f: r - a * (p + f), alpha, left, along, stiff)
            sums = lanewise(lambda a, s, p: s + a * p, alpha, pairs.read("sum", item), along)
            pairs.write("left", left, item)
            pairs.write("sum", sums, item)

        pairs.do(store)

    def _turn(self, beta: Lanes) -> None:
        pairs = self.pairs

        def store(item: Any, partner: jax.Array) -> None:
            for field, new in (("along", pairs.read("left", item)), ("moved", None)):
                new = pairs.relative(item, partner) if new is None else new
                value = lanewise(lambda b, n, o: n + b * o, beta, new, pairs.read(field, item))
                pairs.write(field, value, item)

        pairs.do(store)

    def _precondition(self, field: str) -> jax.Array:
        """Moves the contacts by P^-1 J' of their residual; returns the product with it, (lane,).

        Args:
          field: "moved" to store how they move, "own" to leave each side's own part only.
        """
        pairs = self.pairs
        self.substitute("z_again", self.again("left"))
        pairs.own_motion()

        def add(item: Any, partner: jax.Array, sums: Lanes) -> Lanes:
            change = pairs.relative(item, partner)
            if field == "moved":
                pairs.write("moved", change, item)
            product = lanewise(dot, pairs.read("left", item), change)
            return lanewise(lambda s, v: s + 0.5 * sum_axis(v, 0), sums, product)

        sums = pairs.each(add, zeros((), self.newton.like))
        return self.block.fold(sums.lane, jnp.add)

    # One more right side

    def again(self, field: str) -> "Iterate":
        """Eliminates forces of the contacts, a field of theirs; see `Newton.backward`."""
        self.pairs.load_all(field)
        none = zeros((6,), self.newton.like)

        def step(i: Any, carry: tuple) -> tuple:
            names = ("axes", "w", "g", "inverse")
            r, ro, z = lanewise(
                _again, carry, self.newton.read(*names, item=i), *self.newton.pair_push(i)
            )
            self.newton.write("z_again", z, i)
            return r, ro

        r, ro = loop(self.links, step, (none, none), self.block.size, reverse=True)
        r = self.newton.add_first(r)
        return self._palm(*self.block.sum((r, ro)))

    def _palm(self, r: Lanes, ro: Lanes) -> "Iterate":
        from codesign_jax.engines.structured.kernel.newton import Iterate

        def solve(done: Eliminated, axes, position, armature, r, ro):
            if done.hinges is None or done.slides is None:
                obj = el.solve_object(direct, done.q, ro)
                none = jnp.zeros_like(obj)
                return Iterate(none, object_acceleration(obj, position), none, obj)
            r, ro, hinges = el.eliminate_again(direct, axes, done.hinges, r, ro)
            slide_axes = wrist_slides(armature)
            _, ro, slides = el.eliminate_again(direct, slide_axes, done.slides, r, ro)
            obj = el.solve_object(direct, done.q, ro)
            first, motion = el.substitute(slide_axes, slides, jnp.zeros_like(obj), obj)
            second, motion = el.substitute(axes, hinges, motion, obj)
            at_centre = object_acceleration(obj, position)
            return Iterate(jnp.concatenate([first, second]), at_centre, motion, obj)

        palm = self.newton.palm
        return lanewise(solve, self.done, palm.axes, palm.position, palm.armature, r, ro)

    def substitute(self, z: str, step: "Iterate") -> None:
        """Leaves the links' motion with the sides, see `Newton.forward`."""

        def one(i: Any, parent: Lanes) -> Lanes:
            axes, *factors = self.newton.read("axes", "w", "g", z, item=i)

            def move(axes, factors, parent, obj):
                return el.substitute(axes, el.Factors(*factors), parent, obj)[1]

            moved = lanewise(move, axes, factors, parent, step.object_motion)
            self.pairs.put("motion", moved, i + 1)
            return moved

        parent = self.newton.widened(step.palm_motion)
        self.pairs.put("motion", parent, 0)
        loop(self.links, one, parent, self.block.size)


def _again(carry, factors, push, turned):
    """`elimination.eliminate_again` of a link, with forces on the link and on its joint."""
    (r, ro), (axes, w, g, inverse) = carry, factors
    r = r + push
    y = contract(axes, r[None], 1)
    if turned is not None:
        y = y + contract(axes[:, :3], turned[None], 1)
    ro = ro + contract(g, y[:, None], 0)
    return r - contract(w, y[:, None], 0), ro, contract(inverse, y[None], 1)
