"""When a world is decided: the one rule that every engine and the cost apply.

A world is decided when its object is lost within the cost's window (paper Fig. 3) or when it
failed.  The functions consist of comparisons only, so that they take NumPy arrays, JAX arrays and
the lanes of a kernel alike.  None of them asks whether a number is finite, because a GPU kernel
cannot: comparisons with a number that is not one are false.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import Scene
from codesign_jax.types import Status, Trace, failed

FAR = 3e38
"""Larger than any distance, and still a number in float32."""


class Bounds(NamedTuple):
    """What decides a world: numbers, or arrays that broadcast to those of the worlds."""

    # Distance from object centre to hand centre from which on the object is lost [m]
    lost_distance: Any
    start: Any  # the first time step at which a lost object counts
    end: Any  # the first time step at which it no longer does
    speed: Any  # largest velocity of a world that has not failed [rad/s or m/s]
    # How far below the table the object's centre may be [m]; `FAR` without a table, where what
    # falls is lost as soon as the window begins
    penetration: Any


def bounds(scene: Scene) -> Bounds:
    """The bounds of a scene, whose numbers may be arrays or traced."""
    start, end = map(scene.steps_to, scene.window)
    limits = scene.limits
    deep = limits.penetration if scene.effects.table else FAR + 0 * limits.penetration
    return Bounds(scene.cost.lost_distance, start, end, limits.speed, deep)


def lost(bounds: Bounds, distance: Any, step: Any) -> Any:
    """Whether the object is lost: far from the hand, and within the window of the cost.

    Args:
      distance: Object centre to hand centre [m].
    """
    return (distance >= bounds.lost_distance) & (step >= bounds.start) & (step < bounds.end)


def sound(bounds: Bounds, distance: Any, height: Any) -> Any:
    """Whether a state consists of numbers and its object is not below the table.

    Args:
      distance: Object centre to hand centre [m].
      height: Object centre above the table [m].
    """
    return (distance <= FAR) & (height >= -bounds.penetration)


def slow(bounds: Bounds, speed: Any) -> Any:
    """Whether the largest absolute generalized velocity is a number and within the limit."""
    return speed <= bounds.speed


def goes_on(
    bounds: Bounds, distance: Any, height: Any, speed: Any, step: Any, *, to_end: bool
) -> Any:
    """Whether a world in this state takes the next step.

    The step is kept if the state after it is `slow` as well, else the world stays where it was.

    Args:
      distance: Object centre to hand centre [m].
      height: Object centre above the table [m].
    """
    good = sound(bounds, distance, height) & slow(bounds, speed)
    return good if to_end else good & ~lost(bounds, distance, step)


def failures(scene: Scene, trace: Trace) -> jax.Array:
    """Why each state of a trace is not sound, or its step not valid; bits of `Status`, else 0.

    Args:
      trace: Trace of one world, arrays of shape (time,).

    Returns:
      Bits, shape (time,) int32.
    """
    numbers = jnp.isfinite(trace.speed) & jnp.isfinite(trace.distance) & jnp.isfinite(trace.height)
    bits = as_bit(~numbers, Status.NONFINITE)
    bits |= as_bit(trace.speed > scene.limits.speed, Status.SPEED)
    bits |= as_bit(trace.height < -bounds(scene).penetration, Status.PENETRATION)
    if trace.status is not None:
        told = jnp.asarray(trace.status, jnp.int32)
        bits |= jnp.where(failed(told), told, jnp.zeros_like(told))
    return bits


def as_bit(condition: jax.Array, bit: Status) -> jax.Array:
    """The bit where the condition holds, int32 in every mode of JAX."""
    return condition.astype(jnp.int32) * np.int32(bit)
