"""A finger that is held straight and let go: the drop of its tip over time.

The finger lies level, its inextensible layer below, so that its weight, and a weight hung from its
tip, bend it as pressure does.  The equations of motion are those of its chain in the plane,
M(q) q'' = forces, with Kelvin-Voigt damping; they are integrated by ROS2 (Verwer, Spee, Blom and
Hundsdorfer 1999), a Rosenbrock method that is L-stable and of second order with any Jacobian, here
that of the straight finger.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.finger.rest import Finger
from codesign_jax.model import morphology
from codesign_jax.scene import section_law

STEPS = 150
"""Time steps of the first mode's period."""
MOST = 20_000
"""Most time steps of a release."""
GRAVITY = 9.80665
"""Standard acceleration of gravity, at the bench [m/s^2]."""
GAMMA = 1 - math.sqrt(0.5)
"""ROS2's parameter, with which it is L-stable."""


class Chain(NamedTuple):
    """Numbers of a finger that swings; joints' of shape (N,), all SI."""

    stiffness: Any
    moment: Any  # of pressure on the straight finger
    damping: Any
    segment: Any
    section: morphology.Section
    bodies: Any
    load: Any  # mass of the weight at the tip [kg]
    # See `Finger`, and the pressure [Pa]; None with the law "chamber"
    law: Any = None


def chain(finger: Finger, load: float, pressure: float) -> Chain:
    """The chain of a finger with a weight [N] hung from its tip, at a gauge pressure [Pa]."""
    whole = partial(np.broadcast_to, shape=(finger.links,))
    stiffness = whole(finger.stiffness)
    return Chain(
        stiffness=stiffness,
        moment=pressure * whole(finger.gain),
        damping=finger.constants.damping_time * stiffness,
        segment=finger.segment,
        section=morphology.Section(*map(whole, finger.section)),
        bodies=finger.bodies,
        load=load / GRAVITY,
        law=None if finger.law is None else (finger.law, pressure),
    )


def first_period(finger: Finger, load: float) -> float:
    """Period of the slowest mode of the straight finger without damping [s]."""
    with jax.enable_x64(True):
        model = jax.tree.map(jnp.asarray, chain(finger, load, 0.0))
        mass = np.asarray(_mass(model, jnp.zeros(finger.links)))
    root = 1 / np.sqrt(np.asarray(model.stiffness))
    slowest = np.linalg.eigvalsh(root[:, None] * mass * root)[-1]
    return 2 * math.pi * math.sqrt(slowest)


def released(
    finger: Finger, load: float, pressure: float, until: float, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and drops of the tip [m], shape (time,), from the release of the straight finger.

    Args:
      load: Weight hung from the tip [N].
      pressure: Gauge pressure [Pa].
      until: Time at which it ends [s].
      step: Largest time step [s]; `first_period` over `STEPS` errs by less than 1e-3 of the period.

    Raises:
      ValueError: If that is more than `MOST` steps.
    """
    if until / step > MOST:
        raise ValueError(f"a release of {until:g} s takes more than {MOST:,} time steps")
    # A power of two, so that fingers of nearly the same period are one program.
    count = 2 ** math.ceil(math.log2(until / step))
    step = until / (count - 1)
    with jax.enable_x64(True):
        model = jax.tree.map(jnp.asarray, chain(finger, load, pressure))
        drops = _drops(count, finger.neo_hookean, model, jnp.asarray(step))
        return step * np.arange(count), np.asarray(drops)


def _places(model: Chain, q: jax.Array) -> jax.Array:
    """Places of the segments' centres and of the tip, across the straight finger too; (N + 1, 2).

    Along the finger and downwards [m].
    """
    direction = jnp.cumsum(q)
    cosine = jnp.cos(direction)
    sine = jnp.sin(direction)
    along = model.bodies.along
    up = model.bodies.up
    joints = model.segment * jnp.stack([jnp.cumsum(cosine), jnp.cumsum(sine)], -1)
    before = jnp.concatenate([jnp.zeros((1, 2)), joints[:-1]])
    centre = jnp.stack([along * cosine + up * sine, along * sine - up * cosine], -1)
    half = model.segment / 2 * jnp.stack([cosine[-1], sine[-1]])
    return jnp.concatenate([before + centre, (before[-1] + half)[None]])


def _masses(model: Chain) -> jax.Array:
    return jnp.append(model.bodies.mass, model.load)


@jax.jit
def _mass(model: Chain, q: jax.Array) -> jax.Array:
    """The mass matrix, shape (N, N)."""
    slopes = jax.jacfwd(partial(_places, model))(q)
    turning = jnp.cumsum(model.bodies.inertia[::-1])[::-1]
    number = jnp.arange(q.size)
    of_turns = turning[jnp.maximum(number[:, None], number)]
    return jnp.einsum("b,bdi,bdj->ij", _masses(model), slopes, slopes) + of_turns


def _acceleration(model: Chain, neo_hookean: bool, q: jax.Array, rate: jax.Array) -> jax.Array:
    def speed(at: jax.Array) -> jax.Array:
        return jax.jvp(partial(_places, model), (at,), (rate,))[1]

    slopes = jax.jacfwd(partial(_places, model))(q)
    bias = jax.jvp(speed, (q,), (rate,))[1]
    fall = jnp.array([0.0, GRAVITY]) - bias
    forces = jnp.einsum("b,bdi,bd->i", _masses(model), slopes, fall)
    spring = model.stiffness * q
    if model.law is not None:
        law, pressure = model.law
        held = section_law.response(law, pressure, 0.0, q / model.segment, 0.0).bend
        spring = held + model.moment  # which is added below
    elif neo_hookean:
        height, wall, width = model.section
        spring *= 1 - morphology.softening(q / model.segment, height, wall, width=width)
    forces += model.moment - spring - model.damping * rate
    return jnp.linalg.solve(_mass(model, q), forces)


@partial(jax.jit, static_argnums=(0, 1))
def _drops(count: int, neo_hookean: bool, model: Chain, step: jax.Array) -> jax.Array:
    links = model.stiffness.size

    def slope(state: jax.Array) -> jax.Array:
        rate = state[links:]
        return jnp.concatenate([rate, _acceleration(model, neo_hookean, state[:links], rate)])

    start = jnp.zeros(2 * links)
    inverse = jnp.linalg.inv(jnp.eye(2 * links) - GAMMA * step * jax.jacfwd(slope)(start))

    def advance(state: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        first = inverse @ slope(state)
        second = inverse @ (slope(state + step * first) - 2 * first)
        new = state + step * (1.5 * first + 0.5 * second)
        return new, _places(model, state[:links])[-1, 1]

    return jax.lax.scan(advance, start, None, length=count)[1]
