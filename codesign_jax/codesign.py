"""Co-design: one episode, that is ask, simulate and tell, as one jitted program.

Source: Deimel, Irmisch, Wall, Brock (2017), section VI.1 and Fig. 5; the measures are those of
section VI.4.  Everything here is a pure function of arrays; files and progress are the caller's.

The front page has an optimisation in ten lines; `notebooks/` go on from there.

>>> from codesign_jax import codesign, parameters, scene
>>> space = parameters.design_space(scene.load("paper").hand, "2d")
>>> codesign.make_filter(space).sigma  # of a move, as a share of the parameter's range
0.05
>>> codesign.convergence_episode([3.0, 0.5, 1.2, 0.9])  # below 1 from then on
3
"""

import dataclasses
from collections.abc import Callable, Generator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import optimize, rollout
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine
from codesign_jax.optimize import (
    Info,
    Optimizer,
    ParticleFilter,
    Space,
    State,
    answer,
    rejection,
    translated,
)
from codesign_jax.programs import Program, shared
from codesign_jax.scene import Constants, Scene, SceneError
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, Trial

# Four ASCII letters each, as the optimiser's streams, so that no two streams of a seed meet.
STREAM_TRIAL = 0x7472696C
"""Stream of the noise of an episode's trials ("tril")."""
STREAM_SCREEN = 0x7363726E
"""Stream of the noise with which seed candidates are screened ("scrn")."""
STREAM_TEST = 0x74657374
"""Stream of the noise of the final test ("test")."""

SUCCESS_COST = 0.01
"""Mean test cost below which a particle has solved the task (section VI.4)."""
CONVERGED_COST = 1.0
"""Mean particle cost of an episode below which a run counts as converged (section VI.4)."""
SEED_COST = 2.0
"""Cost that a seed particle must exceed, so that no run starts with a solution (section VI.4)."""

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
    """

    population: jax.Array
    trials: Outcome
    selection: Info
    last: jax.Array | None = None


class FinalTest(NamedTuple):
    """How particles did in the final test.

    Attributes:
      trials: Outcomes, every array of shape (particle, trial).
      cost: Mean cost of each particle by the scene's failure rule, shape (particle,).
      success: Whether the cost is below `SUCCESS_COST`, bool, shape (particle,).
    """

    trials: Outcome
    cost: jax.Array
    success: jax.Array


@dataclasses.dataclass(frozen=True)
class _Projection:
    """`DesignSpace.project`, equal for equal spaces, so that their filters share programs."""

    space: DesignSpace

    def __call__(self, design: jax.Array) -> jax.Array:
        return self.space.project(design)


def make_filter(space: DesignSpace, *, sigma: float = 0.05, alpha: float = 0.2) -> ParticleFilter:
    """Returns the particle filter over a design space, by default with the paper's constants.

    Args:
      space: Free parameters with bounds and pressure limit.
      sigma: Standard deviation of a move as a fraction of the parameter's range.
      alpha: Cost offset of the weight 1 / (alpha + cost).
    """
    return ParticleFilter(_box(space), sigma=sigma, alpha=alpha)


def make_optimizer(name: str, space: DesignSpace) -> Optimizer:
    """Returns an optimiser over a design space; see `optimize.make_optimizer`.

    Args:
      name: One of `optimize.NAMES`.
      space: Free parameters with bounds and pressure limit.

    Raises:
      ValueError: If there is no such optimiser.
      ModuleNotFoundError: If it needs evosax, which is not installed.
    """
    return optimize.make_optimizer(name, _box(space))


def _box(space: DesignSpace) -> Space:
    return Space(np.asarray(space.low), np.asarray(space.high), _Projection(space))


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
        return program(population, key, constants)

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
    return Program(scene, program, optimizer)


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
    return Program(scene, _run(scene, engine, space, num_trials, trajectory, cost), optimizer)


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


def find_seed(
    scene: Scene,
    evaluate: EvaluateFunction,
    optimizer: Optimizer,
    key: jax.Array,
    *,
    batch: int,
    threshold: float = SEED_COST,
) -> tuple[jax.Array, float, int]:
    """Draws the particle that a run starts from by rejection sampling (section VI.4).

    Args:
      scene: The scene.
      evaluate: See `make_evaluate`.
      optimizer: Optimiser whose space is sampled.
      key: Root key of the run.
      batch: Candidates simulated at once.
      threshold: Cost above which a candidate is poor enough.

    Returns:
      The seed particle [SI units], shape (parameter,), its cost and the number of candidates drawn.

    Raises:
      RuntimeError: If no candidate is poor enough.
    """
    search = seed_search(scene, optimizer, key, batch=batch, threshold=threshold)
    return answer(search, lambda asked: evaluate(*asked))


def seed_search(
    scene: Scene,
    optimizer: Optimizer,
    key: jax.Array,
    *,
    batch: int,
    threshold: float = SEED_COST,
) -> Generator[tuple[jax.Array, jax.Array], Outcome, tuple[jax.Array, float, int]]:
    """`find_seed` as a generator: yields (population, key), and is sent their outcomes.

    Args:
      scene: The scene.
      optimizer: Optimiser whose space is sampled.
      key: Root key of the run.
      batch: Candidates of one request.
      threshold: Cost above which a candidate is poor enough.
    """
    noise = stream_key(key, STREAM_SCREEN)
    seeds, costs, drawn = yield from translated(
        rejection(key, optimizer.space, 1, threshold=threshold, batch=batch),
        lambda population: (population, noise),
        lambda outcomes: particle_cost(scene, outcomes),
    )
    return seeds[0], float(costs[0]), drawn


def final_test(
    scene: Scene,
    evaluate: EvaluateFunction,
    particles: jax.Array,
    key: jax.Array,
    *,
    num_trials: int,
    previous: Outcome | None = None,
) -> FinalTest:
    """Tests final particles on new trials, together with the trials they had already.

    The paper's test: 36 more trials in 2D, which makes 42 with the last episode's 6, and 72 more
    in 23D, which makes 78.

    Args:
      scene: The scene.
      evaluate: See `make_evaluate`; called until there are at least `num_trials` more trials, so
        that a multiple of its own number of trials gives exactly that many.
      particles: Particles [SI units], shape (particle, parameter).
      key: Root key of the run.
      num_trials: Further trials of each particle.
      previous: Outcomes that count as well, shape (particle, trial), such as the last episode's.
    """
    asked = testing(scene, particles, key, num_trials=num_trials, previous=previous)
    return answer(asked, lambda request: evaluate(*request))


def testing(
    scene: Scene,
    particles: jax.Array,
    key: jax.Array,
    *,
    num_trials: int,
    previous: Outcome | None = None,
) -> Generator[tuple[jax.Array, jax.Array], Outcome, FinalTest]:
    """`final_test` as a generator: yields (population, key), and is sent their outcomes.

    Args:
      scene: See `final_test`, as the others.
      particles: Particles [SI units], shape (particle, parameter).
      key: Root key of the run.
      num_trials: Further trials of each particle.
      previous: Outcomes that count as well.
    """
    parts = [] if previous is None else [previous]
    done, chunk = 0, 0
    while done < num_trials:
        parts.append((yield particles, stream_key(key, STREAM_TEST, chunk)))
        done, chunk = done + parts[-1].cost.shape[1], chunk + 1
    return summarize_test(scene, jax.tree.map(lambda *v: jnp.concatenate(v, axis=1), *parts))


def summarize_test(scene: Scene, trials: Outcome) -> FinalTest:
    """Returns cost and success of particles from the outcomes of their test.

    Args:
      scene: The scene.
      trials: Outcomes, every array of shape (particle, trial).
    """
    cost = particle_cost(scene, trials)
    return FinalTest(trials, cost, cost < SUCCESS_COST)


def convergence_episode(
    mean_cost: np.typing.ArrayLike, *, threshold: float = CONVERGED_COST
) -> int | None:
    """Returns the first episode from which the mean particle cost stays below the threshold.

    Args:
      mean_cost: Mean particle cost of each episode, shape (episode,).
      threshold: The paper's c_convergence.

    Returns:
      Zero-based episode, or None if the last episode is not below the threshold.
    """
    above = np.flatnonzero(~(np.asarray(mean_cost) < threshold))
    first = int(above[-1]) + 1 if above.size else 0
    return first if first < np.size(mean_cost) else None
