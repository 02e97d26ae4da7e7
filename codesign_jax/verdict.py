"""When a world is decided: the one rule that every engine and the cost apply.

A world is decided when its object is lost within the cost's window (paper Fig. 3) or when it
failed.  The functions consist of comparisons only, so that they take NumPy arrays, JAX arrays and
the lanes of a kernel alike.  None of them asks whether a number is finite, because a GPU kernel
cannot: comparisons with a number that is not one are false.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import Scene
from codesign_jax.types import Status, Trace, failed

FAR = 3e38
"""Larger than any distance, and still a number in float32."""


def window(scene: Scene) -> tuple[int, int]:
    """The first step at which a lost object counts, and the first at which it no longer does."""
    start, end = (round(t / scene.discretization.timestep) for t in scene.window)
    return start, end


def lost(scene: Scene, distance: Any, step: Any) -> Any:
    """Whether the object is lost: far from the hand, and within the window of the cost.

    Args:
      scene: The scene.
      distance: Object centre to hand centre [m].
      step: Index of the time step, broadcast against the distance.
    """
    start, end = window(scene)
    return (distance >= scene.cost.lost_distance) & (step >= start) & (step < end)


def sound(scene: Scene, distance: Any, height: Any) -> Any:
    """Whether a state consists of numbers and its object is not below the table.

    Args:
      scene: The scene.
      distance: Object centre to hand centre [m].
      height: Object centre above the table [m].
    """
    return (distance <= FAR) & (height >= -scene.limits.penetration)


def slow(scene: Scene, speed: Any) -> Any:
    """Whether the largest absolute generalized velocity is a number and within the limit."""
    return speed <= scene.limits.speed


def goes_on(
    scene: Scene, distance: Any, height: Any, speed: Any, step: Any, *, to_end: bool
) -> Any:
    """Whether a world whose state is so takes the next step; arguments as above.

    The step is kept if the state after it is `slow` as well, else the world stays where it was.

    Args:
      scene: The scene.
      distance: Object centre to hand centre [m].
      height: Object centre above the table [m].
      speed: Largest absolute generalized velocity.
      step: Index of the time step.
      to_end: Whether worlds that lost their object are simulated to the end all the same.
    """
    good = sound(scene, distance, height) & slow(scene, speed)
    return good if to_end else good & ~lost(scene, distance, step)


def failures(scene: Scene, trace: Trace) -> jax.Array:
    """Why each state of a trace is not sound, or its step not valid; bits of `Status`, else 0.

    Args:
      scene: The scene.
      trace: Trace of one world, arrays of shape (time,).

    Returns:
      Bits, shape (time,) int32.
    """
    numbers = jnp.isfinite(trace.speed) & jnp.isfinite(trace.distance) & jnp.isfinite(trace.height)
    bits = as_bit(~numbers, Status.NONFINITE)
    bits |= as_bit(trace.speed > scene.limits.speed, Status.SPEED)
    bits |= as_bit(trace.height < -scene.limits.penetration, Status.PENETRATION)
    if trace.status is not None:
        told = jnp.asarray(trace.status, jnp.int32)
        bits |= jnp.where(failed(told), told, jnp.zeros_like(told))
    return bits


def as_bit(condition: jax.Array, bit: Status) -> jax.Array:
    """The bit where the condition holds, int32 in every mode of JAX."""
    return condition.astype(jnp.int32) * np.int32(bit)
