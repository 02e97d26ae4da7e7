"""Contacts: implicit compliance in the problem of MuJoCo's elliptic cone.

A contact has a stiffness k and a dissipation time tau.  Its normal force is that of the end of the
step h, f = -k (g + (h + tau) v+) and never a pull, for the gap g at its beginning, v+ = v + h a.
In the solver's terms that is a row of D = k h (h + tau) with aref = -v/h - K g, in contact
K = 1/(h (h + tau)).  A gap closes within the step at the earliest: there K = 1/h^2.

A contact's relative velocity and acceleration are those of the hand's (or, on the table, the
object's) point minus the other body's, with the normal pointing the same way; jar = J a - aref as
in MuJoCo. Without friction its tangential part is ignored. Within a set of contacts every array has
the item axes (link, k, finger), (sphere, 1) or (slot, 1) before the world's.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import cross, dot

MARGIN = 2e-3
"""Gap below which a contact is a candidate, whatever its velocity [m]."""


class Cone(NamedTuple):
    """A contact's parameters, as numbers or arrays that broadcast to the contacts.

    What a friction model does not need is None: it has no place in the program.
    """

    # MuJoCo's constraint mass D of the normal row, at the scene's stiffness [kg]
    normal_mass: jax.Array | float
    tangential_mass: jax.Array | float  # D of the tangential rows [kg]
    friction: jax.Array | float  # Coulomb coefficient mu
    regularized_friction: jax.Array | float  # mu sqrt(D / D_t), `mu` of MuJoCo's contacts
    spring: jax.Array | float  # K, coefficient of the penetration in aref [1/s^2]
    damper: jax.Array | float  # Coefficient of the velocity in aref, 1/h [1/s]

    def of_share(self, share: jax.Array) -> "Cone":
        """This cone with its stiffness scaled by `share`, which is 0 where there is no contact."""
        tangential_mass = None if self.tangential_mass is None else self.tangential_mass * share
        return self._replace(normal_mass=self.normal_mass * share, tangential_mass=tangential_mass)

    def of_friction(self, friction: jax.Array) -> "Cone":
        """This cone with other Coulomb coefficients and the same stiffness."""
        if self.friction is None:
            return self
        regularized_friction = friction * jnp.sqrt(self.normal_mass / self.tangential_mass)
        return self._replace(friction=friction, regularized_friction=regularized_friction)


class Contacts(NamedTuple):
    """A set of contacts between the same two bodies or kinds of bodies."""

    point: jax.Array  # Contact points, shape (3, ...)
    normal: jax.Array  # Unit normals, shape (3, ...)
    gap: jax.Array  # Distance of the surfaces [m], negative in contact, shape (...)
    cone: Cone  # Their parameters, see `Cone.of_share`

    @property
    def active(self) -> jax.Array:
        return jnp.asarray(self.cone.normal_mass > 0)

    def relative(self, motion: jax.Array) -> jax.Array:
        """Relative velocity of the points, shape (3, ...).

        Accelerations without velocity terms, and virtual ones, are related in the same way.

        Args:
          motion: Relative spatial velocity or acceleration, shape (6, ...).
        """
        return motion[3:6] + cross(motion[:3], self.point)

    def reference(self, velocity: jax.Array) -> jax.Array:
        """Reference acceleration aref from the relative point velocity, shaped as that."""
        cone = self.cone
        gap = self.gap
        spring = jnp.where(gap < 0, cone.spring, cone.damper**2) * gap
        return -cone.damper * velocity - spring * self.normal


def candidates(
    share: jax.Array, gap: jax.Array, approach: jax.Array, cone: Cone, margin: float
) -> jax.Array:
    """Shares of the contacts that may act within the step, 0 of the others; the solver decides.

    Args:
      share: Shares of the scene's stiffness, shape (...).
      gap: Their gaps [m].
      approach: Speed at which they close [m/s].
      margin: `MARGIN`; 0 of balls, which act from touch on, as MuJoCo's.
    """
    reach = jnp.maximum(margin, approach / cone.damper) if margin else 0.0
    return jnp.where(gap < reach, share, 0.0)


class ConeResponse(NamedTuple):
    """Cone force and Hessian at jar."""

    force: jax.Array  # -ds/d(jar), shape (3, ...)
    # Upper triangle xx, xy, xz, yy, yz, zz, shape (6, ...)
    hessian: jax.Array
    cost: jax.Array  # s(jar), shape (...)


def constraint_update(contacts: Contacts, jar: jax.Array) -> ConeResponse:
    """Evaluates MuJoCo's elliptic cone (engine_core_constraint.c, mj_constraintUpdate) at jar.

    With w_n and w_t the normal and tangential parts of jar: the bottom zone is quadratic in both,
    the middle zone 1/2 D_m (w_n - mu |w_t|)^2 with D_m = D_n / (1 + mu^2 / impratio), the top zone
    zero.
    """
    cone = contacts.cone
    n = contacts.normal
    if cone.friction is None:
        return _update_frictionless(contacts, jar)
    jar_normal = dot(n, jar)
    jar_tangent = jar - jar_normal * n
    length = jnp.sqrt(dot(jar_tangent, jar_tangent) + 1e-30)
    e = jar_tangent / length
    bottom, middle = _zones(contacts, jar_normal, length)
    slip = jar_normal - cone.friction * length
    stiff = jnp.where(middle, cone.normal_mass / (1.0 + cone.regularized_friction**2), 0.0)
    kappa = jnp.where(bottom, cone.tangential_mass, -stiff * slip * cone.friction / length)
    force = jnp.where(bottom, cone.normal_mass * jar_normal, stiff * slip) * -n
    sticking = -cone.tangential_mass * length
    sliding = stiff * slip * cone.friction
    force = force + jnp.where(bottom, sticking, sliding) * e
    nn = jnp.where(bottom, cone.normal_mass, stiff) - kappa
    ne = -stiff * cone.friction
    ee = jnp.where(bottom, 0.0, stiff * cone.friction**2 - kappa)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    hessian = jnp.stack(
        [
            nn * n[i] * n[j]
            + ne * (n[i] * e[j] + e[i] * n[j])
            + ee * e[i] * e[j]
            + (kappa if i == j else 0.0)
            for i, j in pairs
        ]
    )
    quadratic = cone.normal_mass * jar_normal**2 + cone.tangential_mass * length**2
    cost = 0.5 * jnp.where(bottom, quadratic, stiff * slip**2)
    return ConeResponse(force, hessian, cost)


def _update_frictionless(contacts: Contacts, jar: jax.Array) -> ConeResponse:
    """One row a contact: quadratic in the normal part where that is negative."""
    n = contacts.normal
    jar_normal = dot(n, jar)
    stiff = jnp.where(contacts.active & (jar_normal < 0), contacts.cone.normal_mass, 0.0)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    hessian = jnp.stack([stiff * n[i] * n[j] for i, j in pairs])
    return ConeResponse(-stiff * jar_normal * n, hessian, 0.5 * stiff * jar_normal**2)


def _zones(
    contacts: Contacts, jar_normal: jax.Array, length: jax.Array
) -> tuple[jax.Array, jax.Array]:
    cone = contacts.cone
    # With D_n / D_t = 1 / impratio; where friction is zero nothing sticks.
    bottom = contacts.active & (
        cone.friction * cone.normal_mass * jar_normal + cone.tangential_mass * length <= 0
    )
    middle = contacts.active & ~bottom & (jar_normal < cone.friction * length)
    return bottom, middle


class LineCost(NamedTuple):
    """A contact's cost along jar + alpha * step: all that the line search needs.

    Without friction the tangential parts are None.
    """

    n0: jax.Array  # Normal part of jar
    n1: jax.Array  # Normal part of the step
    uu: jax.Array  # Squared tangential part of jar
    uv: jax.Array  # Product of the tangential parts
    vv: jax.Array  # Squared tangential part of the step


def line(contacts: Contacts, jar: jax.Array, step: jax.Array) -> LineCost:
    """Prepares the line search along a step of jar."""
    n0 = dot(contacts.normal, jar)
    n1 = dot(contacts.normal, step)
    if contacts.cone.friction is None:
        return LineCost(n0, n1, None, None, None)
    u = jar - n0 * contacts.normal
    v = step - n1 * contacts.normal
    return LineCost(n0, n1, dot(u, u), dot(u, v), dot(v, v))


def same_zone(contacts: Contacts, ray: LineCost, alpha: jax.Array) -> jax.Array:
    """Whether the contacts are in one zone of the cone, see `constraint_update`, at 0 and alpha."""
    jar_normals = ray.n0, ray.n0 + alpha * ray.n1
    if contacts.cone.friction is None:
        before, after = (jar_normal < 0 for jar_normal in jar_normals)
        return ~contacts.active | (before == after)
    squares = ray.uu, ray.uu + alpha * (2 * ray.uv + alpha * ray.vv)
    lengths = [jnp.sqrt(jnp.maximum(s, 0.0) + 1e-30) for s in squares]
    before, after = (
        _zones(contacts, n, size) for n, size in zip(jar_normals, lengths, strict=True)
    )
    return (before[0] == after[0]) & (before[1] == after[1])


def slopes(contacts: Contacts, ray: LineCost, alpha: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First and second derivative of the cost along the line, shape (...)."""
    cone = contacts.cone
    jar_normal = ray.n0 + alpha * ray.n1
    if cone.friction is None:
        stiff = jnp.where(contacts.active & (jar_normal < 0), cone.normal_mass, 0.0)
        return stiff * jar_normal * ray.n1, stiff * ray.n1**2
    square = jnp.maximum(ray.uu + alpha * (2 * ray.uv + alpha * ray.vv), 0.0)
    length = jnp.sqrt(square + 1e-30)
    half = ray.uv + alpha * ray.vv
    rate = half / length
    bottom, middle = _zones(contacts, jar_normal, length)
    slip = jar_normal - cone.friction * length
    slip_rate = ray.n1 - cone.friction * rate
    stiff = cone.normal_mass / (1.0 + cone.regularized_friction**2)
    curve = jnp.maximum(ray.vv - rate**2, 0.0) / length
    sticking = cone.normal_mass * jar_normal * ray.n1 + cone.tangential_mass * half
    first = jnp.where(bottom, sticking, 0.0)
    first = jnp.where(middle, stiff * slip * slip_rate, first)
    second = jnp.where(bottom, cone.normal_mass * ray.n1**2 + cone.tangential_mass * ray.vv, 0.0)
    bent = stiff * (slip_rate**2 - slip * cone.friction * curve)
    return first, jnp.where(middle, bent, second)


def contact_inertia(contacts: Contacts, hessian: jax.Array) -> jax.Array:
    """X'KX with X = [-[r], 1]: a contact's Hessian in spatial accelerations, rows (6, 6, ...)."""
    xx, xy, xz, yy, yz, zz = hessian
    k = [jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])]
    r = contacts.point
    # Rows of [r]K, then of -[r]K[r]: cross products, never the skew matrix's zeros.
    y = _crossed(r, k)
    upper = [jnp.concatenate([cross(r, row), row]) for row in y]
    lower = [jnp.concatenate([jnp.stack([y[j][i] for j in range(3)]), k[i]]) for i in range(3)]
    return jnp.stack(upper + lower)


def _crossed(r: jax.Array, k: list[jax.Array]) -> list[jax.Array]:
    return [r[1] * k[2] - r[2] * k[1], r[2] * k[0] - r[0] * k[2], r[0] * k[1] - r[1] * k[0]]


def contact_wrench(contacts: Contacts, force: jax.Array) -> jax.Array:
    """Spatial force (moment about the origin, force), shape (6, ...)."""
    return jnp.concatenate([cross(contacts.point, force), force])
