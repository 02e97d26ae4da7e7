"""JAX's transformations of a rollout: `vmap` simulates one larger batch, `grad` runs an adjoint.

Batching: a mapped axis is folded into the axis of the worlds, so that one kernel simulates all of
them whatever the nesting (`jax.custom_batching.custom_vmap`).

Differentiation (`jax.custom_vjp`): the forward pass is the same kernel, which then stores the state
before each step and the accelerations of the step.  The backward pass is one reverse scan over the
steps.  Each step is repeated from its stored accelerations as plain JAX (`differentiable`) and
pulled back by the implicit function theorem (`implicit`): one linear solve a step.

The derivative is that of the trace as it was computed.  The trace of a decided world repeats its
last state, and the cotangents of the repeated entries are added to that state's.  A step that
failed passes no cotangent back.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax import verdict
from codesign_jax.engines.structured import coordinates, differentiable
from codesign_jax.engines.structured.constants import WorldConstants, world_constants
from codesign_jax.engines.structured.lanes import total
from codesign_jax.model import ModelFields
from codesign_jax.types import Trace

if TYPE_CHECKING:
    from codesign_jax.engines.structured.engine import StructuredEngine


class Path(NamedTuple):
    """What the derivative of a rollout needs of every step.

    Attributes:
      qpos: Generalized positions before the step, shape (world, time, nq).
      qvel: Generalized velocities before the step, shape (world, time, nv).
      acc: Accelerations of the step in the order of qvel, the object's as in `kinematics.Acc`,
        shape (world, time, nv).
      moved: Whether the world took the step, bool, shape (world, time).
    """

    qpos: jax.Array
    qvel: jax.Array
    acc: jax.Array
    moved: jax.Array


def rollout(
    engine: "StructuredEngine", fields: ModelFields, ctrl: jax.Array, *, trajectory: bool
) -> Trace:
    """`StructuredEngine.simulate`'s trace, under any of JAX's transformations but forward mode.

    Args:
      engine: The engine.
      fields: As in `Engine.rollout`.
      ctrl: As in `Engine.rollout`.
      trajectory: As in `Engine.rollout`.

    Raises:
      NotImplementedError: If a derivative is differentiated again.
      SceneError: If a derivative is asked for and the scene has none.
    """
    plain = folded(lambda f, c: engine.simulate(f, c, trajectory=trajectory)[0])
    recorded = _once(folded(partial(engine.simulate, trajectory=trajectory, states=True)))
    adjoint = _once(folded(partial(_adjoint, engine)))

    @jax.custom_vjp
    def run(fields: ModelFields, ctrl: jax.Array) -> Trace:
        return plain(fields, ctrl)

    def forward(fields: ModelFields, ctrl: jax.Array):
        differentiable.refuse(engine.scene)  # before the kernel, whose compile takes a while
        trace, path = recorded(fields, ctrl)
        return trace, (fields, ctrl, path, trace.speed)

    def backward(saved: tuple, cotangent: Trace):
        return adjoint(*saved, cotangent._replace(status=None))

    run.defvjp(forward, backward)
    return run(fields, ctrl)


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
    fields: ModelFields,
    ctrl: jax.Array,
    path: Path,
    speed: jax.Array,
    cotangent: Trace,
) -> tuple[ModelFields, jax.Array]:
    """Cotangents of fields and controls.

    Args:
      engine: The engine.
      fields: Model fields of the rollout.
      ctrl: Its controls.
      path: Its steps.
      speed: Its largest velocities, as in `Trace`.
      cotangent: Cotangent of its trace, without the status.
    """
    with jax.default_matmul_precision("highest"):
        return _reverse_scan(engine, fields, ctrl, path, speed, cotangent)


def _reverse_scan(
    engine: "StructuredEngine",
    fields: ModelFields,
    ctrl: jax.Array,
    path: Path,
    speed: jax.Array,
    cotangent: Trace,
) -> tuple[ModelFields, jax.Array]:
    scene, nq = engine.scene, path.qpos.shape[-1]
    hand = world_constants(scene, fields)
    _, rebuild = _numbers(hand)
    bounds = verdict.Bounds(*(v[0] for v in hand.bounds))
    numbers, pull_fields = jax.vjp(lambda f: _numbers(world_constants(scene, f))[0], fields)
    assert cotangent.last is not None

    def body(carry: tuple, t: jax.Array):
        sums, qpos_bar, qvel_bar = carry
        here, u, top, bar = jax.tree.map(
            lambda x: jax.lax.dynamic_index_in_dim(x, t, 1, keepdims=False),
            (path, ctrl, speed, cotangent._replace(last=None)),
        )
        moved = here.moved[:, None]
        acc = jnp.where(moved, here.acc, 0.0)

        def step(numbers: list, qpos: jax.Array, qvel: jax.Array, u: jax.Array):
            state = coordinates.make(scene, qpos, qvel, acc)
            new, centre = differentiable.step(scene, rebuild(numbers), state, u.T)
            away = state.position - centre
            distance = jnp.sqrt(total([away[i, 0] ** 2 for i in range(3)]))
            entry = distance, state.position[2, 0], coordinates.speed(state)
            return coordinates.qpos(new), coordinates.qvel(new), *entry

        _, pull = jax.vjp(step, numbers, here.qpos, here.qvel, u)
        # The entry after a failed step shows the speed of a state that was not kept.
        shown = jnp.where(verdict.slow(bounds, top), bar.speed, 0.0)
        after = jnp.where(moved, qpos_bar, 0.0), jnp.where(moved, qvel_bar, 0.0)
        own, dq, dv, du = pull((*after, bar.distance, bar.height, shown))
        own, (dq, dv, du) = _finite(own, moved.T), _finite((dq, dv, du), moved)
        dq += jnp.where(moved, 0.0, qpos_bar)
        dv += jnp.where(moved, 0.0, qvel_bar)
        dq += bar.qpos if bar.qpos.shape[-1] else 0.0
        return (jax.tree.map(jnp.add, sums, own), dq, dv), du

    zero = jax.tree.map(jnp.zeros_like, numbers)
    start = zero, cotangent.last[:, :nq], cotangent.last[:, nq:]
    steps = jnp.arange(ctrl.shape[1])
    (sums, start_bar, _), ctrl_bar = jax.lax.scan(body, start, steps, reverse=True)
    (bar,) = pull_fields(sums)
    bar = bar._replace(start=bar.start + start_bar)
    # A world that never moved, such as one of fields that are not numbers, has no derivative.
    bar = jax.tree.map(partial(_of_worlds, path.moved.any(1)), bar)
    return bar, jnp.moveaxis(ctrl_bar, 0, 1)


def _numbers(hand: WorldConstants) -> tuple[list[jax.Array], Callable]:
    """The constants that have a derivative, and the function that puts such into the others' place.

    Lanes have two axes at least: what has fewer, such as the grids of meshes, belongs to the scene.
    """
    leaves, structure = jax.tree.flatten(hand)
    mine = [jnp.issubdtype(x.dtype, jnp.floating) and x.ndim > 1 for x in leaves]

    def rebuild(numbers: list[jax.Array]) -> WorldConstants:
        given = iter(numbers)
        every = [next(given) if m else x for x, m in zip(leaves, mine, strict=True)]
        return jax.tree.unflatten(structure, every)

    return [x for x, m in zip(leaves, mine, strict=True) if m], rebuild


def _finite(tree: Any, moved: jax.Array) -> Any:
    """Cotangents; zero where one of a world that stands still is not a number."""
    return jax.tree.map(lambda x: jnp.where(moved | jnp.isfinite(x), x, 0.0), tree)


def _of_worlds(keep: jax.Array, x: jax.Array) -> jax.Array:
    """Zeros for the worlds, on the leading axis, that are not kept."""
    return jnp.where(keep.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0)
