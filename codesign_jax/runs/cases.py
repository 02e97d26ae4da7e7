"""The design that a run found: its final particle that tested best, and one grasp of it."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import control, rollout, user_code
from codesign_jax.codesign import episode_trials
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine, make_engine
from codesign_jax.policy import ControlLoop
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.runs import scene_files
from codesign_jax.runs.interrupts import interruptible
from codesign_jax.runs.reading import Tell, load_record, read_run
from codesign_jax.runs.record import Record
from codesign_jax.runs.tables import failure_counts, status_names
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.scene.schema import InputError, range_problem
from codesign_jax.types import Outcome, Trial, failed


class Grasp(NamedTuple):
    """One trial of one particle of a run."""

    design: np.ndarray  # the particle as simulated [SI units], shape (parameter,)
    trial: Trial  # object and noise, no leading axis
    outcome: Outcome  # how it ended in the run, numbers
    # Number of the episode, from 1, and indices of particle and trial, as in trials.csv
    place: tuple[int, int, int]


class Chosen(NamedTuple):
    """The design that a run found."""

    design: np.ndarray  # the design [SI units], shape (parameter,)
    particle: int  # its index among the final particles, or in its episode without a test
    cost: float  # its mean cost by the scene's rule for failed trials
    outcomes: Outcome  # of its trials, arrays of shape (trial,)
    tested: bool  # whether they are those of the final test, or its episode's
    row: int  # its index in its episode's population
    episode: int  # index of an episode that simulated it: the last, where that did


class Departure(NamedTuple):
    """Where commands differ from those of the key frames, by trial."""

    time: Any  # when they first do [s], inf if they never do, shape (trial,)
    lower: Any  # most that a pressure is lowered, at most 0 [Pa], shape (trial,)
    higher: Any  # most that one is raised [Pa], shape (trial,)
    place: Any  # farthest that the arm is from its place [m], shape (trial,)
    turn: Any  # largest angle of the arm's joints from theirs [rad], shape (trial,)

    def __str__(self) -> str:
        """In words, such as "left the key frames in 3 of 20 grasps, first after 1.3 s (median)"."""
        departed = np.isfinite(self.time)
        if not departed.any():
            return f"commanded nothing but the key frames in {departed.size} grasps"
        low, high = (1e-3 * f(v) for f, v in ((np.min, self.lower), (np.max, self.higher)))
        return (
            f"left the key frames in {departed.sum()} of {departed.size} grasps, first after "
            f"{np.median(self.time[departed]):.3g} s (median); pressures by {low:.3g} to "
            f"{high:+.3g} kPa, the arm by up to {1e3 * np.max(self.place):.3g} mm and "
            f"{np.degrees(np.max(self.turn)):.3g}°"
        )


class Case(NamedTuple):
    """A design with what simulates it."""

    scene: Scene
    space: DesignSpace
    design: np.ndarray  # the design [SI units], shape (parameter,)
    engine: str  # name of the engine
    # Name of the user's own policy that commands the hand; empty for the key frames alone
    policy: str = ""

    @property
    def commanded(self) -> str:
        """Names of engine and policy."""
        return f"{self.engine} {self.policy}".strip()

    def make_engine(self, scene: Scene | None = None) -> Engine:
        """The engine of the scene, or of one that differs from it, with the policy if any."""
        scene = scene or self.scene
        engine = make_engine(self.engine, scene)
        if not self.policy:
            return engine
        return ControlLoop(engine, user_code.make_policy(self.policy, scene)[0])

    def simulate(self, trials: int, key: jax.Array, first: int = 0) -> Outcome:
        """Outcomes in trials that depend on objects and key alone, arrays of shape (trial,).

        Args:
          trials: Number of trials.
          key: Typed key.
          first: Index of the first of them, see `rollout.sample_trials`: more of the same trials
            are the same program.
        """
        return self.observe(trials, key, first)[0]

    def observe(
        self, trials: int, key: jax.Array, first: int = 0
    ) -> tuple[Outcome, Departure | None]:
        """As `simulate`, and where a policy left the key frames; None without a policy."""
        design = jnp.asarray(self.design, jnp.float32)
        self.space.check(design[None])
        run = SceneProgram(self.scene, _in_trials(self.make_engine(), self.space, trials))
        return jax.tree.map(np.asarray, interruptible(run, design, (key, jnp.asarray(first))))

    def digest(self, *numbers: int) -> str:
        """Digest of what determines outcomes, beside code, versions and device."""
        return scene_files.digest(self.scene, self.commanded, self.design, *numbers)


@shared
def _in_trials(engine: Engine, space: DesignSpace, num_trials: int) -> Callable:
    def simulated(
        design: jax.Array, noise: tuple[jax.Array, jax.Array], scene: Scene
    ) -> tuple[Outcome, Departure | None]:
        trials = rollout.sample_trials(scene, noise[0], num_trials, noise[1])
        hand = jax.tree.map(lambda v: v[None], space.params(design))
        worlds = rollout.crossed(scene, hand, trials)
        outcome, trace = rollout.simulate(worlds[0], engine, *worlds[1:])
        if trace.ctrl is None:
            return outcome, None
        planned = jax.vmap(partial(control.commands, scene))(*worlds[1:])
        return outcome, departure(scene, outcome, trace.ctrl, planned)

    return simulated


LEAST = 1e-5
"""Difference of a command, in bar, metres or radians, from which on it is one: rounding is less."""


def departure(scene: Scene, outcomes: Outcome, ctrl: jax.Array, planned: jax.Array) -> Departure:
    """Where commands of grasps leave the key frames, until each grasp was decided.

    Args:
      scene: The scene.
      outcomes: How the grasps ended, arrays of shape (trial,).
      ctrl: Commands, shape (trial, time, 6 + finger): the arm's places [m] and angles [rad], and
        pressures [Pa].
      planned: Those of the key frames, of the same shape.
    """
    steps = ctrl.shape[1]
    h = scene.discretization.timestep
    end = jnp.where(outcomes.bad_step < 0, steps, outcomes.bad_step)
    end = jnp.minimum(
        end, jnp.where(jnp.isfinite(outcomes.lost_time), outcomes.lost_time / h, steps)
    )
    counts = np.arange(steps) < end[:, None]
    apart = jnp.where(counts[..., None], ctrl - planned, 0.0)
    distance = jnp.linalg.norm(apart[..., :3], axis=-1)
    turn = jnp.abs(apart[..., 3:6]).max(-1)
    pressure = apart[..., 6:]
    size = jnp.maximum(jnp.maximum(distance, turn), 1e-5 * jnp.abs(pressure).max(-1))
    departs = size > LEAST
    first = jnp.where(departs.any(1), departs.argmax(1) * h, jnp.inf)
    lower = jnp.minimum(pressure, 0).min((1, 2))
    higher = jnp.maximum(pressure, 0).max((1, 2))
    return Departure(first, lower, higher, distance.max(1), turn.max(1))


def refuse_other_policy(policy: str, named: str | None) -> None:
    """Refuses to import a run's policy that the command line does not name, or to leave it out."""
    if policy != (named or ""):
        policy_words = f"--policy {policy}" if policy else "no policy"
        raise InputError(
            [f"the run was made with {policy_words}; --policy is {named or 'not given'}"]
        )


def case_of_run(
    folder: Path,
    *,
    objects: str | None = None,
    accuracy: str | None = None,
    overrides: Mapping[Any, Any] | None = None,
    engine: str | None = None,
    tell: Tell = lambda text: None,
) -> Case:
    """The design that a run found; objects, accuracy, values and engine may replace the run's."""
    replacements = {"object_set": objects, "accuracy": accuracy, "overrides": overrides}
    scene, settings = read_run(folder, **replacements)
    # By the run's own rule for failed trials, whatever the overrides say.
    chosen = choose(read_run(folder)[0], read_record(folder, tell=tell))
    if problem := doubt(chosen):
        tell(problem)
    space = design_space(scene.hand, settings.preset)
    if len(chosen.design) != space.num_parameters:
        raise InputError(
            [
                f"--set leaves {space.num_parameters} parameters free in preset "
                f"{settings.preset!r}; the run's designs have {len(chosen.design)}"
            ]
        )
    return Case(scene, space, chosen.design, engine or settings.engine, settings.policy)


def read_record(folder: Path, *, tell: Tell | None = None) -> Record:
    """Reads a run's newest whole checkpoint."""
    record = load_record(folder, tell=tell)
    if record is None or record.done == 0:
        raise InputError([f"run {folder} has no finished episode yet"])
    return record


def choose(scene: Scene, record: Record) -> Chosen:
    """The final particle that tested best.

    Without a test the last episode's best, or the run's where the optimiser keeps the best so far.
    """
    history = record.history
    if record.test is None:
        episode = record.done - 1
        row = int(history.cost[record.done - 1].argmin())
        if (history.ancestors[: record.done] < 0).any():
            episode, row = _place(record, 0)
        trials = jax.tree.map(lambda v: v[episode, row], history.outcomes)
        cost = float(history.cost[episode, row])
        return Chosen(history.population[episode, row], row, cost, trials, False, row, episode)
    cost = np.asarray(particle_cost(scene, record.test))
    best = int(cost.argmin())
    trials = jax.tree.map(lambda v: np.asarray(v)[best], record.test)
    design = np.asarray(record.state.particles)[best]
    episode, row = _place(record, best)
    return Chosen(design, best, float(cost[best]), trials, True, row, episode)


def doubt(chosen: Chosen) -> str:
    """Why the design should not be called the best of its run, in words; nothing if it may be."""
    status = np.asarray(chosen.outcomes.status)
    if not failed(status).all():
        return ""
    return (
        f"every trial of the run's chosen design failed ({failure_counts(status)}), so that none "
        "of its designs is known to grasp anything"
    )


def _place(record: Record, particle: int) -> tuple[int, int]:
    last = record.done - 1
    row = int(record.history.ancestors[last, particle])
    if row >= 0:
        return last, row
    # One of the best so far: the last earlier episode that simulated this very design.
    design = np.asarray(record.state.particles)[particle]
    same = (record.history.population[:last] == design).all(-1)
    if not same.any():  # against `optimize.Info.ancestors`, as an optimiser of the user's may do
        return last, int(record.history.cost[last].argmin())
    episode, row = np.argwhere(same)[-1]
    return int(episode), int(row)


def find_grasp(
    scene: Scene,
    record: Record,
    *,
    episode: int | None = None,
    particle: int | None = None,
    trial: int | None = None,
) -> Grasp:
    """A grasp of a run, by the numbers of trials.csv."""
    history = record.history
    _, particles, trials = history.outcomes.cost.shape
    numbers = (
        ("--episode", episode, 1, record.done),
        ("--particle", particle, 0, particles - 1),
        ("--trial", trial, 0, trials - 1),
    )
    checks = [range_problem(n, v, "", low, high) for n, v, low, high in numbers if v is not None]
    if problems := [problem for problem in checks if problem]:
        raise InputError(problems)
    chosen = choose(scene, record)
    last = record.done - 1 if particle is not None else chosen.episode
    e = last if episode is None else episode - 1
    if particle is None:
        particle = chosen.row if e == chosen.episode else int(history.cost[e].argmin())
    of_particle = jax.tree.map(lambda v: v[e, particle], history.outcomes)
    if trial is None:
        trial = int(np.where(failed(of_particle.status), np.inf, of_particle.cost).argmin())
    # One program, not one an operation.
    noise = jax.jit(episode_trials, static_argnums=(0, 3))(scene, record.state.key, e, trials)
    return Grasp(
        history.population[e, particle],
        jax.tree.map(lambda v: np.asarray(v)[trial], noise),
        jax.tree.map(lambda v: v[trial], of_particle),
        (e + 1, particle, trial),
    )


def ending(outcome: Outcome) -> str:
    """How a trial ended, in words; its entries are numbers."""
    if failed(int(outcome.status)):
        return f"failed ({status_names(int(outcome.status))})"
    lost = float(outcome.lost_time)
    return f"object lost at {lost:.2f} s" if np.isfinite(lost) else "object kept"
