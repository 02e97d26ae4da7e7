"""The reverse-mode derivative of a whole rollout as one kernel.

It goes through the stored path backwards, with the forward kernel's own functions and tables, and
leaves the cotangents of the forward kernel's arguments.  A block begins at the last step that
any of its worlds took.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from codesign_jax import reuse
from codesign_jax.compiler.launch import Kernel, launch
from codesign_jax.engines.structured.kernel.adjoint_step import ReverseStep, TraceCotangents
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables, of_step
from codesign_jax.engines.structured.kernel.memory import Block, MemoryLayout
from codesign_jax.engines.structured.kernel.program import Program, copy_rows
from codesign_jax.engines.structured.kernel.residual import Before, BodyMotion
from codesign_jax.engines.structured.kernel.residual_vjp import SHAPES
from codesign_jax.engines.structured.kernel.self_contacts import SelfContactSet
from codesign_jax.engines.structured.lanewise import lanes, of_code


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


def state_path(out: Any, taken: jax.Array) -> StatePath:
    """What `Program.execute` has stored in blocks; `taken` as in `StatePath`, of blocks."""
    finger_end = out[0][:, None]
    world_end = out[1][:, None]
    return StatePath(out[-2], out[-1], finger_end, world_end, taken)


class Cotangents(NamedTuple):
    """Cotangents of a rollout's results, laid out as `StatePath`."""

    finger: jax.Array  # Of the fingers' state at the end, shape (world, 1, row, finger)
    world: jax.Array  # Of wrist and object at the end, shape (world, 1, row, 1)
    trace: jax.Array  # Of distance, height and speed, shape (world, time, 3, 1)
    # Of the positions at every step, (world, time, row, finger) and (world, time, row, 1); none
    # without a trajectory
    path: tuple[jax.Array, ...] = ()


class AdjointProgram(Program):
    """Tables and kernel of a rollout's derivative."""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **{**options, "team": 1})

    remembers = ("owner", "ring")

    def _tables(self) -> None:
        super()._tables()
        n = self.links
        a = self.axes
        more = {f"chain.{k}": (n + 1, shape) for k, shape in SHAPES._asdict().items()}
        more |= {f"before.{k}": (n, getattr(SHAPES, k)) for k in Before._fields}
        more |= {"acc_bar": (n, (a,)), "virtual": (n, (a,))}
        if pairings := self.held.get("finger_finger"):
            more |= {"sums_bar": (pairings, (4,))}
        more |= {f"{s.name}.held_bar": (s.count, (3, s.k)) for s in self.sets if s.holds}
        more |= {f"bar.{k}": (1, shape) for k, shape in of_step(self.scene).items()}
        if any(isinstance(s, SelfContactSet) for s in self.sets):
            more |= {f"pairbar.{k}": (n + 1, getattr(SHAPES, k)) for k in BodyMotion._fields}
        if self.scene.effects.finger_palm:
            more |= {f"palmbar.{k}": (1, getattr(SHAPES, k)) for k in BodyMotion._fields}
        self.scratch = MemoryLayout.by_item(True, **(self.scratch.groups | more))
        self.world_bars = MemoryLayout(True, **self.world.groups)

    def adjoint(
        self, inputs: tuple, path: StatePath, bars: Cotangents, sums: tuple | None = None
    ) -> tuple:
        """Cotangents of `Program.inputs`; where a world took no step they need not be numbers.

        Those of the worlds' constants are for each of their fingers, see `summed`; `sums` is what
        is added to those of the constants, see `no_sums`.
        """
        given = self._arguments(inputs, path, bars, sums)
        call, outputs = self._adjoint_call(given)
        if self.backend == "interpreter":
            cotangents = call(*given)[:6]
        else:
            of_code(reuse.code_digest())
            origin = repr((self.scene.structure, "adjoint"))
            shared = (len(given) - 1,) if self.meshes else ()
            # At LLVM's level 1 it is as fast, with the same bits, after two thirds of LLVM's time.
            kernel = Kernel(origin, self.backend, self.size, shared, scratch=(6, 7, 8), level=1)
            cotangents = launch(call, given, outputs, kernel)[:6]
        grid = (jnp.zeros_like(inputs[-1]),) if self.meshes else ()
        return (*cast("list[jax.Array]", cotangents), *grid)

    def no_sums(self, blocks: int, dtype: Any) -> tuple:
        """Cotangents of the constants before the last step: those of the hand, and the worlds'."""
        rows = self.hand.rows, self.world_bars.rows
        return tuple(jnp.zeros((blocks, n, self.size), dtype) for n in rows)

    def summed(self, world: jax.Array) -> jax.Array:
        """Cotangents of the worlds' constants, of those on each of the fingers' lanes."""
        return world.reshape(*world.shape[:2], self.fingers, self.block).sum(2)

    def sound(self, bars: tuple, taken: jax.Array) -> tuple:
        """Cotangents of the inputs, zero where a world took no step and they are no numbers."""
        some = taken[:, 0] > 0
        lane = jnp.tile(some, (1, 1, self.fingers))
        masks = lane, some, lane, some, some[:, None], lane
        pairs = zip(masks, bars, strict=False)
        cleared = [jnp.where(mask | jnp.isfinite(x), x, 0.0) for mask, x in pairs]
        return (*cleared, *bars[6:])

    def _arguments(
        self, inputs: tuple, path: StatePath, bars: Cotangents, sums: tuple | None = None
    ) -> tuple:
        hand, world, _, _, arm, pressure, *grid = inputs
        if sums is None:
            sums = self.no_sums(hand.shape[0], hand.dtype)
        ends = bars.finger, bars.world, *sums, bars.trace, *bars.path
        return (hand, world, arm, pressure, *path, *ends, *grid)

    def _adjoint_call(self, given: tuple) -> tuple[Callable, list[jax.ShapeDtypeStruct]]:
        blocks = given[0].shape[0]
        steps = given[2].shape[1]
        dtype = given[2].dtype
        shapes = [
            (blocks, self.hand.rows, self.size),
            (blocks, self.world_bars.rows, self.size),
            (blocks, self.finger_state.rows, self.size),
            (blocks, self.world_state.rows, self.block),
            (blocks, steps, 6, self.block),
            (blocks, steps, self.size),
            # Scratch memory: that of a step, and the state before it.
            (blocks, self.scratch.rows, self.size),
            (blocks, self.finger_state.rows, self.size),
            (blocks, self.world_state.rows, self.block),
        ]
        trajectory = len(given) - int(self.meshes) > 14
        kernel = partial(self._adjoint_kernel, steps, trajectory)
        return self.call(kernel, "grasp_adjoint", given, shapes, dtype)

    def _adjoint_kernel(self, steps: int, trajectory: bool, *refs: Any) -> None:
        hand, world, arm, pressure, *rest = refs
        *states, taken, finger_seed, world_seed, hand_sum, world_sum, trace = rest[:10]
        rest = rest[10:]
        path = [rest.pop(0), rest.pop(0)] if trajectory else []
        grid = rest.pop(0) if self.meshes else None
        hand_bar, world_bar, finger_bar, state_bar, arm_bar, pressure_bar, *rest = rest
        scratch, finger_state, world_state = rest
        block = Block(self.fingers, self.block)
        lane_world = block.world
        none = jnp.zeros((self.size,), scratch.dtype)
        bars = CotangentTables(self, block, (hand_bar, world_bar, finger_bar, state_bar), scratch)
        tables = hand, world, finger_state, world_state, scratch, grid
        step = ReverseStep(self, block, tables, bars)
        copy_rows((0, self.hand.rows), lambda k: hand_sum[(k,)], hand_bar)
        copy_rows((0, self.world_bars.rows), lambda k: world_sum[(k,)], world_bar)
        copy_rows((0, self.finger_state.rows), lambda k: finger_seed[(0, k)], finger_bar)
        copy_rows(
            (0, self.world_state.rows),
            lambda k: world_seed[0, k, lane_world],
            state_bar,
            lane_world,
        )
        count = taken[0, 0, lane_world]
        last = jnp.minimum(jnp.max(count.astype(jnp.int32)), steps - 1)

        def quiet(t: jax.Array, x: jax.Array) -> jax.Array:
            for k in range(6):
                arm_bar[t, k, lane_world] = none
            pressure_bar[(t, slice(None))] = none
            return x

        def reverse(back: jax.Array, x: jax.Array) -> jax.Array:
            t = last - back
            moved = t.astype(count.dtype) < count
            self._load(t, steps, moved, states, (finger_state, world_state), lane_world)
            commands = [jnp.where(moved, arm[t, k, lane_world], 0.0) for k in range(6)]
            chamber = jnp.where(moved, pressure[(t,)], 0.0)
            shown = TraceCotangents(*(trace[t, k, lane_world] for k in range(3)))
            arms = step.reverse(
                lanes(commands, (6,), wide=False), lanes([chamber], (), wide=True), moved, shown
            )
            for k in range(6):
                arm_bar[t, k, lane_world] = jnp.where(moved, arms[k].lane, 0.0)
            pressure_bar[(t, slice(None))] = jnp.where(moved, bars.of_step("pressure").lane, 0.0)
            if path:
                angles, places = self.path_rows(states=False)
                copy_rows((0, angles), lambda k: finger_bar[(k,)] + path[0][(t, k)], finger_bar)
                rows = lambda k: state_bar[k, lane_world] + path[1][t, k, lane_world]  # noqa: E731
                copy_rows((0, places), rows, state_bar, lane_world)
            return x

        jax.lax.fori_loop(last + 1, steps, quiet, jnp.int32(0))
        jax.lax.fori_loop(0, last + 1, reverse, jnp.int32(0))

    def _load(
        self, t: Any, steps: int, moved: Any, states: list, target: tuple, lane_world: Any
    ) -> None:
        """Loads the state before a step, with the step's accelerations.

        A row of the path has the acceleration of the step before it, the solver's warm start. Where
        a world took no step they are of no use, and need not be numbers.
        """
        fingers, worlds, finger_end, world_end = states
        after = jnp.minimum(t + 1, steps - 1)
        more = t + 1 < steps
        first = self.finger_state.offset["acc"], self.world_state.offset["acc_wrist"]
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
