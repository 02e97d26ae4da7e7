"""Every grasp of an experiment as a row of a Parquet file (pyarrow, the extra `parquet`)."""

from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.runs import parquet
from codesign_jax.runs.parquet import Column
from codesign_jax.scene.parameters import DesignSpace
from scripts.experiments.plan import Strategies
from scripts.experiments.strategies import Arrays

FLAG = "--parquet"
"""Flag of the study that asks for the file."""
EPISODE, TEST = "episode", "test"
"""Phases of an experiment on strategies."""
_TEST = "test_cost"

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


def write_strategies(
    path: Path, plan: Strategies, space: DesignSpace, found: Arrays, notes: dict[str, Any]
) -> Path:
    """Writes one row a grasp of `strategies.gather`, as a whole or not at all.

    Grasps that screened the seeds are in no row.  A test also counts the last episode's grasps of
    the particles that survived it: these are rows of that episode alone.

    Args:
      path: File to write.
      plan: The experiment.
      space: Its design space.
      found: What was gathered.
      notes: Provenance, kept as JSON in the schema's metadata.

    Raises:
      InputError: If pyarrow is missing.
    """
    # The first columns of the test repeat the last episode's grasps.
    test = {f"test_{v}": found[f"test_{v}"][..., plan.trials :] for v in _OUTCOME if _TEST in found}
    tables = []
    for s, strategy in enumerate(plan.strategies):
        fixed = {"experiment": plan.name, "strategy": strategy}
        cost, status = found["trial_cost"][s], found["status"][s]
        axes = _indices(cost, "run", "episode", "particle", "trial")
        tables.append(fixed | {"phase": EPISODE, "cost": cost, "status": status} | axes)
        if test:
            cost, status = (test[f"test_{v}"][s] for v in ("cost", "status"))
            axes = _indices(cost, "run", "particle", "trial")
            own = {"phase": TEST, "episode": None, "cost": cost, "status": status}
            tables.append(fixed | own | axes)
    return _write(path, _STRATEGIES, space, tables, notes)


def write_landscape(
    path: Path, name: str, space: DesignSpace, found: Arrays, notes: dict[str, Any]
) -> Path:
    """As `write_strategies`, of what `landscape.simulate` returns."""
    designs = space.in_units(found["designs"])[..., None, :]
    columns = {
        "experiment": name,
        "first": designs[..., 0],
        "second": designs[..., 1],
        "trial": np.arange(found["status"].shape[-1]),
        "cost": found["trial_cost"],
        "status": found["status"],
    }
    return _write(path, _GRID, space, [columns], notes)


def _write(
    path: Path,
    described: dict[str, tuple[str, str]],
    space: DesignSpace,
    tables: list[dict[str, Any]],
    notes: dict[str, Any],
) -> Path:
    pa = parquet.library(FLAG)
    columns = {}
    for name, (kind, text) in described.items():
        more = {}
        if name in ("first", "second"):
            index = ("first", "second").index(name)
            more = {"parameter": space.names[index], "unit": space.units[index]}
        columns[name] = Column(kind, text, more, nullable=name == "episode")
    metadata = {"provenance": notes, "status_bits": parquet.STATUS_BITS}
    schema = parquet.schema(pa, columns, metadata)
    with parquet.writing(pa, path, schema) as writer:
        for values in tables:
            writer.write_table(parquet.table(pa, schema, values, values["cost"].shape))
    return path


def _indices(values: np.ndarray, *names: str) -> dict[str, Any]:
    """Indices along the axes, to broadcast."""
    return dict(zip(names, np.indices(values.shape, sparse=True), strict=True))
