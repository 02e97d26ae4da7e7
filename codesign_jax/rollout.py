# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportUnknownLambdaType=false, reportMissingTypeStubs=false
"""Particles x trials in one batch: noise, commands, model fields, engine and cost put together.

>>> import jax
>>> from codesign_jax import make_engine, parameters, rollout, scene
>>> grasping = scene.load("paper")
>>> trials = rollout.sample_trials(grasping, jax.random.key(0), 6)
>>> trials.position.shape  # (trial, axis) [m]
(6, 2)
>>> space = parameters.design_space(grasping.hand, "2d")
>>> hand, engine = space.params(space.default()), make_engine("structured", grasping)
>>> rollout.simulate(grasping, engine, hand, trials)
Traceback (most recent call last):
codesign_jax.scene.schema.InputError: params have no axis (world,); ... makes a batch
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from codesign_jax import axes, control, model, reuse
from codesign_jax.cost import outcome, shown
from codesign_jax.engines import DEFAULT, Engine, make_engine
from codesign_jax.engines.base import recording
from codesign_jax.judge.verdict import as_bit
from codesign_jax.model.layout import layout
from codesign_jax.preflight import invalid_start
from codesign_jax.preflight import nominal_trial as nominal_trial
from codesign_jax.scene import Scene, draws, mesh_margins, schema, unit_slips
from codesign_jax.scene.constants import batch_axes
from codesign_jax.types import Outcome, Params, Status, Trace, Trial, failed

CostFunction = Callable[[Scene, Trace, jax.Array], jax.Array]
"""A cost of one's own: from the scene, the trace of one world (arrays of shape (time,) and qpos of
shape (time, nq)) and its controls (time, nu) to a number.

Whether a world failed, and when it lost its object, is told by the scene's rule all the same, and a
trial whose cost is not a finite number has failed too (NONFINITE).  A failed trial shows the
scene's `cost.maximum`, and `cost.particle_cost` leaves it out or scores it with that.  What the
cost reads of the trace needs `stop_when_lost=False`, or `stop_when_lost=True` if it is meant to see
a grasp up to the loss of the object only, and its qpos needs `record_qpos=True`; see `cost.shown`.
"""


class Options(NamedTuple):
    """Options of simulation and judgement: keywords of `simulate`, `grasp` and `evaluate`.

    Attributes:
      record_qpos: Whether the trace holds qpos of every step; such worlds go on when they are lost.
      stop_when_lost: Whether a world that lost its object stops there, see `Trace`; None for True,
        but a cost of one's own that reads the trace must say which.
      record_forces: Whether the trace has the contact forces, see `Forces`; engine structured
        alone, and without derivatives.  A cost's attribute of this name says the same.
      record_touch: Whether the forces include the contacts of the object ring by ring, see `Touch`:
        eleven numbers for each ring and time step.  Implies `record_forces`.
      cost: A cost of one's own in place of the scene's, see `CostFunction`.
    """

    record_qpos: bool = False
    stop_when_lost: bool | None = None
    record_forces: bool = False
    record_touch: bool = False
    cost: CostFunction | None = None

    @property
    def to_end(self) -> bool:
        """Whether worlds are simulated to the end though they are lost."""
        return self.record_qpos or self.stop_when_lost is False

    def refuse(self) -> None:
        """Refuses worlds that are to stop, and to be recorded: an engine records whole grasps."""
        if self.record_qpos and self.stop_when_lost:
            problem = "record_qpos=True records whole grasps: leave out stop_when_lost=True"
            raise schema.InputError.of("conflict", problem)


# Folded into a trial's key for draws that came later, so that earlier ones stay as they are.
_LATER = 1
_HAND_MASS = 2
_CONSTANTS = 0x636F6E73
"""Stream of the trials' constants ("cons")."""


def sample_trials(
    scene: Scene, key: jax.Array, num_trials: int, first: jax.typing.ArrayLike = 0
) -> Trial:
    """Draws objects and noise of trials (paper Sec. VI.2); shapes take turns in the set's order.

    Args:
      scene: The scene; its numbers of shape () or (trial,).
      key: Typed key; trial t draws from fold_in(key, t), so that more trials do not change earlier
        ones.
      num_trials: Number of trials.
      first: Index of the first of them, which may be traced: more of what was drawn before.

    Returns:
      Trials with leading axis (trial,).

    Raises:
      InputError: If `key` is not one typed key, `num_trials` is no whole number or below 1, or the
        scene's numbers are not in their ranges or as many as the trials.
    """
    reuse.begin()
    axes.refuse_draws(key, num_trials)
    axes.refuse_numbers(scene.checked(), num_trials, "trial")
    trials = _drawn(num_trials, len(scene.objects.object), key, scene.objects.noise, first)
    if not scene.drawn.constant:
        return trials
    constants_key = jax.random.fold_in(key, _CONSTANTS)
    return trials._replace(
        constants=draws.deviations(scene.drawn, constants_key, num_trials, first)
    )


LEAST = 64
"""Least number of trials that are drawn at once: fewer are cut, so that one program serves."""


def _drawn(
    num_trials: int, shapes: int, key: jax.Array, noises: Any, first: jax.typing.ArrayLike
) -> Trial:
    """`_draw` in programs of few sizes, where it is not a part of another program."""
    arguments = jax.tree.leaves((key, noises, first))
    if any(isinstance(v, jax.core.Tracer) or jnp.ndim(v) for v in arguments):
        return _draw(num_trials, shapes, key, noises, first)
    size = LEAST
    while size < num_trials:
        size *= 2
    with jax.ensure_compile_time_eval():  # another program may close over the key
        more = _draw(size, shapes, key, noises, first)
    # Not by JAX's operations: each would be a program for every shape.
    return jax.device_put(jax.tree.map(lambda v: np.asarray(v)[:num_trials], more))


@partial(reuse.quickly_compiled, static_argnums=(0, 1))
def _draw(
    num_trials: int, shapes: int, key: jax.Array, noises: Any, first: jax.typing.ArrayLike
) -> Trial:
    """Trials of a set of so many shapes; one program where nothing else is compiled with it."""

    def draw(t: jax.Array, noise: Any) -> Trial:
        trial_key = jax.random.fold_in(key, t)
        others = jax.vmap(partial(jax.random.fold_in, trial_key))(np.array([_LATER, _HAND_MASS]))
        # The first numbers of a key are the same however many are drawn, so that one draw of all
        # is three draws, with two thirds of the operations.
        every = jax.vmap(lambda k: jax.random.normal(k, (7,)))(jnp.append(trial_key, others))
        z = every[0]
        later = every[1]
        hand_mass = every[2, 0]
        angles = jnp.deg2rad(noise.orientation) * z[2:5]
        return Trial(
            shape=t % shapes,
            position=noise.position * z[:2],
            yaw=angles[0],
            arm_tilt=angles[1:],
            mass=(1.0 + noise.mass * z[5]) * noise.mass_range ** norm.cdf(every[2, 1]),
            size=1.0 + noise.size * z[6],
            friction=jnp.exp(noise.friction * later[0]),
            stiffness=jnp.exp(noise.stiffness * later[1]),
            hand_mass=jnp.exp(noise.hand_mass * hand_mass),
            tilt=jnp.deg2rad(noise.tilt) * later[2:4],
        )

    numbers = jnp.asarray(first) + jnp.arange(num_trials)
    return jax.vmap(draw, in_axes=(0, batch_axes(noises)))(numbers, noises)


def simulate(
    scene: Scene,
    engine: Engine,
    params: Params,
    trials: Trial,
    **options: Any,
) -> tuple[Outcome, Trace]:
    """Simulates a batch of worlds; jit it, with scene and engine closed over.

    The scene's cost counts the time steps after a loss of the object, so that it is flat almost
    everywhere: `jax.grad` of `Outcome.cost` is 0.0, without a warning.  What has a useful gradient
    is a trace over a short window, as of `grasp(..., steps=40).distance[-1]`; docs/gradients.md.

    Args:
      scene: The scene; its numbers of shape () or (world,).
      engine: The engine, which may be that of any scene of the same structure.
      params: Parameters with leading axis (world,).
      trials: Trials with leading axis (world,).
      **options: See `Options`.

    Returns:
      Outcome and trace with leading axis (world,).

    Raises:
      InputError: If the engine was made for a scene of another structure, if an array lacks an
        axis, if a number of the scene is outside of its range, or if a parameter
        is out of its range by a factor between units, such as millimetres given for metres, or a
        finger is so high that its contacts begin farther from a mesh than distances reach; of
        traced ones no values are known.
    """
    return simulated(scene, engine, params, trials, Options(**options))[:2]


def simulated(
    scene: Scene,
    engine: Engine,
    params: Params,
    trials: Trial,
    options: Options,
    counts: jax.Array | None = None,
) -> tuple[Outcome, Trace, Any]:
    """`simulate`, and the controls of shape (world, time, nu), or the `control.Plan`.

    Args:
      counts: Which worlds are simulated, bool, shape (world,); the others fill a batch up, and what
        is returned of them means nothing.  None for all.
    """
    _check(scene, engine, params, trials)
    trace, ctrl, initial = _traced(scene, engine, params, trials, options, counts=counts)
    return judge(scene, trace, ctrl, initial, trials, options), trace, ctrl


def grasp(
    scene: Scene,
    engine: Engine,
    params: Params,
    trial: Trial,
    *,
    steps: int | None = None,
    **options: Any,
) -> Trace:
    """Simulates one world, or the beginning of it; `jax.vmap` makes a batch of it.

    Args:
      params: Parameters of one hand.
      trial: One trial.
      steps: How many time steps are simulated; None for the whole grasp.
      **options: See `Options`.

    Returns:
      Trace of shape (steps,).

    Raises:
      InputError: As `simulate`, or if there are no such steps.
    """
    if steps is not None and not 0 < steps <= scene.num_steps:
        raise schema.InputError.of(
            "range", f"steps = {steps}: the grasp has 1 to {scene.num_steps}"
        )
    params, trial = jax.tree.map(lambda v: jnp.asarray(v)[None], (params, trial))
    _check(scene, engine, params, trial)
    trace, *_ = _traced(scene, engine, params, trial, Options(**options), steps)
    return jax.tree.map(lambda v: v[0], trace)


def evaluate(
    scene: Scene,
    engine: Engine,
    params: Params,
    trials: Trial,
    **options: Any,
) -> Outcome:
    """Evaluates all particles in all trials as one batch of particle * trial worlds.

    Args:
      scene: The scene; its numbers of shape () or (trial,).
      params: Parameters with leading axis (particle,).
      trials: Trials with leading axis (trial,): common random numbers, every particle meets the
        same ones.
      **options: See `Options`.

    Returns:
      Outcomes, every array of shape (particle, trial).

    Raises:
      InputError: See `simulate`.
    """
    axes.refuse(scene, params, trials, ("particle", "trial"))
    axes.refuse_numbers(scene, len(trials.yaw), "trial")
    shape = params.length.shape[0], trials.yaw.shape[0]
    scene, params, trials = crossed(scene, params, trials)
    return grid(simulate(scene, engine, params, trials, **options)[0], shape)


def tips(scene: Scene, params: Params, trial: Trial, qpos: jax.typing.ArrayLike) -> jax.Array:
    """Positions of the finger tips in the world frame [m], shape (..., finger, 3).

    A tip is the middle of the far end of the finger's inextensible side, on which the finger is
    mounted.

    Args:
      scene: The scene.
      params: Parameters of one hand.
      trial: One trial.
      qpos: Recorded positions, shape (..., nq), as `grasp(..., record_qpos=True).qpos`.

    Raises:
      InputError: If the positions are not those of this scene's hand and object, and as `simulate`.
    """
    hands, trials = jax.tree.map(lambda v: jnp.asarray(v)[None], (params, trial))
    axes.refuse(scene, hands, trials, ("world", "world"))
    size = 13 + layout(scene).dofs.size  # of wrist, joints and the object's pose
    if jnp.shape(qpos)[-1:] != (size,):
        hint = "record_qpos=True records it" if jnp.shape(qpos)[-1:] == (0,) else "of this scene"
        raise schema.InputError.of(
            "size", f"qpos has shape {jnp.shape(qpos)}, not (..., {size}): {hint}"
        )
    numbers = jax.tree.map(lambda v: jnp.asarray(v, float), scene.bare)
    rows = jnp.reshape(jnp.asarray(qpos), (-1, size))
    places = _tips(make_engine(DEFAULT, scene), numbers, params, trial, rows)
    return places.reshape(*jnp.shape(qpos)[:-1], -1, 3)


@partial(jax.jit, static_argnums=0)
def _tips(engine: Engine, scene: Scene, params: Params, trial: Trial, qpos: jax.Array) -> jax.Array:
    """`tips` of positions of shape (time, nq)."""
    fields = model.model_fields(scene, params, trial)
    observe = engine.observe(jax.tree.map(lambda v: v[None], fields))
    after = fields.start[qpos.shape[1] :]  # the rest of a state, which moves no tip

    def at(row: jax.Array) -> jax.Array:
        link = observe(jnp.concatenate([row, after])[None]).link
        half = params.length / (2 * scene.discretization.links)
        return link.position[0, :, -1] + half[:, None] * link.rotation[0, :, -1, :, 0]

    return jax.vmap(at)(qpos)


def crossed(scene: Scene, params: Params, trials: Trial) -> tuple[Scene, Params, Trial]:
    """Every particle in all trials, arrays with leading axis (particle * trial,), particles slow.

    Of the scene's numbers those with an axis have the trials'.
    """
    particles = params.length.shape[0]
    count = trials.yaw.shape[0]
    every_p = jax.tree.map(lambda v: jnp.repeat(v, count, axis=0), params)
    every_t = jax.tree.map(lambda v: jnp.tile(v, (particles,) + (1,) * (v.ndim - 1)), trials)
    scenes = jax.tree.map(lambda v: jnp.tile(v, particles) if jnp.ndim(v) else v, scene)
    return scenes, every_p, every_t


def grid(tree: Any, shape: tuple[int, ...]) -> Any:
    """Arrays whose leading axis (particle * trial,) becomes two, (particle, trial)."""
    return jax.tree.map(lambda v: v.reshape(*shape, *v.shape[1:]), tree)


def _check(scene: Scene, engine: Engine, params: Params, trials: Trial) -> None:
    axes.refuse_other(scene, engine)
    axes.refuse(scene, params, trials, ("world", "world"))
    axes.refuse_numbers(scene.checked(), len(trials.yaw), "world")
    unit_slips.refuse(params)
    for height in [params.height] if params.tip is None else [params.height, params.tip.height]:
        mesh_margins.refuse(scene.objects, height / 2)


def _traced(
    scene: Scene,
    engine: Engine,
    params: Params,
    trials: Trial,
    options: Options,
    steps: int | None = None,
    counts: jax.Array | None = None,
) -> tuple[Trace, Any, jax.Array]:
    options.refuse()
    needed = options.record_forces or options.record_touch
    if needed or getattr(options.cost, "record_forces", False):
        engine = recording(engine, touch=options.record_touch)
    ctrl: Any
    fields, ctrl = prepare(scene, params, trials, engine)
    if counts is not None:
        fields = fields._replace(start=decided(scene, fields.start, ~counts))
    if steps is not None and isinstance(ctrl, control.Plan):
        series = {k: getattr(ctrl, k)[:, :steps] for k in ("pose", "pressure", "shake")}
        ctrl = ctrl._replace(**series)
    elif steps is not None:
        ctrl = ctrl[:, :steps]
    trace = engine.rollout(fields, ctrl, trajectory=options.to_end)
    initial = invalid_start(scene, fields, trace.overlap)
    return trace if options.record_qpos else trace._replace(qpos=trace.qpos[..., :0]), ctrl, initial


def decided(scene: Scene, start: jax.Array, which: jax.Array) -> jax.Array:
    """Start states of which some are those of decided worlds, which no engine simulates."""
    state = model.split(scene, start)
    going = jnp.where(which[:, None], 0, state.going).astype(start.dtype)
    return jnp.concatenate(state._replace(going=going), -1)


def prepare(
    scene: Scene,
    params: Params,
    trials: Trial,
    engine: Engine | None = None,
) -> tuple[model.ModelFields, Any]:
    """Inputs of an engine for a batch of worlds.

    Args:
      scene: The scene; its numbers of shape () or (world,).
      params: Parameters with leading axis (world,).
      trials: Trials with leading axis (world,).

    Returns:
      Model fields, and controls of shape (world, time, nu), or a `control.Plan` for such an engine.
    """
    reuse.begin()
    numbers = jax.tree.map(lambda v: jnp.asarray(v, float), scene.bare)
    world = partial(_world, getattr(engine, "commands", control.commands))
    return jax.vmap(world, in_axes=(batch_axes(numbers), 0, 0))(numbers, params, trials)


@partial(jax.jit, static_argnums=0)
def _world(
    commands: Callable[..., Any], scene: Scene, params: Params, trial: Trial
) -> tuple[model.ModelFields, Any]:
    """Model fields and controls of a world; a process traces them once for batches of any size."""
    return model.model_fields(scene, params, trial), commands(scene, params, trial)


def judge(
    scene: Scene,
    trace: Trace,
    ctrl: jax.Array | None,
    initial: jax.Array,
    trials: Trial,
    options: Options,
) -> Outcome:
    """Outcomes of a batch of worlds, with leading axis (world,).

    Args:
      scene: The scene; its numbers of shape () or (world,).
      initial: Bits of `Status` that they started with, shape (world,).
      trials: Their trials, with leading axis (world,).
    """
    outcomes = jax.vmap(outcome, in_axes=(batch_axes(scene), 0, 0, 0))(
        scene, trace, initial, trials
    )
    return outcomes if options.cost is None else by_user_cost(scene, options, trace, ctrl, outcomes)


def by_user_cost(
    scene: Scene, options: Options, trace: Trace, ctrl: jax.Array | None, outcomes: Outcome
) -> Outcome:
    """Outcomes of a batch of worlds by a cost of one's own, from those by the scene's.

    Args:
      ctrl: As a policy gave them in the trace, or as they were known, shape (world, time, nu).
    """
    cost = options.cost
    assert cost is not None

    def world(world_scene: Scene, t: Trace, u: jax.Array | None, result: Outcome) -> Outcome:
        seen = shown(t, options.record_qpos, options.stop_when_lost)
        return _by_user_cost(world_scene, cost, seen, u, result)

    commands = ctrl if trace.ctrl is None else trace.ctrl
    every = jax.vmap(world, in_axes=(batch_axes(scene), 0, 0, 0))
    return every(scene, trace, commands, outcomes)


def _by_user_cost(
    scene: Scene, cost: CostFunction, trace: Trace, ctrl: jax.Array | None, result: Outcome
) -> Outcome:
    if ctrl is None:
        raise ValueError("a cost of one's own needs the controls")
    returned: Any = cost(scene, trace, ctrl)
    if returned is None:
        raise ValueError("a cost is one number for each world, not None: does it return one?")
    value = jnp.asarray(returned)
    if value.shape:
        raise ValueError(f"a cost is one number for each world, not an array {value.shape}")
    status = result.status | as_bit(~jnp.isfinite(value), Status.NONFINITE)
    value = jnp.where(failed(status), scene.cost.maximum, value)
    return result._replace(cost=value.astype(result.cost.dtype), status=status)
