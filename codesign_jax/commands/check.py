"""`codesign check`: how fast and how exact a scene is on this machine, by simulating it."""

import dataclasses
import importlib.metadata
import os
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import optimize, preflight, runs, sampling, user_code
from codesign_jax.commands import common
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Check
from codesign_jax.engines import Engine
from codesign_jax.interrupts import interruptible
from codesign_jax.judge import fresh_trials, verdict
from codesign_jax.judge.cases import Case
from codesign_jax.runs import Settings, reference, selection
from codesign_jax.runs.progress import Busy, duration
from codesign_jax.scene import Scene, with_accuracy
from codesign_jax.scene.schema import Problem
from codesign_jax.statistics import wilson
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome, Trial, failed

_ROUNDS = 4
"""Batches of random designs of which a mixed sample takes the best."""
_LEAST = 4
"""Designs that are simulated at accuracy reference, however long that takes."""


class Measured(NamedTuple):
    """A batch of grasps."""

    scene: Scene  # what was simulated
    outcomes: Outcome  # arrays of shape (design, trial)
    seconds: float  # wall time of the batch, compiled before
    compiling: float  # time to compile the program, or to load it [s]

    @property
    def rate(self) -> float:
        return self.outcomes.cost.size / self.seconds

    @property
    def kept(self) -> np.ndarray:
        """Whether each grasp kept its object, shape (design, trial)."""
        return verdict.kept(self.outcomes)

    def __str__(self) -> str:
        """Rate and sizes in a line."""
        size = self.scene.discretization
        count = self.outcomes.cost.size
        return (
            f"steps of {1e3 * size.timestep:g} ms, {size.links} links a finger: {self.rate:.3g} "
            f"grasps/s ({count} grasps in {self.seconds:.3g} s; compiled or loaded in "
            f"{self.compiling:.1f} s)"
        )


def main(options: Check) -> int:
    common.use_compilation_cache()
    load = os.getloadavg()[0]
    case = find_case(options)
    finer = with_accuracy(case.scene, fresh_trials.ACCURACY)
    _refuse(options, case, finer)
    console = Console()
    for line in _head(case, load):
        console.print(line)
    settings = _settings(options, case)
    return tell(case, settings, *simulate(case, settings, finer, options, console), console)


def simulate(
    case: Case, settings: Settings, finer: Scene, options: Check, console: Console
) -> tuple[str, Measured, Measured]:
    """A description of the designs, and their grasps in the scene and in the finer scene.

    The second are the first of the first ones: the same designs and trials.
    """
    engines = [case.make_engine(scene) for scene in (case.scene, finer)]
    trials = len(case.scene.objects.object)
    count = max(_LEAST, (options.grasps or settings.particles * settings.trials) // trials)
    with Busy(console, "compiling") as busy:
        run, compiling = _compile(case.scene, engines[0], case, count)
        busy.say("simulating at the scene's accuracy")
        designs, words = _sample(options, case, run, count)
        drawn = _draw(case, 1, 0, count).trials
        outcomes, seconds = min(
            (_time_call(run, designs, drawn) for _ in range(2)), key=lambda m: m[1]
        )
        usual = Measured(case.scene, outcomes, seconds, compiling)
        few = options.seconds * usual.rate / fresh_trials.steps_and_links(case.scene) / trials
        few = int(np.clip(few, _LEAST, count))
        busy.say(f"compiling at accuracy {fresh_trials.ACCURACY}")
        run, compiling = _compile(finer, engines[1], case, few)
        busy.say(f"simulating {few * trials} grasps at accuracy {fresh_trials.ACCURACY}")
        some = designs[:few], jax.tree.map(lambda v: v[:few], drawn)
        fine = Measured(finer, *_time_call(run, *some), compiling)
    return words, usual, fine


def _refuse(options: Check, case: Case, finer: Scene) -> None:
    problems = common.number_problems(
        ("--grasps", options.grasps, 1, 1_000_000), ("--seconds", options.seconds, 1, 86_400)
    )
    problems += common.engine_problems(case.engine, options.overrides)
    if finer == case.scene:
        sentence = (
            f"accuracy {fresh_trials.ACCURACY} is what others are compared with: choose another by "
            "--accuracy"
        )
        problems.append(Problem("unsupported", sentence))
    common.refuse(problems)


def _head(case: Case, load: float) -> list[str]:
    """The subject and the machine of the check, and warnings."""
    device = jax.devices()[0]
    where = f"{os.cpu_count()} CPU cores"
    if hasattr(os, "sched_getaffinity"):
        where = f"{len(os.sched_getaffinity(0))} CPU cores"
    if device.platform != "cpu" and case.engine != "mujoco":
        where = f"one {device.device_kind}"
    versions = (f"{name} {importlib.metadata.version(name)}" for name in ("jax", "mujoco"))
    lines = [f"scene {case.scene.name}, engine {case.engine}; {where}; {', '.join(versions)}"]
    if load > 0.5:
        lines.append(
            f"warning: the machine is busy (load {load:.1f}), so that rates are lower than they "
            "could be"
        )
    return lines + preflight.notes(case.scene, case.space, {"the design": case.design})


def _settings(options: Check, case: Case) -> Settings:
    if options.run_folder:
        return runs.read_run(options.run_folder)[1]
    objects = len(case.scene.objects.object)
    arguments = {"optimizer": optimize.DEFAULT, "objects": objects}
    preset = common.design_file(options).preset
    return runs.make_settings(preset, "concurrent", "morphology", case.engine, 0, **arguments)


def _without_own_code(settings: Settings) -> Settings:
    """Settings of as many grasps that import nothing: a run's are a stranger's, maybe."""
    optimizer = optimize.PAPER if user_code.is_user_code(settings.optimizer) else settings.optimizer
    replaced = {"optimizer": optimizer, "cost": runs.SCENE_COST, "policy": ""}
    return dataclasses.replace(settings, **replaced)


Run = Callable[[jax.Array, Trial], Outcome]


def _compile(scene: Scene, engine: Engine, case: Case, count: int) -> tuple[Run, float]:
    program = sampling.make_simulate(scene, engine, case.space)
    like = _draw(case, 0, 0, count)
    begin = time.perf_counter()
    return interruptible(program.compile, *like), time.perf_counter() - begin


def _draw(case: Case, stream: int, first: int, count: int) -> sampling.Drawn:
    key = jax.random.fold_in(jax.random.key(0), stream)
    sizes = {"first": first, "n": count, "num_trials": len(case.scene.objects.object)}
    return sampling.draw(case.scene, case.space, key, **sizes)


def _time_call(run: Run, designs: jax.Array, trials: Trial) -> tuple[Outcome, float]:
    begin = time.perf_counter()
    outcomes = jax.tree.map(np.asarray, interruptible(run, designs, trials))
    return outcomes, time.perf_counter() - begin


def _sample(options: Check, case: Case, run: Run, count: int) -> tuple[jax.Array, str]:
    """Designs of shape (count, parameter), repeated where there are fewer, and what they are."""
    if options.run_folder:
        particles = selection.read_record(options.run_folder).state.particles
        designs = np.unique(np.asarray(particles), axis=0)
        words = f"the {common.counted(len(designs), 'final particle')} of {options.run_folder} "
        words += "that differ"
    elif options.design:
        designs = np.asarray(case.design)[None]
        words = runs.describe(case.space, case.design)
    else:
        designs, words = _mixed(options, case, run, count)
    return jnp.asarray(np.resize(designs, (count, designs.shape[1])), jnp.float32), words


def _mixed(options: Check, case: Case, run: Run, count: int) -> tuple[np.ndarray, str]:
    begin = time.perf_counter()
    designs = []
    costs = []
    while len(designs) < _ROUNDS and time.perf_counter() - begin < options.seconds / _ROUNDS:
        drawn = _draw(case, 0, count * len(designs), count)
        outcomes, _ = _time_call(run, *drawn)
        designs.append(np.asarray(drawn.designs))
        costs.append(np.where(failed(outcomes.status), np.inf, outcomes.cost).mean(1))
    every = np.concatenate(designs)
    half = (count + 1) // 2
    best = every[np.concatenate(costs).argsort(kind="stable")[:half]]
    mixed = np.stack([best, every[-half:]], 1).reshape(-1, best.shape[1])[:count]
    words = (
        f"half of them random, half the best of {len(every)} random ones; those that a search "
        "ends with take longer, and fewer of their verdicts differ (--run FOLDER measures them)"
    )
    return mixed, words


def tell(
    case: Case, settings: Settings, words: str, usual: Measured, fine: Measured, console: Console
) -> int:
    """Prints what `simulate` found; the exit status."""
    ours = usual.kept[: len(fine.kept)]
    theirs = fine.kept
    differ = int((ours != theirs).sum())
    share = wilson(differ, theirs.size)
    grasps = runs.prepare(case.scene, _without_own_code(settings)).grasps
    tested = min(reference.most_trials(None, settings), verdict.USUAL)
    test = f", and {duration(tested / fine.rate)} for its test at accuracy {fresh_trials.ACCURACY}"
    causes = verdict.failure_counts(usual.outcomes.status)
    lines = [
        *f"designs: {words}".split("\n"),
        str(usual),
        f"accuracy {fresh_trials.ACCURACY}, {fine}",
        *([f"failed: {causes}"] if causes else []),
        f"kept: {ours.sum()} of {ours.size} grasps, at accuracy {fresh_trials.ACCURACY} "
        f"{theirs.sum()}; verdicts differ in {differ}: {100 * share.value:.2g} % "
        f"(95 % interval {100 * share.low:.2g} to {100 * share.high:.2g} %)",
        f"a search ({settings.optimizer}, preset {settings.preset}, {grasps} grasps): about "
        f"{duration(usual.compiling + grasps / usual.rate)}{test if tested else ''}",
    ]
    for line in lines:
        console.print(line)
    return int(any(failed(m.outcomes.status).all() for m in (usual, fine)))
