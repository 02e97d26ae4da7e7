"""A grasp as an environment; observation, action and reward are methods."""

import contextlib
import dataclasses
import functools
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax import control, model, policy, rollout
from codesign_jax.control import Plan
from codesign_jax.engines import DEFAULT, Engine, make_engine
from codesign_jax.engines.base import tells_forces
from codesign_jax.judge import verdict
from codesign_jax.model import ModelFields
from codesign_jax.policy import Command, Observation, World
from codesign_jax.scene import Scene
from codesign_jax.scene.hand import highest_pressure
from codesign_jax.scene.parameters import design_space
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Params, Trace, Trial


class Data(NamedTuple):
    """A world between two actions.

    Attributes:
      trial: Its object and noise.
      fields: Its model fields.
      plan: What the key frames command over the grasp.
      world: Its state and the pressures in its chambers.
      period: Number of actions since the grasp began, shape () int32.
    """

    trial: Trial
    fields: ModelFields
    plan: Plan
    world: World
    period: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """Result of `reset` and `step`, with the names of Brax and MuJoCo Playground.

    Attributes:
      data: The world.
      obs: What the agent observes, shape (observation,).
      reward: Reward of the last action, shape ().
      done: One after the end of the grasp, and of one that lost its object or failed, shape ().
      metrics: Numbers to watch, which the trainers add up over an episode.
      info: What wrappers keep.
    """

    data: Any
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    info: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def pipeline_state(self) -> Any:
        """`data` by Brax's name."""
        return self.data

    def replace(self, **changes: Any) -> "State":
        """The state with other fields."""
        if "pipeline_state" in changes:
            changes["data"] = changes.pop("pipeline_state")
        return dataclasses.replace(self, **changes)


class GraspEnv:
    """Grasps of one hand, each of an object of the set with noise of its own.

    Attributes:
      params: Parameters of the hand.
      dt: Seconds of an action.
      episode_length: Actions of a whole grasp.
    """

    backend = "codesign"

    def __init__(
        self,
        scene: Scene,
        params: Params | None = None,
        *,
        engine: Engine | None = None,
        period: float = policy.PERIOD,
    ):
        """Takes scene and hand.

        Args:
          scene: The scene; its key frames move the arm, and its phases say when a lost object
            counts.
          params: Parameters of the hand, as `DesignSpace.params` makes them; default: the hand
            file's.
          engine: Engine of the scene; default: structured, which alone tells forces, so that with
            another one `observe` has to be replaced.
          period: Seconds of an action, a whole number of time steps, at most those of a grasp.

        Raises:
          InputError: If the period is not a whole number of time steps, or longer than a grasp.
        """
        if params is None:
            space = design_space(scene.hand)
            params = space.params(space.default())
        self.scene = scene
        self.params = params
        self.engine = make_engine(DEFAULT, scene) if engine is None else engine
        self._steps = policy.period_steps(scene, period)
        if self._steps > scene.num_steps:
            end = scene.num_steps * scene.discretization.timestep
            raise InputError.of(
                "order", f"period = {period:g} s is longer than a grasp, of {end:g} s"
            )
        self.dt = period
        self.episode_length = -(-scene.num_steps // self._steps)

    def observe(self, seen: Observation) -> jax.Array:
        """The agent's observation: signals of sensors on a hand, without the object's position.

        Time of the grasp and of the phase [s]; and of each finger its pressure over the limit of
        its wall, how far it is bent [rad], how fast that changes [rad/s], how hard it presses on
        the object [N], and how much of the object it carries [N].
        """
        if seen.forces is None:
            raise InputError.of(
                "unsupported",
                f"engine {self.engine.name} tells no contact forces, which `observe` of "
                "GraspEnv shows: take engine structured, or replace the method",
            )
        bend = seen.joint[..., 0].sum(-1)
        rate = seen.joint_velocity[..., 0].sum(-1)
        times = jnp.stack([seen.time, seen.phase_time])
        touch = [seen.forces.grip, seen.forces.finger[:, 2]]
        return jnp.concatenate([times, seen.pressure / self.limit, bend, 0.1 * rate, *touch])

    def act(self, seen: Observation, action: jax.Array) -> Command:
        """The command of an action: the plan's pressures times 0, at -1, to 2, at 1; the plan at 0.

        Fingers that the plan keeps empty, as before the hand has arrived, stay empty. A pressure
        above the limit of the walls is that limit, see `Command`.
        """
        share = 1.0 + jnp.clip(action, -1.0, 1.0)
        return seen.plan._replace(pressure=share * seen.plan.pressure)

    def reward(
        self, before: Observation, command: Command, after: Observation, held: jax.Array
    ) -> jax.Array:
        """Reward of a period, shape (): how much of the time that counts the object was held.

        Args:
          before: What was observed before it.
          command: The command, of shape (step, ...).
          after: What is observed after it.
          held: Share of the scene's window in which the object was held during this period, so
            that a grasp's sum is 1 - cost / `cost.maximum` by the scene's cost.
        """
        return held

    @property
    def limit(self) -> jax.Array:
        """Pressures that the fingers' walls stand [Pa], shape (finger,)."""
        p = self.params
        return highest_pressure(self.scene.hand, p.wall, None if p.tip is None else p.tip.wall)

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return self.scene.num_fingers

    @functools.cached_property
    def observation_size(self) -> int:
        """Numbers of an observation."""
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[0]

    @property
    def unwrapped(self) -> "GraspEnv":
        """The environment itself."""
        return self

    def reset(self, rng: jax.Array) -> State:
        """The beginning of a grasp in a random trial.

        Args:
          rng: A key, or the data of one, as Brax has keys.

        Raises:
          InputError: If it is no key, or several.
        """
        noise, choice = jax.random.split(_one_key(rng))
        trial = jax.tree.map(lambda v: v[0], rollout.sample_trials(self.scene, noise, 1))
        shape = jax.random.randint(choice, (), 0, len(self.scene.objects.object))
        return self.begin(trial._replace(shape=shape))

    def begin(self, trial: Trial) -> State:
        """The beginning of a grasp in a given trial."""
        fields = model.model_fields(self.scene, self.params, trial)
        plan = control.plan(self.scene, self.params, trial)
        world = policy.begin(self.scene, *_batch((fields, plan)))
        zero = jnp.zeros((), plan.pose.dtype)
        data = Data(trial, fields, plan, _one(world), jnp.int32(0))
        metrics = {"held": zero, "distance": zero}
        return State(data, self.observe(self.seen(data)), zero, zero, metrics)

    def step(self, state: State, action: jax.Array) -> State:
        """The world after an action of shape (action,), each number of it in [-1, 1].

        A grasp that fails, as by an action that is no number, ends without a reward: it is done,
        and the agent observes what it observed before.

        Raises:
          InputError: If the action has another shape.
        """
        self._refuse_shape(action)
        data: Data = state.data
        plan = self._ahead(data)
        before = self.seen(data)  # once more: a program leaves out what nothing reads
        action_command = _batch(self.act(before, action))
        command = policy.spread(self.scene, action_command, _batch(plan), of="act")
        fields, world, ahead = _batch((data.fields, data.world, plan))
        advanced = policy.advance(self.engine, fields, world, ahead, command)
        world, trace = _one(advanced)
        after = data._replace(world=world, period=data.period + 1)
        seen = self.seen(after)
        held, ended = self._held(data, trace, world)
        reward = self.reward(before, _one(command), seen, held)
        obs = self.observe(seen)
        good = jnp.isfinite(obs).all() & jnp.isfinite(reward)
        done = ended | ~good | (after.period >= self.episode_length)
        metrics = state.metrics | {"held": held, "distance": trace.distance[-1]}
        earlier = {name: state.metrics[name] for name in metrics}
        return state.replace(
            data=after,
            obs=jnp.where(good, obs, state.obs),
            reward=jnp.where(good, reward, 0.0),
            done=done.astype(reward.dtype),
            metrics=jax.tree.map(partial(jnp.where, good), metrics, earlier),
        )

    def _refuse_shape(self, action: jax.typing.ArrayLike) -> None:
        shape = jnp.shape(action)
        size = self.action_size
        if shape != (size,):
            hint = "; jax.vmap maps over environments" if shape[1:] == (size,) else ""
            raise InputError.of("size", f"an action has shape {shape}, not ({size},){hint}")

    def _ahead(self, data: Data) -> Plan:
        """The plan over the period that begins; a last one that is shorter overlaps."""
        first = data.period * self._steps

        def cut(series: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice_in_dim(series, first, self._steps)

        plan = data.plan
        return plan._replace(
            pose=cut(plan.pose), pressure=cut(plan.pressure), shake=cut(plan.shake)
        )

    def seen(self, data: Data) -> Observation:
        """The observation of a world."""
        fields, world, plan = _batch((data.fields, data.world, self._ahead(data)))
        seen = policy.observe(self.scene, self.engine.observe(fields), fields, world, plan)
        if tells_forces(self.engine):
            seen = seen._replace(forces=self.engine.contacts(fields, *world))
        return _one(seen)

    def _held(self, data: Data, trace: Trace, world: World) -> tuple[jax.Array, jax.Array]:
        """Share of the window in which the object was held, and whether the grasp is decided."""
        bounds = verdict.bounds(data.fields.constants)
        steps = data.period * self._steps + jnp.arange(self._steps)
        counts = (steps >= bounds.start) & (steps < bounds.end) & (steps < self.scene.num_steps)
        away = jnp.cumsum(verdict.lost(bounds, trace.distance, steps)) > 0
        good = jnp.cumsum(verdict.failures(self.scene, trace) != 0) == 0
        ended = model.split(self.scene, world.state).going[0] == 0
        held = (counts & ~away & good).sum() / (bounds.end - bounds.start)
        return held.astype(trace.distance.dtype), ended


def _one_key(rng: Any) -> jax.Array:
    """A key, which may be given as its data."""
    dtype = getattr(rng, "dtype", None)
    if dtype == jnp.uint32:
        with contextlib.suppress(TypeError, ValueError):  # of another shape than a key's data
            rng = jax.random.wrap_key_data(rng)
    if dtype is None or not jnp.issubdtype(rng.dtype, jax.dtypes.prng_key):
        raise InputError.of("type", f"reset takes a key, as of jax.random.key(0), not {rng!r:.60}")
    if rng.shape:
        words = f"reset takes one key, not {rng.shape}: jax.vmap(env.reset)(keys) begins several"
        raise InputError.of("size", words)
    return rng


def _batch(tree: Any) -> Any:
    return jax.tree.map(lambda v: jnp.asarray(v)[None], tree)


def _one(tree: Any) -> Any:
    return jax.tree.map(lambda v: v[0], tree)
