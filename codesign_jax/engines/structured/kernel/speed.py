"""The largest velocity of a state, and in reverse: its cotangent goes to the velocities it is."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.memory import loop
from codesign_jax.engines.structured.kernel.pull import plus
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.reverse import ReverseStep
    from codesign_jax.engines.structured.kernel.step import Step

VELOCITIES = ("wrist_vel", "linear_vel", "angular_vel")


def largest(step: "Step", state: dict[str, Lanes]) -> Lanes:
    """Largest absolute velocity of each world's state; see `add`."""
    return _folded(step, state, _largest, jnp.maximum)


def add(step: "ReverseStep", state: dict[str, Lanes], bar: jax.Array) -> None:
    """Adds the cotangent of the trace's speed; equal velocities share it.

    Args:
      step: The step, whose cotangents are those of the state before it.
      state: Velocities of wrist and object, by name.
      bar: The cotangent, numbers of a world.
    """
    p, block = step.p, step.block
    top = largest(step, state)
    number = _folded(step, state, _count, jnp.add, top)
    share = lanewise(_share, lanes([bar], (), wide=False), number)

    def link(i: Any, x: Any) -> Any:
        step.bars.add_joint({"finger_vel": lanewise(_slope, _rates(step, i), top, share)}, i)
        return x

    jax.lax.fori_loop(0, p.links, link, jnp.int32(0))
    table, ref = p.world_state, step.bars.world_state
    for name in VELOCITIES:
        old = table.read(ref, name, 0, block.world)
        new = plus(old, lanewise(_slope, state[name], top, share))
        table.write(ref, name, new, 0, block.world)


def _rates(step: "Step", i: Any) -> Lanes:
    return step.p.finger_state.read(step.finger_state, "finger_vel", i)


def _folded(
    step: "Step", state: dict[str, Lanes], function: Callable, combine: Callable, *more: Lanes
) -> Lanes:
    """function(x, velocities, *more) folded over all velocities of a world."""
    p = step.p

    def one(i: Any, x: Lanes) -> Lanes:
        return lanewise(function, x, _rates(step, i), *more)

    first = zeros((), jnp.zeros((p.size,), state[VELOCITIES[0]].dtype))
    found = lanes(
        [step.block.fold(loop(p.links, one, first, p.size).lane, combine)], (), wide=False
    )
    for name in VELOCITIES:
        found = lanewise(function, found, state[name], *more)
    return found


def _largest(x, velocities):
    for k in range(velocities.shape[0]):
        x = jnp.maximum(x, jnp.abs(velocities[k]))
    return x


def _count(x, velocities, top):
    for k in range(velocities.shape[0]):
        x = x + jnp.where(jnp.abs(velocities[k]) == top, 1.0, 0.0)
    return x


def _share(bar, number):
    return bar / jnp.maximum(number, 1.0)


def _slope(velocities, top, share):
    sign = jnp.where(velocities > 0, 1.0, jnp.where(velocities < 0, -1.0, 0.0))
    return jnp.where(jnp.abs(velocities) == top, sign * share, 0.0)
