"""The one grasp that `render` and `replay` show: of a design, or a row of a run's trials.csv."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout, runs
from codesign_jax.commands import common
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import GraspFlags
from codesign_jax.engines.base import recording, tells_forces
from codesign_jax.judge import verdict
from codesign_jax.judge.cases import Case
from codesign_jax.runs import selection
from codesign_jax.scene import scene_files
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Trial

if TYPE_CHECKING:
    from codesign_jax.report.replay import Replay


class PlannedGrasp(NamedTuple):
    """A grasp to simulate."""

    case: Case  # scene, design and engine
    trial: Trial  # object and noise, no leading axis
    text: str  # what grasp it is, in words
    recorded: str | None  # how it ended in its run, in words; None if it is of no run
    recorded_at: str = ""  # step and links of the run's search, if they are others


def find(options: GraspFlags) -> PlannedGrasp:
    """The grasp that the flags name; simulates nothing."""
    numbers = {"--episode": options.episode, "--particle": options.particle}
    numbers |= {"--trial": options.trial}
    flags = " and ".join(flag for flag, value in numbers.items() if value is not None)
    if flags and not options.run_folder:
        raise InputError.of(
            "missing", f"{flags}: numbers of a run's trials.csv, so --run must say of which"
        )
    if options.trial is not None and options.object is not None:
        raise InputError.of(
            "conflict", "--trial and --object exclude each other: a trial has its object"
        )
    searched = _search_accuracy(options)
    if flags and options.accuracy is None and searched:
        # What trials.csv has was simulated at the accuracy of the search.
        options = dataclasses.replace(options, accuracy=str(searched))
    case = find_case(options)
    common.refuse(common.engine_problems(case.engine))
    if options.run_folder is None:
        return nominal(case, options.object or 0)
    return _of_run(case, options, options.run_folder)


def _search_accuracy(options: GraspFlags) -> Path | None:
    """The accuracy of the run's search, where that is not its scene's."""
    if options.run_folder is None:
        return None
    settings = runs.read_run(options.run_folder)[1]
    if settings.search_accuracy == runs.SCENE_ACCURACY:
        return None
    return options.run_folder / scene_files.SEARCH


def _of_run(case: Case, options: GraspFlags, folder: Path) -> PlannedGrasp:
    if options.objects is not None and options.object is None:
        raise InputError.of(
            "missing", "--objects replaces the run's: --object must say which one to grasp"
        )
    numbers = {"episode": options.episode, "particle": options.particle, "trial": options.trial}
    record = selection.read_record(folder, tell=lambda text: None)  # `find_case` has said it
    grasp = selection.find_grasp(runs.read_run(folder)[0], record, **numbers)
    case = case._replace(design=grasp.design)
    if options.object is not None:
        return nominal(case, options.object)
    name = case.scene.objects.object[int(grasp.trial.shape)].name
    episode, particle, trial = grasp.place
    text = f"episode {episode}, particle {particle}, trial {trial}: object {name}"
    searched = runs.read_search_scene(folder).discretization
    other = searched != case.scene.discretization
    at = f" (steps of {1e3 * searched.timestep:g} ms, {searched.links} links)" if other else ""
    return PlannedGrasp(case, grasp.trial, text, verdict.ending(grasp.outcome), at)


def nominal(case: Case, shape: int | str = 0) -> PlannedGrasp:
    """A grasp of an object without noise."""
    trial = jax.tree.map(np.asarray, rollout.nominal_trial(case.scene, shape))
    name = case.scene.objects.object[int(trial.shape)].name
    return PlannedGrasp(case, trial, f"object {name}, without noise", None)


def simulate(planned: PlannedGrasp, *, forces: bool = False) -> "Replay":
    """Simulates the grasp and keeps its trajectory, with the forces where an engine tells them."""
    from codesign_jax.report import animation

    case = planned.case
    params = case.space.params(jnp.asarray(case.design, jnp.float32))
    trials = jax.tree.map(lambda v: v[None], planned.trial)
    engine = case.make_engine()
    if forces and tells_forces(engine):
        engine = recording(engine, touch=True)
    return animation.replay(case.scene, engine, params, trials)[0]


def description(planned: PlannedGrasp, shown: "Replay") -> list[str]:
    """Lines that say which grasp it is and how it ended."""
    again = verdict.ending(shown.outcome)
    before = f"in the run{planned.recorded_at}: {planned.recorded}"
    ending = f"{before}; here: {again}" if planned.recorded else again
    design = runs.describe(planned.case.space, planned.case.design)
    lines = [design, f"{planned.text}; {ending}"]
    if planned.recorded not in (None, again):
        lines.append(
            "The two differ: contact is chaotic, and a batch of another size, another machine or "
            "other settings lead elsewhere."
        )
    return lines
