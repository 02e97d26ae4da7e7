"""The whole rollout as one kernel: a block simulates a few worlds from start to end.

A lane is a finger of a world; a block is one warp of a GPU or one vector of a CPU.  Blocks are
independent: each does as many Newton iterations as its own worlds need, and stops when all of its
worlds are decided.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Self, TypeVar

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from codesign_jax import reuse
from codesign_jax.compiler.launch import Kernel, block_lanes, kernel_jaxpr, launch
from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.kernel import chambers, shared_memory
from codesign_jax.engines.structured.kernel.memory import Block, BoundTable, TimeStep, anywhere
from codesign_jax.engines.structured.kernel.memory_tables import Packing
from codesign_jax.engines.structured.kernel.rows import Record, WorldState
from codesign_jax.engines.structured.kernel.step import Step
from codesign_jax.engines.structured.lanewise import Lanes, lanes, of_code
from codesign_jax.engines.structured.laws.kinematics import State
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.judge import verdict
from codesign_jax.model import held
from codesign_jax.scene import Scene

Arrays = TypeVar("Arrays")

TRACE = ("distance", "height", "speed", "residual", "iterations", "moved")


WORLDS_THAT_WAIT = 2
"""Most worlds of a CPU's block whose fingers touch one another.

Worlds of a block wait for one another in every loop, most of all in those over contacts of fingers:
good designs are simulated 1.2 times as fast with two worlds a block as with the four that fill a
vector of 64 bytes, and 1.1 times as fast as with one.
"""


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


class PathPart(NamedTuple):
    """States that are stored, every so many steps: all rows, or those of positions."""

    finger: Any  # Rows of `rows.FingerState`, shape (block, time, row, lane)
    world: Any  # Rows of `rows.WorldState`, shape (block, time, row, world)


class Outputs(NamedTuple):
    """What the kernel writes of worlds, tables of blocks."""

    finger_state: Any  # `rows.FingerState` at the end, shape (block, row, lane)
    world_state: Any  # `rows.WorldState` at the end, shape (block, row, world)
    scratch: Any  # Memory of a step, which is not read; None after the call
    trace: Any  # `Program.trace`, shape (block, time, entry, world)
    path: tuple[PathPart, ...] = ()  # See `path_parts`
    recorded: Any = None  # Forces by `kernel.record`, shape (block, time, row, lane)
    onchip: Any = None  # Shared memory of a step, with teams only; None after the call


class Limits(NamedTuple):
    """How hard each step is solved."""

    # Largest number of Newton iterations; with none the accelerations stay those of the state
    iterations: int
    evaluations: int  # Largest number of line-search evaluations of an iteration
    tolerance: float  # Relative Newton decrement at which a world has converged


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
        places = numbered(outputs)
        memory: dict[str, Any] = {"scratch": (places.scratch,)}
        if self.record is not None:
            origin = f"{origin} {self.record}"
        if not self.limits.iterations:
            memory |= {"level": 1}  # what has no solver is as fast at LLVM's level 1
        if self.team > 1:
            origin = f"{origin} {self.team}"
            memory |= {"onchip": (places.onchip,), "exchanged": (places.scratch, places.onchip)}
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

    def inputs(self, hand: WorldModel, state: State, ctrl: jax.Array) -> Inputs:
        """The kernel's arguments, of constants, start states and controls (world, time, nu)."""
        if self.scene.effects.air_mass:
            ctrl = chambers.charged(self.scene, hand, ctrl)
        return self.joined(self.pack_hand(hand), hand, state, ctrl)

    def joined(
        self, tables: tuple[jax.Array, ...], hand: WorldModel, state: State, ctrl: jax.Array
    ) -> Inputs:
        """`inputs` of the hands' tables, see `Packing.pack_hand`."""
        grid = None if hand.mesh is None else hand.mesh.values[None]
        hand_table, world_table = tables
        finger_start, world_start = self.pack_state(state)
        arm, pressure = self.pack_controls(ctrl)
        return Inputs(hand_table, world_table, finger_start, world_start, arm, pressure, grid)

    def _call(self, inputs: Inputs, trajectory: bool, states: int) -> tuple[Callable, Outputs]:
        """The kernel of inputs as a function of their arrays, and its outputs."""
        blocks, steps = inputs.arm.shape[:2]

        def shape(*sizes: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((blocks, *sizes), inputs.arm.dtype)

        path = []
        for stride, whole in path_parts(trajectory, states):
            angles, places = self.path_rows(whole)
            count = -(-steps // stride)
            path.append(
                PathPart(shape(count, angles, self.columns), shape(count, places, self.block))
            )
        some = self.record is not None and self.recorded.rows > 0
        recorded = shape(steps, self.recorded.rows, self.columns) if some else None
        outputs = Outputs(
            shape(self.finger_state.rows, self.columns),
            shape(self.world_state.rows, self.block),
            shape(self.scratch.rows, self.columns),
            shape(steps, len(self.trace), self.block),
            tuple(path),
            recorded,
            shape(self.onchip.rows, self.columns) if self.team > 1 else None,
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
        rollout = BlockRollout(self, inputs, outputs, path_parts(to_end, states))
        rollout.start()
        done = rollout.run(steps, to_end=to_end)
        rollout.repeat_last(done, steps)


def numbered(record: Arrays) -> Arrays:
    """A record with the places of its arrays among all of them."""
    leaves, structure = jax.tree.flatten(record)
    return structure.unflatten(range(len(leaves)))


class BlockRollout:
    """The rollout of a block of worlds in the kernel of a program."""

    def __init__(
        self, program: Program, inputs: Inputs, outputs: Outputs, parts: list[tuple[int, bool]]
    ):
        """Takes the references to inputs and outputs; `parts` as `path_parts` returns them."""
        block = Block(program.fingers, program.block, program.team)
        if program.team > 1:
            inputs, outputs = _with_shared_columns(block, inputs, outputs)
        self.program = program
        self.path_parts = parts
        state = outputs.finger_state, outputs.world_state
        memory = outputs.scratch, inputs.grid, outputs.onchip
        self.step = Step(program, block, inputs.hand, inputs.world, *state, *memory)
        self.world = block.world
        self.start_state = inputs.finger_start, inputs.world_start
        self.state = state
        self.commands = inputs.arm, inputs.pressure
        self.trace = outputs.trace
        self.path = outputs.path
        self.recorded = outputs.recorded

    def start(self) -> None:
        """Copies the start state to the state."""
        finger_start, world_start = self.start_state
        fingers, worlds = self.state
        world = self.world
        rows = self.program.finger_state.rows, self.program.world_state.rows
        copy_rows((0, rows[0]), lambda k: finger_start[(k,)], fingers)
        copy_rows((0, rows[1]), lambda k: world_start[k, world], worlds, world)

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
            command = self._command(t)
            limits = self.program.limits
            given = undecided, going > 0, fastest, limits, t == 0, self._recorded(t)
            entry, new_speed, moved = step.advance(*command, *given)
            going = jnp.where(moved, going, 0.0)
            for k, value in enumerate((*entry[:2], fastest, *entry[2:4], going, *entry[4:])):
                self.trace[t, k, self.world] = value
            self._keep(step=now + 1.0, going=going, speed=new_speed)
            return t + 1, going

        def goes_on(carry: tuple) -> jax.Array:
            # The first step also tells where worlds are that were decided before.
            return (carry[0] < steps) & (anywhere(carry[1] > 0) | (carry[0] == 0))

        return jax.lax.while_loop(goes_on, body, (jnp.int32(0), self._number(WorldState.going)))[0]

    def repeat_last(self, done: jax.Array, steps: int) -> None:
        """Repeats the trace's last entries from step `done` on.

        They are those of decided worlds of a block that goes on: no residual, and their speed.
        """
        last_speed = self._number(WorldState.speed)
        none = jnp.zeros_like(last_speed)
        ended = {"speed": last_speed, "residual": none, "overflow": none}
        world = self.world
        trace = self.trace

        def repeat(t: jax.Array, x: jax.Array) -> jax.Array:
            self._store_path(t)
            for k, name in enumerate(self.program.trace):
                trace[t, k, world] = ended.get(name, trace[done - 1, k, world])
            self._keep(step=self._number(WorldState.step) + 1.0)
            return x

        jax.lax.fori_loop(done, steps, repeat, jnp.int32(0))

    def _command(self, t: jax.Array) -> tuple[Lanes, Lanes]:
        """Commands of the arm frame and pressures of the chambers at a step."""
        arm, pressure = self.commands
        pose = lanes([arm[t, k, self.world] for k in range(6)], (6,), wide=False)
        return pose, lanes([pressure[t]], (), wide=True)

    def _recorded(self, t: jax.Array) -> BoundTable | None:
        """Where a step's forces are recorded."""
        if self.recorded is None:
            return None
        return BoundTable(self.program.recorded, TimeStep(self.recorded, t))

    def _number(self, name: str) -> jax.Array:
        return self.step.world_state.read(name).lane

    def _keep(self, **numbers: jax.Array) -> None:
        for name, value in numbers.items():
            self.step.world_state.write(name, lanes([value], (), wide=False))

    def _store_path(self, t: jax.Array) -> None:
        """Stores the state before step t where it is part of the path."""
        for k, (stride, whole) in enumerate(self.path_parts):
            target = self.path[k]
            if stride == 1:
                self._store_state(t, whole, *target)
            else:
                every = jnp.int32(stride)
                put = partial(self._store_state, jax.lax.div(t, every), whole, *target)
                jax.lax.cond(jax.lax.rem(t, every) == 0, put, lambda: None)

    def _store_state(self, place: jax.Array, whole: bool, fingers: Any, worlds: Any) -> None:
        """Stores the whole state, or its positions, at a place of the path."""
        finger_state, world_state = self.state
        world = self.world
        angles, places = self.program.path_rows(whole)
        copy_rows((0, angles), lambda k: finger_state[(k,)], fingers, at=(place,))
        copy_rows((0, places), lambda k: world_state[k, world], worlds, world, at=(place,))


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


def path_parts(trajectory: bool, states: int) -> list[tuple[int, bool]]:
    """What the kernel stores: every how many steps, and whether whole states or positions."""
    parts = [(1, states == 1)] if trajectory or states == 1 else []
    return parts + ([(states, True)] if states > 1 else [])


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


def copy_rows(rows: tuple[Any, Any], read: Callable, target: Any, *where: Any, at: tuple = ()):
    """Stores read(row) in rows of a table; what is before and behind the row in the index."""

    def copy(k: jax.Array, x: jax.Array) -> jax.Array:
        target[(*at, k, *where)] = read(k)
        return x

    jax.lax.fori_loop(*rows, copy, jnp.int32(0))
