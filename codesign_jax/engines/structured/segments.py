"""A rollout's reverse pass in segments, of whose steps only the first states were stored.

The steps of a segment are simulated once more from its first state, by the kernel that simulated
them before: their bits are the same, as a block's step depends on nothing but its state.
The cotangents of the constants are handed on from segment to segment, so that the order of their
sums is that of the whole path.
"""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import Program
from codesign_jax.engines.structured.kernel.adjoint import (
    AdjointProgram,
    Cotangents,
    Path,
    recorded,
)

if TYPE_CHECKING:
    from codesign_jax.engines.structured.engine import StructuredEngine


def reverse(
    engine: "StructuredEngine",
    program: AdjointProgram,
    inputs: tuple,
    path: Path,
    bars: Cotangents,
    *,
    trajectory: bool,
) -> tuple:
    """Cotangents of a rollout's inputs, see `AdjointProgram.adjoint`.

    Args:
      path: What was stored of it, as tables of blocks.
      bars: Cotangents of its results, as tables of blocks.
    """
    if engine.segment is None:
        hand_bar, world_bar, *rest = program.adjoint(inputs, path, bars)
        return hand_bar, program.summed(world_bar), *rest
    size, (hand, world, _, _, arm, pressure, *grid) = engine.segment, inputs
    steps, count = arm.shape[1], path.finger.shape[1]
    how = {"backend": program.backend, "width": program.size, "team": 1}
    again = Program(engine.scene, engine.limits, **how)  # type: ignore[arg-type]

    def split(x: jax.Array) -> jax.Array:
        """(block, time, ...) to (segment, block, time of the segment, ...)."""
        x = jnp.pad(x, [(0, 0), (0, count * size - steps)] + [(0, 0)] * (x.ndim - 2))
        return jnp.moveaxis(x.reshape(x.shape[0], count, size, *x.shape[2:]), 1, 0)

    def segment(ends: tuple, given: tuple) -> tuple[tuple, tuple]:
        number, start, commands, shown = given
        taken = jnp.clip(path.taken - number * size, 0, size)
        own = (hand, world, *start, *commands, *grid)
        out = again.execute(own, trajectory=trajectory, states=1)
        here = recorded(out, taken)
        finger_bar, state_bar, *sums = ends
        cotangents = Cotangents(finger_bar, state_bar, shown[0], shown[1:])
        found = program.adjoint(own, here, cotangents, tuple(sums))
        hand_bar, world_bar, *state, arm_bar, pressure_bar = found[:6]
        state = [(jnp.zeros_like(x) if engine.truncate else x)[:, None] for x in state]
        return (*state, hand_bar, world_bar), (arm_bar, pressure_bar)

    every = jnp.arange(count, dtype=arm.dtype)
    starts = tuple(jnp.moveaxis(x, 1, 0) for x in path[:2])
    shown = tuple(split(x) for x in (bars.trace, *bars.path))
    given = every, starts, (split(arm), split(pressure)), shown
    sums = program.no_sums(arm.shape[0], arm.dtype)
    (*ends, hand_bar, world_bar), commands = jax.lax.scan(
        segment, (bars.finger, bars.world, *sums), given, reverse=True
    )

    def join(x: jax.Array) -> jax.Array:
        """Inverse of `split`."""
        return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1, *x.shape[3:])[:, :steps]

    state = (x[:, 0] for x in ends)
    none = [jnp.zeros_like(x) for x in grid]
    return hand_bar, program.summed(world_bar), *state, *map(join, commands), *none
