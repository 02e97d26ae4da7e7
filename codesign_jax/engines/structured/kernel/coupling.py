"""Newton steps with self-contacts, inside a kernel: conjugate gradients in their forces.

With these contacts the Newton matrix is H = P + J'KJ, P what the elimination solves, K the Hessians
of the self-contacts and J their Jacobian.  H x = g is solved by conjugate gradients
preconditioned with P, started at P^-1 g (Nocedal and Wright, Numerical Optimization, 2006, ch. 5).
P^-1 H is the identity but for three directions a contact, so that the iteration ends after at most
3 n + 1 steps for n contacts, and often far earlier.  Since H >= P, the residual r has
|x - H^-1 g|_H^2 <= r'P^-1 r, which is known: that is where it stops.  The first
residual of x = P^-1 g is -J'KJx, and all later ones are J'f, f a force at each contact: iterates
need no memory but a few numbers a contact, and x = P^-1 (g + J's) with the sum s of the steps.

The iteration is that of Chronopoulos and Gear (s-step iterative methods for symmetric linear
systems, J. Comput. Appl. Math. 25, 1989, with s = 1): both products of a step are taken in one
pass through the contacts, and everything else is updated in a second one.

At each contact are kept, as vectors like jar: "residual", the force f; "response", J P^-1 J'f;
"direction", along which the forces go; "direction_response", the same of it; "force", the sum s;
and "first_response", J P^-1 g.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.memory import anywhere, loop, zeros
from codesign_jax.engines.structured.kernel.placement import Item
from codesign_jax.engines.structured.kernel.problem import Iterate, Problem
from codesign_jax.engines.structured.kernel.rows import Again, Scratch, Side, Slot
from codesign_jax.engines.structured.kernel.sides import OwnSide
from codesign_jax.engines.structured.lanes import contract, dot, sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

ITERATIONS = 60
"""Largest number of conjugate gradient steps; a longer one would be of rounding."""
TOLERANCE = 1e-2
"""Squared error of a step, relative to its squared size, both as measured by H.

An exact solution gains little: Newton's method takes 3 % more iterations than with 1e-6, and
conjugate gradients 40 % fewer (fingers that touch in 120 grasps of scene `paper`).
"""


class Eliminated(NamedTuple):
    """What the palm's elimination leaves for another right side; lanes of a world."""

    hinges: el.Kept | None  # Of the wrist's hinges; None with a rigid arm
    slides: el.Kept | None  # Of its slides; None with a rigid arm
    q: Any  # Matrix that is left of the object, shape (6, 6, 1, world)
    work: Any  # g'P^-1 g of the present right side, shape (1, world)


class Coupling:
    """Corrects a Newton step for the self-contacts."""

    def __init__(
        self,
        problem: Problem,
        self_contacts: ContactList,
        done: Eliminated,
        *,
        tolerance: float = TOLERANCE,
        iterations: int = ITERATIONS,
    ):
        self.problem = problem
        assert problem.sides is not None
        self.sides = problem.sides
        self.contacts = self_contacts
        self.done = done
        self.tolerance = tolerance
        self.iterations = iterations
        self.block = problem.block
        self.links = problem.links

    def correct(self, step: Iterate, idle: jax.Array) -> Iterate:
        """Adds the correction to the fingers' factors z and returns the step of palm and object."""
        work = self.done.work.lane
        self.substitute(Scratch.z, step)
        self._begin(lanes([~idle], (), wide=False))
        none = jnp.zeros_like(work)
        ones = jnp.ones_like(work)
        # Squared error and curvature; squared error and length of the step before; work.
        start = (jnp.int32(0), *self._products(self.contacts), ones, none, work)

        def misses(size: jax.Array, work: jax.Array) -> jax.Array:
            return size > self.tolerance * jnp.abs(work)

        def going(carry: tuple) -> jax.Array:
            count, size, *_, work = carry
            return (count < self.iterations) & anywhere(misses(size, work))

        def body(carry: tuple) -> tuple:
            count, size, bent, last, length, work = carry
            turn = jnp.where(length > 0, size / last, none)
            curvature = bent - turn * size / jnp.where(length > 0, length, ones)
            sound = misses(size, work) & (curvature > 0)
            length = jnp.where(sound, size / jnp.where(sound, curvature, ones), none)
            # The step of a world that has converged has length zero: its contacts add nothing.
            among = self.contacts.masked(sound)
            work = work + length * self._advance(among, length, turn)
            new, bent = self._products(among)
            # A world that has converged keeps its values: they must not depend on other worlds.
            kept = jnp.where(sound, jnp.maximum(new, 0.0), none)
            return count + 1, kept, bent, jnp.where(sound, size, ones), length, work

        work = jax.lax.while_loop(going, body, start)[-1]
        more = self._result(lanes([work > 0], (), wide=False))
        self._add_correction()
        return lanewise(lambda a, b: jax.tree.map(jnp.add, a, b), step, more)

    def _add_correction(self) -> None:
        def add(i: Any, x: jax.Array) -> jax.Array:
            z = lanewise(jnp.add, *self.problem.read(Scratch.z, Again.z_again, item=i))
            self.problem.write(Scratch.z, z, i)
            return x

        jax.lax.fori_loop(0, self.links, add, jnp.int32(0))

    def _begin(self, busy: Lanes) -> None:
        """Stores the first residual, and the relative accelerations by the uncorrected step."""
        contacts = self.contacts

        def store(item: Item, _: OwnSide) -> Lanes:
            hessian = contacts.read(Slot.hessian, item)
            change = self.sides.relative(contacts, item)
            residual = lanewise(
                lambda b, f: jnp.where(b, -f, 0.0), busy, contacts.times_hessian(hessian, change)
            )
            none = lanewise(jnp.zeros_like, residual)
            fields = {Slot.first_response: change, Slot.residual: residual}
            fields |= {Slot.direction: none, Slot.direction_response: none, Slot.force: none}
            for field, value in fields.items():
                contacts.write(field, value, item)
            return residual

        self.sides.lay_each(contacts, store)

    def _products(self, contacts: ContactList) -> tuple[jax.Array, jax.Array]:
        """Applies P^-1 J' to the residual of contacts, and J to that: "response".

        Returns the product of the residual with it, and its curvature, shape (lane,) each.
        """
        self.substitute(Again.z_again, self.again())

        def add(item: Item, sums: list[Lanes]) -> list[Lanes]:
            residual = contacts.read(Slot.residual, item)
            hessian = contacts.read(Slot.hessian, item)
            response = self.sides.relative(contacts, item)
            contacts.write(Slot.response, response, item)

            def both(sums, half, residual, response, force):
                product, stiff = (half * sum_axis(dot(v, response), 0) for v in (residual, force))
                return [sums[0] + product, sums[1] + product + stiff]

            return lanewise(
                both,
                sums,
                item.pairing.half,
                residual,
                response,
                contacts.times_hessian(hessian, response),
            )

        sums = contacts.fold(add, [zeros((), self.problem.like)] * 2)
        size, bent = (self.block.total(v.lane) for v in sums)
        return size, bent

    def _advance(self, contacts: ContactList, length: jax.Array, turn: jax.Array) -> jax.Array:
        """Turns the direction of contacts and goes along it; returns what that gains of the work.

        The new residual is laid on the sides.
        """
        alpha, beta = (lanes([v], (), wide=False) for v in (length, turn))
        names = (
            Slot.residual,
            Slot.response,
            Slot.direction,
            Slot.direction_response,
            Slot.force,
        )

        def move(alpha, beta, residual, response, direction, direction_response, force):
            direction = residual + beta * direction
            direction_response = response + beta * direction_response
            force = force + alpha * direction
            return direction, direction_response, force, residual - alpha * direction

        def store(item: Item, gain: Lanes) -> Lanes:
            side = self.sides.own_side(contacts, item)
            hessian = contacts.read(Slot.hessian, item)
            old = [contacts.read(name, item) for name in names]
            first_response = contacts.read(Slot.first_response, item)
            direction, direction_response, force, residual = lanewise(move, alpha, beta, *old)
            stiff = contacts.times_hessian(hessian, direction_response)
            residual = lanewise(lambda a, r, f: r - a * f, alpha, residual, stiff)
            new = {Slot.residual: residual, Slot.direction: direction}
            new |= {Slot.direction_response: direction_response, Slot.force: force}
            for name, value in new.items():
                contacts.write(name, value, item)
            self.sides.load(contacts, item, side, residual)

            def add(gain, half, direction, first_response):
                return gain + half * sum_axis(dot(direction, first_response), 0)

            return lanewise(add, gain, item.pairing.half, direction, first_response)

        gain = self.sides.lay(contacts, store, zeros((), self.problem.like))
        return self.block.total(gain.lane)

    def _result(self, kept: Lanes) -> Iterate:
        """Solves once more, with the sum of all steps; where that is no descent, without it."""
        contacts = self.contacts

        def store(item: Item, _: OwnSide) -> Lanes:
            force = contacts.read(Slot.force, item)
            return lanewise(lambda k, s: jnp.where(k, s, 0.0), kept, force)

        self.sides.lay_each(contacts, store)
        return self.again()

    # One more right side

    def again(self) -> Iterate:
        """Eliminates the forces that lie on the sides, from the tips to the palm.

        Returns:
          The step of wrist, palm and object; that of each joint is left in `Again.z_again`.
        """
        none = zeros((6,), self.problem.like)

        def step(i: Any, carry: tuple) -> tuple:
            names = (Scratch.axes, Scratch.w, Scratch.g, Again.inverse)
            push = self.sides.wrench_on(i + 1)
            factors = self.problem.read(*names, item=i)
            r, ro, z = lanewise(_again, carry, factors, push)
            self.problem.write(Again.z_again, z, i)
            return r, ro

        r, ro = loop(self.links, step, (none, none), self.block.size, reverse=True)
        if chambers := self.problem.chambers:
            r, ro, _ = chambers.close_again(Again.z_again, r, ro)
        r = self.problem.add_palm_wrench(r)
        at_palm = self._palm(*self.block.sum((r, ro)))
        if chambers:
            chambers.substitute(Again.z_again, at_palm.palm_acc, at_palm.object_acc)
        return at_palm

    def _palm(self, r: Lanes, ro: Lanes) -> Iterate:
        palm = self.problem.palm
        return lanewise(solve_palm_again, self.done, palm.axes, palm.armature, r, ro)

    def substitute(self, z: str, step: Iterate) -> None:
        """Leaves the links' accelerations by a step with the sides of the contacts.

        Args:
          z: Row of what the elimination leaves of each joint, shape (axis, ...).
          step: Accelerations of palm and object, shape (6, ...) each.
        """

        def link(i: Any, parent: Lanes) -> Lanes:
            axes, *factors = self.problem.read(Scratch.axes, Scratch.w, Scratch.g, z, item=i)

            def move(axes, factors, parent, obj):
                return el.substitute(axes, el.Factors(*factors), parent, obj)[1]

            moved = lanewise(move, axes, factors, parent, step.object_acc)
            self.sides.put(Side.link_acc, moved, i + 1)
            return moved

        parent = self.problem.widened(step.palm_acc)
        self.sides.put(Side.link_acc, parent, 0)
        loop(self.links, link, parent, self.block.size)


def solve_palm_again(
    done: Eliminated, axes, armature, r, ro, twist: Any = None, work: Any = None
) -> Any:
    """Wrist, palm and object of another right side, see `elimination.eliminate_again`.

    Args:
      twist: Forces on the wrist's joints; None for none.
      work: Product of the fingers' forces with their step, to which that of these is added and
        which is then returned too; None if nobody asks for it.
    """
    kept: list[el.Factors] = []
    if done.hinges is None or done.slides is None:
        obj = el.solve_object(done.q, ro)
        none = jnp.zeros_like(obj)
        step = Iterate(none, none, obj)
        return step if work is None else (step, work + dot(ro, obj))
    slides = el.wrist_slides(armature)
    for subspace, factors, joints in (
        (axes, done.hinges, slice(3, 6)),
        (slides, done.slides, slice(3)),
    ):
        tau: Any = None if twist is None else twist[joints]
        y: Any = None if work is None else contract(subspace, r[None], 1) + tau
        r, ro, new = el.eliminate_again(subspace, factors, r, ro, tau)
        kept.append(new)
        work = None if work is None else work + dot(y, new.z)
    obj = el.solve_object(done.q, ro)
    first, slides_acc = el.substitute(slides, kept[1], jnp.zeros_like(obj), obj)
    second, palm_acc = el.substitute(axes, kept[0], slides_acc, obj)
    step = Iterate(jnp.concatenate([first, second]), palm_acc, obj)
    return step if work is None else (step, work + dot(ro, obj))


def _again(carry, factors, push):
    """`elimination.eliminate_again` of a link, with a force on it."""
    r, ro = carry
    axes, w, g, inverse = factors
    r = r + push
    y = contract(axes, r[None], 1)
    ro = ro + contract(g, y[:, None], 0)
    return r - contract(w, y[:, None], 0), ro, contract(inverse, y[None], 1)
