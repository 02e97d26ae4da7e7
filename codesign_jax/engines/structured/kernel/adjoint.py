"""The reverse-mode derivative of a whole rollout as one kernel.

It goes through the stored path backwards, with the forward kernel's own functions and tables, and
leaves the cotangents of the forward kernel's arguments.  A block begins at the last step that
any of its worlds took.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.adjoint_step import ReverseStep, TraceCotangents
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables
from codesign_jax.engines.structured.kernel.memory import Block, MemoryLayout
from codesign_jax.engines.structured.kernel.memory_tables import Tables
from codesign_jax.engines.structured.kernel.program import Program, leaf_indices
from codesign_jax.engines.structured.kernel.rollout import Inputs, Outputs, copy_rows
from codesign_jax.engines.structured.kernel.rows import (
    BodyBar,
    Chain,
    ChainBefore,
    FingerState,
    HeldBar,
    Remembered,
    StepBar,
    Virtual,
    WorldState,
)
from codesign_jax.engines.structured.kernel.step_memory import References
from codesign_jax.engines.structured.lanewise import lanes


class StatePath(NamedTuple):
    """What the reverse pass reads of a rollout, with a leading world axis.

    In a kernel the rows are those of blocks, see `Packing.by_block`.
    """

    # Fingers' state before the steps that are stored, shape (world, time, row, finger)
    finger: jax.Array
    world: jax.Array  # Wrist and object alike, shape (world, time, row, 1)
    finger_end: jax.Array  # The same after the last step, shape (world, 1, row, finger)
    world_end: jax.Array  # Likewise
    taken: jax.Array  # Number of steps that each world took, shape (world, 1, 1, 1)


def state_path(out: Outputs, taken: jax.Array) -> StatePath:
    """What `Program.execute` has stored in blocks; `taken` as in `StatePath`, of blocks."""
    return StatePath(*out.path[-1], out.finger_state[:, None], out.world_state[:, None], taken)


class Cotangents(NamedTuple):
    """Cotangents of a rollout's results, laid out as `StatePath`."""

    finger: jax.Array  # Of the fingers' state at the end, shape (world, 1, row, finger)
    world: jax.Array  # Of wrist and object at the end, shape (world, 1, row, 1)
    trace: jax.Array  # Of distance, height and speed, shape (world, time, 3, 1)
    # Of the positions at every step, (world, time, row, finger) and (world, time, row, 1); none
    # without a trajectory
    path: tuple[jax.Array, ...] = ()


class AdjointInputs(NamedTuple):
    """What the adjoint reads, tables of blocks; `bars` are cotangents."""

    hand: Any  # As in `Inputs`
    world: Any  # As in `Inputs`
    arm: Any  # As in `Inputs`
    pressure: Any  # As in `Inputs`
    path: StatePath
    finger_bar: Any  # As `Cotangents.finger`
    world_bar: Any  # As `Cotangents.world`
    hand_sum: Any  # What is added to the cotangents of `hand`, shape (block, row, lane)
    world_sum: Any  # The same of `world`, on the lanes of each finger, shape (block, row, lane)
    trace_bar: Any  # As `Cotangents.trace`
    path_bar: tuple[Any, ...]  # As `Cotangents.path`
    grid: Any = None  # As in `Inputs`


class AdjointOutputs(NamedTuple):
    """What the adjoint writes: cotangents of `Inputs`, and memory that is not read."""

    hand: Any  # As in `Inputs`
    world: Any  # On the lanes of each finger, shape (block, row, lane)
    finger_start: Any  # As in `Inputs`
    world_start: Any  # As in `Inputs`
    arm: Any  # As in `Inputs`
    pressure: Any  # As in `Inputs`
    scratch: Any  # Memory of a step
    finger_state: Any  # The state before a step
    world_state: Any  # Likewise


class AdjointProgram(Program):
    """Tables and kernel of a rollout's derivative."""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **{**options, "team": 1})

    remembers = (Remembered,)

    def _tables(self) -> None:
        super()._tables()
        more = self._groups(Chain, ChainBefore, Virtual)
        for contacts in self.lists:
            more |= contacts.groups_of(HeldBar)
        more |= self._groups(StepBar, BodyBar)
        self.scratch = MemoryLayout.by_item(True, **(self.scratch.groups | more))
        self.world_bars = MemoryLayout(True, **self.world.groups)

    def adjoint(
        self, inputs: Inputs, path: StatePath, bars: Cotangents, sums: tuple | None = None
    ) -> Inputs:
        """Cotangents of `Program.inputs`; where a world took no step they need not be numbers.

        Args:
          inputs: What the rollout read.
          path: What it stored, as tables of blocks.
          bars: Cotangents of its results, as tables of blocks.
          sums: What is added to the cotangents of `inputs.hand`, shape (block, row, lane), and of
            `inputs.world`, on the lanes of each finger; None for zeros.

        Returns:
          Cotangents shaped as the inputs, but those of `world`, which are on the lanes of each
          finger: `summed` adds them up.
        """
        given = self._arguments(inputs, path, bars, sums)
        call, outputs = self._adjoint_call(given)
        index = leaf_indices(outputs)
        scratch = index.scratch, index.finger_state, index.world_state
        # At LLVM's level 1 it is as fast, with the same bits, after two thirds of LLVM's time.
        origin = repr((self.scene.structure, "adjoint"))
        out = self.launch(call, given, outputs, origin, scratch=scratch, level=1)
        grid = None if inputs.grid is None else jnp.zeros_like(inputs.grid)
        return Inputs(
            hand=out.hand,
            world=out.world,
            finger_start=out.finger_start,
            world_start=out.world_start,
            arm=out.arm,
            pressure=out.pressure,
            grid=grid,
        )

    def no_sums(self, blocks: int, dtype: Any) -> tuple:
        """Cotangents of the constants before the last step: those of the hand, and the worlds'."""
        rows = self.hand.rows, self.world_bars.rows
        return tuple(jnp.zeros((blocks, n, self.size), dtype) for n in rows)

    def summed(self, world: jax.Array) -> jax.Array:
        """Cotangents of the worlds' constants, of those on each of the fingers' lanes."""
        return world.reshape(*world.shape[:2], self.fingers, self.block).sum(2)

    def sound(self, bars: Inputs, taken: jax.Array) -> Inputs:
        """Cotangents of the inputs, zero where a world took no step and they are no numbers."""
        some = taken[:, 0] > 0
        lane = jnp.tile(some, (1, 1, self.fingers))
        masks = {
            "hand": lane,
            "world": some,
            "finger_start": lane,
            "world_start": some,
            "arm": some[:, None],
            "pressure": lane,
        }
        cleared = {}
        for name, mask in masks.items():
            bar = getattr(bars, name)
            cleared[name] = jnp.where(mask | jnp.isfinite(bar), bar, 0.0)
        return bars._replace(**cleared)

    def _arguments(
        self, inputs: Inputs, path: StatePath, bars: Cotangents, sums: tuple | None = None
    ) -> AdjointInputs:
        if sums is None:
            sums = self.no_sums(inputs.hand.shape[0], inputs.hand.dtype)
        hand_sum, world_sum = sums
        return AdjointInputs(
            hand=inputs.hand,
            world=inputs.world,
            arm=inputs.arm,
            pressure=inputs.pressure,
            path=path,
            finger_bar=bars.finger,
            world_bar=bars.world,
            hand_sum=hand_sum,
            world_sum=world_sum,
            trace_bar=bars.trace,
            path_bar=bars.path,
            grid=inputs.grid,
        )

    def _adjoint_call(self, given: AdjointInputs) -> tuple[Callable, AdjointOutputs]:
        blocks, steps = given.arm.shape[:2]

        def shape(*sizes: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((blocks, *sizes), given.arm.dtype)

        finger_state = shape(self.finger_state.rows, self.size)
        world_state = shape(self.world_state.rows, self.block)
        outputs = AdjointOutputs(
            hand=shape(self.hand.rows, self.size),
            world=shape(self.world_bars.rows, self.size),
            finger_start=finger_state,
            world_start=world_state,
            arm=shape(steps, 6, self.block),
            pressure=shape(steps, self.size),
            scratch=shape(self.scratch.rows, self.size),
            finger_state=finger_state,
            world_state=world_state,
        )
        kernel = partial(self._adjoint_kernel, steps)
        return self.call(kernel, "grasp_adjoint", given, outputs), outputs

    def _adjoint_kernel(self, steps: int, given: AdjointInputs, out: AdjointOutputs) -> None:
        adjoint = BlockAdjoint(self, steps, given, out)
        adjoint.start()
        adjoint.run()


class BlockAdjoint:
    """The reverse pass of a block of worlds in a kernel."""

    def __init__(self, tables: Tables, steps: int, given: AdjointInputs, out: AdjointOutputs):
        """Takes what the kernel reads and writes.

        Args:
          tables: The rows of the tables.
          steps: Steps of the path.
          given: References to a block's part of the tables that are read.
          out: References to its part of those that are written.
        """
        block = Block(tables.fingers, tables.block)
        self.tables = tables
        self.steps = steps
        self.given = given
        self.out = out
        self.world = block.world
        self.none = jnp.zeros((tables.size,), out.scratch.dtype)
        bars = References(
            hand=out.hand,
            world=out.world,
            finger_state=out.finger_start,
            world_state=out.world_start,
            scratch=out.scratch,
        )
        references = References(
            hand=given.hand,
            world=given.world,
            finger_state=out.finger_state,
            world_state=out.world_state,
            scratch=out.scratch,
            grid=given.grid,
        )
        self.bars = CotangentTables(tables, block, bars)
        self.step = ReverseStep(tables, block, references, self.bars)

    def start(self) -> None:
        """Copies the cotangents of the last state, and those of constants that are added to."""
        given = self.given
        out = self.out
        world = self.world
        rows = self.tables.finger_state.rows, self.tables.world_state.rows
        copy_rows((0, self.tables.hand.rows), lambda k: given.hand_sum[(k,)], out.hand)
        copy_rows((0, self.tables.world.rows), lambda k: given.world_sum[(k,)], out.world)
        copy_rows((0, rows[0]), lambda k: given.finger_bar[(0, k)], out.finger_start)
        copy_rows((0, rows[1]), lambda k: given.world_bar[0, k, world], out.world_start, world)

    def run(self) -> None:
        """Goes back from the last step that any world took; later commands have no cotangents."""
        count = self.given.path.taken[0, 0, self.world]
        last = jnp.minimum(jnp.max(count.astype(jnp.int32)), self.steps - 1)

        def idle(t: jax.Array, x: jax.Array) -> jax.Array:
            for k in range(6):
                self.out.arm[t, k, self.world] = self.none
            self.out.pressure[(t, slice(None))] = self.none
            return x

        def reverse(back: jax.Array, x: jax.Array) -> jax.Array:
            t = last - back
            self._reverse(t, t.astype(count.dtype) < count)
            return x

        jax.lax.fori_loop(last + 1, self.steps, idle, jnp.int32(0))
        jax.lax.fori_loop(0, last + 1, reverse, jnp.int32(0))

    def _reverse(self, t: jax.Array, moved: jax.Array) -> None:
        """Makes the cotangents of the state after step t those before it; moved: who took it."""
        given = self.given
        out = self.out
        world = self.world
        self._load(t, moved)
        commands = [jnp.where(moved, given.arm[t, k, world], 0.0) for k in range(6)]
        chamber = jnp.where(moved, given.pressure[(t,)], 0.0)
        shown = TraceCotangents(*(given.trace_bar[t, k, world] for k in range(3)))
        arms = self.step.reverse(
            lanes(commands, (6,), wide=False), lanes([chamber], (), wide=True), moved, shown
        )
        for k in range(6):
            out.arm[t, k, world] = jnp.where(moved, arms[k].lane, 0.0)
        pressure_bar = self.bars.of_step("pressure").lane
        out.pressure[(t, slice(None))] = jnp.where(moved, pressure_bar, 0.0)
        if given.path_bar:
            self._add_path(t)

    def _add_path(self, t: jax.Array) -> None:
        """Adds the cotangents of the positions that the trajectory shows before step t."""
        fingers, worlds = self.given.path_bar
        finger_bar = self.out.finger_start
        world_bar = self.out.world_start
        world = self.world
        of_finger, of_world = self.tables.path_rows(states=False)
        copy_rows((0, of_finger), lambda k: finger_bar[(k,)] + fingers[(t, k)], finger_bar)
        copy_rows(
            (0, of_world), lambda k: world_bar[k, world] + worlds[t, k, world], world_bar, world
        )

    def _load(self, t: jax.Array, moved: jax.Array) -> None:
        """Loads the state before a step, with the step's accelerations.

        A row of the path has the acceleration of the step before it, the solver's warm start. Where
        a world took no step they are of no use, and need not be numbers.
        """
        path = self.given.path
        out = self.out
        world = self.world
        after = jnp.minimum(t + 1, self.steps - 1)
        more = t + 1 < self.steps
        finger_rows = self.tables.finger_state
        world_rows = self.tables.world_state
        finger_acc = finger_rows.offset[FingerState.acc]
        world_acc = world_rows.offset[WorldState.acc_wrist]

        def of_finger(k: jax.Array) -> jax.Array:
            acc = jnp.where(more, path.finger[(after, k)], path.finger_end[(0, k)])
            return jnp.where(moved, acc, 0.0)

        def of_world(k: jax.Array) -> jax.Array:
            acc = jnp.where(more, path.world[after, k, world], path.world_end[0, k, world])
            return jnp.where(moved, acc, 0.0)

        copy_rows((0, finger_acc), lambda k: path.finger[(t, k)], out.finger_state)
        copy_rows((0, world_acc), lambda k: path.world[t, k, world], out.world_state, world)
        copy_rows((finger_acc, finger_rows.rows), of_finger, out.finger_state)
        copy_rows((world_acc, world_rows.rows), of_world, out.world_state, world)
