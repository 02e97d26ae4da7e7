"""Settings and folders of the runs that the flags of `codesign optimize` ask for."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax

from codesign_jax import engines, optimize, runs
from codesign_jax.commands import common
from codesign_jax.commands.flags import Optimize
from codesign_jax.runs import Settings
from codesign_jax.scene import Scene, schema
from codesign_jax.scene.schema import InputError
from codesign_jax.user_code import is_user_code, make_policy

ALTERNATE = "alternate"
"""Value of --first by which even seeds begin in the first domain and odd ones in the other."""
DOMAINS = ("morphology", "control")
_LONGEST = 200
"""Most bytes of a folder's name; file systems take 255, temporary files add to it."""


def resolve(options: Optimize) -> tuple[Scene, Settings]:
    """Reads the scene and fills the settings."""
    problems = []
    scene = None
    try:
        problems += common.engine_problems(options.engine or engines.DEFAULT, options.overrides)
        scene = common.load_scene(options)
        if options.policy:
            scene = make_policy(options.policy, scene)[1]
    except InputError as error:
        problems += error.problems
    schedules = options.schedule.split(",")
    optimizer = options.optimizer
    episodes = options.episodes
    if scene is not None and not options.fresh:
        try:
            optimizer, episodes = _of_the_runs(options, scene)
        except InputError as error:
            problems += error.problems
    settings = _settings(options, scene, optimizer or optimize.DEFAULT, episodes)
    problems += _flag_problems(options)
    for name in schedules:
        candidate = dataclasses.replace(settings, schedule=name)
        messages = runs.check(candidate, scene.hand if scene else None)
        problems += [problem for problem in messages if problem not in problems]
    problems += _accuracy_problems(scene, settings) if scene else []
    if problems or scene is None:
        raise InputError(problems)
    return scene, settings


def _settings(
    options: Optimize, scene: Scene | None, optimizer: str, episodes: int | None
) -> Settings:
    """Settings of the first run that the flags ask for."""
    arguments = {
        "particles": options.particles,
        "trials": options.trials,
        "episodes": episodes,
        "test_trials": options.test_trials,
        "optimizer": optimizer,
        "cost": options.cost or runs.SCENE_COST,
        "policy": options.policy or "",
        "objects": len(scene.objects.object) if scene else 1,
    }
    names = (
        options.preset,
        options.schedule.split(",")[0],
        DOMAINS[0] if options.first == ALTERNATE else options.first,
        options.engine or engines.DEFAULT,
    )
    settings = runs.make_settings(*names, options.seed, **arguments)
    accuracy = options.search_accuracy
    if accuracy is None and options.accuracy is None and scene is not None:
        accuracy = runs.COARSE if runs.coarse_search(scene, settings) else None
    if accuracy is None:
        return settings
    return runs.make_settings(*names, options.seed, search_accuracy=accuracy, **arguments)


def _accuracy_problems(scene: Scene, settings: Settings) -> list[str]:
    """Why the search cannot have its accuracy."""
    if settings.search_accuracy == runs.SCENE_ACCURACY:
        return []
    try:
        runs.search_scene(scene, settings)
    except InputError as error:
        return [problem.told(f"--search-accuracy: {problem}") for problem in error.problems]
    if not settings.test_trials:
        sentence = (
            f"--search-accuracy: {settings.search_accuracy} needs a final test at the scene's "
            "accuracy, and --test-trials is 0"
        )
        return [schema.Problem("conflict", sentence)]
    return []


def _flag_problems(options: Optimize) -> list[str]:
    problems = []
    if options.seeds is not None and options.seed != 0:
        problems.append(schema.Problem("conflict", "--seed and --seeds exclude each other"))
    schedules = options.schedule.split(",")
    if len({*schedules}) < len(schedules):
        problems.append(
            schema.Problem(
                "conflict", f"--schedule {options.schedule!r} names a strategy more than once"
            )
        )
    available = jax.local_device_count()
    if options.devices is not None and not 1 <= options.devices <= available:
        problems.append(
            schema.Problem(
                "range",
                f"--devices = {options.devices} is not valid; this process has {available}",
            )
        )
    return problems + common.number_problems(
        ("--reference-trials", options.reference_trials, 0, 100_000),
        ("--chunk", options.chunk, 1, 10_000_000),
    )


def _of_the_runs(options: Optimize, scene: Scene) -> tuple[str | None, int | None]:
    """Optimiser and episodes: where none are given, those of the runs that are there.

    An optimiser of somebody's own is not among them: only a command line has code imported.
    """
    optimizer = options.optimizer
    cost = options.cost or runs.SCENE_COST
    choices: dict[str, Any] = {"optimizer": optimizer or optimize.DEFAULT, "cost": cost}
    choices["policy"] = options.policy or ""
    usual = runs.make_settings(options.preset, "", "", "", 0, **choices)
    folders = runs_of(options, scene, usual)
    if optimizer is None:
        recorded = runs.setting_of(folders, "optimizer")
        optimizer = None if recorded is None or is_user_code(recorded) else recorded
    episodes = options.episodes
    return optimizer, runs.setting_of(folders, "episodes") if episodes is None else episodes


def several(options: Optimize) -> bool:
    """Whether the command compares runs, even if it happens to have one alone."""
    return options.seeds is not None or "," in options.schedule


def runs_of(options: Optimize, scene: Scene, settings: Settings) -> dict[Path, Settings]:
    """Settings of each run by its folder: of every strategy those of every seed."""
    settings_by_folder = {}
    for name in options.schedule.split(","):
        for seed in [options.seed] if options.seeds is None else common.parse_seeds(options.seeds):
            first = DOMAINS[seed % 2] if options.first == ALTERNATE else options.first
            run_settings = dataclasses.replace(settings, schedule=name, first=first, seed=seed)
            settings_by_folder[_folder(options, scene, run_settings)] = run_settings
    return settings_by_folder


def _folder(options: Optimize, scene: Scene, settings: Settings) -> Path:
    if options.out is not None:
        inside = [settings.schedule] if "," in options.schedule else []
        inside += [f"seed-{settings.seed}"] if several(options) else []
        return options.out.joinpath(*inside)
    names = [scene.hand.name, settings.preset, settings.schedule, str(settings.seed)]
    others = (settings.optimizer, optimize.DEFAULT), (settings.cost, runs.SCENE_COST)
    others = *others, (settings.policy, "")
    names[3:3] = [value.replace(":", ".") for value, usual in others if value != usual]
    name = "-".join(names)
    # Whoever wrote the files would choose a place on this disk.
    if name[0] in ".-~" or "/" in name or "\\" in name or len(os.fsencode(name)) > _LONGEST:
        text = schema.shown(name)
        raise InputError.of(
            "file", f"{text}, of hand and preset, is no name of a folder: give --out"
        )
    return Path("runs") / name
