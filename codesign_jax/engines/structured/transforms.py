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
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax import verdict
from codesign_jax.engines.structured import segments
from codesign_jax.engines.structured.kernel.adjoint import AdjointProgram, Cotangents, Path
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import ModelFields
from codesign_jax.types import Trace

if TYPE_CHECKING:
    from codesign_jax.engines.structured.engine import StructuredEngine


def rollout(
    engine: "StructuredEngine",
    fields: ModelFields,
    ctrl: jax.Array,
    tables: tuple[jax.Array, ...] = (),
    *,
    trajectory: bool,
) -> Trace:
    """`StructuredEngine.simulate`'s trace, under any of JAX's transformations but forward mode.

    Raises:
      NotImplementedError: If a derivative is differentiated again.
    """
    plain = folded(partial(engine.simulate, trajectory=trajectory))
    recorded = _once(folded(partial(engine.record, trajectory=trajectory)))
    adjoint = _once(folded(partial(_adjoint, engine, trajectory)))

    @jax.custom_vjp
    def run(fields: ModelFields, ctrl: jax.Array, tables: tuple[jax.Array, ...]) -> Trace:
        return plain(fields, ctrl, tables)

    def forward(fields: ModelFields, ctrl: jax.Array, _: tuple[jax.Array, ...]):
        trace, path = recorded(fields, ctrl)
        return trace, (fields, ctrl, path, trace.speed)

    def backward(saved: tuple, cotangent: Trace):
        return *adjoint(*saved, cotangent._replace(status=None, residual=None)), None

    run.defvjp(forward, backward)
    return run(fields, ctrl, tables)


def folded(function: Callable) -> Callable:
    """The function, whose arrays all have a leading world axis, with a rule for `jax.vmap`.

    Worlds must not depend on each other.
    """
    mapped = jax.custom_batching.custom_vmap(function)

    @mapped.def_vmap
    def _(size: int, batched: Any, *args: Any):
        def merge(x: jax.Array, own: bool) -> jax.Array:
            x = x if own else jnp.broadcast_to(x, (size, *x.shape))
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
    engine: "StructuredEngine",
    trajectory: bool,
    fields: ModelFields,
    ctrl: jax.Array,
    path: Path,
    speed: jax.Array,
    cotangent: Trace,
) -> tuple[ModelFields, jax.Array]:
    """Cotangents of fields and controls.

    Args:
      speed: Its largest velocities, as in `Trace`.
      cotangent: Cotangent of its trace, without status and residual.
    """
    scene = engine.scene
    program = AdjointProgram.here(scene, engine.limits, ctrl.dtype, len(ctrl))

    def inputs(fields: ModelFields, ctrl: jax.Array) -> tuple:
        return program.inputs(world_constants(scene, fields), engine.reset(fields), ctrl)

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
    found = segments.reverse(engine, program, tables, path, bars, trajectory=trajectory)
    sound = program.sound  # pyright: ignore[reportAttributeAccessIssue]  # an AdjointProgram here
    fields_bar, ctrl_bar = pull_inputs(sound(found, path.taken))
    # A world of fields that are not numbers never moved, and has no derivative.
    return jax.tree.map(partial(_of_worlds, taken[:, 0] > 0), (fields_bar, ctrl_bar))


def _gathered(taken: jax.Array, x: jax.Array) -> jax.Array:
    """Cotangents of entries (world, time, entry), those of entries that repeat in the first.

    Args:
      taken: Number of steps that each world took, shape (world, 1): later entries show the state
        at its end.
    """
    step, end = jnp.arange(x.shape[1])[:, None], taken[:, None]
    rest = jnp.where(step >= end, x, 0.0).sum(1, keepdims=True)
    return jnp.where(step < end, x, jnp.where(step == end, rest, 0.0))


def _of_worlds(keep: jax.Array, x: jax.Array) -> jax.Array:
    """Zeros for what is no number of worlds, on the leading axis, that are not kept."""
    return jnp.where(keep.reshape(-1, *[1] * (x.ndim - 1)) | jnp.isfinite(x), x, 0.0)
