"""The rollout of a block of worlds inside the kernel: what it reads and writes, and its loop."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import shared_memory
from codesign_jax.engines.structured.kernel.memory import Block, BoundTable, TimeStep, anywhere
from codesign_jax.engines.structured.kernel.memory_tables import Tables
from codesign_jax.engines.structured.kernel.newton import Limits
from codesign_jax.engines.structured.kernel.rows import WorldState
from codesign_jax.engines.structured.kernel.step import Step
from codesign_jax.engines.structured.kernel.step_memory import References
from codesign_jax.engines.structured.lanewise import Lanes, lanes
from codesign_jax.judge import verdict


class Inputs(NamedTuple):
    """What the kernel reads of worlds, tables of blocks; also their cotangents."""

    hand: Any  # `rows.Hand`, shape (block, row, lane)
    world: Any  # `rows.World`, shape (block, row, world)
    finger_start: Any  # `rows.FingerState` at the start, shape (block, row, lane)
    world_start: Any  # `rows.WorldState` at the start, shape (block, row, world)
    arm: Any  # Commands of the arm frame, shape (block, time, 6, world)
    pressure: Any  # Pressures of the chambers [Pa], shape (block, time, lane)
    # Distances of all meshes, which all blocks share, shape (1, n); None without meshes
    grid: Any = None


class PathRows(NamedTuple):
    """States that are stored, every so many steps: all rows, or those of positions."""

    finger: Any  # Rows of `rows.FingerState`, shape (block, time, row, lane)
    world: Any  # Rows of `rows.WorldState`, shape (block, time, row, world)


class Outputs(NamedTuple):
    """What the kernel writes of worlds, tables of blocks."""

    finger_state: Any  # `rows.FingerState` at the end, shape (block, row, lane)
    world_state: Any  # `rows.WorldState` at the end, shape (block, row, world)
    scratch: Any  # Memory of a step, which is not read; None after the call
    trace: Any  # `Program.trace`, shape (block, time, entry, world)
    path: tuple[PathRows, ...] = ()  # One for each of `path_parts`
    recorded: Any = None  # Forces by `kernel.record`, shape (block, time, row, lane)
    onchip: Any = None  # Shared memory of a step, with teams only; None after the call


class PathPart(NamedTuple):
    """Which states a rollout stores."""

    stride: int  # Steps from one stored state to the next, beginning with the first
    whole: bool  # Whether all rows are stored, or those of positions


def path_parts(trajectory: bool, states: int) -> list[PathPart]:
    """What the kernel stores.

    Args:
      trajectory: Whether the positions before every step.
      states: Steps from one whole state to the next, beginning with the first; 0 for none.
    """
    parts = [PathPart(1, states == 1)] if trajectory or states == 1 else []
    return parts + ([PathPart(states, True)] if states > 1 else [])


class BlockRollout:
    """The rollout of a block of worlds in a kernel."""

    def __init__(
        self,
        tables: Tables,
        limits: Limits,
        names: tuple[str, ...],
        inputs: Inputs,
        outputs: Outputs,
        parts: list[PathPart],
    ):
        """Takes what the kernel reads and writes.

        Args:
          tables: The rows of the tables.
          limits: How hard each step is solved.
          names: Names of the trace's entries.
          inputs: References to a block's part of the tables that are read.
          outputs: References to its part of those that are written.
          parts: Which states are stored, one for each of `outputs.path`.
        """
        block = Block(tables.fingers, tables.block, tables.team)
        if tables.team > 1:
            inputs, outputs = _with_shared_columns(block, inputs, outputs)
        self.tables = tables
        self.limits = limits
        self.names = names
        self.inputs = inputs
        self.outputs = outputs
        self.parts = parts
        self.world = block.world
        references = References(
            hand=inputs.hand,
            world=inputs.world,
            finger_state=outputs.finger_state,
            world_state=outputs.world_state,
            scratch=outputs.scratch,
            grid=inputs.grid,
            onchip=outputs.onchip,
        )
        self.step = Step(tables, block, references)

    def start(self) -> None:
        """Copies the start state to the state."""
        inputs = self.inputs
        outputs = self.outputs
        world = self.world
        rows = self.tables.finger_state.rows, self.tables.world_state.rows
        copy_rows((0, rows[0]), lambda k: inputs.finger_start[(k,)], outputs.finger_state)
        copy_rows((0, rows[1]), lambda k: inputs.world_start[k, world], outputs.world_state, world)

    def run(self, steps: int, *, to_end: bool) -> jax.Array:
        """Steps until all worlds are decided; returns the number of steps.

        Args:
          steps: Largest number of steps.
          to_end: Whether worlds that lost their object go on.
        """
        step = self.step
        bounds = verdict.Bounds(*(step.constant(n).lane for n in verdict.Bounds._fields))

        def body(carry: tuple) -> tuple:
            t, going = carry
            now = self._number(WorldState.step)
            fastest = self._number(WorldState.speed)

            def undecided(distance: jax.Array, height: jax.Array) -> jax.Array:
                return verdict.goes_on(bounds, distance, height, fastest, now, to_end=to_end)

            self._store_path(t)
            entries, new_speed, moved = step.advance(
                *self._command(t),
                undecided=undecided,
                waiting=going > 0,
                speed=fastest,
                limits=self.limits,
                begins=t == 0,
                recorded=self._recorded(t),
            )
            going = jnp.where(moved, going, 0.0)
            entries |= {"speed": fastest, "moved": going}
            for k, name in enumerate(self.names):
                self.outputs.trace[t, k, self.world] = entries[name]
            self._keep(step=now + 1.0, going=going, speed=new_speed)
            return t + 1, going

        def goes_on(carry: tuple) -> jax.Array:
            # The first step also tells where worlds are that were decided before.
            return (carry[0] < steps) & (anywhere(carry[1] > 0) | (carry[0] == 0))

        return jax.lax.while_loop(goes_on, body, (jnp.int32(0), self._number(WorldState.going)))[0]

    def repeat_last(self, done: jax.Array, steps: int) -> None:
        """Repeats the trace's last entries from step `done` on.

        They are those of decided worlds of a block that goes on: no decrement, and their speed.
        """
        last_speed = self._number(WorldState.speed)
        none = jnp.zeros_like(last_speed)
        ended = {"speed": last_speed, "decrement": none, "overflow": none}
        world = self.world
        trace = self.outputs.trace

        def repeat(t: jax.Array, x: jax.Array) -> jax.Array:
            self._store_path(t)
            for k, name in enumerate(self.names):
                trace[t, k, world] = ended.get(name, trace[done - 1, k, world])
            self._keep(step=self._number(WorldState.step) + 1.0)
            return x

        jax.lax.fori_loop(done, steps, repeat, jnp.int32(0))

    def _command(self, t: jax.Array) -> tuple[Lanes, Lanes]:
        """Commands of the arm frame and pressures of the chambers at a step."""
        inputs = self.inputs
        pose = lanes([inputs.arm[t, k, self.world] for k in range(6)], (6,), wide=False)
        return pose, lanes([inputs.pressure[t]], (), wide=True)

    def _recorded(self, t: jax.Array) -> BoundTable | None:
        """Where a step's forces are recorded."""
        recorded = self.outputs.recorded
        if recorded is None:
            return None
        return BoundTable(self.tables.recorded, TimeStep(recorded, t))

    def _number(self, name: str) -> jax.Array:
        """A row of the worlds' state with one number, shape (lane,)."""
        return self.step.world_state.read(name).lane

    def _keep(self, **numbers: jax.Array) -> None:
        """Stores such numbers, by row."""
        for name, value in numbers.items():
            self.step.world_state.write(name, lanes([value], (), wide=False))

    def _store_path(self, t: jax.Array) -> None:
        """Stores the state before step t where it is part of the path."""
        for part, target in zip(self.parts, self.outputs.path, strict=True):
            if part.stride == 1:
                self._store_state(t, part.whole, target)
            else:
                stride = jnp.int32(part.stride)
                store = partial(self._store_state, jax.lax.div(t, stride), part.whole, target)
                jax.lax.cond(jax.lax.rem(t, stride) == 0, store, lambda: None)

    def _store_state(self, index: jax.Array, whole: bool, target: PathRows) -> None:
        """Stores the whole state, or its positions, at an index of the path."""
        outputs = self.outputs
        world = self.world
        of_finger, of_world = self.tables.path_rows(whole)
        at = (index,)
        copy_rows((0, of_finger), lambda k: outputs.finger_state[(k,)], target.finger, at=at)
        copy_rows(
            (0, of_world), lambda k: outputs.world_state[k, world], target.world, world, at=at
        )


def _with_shared_columns(block: Block, inputs: Inputs, outputs: Outputs) -> tuple[Inputs, Outputs]:
    """References of which the lanes of a team share the columns."""

    def share(table: Any) -> Any:
        return shared_memory.SharedColumns(block, table)

    return (
        inputs._replace(
            hand=share(inputs.hand),
            finger_start=share(inputs.finger_start),
            pressure=share(inputs.pressure),
        ),
        outputs._replace(
            finger_state=share(outputs.finger_state),
            scratch=share(outputs.scratch),
            recorded=None if outputs.recorded is None else share(outputs.recorded),
            path=tuple(part._replace(finger=share(part.finger)) for part in outputs.path),
            onchip=share(outputs.onchip),
        ),
    )


def copy_rows(rows: tuple[Any, Any], read: Callable, target: Any, *where: Any, at: tuple = ()):
    """Stores read(row) in rows of a table.

    Args:
      rows: The first row, and the one after the last.
      read: From the number of a row to its values.
      target: Reference to the table.
      *where: Behind the row in the index.
      at: Before the row in the index.
    """

    def copy(k: jax.Array, x: jax.Array) -> jax.Array:
        target[(*at, k, *where)] = read(k)
        return x

    jax.lax.fori_loop(*rows, copy, jnp.int32(0))
