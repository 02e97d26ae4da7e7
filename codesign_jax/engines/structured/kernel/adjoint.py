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
from codesign_jax.engines.structured.kernel.program import (
    Inputs,
    Outputs,
    Program,
    copy_rows,
    numbered,
)
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
        for contacts in self.sets:
            more |= contacts.groups_of(HeldBar)
        more |= self._groups(StepBar, BodyBar)
        self.scratch = MemoryLayout.by_item(True, **(self.scratch.groups | more))
        self.world_bars = MemoryLayout(True, **self.world.groups)

    def adjoint(
        self, inputs: Inputs, path: StatePath, bars: Cotangents, sums: tuple | None = None
    ) -> Inputs:
        """Cotangents of `Program.inputs`; where a world took no step they need not be numbers.

        Those of the worlds' constants are for each of their fingers, see `summed`; `sums` is what
        is added to those of the constants, see `no_sums`.
        """
        given = self._arguments(inputs, path, bars, sums)
        call, outputs = self._adjoint_call(given)
        places = numbered(outputs)
        scratch = places.scratch, places.finger_state, places.world_state
        # At LLVM's level 1 it is as fast, with the same bits, after two thirds of LLVM's time.
        origin = repr((self.scene.structure, "adjoint"))
        out = self.launch(call, given, outputs, origin, scratch=scratch, level=1)
        grid = None if inputs.grid is None else jnp.zeros_like(inputs.grid)
        return Inputs(
            out.hand,
            out.world,
            out.finger_start,
            out.world_start,
            out.arm,
            out.pressure,
            grid,
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
        masks = Inputs(lane, some, lane, some, some[:, None], lane)
        cleared = [
            jnp.where(mask | jnp.isfinite(x), x, 0.0)
            for mask, x in zip(masks[:6], bars[:6], strict=True)
        ]
        return bars._replace(**dict(zip(Inputs._fields, cleared, strict=False)))

    def _arguments(
        self, inputs: Inputs, path: StatePath, bars: Cotangents, sums: tuple | None = None
    ) -> AdjointInputs:
        if sums is None:
            sums = self.no_sums(inputs.hand.shape[0], inputs.hand.dtype)
        hand_sum, world_sum = sums
        return AdjointInputs(
            inputs.hand,
            inputs.world,
            inputs.arm,
            inputs.pressure,
            path,
            bars.finger,
            bars.world,
            hand_sum,
            world_sum,
            bars.trace,
            bars.path,
            inputs.grid,
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
        hand_bar, world_bar, finger_bar, state_bar, arm_bar, pressure_bar = out[:6]
        scratch, finger_state, world_state = out[6:]
        arm = given.arm
        pressure = given.pressure
        block = Block(self.fingers, self.block)
        lane_world = block.world
        none = jnp.zeros((self.size,), scratch.dtype)
        bars = CotangentTables(self, block, (hand_bar, world_bar, finger_bar, state_bar), scratch)
        tables = given.hand, given.world, finger_state, world_state, scratch, given.grid
        step = ReverseStep(self, block, tables, bars)
        copy_rows((0, self.hand.rows), lambda k: given.hand_sum[(k,)], hand_bar)
        copy_rows((0, self.world_bars.rows), lambda k: given.world_sum[(k,)], world_bar)
        copy_rows((0, self.finger_state.rows), lambda k: given.finger_bar[(0, k)], finger_bar)
        copy_rows(
            (0, self.world_state.rows),
            lambda k: given.world_bar[0, k, lane_world],
            state_bar,
            lane_world,
        )
        count = given.path.taken[0, 0, lane_world]
        last = jnp.minimum(jnp.max(count.astype(jnp.int32)), steps - 1)

        def quiet(t: jax.Array, x: jax.Array) -> jax.Array:
            for k in range(6):
                arm_bar[t, k, lane_world] = none
            pressure_bar[(t, slice(None))] = none
            return x

        def reverse(back: jax.Array, x: jax.Array) -> jax.Array:
            t = last - back
            moved = t.astype(count.dtype) < count
            self._load(t, steps, moved, given.path, (finger_state, world_state), lane_world)
            commands = [jnp.where(moved, arm[t, k, lane_world], 0.0) for k in range(6)]
            chamber = jnp.where(moved, pressure[(t,)], 0.0)
            trace = given.trace_bar
            shown = TraceCotangents(*(trace[t, k, lane_world] for k in range(3)))
            arms = step.reverse(
                lanes(commands, (6,), wide=False), lanes([chamber], (), wide=True), moved, shown
            )
            for k in range(6):
                arm_bar[t, k, lane_world] = jnp.where(moved, arms[k].lane, 0.0)
            pressure_bar[(t, slice(None))] = jnp.where(moved, bars.of_step("pressure").lane, 0.0)
            if given.path_bar:
                fingers, worlds = given.path_bar
                angles, places = self.path_rows(states=False)
                copy_rows((0, angles), lambda k: finger_bar[(k,)] + fingers[(t, k)], finger_bar)
                rows = lambda k: state_bar[k, lane_world] + worlds[t, k, lane_world]  # noqa: E731
                copy_rows((0, places), rows, state_bar, lane_world)
            return x

        jax.lax.fori_loop(last + 1, steps, quiet, jnp.int32(0))
        jax.lax.fori_loop(0, last + 1, reverse, jnp.int32(0))

    def _load(
        self, t: Any, steps: int, moved: Any, path: StatePath, target: tuple, lane_world: Any
    ) -> None:
        """Loads the state before a step, with the step's accelerations.

        A row of the path has the acceleration of the step before it, the solver's warm start. Where
        a world took no step they are of no use, and need not be numbers.
        """
        fingers, worlds, finger_end, world_end, _ = path
        after = jnp.minimum(t + 1, steps - 1)
        more = t + 1 < steps
        first = (
            self.finger_state.offset[FingerState.acc],
            self.world_state.offset[WorldState.acc_wrist],
        )
        ends = self.finger_state.rows, self.world_state.rows

        def of_finger(k: jax.Array) -> jax.Array:
            acc = jnp.where(more, fingers[(after, k)], finger_end[(0, k)])
            return jnp.where(moved, acc, 0.0)

        def of_world(k: jax.Array) -> jax.Array:
            acc = jnp.where(more, worlds[after, k, lane_world], world_end[0, k, lane_world])
            return jnp.where(moved, acc, 0.0)

        copy_rows((0, first[0]), lambda k: fingers[(t, k)], target[0])
        copy_rows((0, first[1]), lambda k: worlds[t, k, lane_world], target[1], lane_world)
        copy_rows((first[0], ends[0]), of_finger, target[0])
        copy_rows((first[1], ends[1]), of_world, target[1], lane_world)
