"""The largest velocity of a state in reverse: its cotangent goes to the velocities that it is."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.memory import loop
from codesign_jax.engines.structured.kernel.pull import plus
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.reverse import ReverseStep

VELOCITIES = ("wrist_vel", "linear_vel", "angular_vel")


def add(step: "ReverseStep", state: dict[str, Lanes], bar: jax.Array) -> None:
    """Adds the cotangent of the trace's speed; equal velocities share it.

    Args:
      step: The step, whose cotangents are those of the state before it.
      state: Velocities of wrist and object, by name.
      bar: The cotangent, numbers of a world.
    """
    p, block, like = step.p, step.block, step.like

    def rates(i: Any) -> Lanes:
        return p.finger_state.read(step.finger_state, "finger_vel", i)

    def folded(function: Any, combine: Any, *more: Lanes) -> Lanes:
        """function(x, velocities, *more) folded over all velocities of a world."""

        def one(i: Any, x: Lanes) -> Lanes:
            return lanewise(function, x, rates(i), *more)

        fingers = block.fold(loop(p.links, one, zeros((), like), p.size).lane, combine)
        found = lanes([fingers], (), wide=False)
        for name in VELOCITIES:
            found = lanewise(function, found, state[name], *more)
        return found

    top = folded(_largest, jnp.maximum)
    number = folded(_count, jnp.add, top)
    share = lanewise(_share, lanes([bar], (), wide=False), number)

    def link(i: Any, x: Any) -> Any:
        step.bars.add_joint({"finger_vel": lanewise(_slope, rates(i), top, share)}, i)
        return x

    jax.lax.fori_loop(0, p.links, link, jnp.int32(0))
    table, ref = p.world_state, step.bars.world_state
    for name in VELOCITIES:
        old = table.read(ref, name, 0, block.world)
        new = plus(old, lanewise(_slope, state[name], top, share))
        table.write(ref, name, new, 0, block.world)


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
