"""Every grasp of an experiment as a row of a Parquet file (pyarrow, the extra `parquet`)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.runs import parquet
from codesign_jax.runs.parquet import Column
from scripts.experiments import results
from scripts.experiments.batch import Batch
from scripts.experiments.landscape import Grid
from scripts.shared.record import Arrays

FLAG = "--parquet"
"""Flag of the study that asks for the file."""
EPISODE, TEST = "episode", "test"
"""Phases of an experiment on strategies."""

_OUTCOME = {
    "cost": (
        "float32",
        "cost of the grasp, 0 (kept) to the scene's maximum (lost at once, failed)",
    ),
    "status": (
        "uint8",
        "bits of codesign_jax.types.Status, named in the schema's metadata; 0: none",
    ),
}
_STRATEGIES = {
    "experiment": ("name", "name of the experiment"),
    "strategy": ("name", "what opened the parameters, see codesign_jax.optimize.schedule"),
    "run": ("int16", "run of the strategy; run r of every strategy shares seed and noise"),
    "phase": ("name", f"{EPISODE} or {TEST} of the final particles"),
    "episode": ("int16", "episode from 0; null in the test"),
    "particle": ("int16", "particle of the episode, or final particle in the test"),
    "trial": ("int16", "trial of the particle in this episode or in the test, from 0"),
    **_OUTCOME,
}
_GRID = {
    "experiment": ("name", "name of the experiment"),
    "first": ("float32", "first parameter of the grid"),
    "second": ("float32", "second parameter of the grid"),
    "trial": ("int16", "trial of the point, from 0; every point meets the same ones"),
    **_OUTCOME,
}


def write(path: Path, experiment: Batch | Grid, record: Arrays, notes: dict[str, Any]) -> Path:
    """Writes one row a grasp, as a whole or not at all.

    Grasps that screened the seeds are in no row.  A test also counts the last episode's grasps of
    the particles that survived it: these are rows of that episode alone.

    Args:
      path: File to write.
      experiment: What was run.
      record: Its record; episodes that were not simulated yet have no rows.
      notes: Provenance, kept as JSON in the schema's metadata.

    Raises:
      SceneError: If pyarrow is missing.
    """
    pa = parquet.library(FLAG)
    metadata = {"provenance": notes, "status_bits": parquet.STATUS_BITS}
    schema = parquet.schema(pa, _columns(experiment), metadata)
    batch = isinstance(experiment, Batch)
    tables = _strategies(experiment, record) if batch else _points(experiment, record)
    with parquet.writing(pa, path, schema) as writer:
        for columns in tables:
            writer.write_table(parquet.table(pa, schema, columns, columns["cost"].shape))
    return path


def _columns(experiment: Batch | Grid) -> dict[str, Column]:
    space, found = experiment.worlds.space, {}
    columns = _STRATEGIES if isinstance(experiment, Batch) else _GRID
    for name, (kind, text) in columns.items():
        more = {}
        if name in ("first", "second"):
            index = ("first", "second").index(name)
            more = {"parameter": space.names[index], "unit": space.units[index]}
        found[name] = Column(kind, text, more, nullable=name == "episode")
    return found


def _strategies(batch: Batch, record: Arrays) -> Iterator[dict[str, Any]]:
    """Columns of each strategy's episodes, then of its tests: broadcast axes, and arrays."""
    plan, step = batch.plan, int(record["step"])
    episodes = min(step, plan.episodes)
    # The first columns of the test repeat the last episode's grasps.
    tested = slice(plan.trials, plan.trials * (1 + max(step - plan.episodes, 0)))
    for s, strategy in enumerate(plan.strategies):
        fixed = {"experiment": plan.name, "strategy": strategy}
        if episodes:
            status = record["status"][s, :, :episodes]
            cost = results.costs(batch.scene, record["lost_step"][s, :, :episodes], status)
            axes = _indices(cost, "run", "episode", "particle", "trial")
            yield fixed | {"phase": EPISODE, "cost": cost, "status": status} | axes
        if tested.stop > tested.start:
            cost, status = (record[f"test_{v}"][s, ..., tested] for v in ("cost", "status"))
            axes = _indices(cost, "run", "particle", "trial")
            yield fixed | {"phase": TEST, "episode": None, "cost": cost, "status": status} | axes


def _indices(values: np.ndarray, *names: str) -> dict[str, Any]:
    """Indices along the axes, to broadcast."""
    return dict(zip(names, np.indices(values.shape, sparse=True), strict=True))


def _points(grid: Grid, record: Arrays) -> Iterator[dict[str, Any]]:
    """Columns of the grid's grasps."""
    done = min(grid.plan.block * int(record["step"]), grid.plan.trials)
    cost, status = (record[name][..., :done] for name in ("trial_cost", "status"))
    designs = grid.worlds.space.in_units(record["designs"])[..., None, :]
    trial = np.arange(done)
    yield {
        "experiment": grid.plan.name,
        "first": designs[..., 0],
        "second": designs[..., 1],
        "trial": trial,
        "cost": cost,
        "status": status,
    }
