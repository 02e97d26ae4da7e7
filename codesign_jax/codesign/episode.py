"""`Task`: the evaluation of a population, one episode, and a whole optimisation as programs."""

import dataclasses
import functools
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from codesign_jax import axes, batch, devices, engines, rollout
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine
from codesign_jax.engines.base import recording
from codesign_jax.optimize import Info, Optimizer, OptimizerState, ParticleFilter
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.scene import InputError, Problem, Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, Params, Trial, random_key_problem

# Four ASCII letters, as the optimiser's streams and `experiment`'s, so that no two streams of a
# seed meet.
STREAM_TRIAL = 0x7472696C
"""Stream of the noise of an episode's trials ("tril")."""


class EpisodeInfo(NamedTuple):
    """The report of an episode.

    Attributes:
      population: Particles as simulated [SI units], shape (particle, parameter).
      outcomes: Cost, status, time of loss and first bad step, each of shape (particle, trial).
      selection: Particle costs, and weights and ancestors of a resampling; see `optimize.Info`.
      last: Final states of the worlds, shape (particle, trial, n), see `model.RolloutState`; a
        failed world keeps its last valid state. None if the engine does not report states.
      drawn: The trials that every particle met, leading axis (trial,).
    """

    population: jax.Array
    outcomes: Outcome
    selection: Info
    last: jax.Array | None
    drawn: Trial


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Task:
    """A problem to optimise: grasps by hands of a design space, and their cost.

    Its functions are programs that all scenes of one structure share (`programs`): another scene of
    the same structure, as by `dataclasses.replace(scene, gravity=3.7)`, compiles nothing.
    `jax.jit`, `jax.vmap` and so on work on them.  A cost by the scene's rule is flat almost
    everywhere, and its gradient 0.0; see `rollout.simulate`.

    Attributes:
      space: Design space of the particles.
      trials: Trials of each particle in an evaluation or an episode.
      engine: Engine that simulates; by default the engine `structured` of the scene.
      cost: A cost of one's own in place of the scene's, see `rollout.CostFunction`.  If it has the
        attribute `record_forces = True`, its trace has the contact forces.
      record_qpos: As in `rollout.Options`, for a cost of one's own.
      stop_when_lost: As in `rollout.Options`, for a cost of one's own.
      devices: Devices of this process that share the worlds of a call.

    >>> from codesign_jax import Task, parameters, scene
    >>> grasping = scene.load("paper")
    >>> task = Task(grasping, parameters.design_space(grasping.hand, "2d"), trials=3)
    >>> task.engine.name
    'structured'
    >>> print(task)
    3 trials of each design, engine structured, the scene's cost
    2 parameters: length 10 to 180 mm, arm_z -60 to 200 mm
    scene paper: ...
    """

    scene: Scene
    space: DesignSpace
    trials: int
    engine: Engine = None  # type: ignore[assignment]  # made after this
    cost: rollout.CostFunction | None = None
    record_qpos: bool = False
    stop_when_lost: bool | None = None
    devices: int = 1

    def __post_init__(self) -> None:
        """Makes the engine.

        Raises:
          InputError: If the space is none, or there are no trials, or the engine is that of a scene
            of another structure or records no forces where they are asked for, or worlds are to be
            recorded and to stop.
          ValueError: If there are not so many devices.
        """
        problems = []
        if not isinstance(self.space, DesignSpace):
            hint = "parameters.design_space(scene.hand, '2d') makes one"
            problems.append(
                Problem("type", f"space is {self.space!r:.40}, not a DesignSpace; {hint}")
            )
        if not isinstance(self.trials, int | np.integer) or self.trials < 1:
            problems.append(
                Problem("range", f"trials = {self.trials!r:.60} must be a whole number, at least 1")
            )
        if problems:
            raise InputError(problems)
        if self.engine is None:
            object.__setattr__(self, "engine", engines.make_engine(engines.DEFAULT, self.scene))
        if getattr(self.cost, "record_forces", False):
            object.__setattr__(self, "engine", recording(self.engine))
        axes.refuse_other(self.scene, self.engine)
        self._options.refuse()
        devices.take(self.devices)

    def __str__(self) -> str:
        """In a few lines."""
        name = getattr(self.cost, "__name__", type(self.cost).__name__)
        cost = "the scene's cost" if self.cost is None else f"cost {name}"
        words = f"{self.trials} trials of each design, engine {self.engine.name}, {cost}"
        return f"{words}\n{self.space}\n{self.scene}"

    __repr__ = __str__

    @property
    def _options(self) -> rollout.Options:
        return rollout.Options(self.record_qpos, self.stop_when_lost, cost=self.cost)

    def evaluate(
        self,
        population: jax.typing.ArrayLike,
        key: jax.Array,
        scene: Scene | None = None,
    ) -> Outcome:
        """Outcomes of particles in random trials, arrays of shape (particle, trial).

        All particles meet the same trials: common random numbers compare designs, not luck.

        Args:
          population: Particles [SI units], shape (particle, parameter).
          key: Key of the trials.
          scene: A scene with other numbers, of shape () or (trial,).

        Raises:
          InputError: If the population, the key or the scene do not fit, and see
            `DesignSpace.check`, which warns of designs that are not legal.
        """
        if problem := random_key_problem(key):
            hint = "; rollout.evaluate takes trials" if isinstance(key, Trial) else ""
            raise InputError.of("type", problem + hint)
        self.space.refuse_population(population)
        self.space.check(population)
        self.scene.checked(scene)
        population = jnp.asarray(population)
        if _is_whole(population, key, scene):
            return SceneProgram(self.scene, self._programs.evaluate)(population, key, scene)
        trials = rollout.sample_trials(scene or self.scene, key, self.trials)
        populations, trials = _alone((population, trials))
        return self.outcomes(populations, trials, scene)[0]

    def outcomes(
        self,
        populations: jax.Array,
        trials: Trial,
        scene: Scene | None = None,
        *,
        size: int | None = None,
        advance: Callable[[int], Any] = lambda worlds: None,
    ) -> list[Outcome]:
        """Outcomes of populations that meet trials of their own, each of shape (particle, trial).

        Args:
          populations: Particles [SI units], shape (population, particle, parameter).
          trials: The trials of each population, leading axes (population, trial).
          scene: A scene with other numbers, of shape ().
          size: Worlds of a call; None for `call_size`.
          advance: Is told the worlds of each call that has ended.
        """
        hands, worlds = self._pieces.cross(populations, trials)
        shape = (*populations.shape[:2], trials.yaw.shape[1])
        every, _ = self._batch.simulate(hands, worlds, scene, size=size, advance=advance)
        every = jax.tree.map(lambda v: v.reshape(shape), every)
        return [jax.tree.map(lambda v, k=k: v[k], every) for k in range(shape[0])]

    def episode(
        self,
        optimizer: Optimizer,
        state: OptimizerState,
        mask: jax.typing.ArrayLike | None = None,
        scene: Scene | None = None,
    ) -> tuple[OptimizerState, "EpisodeInfo"]:
        """Runs one episode: moves the particles, simulates, and tells the optimiser their costs.

        The noise of trial t derives from (root key, stream, episode, t), so that it depends neither
        on the number of particles nor on where a run was resumed.

        Args:
          optimizer: Optimiser over the same space, see `optimize.Optimizer`.
          mask: Parameters that may move, bool, shape (parameter,): data, so that every schedule
            shares one program. None for all.
          scene: A scene with other numbers, of shape () or (trial,), but for `cost.maximum`, which
            is one number.
        """
        _refuse_state(state)
        self.scene.checked(scene)
        mask = np.ones(self.space.num_parameters, bool) if mask is None else mask
        if _is_whole((state, mask), optimizer, scene):
            return self._joined(self._programs.episode, optimizer)(state, mask, scene)
        _refuse_mask(self.space, mask)
        self.space.refuse_population(state.particles)
        states, masks = _alone((state, np.asarray(mask)))
        results = self.side_by_side(optimizer)(states, masks, scene)
        if self._weighs(optimizer):
            _warn_of_negative(results[1].selection.cost)
        return _first(results)

    def side_by_side(self, optimizer: Optimizer) -> "SideBySide":
        """`episode` of several runs: a function of states and masks with a leading axis (run,)."""
        return SideBySide(self, optimizer)

    def run(
        self,
        optimizer: Optimizer,
        state: OptimizerState,
        masks: jax.typing.ArrayLike,
        scene: Scene | None = None,
    ) -> tuple[OptimizerState, "EpisodeInfo"]:
        """Runs a whole optimisation as one program, a `jax.lax.scan` over the episodes.

        It is a loop in Python over `episode` without a way to stop in between.  XLA rounds the
        model fields of the two programs, and of batches of other sizes, differently in the last
        bit.  `jax.vmap` over the state runs many seeds in one batch, see
        `optimize.OptimizerState`, and over a scene's numbers many worlds' physics.

        Args:
          optimizer: As of `episode`.
          masks: The mask of each episode, shape (episode, parameter).
          scene: As of `episode`.

        Returns:
          The state at the end, and reports with leading axis (episode,).
        """
        _refuse_state(state)
        return self._joined(self._programs.run, optimizer)(state, masks, scene)

    def call_size(self, worlds: int) -> int | None:
        """Worlds of a call of what simulates so many, for other calls to be alike; None for any."""
        return self._batch.size(worlds) if self._batch.fills else None

    def start(self, hands: Params, worlds: int) -> bool:
        """Whether hands, leading axis (hand,), are known to start apart from everything.

        By the program that simulates so many worlds, see `batch.Batch.start`.
        """
        return self._batch.start(hands, size=self.call_size(worlds))

    def first_trials(self, keys: jax.Array) -> Trial:
        """Trials of the first episodes of runs with these root keys, leading axes (run, trial)."""
        return SceneProgram(self.scene, self._pieces.first_trials)(keys, None)

    @functools.cached_property
    def _batch(self) -> batch.Batch:
        return batch.Batch(self.scene, self.engine, self._options, self.devices)

    @functools.cached_property
    def _pieces(self) -> "_Pieces":
        return _pieces(self.space, self.trials)

    @functools.cached_property
    def _programs(self) -> "_Programs":
        return _programs(self.engine, self.space, self.trials, self.devices, self._options)

    def _joined(self, program: Callable, optimizer: Optimizer) -> SceneProgram:
        """A program with its optimiser, which warns where that does not see costs of one's own."""
        kind = _Weighing if self._weighs(optimizer) else SceneProgram
        return kind(self.scene, program, optimizer)

    def _weighs(self, optimizer: Optimizer) -> bool:
        return self.cost is not None and isinstance(optimizer, ParticleFilter)


class _Weighing(SceneProgram):
    """A program whose costs of one's own a particle filter weighs: negative ones count as 0."""

    def __call__(self, first: Any, second: Any, scene: Scene | None = None) -> Any:
        """Like `SceneProgram`, but warns of negative particle costs, except traced ones."""
        results = super().__call__(first, second, scene)
        _warn_of_negative(results[1].selection.cost)
        return results


def _warn_of_negative(costs: Any) -> None:
    if not isinstance(costs, jax.core.Tracer) and (np.asarray(costs) < 0).any():
        warnings.warn(
            "a cost of your own is negative: the particle filter weighs by 1 / (alpha + cost) "
            "and takes negative costs for 0, so that it does not tell them apart; add a "
            "constant, or take an optimiser that compares, such as cma-es",
            stacklevel=3,
        )


class SideBySide:
    """Episodes of several runs: a function of their states and masks, see `Task.side_by_side`.

    Called with arrays it is three programs: one asks the optimiser, one simulates the worlds in
    calls of few sizes (`batch.Batch`), and one tells the costs; only the first and the last depend
    on space, optimiser and numbers of particles. Called with traced arrays it is one program.
    """

    def __init__(self, task: Task, optimizer: Optimizer):
        """Compiles nothing yet."""
        self._task = task
        self._optimizer = optimizer

    def __call__(
        self, states: OptimizerState, masks: jax.typing.ArrayLike, scene: Scene | None = None
    ) -> tuple[OptimizerState, EpisodeInfo]:
        """The states after an episode, and reports, with a leading axis (run,)."""
        task = self._task
        if _is_whole((states, masks), self._optimizer, scene):
            return SceneProgram(task.scene, task._programs.episodes, self._optimizer)(
                states, masks, scene
            )
        asked = self._ask(states, masks, scene)
        hands, trials = asked[2:]
        outcomes, trace = task._batch.simulate(hands, trials, scene)
        return self._tell(states, masks, scene, asked, (outcomes, trace.last))

    def compile(self, states: OptimizerState, masks: jax.typing.ArrayLike) -> Callable:
        """Compiles ahead for arguments like these, by worlds that are not simulated.

        An engine that simulates all worlds of a batch gets one program, as if it were traced.
        """
        task = self._task
        if not task._batch.fills:
            whole = SceneProgram(task.scene, task._programs.episodes, self._optimizer)
            return whole.compile(states, masks)
        asked = self._ask(states, masks, None)
        nothing = task._batch.compile(*asked[2:])
        jax.block_until_ready(self._tell(states, masks, None, asked, nothing))
        return self

    def _ask(self, states: OptimizerState, masks: Any, scene: Scene | None) -> tuple:
        program = SceneProgram(self._task.scene, self._task._pieces.ask, self._optimizer)
        return program(states, masks, scene)

    def _tell(
        self, states: OptimizerState, masks: Any, scene: Scene | None, asked: tuple, results: tuple
    ) -> tuple[OptimizerState, EpisodeInfo]:
        population, trials, *_ = asked
        shape = (*population.shape[:2], self._task.trials)
        results = jax.device_put(jax.tree.map(lambda v: v.reshape(*shape, *v.shape[1:]), results))
        outcomes, last = results
        program = SceneProgram(self._task.scene, self._task._pieces.tell, self._optimizer)
        new, selection = program((states, masks), (population, outcomes), scene)
        return new, EpisodeInfo(population, outcomes, selection, last, trials)


# One program, not one an operation.


@jax.jit
def _alone(tree: Any) -> Any:
    """Arrays with a leading axis of one run."""
    return jax.tree.map(lambda v: jnp.asarray(v)[None], tree)


@jax.jit
def _first(tree: Any) -> Any:
    """Arrays of the first run."""
    return jax.tree.map(lambda v: v[0], tree)


def _is_whole(*arguments: Any) -> bool:
    """Whether a call is one program: what is traced, or has numbers that differ between trials."""
    *_, scene = arguments
    if any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(arguments)):
        return True
    return scene is not None and any(jnp.ndim(v) for v in jax.tree.leaves(scene.bare))


class _Pieces(NamedTuple):
    """Programs around the simulation; all arrays have a leading axis (run,) or (population,)."""

    ask: Any
    tell: Any
    cross: Any
    first_trials: Any


@shared
def _pieces(space: DesignSpace, num_trials: int) -> _Pieces:
    def cross(population: jax.Array, trials: Trial) -> tuple[Params, Trial]:
        particles, count = len(population), trials.yaw.shape[0]
        hands = jax.vmap(space.params)(population)
        hands = jax.tree.map(lambda v: jnp.repeat(v, count, axis=0), hands)
        return hands, jax.tree.map(
            lambda v: jnp.tile(v, (particles,) + (1,) * (v.ndim - 1)), trials
        )

    def worlds(populations: jax.Array, trials: Trial) -> tuple[Params, Trial]:
        every = jax.vmap(cross)(populations, trials)
        return jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), every)

    def ask(
        states: OptimizerState, masks: jax.Array, scene: Scene, optimizer: Optimizer
    ) -> tuple[jax.Array, Trial, Params, Trial]:
        def ask_run(state: OptimizerState, mask: jax.Array) -> tuple[jax.Array, Trial]:
            _refuse_mask(space, mask)
            space.refuse_population(state.particles)
            trials = episode_trials(scene, state.key, state.episode, num_trials)
            return optimizer.ask(state, mask), trials

        populations, trials = jax.vmap(ask_run)(states, masks)
        return populations, trials, *worlds(populations, trials)

    def tell(
        before: tuple[OptimizerState, jax.Array],
        simulated: tuple[jax.Array, Outcome],
        scene: Scene,
        optimizer: Optimizer,
    ) -> tuple[OptimizerState, Info]:
        def tell_run(
            state: OptimizerState, mask: jax.Array, population: jax.Array, outcomes: Outcome
        ) -> tuple[OptimizerState, Info]:
            return optimizer.tell(state, population, particle_cost(scene, outcomes), mask)

        return jax.vmap(tell_run)(*before, *simulated)

    def first_trials(keys: jax.Array, _: Any, scene: Scene) -> Trial:
        return jax.vmap(lambda key: episode_trials(scene, key, 0, num_trials))(keys)

    return _Pieces(ask, tell, worlds, first_trials)


class _Programs(NamedTuple):
    """The programs of a task."""

    evaluate: Any
    episode: Any
    episodes: Any
    run: Any


@shared
def _programs(
    engine: Engine, space: DesignSpace, num_trials: int, count: int, options: rollout.Options
) -> _Programs:
    def worlds(scene: Scene, hands: Params, trials: Trial) -> tuple[Outcome, jax.Array | None]:
        outcome, trace = rollout.simulate(scene, engine, hands, trials, **options._asdict())
        return outcome, trace.last

    def simulate(
        scene: Scene, population: jax.Array, trials: Trial
    ) -> tuple[Outcome, jax.Array | None]:
        """Outcomes and last states of every particle in all trials, by particle and trial."""
        every = rollout.crossed(scene, jax.vmap(space.params)(population), trials)
        results = devices.shared_out(worlds, count)(*every)
        return rollout.grid(results, (len(population), num_trials))

    def evaluate(population: jax.Array, key: jax.Array, scene: Scene) -> Outcome:
        return simulate(scene, population, rollout.sample_trials(scene, key, num_trials))[0]

    @jax.jit  # is traced once for itself, `episodes` and `run`
    def episode(
        state: OptimizerState, mask: jax.typing.ArrayLike, scene: Scene, optimizer: Optimizer
    ) -> tuple[OptimizerState, EpisodeInfo]:
        """Fig. 5 of the paper: move, simulate, weigh and resample."""
        _refuse_mask(space, mask)
        space.refuse_population(state.particles)
        population = optimizer.ask(state, mask)
        trials = episode_trials(scene, state.key, state.episode, num_trials)
        outcomes, last = simulate(scene, population, trials)
        new, selection = optimizer.tell(state, population, particle_cost(scene, outcomes), mask)
        return new, EpisodeInfo(population, outcomes, selection, last, trials)

    def run(
        state: OptimizerState, masks: jax.typing.ArrayLike, scene: Scene, optimizer: Optimizer
    ) -> tuple[OptimizerState, EpisodeInfo]:
        def step(state: OptimizerState, mask: jax.Array) -> tuple[OptimizerState, EpisodeInfo]:
            return episode(state, mask, scene, optimizer)

        return jax.lax.scan(step, state, jnp.asarray(masks))

    episodes = jax.vmap(episode, in_axes=(0, 0, None, None))
    return _Programs(jax.jit(evaluate), episode, jax.jit(episodes), jax.jit(run))


def _refuse_state(state: Any) -> None:
    if not hasattr(state, "particles"):
        kind = type(state).__name__
        hint = "optimizer.init(key, design, num_particles) makes the first"
        raise InputError.of("type", f"state is a {kind}, not an optimiser's state; {hint}")


def _refuse_mask(space: DesignSpace, mask: jax.typing.ArrayLike) -> None:
    if np.shape(mask) != (space.num_parameters,):
        names = ", ".join(space.names)
        raise InputError.of(
            "size",
            f"the mask has shape {np.shape(mask)}, not ({space.num_parameters},), that is {names}",
        )


def episode_trials(
    scene: Scene, key: jax.Array, episode: jax.typing.ArrayLike, num_trials: int
) -> Trial:
    """Trials of an episode of the run with this root key, leading axis (trial,)."""
    return rollout.sample_trials(scene, stream_key(key, STREAM_TRIAL, episode), num_trials)


def stream_key(key: jax.Array, stream: int, index: jax.typing.ArrayLike = 0) -> jax.Array:
    """Derives the key of one draw from the root key, the stream and a running number."""
    return jax.random.fold_in(jax.random.fold_in(key, stream), index)
