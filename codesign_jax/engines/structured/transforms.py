"""JAX's transformations of a rollout: `vmap` simulates one larger batch, `grad` runs an adjoint.

Batching: a mapped axis is folded into the axis of the worlds, so that one kernel simulates all of
them whatever the nesting (`jax.custom_batching.custom_vmap`).

Differentiation (`jax.custom_vjp`): the forward pass is the same kernel, which then stores the state
before each step and the accelerations of the step.  The backward pass is a second kernel, which
goes through the steps in reverse (`kernel.adjoint`).  The accelerations a of a step are where the
gradient of its objective vanishes,
  F(a, theta) = M a - tau - J' f(J a - aref) = 0,
with theta all data of the step.  By the implicit function theorem a cotangent v of a gives theta
the cotangent -lambda' dF/dtheta with H lambda = v, and H = dF/da is the symmetric matrix of a
Newton step at a: one linear solve a step, however many iterations found a.

The derivative is that of the trace as it was computed.  The trace of a decided world repeats its
last state, and the cotangents of the repeated entries are added to that state's.  A step that
failed passes no cotangent back.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.engines.structured.kernel.adjoint import (
    AdjointProgram,
    Cotangents,
    StatePath,
    state_path,
)
from codesign_jax.engines.structured.kernel.rollout import Inputs
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.judge import verdict
from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene
from codesign_jax.types import Trace


class Settings(NamedTuple):
    """What a rollout and its derivative depend on beside their arguments."""

    scene: Scene  # The scene
    limits: Limits  # How hard each step is solved
    # Steps of a segment, see `StructuredEngine`; None to store the states of all steps
    segment: int | None
    truncate: bool  # Whether no cotangent of a state passes from a segment to the one before it


def rollout(
    simulate: Callable,
    simulate_with_path: Callable,
    settings: Settings,
    fields: ModelFields,
    ctrl: jax.Array,
    tables: tuple[jax.Array, ...] = (),
    *,
    trajectory: bool,
) -> Trace:
    """`StructuredEngine.simulate`'s trace, under any of JAX's transformations but forward mode.

    Args:
      simulate: That method; `simulate_with_path`: that of the same name.

    Raises:
      NotImplementedError: If a derivative is differentiated again.
    """
    plain = folded(partial(simulate, trajectory=trajectory))
    with_path = _once(folded(partial(simulate_with_path, trajectory=trajectory)))
    adjoint = _once(folded(partial(_adjoint, settings, trajectory)))

    @jax.custom_vjp
    def run(fields: ModelFields, ctrl: jax.Array, tables: tuple[jax.Array, ...]) -> Trace:
        return plain(fields, ctrl, tables)

    def forward(fields: ModelFields, ctrl: jax.Array, _: tuple[jax.Array, ...]):
        trace, path = with_path(fields, ctrl)
        return trace, (fields, ctrl, path, trace.speed)

    def backward(saved: tuple, cotangent: Trace):
        return *adjoint(*saved, cotangent._replace(status=None, residual=None, overlap=None)), None

    run.defvjp(forward, backward)
    return run(fields, ctrl, tables)


def folded(function: Callable) -> Callable:
    """The function, whose arrays all have a leading world axis, with a rule for `jax.vmap`.

    Worlds must not depend on each other.
    """
    mapped = jax.custom_batching.custom_vmap(function)

    @mapped.def_vmap
    def _(size: int, batched: Any, *args: Any):
        def merge(x: jax.Array, mapped_axis: bool) -> jax.Array:
            x = x if mapped_axis else jnp.broadcast_to(x, (size, *x.shape))
            return x.reshape(size * x.shape[1], *x.shape[2:])

        def split(x: jax.Array) -> jax.Array:
            return x.reshape(size, x.shape[0] // size, *x.shape[1:])

        out = jax.tree.map(split, mapped(*jax.tree.map(merge, args, tuple(batched))))
        return out, jax.tree.map(lambda _: True, out)

    return mapped


def _once(function: Callable) -> Callable:
    """The function, which says so if it is to be differentiated."""
    guarded = jax.custom_vjp(function)

    def refuse(*_: Any):
        raise NotImplementedError(
            "a rollout of engine structured has first derivatives only: its gradient cannot be "
            "differentiated again (jax.hessian, grad of grad)"
        )

    guarded.defvjp(refuse, refuse)
    return guarded


def _adjoint(
    settings: Settings,
    trajectory: bool,
    fields: ModelFields,
    ctrl: jax.Array,
    path: StatePath,
    speed: jax.Array,
    cotangent: Trace,
) -> tuple[ModelFields, jax.Array]:
    """Cotangents of fields and controls.

    Args:
      speed: Its largest velocities, as in `Trace`.
      cotangent: Cotangent of its trace, without status, residual and overlap.
    """
    scene = settings.scene
    program = AdjointProgram.here(scene, settings.limits, ctrl.dtype, len(ctrl))

    def inputs(fields: ModelFields, ctrl: jax.Array) -> Inputs:
        start = coordinates.reset(scene, fields)
        return program.inputs(world_constants(scene, fields), start, ctrl)

    tables, pull_inputs = jax.vjp(inputs, fields, ctrl)
    taken = path.taken[:, 0, 0]
    # The entry after a failed step shows the speed of a state that was not kept.
    bounds = world_constants(scene, fields).bounds
    bounds = verdict.Bounds(*(v[0, :, None] for v in bounds))
    shown = jnp.where(verdict.slow(bounds, speed), cotangent.speed, 0.0)
    entries = [cotangent.distance, cotangent.height, shown]
    assert cotangent.last is not None
    trace = _gathered(taken, jnp.stack(entries, 2))[..., None]
    bars = Cotangents(*program.rows_of_end(cotangent.last), trace)
    if trajectory:
        bars = bars._replace(path=program.rows_of(_gathered(taken, cotangent.qpos)))
    path, bars = jax.tree.map(program.by_block, (path, bars))
    bars_of_inputs = _reversed(settings, program, tables, path, bars, trajectory=trajectory)
    fields_bar, ctrl_bar = pull_inputs(program.sound(bars_of_inputs, path.taken))
    fields_bar = fields_bar._replace(shape=None)  # an index has no derivative
    # A world of fields that are not numbers never moved, and has no derivative.
    return jax.tree.map(partial(_of_worlds, taken[:, 0] > 0), (fields_bar, ctrl_bar))


def _gathered(taken: jax.Array, x: jax.Array) -> jax.Array:
    """Cotangents of entries (world, time, entry), those of entries that repeat in the first.

    Args:
      taken: Number of steps that each world took, shape (world, 1): later entries show the state
        at its end.
    """
    step = jnp.arange(x.shape[1])[:, None]
    end = taken[:, None]
    rest = jnp.where(step >= end, x, 0.0).sum(1, keepdims=True)
    return jnp.where(step < end, x, jnp.where(step == end, rest, 0.0))


def _of_worlds(keep: jax.Array, x: jax.Array) -> jax.Array:
    """Zeros for what is no number of worlds, on the leading axis, that are not kept."""
    return jnp.where(keep.reshape(-1, *[1] * (x.ndim - 1)) | jnp.isfinite(x), x, 0.0)


def _reversed(
    settings: Settings,
    program: AdjointProgram,
    inputs: Inputs,
    path: StatePath,
    bars: Cotangents,
    *,
    trajectory: bool,
) -> Inputs:
    """Cotangents of a rollout's inputs, see `AdjointProgram.adjoint`.

    Of segments only the first states were stored.  Their steps are simulated once more, by the
    kernel that simulated them before: their bits are the same, as a block's step depends on nothing
    but its state.  The cotangents of the constants are handed on from segment to segment, so that
    the order of their sums is that of the whole path.

    Args:
      path: What was stored of it, as tables of blocks.
      bars: Cotangents of its results, as tables of blocks.
    """
    if settings.segment is None:
        input_bars = program.adjoint(inputs, path, bars)
        return input_bars._replace(world=program.summed(input_bars.world))
    return _reversed_by_segment(settings, program, inputs, path, bars, trajectory=trajectory)


def _reversed_by_segment(
    settings: Settings,
    program: AdjointProgram,
    inputs: Inputs,
    path: StatePath,
    bars: Cotangents,
    *,
    trajectory: bool,
) -> Inputs:
    """`_reversed` of a path of which the first states of segments were stored."""
    size = settings.segment
    assert size is not None
    steps = inputs.arm.shape[1]
    count = path.finger.shape[1]
    options = {"backend": program.backend, "width": program.size, "team": 1}
    again = Program(settings.scene, settings.limits, **options)  # type: ignore[arg-type]

    def split(x: jax.Array) -> jax.Array:
        """(block, time, ...) to (segment, block, time of the segment, ...)."""
        x = jnp.pad(x, [(0, 0), (0, count * size - steps)] + [(0, 0)] * (x.ndim - 2))
        return jnp.moveaxis(x.reshape(x.shape[0], count, size, *x.shape[2:]), 1, 0)

    def segment(ends: tuple, given: tuple) -> tuple[tuple, tuple]:
        number, (finger_start, world_start), (arm, pressure), shown = given
        taken = jnp.clip(path.taken - number * size, 0, size)
        given_inputs = inputs._replace(
            finger_start=finger_start, world_start=world_start, arm=arm, pressure=pressure
        )
        out = again.execute(given_inputs, trajectory=trajectory, states=1)
        here = state_path(out, taken)
        finger_bar, state_bar, *sums = ends
        cotangents = Cotangents(finger_bar, state_bar, shown[0], shown[1:])
        before = program.adjoint(given_inputs, here, cotangents, tuple(sums))
        state = before.finger_start, before.world_start
        state = [(jnp.zeros_like(x) if settings.truncate else x)[:, None] for x in state]
        return (*state, before.hand, before.world), (before.arm, before.pressure)

    every = jnp.arange(count, dtype=inputs.arm.dtype)
    starts = tuple(jnp.moveaxis(x, 1, 0) for x in path[:2])
    shown = tuple(split(x) for x in (bars.trace, *bars.path))
    given = every, starts, (split(inputs.arm), split(inputs.pressure)), shown
    sums = program.no_sums(inputs.arm.shape[0], inputs.arm.dtype)
    (finger_bar, state_bar, hand_bar, world_bar), (arm_bar, pressure_bar) = jax.lax.scan(
        segment, (bars.finger, bars.world, *sums), given, reverse=True
    )

    def join(x: jax.Array) -> jax.Array:
        return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1, *x.shape[3:])[:, :steps]

    return Inputs(
        hand=hand_bar,
        world=program.summed(world_bar),
        finger_start=finger_bar[:, 0],
        world_start=state_bar[:, 0],
        arm=join(arm_bar),
        pressure=join(pressure_bar),
        grid=None if inputs.grid is None else jnp.zeros_like(inputs.grid),
    )
