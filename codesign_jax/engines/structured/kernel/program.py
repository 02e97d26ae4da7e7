"""The whole rollout as one kernel: a block simulates a few worlds from start to end.

A lane is a finger of a world; a block is one warp of a GPU or one vector of a CPU.  Blocks are
independent: each does as many Newton iterations as its own worlds need, and stops when all of its
worlds are decided.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Self, TypeVar

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from codesign_jax import reuse
from codesign_jax.compiler.launch import Kernel, block_lanes, kernel_jaxpr, launch
from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.kernel import chambers
from codesign_jax.engines.structured.kernel.newton import Limits
from codesign_jax.engines.structured.kernel.packing import Packing
from codesign_jax.engines.structured.kernel.rollout import (
    BlockRollout,
    Inputs,
    Outputs,
    PathRows,
    path_parts,
)
from codesign_jax.engines.structured.kernel.rows import Record
from codesign_jax.engines.structured.lanewise import of_code
from codesign_jax.engines.structured.laws.kinematics import State
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.model import held
from codesign_jax.scene import Scene

Arrays = TypeVar("Arrays")

TRACE = ("distance", "height", "speed", "decrement", "iterations", "moved")
"""Entries of the trace of a kernel; scenes with slots have "overflow" behind them."""


WORLDS_THAT_WAIT = 2
"""Most worlds of a CPU's block whose fingers touch one another.

Worlds of a block wait for one another in every loop, most of all in those over contacts of fingers:
good designs are simulated 1.2 times as fast with two worlds a block as with the four that fill a
vector of 64 bytes, and 1.1 times as fast as with one.
"""


class Program(Packing):
    """Tables and kernel of a scene's rollout for one size of block."""

    def __init__(
        self,
        scene: Scene,
        limits: Limits,
        *,
        backend: str = "gpu",
        width: int = 32,
        team: int | None = None,
        record: Record | None = None,
    ):
        """Lays out the memory.

        Args:
          scene: The scene.
          limits: How hard each step is solved.
          backend: "gpu", "cpu", or "interpreter", which is Pallas' own and slow.
          width: Lanes of a block, a power of two; more if a world has more fingers. By default
            those of a warp.
          team: Lanes that share the work of a finger, 1 or `shared_memory.TEAM`; by default what
            the scene and the backend make faster. Sums depend on it, and so do last bits.
          record: What rollouts record of the contacts' forces, None for nothing.
        """
        super().__init__(scene, backend=backend, width=width, team=team, record=record)
        self.limits = limits
        self.trace = (*TRACE, "overflow") if self.has_slots else TRACE

    @classmethod
    def here(
        cls, scene: Scene, limits: Limits, dtype: Any, worlds: int | None = None, **options: Any
    ) -> Self:
        """The program for this device, type and number of worlds, see `lanes_here`."""
        width = lanes_here(scene, dtype, worlds)
        return cls(scene, limits, backend=jax.default_backend(), width=width, **options)

    def run(self, hand: WorldModel, state: State, ctrl: jax.Array) -> dict[str, jax.Array]:
        """Runs a rollout; returns `trace` by name, shape (world, time)."""
        return self.simulate(hand, state, ctrl)[0]

    def simulate(
        self,
        hand: WorldModel,
        state: State,
        ctrl: jax.Array,
        *,
        trajectory: bool = False,
        states: bool = False,
    ) -> tuple[dict[str, jax.Array], State]:
        """Runs a rollout.

        Args:
          hand: Constants of the worlds.
          state: Their start states.
          ctrl: Controls, shape (world, time, nu).
          trajectory: Whether to store qpos, and to simulate worlds that lost their object to the
            end.
          states: Whether to store qpos, qvel, the accelerations of every step, and the friction
            that contacts hold before it.

        Returns:
          `trace` by name, shape (world, time), with "qpos", "qvel" and "acc", shape (world, time,
          nq or nv), of what is stored; and the last states.
        """
        inputs = self.inputs(hand, state, ctrl)
        out = self.execute(inputs, trajectory=trajectory, states=states)
        return self.outputs(out, ctrl.shape[0], trajectory=trajectory, states=states)

    def execute(self, inputs: Inputs, *, trajectory: bool = False, states: int = 0) -> Outputs:
        """Runs the blocks, which do not depend on each other; None in the place of scratch memory.

        States are steps from one stored state to the next, beginning with the first; 0 for none.
        """
        # Controls come as arrays: key frames are no part of the kernel.
        structure = replace(self.scene.structure, control=None)  # type: ignore[arg-type]
        origin = repr((structure, self.limits, trajectory, states))
        call, outputs = self._call(inputs, trajectory, states)
        index = leaf_indices(outputs)
        memory: dict[str, Any] = {"scratch": (index.scratch,)}
        if self.record is not None:
            origin = f"{origin} {self.record}"
        if not self.limits.iterations:
            memory |= {"level": 1}  # what has no solver is as fast at LLVM's level 1
        if self.team > 1:
            origin = f"{origin} {self.team}"
            memory |= {"onchip": (index.onchip,), "exchanged": (index.scratch, index.onchip)}
        return self.launch(call, inputs, outputs, origin, **memory)

    def outputs(
        self, out: Outputs, worlds: int, *, trajectory: bool = False, states: bool = False
    ) -> tuple[dict[str, jax.Array], State]:
        """What `simulate` returns, from what the blocks of so many worlds wrote."""
        # (block, world, time, entry)
        trace = jnp.moveaxis(out.trace, 3, 1)
        trace = trace.reshape(-1, trace.shape[2], len(self.trace))[:worlds]
        series = {name: trace[..., k] for k, name in enumerate(self.trace)}
        if trajectory or states:
            path = self.path(*out.path[0], states=states)
            series |= {k: v[:worlds] for k, v in path.items()}
        last = self.unpack_state(out.finger_state, out.world_state, worlds)
        if states:
            # A row holds the acceleration of the step before it, the solver's warm start.
            end = coordinates.flat_acc(last.acc)[:, None]
            series["acc"] = jnp.concatenate([series["acc"][:, 1:], end], 1)
        return series, last

    def jaxpr(self, hand: WorldModel, state: State, ctrl: jax.Array) -> Any:
        """The jaxpr of a block of a rollout's kernel; arguments may be `jax.ShapeDtypeStruct`."""
        inputs = jax.eval_shape(self.inputs, hand, state, ctrl)
        return kernel_jaxpr(self._call(inputs, False, False)[0], jax.tree.leaves(inputs))

    def inputs(
        self,
        hand: WorldModel,
        state: State,
        ctrl: jax.Array,
        tables: tuple[jax.Array, ...] = (),
    ) -> Inputs:
        """The kernel's arguments.

        Args:
          hand: Constants of the worlds.
          state: Their start states.
          ctrl: Controls, shape (world, time, nu).
          tables: The hands' tables, where they are at hand; see `Packing.pack_hand`.
        """
        if self.scene.effects.air_mass:
            ctrl = chambers.charged(self.scene, hand, ctrl)
        hand_table, world_table = tables or self.pack_hand(hand)
        finger_start, world_start = self.pack_state(state)
        arm, pressure = self.pack_controls(ctrl)
        return Inputs(
            hand=hand_table,
            world=world_table,
            finger_start=finger_start,
            world_start=world_start,
            arm=arm,
            pressure=pressure,
            grid=None if hand.mesh is None else hand.mesh.values[None],
        )

    def _call(self, inputs: Inputs, trajectory: bool, states: int) -> tuple[Callable, Outputs]:
        """The kernel of inputs as a function of their arrays, and its outputs."""
        blocks, steps = inputs.arm.shape[:2]

        def shape(*sizes: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((blocks, *sizes), inputs.arm.dtype)

        path = []
        for part in path_parts(trajectory, states):
            of_finger, of_world = self.path_rows(part.whole)
            count = -(-steps // part.stride)
            finger = shape(count, of_finger, self.columns)
            path.append(PathRows(finger, shape(count, of_world, self.block)))
        some = self.record is not None and self.recorded.rows > 0
        recorded = shape(steps, self.recorded.rows, self.columns) if some else None
        outputs = Outputs(
            finger_state=shape(self.finger_state.rows, self.columns),
            world_state=shape(self.world_state.rows, self.block),
            scratch=shape(self.scratch.rows, self.columns),
            trace=shape(steps, len(self.trace), self.block),
            path=tuple(path),
            recorded=recorded,
            onchip=shape(self.onchip.rows, self.columns) if self.team > 1 else None,
        )
        kernel = partial(self._kernel, steps, trajectory, states)
        return self.call(kernel, "grasp", inputs, outputs), outputs

    def call(self, kernel: Callable, name: str, inputs: Any, outputs: Any) -> Callable:
        """A kernel as a function of the arrays of its inputs.

        Args:
          kernel: Function of references to inputs and outputs, records of the same structure.
          name: The kernel's.
          inputs: Record of arrays, or of their shapes.
          outputs: Record of shapes of the results.
        """
        given, taken = jax.tree.structure(inputs), jax.tree.structure(outputs)
        shapes = jax.tree.leaves(outputs)
        blocks = shapes[0].shape[0]

        def run(*refs: Any) -> None:
            split = given.num_leaves
            kernel(given.unflatten(refs[:split]), taken.unflatten(refs[split:]))

        return pl.pallas_call(
            run,
            grid=(blocks,),
            in_specs=[block_spec(x.shape, blocks) for x in jax.tree.leaves(inputs)],
            out_specs=[block_spec(x.shape, blocks) for x in shapes],
            out_shape=shapes,
            interpret=self.backend == "interpreter",
            name=name,
        )

    def launch(
        self, call: Callable, inputs: Any, outputs: Arrays, origin: str, **options: Any
    ) -> Arrays:
        """Runs what `call` returns; results are a record as the outputs.

        Args:
          call: What `call` has made of the inputs.
          inputs: Record of arrays, of which the last one is that of meshes if the scene has any.
          outputs: Record of shapes of the results.
          origin: What the kernel is made of, see `launch.Kernel`.
          **options: Other fields of `launch.Kernel`.
        """
        arrays = jax.tree.leaves(inputs)
        shapes, structure = jax.tree.flatten(outputs)
        if self.backend == "interpreter":
            return structure.unflatten(call(*arrays))
        of_code(reuse.code_digest())
        shared = (len(arrays) - 1,) if self.meshes else ()
        kernel = Kernel(origin, self.backend, self.size, shared, **options)
        return structure.unflatten(launch(call, tuple(arrays), shapes, kernel))

    def _kernel(
        self, steps: int, to_end: bool, states: int, inputs: Inputs, outputs: Outputs
    ) -> None:
        parts = path_parts(to_end, states)
        rollout = BlockRollout(self, self.limits, self.trace, inputs, outputs, parts)
        rollout.start()
        done = rollout.run(steps, to_end=to_end)
        rollout.repeat_last(done, steps)


def leaf_indices(record: Arrays) -> Arrays:
    """A record with the index of each of its arrays among all of them."""
    leaves, structure = jax.tree.flatten(record)
    return structure.unflatten(range(len(leaves)))


def block_spec(shape: tuple[int, ...], blocks: int) -> pl.BlockSpec:
    """A block's part of an array with a leading axis of blocks, or of one that all share."""
    by_block = shape[0] == blocks
    return pl.BlockSpec((None, *shape[1:]), lambda i: (i * by_block, *[0] * (len(shape) - 1)))


def lanes_here(scene: Scene, dtype: Any, worlds: int | None = None) -> int:
    """Lanes of a block on this device for so many worlds, if it is known; `launch.block_lanes`."""
    fingers = held.lanes(scene)
    total = None if worlds is None else worlds * fingers
    platform = jax.default_backend()
    lanes = block_lanes(platform, dtype, total)
    if platform == "cpu" and scene.effects.finger_finger:
        return min(lanes, WORLDS_THAT_WAIT * fingers)
    return lanes
