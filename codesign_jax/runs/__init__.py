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
from codesign_jax.runs.reading import load_record, read_run
from codesign_jax.runs.record import History, Record
from codesign_jax.runs.run import FAILURES, RunResult
from codesign_jax.runs.settings import SCENE_COST, Settings, check, make_settings
from codesign_jax.runs.tables import describe

__all__ = [
    "FAILURES",
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
    "describe",
    "load_record",
    "make_settings",
    "needs_poor_seed",
    "optimize",
    "prepare",
    "read_run",
    "reopened",
    "run_names",
    "setting_of",
    "variant",
]
