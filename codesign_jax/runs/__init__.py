"""Runs on disk: an optimisation that saves every episode and resumes where it stopped.

The numerical modules know nothing of files; this package knows nothing of physics.

>>> from codesign_jax import runs
>>> settings = runs.make_settings("2d", "concurrent", "morphology", "structured", seed=0)
>>> settings.particles, settings.trials, settings.episodes, settings.test_rounds  # the paper's
(10, 6, 64, 6)
"""

from codesign_jax.runs.directory import RunDirectory, check_folder, reopened, setting_of
from codesign_jax.runs.errors import AllFailed, RunError
from codesign_jax.runs.loop import Results, optimize, run_names
from codesign_jax.runs.plan import Plan, needs_poor_seed, prepare, variant
from codesign_jax.runs.reading import load_record, read_run, read_search_scene
from codesign_jax.runs.record import History, Record
from codesign_jax.runs.run import FAILURES, RunResult
from codesign_jax.runs.settings import (
    COARSE,
    SCENE_ACCURACY,
    SCENE_COST,
    Settings,
    check,
    coarse_search,
    make_settings,
    search_scene,
)
from codesign_jax.runs.tables import describe

__all__ = [
    "COARSE",
    "FAILURES",
    "SCENE_ACCURACY",
    "SCENE_COST",
    "AllFailed",
    "History",
    "Plan",
    "Record",
    "RunDirectory",
    "Results",
    "RunError",
    "RunResult",
    "Settings",
    "check",
    "check_folder",
    "coarse_search",
    "describe",
    "load_record",
    "make_settings",
    "needs_poor_seed",
    "optimize",
    "prepare",
    "read_run",
    "read_search_scene",
    "reopened",
    "run_names",
    "search_scene",
    "setting_of",
    "variant",
]
