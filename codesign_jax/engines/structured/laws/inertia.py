"""Spatial inertia and smooth forces: gravity, gyroscopic terms, springs, damping, actuators.

Velocity products are the inertial forces at zero joint acceleration: centrifugal and Coriolis
forces and gyroscopic moments. Taken at a step's start, as MuJoCo takes them, they are forward Euler
on a rotation: a point that turns by x a step gains speed by the root of 1 + x^2. So a body gets
them whole up to a turn, and beyond it the share of `share_of_products`; what stands in the place of
the rest is `carried_force` of the fingers' links, and the mid-step rotation of
`gyroscopic_moment` of the object. The palm turns by less than 0.05 rad a step and gets them whole.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import (
    apply_columns,
    apply_rows,
    cross,
    dot,
    spatial,
    total,
    turn_columns,
)
from codesign_jax.model.layout import implicit_spring, joint_axes
from codesign_jax.model.morphology import softening, threshold_energy, threshold_moments
from codesign_jax.scene import Scene, section_law
from codesign_jax.scene.beams import softening_energy
from codesign_jax.scene.section_numbers import Numbers


class Body(NamedTuple):
    """Inertia of bodies; the item axes (link, finger or 1) precede the world's."""

    mass: jax.Array  # Shape (..., world)
    centre: jax.Array  # Centres of mass, shape (3, ..., world)
    tensor: jax.Array  # Rotational inertia about the centre, world axes, shape (3, 3, ..., world)

    def times(self, acc: jax.Array) -> jax.Array:
        """Spatial force (moment about the origin, force) of a spatial acceleration, (6, ...)."""
        force = self.mass * (acc[3:] + cross(acc[:3], self.centre))
        moment = apply_columns(self.tensor, acc[:3])
        return spatial(moment + cross(self.centre, force), force)

    def matrix(self) -> jax.Array:
        """Rows of the 6 x 6 spatial inertia, shape (6, 6, ...)."""
        m = self.mass
        c = self.centre
        zero = jnp.zeros_like(m * c[0])
        square = dot(c, c)
        m = m + zero
        skew = [
            [zero, -m * c[2], m * c[1]],
            [m * c[2], zero, -m * c[0]],
            [-m * c[1], m * c[0], zero],
        ]
        rows = []
        for i in range(3):
            turning = [
                self.tensor[i, j] + m * ((square if i == j else 0.0) - c[i] * c[j])
                for j in range(3)
            ]
            rows.append(jnp.stack([*turning, *skew[i]]))
        for i in range(3):
            moving = [m if i == j else zero for j in range(3)]
            rows.append(jnp.stack([skew[j][i] for j in range(3)] + moving))
        return jnp.stack(rows)

    def smooth_force(
        self,
        vel: jax.Array,
        bias: jax.Array,
        gravity: jax.Array | None,
        share: jax.Array | float = 1.0,
    ) -> jax.Array:
        """External minus inertial force at zero joint acceleration, shape (6, ...).

        Args:
          gravity: Magnitude of gravity, along -z [m/s^2]; None without the effect.
          share: What is taken of the velocity products, see `share_of_products`.
        """
        omega = vel[:3]
        alpha = bias[:3]
        point_vel = vel[3:] + cross(omega, self.centre)
        acc = share * (bias[3:] + cross(alpha, self.centre) + cross(omega, point_vel))
        if gravity is not None:
            acc = jnp.stack([acc[0], acc[1], acc[2] + gravity])
        force = -self.mass * acc
        spin = apply_columns(self.tensor, omega)
        moment = -share * (apply_columns(self.tensor, alpha) + cross(omega, spin))
        return spatial(moment + cross(self.centre, force), force)


LARGEST_TURN = 0.5
"""Turn of a link in a step [rad] up to which its velocity products are taken whole [measured]: with
1 rad long, thin fingers still gain energy after a release, and with 0.25 rad their path after it is
less accurate."""


LARGEST_FREE_TURN = 0.1
"""The same of the object, whose spin nothing damps [chosen]: in half a second of flight, 10 ms a
step, a box gains at most 5 % of its energy by such turns."""


def share_of_products(
    omega: jax.Array, timestep: float, largest: float = LARGEST_TURN
) -> jax.Array:
    """Share of a body's velocity products that a step takes, of its angular velocity (3, ...).

    They are of second order in the velocities, so that a body which turns further than `largest` in
    a step gets those of that turn along the same motion.
    """
    most = (largest / timestep) ** 2
    square = dot(omega, omega)
    # A GPU's quotient of a number and itself need not be one, and slow bodies must have all.
    return jnp.where(square > most, most / jnp.maximum(square, most), 1.0)


def momentum(mass: Any, inertia: Any, frame: Any, centre: Any, vel: Any) -> jax.Array:
    """Momentum about the centre of mass, in the body's axes, and that of the centre, (6, ...).

    Args:
      inertia: Principal moments of inertia, shape (3, ...).
      frame: Columns of the orientation, shape (3, 3, ...).
      vel: Spatial velocity, shape (6, ...).
    """
    return spatial(inertia * apply_rows(frame, vel[:3]), mass * (vel[3:] + cross(vel[:3], centre)))


def carried_force(
    now: jax.Array, before: jax.Array, frame: jax.Array, centre: jax.Array, rest: jax.Array
) -> jax.Array:
    """Force on a link that carries its momentum over from step to step, shape (6, ...).

    The last step ended with velocities v at the place q - h v where it had begun; this one begins
    with them at q. With the difference of both momenta over the step as inertial force, the new
    velocities are the old motion's projection, in the metric of the masses, on what the joints
    allow at q, and no kinetic energy arises. It is of first order in the step, and products of the
    last velocities are of second order, which is why only fast links have it. The momentum about
    the centre turns with the body, in whose axes its metric stays as it is: the moment that this
    leaves out is a thousandth of the others, whose arm is the finger and not the link.

    Args:
      now: `momentum` at q; `before`: at q - h v.
      frame: Columns of the orientation at q; `centre`: the centre of mass there.
      rest: What `share_of_products` leaves, over the step [1/s].
    """
    change = rest * (before - now)
    force = change[3:]
    return spatial(apply_columns(frame, change[:3]) + cross(centre, force), force)


ROTATIONS = 3
"""Iterations of `gyroscopic_moment` [measured]: two let the energy of a box at 100 rad/s double."""


def gyroscopic_moment(
    tensor: jax.Array, inverse: jax.Array, omega: jax.Array, timestep: float
) -> jax.Array:
    """Gyroscopic moment on a free body, shape (3, ...).

    Velocities are those of the middle between two places. So beyond `LARGEST_FREE_TURN` the new
    one, v, has the body's angular momentum when the body has turned on by h v / 2, as the last one
    has it half a step ago. Each iterate has the length of that momentum: the energy is bounded at
    any speed.

    Args:
      tensor: Rotational inertia about the centre, world axes, and its inverse, (3, 3, ...).
    """
    spin = apply_columns(tensor, omega)
    carried = _turned(spin, -timestep / 2 * omega)
    new = omega
    for _ in range(ROTATIONS):
        new = apply_columns(inverse, _turned(carried, -timestep / 2 * new))
    share = share_of_products(omega, timestep, LARGEST_FREE_TURN)
    rest = (1 - share) / timestep
    return rest * apply_columns(tensor, new - omega) - share * cross(omega, spin)


def _turned(vector: jax.Array, angle: jax.Array) -> jax.Array:
    """Vector turned by a rotation vector, to the second order of its angle; keeps the length."""
    half = angle / 2
    aside = cross(half, vector)
    return vector + 2 / (1 + dot(half, half)) * (aside + cross(half, aside))


class Centred(NamedTuple):
    """As `Body`, its centre the origin."""

    mass: jax.Array  # Shape (..., world)
    tensor: jax.Array  # Rotational inertia, world axes, shape (3, 3, ..., world)

    def times(self, acc: jax.Array) -> jax.Array:
        """The wrench (6, ...) that gives the body a spatial acceleration (6, ...)."""
        return spatial(apply_columns(self.tensor, acc[:3]), self.mass * acc[3:])

    def matrix(self) -> jax.Array:
        """The spatial inertia, shape (6, 6, ...)."""
        zero = jnp.zeros_like(self.mass + self.tensor[0, 0])
        none = jnp.stack([zero] * 3)
        mass = self.mass + zero
        rows = [jnp.concatenate([self.tensor[i], none]) for i in range(3)]
        for i in range(3):
            moving = jnp.stack([mass if i == j else zero for j in range(3)])
            rows.append(jnp.concatenate([none, moving]))
        return jnp.stack(rows)

    def smooth_force(
        self, vel: jax.Array, gravity: jax.Array | None, inverse: jax.Array, timestep: float
    ) -> jax.Array:
        """Gravity and gyroscopic moment, shape (6, ...); see `Body.smooth_force`.

        The velocity of the centre causes no force: the body's coordinates are its own velocity.

        Args:
          gravity: Magnitude of gravity, along -z [m/s^2]; None without the effect.
          inverse: Of the rotational inertia.
        """
        zero = jnp.zeros_like(vel[0])
        weight = zero if gravity is None else -self.mass * gravity + zero
        moment = gyroscopic_moment(self.tensor, inverse, vel[:3], timestep)
        return spatial(moment, jnp.stack([zero, zero, weight]))


def principal_tensor(columns: jax.Array, principal: jax.Array) -> jax.Array:
    """World inertia tensor from body axes (3 columns, 3, ...) and principal moments (3, ...)."""
    pairs = zip(jnp.unstack(principal), jnp.unstack(columns), strict=True)
    return total([(p * c)[:, None] * c[None] for p, c in pairs])


def turned_tensor(frame: jax.Array, tensor: jax.Array) -> jax.Array:
    """R T R' of a tensor T (3, 3, ...), R given by its columns."""
    # Rows of T first, then columns of T R'.
    return turn_columns(frame, jnp.moveaxis(turn_columns(frame, tensor), 0, 1))


def softening_moment(section: jax.Array, stiffness: jax.Array, angle: jax.Array) -> jax.Array:
    """As `model.softening_moments`: of a section (4, finger, world), stiffness and bend angles."""
    height, wall, segment, width = section
    return stiffness * angle * softening(angle / segment, height, wall, width=width)


def joint_energy(constants: dict, pressure: jax.Array, q: jax.Array) -> jax.Array:
    """Energy of a joint's springs, less the work that its chamber does at a pressure [J].

    The moments of `springs`, of `softening_moment` and of the chamber are minus its slopes by the
    angles. At a constant pressure they can only exchange it with other energy.

    Args:
      constants: What `link_forces` takes of the springs, "stiffness" and "gain", and, of scenes
        with these effects, "section" and "threshold"; with the law "elements" it is "law".
      pressure: Of the chamber [Pa].
      q: Angles, shape (axis, ...).
    """
    if "law" in constants:
        return _section_energy(constants["law"], pressure, q)
    stiffness = constants["stiffness"]
    energy = total([k * x**2 / 2 for k, x in zip(stiffness, q, strict=True)])
    energy = energy - constants["gain"] * pressure * q[0]
    if "section" in constants:
        height, wall, segment, width = constants["section"]
        share = softening_energy(q[0] / segment, height, wall, width=width)
        energy = energy - stiffness[0] * q[0] ** 2 / 2 * share
    if "threshold" in constants:
        energy = energy + threshold_energy(tuple(constants["threshold"]), pressure, q[0], q[1])
    return energy


def _section_energy(law: jax.Array, pressure: jax.Array, q: jax.Array) -> jax.Array:
    """`joint_energy` by the law of sections; of hinges on all three axes."""
    *numbers, segment = jnp.unstack(law)
    bend, lateral, twist = jnp.unstack(q / segment)
    return segment * section_law.energy(Numbers(*numbers), pressure, twist, bend, lateral)


class SectionSprings(NamedTuple):
    """A joint's springs by the law of its section; (axis, ...)."""

    moments: jax.Array  # With those of the chamber
    stiffness: jax.Array  # What a step takes implicitly
    damping: jax.Array  # With the implicit term
    armature: jax.Array  # With the implicit terms


def section_springs(
    scene: Scene, constants: list, law: jax.Array, pressure: jax.Array, q: jax.Array
) -> SectionSprings:
    """A joint's springs by the law of its section, as `model.section_springs`.

    Args:
      constants: Stiffness at rest, damping and armature of the hinges, shape (axis, ...).
      law: What `section_law` needs of the section, and last the length of a segment [m], shape
        (number, ...).
      pressure: Of the chamber [Pa].
      q: Angles, shape (axis, ...).
    """
    stiffness, damping, armature = constants
    axes = joint_axes(scene)
    *numbers, segment = jnp.unstack(law)
    rest, angles = (dict(zip(axes, jnp.unstack(v), strict=True)) for v in (stiffness, q))
    held, more = section_law.at_joint(Numbers(*numbers), segment, rest, pressure, angles)
    added = jnp.stack([more[name] for name in axes])
    implicit = implicit_spring(scene, added, jnp.zeros_like(added))
    moments = jnp.stack([-held[name] for name in axes])
    return SectionSprings(moments, stiffness + added, damping + implicit[0], armature + implicit[1])


class Springs(NamedTuple):
    """A joint's springs, and what the threshold of sideways bending adds; (axis, ...)."""

    stiffness: jax.Array  # Of the hinges
    damping: jax.Array  # With the implicit term
    armature: jax.Array  # With the implicit terms
    # Further moment on the bend hinge, shape (1, ...); None without the effect
    moment: jax.Array | None


def springs(
    scene: Scene, constants: tuple, threshold: jax.Array | None, pressure: jax.Array, q: jax.Array
) -> Springs:
    """A joint's springs at its angles.

    The threshold is a spring that is implicit in the lateral hinge as its own one, see
    `model.layout.implicit_spring`.

    Args:
      constants: Stiffness, damping and armature of the hinges, shape (axis, ...).
      threshold: Numbers of `model.morphology.thresholds`, shape (3, ...); None without the effect.
      q: Angles, shape (axis, ...); the second one is the lateral one.
    """
    stiffness, damping, armature = constants
    if threshold is None:
        return Springs(stiffness, damping, armature, None)
    more, moment = threshold_moments(tuple(threshold), pressure, q[0], q[1])
    stiffness = _with_lateral(stiffness, stiffness[1] + more)
    added = implicit_spring(scene, more, jnp.zeros_like(more))
    damping = _with_lateral(damping, damping[1] + added[0])
    armature = _with_lateral(armature, armature[1] + added[1])
    return Springs(stiffness, damping, armature, moment[None])


def _with_lateral(axes: jax.Array, lateral: jax.Array) -> jax.Array:
    return jnp.concatenate([axes[:1], lateral[None], axes[2:]])
