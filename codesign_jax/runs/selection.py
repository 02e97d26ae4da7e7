"""The design that a run found: its final particle that tested best, and one grasp of it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.codesign import episode_trials
from codesign_jax.cost import particle_cost
from codesign_jax.judge.cases import Case
from codesign_jax.judge.sentences import Judged
from codesign_jax.judge.stress import Stress
from codesign_jax.judge.verdict import failure_counts
from codesign_jax.runs.reading import Tell, load_record, read_run
from codesign_jax.runs.record import Record
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import design_space
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

    def judged(self, scene: Scene, stress: Stress | None) -> Judged:
        """The trials that chose the design, where there are no fresh ones to judge it by."""
        grasps = "grasps of " + ("its final test" if self.tested else "its last episode")
        return Judged(scene, self.outcomes, None, grasps, stress)


def refuse_other_policy(policy: str, named: str | None) -> None:
    """Refuses to import a run's policy that the command line does not name, or to leave it out."""
    if policy != (named or ""):
        given = named or "not given"
        made = policy or "none"
        raise InputError.of("conflict", f"--policy: {given}; the policy of the run is {made}")


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
        raise InputError.of(
            "size",
            f"--set leaves {space.num_parameters} parameters free in preset "
            f"{settings.preset!r}; the run's designs have {len(chosen.design)}",
        )
    return Case(scene, space, chosen.design, engine or settings.engine, settings.policy)


def read_record(folder: Path, *, tell: Tell | None = None) -> Record:
    """Reads a run's newest whole checkpoint."""
    record = load_record(folder, tell=tell)
    if record is None or record.done == 0:
        raise InputError.of("missing", f"run {folder} has no finished episode yet")
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
