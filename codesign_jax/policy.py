"""A policy in the loop: a pure function that commands the hand by what it observes.

A policy is called every `period` seconds with what it remembers and an `Observation`, and returns
both what it remembers and a `Command`.  `ControlLoop` is an engine that calls it inside the
rollout; whatever takes an engine takes it.

>>> from codesign_jax import make_engine, parameters, policy, rollout, scene
>>> grasping = scene.load("paper")
>>> def gentle(carry, seen):  # half the pressures of the key frames
...     return carry, seen.plan._replace(pressure=0.5 * seen.plan.pressure)
>>> loop = policy.ControlLoop(make_engine("structured", grasping), gentle)
>>> space = parameters.design_space(grasping.hand, "2d")
>>> hand, trial = space.params(space.default()), rollout.nominal_trial(grasping)
>>> trace = rollout.grasp(grasping, loop, hand, trial, steps=250)
>>> round(float(trace.ctrl[-1, 6]))  # a third of the way to 60 kPa [Pa]
19600
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from codesign_jax import control, model
from codesign_jax.control import Plan
from codesign_jax.engines.base import Bodies, Engine, Equal, Pose, recording, tells_forces
from codesign_jax.model import ModelFields
from codesign_jax.model.layout import WRIST
from codesign_jax.scene import Scene, key_frames, unit_slips
from codesign_jax.scene.hand import highest_pressure
from codesign_jax.scene.schema import InputError, Problem
from codesign_jax.types import Forces, Params, Trace, Trial

PERIOD = 0.05
"""Seconds between two calls of a policy that does not say so itself."""


class Command(NamedTuple):
    """Command to the hand for a period.

    The disturbance and the trial's noise are added to the pose, and the air supply acts on the
    pressures.  A pressure below zero or above the limit of the finger's wall is moved to that end.

    Attributes:
      pose: Pose of the arm frame: x, y, z [m], roll, pitch, yaw [rad], shape (6,), held over the
        period, or (step, 6), one for each time step.
      pressure: Pressures of the fingers [Pa], shape (finger,) or (step, finger).
    """

    pose: jax.Array
    pressure: jax.Array


class Observation(NamedTuple):
    """Observation of a world at the beginning of a period.

    Attributes:
      time: Time since the beginning of the grasp [s], shape ().
      phase: Index of the present phase in `Scene.phase_ends`, shape () int32.
      phase_time: Time since that phase began [s], shape ().
      plan: What the scene's key frames command over this period, a `Command` of shape (step, ...).
      pressure: Pressures in the chambers [Pa], shape (finger,).
      joint: Angles of the fingers' joints [rad], shape (finger, link, axis).
      joint_velocity: Their velocities [rad/s], likewise.
      palm: Pose of the palm.
      link: Poses of the fingers' links, whose origins are at their joints, shape (finger, link).
      object: Pose of the object, whose origin is its centre of mass.
      object_velocity: Its linear [m/s] and angular [rad/s] velocity, shape (6,).
      forces: Contact forces over the time step before, zero at the beginning; they have no
        derivative. A policy that does not read them costs no time for them. None with another
        engine than structured.
    """

    time: jax.Array
    phase: jax.Array
    phase_time: jax.Array
    plan: Command
    pressure: jax.Array
    joint: jax.Array
    joint_velocity: jax.Array
    palm: Pose
    link: Pose
    object: Pose
    object_velocity: jax.Array
    forces: Forces | None = None


Policy = Callable[[Any, Observation], tuple[Any, Command]]
"""From what it remembers and an observation of one world to both what it remembers and a command.

Attributes that it may have:
  period: Seconds from call to call, a whole number of time steps; without it about `PERIOD`.
  init: A function of the hand's `Params` to what it remembers at first, a tree of arrays of fixed
    shape and type; without it ().
  parameters: Numbers that a search may move, rows as [[parameter]] of a control file; `init` finds
    their values by name in `Params.control` [SI].
"""


Look = Callable[[jax.Array], Bodies]
"""A function of states, see `Engine.observe`."""


class World(NamedTuple):
    """Worlds between two periods, every array with a leading axis (world,).

    Attributes:
      state: Their states, see `model.RolloutState`, shape (world, n).
      pressure: Pressures in the chambers [Pa], shape (world, finger).
    """

    state: jax.Array
    pressure: jax.Array


class ControlLoop(Equal):
    """An engine that asks a policy for its commands; of equal engine and policy equal.

    The rollout is one program.  A rollout's `Trace.ctrl` has the commands that were given.
    """

    def __init__(self, engine: Engine, policy: Policy):
        """Takes the engine that simulates, and the policy.

        Raises:
          InputError: If the policy cannot be called, or its period is not a whole number of time
            steps.
        """
        if not callable(policy):
            words = f"policy is {policy!r:.60}, not a function of (carry, observation)"
            raise InputError.of("type", words)
        self.engine = engine
        self.policy = policy
        self.name = engine.name
        self.scene = engine.scene
        self.fills = getattr(engine, "fills", False)
        self.steps = period_steps(self.scene, getattr(policy, "period", None))

    def _key(self) -> tuple:
        return self.engine, self.policy, self.scene.hand.pressure_limit

    def recording(self, *, touch: bool = False) -> "ControlLoop":
        """As an engine whose traces have the contact forces, see `base.recording`."""
        return ControlLoop(recording(self.engine, touch=touch), self.policy)

    def observe(self, fields: ModelFields) -> Callable[[jax.Array], Bodies]:
        """As of the engine."""
        return self.engine.observe(fields)

    def contacts(
        self, fields: ModelFields, state: jax.Array, pressure: jax.Array, *, find: bool = True
    ) -> Forces:
        """As of the engine."""
        return self.engine.contacts(fields, state, pressure, find=find)

    commands = staticmethod(control.plan)
    """What `rollout.prepare` makes for `rollout`: the plan instead of controls."""

    def rollout(self, fields: ModelFields, ctrl: Any, *, trajectory: bool = False) -> Trace:
        """See `Engine.rollout`; `ctrl` is a plan, every array with a leading axis (world,).

        Raises:
          InputError: If the policy does not return what it should, or, where nothing is traced,
            a command that is not finite: inside of `jax.jit` such a world has failed (NONFINITE).
        """
        plan: Plan = ctrl
        look = self.engine.observe(fields)
        pack = getattr(self.engine, "tables", None)
        # Worlds keep their constants, which a GPU would take a millisecond a period to lay out.
        arguments = {} if pack is None else {"tables": pack(fields)}
        series = {"pose": plan.pose, "pressure": plan.pressure, "shake": plan.shake}

        def period(carry: tuple, now: dict[str, jax.Array]) -> tuple[tuple, tuple]:
            world, memory = carry
            ahead = plan._replace(**now)
            answer, command = self._asked(look, fields, world, memory, ahead)
            world, trace = advance(
                self.engine, fields, world, ahead, command, trajectory=trajectory, **arguments
            )
            return (world, answer), (trace._replace(last=None, overlap=None), trace.overlap)

        carry = (begin(self.scene, fields, plan), self._remembered(plan.params))
        parts = []
        deepest = None
        periods, rest = divmod(plan.pose.shape[1], self.steps)
        if periods:
            now = {k: _split(v[:, : periods * self.steps], periods) for k, v in series.items()}
            carry, (traces, overlaps) = jax.lax.scan(period, carry, now)
            deepest = None if overlaps is None else overlaps[0]  # the grasp begins in the first one
            parts.append(jax.tree.map(_joined, traces))
        if rest:
            carry, (trace, overlap) = period(carry, {k: v[:, -rest:] for k, v in series.items()})
            deepest = deepest if parts else overlap
            parts.append(trace)
        trace = jax.tree.map(lambda *v: jnp.concatenate(v, 1), *parts)
        self._refuse_nonfinite(trace.ctrl)
        return trace._replace(last=carry[0].state, overlap=deepest)

    def first_command(self, params: Params, trial: Trial) -> Command:
        """The policy's command for the first period of a grasp, without a simulation.

        Raises:
          InputError: As `rollout`.
        """
        return self._rehearsed(params, trial, 1)

    def rehearsed(self, params: Params, trial: Trial) -> Command:
        """The policy's commands over a motionless grasp, shape (step, ...).

        It is asked in every whole period and observes hand and object where they begin, while time
        and key frames go on: nothing is simulated.

        Raises:
          InputError: As `rollout`.
        """
        return self._rehearsed(params, trial, max(1, self.scene.num_steps // self.steps))

    def _rehearsed(self, params: Params, trial: Trial, periods: int) -> Command:
        params, trial = jax.tree.map(lambda v: jnp.asarray(v)[None], (params, trial))
        fields = jax.vmap(partial(model.model_fields, self.scene))(params, trial)
        plan = jax.vmap(partial(control.plan, self.scene))(params, trial)
        steps = min(self.steps, self.scene.num_steps)
        series = {k: getattr(plan, k)[:, : periods * steps] for k in ("pose", "pressure", "shake")}
        look = self.engine.observe(fields)
        world = begin(self.scene, fields, plan)
        state = model.split(self.scene, world.state)

        def period(memory: Any, now: tuple) -> tuple[Any, Command]:
            taken, ahead = now
            at = jnp.full_like(state.step, taken)
            there = world._replace(state=jnp.concatenate(state._replace(step=at), -1))
            return self._asked(look, fields, there, memory, plan._replace(**ahead))

        cut = {k: _split(v, periods) for k, v in series.items()}
        memory = self._remembered(params)
        if periods == 1:
            command = period(memory, (0, {k: v[0] for k, v in cut.items()}))[1]
            return jax.tree.map(lambda v: v[0], command)
        _, command = jax.lax.scan(period, memory, (steps * jnp.arange(periods), cut))
        return jax.tree.map(lambda v: _joined(v)[0], command)

    def _asked(
        self, look: Look, fields: ModelFields, world: World, memory: Any, plan: Plan
    ) -> tuple[Any, Command]:
        seen = observe(self.scene, look, fields, world, plan)
        if tells_forces(self.engine):
            contacts = partial(self.engine.contacts, fields, *world)
            seen = seen._replace(forces=contacts(find=False))
            if reads_forces(self.policy, memory, seen):
                seen = seen._replace(forces=contacts())
        answer = jax.vmap(self.policy)(memory, seen)
        if not (isinstance(answer, tuple) and [*map(type, answer[1:])] == [Command]):
            raise InputError.of("type", f"{self.called} must return (carry, policy.Command)")
        self._refuse_memory(memory, answer[0])
        return answer[0], spread(self.scene, answer[1], plan, of=self.called)

    @property
    def called(self) -> str:
        """The policy's name for messages."""
        return f"policy {getattr(self.policy, '__name__', type(self.policy).__name__)}"

    def _remembered(self, params: Params) -> Any:
        init = getattr(self.policy, "init", None)
        if init is None:
            return ()

        def initial(params: Params) -> Any:
            return jax.tree.map(jnp.asarray, init(params))

        return jax.vmap(initial)(params)

    def _refuse_memory(self, before: Any, after: Any) -> None:
        trees = [jax.tree.flatten(tree) for tree in (before, after)]
        kinds = [[(v.shape[1:], v.dtype.name) for v in map(jnp.asarray, t[0])] for t in trees]
        if trees[0][1] != trees[1][1] or kinds[0] != kinds[1]:
            words = [f"{k}, in the tree {t[1]}" for k, t in zip(kinds, trees, strict=True)]
            raise InputError.of(
                "type",
                f"{self.called} must remember arrays like those of its init: {words[0]}; "
                f"it returned {words[1]}",
            )

    def _refuse_nonfinite(self, ctrl: Any) -> None:
        """Refuses commands that are no numbers; of traced ones nothing is known."""
        if isinstance(ctrl, jax.core.Tracer) or np.isfinite(ctrl).all():
            return
        world, step, column = np.argwhere(~np.isfinite(np.asarray(ctrl)))[0]
        names = [*WRIST, *(f"pressure[{i}]" for i in range(ctrl.shape[2] - 6))]
        time = f"{step * self.scene.discretization.timestep:.4g} s"
        value = f"{names[column]} = {float(ctrl[world, step, column])}"
        raise InputError.of("range", f"{self.called} commands {value} at {time} in world {world}")


def searched(scene: Scene, policy: Policy) -> Scene:
    """The scene with the policy's parameters beside those of its key frames."""
    rows = key_frames.read_parameters(getattr(policy, "parameters", ()), "policy.parameters")
    there = {row.name: row for row in scene.control.parameter}
    new = tuple(row for row in rows if there.get(row.name) != row)
    if taken := [row.name for row in new if row.name in there]:
        words = f"{', '.join(taken)} of the policy: the scene's control has such a parameter"
        raise InputError.of("conflict", words)
    more = dataclasses.replace(scene.control, parameter=(*scene.control.parameter, *new))
    hand = key_frames.with_parameters(scene.hand, dataclasses.replace(more, parameter=new))
    return dataclasses.replace(scene, control=more, hand=hand)


def doubts(loop: ControlLoop, params: Params, trial: Trial) -> list[str]:
    """Warnings about a policy's commands that are legal but suspicious: kPa given as Pa."""
    command = jax.jit(loop.rehearsed)(params, trial)
    words = unit_slips.kilopascals(np.asarray(command.pressure))
    if not words:
        return []
    return [f"{loop.called}: the highest pressure that it commands while nothing moves {words}"]


def period_steps(scene: Scene, period: float | None) -> int:
    """Time steps of a period [s]; None for about `PERIOD`."""
    h = scene.discretization.timestep
    if period is None:
        return max(1, round(PERIOD / h))
    steps = round(period / h) if np.isfinite(period) else 0
    if steps < 1 or abs(steps * h - period) > 1e-6 * h:
        raise InputError.of(
            "range", f"period = {period:g} s is not a whole number of time steps of {h:g} s"
        )
    return steps


def begin(scene: Scene, fields: ModelFields, plan: Plan) -> World:
    """The worlds at the beginning of a grasp, or in the state that the fields start from."""
    state = jnp.concatenate(model.split(scene, fields.start), -1)
    first = plan.pressure[:, 0]
    if scene.effects.pressure_dynamics:
        first = jax.vmap(control.reachable)(fields.constants, first)
    return World(state, first)


def reads_forces(policy: Policy, memory: Any, seen: Observation) -> bool:
    """Whether a policy reads the contact forces that it observes, which a kernel has to find.

    Args:
      memory: Memory of policies, and `seen`: their observations, with a leading axis (world,).
    """

    def answer(contact_forces: Forces) -> Any:
        return jax.vmap(policy)(memory, seen._replace(forces=contact_forces))

    program = jax.make_jaxpr(answer)(seen.forces).jaxpr
    read = {id(value) for equation in program.eqns for value in equation.invars}
    read |= {id(value) for value in program.outvars}
    return any(id(value) in read for value in program.invars)


def observe(scene: Scene, look: Look, fields: ModelFields, world: World, plan: Plan) -> Observation:
    """Observations for policies, without forces; every array has the leading axis (world,).

    Args:
      scene: The engine's scene.
      look: What `Engine.observe` returns for the fields.
      fields: Model fields.
      world: The worlds.
      plan: What the key frames command over this period.
    """
    bodies = look(world.state)
    step = model.split(scene, world.state).step[:, 0]
    phase, since = jax.vmap(_phase)(fields.constants, step)
    return Observation(
        time=step * scene.discretization.timestep,
        phase=phase,
        phase_time=since,
        plan=Command(plan.pose, plan.pressure),
        pressure=world.pressure,
        **bodies._asdict(),
    )


def _phase(scene: Scene, step: jax.Array) -> tuple[jax.Array, jax.Array]:
    ends = jnp.stack(
        [jnp.asarray(scene.steps_to(t), step.dtype) for t in scene.phase_ends.values()]
    )
    phase = jnp.minimum((step >= ends).sum(), len(ends) - 1)
    start = jnp.where(phase > 0, ends[phase - 1], 0.0)
    return phase.astype(jnp.int32), (step - start) * scene.discretization.timestep


def spread(scene: Scene, command: Command, plan: Plan, *, of: str) -> Command:
    """Commands over the time steps of a period, with pressures that the fingers stand.

    Args:
      command: Commands with a leading axis (world,).
    """
    problems = []
    commands = []
    for name, like in (("pose", plan.pose), ("pressure", plan.pressure)):
        series = jnp.asarray(getattr(command, name), like.dtype)
        if series.shape == (len(like), like.shape[2]):
            series = jnp.broadcast_to(series[:, None], like.shape)
        elif series.shape != like.shape:
            shapes = series.shape[1:], like.shape[2:], like.shape[1:]
            words = "{} returned {} of shape {}, not {} or {}".format(of, name, *shapes)
            problems.append(Problem("size", words))
        commands.append(series)
    if problems:
        raise InputError(problems)
    # The upper end is the limit of the wall, or the design's own pressure where that is higher.
    p = plan.params
    tip = None if p.tip is None else p.tip.wall
    top = jax.vmap(partial(highest_pressure, scene.hand))(p.wall, tip)
    top = jnp.maximum(top, p.pressure)[:, None]
    # Comparisons let what is no number pass, and have the derivative of what is at an end.
    pose, pressure = commands
    pressure = jnp.where(pressure < 0, 0.0, pressure)
    return Command(pose, jnp.where(pressure > top, top, pressure))


def advance(
    engine: Engine,
    fields: ModelFields,
    world: World,
    plan: Plan,
    command: Command,
    **options: Any,
) -> tuple[World, Trace]:
    """Simulates a period under commands of shape (world, step, ...); `options`: of the engine."""
    scene = engine.scene

    def controls(
        constants: Scene, now: jax.Array, shake: jax.Array, tilt: jax.Array, command: Command
    ):
        pressure = command.pressure
        end = command.pressure[-1]
        if scene.effects.pressure_dynamics:
            pressure, end = control.supplied(constants, pressure, now)
        return control.actuated(command.pose, pressure, shake, tilt), end

    inputs = fields.constants, world.pressure, plan.shake, plan.tilt, command
    ctrl, pressure = jax.vmap(controls)(*inputs)
    trace = engine.rollout(fields._replace(start=world.state), ctrl, **options)
    if trace.last is None:
        raise InputError.of(
            "unsupported", f"engine {engine.name} does not tell states to go on from"
        )
    return World(trace.last, pressure), trace._replace(ctrl=ctrl)


def _split(series: jax.Array, periods: int) -> jax.Array:
    """(world, time, n) to (period, world, step, n)."""
    return jnp.moveaxis(series.reshape(len(series), periods, -1, series.shape[2]), 1, 0)


def _joined(series: jax.Array) -> jax.Array:
    """(period, world, step, ...) to (world, time, ...)."""
    periods, worlds, steps = series.shape[:3]
    return jnp.moveaxis(series, 0, 1).reshape(worlds, periods * steps, *series.shape[3:])
