"""Spatial inertia and smooth forces: gravity, gyroscopic terms, springs, damping, actuators."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import cross, dot, spatial, total
from codesign_jax.engines.structured.world_model import apply_columns, turn_columns
from codesign_jax.model.layout import implicit_spring
from codesign_jax.model.morphology import softening, threshold_moments
from codesign_jax.scene import Scene


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

    def smooth_force(self, vel: jax.Array, bias: jax.Array, gravity: jax.Array | None) -> jax.Array:
        """External minus inertial force at zero joint acceleration, shape (6, ...).

        Args:
          gravity: Magnitude of gravity, along -z [m/s^2]; None without the effect.
        """
        omega = vel[:3]
        alpha = bias[:3]
        point_vel = vel[3:] + cross(omega, self.centre)
        acc = bias[3:] + cross(alpha, self.centre) + cross(omega, point_vel)
        if gravity is not None:
            acc = jnp.stack([acc[0], acc[1], acc[2] + gravity])
        force = -self.mass * acc
        spin = apply_columns(self.tensor, omega)
        moment = -apply_columns(self.tensor, alpha) - cross(omega, spin)
        return spatial(moment + cross(self.centre, force), force)


class Centred(NamedTuple):
    """As `Body`, its centre the origin."""

    mass: jax.Array  # Shape (..., world)
    tensor: jax.Array  # Rotational inertia, world axes, shape (3, 3, ..., world)

    def times(self, acc: jax.Array) -> jax.Array:
        return spatial(apply_columns(self.tensor, acc[:3]), self.mass * acc[3:])

    def matrix(self) -> jax.Array:
        zero = jnp.zeros_like(self.mass + self.tensor[0, 0])
        none = jnp.stack([zero] * 3)
        mass = self.mass + zero
        rows = [jnp.concatenate([self.tensor[i], none]) for i in range(3)]
        for i in range(3):
            moving = jnp.stack([mass if i == j else zero for j in range(3)])
            rows.append(jnp.concatenate([none, moving]))
        return jnp.stack(rows)

    def smooth_force(self, vel: jax.Array, gravity: jax.Array | None) -> jax.Array:
        """Gravity and gyroscopic moment, shape (6, ...); see `Body.smooth_force`.

        The velocity of the centre causes no force: the body's coordinates are its own velocity.

        Args:
          gravity: Magnitude of gravity, along -z [m/s^2]; None without the effect.
        """
        omega = vel[:3]
        zero = jnp.zeros_like(vel[0])
        weight = zero if gravity is None else -self.mass * gravity + zero
        moment = -cross(omega, apply_columns(self.tensor, omega))
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
      threshold: See `WorldModel`, shape (3, ...); None without the effect.
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
