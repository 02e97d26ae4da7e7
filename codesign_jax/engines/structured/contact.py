"""Contacts: signed distances of spheres to the object and the table, and MuJoCo's elliptic cone.

A contact's relative velocity and acceleration are those of the hand's (or, on the table, the
object's) point minus the other body's, with the normal pointing the same way; jar = J a - aref as
in MuJoCo.  Within a set of contacts every array has the item axes (link, k, finger), (sphere, 1) or
(slot, 1) before the world's.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import cross, dot


class Cone(NamedTuple):
    """MuJoCo's contact parameters, as numbers of the scene or arrays broadcasting to the contacts.

    Attributes:
      normal: D = 1/R of the normal row [kg].
      tangent: D of the tangential rows, impratio times as much [kg].
      friction: Coulomb coefficient mu.
      ratio: mu / sqrt(impratio), MuJoCo's regularized cone.
      spring: Coefficient of the penetration in aref [1/s^2].
      damper: Coefficient of the velocity in aref [1/s].
    """

    normal: jax.Array | float
    tangent: jax.Array | float
    friction: jax.Array | float
    ratio: jax.Array | float
    spring: float
    damper: float


class Contacts(NamedTuple):
    """A set of contacts between the same two bodies or kinds of bodies.

    Attributes:
      point: Contact points, shape (3, ...).
      normal: Unit normals, shape (3, ...).
      distance: Signed distance [m], negative in contact, shape (...).
      cone: Their parameters.
      lever: Of points that follow a joint's rotation in part, see `hull`, the arm at which they do,
        shape (3, ...).
    """

    point: jax.Array
    normal: jax.Array
    distance: jax.Array
    cone: Cone
    lever: jax.Array | None = None

    @property
    def active(self) -> jax.Array:
        """Which contacts exist, shape (...)."""
        return self.distance < 0

    def relative(self, motion: jax.Array) -> jax.Array:
        """Point motion, (3, ...), of a relative spatial motion, (6, ...); (9, ...) with a lever."""
        moved = motion[3:6] + cross(motion[:3], self.point)
        return moved if self.lever is None else moved + cross(motion[6:], self.lever)

    def reference(self, velocity: jax.Array) -> jax.Array:
        """Reference acceleration aref from the relative point velocity, shape (3, ...)."""
        return -self.cone.damper * velocity - self.cone.spring * self.distance * self.normal


class Response(NamedTuple):
    """Cone force and Hessian at jar.

    Attributes:
      force: -ds/d(jar), shape (3, ...).
      hessian: Upper triangle xx, xy, xz, yy, yz, zz, shape (6, ...).
      cost: s(jar), shape (...).
    """

    force: jax.Array
    hessian: jax.Array
    cost: jax.Array


def respond(contacts: Contacts, jar: jax.Array) -> Response:
    """Evaluates MuJoCo's elliptic cone (engine_core_constraint.c, mj_constraintUpdate) at jar.

    With w_n and w_t the normal and tangential parts of jar: the bottom zone is quadratic in both,
    the middle zone 1/2 D_m (w_n - mu |w_t|)^2 with D_m = D_n / (1 + mu^2 / impratio), the top zone
    zero.
    """
    cone, n = contacts.cone, contacts.normal
    normal = dot(n, jar)
    tangent = jar - normal * n
    length = jnp.sqrt(dot(tangent, tangent) + 1e-30)
    e = tangent / length
    bottom, middle = _zones(contacts, normal, length)
    slip = normal - cone.friction * length
    stiff = jnp.where(middle, cone.normal / (1.0 + cone.ratio**2), 0.0)
    kappa = jnp.where(bottom, cone.tangent, -stiff * slip * cone.friction / length)
    force = jnp.where(bottom, cone.normal * normal, stiff * slip) * -n
    force = force + jnp.where(bottom, -cone.tangent * length, stiff * slip * cone.friction) * e
    nn = jnp.where(bottom, cone.normal, stiff) - kappa
    ne = -stiff * cone.friction
    ee = jnp.where(bottom, 0.0, stiff * cone.friction**2 - kappa)
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    hessian = jnp.stack(
        [
            nn * n[i] * n[j]
            + ne * (n[i] * e[j] + e[i] * n[j])
            + ee * e[i] * e[j]
            + (kappa if i == j else 0.0)
            for i, j in pairs
        ]
    )
    quadratic = cone.normal * normal**2 + cone.tangent * length**2
    cost = 0.5 * jnp.where(bottom, quadratic, stiff * slip**2)
    return Response(force, hessian, cost)


def _zones(contacts: Contacts, normal: jax.Array, length: jax.Array) -> tuple[jax.Array, jax.Array]:
    cone = contacts.cone
    bottom = contacts.active & (cone.ratio**2 * normal + cone.friction * length <= 0)
    middle = contacts.active & ~bottom & (normal < cone.friction * length)
    return bottom, middle


class Line(NamedTuple):
    """A contact's cost along jar + alpha * step: all that the line search needs.

    Attributes:
      n0: Normal part of jar.
      n1: Normal part of the step.
      uu: Squared tangential part of jar.
      uv: Product of the tangential parts.
      vv: Squared tangential part of the step.
    """

    n0: jax.Array
    n1: jax.Array
    uu: jax.Array
    uv: jax.Array
    vv: jax.Array


def line(contacts: Contacts, jar: jax.Array, step: jax.Array) -> Line:
    """Prepares the line search along a step of jar."""
    n0, n1 = dot(contacts.normal, jar), dot(contacts.normal, step)
    u, v = jar - n0 * contacts.normal, step - n1 * contacts.normal
    return Line(n0, n1, dot(u, u), dot(u, v), dot(v, v))


def slopes(contacts: Contacts, ray: Line, alpha: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First and second derivative of the cost along the line, shape (...)."""
    cone = contacts.cone
    normal = ray.n0 + alpha * ray.n1
    square = jnp.maximum(ray.uu + alpha * (2 * ray.uv + alpha * ray.vv), 0.0)
    length = jnp.sqrt(square + 1e-30)
    half = ray.uv + alpha * ray.vv
    rate = half / length
    bottom, middle = _zones(contacts, normal, length)
    slip = normal - cone.friction * length
    slip_rate = ray.n1 - cone.friction * rate
    stiff = cone.normal / (1.0 + cone.ratio**2)
    curve = jnp.maximum(ray.vv - rate**2, 0.0) / length
    first = jnp.where(bottom, cone.normal * normal * ray.n1 + cone.tangent * half, 0.0)
    first = jnp.where(middle, stiff * slip * slip_rate, first)
    second = jnp.where(bottom, cone.normal * ray.n1**2 + cone.tangent * ray.vv, 0.0)
    bent = stiff * (slip_rate**2 - slip * cone.friction * curve)
    return first, jnp.where(middle, bent, second)


def contact_inertia(contacts: Contacts, hessian: jax.Array) -> jax.Array:
    """X'KX with X = [-[r], 1]: a contact's Hessian in spatial accelerations, rows (6, 6, ...).

    With a lever X = [-[r], 1, -[lever]], rows (9, 9, ...).
    """
    xx, xy, xz, yy, yz, zz = hessian
    k = [jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])]
    r = contacts.point
    if contacts.lever is not None:
        arm = contacts.lever
        rows = [*_crossed(r, k), *k, *_crossed(arm, k)]
        return jnp.stack([jnp.concatenate([cross(r, w), w, cross(arm, w)]) for w in rows])
    # Rows of [r]K, then of -[r]K[r]: cross products, never the skew matrix's zeros.
    y = _crossed(r, k)
    upper = [jnp.concatenate([cross(r, row), row]) for row in y]
    lower = [jnp.concatenate([jnp.stack([y[j][i] for j in range(3)]), k[i]]) for i in range(3)]
    return jnp.stack(upper + lower)


def _crossed(r: jax.Array, k: list[jax.Array]) -> list[jax.Array]:
    """Rows of [r]K from those of K."""
    return [r[1] * k[2] - r[2] * k[1], r[2] * k[0] - r[0] * k[2], r[0] * k[1] - r[1] * k[0]]


def contact_wrench(contacts: Contacts, force: jax.Array) -> jax.Array:
    """Spatial force (moment about the origin, force), (6, ...); with a lever its moment as well."""
    lever = [] if contacts.lever is None else [cross(contacts.lever, force)]
    return jnp.concatenate([cross(contacts.point, force), force, *lever])
