"""The air in a finger's chamber: for a mass of air p V^n is constant, p its absolute pressure.

The chamber's volume is V = V_0 + g'q with the bend angles q and the moments per pressure g of their
hinges: pressure has these moments by virtual work, so that no other volume goes with them.
"""

from typing import Any

import jax
import jax.numpy as jnp

LEAST = 0.05
"""Smallest volume over that of the straight finger; at less the pressure stays what it is there."""


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


def straight_volume(gain: jax.Array, section: jax.Array, links: int) -> jax.Array:
    """Volume of a straight finger's chamber [m^3], shape (...).

    Args:
      gain: Bending moment per pressure at the joints [m^3], shape (joint, ...); one for all joints
        where they are alike.
      section: Height, wall, segment length and width there [m], shape (joint, 4, ...).
      links: Number of joints.
    """
    height, _, segment, _ = jnp.unstack(section, axis=1)
    return links * (2 * gain / height * segment).mean(0)
