"""The reverse-mode derivative of a whole rollout as one kernel.

It goes through the recorded steps backwards, with the forward kernel's own functions and tables,
and leaves the cotangents of the forward kernel's arguments.  A block begins at the last step that
any of its worlds took.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from codesign_jax.compiler import cache
from codesign_jax.compiler.launch import Kernel, kernel_jaxpr, launch
from codesign_jax.engines.structured.kernel.bars import STEP, Bars
from codesign_jax.engines.structured.kernel.memory import Block, MemoryLayout
from codesign_jax.engines.structured.kernel.pairs import PairSet
from codesign_jax.engines.structured.kernel.powers import Place
from codesign_jax.engines.structured.kernel.program import PACKAGE, UNRELATED, Program, block_spec
from codesign_jax.engines.structured.kernel.reverse import ReverseStep, Shown
from codesign_jax.engines.structured.kernel.sweep import SHAPES
from codesign_jax.engines.structured.lanewise import lanes


class Recorded(NamedTuple):
    """What the reverse pass reads of the steps, as tables of blocks.

    Attributes:
      finger: Rows of the fingers' state before each step, with the step's accelerations, shape
        (block, time, row, lane).
      world: Rows of wrist and object alike, shape (block, time, row, world).
      taken: Number of steps that each world took, shape (block, 1, world).
    """

    finger: jax.Array
    world: jax.Array
    taken: jax.Array


class Cotangents(NamedTuple):
    """Cotangents of what the forward kernel returns, as tables of blocks.

    Attributes:
      finger: Of the fingers' state at the end, shape (block, row, lane).
      world: Of wrist and object at the end, shape (block, row, world).
      trace: Of distance, height and speed, shape (block, time, 3, world).
      path: Of the recorded rows of positions, of fingers and of wrist and object; none without a
        trajectory.
    """

    finger: jax.Array
    world: jax.Array
    trace: jax.Array
    path: tuple[jax.Array, ...] = ()


class AdjointProgram(Program):
    """Tables and kernel of a rollout's derivative."""

    remembers = {"hull": ("vertex",), "pairs": ("owner", "sphere")}

    def _tables(self) -> None:
        super()._tables()
        n, a = self.links, self.axes
        more = {f"chain.{k}": (n + 1, shape) for k, shape in SHAPES._asdict().items()}
        more |= {"acc_bar": (n, (a,)), "virtual": (n, (a,))}
        more |= {f"bar.{k}": (1, shape) for k, shape in STEP.items()}
        if any(isinstance(s, PairSet) for s in self.sets):
            more |= {f"pairbar.{k}": (n + 1, getattr(SHAPES, k)) for k in Place._fields}
        self.scratch = MemoryLayout.by_item(True, **(self.scratch.groups | more))
        self.world_bars = MemoryLayout(True, **self.world.groups)

    def adjoint(self, inputs: tuple, recorded: Recorded, cotangents: Cotangents) -> tuple:
        """Cotangents of `Program.inputs`, of which the worlds' states and constants are sums.

        Args:
          inputs: As in `Program.execute`.
          recorded: The steps.
          cotangents: Cotangents of the results.
        """
        given = self._arguments(inputs, recorded, cotangents)
        call, outputs = self._adjoint_call(given)
        if self.backend == "interpreter":
            out = call(*given)
        else:
            code = cache.sources(PACKAGE, UNRELATED)
            origin = repr((self.scene.structure, "adjoint", code))
            shared = (len(given) - 1,) if self.meshes else ()
            out = launch(call, given, outputs, self._kernel_of(origin, shared))
        # Worlds that took no step, such as those that fill the last block, need not be numbers.
        lane = jnp.tile(recorded.taken > 0, (1, 1, self.fingers))
        masks = lane, lane, lane, recorded.taken > 0, recorded.taken[:, None] > 0, lane
        found = [jnp.where(mask, x, 0.0) for mask, x in zip(masks, out, strict=False)]
        # A number of a world has a cotangent on each of its fingers' lanes.
        found[1] = found[1].reshape(*found[1].shape[:2], self.fingers, self.block).sum(2)
        return (*found, jnp.zeros_like(inputs[-1])) if self.meshes else tuple(found)

    def adjoint_jaxpr(self, inputs: tuple, recorded: Recorded, cotangents: Cotangents) -> Any:
        """The jaxpr of a block of the kernel; arguments may be `jax.ShapeDtypeStruct`."""
        given = self._arguments(inputs, recorded, cotangents)
        return kernel_jaxpr(self._adjoint_call(given)[0], list(given))

    def _kernel_of(self, origin: str, shared: tuple[int, ...]) -> Kernel:
        return Kernel(origin, self.backend, self.size, shared, scratch=(6, 7, 8))

    def _arguments(self, inputs: tuple, recorded: Recorded, cotangents: Cotangents) -> tuple:
        hand, world, _, _, arm, pressure, *grid = inputs
        finger, world_state, trace, path = cotangents
        ends = finger, world_state, trace, *path
        return (hand, world, arm, pressure, *recorded, *ends, *grid)

    def _adjoint_call(self, given: tuple) -> tuple[Callable, list[jax.ShapeDtypeStruct]]:
        blocks, steps, dtype = given[0].shape[0], given[2].shape[1], given[2].dtype
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
        trajectory = len(given) - int(self.meshes) > 10
        outputs = [jax.ShapeDtypeStruct(s, dtype) for s in shapes]
        call = pl.pallas_call(
            partial(self._adjoint_kernel, steps, trajectory),
            grid=(blocks,),
            in_specs=[block_spec(x.shape, blocks) for x in given],
            out_specs=[block_spec(s, blocks) for s in shapes],
            out_shape=outputs,
            interpret=self.backend == "interpreter",
            name="grasp_adjoint",
        )
        return call, outputs

    def _adjoint_kernel(self, steps: int, trajectory: bool, *refs: Any) -> None:
        hand, world, arm, pressure, finger_path, world_path, taken, *rest = refs
        finger_end, world_end, trace, *rest = rest
        path = [rest.pop(0), rest.pop(0)] if trajectory else []
        grid = rest.pop(0) if self.meshes else None
        hand_bar, world_bar, finger_bar, state_bar, arm_bar, pressure_bar, *rest = rest
        scratch, finger_state, world_state = rest
        block = Block(self.fingers, self.block)
        own, none = block.world, jnp.zeros((self.size,), scratch.dtype)
        bars = Bars(self, block, (hand_bar, world_bar, finger_bar, state_bar), scratch)
        tables = hand, world, finger_state, world_state, scratch, grid
        step = ReverseStep(self, block, tables, bars)
        bars.clear()
        copy_rows(self.finger_state.rows, lambda k: finger_end[(k,)], finger_bar)
        copy_rows(self.world_state.rows, lambda k: world_end[k, own], state_bar, own)
        count = taken[0, own]
        last = jnp.minimum(jnp.max(count.astype(jnp.int32)), steps - 1)

        def quiet(t: jax.Array, x: jax.Array) -> jax.Array:
            for k in range(6):
                arm_bar[t, k, own] = none
            pressure_bar[(t, slice(None))] = none
            return x

        def reverse(back: jax.Array, x: jax.Array) -> jax.Array:
            t = last - back
            moved = t.astype(count.dtype) < count
            # Where a world stands still its accelerations are of no use, nor need they be numbers.
            first = self.finger_state.offset["acc"], self.world_state.offset["acc_wrist"]

            def of_finger(k: jax.Array) -> jax.Array:
                return jnp.where(moved | (k < first[0]), finger_path[(t, k)], 0.0)

            def of_world(k: jax.Array) -> jax.Array:
                return jnp.where(moved | (k < first[1]), world_path[t, k, own], 0.0)

            copy_rows(self.finger_state.rows, of_finger, finger_state)
            copy_rows(self.world_state.rows, of_world, world_state, own)
            commands = [jnp.where(moved, arm[t, k, own], 0.0) for k in range(6)]
            chamber = jnp.where(moved, pressure[(t,)], 0.0)
            shown = Shown(*(trace[t, k, own] for k in range(3)))
            arms = step.reverse(
                lanes(commands, (6,), wide=False), lanes([chamber], (), wide=True), moved, shown
            )
            for k in range(6):
                arm_bar[t, k, own] = jnp.where(moved, arms[k].lane, 0.0)
            pressure_bar[(t, slice(None))] = jnp.where(moved, bars.of_step("pressure").lane, 0.0)
            if path:
                angles, places = self.path_rows(states=False)
                copy_rows(angles, lambda k: finger_bar[(k,)] + path[0][(t, k)], finger_bar)
                rows = lambda k: state_bar[k, own] + path[1][t, k, own]  # noqa: E731
                copy_rows(places, rows, state_bar, own)
            return x

        jax.lax.fori_loop(last + 1, steps, quiet, jnp.int32(0))
        jax.lax.fori_loop(0, last + 1, reverse, jnp.int32(0))


def copy_rows(count: int, read: Callable, target: Any, *where: jax.Array) -> None:
    """Stores read(row) in the first rows of a table; where: the world of each lane, if it has."""

    def one(k: jax.Array, x: jax.Array) -> jax.Array:
        target[(k, *where)] = read(k)
        return x

    jax.lax.fori_loop(0, count, one, jnp.int32(0))
