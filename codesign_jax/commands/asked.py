"""What a command line of `codesign optimize` asks for: scene, settings and the runs' folders."""

import dataclasses
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

import jax

from codesign_jax import engines, optimize, own, runs
from codesign_jax.commands import common
from codesign_jax.runs import Settings
from codesign_jax.scene import Scene, schema
from codesign_jax.scene.schema import InputError

if TYPE_CHECKING:
    from codesign_jax.cli import Optimize


ALTERNATE, DOMAINS = "alternate", ("morphology", "control")
"""Value of --first by which even seeds begin in the first domain and odd ones in the other."""
MOST = 1000
"""Most runs of one command: a guard against a slip such as 0-99999."""
_LONGEST = 200
"""Most bytes of a folder's name; file systems take 255, temporary files add to it."""


def resolve(options: "Optimize") -> tuple[Scene, Settings]:
    """Reads the scene and fills the settings."""
    problems, scene = [], None
    try:
        problems += common.engine_problems(options.engine or engines.DEFAULT, options.overrides)
        scene = common.load_scene(options)
    except InputError as error:
        problems += error.problems
    schedules = options.schedule.split(",")
    optimizer = options.optimizer or optimize.DEFAULT
    if scene is not None and options.optimizer is None and not options.fresh:
        try:
            optimizer = _of_the_runs(options, scene) or optimizer
        except InputError as error:
            problems += error.problems
    settings = runs.make_settings(
        options.preset,
        schedules[0],
        DOMAINS[0] if options.first == ALTERNATE else options.first,
        options.engine or engines.DEFAULT,
        options.seed,
        particles=options.particles,
        trials=options.trials,
        episodes=options.episodes,
        test_trials=options.test_trials,
        optimizer=optimizer,
        cost=options.cost or runs.SCENE_COST,
        objects=len(scene.objects.object) if scene else 1,
    )
    if scene is not None and options.episodes is None and not options.fresh:
        try:
            settings = _as_the_runs(options, scene, settings)
        except InputError as error:
            problems += error.problems
    problems += _flag_problems(options)
    for name in schedules:
        own = dataclasses.replace(settings, schedule=name)
        found = runs.check(own, scene.hand if scene else None)
        problems += [problem for problem in found if problem not in problems]
    if problems or scene is None:
        raise InputError(problems)
    return scene, settings


def _flag_problems(options: "Optimize") -> list[str]:
    """What is wrong with flags that are no settings of a run."""
    problems = []
    if options.seeds is not None and options.seed != 0:
        problems.append("--seed and --seeds exclude each other")
    schedules = options.schedule.split(",")
    if len({*schedules}) < len(schedules):
        problems.append(f"--schedule {options.schedule!r} names a strategy more than once")
    available = jax.local_device_count()
    if options.devices is not None and not 1 <= options.devices <= available:
        problems.append(f"--devices = {options.devices} is not valid; this process has {available}")
    return problems + common.number_problems(
        ("--reference-trials", options.reference_trials, 0, 100_000),
        ("--chunk", options.chunk, 1, 10_000_000),
    )


def _of_the_runs(options: "Optimize", scene: Scene) -> str | None:
    """The optimiser of the runs that are there: a run goes on with its own.

    One of somebody's own is not among them: only a command line has code imported.
    """
    cost = options.cost or runs.SCENE_COST
    usual = runs.make_settings(options.preset, "", "", "", 0, optimizer=optimize.DEFAULT, cost=cost)
    folders = runs_of(options, scene, usual)
    found = runs.setting_of(folders, "optimizer")
    return None if found is None or own.is_own(found) else found


def _as_the_runs(options: "Optimize", scene: Scene, settings: Settings) -> Settings:
    """Settings with the episodes of the runs that are there: these may have been extended."""
    folders = runs_of(options, scene, settings)
    episodes = runs.setting_of(folders, "episodes") or settings.episodes
    return dataclasses.replace(settings, episodes=episodes)


def several(options: "Optimize") -> bool:
    """Whether the command compares runs, even if it happens to have one alone."""
    return options.seeds is not None or "," in options.schedule


def runs_of(options: "Optimize", scene: Scene, settings: Settings) -> dict[Path, Settings]:
    """Settings of each run by its folder: of every strategy those of every seed."""
    found = {}
    for name in options.schedule.split(","):
        for seed in seeds_of(options):
            first = DOMAINS[seed % 2] if options.first == ALTERNATE else options.first
            own = dataclasses.replace(settings, schedule=name, first=first, seed=seed)
            found[_folder(options, scene, own)] = own
    return found


def table_folder(options: "Optimize") -> Path:
    """Folder of the table that compares runs."""
    return Path("runs") if options.out is None else options.out


def seeds_of(options: "Optimize") -> list[int]:
    """Seeds of the runs."""
    return [options.seed] if options.seeds is None else parse_seeds(options.seeds)


def parse_seeds(text: str) -> list[int]:
    """Reads seeds such as "0-9" or "1,3,5-7", in ascending order."""
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,10})(?:-([0-9]{1,10}))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first or last >= 2**31:
            raise InputError([f"--seeds {text!r} must be seeds such as 0-9 or 1,3,5"])
        if last - first >= MOST or len(found) > MOST:
            raise InputError([f"--seeds {text!r} names more than {MOST} runs"])
        found |= set(range(first, last + 1))
    return sorted(found)


def _folder(options: "Optimize", scene: Scene, settings: Settings) -> Path:
    """Folder of one run: --out, with a folder inside for each of several strategies and --seeds."""
    if options.out is not None:
        inside = [settings.schedule] if "," in options.schedule else []
        inside += [f"seed-{settings.seed}"] if several(options) else []
        return options.out.joinpath(*inside)
    names = [scene.hand.name, settings.preset, settings.schedule, str(settings.seed)]
    others = (settings.optimizer, optimize.DEFAULT), (settings.cost, runs.SCENE_COST)
    names[3:3] = [asked.replace(":", ".") for asked, usual in others if asked != usual]
    name = "-".join(names)
    # Whoever wrote the files would choose a place on this disk.
    if name[0] in ".-~" or "/" in name or "\\" in name or len(os.fsencode(name)) > _LONGEST:
        given = schema.shown(name)
        raise InputError([f"{given}, of hand and preset, is no name of a folder: give --out"])
    return Path("runs") / name
