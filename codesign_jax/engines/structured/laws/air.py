"""The air in a finger's chamber: for a mass of air p V^n is constant, p its absolute pressure.

The chamber's volume is V = V_0 + g'q with the bend angles q and the moments per pressure g of their
hinges: pressure has these moments by virtual work, so that no other volume goes with them.
"""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.laws.inertia import softening_moment
from codesign_jax.engines.structured.world_model import WorldModel, joint_sections
from codesign_jax.scene import Scene

LEAST = 0.05
"""Smallest volume over that of the straight finger; at less the pressure stays what it is there."""
ROUNDS = 8
"""Newton iterations for the bend of a free neo-Hookean finger. They come from below, as the moment
is concave in the angle."""


def power(base: Any, exponent: Any) -> Any:
    """A base to the power of an exponent, to rounding; of 0.05 to 20, and up to 2.

    Kernels have arithmetic and roots only: logarithm and exponential of the sixteenth root are
    series in numbers below 0.1 and 0.4.
    """
    for _ in range(4):
        base = jnp.sqrt(base)
    t = (base - 1) / (base + 1)
    log = sum(2 / k * t**k for k in range(13, 0, -2))
    series = 1.0
    for k in range(13, 0, -1):
        series = 1 + exponent * log * series / k
    return series**16


def end_pressure(timestep: float, charge: Any, volume: Any, air: Any, grown: Any) -> tuple:
    """Gauge pressure at the end of a step [Pa], linear in the volume's change over the step.

    Args:
      timestep: Time step h [s].
      charge: Absolute pressure that the chamber's air has in the straight finger [Pa].
      volume: Volume of the straight finger's chamber [m^3].
      air: Exponent n, and the atmosphere's pressure [Pa].
      grown: What bending adds to the volume [m^3], and its first two derivatives by time.

    Returns:
      The pressure p - k (h V' + h^2 V''), and h^2 k, where k = -dp/dV [Pa/m^3].
    """
    more, rate, acc = grown
    ratio = jnp.maximum(1 + more / volume, LEAST)
    absolute = charge * power(1 / ratio, air[0])
    fall = air[0] * absolute / (ratio * volume)
    return absolute - air[1] - timestep * fall * (rate + timestep * acc), timestep**2 * fall


def volumes(hand: WorldModel, links: int) -> jax.Array:
    """Volumes of the straight fingers' chambers [m^3], shape (finger, world)."""
    height, _, segment, _ = jnp.unstack(joint_sections(hand, links), axis=1)
    return links * (2 * hand.gain / height * segment).mean(0)


def charged(scene: Scene, hand: WorldModel, ctrl: jax.Array) -> jax.Array:
    """Controls (world, time, nu) with charges, see `end_pressure`, in the place of pressures.

    A chamber gets the mass of air that has the wanted pressure while the finger bends freely.
    """
    assert hand.air is not None
    # (time, finger, world)
    wanted = jnp.moveaxis(ctrl[..., 6:], 0, -1)
    links = len(hand.stiffness)
    gains = hand.gain[None] if hand.tip is None else hand.gain
    grown = jnp.zeros_like(wanted)
    for gain, stiffness, section in zip(
        gains, hand.stiffness[:, 0], joint_sections(hand, links), strict=False
    ):
        softening = section if scene.effects.neo_hookean else None
        grown += links / len(gains) * gain * _free_angle(gain * wanted, stiffness, softening)
    ratio = 1 + grown / volumes(hand, links)
    absolute = jnp.maximum(wanted + hand.air[1], 0.0)
    charge = absolute * power(jnp.maximum(ratio, LEAST), hand.air[0])
    return jnp.concatenate([ctrl[..., :6], jnp.moveaxis(charge, -1, 0)], -1)


def _free_angle(moment: jax.Array, stiffness: jax.Array, section: jax.Array | None) -> jax.Array:
    """Bend angle of a joint under a moment; `section` as in `softening_moment`, or None."""
    angle = moment / stiffness
    if section is None:
        return angle

    def carried(angle: jax.Array) -> jax.Array:
        return stiffness * angle - softening_moment(section, stiffness, angle)

    for _ in range(ROUNDS):
        value, slope = jax.jvp(carried, (angle,), (jnp.ones_like(angle),))
        angle = angle + (moment - value) / slope
    return angle
