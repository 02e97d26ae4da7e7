"""What a run does with a scene: design space, schedule, sizes and seed."""

import dataclasses
from typing import Any

import numpy as np

from codesign_jax import engines, optimize, preflight, sizes, user_code
from codesign_jax.optimize import MAX_PARTICLES, schedule
from codesign_jax.scene import Scene, schema, with_accuracy
from codesign_jax.scene.hand import Hand
from codesign_jax.scene.parameters import DesignSpace, design_space

SCENE_COST = "scene"
"""Name of the scene's own cost."""
SCENE_ACCURACY = "scene"
"""Name of the scene's own accuracy, for a search at the accuracy of its test."""
COARSE = "fast"
"""Accuracy of a search where none is asked for and `coarse_search` says that it is known to do."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of an optimisation, beside the scene; a run is determined by both.

    Attributes:
      preset: Design space: a preset of the hand, or "full" for its whole table.
      schedule: "concurrent", "single", "switch-K", "morphology" or "control".
      first: Domain of the first episode for "single" and "switch-K".
      engine: Engine that simulates.
      particles: Particles.
      trials: Trials of a particle in an episode.
      episodes: Episodes.
      seed: Root of all random draws.
      test_trials: Further trials in which the final particles are tested, in whole rounds of
        `trials`; 0 for no test.
      optimizer: One of `optimize.NAMES`, or MODULE:NAME of one of the user's own.
      cost: `SCENE_COST`, or MODULE:NAME of a cost of the user's own.
      policy: MODULE:NAME of a policy of the user's own; empty without one.
      search_accuracy: Accuracy of the episodes; the final test has that of the scene.
    """

    preset: str
    schedule: str
    first: str
    engine: str
    particles: int
    trials: int
    episodes: int
    seed: int
    test_trials: int
    optimizer: str = optimize.PAPER
    cost: str = SCENE_COST
    policy: str = ""
    search_accuracy: str = SCENE_ACCURACY

    @property
    def user_code(self) -> tuple[str, ...]:
        """Names of the user's own code, beside those of this package."""
        return self.optimizer, self.cost, self.policy

    @property
    def test_rounds(self) -> int:
        """Batches of `trials` trials that the final test simulates."""
        return -(-self.test_trials // self.trials)


_RANGES = {
    "particles": (1, MAX_PARTICLES),
    "trials": (1, 100_000),
    "episodes": (1, 1_000_000),
    "seed": (0, 2**31 - 1),
    "test_trials": (0, 1_000_000),
}


def make_settings(
    preset: str,
    schedule: str,
    first: str,
    engine: str,
    seed: int,
    *,
    particles: int | None = None,
    trials: int | None = None,
    episodes: int | None = None,
    test_trials: int | None = None,
    optimizer: str = optimize.PAPER,
    cost: str = SCENE_COST,
    policy: str = "",
    search_accuracy: str = SCENE_ACCURACY,
    objects: int = 3,
) -> Settings:
    """Fills sizes that are not given: those of `sizes`, in a scene with so many `objects`."""
    screens = optimizer == optimize.DEFAULT
    by_preset = sizes.SCREENED if screens else sizes.PAPER
    usual = by_preset.get(preset, by_preset[""])
    if screens:
        usual = usual._replace(trials=max(objects, usual.trials))
    if screens and search_accuracy != SCENE_ACCURACY and preset not in by_preset:
        usual = usual._replace(episodes=sizes.SEARCH_EPISODES)
    given_sizes = (particles, trials, episodes, test_trials)
    n, t, e, test = (s if a is None else a for a, s in zip(given_sizes, usual, strict=True))
    names = optimizer, cost, policy, search_accuracy
    return Settings(preset, schedule, first, engine, n, t, e, seed, test, *names)


def coarse_search(scene: Scene, settings: Settings) -> bool:
    """Whether a search at `COARSE` is known to find hands that are as good or better.

    It was measured with the default optimiser and engine, with 23 parameters and the objects on a
    table, in scenes that have the accuracy `standard`; what the user's own code makes of fewer and
    longer steps is not known, and a fast shaking needs short ones. A search of few parameters takes
    less time than the program of another accuracy compiles. A final test has to follow.
    """
    try:
        many = design_space(scene.hand, settings.preset).num_parameters > optimize.FEW
    except schema.InputError:  # which `check` tells
        return False
    return (
        many
        and (settings.optimizer, settings.engine) == (optimize.DEFAULT, engines.DEFAULT)
        and (settings.cost, settings.policy) == (SCENE_COST, "")
        and settings.test_trials > 0
        and scene.effects.surface == "hull"
        and not scene.fixture
        and with_accuracy(scene, "standard") == scene
        and not preflight.shaken_coarsely(with_accuracy(scene, COARSE))
    )


def search_scene(scene: Scene, settings: Settings) -> Scene:
    """The scene that the episodes simulate."""
    if settings.search_accuracy == SCENE_ACCURACY:
        return scene
    return with_accuracy(scene, settings.search_accuracy)


def masks_of(scene: Scene, settings: Settings) -> np.ndarray:
    """Mask of the parameters that may move in each episode, shape (episode, parameter)."""
    space = design_space(scene.hand, settings.preset)
    first: Any = settings.first
    return schedule(settings.schedule, np.array(space.is_morphology), settings.episodes, first)


def check(settings: Settings, hand: Hand | None) -> list[str]:
    """Returns everything that is wrong with the settings.

    Args:
      hand: The hand, or None if it could not be read; then its presets are not checked.
    """
    problems = []
    for name, (low, high) in _RANGES.items():
        flag = f"--{name.replace('_', '-')}"
        if problem := schema.range_problem(flag, getattr(settings, name), "", low, high):
            problems.append(problem)
    if settings.engine not in engines.NAMES:
        hint = schema.nearest(settings.engine, engines.NAMES)
        problems.append(
            schema.Problem("unknown", f"--engine = {settings.engine!r} is not valid; {hint}")
        )
    if user_code.is_user_code(settings.optimizer):
        code, problem = "syntax", user_code.problem(settings.optimizer)
    else:
        particles = max(settings.particles, 0) or None
        code, problem = "unknown", optimize.problem(settings.optimizer, particles)
    problems += [schema.Problem(code, f"--optimizer: {problem}")] if problem else []
    if settings.cost != SCENE_COST and (problem := user_code.problem(settings.cost)):
        problems.append(schema.Problem("syntax", f"--cost: {problem}"))
    if settings.policy and (problem := user_code.problem(settings.policy)):
        problems.append(schema.Problem("syntax", f"--policy: {problem}"))
    space = None
    if hand is not None:
        try:
            space = design_space(hand, settings.preset)
        except schema.InputError as error:
            problems += [problem.told(f"--{problem}") for problem in error.problems]
    low, high = _RANGES["episodes"]
    if low <= settings.episodes <= high:  # it is as long as the run
        problems += _schedule_problems(settings, space)
    return problems


def _schedule_problems(settings: Settings, space: DesignSpace | None) -> list[str]:
    domains = (True, False) if space is None else space.is_morphology
    try:
        schedule(settings.schedule, list(domains), settings.episodes, settings.first)  # type: ignore[arg-type]
    except ValueError as error:
        return [schema.Problem("conflict", f"--schedule: {error}")]
    return []
