"""Every grasp of an experiment as a row of a Parquet file (pyarrow, the extra `parquet`)."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from codesign_jax import files
from codesign_jax.scene.schema import SceneError
from codesign_jax.types import Status
from scripts.experiments import results
from scripts.experiments.batch import Batch
from scripts.experiments.landscape import Grid
from scripts.shared.record import Arrays

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


def library() -> ModuleType:
    """Returns pyarrow.

    Raises:
      SceneError: If it is not installed; says how to install it.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as error:
        message = f"--parquet needs {error.name}: pip install 'codesign-jax[parquet]'"
        raise SceneError([message]) from error
    return pyarrow


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
    pa = library()
    schema = _schema(pa, experiment, notes)
    batch = isinstance(experiment, Batch)
    tables = _strategies(experiment, record) if batch else _points(experiment, record)
    with (
        files.atomically(path) as part,
        pa.parquet.ParquetWriter(part, schema, compression="zstd") as writer,
    ):
        for columns in tables:
            writer.write_table(_table(pa, schema, columns))
    return path


def _schema(pa: ModuleType, experiment: Batch | Grid, notes: dict[str, Any]) -> Any:
    names = pa.dictionary(pa.int8(), pa.string())
    fields = []
    columns = _STRATEGIES if isinstance(experiment, Batch) else _GRID
    for name, (kind, text) in columns.items():
        space, metadata = experiment.worlds.space, {"description": text}
        if name in ("first", "second"):
            index = ("first", "second").index(name)
            metadata |= {"parameter": space.names[index], "unit": space.units[index]}
        kept = names if kind == "name" else getattr(pa, kind)()
        fields.append(pa.field(name, kept, nullable=name == "episode", metadata=metadata))
    bits = {str(int(s)): s.name for s in Status if s}
    return pa.schema(fields, {"provenance": json.dumps(notes), "status_bits": json.dumps(bits)})


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


def _table(pa: ModuleType, schema: Any, columns: dict[str, Any]) -> Any:
    """A table of columns that are arrays to broadcast, names, or None."""
    shape, arrays = columns["cost"].shape, []
    for field in schema:
        value, count = columns[field.name], int(np.prod(shape))
        if value is None:
            arrays.append(pa.nulls(count, field.type))
        elif isinstance(value, str):
            index = pa.array(np.zeros(count, np.int8))
            arrays.append(pa.DictionaryArray.from_arrays(index, [value]))
        else:
            flat = np.broadcast_to(value, shape).ravel().astype(field.type.to_pandas_dtype())
            arrays.append(pa.array(flat))
    return pa.Table.from_arrays(arrays, schema=schema)
