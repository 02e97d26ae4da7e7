"""Programs: the evaluation of a population, one episode, and a whole optimisation."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine
from codesign_jax.optimize import Info, Optimizer, ParticleFilter, State
from codesign_jax.programs import Program, shared
from codesign_jax.scene import Constants, Scene, SceneError
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, Trial

# Four ASCII letters, as the optimiser's streams and `experiment`'s, so that no two streams of a
# seed meet.
STREAM_TRIAL = 0x7472696C
"""Stream of the noise of an episode's trials ("tril")."""

EpisodeFunction = Callable[..., tuple[State, "EpisodeInfo"]]
EvaluateFunction = Callable[..., Outcome]


class EpisodeInfo(NamedTuple):
    """What one episode reports.

    Attributes:
      population: Particles as simulated [SI units], shape (particle, parameter).
      trials: Cost, status, time of loss and first bad step, each of shape (particle, trial).
      selection: Particle costs, and weights and ancestors of a resampling; see `optimize.Info`.
      last: States at which the worlds ended, failed ones frozen at their last good one, shape
        (particle, trial, nq + nv), or None if the engine does not tell.
      drawn: The trials themselves, leading axis (trial,), of episodes that `batch.Batch` ran.
    """

    population: jax.Array
    trials: Outcome
    selection: Info
    last: jax.Array | None = None
    drawn: Trial | None = None


def make_evaluate(
    scene: Scene,
    engine: Engine,
    space: DesignSpace,
    num_trials: int,
    *,
    trajectory: bool | None = None,
    cost: rollout.CostFunction | None = None,
) -> EvaluateFunction:
    """Returns a function (population, key) -> outcomes of shape (particle, trial); one program.

    All particles meet the same trials: common random numbers compare designs, not luck.  As a third
    argument it takes `Constants` instead of the scene's, leaves of shape () or (trial,): neither
    other numbers nor another scene of the same structure compile anything, see `programs`.

    Args:
      scene: The scene.
      engine: Engine that simulates.
      space: Design space of the population.
      num_trials: Trials of each particle.
      trajectory: As in `rollout.simulate`.
      cost: As in `rollout.simulate`.
    """
    program = Program(scene, _evaluation(scene, engine, space, num_trials, trajectory, cost))

    def evaluate(
        population: jax.Array, key: jax.Array, constants: Constants | None = None
    ) -> Outcome:
        space.refuse_population(population)
        space.refuse_unit_slips(population)
        return program(jnp.asarray(population), key, constants)

    return evaluate


@shared
def _evaluation(
    scene: Scene,
    engine: Engine,
    space: DesignSpace,
    num_trials: int,
    trajectory: bool | None,
    cost: rollout.CostFunction | None,
) -> Callable[..., Outcome]:
    def simulate(population: jax.Array, key: jax.Array, constants: Constants) -> Outcome:
        trials = rollout.sample_trials(scene, key, num_trials, constants=constants)
        hands = jax.vmap(space.params)(population)
        return rollout.evaluate(
            scene, engine, hands, trials, trajectory=trajectory, cost=cost, constants=constants
        )

    return simulate


def make_episode(
    scene: Scene,
    engine: Engine,
    space: DesignSpace,
    optimizer: Optimizer,
    num_trials: int,
    *,
    trajectory: bool | None = None,
    cost: rollout.CostFunction | None = None,
) -> Program:
    """Returns the jitted function (state, mask) -> (state, info) that runs one episode.

    The mask, bool of shape (parameter,), is data: every schedule shares one compile, and so does
    every scene of one structure, see `programs`.  An optional third argument are `Constants`
    instead of the scene's, leaves of shape () or (trial,) but for `cost.maximum`, which is one
    number.  The noise of
    trial t derives from (root key, stream, episode, t), so that it depends neither on the number
    of particles nor on where a run was resumed.

    Args:
      scene: The scene.
      engine: Engine that simulates.
      space: Design space of the particles.
      optimizer: Optimiser over the same space, see `optimize.Optimizer`.
      num_trials: Trials of each particle in an episode.
      trajectory: As in `rollout.simulate`.
      cost: As in `rollout.simulate`.
    """
    program = _episode(scene, engine, space, num_trials, trajectory, cost)
    return _joined(scene, program, optimizer, cost)


def _joined(
    scene: Scene, program: Callable, optimizer: Optimizer, cost: rollout.CostFunction | None
) -> Program:
    """A program with its optimiser, which warns where that does not see costs of one's own."""
    weighs = cost is not None and isinstance(optimizer, ParticleFilter)
    return (_Weighing if weighs else Program)(scene, program, optimizer)


class _Weighing(Program):
    """A program whose costs of one's own a particle filter weighs: negative ones count as 0."""

    def __call__(self, first: Any, second: Any, constants: Constants | None = None) -> Any:
        """As of `Program`; a warning if a particle's cost is negative, but for traced ones."""
        found = super().__call__(first, second, constants)
        costs = found[1].selection.cost
        if not isinstance(costs, jax.core.Tracer) and (np.asarray(costs) < 0).any():
            warnings.warn(
                "a cost of your own is negative: the particle filter weighs by 1 / (alpha + cost) "
                "and takes negative costs for 0, so that it does not tell them apart; add a "
                "constant, or take an optimiser that compares, such as cma-es",
                stacklevel=2,
            )
        return found


@shared
def _episode(
    scene: Scene,
    engine: Engine,
    space: DesignSpace,
    num_trials: int,
    trajectory: bool | None,
    cost: rollout.CostFunction | None,
) -> EpisodeFunction:
    def episode(
        state: State,
        mask: jax.typing.ArrayLike,
        constants: Constants,
        optimizer: Optimizer,
    ) -> tuple[State, EpisodeInfo]:
        _refuse_mask(space, mask)
        space.refuse_population(state.particles)
        population = optimizer.ask(state, mask)
        noise = episode_trials(scene, state.key, state.episode, num_trials, constants=constants)
        hands = jax.vmap(space.params)(population)
        trials, last = rollout.evaluate_to_end(
            scene, engine, hands, noise, trajectory=trajectory, cost=cost, constants=constants
        )
        costs = particle_cost(scene.with_constants(constants), trials)
        new, selection = optimizer.tell(state, population, costs, mask)
        return new, EpisodeInfo(population, trials, selection, last)

    return episode


def _refuse_mask(space: DesignSpace, mask: jax.typing.ArrayLike) -> None:
    """Refuses a mask that is not one of the space's parameters.

    Raises:
      SceneError: If its shape is another one.
    """
    if np.shape(mask) != (space.num_parameters,):
        names = ", ".join(space.names)
        raise SceneError(
            [f"the mask has shape {np.shape(mask)}, not ({space.num_parameters},), that is {names}"]
        )


def make_run(
    scene: Scene,
    engine: Engine,
    space: DesignSpace,
    optimizer: Optimizer,
    num_trials: int,
    *,
    trajectory: bool | None = None,
    cost: rollout.CostFunction | None = None,
) -> Program:
    """Returns the jitted function (state, masks, constants) -> (state, info) of a whole run.

    The loop over the episodes is a `jax.lax.scan`: a loop in Python over `make_episode`'s function
    without a way to stop in between. XLA rounds the model fields of the two programs, and of
    batches of other sizes, differently in the last bit.  The masks, one for each episode,
    have shape (episode, parameter), and the info's arrays get a leading axis (episode,).
    `jax.vmap` over the state runs many seeds in one batch, see `optimize.State`, and over constants
    (`Scene.constants`, by default the scene's own) many worlds' physics.

    Args:
      scene: The scene.
      engine: Engine that simulates; with `jax.vmap` it has to be one that composes, as the default.
      space: Design space of the particles.
      optimizer: Optimiser over the same space, see `optimize.Optimizer`.
      num_trials: Trials of each particle in an episode.
      trajectory: As in `rollout.simulate`.
      cost: As in `rollout.simulate`.
    """
    program = _run(scene, engine, space, num_trials, trajectory, cost)
    return _joined(scene, program, optimizer, cost)


@shared
def _run(scene: Scene, *how: Any) -> EpisodeFunction:
    episode = _episode(scene, *how)

    def run(
        state: State,
        masks: jax.typing.ArrayLike,
        constants: Constants,
        optimizer: Optimizer,
    ) -> tuple[State, EpisodeInfo]:
        def one(state: State, mask: jax.Array) -> tuple[State, EpisodeInfo]:
            return episode(state, mask, constants, optimizer)

        return jax.lax.scan(one, state, jnp.asarray(masks))

    return run


def episode_trials(
    scene: Scene,
    key: jax.Array,
    episode: jax.typing.ArrayLike,
    num_trials: int,
    *,
    constants: Constants | None = None,
) -> Trial:
    """Trials of an episode of the run with this root key, leading axis (trial,)."""
    own = stream_key(key, STREAM_TRIAL, episode)
    return rollout.sample_trials(scene, own, num_trials, constants=constants)


def evaluate_by(episode: EpisodeFunction, optimizer: Optimizer) -> EvaluateFunction:
    """Returns an evaluation (population, key) -> outcomes that uses an episode's own program.

    With every parameter closed nothing moves, so that seeds and final particles are simulated
    without a second compile.

    Args:
      episode: See `make_episode`; works for as many particles as it was compiled for.
      optimizer: The episode's optimiser.
    """

    def evaluate(population: jax.Array, key: jax.Array) -> Outcome:
        return episode(*closed(optimizer, population, key))[1].trials

    return evaluate


def closed(optimizer: Optimizer, population: jax.Array, key: jax.Array) -> tuple[State, np.ndarray]:
    """State and mask of an episode that moves nothing: it simulates a population as it is.

    Args:
      optimizer: The episode's optimiser.
      population: Particles [SI units], shape (particle, parameter).
      key: Key from which the noise of the trials derives.
    """
    state = optimizer.init(key, population[0], len(population))
    mask = np.zeros(np.shape(optimizer.space.low), bool)
    return state._replace(particles=jnp.asarray(population)), mask


def stream_key(key: jax.Array, stream: int, index: jax.typing.ArrayLike = 0) -> jax.Array:
    """Derives the key of one draw from the root key, the stream and a running number."""
    return jax.random.fold_in(jax.random.fold_in(key, stream), index)
