"""Streams worlds through a fixed number of lanes, each at its own time step.

A batch that steps in unison waits in every step for the world that needs most Newton iterations,
and simulates lost objects to the end.  Here a round of the loop does a few iterations for all
lanes; a lane whose iteration has converged advances, the others go on from where they are.  A lane
whose world is decided takes the next world that waits.  A world's numbers do not depend on which
others share the round.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.hand import HandLanes
from codesign_jax.engines.structured.kinematics import State
from codesign_jax.scene import Scene
from codesign_jax.types import Status, Trace

Advance = Callable[[HandLanes, State, jax.Array], tuple[State, State, jax.Array, jax.Array]]
ROW = 4
"""Distance, height, speed and status of a step."""


class Queue(NamedTuple):
    """All worlds of a batch, the world as last axis except in `ctrl`.

    Attributes:
      hand: Their constants.
      start: Their start states.
      ctrl: Controls, shape (world, time, nu).
    """

    hand: HandLanes
    start: State
    ctrl: jax.Array


class Lanes(NamedTuple):
    """What the lanes hold; one world each, none if its index is the number of worlds.

    Attributes:
      world: Index of the world, shape (lane,) int32.
      time: Its time step, shape (lane,) int32.
      rounds: Rounds spent on this step, shape (lane,) int32.
      speed: Largest velocity after the last step, shape (lane,).
      state: States.
      hand: Constants.
      waiting: First world that no lane has taken, shape () int32.
    """

    world: jax.Array
    time: jax.Array
    rounds: jax.Array
    speed: jax.Array
    state: State
    hand: HandLanes
    waiting: jax.Array


class Record(NamedTuple):
    """What the worlds leave.

    Attributes:
      values: Trace rows as they come, shape (world, time, `ROW` and qpos).
      last: The last step of every world, shape (world,) int32.
      state: The state before it, shape (world, nq + nv).
    """

    values: jax.Array
    last: jax.Array
    state: jax.Array


def stream(
    scene: Scene,
    queue: Queue,
    advance: Advance,
    speed_of: Callable[[State], jax.Array],
    qpos_of: Callable[[State], jax.Array],
    flat_of: Callable[[State], jax.Array],
    *,
    lanes: int,
    max_rounds: int,
    trajectory: bool,
) -> Trace:
    """Simulates every world until its verdict is decided.

    Args:
      scene: The scene.
      queue: The worlds.
      advance: From hand, state and controls (nu, lane) to the state after the step, the state to
        resume an unfinished step from, whether the step is solved, shape (lane,), and the hand's
        centre, shape (3, 1, lane).
      speed_of: Largest velocity of states, shape (lane,).
      qpos_of: MuJoCo's qpos of states, shape (lane, nq).
      flat_of: MuJoCo's qpos and qvel of states, shape (lane, nq + nv).
      lanes: Number of lanes; fewer if there are fewer worlds.
      max_rounds: Rounds after which a step is taken as it is.
      trajectory: Whether to record qpos.

    Returns:
      The trace; the entries of a decided world repeat its last one.
    """
    worlds, steps, dtype = *queue.ctrl.shape[:2], queue.ctrl.dtype
    lanes = min(lanes, worlds)
    width = ROW + (qpos_of(queue.start).shape[1] if trajectory else 0)

    def one_round(carry: tuple[Lanes, Record]) -> tuple[Lanes, Record]:
        now, record = carry
        # A lane without a world repeats its last one's last step and writes nowhere.
        step = jnp.minimum(now.time, steps - 1)
        ctrl = queue.ctrl[jnp.minimum(now.world, worlds - 1), step].T
        new, resumed, solved, centre = advance(now.hand, now.state, ctrl)
        capped = ~solved & (now.rounds + 1 >= max_rounds)
        row = _row(now.state, now.speed, centre, capped)
        if trajectory:
            row = jnp.concatenate([row, qpos_of(now.state)], 1)
        values = record.values.at[now.world, now.time].set(row, mode="drop")
        decided = _decided(scene, row, now.time) | (now.time >= steps - 1)
        last = record.last.at[now.world].set(now.time, mode="drop")
        end = record.state.at[now.world].set(flat_of(now.state), mode="drop")
        solved |= capped
        speed = speed_of(new)
        good = solved & (speed <= scene.limits.speed)
        state = jax.tree.map(lambda a, b: jnp.where(good, a, b), new, resumed)
        moved = now._replace(
            time=now.time + solved,
            rounds=jnp.where(solved, 0, now.rounds + 1),
            speed=jnp.where(solved, speed, now.speed),
            state=state,
        )
        return _refill(queue, moved, decided & (now.world < worlds)), Record(values, last, end)

    values, none = jnp.zeros((worlds, steps, width), dtype), jnp.zeros(worlds, jnp.int32)
    record = Record(values, none, flat_of(queue.start))
    first = _first(queue, lanes)
    _, record = jax.lax.while_loop(
        lambda carry: jnp.any(carry[0].world < worlds), one_round, (first, record)
    )
    held = jnp.minimum(jnp.arange(steps)[None], record.last[:, None])
    values = jnp.take_along_axis(record.values, held[:, :, None], axis=1)
    distance, height, speed, status = (values[..., k] for k in range(ROW))
    bits = status.astype(jnp.int32)
    return Trace(distance, height, speed, values[..., ROW:], bits, record.state)


def _first(queue: Queue, lanes: int) -> Lanes:
    zero = jnp.zeros(lanes, jnp.int32)
    head = (queue.start, queue.hand)
    state, hand = jax.tree.map(lambda v: v[..., :lanes] if v.size else v, head)
    speed = jnp.zeros(lanes, queue.ctrl.dtype)
    return Lanes(jnp.arange(lanes), zero, zero, speed, state, hand, jnp.int32(lanes))


def _row(state: State, speed: jax.Array, centre: jax.Array, capped: jax.Array) -> jax.Array:
    """Distance, height, speed and status of every lane, shape (lane, `ROW`)."""
    away = state.position - centre
    distance = jnp.sqrt(away[0, 0] ** 2 + away[1, 0] ** 2 + away[2, 0] ** 2)
    status = jnp.where(capped, float(Status.SOLVER_CAP), 0.0).astype(speed.dtype)
    return jnp.stack([distance, state.position[2, 0], speed, status], 1)


def _decided(scene: Scene, row: jax.Array, time: jax.Array) -> jax.Array:
    """Whether the trace's last entry settles the verdict as `cost.outcome` reads it."""
    start, end = (round(t / scene.discretization.timestep) for t in scene.window)
    lost = (row[:, 0] >= scene.cost.lost_distance) & (time >= start) & (time < end)
    failed = ~(row[:, 2] <= scene.limits.speed) | ~jnp.isfinite(row[:, 0])
    return lost | failed | (row[:, 1] < -scene.limits.penetration)


def _refill(queue: Queue, now: Lanes, free: jax.Array) -> Lanes:
    """Gives free lanes the worlds that wait; a lane that finds none is empty from then on."""
    worlds, lanes = queue.ctrl.shape[0], free.shape[0]
    order = jnp.cumsum(free.astype(jnp.int32)) - 1
    new = jnp.where(free, jnp.minimum(now.waiting + order, worlds), now.world)
    now = now._replace(world=new, waiting=now.waiting + free.sum(dtype=jnp.int32))
    if lanes == worlds:
        return now

    def load(now: Lanes) -> Lanes:
        taken = free & (new < worlds)

        def pick(full: jax.Array, old: jax.Array) -> jax.Array:
            fresh = jnp.take(full, jnp.minimum(new, worlds - 1), axis=-1)
            return jnp.where(taken, fresh, old) if old.size else old

        return now._replace(
            time=jnp.where(taken, 0, now.time),
            rounds=jnp.where(taken, 0, now.rounds),
            speed=jnp.where(taken, 0.0, now.speed),
            state=jax.tree.map(pick, queue.start, now.state),
            hand=jax.tree.map(pick, queue.hand, now.hand),
        )

    return jax.lax.cond(jnp.any(free), load, lambda now: now, now)
