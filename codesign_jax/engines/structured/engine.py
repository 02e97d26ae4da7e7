"""Step and rollout of the structured engine behind the common interface."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.compiler import launch
from codesign_jax.compiler.launch import KernelUnavailable
from codesign_jax.engines.base import Bodies, Equal
from codesign_jax.engines.structured import bodies, coordinates, forces, transforms
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.engines.structured.kernel.adjoint import StatePath, state_path
from codesign_jax.engines.structured.kernel.rollout import Inputs, Outputs
from codesign_jax.engines.structured.kernel.rows import Record
from codesign_jax.engines.structured.laws import meshes
from codesign_jax.engines.structured.laws.integration import before
from codesign_jax.engines.structured.laws.kinematics import State
from codesign_jax.engines.structured.world_model import WorldModel, world_constants
from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene, effects, mesh_margins
from codesign_jax.types import Forces, Status, Trace

FAR = 1e30
"""A bound that no number exceeds."""


class StructuredEngine(Equal):
    """Newton on MuJoCo's own problem by elimination along the fingers; cost linear in the links.

    One kernel runs a whole rollout, on a CPU or an NVIDIA GPU.
    """

    name = "structured"
    fills = True  # see `Engine`

    def __init__(
        self,
        scene: Scene,
        *,
        iterations: int | None = None,
        evaluations: int | None = None,
        tolerance: float | None = None,
        segment: int | None = None,
        truncate: bool = False,
    ):
        """Prepares the engine.

        Args:
          iterations: Largest number of Newton iterations a step instead of the scene's, see
            `scene.Newton`.
          evaluations: Largest number of line-search evaluations of an iteration.
          tolerance: Relative Newton decrement below which a world needs no further iteration.
          segment: Steps of a segment, for derivatives: only the states at the segments' starts are
            stored, and the steps between them simulated once more, with the same bits. By default
            the states of all steps are stored.
          truncate: Whether no cotangent of a state passes from a segment to the one before it.

        Raises:
          ValueError: If a segment has no step, or there is none to truncate.
          KernelUnavailable: If kernels cannot run on this device.
          InputError: If a mesh's distance cannot be put on a grid, or was read for a hand with
            smaller contact spheres.
        """
        effects.refuse(scene.effects, self.name)
        if (reason := launch.available(jax.default_backend())) is not None:
            raise _unavailable(reason)
        mesh_margins.refuse(scene.objects, mesh_margins.contact_radius(scene.hand))
        if segment is not None and segment < 1:
            raise ValueError(f"segment = {segment}: a segment has one time step at least")
        if truncate and segment is None:
            raise ValueError("truncate = True needs segment, the number of steps of a segment")
        meshes.tables(scene)
        self.scene = scene
        self.segment = segment
        self.truncate = truncate
        newton = scene.newton
        self.limits = Limits(
            newton.iterations if iterations is None else iterations,
            newton.evaluations if evaluations is None else evaluations,
            newton.decrement if tolerance is None else tolerance,
        )

    def _key(self) -> tuple:
        return self.scene.structure, self.limits, self.segment, self.truncate

    def reset(self, fields: ModelFields) -> State:
        """The states in which rollouts of model fields begin, leading axis (world,), in lanes."""
        return coordinates.reset(self.scene, fields)

    def state_at(
        self, state: State, qpos: jax.Array, qvel: jax.Array, acc: jax.Array | None = None
    ) -> State:
        """The state at other coordinates, at the beginning of a grasp; contacts hold no friction.

        Args:
          state: A state, for its accelerations.
          qpos: MuJoCo's positions, shape (world, nq).
          qvel: MuJoCo's velocities, shape (world, nv).
          acc: Accelerations, the solver's warm start, in the order of qvel, the object's as in
            `kinematics.Acc`, shape (world, nv); None for those of the state.
        """
        warm = coordinates.flat_acc(state.acc) if acc is None else acc
        return coordinates.make(self.scene, qpos, qvel, warm)

    def qpos(self, state: State) -> jax.Array:
        return coordinates.qpos(state)

    def qvel(self, state: State) -> jax.Array:
        return coordinates.qvel(state)

    def advance(
        self, hand: WorldModel, state: State, ctrl: jax.Array
    ) -> tuple[dict[str, jax.Array], State]:
        """Simulates from any state, whatever becomes of the worlds.

        Only worlds whose state is not a number, or with too few slots for their contacts, stay.

        Args:
          ctrl: Controls, shape (world, time, nu).

        Returns:
          As `Program.simulate` with states, and the states at the end.
        """
        far = jnp.full_like(hand.bounds.speed, FAR)
        hand = hand._replace(bounds=hand.bounds._replace(speed=far, penetration=far))
        program = Program.here(self.scene, self.limits, ctrl.dtype, len(ctrl))
        outputs = {"trajectory": True, "states": True}
        return program.outputs(
            _execute(program, program.inputs(hand, state, ctrl), **outputs), len(ctrl), **outputs
        )

    def rollout(
        self,
        fields: ModelFields,
        ctrl: jax.Array,
        *,
        trajectory: bool = False,
        tables: tuple[jax.Array, ...] = (),
    ) -> Trace:
        """See `Engine.rollout`; what JAX's transformations make of it stands in `transforms`.

        Args:
          tables: Those of the fields, see `tables`.
        """
        settings = transforms.Settings(self.scene, self.limits, self.segment, self.truncate)
        run = partial(transforms.rollout, self.simulate, self.simulate_with_path, settings)
        return run(fields, ctrl, tables, trajectory=trajectory)

    def tables(self, fields: ModelFields) -> tuple[jax.Array, ...]:
        """The kernel's tables of worlds, for rollouts that go on from one another.

        Nothing where a block has several worlds, on CPUs: each rollout lays them out itself.
        """
        if Program.here(self.scene, self.limits, fields.start.dtype, len(fields.start)).team == 1:
            return ()

        def tables(fields: ModelFields) -> tuple[jax.Array, ...]:
            count = len(fields.start)
            dtype = fields.start.dtype
            program = Program.here(self.scene, self.limits, dtype, count)
            return program.pack_hand(world_constants(self.scene, fields))

        return transforms.folded(tables)(jax.lax.stop_gradient(fields))

    def simulate(
        self,
        fields: ModelFields,
        ctrl: jax.Array,
        tables: tuple[jax.Array, ...] = (),
        *,
        trajectory: bool = False,
    ) -> Trace:
        """The rollout itself, in one kernel, without JAX's transformations.

        Args:
          fields: Model fields, leading axis (world,).
          ctrl: Controls, shape (world, time, nu).
          tables: The fields' tables of `tables`; none to lay them out here.
          trajectory: Whether the trace has qpos of every step, of whole grasps.

        Raises:
          KernelUnavailable: If the kernel cannot be compiled for this device, or called there.
        """
        program = Program.here(self.scene, self.limits, ctrl.dtype, len(ctrl))
        inputs = self._inputs(program, fields, ctrl, tables)
        out = _execute(program, inputs, trajectory=trajectory)
        return self._trace(*program.outputs(out, len(ctrl), trajectory=trajectory), trajectory)

    def observe(self, fields: ModelFields) -> Callable[[jax.Array], Bodies]:
        return bodies.observer(self.scene, fields)

    def contacts(
        self, fields: ModelFields, state: jax.Array, pressure: jax.Array, *, find: bool = True
    ) -> Forces:
        """See `Engine.contacts`.

        What fingers hold on one another is that after the step, from which the force between two
        that slide differs a little.
        """
        if not find:
            shapes = forces.shapes(self.scene, len(state), state.dtype)
            return jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)

        def of_worlds(fields: ModelFields, start: jax.Array, pressure: jax.Array) -> Forces:
            after = self.reset(fields._replace(start=start))
            earlier = before(after, self.scene.discretization.timestep)
            hand = world_constants(self.scene, fields)
            every = forces.forces(self.scene, hand, earlier, pressure)
            stepped = (after.step[0, 0] > 0) & (after.going[0, 0] > 0)

            def masked(v: jax.Array) -> jax.Array:
                return jnp.where(stepped.reshape(-1, *[1] * (v.ndim - 1)), v, 0.0)

            return jax.tree.map(masked, every)

        # Accelerations of a rollout have no derivative.
        return transforms.folded(of_worlds)(*jax.lax.stop_gradient((fields, state, pressure)))

    def recording(self, *, touch: bool = False) -> "RecordingEngine":
        """As an engine whose traces have the contact forces, see `base.recording`."""
        return RecordingEngine(self, touch=touch)

    def states(
        self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool = False
    ) -> tuple[Trace, dict[str, jax.Array]]:
        """`simulate`, and qpos, qvel and accelerations of every step, see `Program.simulate`."""
        program = Program.here(self.scene, self.limits, ctrl.dtype, len(ctrl))
        outputs = {"trajectory": trajectory, "states": True}
        out = _execute(program, self._inputs(program, fields, ctrl), **outputs)
        series, end = program.outputs(out, len(ctrl), **outputs)
        return self._trace(series, end, trajectory), series

    def _inputs(
        self,
        program: Program,
        fields: ModelFields,
        ctrl: jax.Array,
        tables: tuple[jax.Array, ...] = (),
    ) -> Inputs:
        """The kernel's arguments, see `Program.inputs`."""
        hand = world_constants(self.scene, fields)
        return program.inputs(hand, self.reset(fields), ctrl, tables)

    def simulate_with_path(
        self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool = False
    ) -> tuple[Trace, StatePath]:
        """`simulate`, and what a derivative reads of it."""
        # A lane a finger, as the reverse pass has it, which simulates segments again.
        program = Program.here(self.scene, self.limits, ctrl.dtype, len(ctrl), team=1)
        inputs = program.inputs(world_constants(self.scene, fields), self.reset(fields), ctrl)
        out = _execute(program, inputs, trajectory=trajectory, states=self.segment or 1)
        series, end = program.outputs(out, len(ctrl), trajectory=trajectory)
        taken = program.by_block(series["moved"].sum(1)[:, None, None, None])
        path = jax.tree.map(lambda x: program.by_world(x, len(ctrl)), state_path(out, taken))
        return self._trace(series, end, trajectory), path

    def simulate_with_forces(
        self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool, touch: bool
    ) -> tuple[Trace, jax.Array, Forces]:
        """`simulate`, which steps worlds took (world, time), and the forces of these steps."""
        record = Record(touch=touch)
        program = Program.here(self.scene, self.limits, ctrl.dtype, len(ctrl), record=record)
        out = _execute(program, self._inputs(program, fields, ctrl), trajectory=trajectory)
        series, end = program.outputs(out, len(ctrl), trajectory=trajectory)
        every = forces.of_rollout(program, out, len(ctrl))
        return self._trace(series, end, trajectory), series["moved"], every

    def _trace(self, entries: dict[str, jax.Array], end: State, trajectory: bool) -> Trace:
        series = entries["distance"], entries["height"], entries["speed"]
        shape = (*series[0].shape, 0)
        qpos = entries["qpos"] if trajectory else jnp.zeros(shape, series[0].dtype)
        # The decrement is a share of forces times accelerations, its root one of forces.  What a
        # step that converged leaves is rounding.
        left = jnp.where(entries["decrement"] > self.limits.tolerance, entries["decrement"], 0.0)
        return Trace(
            *series,
            qpos,
            self._status(entries),
            coordinates.whole(end),
            residual=jnp.sqrt(left),
            overlap=end.overlap[0, 0],
        )

    def _status(self, series: dict[str, jax.Array]) -> jax.Array:
        """SOLVER_CAP above the tolerance, CONTACT_OVERFLOW; int32 of shape (world, time)."""
        above = series["decrement"] > self.limits.tolerance
        status = jnp.where(above, int(Status.SOLVER_CAP), 0).astype(jnp.int32)
        if "overflow" not in series:
            return status
        return status | jnp.where(series["overflow"] > 0, int(Status.CONTACT_OVERFLOW), 0)


class RecordingEngine(Equal):
    """The engine `structured` as one whose traces have `Trace.forces`; without derivatives."""

    def __init__(self, engine: StructuredEngine, *, touch: bool = False):
        """Prepares the engine; `touch`: forces have the object's contacts ring by ring."""
        self.engine = engine
        self.touch = touch
        self.scene = engine.scene
        self.name = engine.name

    def _key(self) -> tuple:
        return self.engine, self.touch

    def observe(self, fields: ModelFields) -> Callable[[jax.Array], Bodies]:
        return self.engine.observe(fields)

    def contacts(
        self, fields: ModelFields, state: jax.Array, pressure: jax.Array, *, find: bool = True
    ) -> Forces:
        return self.engine.contacts(fields, state, pressure, find=find)

    def recording(self, *, touch: bool = False) -> "RecordingEngine":
        return RecordingEngine(self.engine, touch=touch or self.touch)

    def rollout(self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool = False) -> Trace:
        run = jax.custom_vjp(transforms.folded(partial(self._simulate, trajectory)))

        def refuse(*_: Any) -> Any:
            raise NotImplementedError("a rollout with record_forces=True has no derivative")

        run.defvjp(refuse, refuse)
        return run(fields, ctrl)

    def _simulate(self, trajectory: bool, fields: ModelFields, ctrl: jax.Array) -> Trace:
        trace, moved, every = self.engine.simulate_with_forces(
            fields, ctrl, trajectory=trajectory, touch=self.touch
        )

        def masked(v: jax.Array) -> jax.Array:
            return jnp.where(moved.reshape(*moved.shape, *[1] * (v.ndim - 2)) > 0, v, 0.0)

        return trace._replace(forces=jax.tree.map(masked, every))


def _execute(program: Program, inputs: Inputs, **outputs: Any) -> Outputs:
    try:
        return program.execute(inputs, **outputs)
    except KernelUnavailable as error:
        raise _unavailable(str(error)) from error


def _unavailable(reason: str) -> KernelUnavailable:
    """The error of a device without kernels, with the engines that run there."""
    return KernelUnavailable(
        f"engine structured cannot run here: {reason}; engine mjx runs on every device of JAX, "
        "engine mujoco on every CPU"
    )
