"""Grasps of random designs in one Parquet file (extra `parquet`), in steps that survive a kill.

A row follows from the question (scene, design space, seed, ...) and the indices of design and
trial, but for its outcome.  So a folder beside the unfinished file holds outcomes alone, a file for
each call of the engine, a few bytes a grasp; the rest is drawn again when the file is written.
"""

import dataclasses
import functools
import hashlib
import json
import uuid
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax import array_files, files, reuse, sampling
from codesign_jax.judge.verdict import VERDICTS, status_names, verdicts
from codesign_jax.model import morphology
from codesign_jax.provenance import environment
from codesign_jax.runs.columns import GRASPS, MAY_BE_EMPTY, OF_DESIGNS
from codesign_jax.runs.directory import LOCK
from codesign_jax.runs.record import outcome_layout
from codesign_jax.runs.tables import design_columns, noise_values
from codesign_jax.sampling import Drawn
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space, params_of
from codesign_jax.scene.scene_files import contents, scene_texts
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Outcome, Status

ROWS = 1 << 16
"""About as many rows are written at once: a row group of the file."""
_NAMES = ("engine", "preset", "trials", "seed", "chunk")


@dataclasses.dataclass(frozen=True)
class Question:
    """What grasps a file has, but for their number."""

    scene: Scene
    engine: str
    preset: str
    trials: int
    seed: int
    chunk: int

    @functools.cached_property
    def space(self) -> DesignSpace:
        return design_space(self.scene.hand, self.preset)

    @functools.cached_property
    def described(self) -> dict[str, Any]:
        """What determines the outcomes, beside versions and machine; of JSON's types."""
        texts = scene_texts(self.scene)
        every = contents(self.scene)
        meshes = [hashlib.sha256(every[name]).hexdigest() for name in sorted({*every} - {*texts})]
        # What code that is not known has simulated is no part of anything else.
        code = reuse.code_digest() or f"unknown {uuid.uuid4()}"
        fields = {name: getattr(self, name) for name in _NAMES}
        return fields | {"scene": texts, "meshes": meshes, "code": code}

    def drawn(self, shard: int) -> Drawn:
        """Designs and trials of a shard, NumPy arrays."""
        first = shard * self.chunk
        key = jax.random.key(self.seed)
        sizes = {"n": self.chunk, "num_trials": self.trials}
        drawn = sampling.draw(self.scene, self.space, key, first=np.int32(first), **sizes)
        return jax.tree.map(np.asarray, drawn)

    def shards(self, designs: int) -> int:
        """Number of shards of so many designs; the last one may have more than are wanted."""
        return -(-designs // self.chunk)


class Shards:
    """Outcomes of calls, a file each in a folder that names their question."""

    def __init__(self, path: Path):
        self.folder = path.with_name(f"{path.name}.part")
        self._question = self.folder / "question.json"

    @property
    def question(self) -> dict[str, Any] | None:
        """`Question.described` of what has begun; None if nothing has."""
        try:
            question = json.loads(files.read(self._question))
        except (OSError, ValueError):
            return None
        return question if isinstance(question, dict) else None

    def refuse_other(self, question: Question) -> None:
        """Refuses what is there if it is of another question, or no part of a data set."""
        part = self.folder
        before = self.question
        if part.exists() and before is None and not (part.is_dir() and {*self.names} <= {LOCK}):
            raise InputError.of("file", f"{part} is no part of a data set; choose another --out")
        others = [n for n, v in question.described.items() if before and before.get(n) != v]
        if others:
            difference = f"{part} has a part of other grasps ({', '.join(others)} differ)"
            raise InputError.of(
                "damaged", f"{difference}; choose another --out, or delete the folder"
            )

    @property
    def names(self) -> list[str]:
        return [path.name for path in self.folder.iterdir()] if self.folder.is_dir() else []

    def begin(self, question: Question) -> None:
        with files.atomically(self._question) as temporary:
            temporary.write_text(json.dumps(question.described), encoding="utf-8")

    def load(self, shard: int) -> Outcome | None:
        try:
            layout = outcome_layout("design", "trial")
            return Outcome(**array_files.load(self.folder / f"{shard}.npz", layout))
        except (OSError, array_files.ArrayFileError):
            return None

    def save(self, shard: int, outcomes: Outcome) -> None:
        array_files.save(self.folder / f"{shard}.npz", outcomes._asdict())


class Names(NamedTuple):
    """Values of a column of few texts: which of them, integers of any shape, and the texts."""

    index: np.ndarray
    texts: list[str]


def pyarrow_module(purpose: str) -> ModuleType:
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as error:
        message = f"{purpose} needs {error.name}: pip install -e '.[parquet]' in the checkout"
        raise InputError([message]) from error
    return pyarrow


def _schema(pa: ModuleType, space: DesignSpace, notes: dict[str, Any]) -> Any:
    fields = []
    for name, (kind, unit, text) in GRASPS.items():
        named = pa.dictionary(pa.int16(), pa.string())
        about = {"description": text} | ({"unit": unit} if unit else {})
        arrow_type = named if kind == "name" else getattr(pa, kind)()
        empty = name in MAY_BE_EMPTY
        fields.append(pa.field(name, arrow_type, nullable=empty, metadata=about))
    for column, name, unit in zip(design_columns(space), space.names, space.units, strict=True):
        about = {"description": "the design", "unit": unit, "parameter": name}
        fields.append(pa.field(column, pa.float32(), nullable=False, metadata=about))
    for name, (kind, unit, text) in OF_DESIGNS.items():
        about = {"description": text, "unit": unit}
        fields.append(pa.field(name, getattr(pa, kind)(), nullable=False, metadata=about))
    return pa.schema(fields, {name: json.dumps(note) for name, note in notes.items()})


def _table(pa: ModuleType, schema: Any, columns: dict[str, Any], shape: tuple[int, int]) -> Any:
    """A row for each entry of arrays that broadcast to a shape; masked entries are missing."""
    arrays = []
    for field in schema:
        value = columns[field.name]
        if isinstance(value, Names):
            index = np.broadcast_to(value.index, shape).ravel().astype(np.int16)
            arrays.append(pa.DictionaryArray.from_arrays(pa.array(index), value.texts))
            continue
        flat = np.broadcast_to(value, shape, subok=True).ravel()
        arrays.append(pa.array(flat.astype(field.type.to_pandas_dtype())))
    return pa.Table.from_arrays(arrays, schema=schema)


def rows(question: Question, shard: int, drawn: Drawn, outcomes: Outcome) -> dict[str, Any]:
    """Values of the columns for a shard, arrays that broadcast to (design, trial)."""
    trials = drawn.trials
    status = np.asarray(outcomes.status)
    texts, index = np.unique(status, return_inverse=True)
    bad_step = np.asarray(outcomes.bad_step)
    values = {
        "design": (shard * question.chunk + np.arange(question.chunk))[:, None],
        "trial": np.arange(question.trials),
        "object": Names(trials.shape, [s.name for s in question.scene.objects.object]),
        **noise_values(trials),
        "verdict": Names(verdicts(outcomes), [*VERDICTS]),
        "cost": outcomes.cost,
        "lost_time_s": outcomes.lost_time,
        "status": Names(index.reshape(status.shape), [status_names(s) for s in texts]),
        "first_bad_step": np.ma.masked_less(bad_step, 0),
        "steps_at_limit": np.ma.masked_invalid(np.asarray(outcomes.capped)),
        "residual": np.ma.masked_invalid(np.asarray(outcomes.residual)),
    }
    designs = question.space.in_units(drawn.designs)
    columns = design_columns(question.space)
    hands = params_of(question.space, drawn.designs)
    values["chamber_volume_cm3"] = morphology.air(question.scene.hand, hands)[:, None]
    return values | {name: designs[:, k, None] for k, name in enumerate(columns)}


def write(path: Path, question: Question, designs: int, outcomes: Shards) -> None:
    """Writes the file from its outcomes, as a whole or not at all."""
    pa = pyarrow_module("--out")
    notes = {"question": question.described, "designs": designs, "environment": environment()}
    notes |= {"status_bits": {str(int(bit)): bit.name for bit in Status if bit}}
    schema = _schema(pa, question.space, notes)
    shape = (question.chunk, question.trials)
    remaining = designs * question.trials
    group = []
    with (
        files.atomically(path) as temporary,
        pa.parquet.ParquetWriter(temporary, schema, compression="zstd") as writer,
    ):
        for shard in range(question.shards(designs)):
            outcome = outcomes.load(shard)
            assert outcome is not None
            values = rows(question, shard, question.drawn(shard), outcome)
            group.append(_table(pa, schema, values, shape).slice(0, remaining))
            remaining -= group[-1].num_rows
            if not remaining or sum(table.num_rows for table in group) >= ROWS:
                # Groups are written as they are, whatever the writer's own size is.
                table = pa.concat_tables(group).unify_dictionaries()
                writer.write_table(table, row_group_size=table.num_rows)
                group = []
