"""Runs as others read them: scene, settings and the newest whole checkpoint; nothing is changed.

Whatever is amiss is said or refused: a run whose newest checkpoint is damaged has another best
design at the one before.
"""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from codesign_jax import scene as scenes
from codesign_jax.runs import manifest, tables
from codesign_jax.runs import record as records
from codesign_jax.runs.checkpoint import Checkpoints, Restored
from codesign_jax.runs.errors import RunError
from codesign_jax.runs.record import Record
from codesign_jax.runs.settings import SCENE_ACCURACY, Settings
from codesign_jax.scene import Scene, scene_files, texts
from codesign_jax.scene.schema import InputError, Problem

Tell = Callable[[str], None]
"""Takes a sentence about what is amiss with a run."""


def read_run(
    path: Path,
    *,
    object_set: str | Path | None = None,
    accuracy: str | Path | None = None,
    overrides: Mapping[Any, Any] | None = None,
) -> tuple[Scene, Settings]:
    """Reads scene and settings of a run folder.

    Args:
      object_set: Object set instead of the run's.
      accuracy: Preset of discretization and solver instead of the run's.
      overrides: Values by key path that replace the run's; see `scene.load`.

    Raises:
      InputError: If it is not a run folder, or its scene is no longer the one it was made with.
    """
    stored = manifest.read_provenance(path)
    manifest.refuse_changed(path, stored)
    scene = scenes.load(
        path / "scene.toml", object_set=object_set, accuracy=accuracy, overrides=overrides
    )
    return scene, Settings(**stored["settings"])


def read_search_scene(path: Path) -> Scene:
    """Reads the scene that a run's episodes simulate: at the accuracy of the search."""
    scene, settings = read_run(path)
    if settings.search_accuracy == SCENE_ACCURACY:
        return scene
    return read_run(path, accuracy=path / scene_files.SEARCH)[0]


def load_record(folder: Path, *, tell: Tell | None = None) -> Record | None:
    """Reads the newest whole checkpoint of a run folder; None if it has none.

    Args:
      tell: Called with what is amiss, such as newer checkpoints that are damaged; None to warn.

    Raises:
      InputError: If the folder is no run, no checkpoint of it can be read, or they are another's.
    """
    tell = tell or (lambda text: warnings.warn(text, stacklevel=3))
    manifest.refuse_links(folder)
    stored = manifest.read_provenance(folder)
    if problem := lost(folder):
        raise InputError([problem])
    if not (folder / "checkpoints").is_dir():
        return None
    settings = Settings(**stored["settings"])
    try:
        with Checkpoints(folder / "checkpoints", run=stored["id"], read_only=True) as store:
            restored = store.restore(records.refuse_other_arrays)
        record = records.from_arrays(restored.arrays) if restored.arrays else None
        if record is not None:
            records.refuse_other(record, settings)
    except (RunError, OSError) as error:
        raise InputError.of("damaged", f"run {folder}: {error}") from error
    if record is None:
        if problem := lost(folder, restored):
            raise InputError([problem])
        return None
    if restored.damaged:
        steps = texts.some([f"{step}: {reason}" for step, reason in restored.damaged], "; ")
        test = "with" if record.test is not None else "without"
        tell(
            f"{folder} has damaged checkpoints ({steps}). Read instead is checkpoint "
            f"{restored.step}, after episode {record.done} of {settings.episodes}, {test} the "
            "final test: another design may be the best there. The command of codesign optimize "
            "that made the run computes again what is lost"
        )
    return record


def lost(folder: Path, restored: Restored | None = None) -> str:
    """Says that a run has no whole checkpoint while its tables have episodes; else nothing."""
    episodes = tables.episodes_in(folder)
    if not episodes or (restored is None and (folder / "checkpoints").is_dir()):
        return ""
    damaged = restored.damaged if restored else ()
    steps = texts.some([f"{step}: {reason}" for step, reason in damaged], "; ")
    loss = f"no checkpoint that is whole ({steps})" if steps else "lost its checkpoints"
    return Problem(
        "damaged",
        f"run {folder} has {loss}, while its tables have {episodes} "
        f"episode{'s' * (episodes != 1)}. Put checkpoints/ back from a copy; or copy the tables, "
        "if they are wanted, and begin anew with codesign optimize --fresh",
    )
