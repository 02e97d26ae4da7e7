"""All strategies and runs of an experiment advance together, one episode a step.

Masks and keys are data.  Run r of every strategy has the root key `jax.random.key(seed + r)` and
draws from it as `codesign optimize --seed` does, so that one run of the batch is that command's.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, rollout
from codesign_jax.codesign import STREAM_SCREEN, STREAM_TEST, STREAM_TRIAL, stream_key
from codesign_jax.cost import particle_cost
from codesign_jax.optimize import ParticleFilter, State, candidates
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Trial, failed
from scripts.experiments.plan import Strategies
from scripts.experiments.worlds import Worlds
from scripts.shared.record import Arrays, pack

MAX_SCREENS = 100
"""Batches of seed candidates after which the search is given up."""


class _Programs(NamedTuple):
    """What is compiled beside the simulation; the leading axes are (strategy, run)."""

    move: Callable[..., Any]
    select: Callable[..., Any]
    noise: Callable[..., Any]
    screen: Callable[..., Any]


class Batch:
    """The runs of an experiment; `step` advances all of them by an episode or a test round.

    Attributes:
      steps: Episodes and rounds of the final test.
    """

    def __init__(
        self,
        plan: Strategies,
        scene: Scene,
        worlds: Worlds,
        optimizer: ParticleFilter,
        *,
        seed: int = 0,
    ):
        """Takes the experiment and what simulates it.

        Args:
          plan: The experiment.
          scene: The scene.
          worlds: Simulates the worlds.
          optimizer: Particle filter over the space of `worlds`.
          seed: Seed of run 0; run r has `seed + r`.
        """
        self.plan, self.scene, self.worlds = plan, scene, worlds
        self.optimizer, self.steps = optimizer, plan.episodes + plan.rounds
        self.masks = plan.masks(worlds.space)
        self.keys = jax.vmap(jax.random.key)(jnp.arange(seed, seed + plan.runs))
        self._programs = _compile(scene, optimizer, plan.trials)

    def start(self) -> Arrays:
        """Finds the seed particles and returns the record before the first episode.

        Raises:
          RuntimeError: If a run finds no particle that is poor enough.
        """
        before = self.worlds.grasps
        seeds, cost, drawn = self._seeds()
        screened = np.int64(self.worlds.grasps - before)
        return self.blank(seeds[None, :, None]) | {
            "screened": screened,
            "seeds": np.asarray(seeds, np.float32),
            "seed_cost": cost,
            "seed_candidates": drawn,
        }

    def blank(self, particles: np.ndarray) -> Arrays:
        """Returns a record before the first episode, without what was known of the seeds.

        Args:
          particles: First particles [SI units], which broadcast to the shape (strategy, run,
            particle, parameter).
        """
        return self.blank_of(self.plan, self.worlds.space.num_parameters, particles)

    @staticmethod
    def blank_of(plan: Strategies, num_parameters: int, particles: np.ndarray) -> Arrays:
        """`blank` of a plan and a number of parameters."""
        p = plan
        s, r, n, e, t = len(p.strategies), p.runs, p.particles, p.episodes, p.trials
        shape = (s, r, n, num_parameters)
        return {
            "step": np.int64(0),
            "particles": np.array(np.broadcast_to(particles, shape), np.float32),
            "cost": np.zeros((s, r, e, n), np.float32),
            "lost_step": np.zeros((s, r, e, n, t), np.uint16),
            "status": np.zeros((s, r, e, n, t), np.uint8),
            "test_lost_step": np.zeros((s, r, n, t + p.test_trials), np.uint16),
            "test_status": np.zeros((s, r, n, t + p.test_trials), np.uint8),
            "test_cost": np.zeros((s, r, n, t + p.test_trials), np.float32),
        }

    def step(self, record: Arrays) -> str:
        """Advances the record by one episode or one round of the final test.

        Returns:
          What happened, in words.
        """
        step = int(record["step"])
        line = self._episode(record, step) if step < self.plan.episodes else self._test(record)
        record["step"] = np.int64(step + 1)
        return line

    def trials(self, episode: int) -> Trial:
        """Trials of an episode, with leading axes (run, trial): a run's particles share them."""
        return self._programs.noise(stream_keys(self.keys, STREAM_TRIAL, episode))

    def grasps(self, step: int) -> int:
        """Grasps of one step."""
        return self.plan.worlds

    def _episode(self, record: Arrays, e: int) -> str:
        episode = jnp.int32(e)
        population = self._programs.move(
            record["particles"], episode, self.keys, self.masks[:, :, e]
        )
        outcome = self.worlds.evaluate(np.asarray(population), self.trials(e))
        new, cost, ancestors = jax.tree.map(
            np.asarray,
            self._programs.select(record["particles"], episode, self.keys, population, outcome),
        )
        packed = pack(self.scene, outcome)
        record["particles"], record["cost"][:, :, e] = new, cost
        record["lost_step"][:, :, e], record["status"][:, :, e] = packed
        if e == self.plan.episodes - 1:
            self._keep_last(record, outcome, ancestors)
        means = zip(self.plan.strategies, cost.mean((1, 2)), strict=True)
        count = int(failed(outcome.status).sum())
        text = "  ".join(f"{name} {mean:.3f}" for name, mean in means)
        return f"mean cost: {text}  failed {count}"

    def _keep_last(self, record: Arrays, outcome: Outcome, ancestors: np.ndarray) -> None:
        """The last episode's outcomes of the final particles count in their test."""
        kept = jax.tree.map(lambda v: np.take_along_axis(v, ancestors[..., None], axis=2), outcome)
        self._write_test(record, kept, 0)

    def _test(self, record: Arrays) -> str:
        c = int(record["step"]) - self.plan.episodes
        # As `evaluate_by` derives them, which is what `codesign optimize` tests with.
        keys = stream_keys(stream_keys(self.keys, STREAM_TEST, c), STREAM_TRIAL)
        outcome = self.worlds.evaluate(record["particles"], self._programs.noise(keys))
        self._write_test(record, outcome, 1 + c)
        return f"test round {c + 1}/{self.plan.rounds}"

    def _write_test(self, record: Arrays, outcome: Outcome, part: int) -> None:
        t = self.plan.trials
        columns = slice(part * t, (part + 1) * t)
        lost_step, status = pack(self.scene, outcome)
        record["test_lost_step"][..., columns] = lost_step
        record["test_status"][..., columns] = status
        record["test_cost"][..., columns] = outcome.cost

    def _seeds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rejection sampling of all runs at once: each takes its first poor enough candidate.

        Returns:
          Seeds, shape (run, parameter), their costs and the candidates each run drew, shape (run,).
        """
        p = self.plan
        # As many as fill a call of the simulation: the number does not change who is accepted.
        count = max(1, self.worlds.chunk // (p.runs * p.trials))
        keys = stream_keys(stream_keys(self.keys, STREAM_SCREEN), STREAM_TRIAL)
        trials = self._programs.noise(keys)
        seeds = np.zeros((p.runs, self.worlds.space.num_parameters), np.float32)
        cost, drawn = np.zeros(p.runs, np.float32), np.zeros(p.runs, np.int32)
        for start in range(0, count * MAX_SCREENS, count):
            population = np.asarray(
                self._programs.screen(self.keys, np.arange(start, start + count))
            )
            outcome = self.worlds.evaluate(population[None], trials)
            costs = np.asarray(particle_cost(self.scene, outcome))[0]
            poor = np.isfinite(costs) & (costs > codesign.SEED_COST)
            for r in np.flatnonzero((drawn == 0) & poor.any(1)):
                chosen = int(np.argmax(poor[r]))
                seeds[r], cost[r] = population[r, chosen], costs[r, chosen]
                drawn[r] = start + chosen + 1
            if (drawn > 0).all():
                return seeds, cost, drawn
        missing = np.flatnonzero(drawn == 0).tolist()
        raise RuntimeError(f"runs {missing}: no seed particle costs more than {codesign.SEED_COST}")


def stream_keys(keys: jax.Array, stream: int, index: int = 0) -> jax.Array:
    """`codesign.stream_key` of every run's key, shape (run,)."""
    return jax.vmap(lambda key: stream_key(key, stream, index))(keys)


def _compile(scene: Scene, optimizer: ParticleFilter, num_trials: int) -> _Programs:
    def ask(particles, episode, key, mask):
        return optimizer.ask(State(particles, episode, key), mask)

    def tell(particles, episode, key, population, outcome):
        cost = particle_cost(scene, outcome)
        new, info = optimizer.tell(State(particles, episode, key), population, cost)
        return new.particles, cost, info.ancestors

    def over_runs(function, strategy_axes, run_axes):
        return jax.jit(jax.vmap(jax.vmap(function, run_axes), strategy_axes))

    def noise(keys) -> Trial:
        return jax.vmap(lambda key: rollout.sample_trials(scene, key, num_trials))(keys)

    def screen(keys, indices):
        return jax.vmap(lambda key: candidates(key, optimizer.space, indices))(keys)

    return _Programs(
        move=over_runs(ask, (0, None, None, 0), (0, None, 0, 0)),
        select=over_runs(tell, (0, None, None, 0, 0), (0, None, 0, 0, 0)),
        noise=jax.jit(noise),
        screen=jax.jit(screen),
    )
