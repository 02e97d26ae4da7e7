"""Rows of a Parquet file, with unit and meaning of each column in its schema (extra `parquet`)."""

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from codesign_jax import files
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Status

STATUS_BITS = {str(int(bit)): bit.name for bit in Status if bit}
"""Names of the status' bits by their value."""


class Column(NamedTuple):
    """A column.

    Attributes:
      kind: One of pyarrow's types, such as "float32", or "name" for one of few texts.
      meaning: What it is.
      more: Further metadata of the column, such as its unit.
      nullable: Whether values may be missing.
    """

    kind: str
    meaning: str
    more: Mapping[str, str] = {}
    nullable: bool = False


class Names(NamedTuple):
    """Values of a column of the kind "name"."""

    index: np.ndarray
    texts: list[str]


def pyarrow_module(what: str) -> ModuleType:
    """Returns pyarrow."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as error:
        message = f"{what} needs {error.name}: pip install '.[parquet]' in the checkout"
        raise InputError([message]) from error
    return pyarrow


def arrow_schema(pa: ModuleType, columns: Mapping[str, Column], notes: Mapping[str, Any]) -> Any:
    """The schema of a file."""
    fields = []
    for name, column in columns.items():
        named = column.kind == "name"
        kind = pa.dictionary(pa.int16(), pa.string()) if named else getattr(pa, column.kind)()
        metadata = {"description": column.meaning, **column.more}
        fields.append(pa.field(name, kind, nullable=column.nullable, metadata=metadata))
    return pa.schema(fields, {name: json.dumps(note) for name, note in notes.items()})


def table(pa: ModuleType, schema: Any, columns: Mapping[str, Any], shape: tuple[int, ...]) -> Any:
    """A table of a row for each entry of arrays of a shape.

    Args:
      pa: pyarrow.
      schema: The schema.
      columns: Of every column an array that broadcasts to the shape (of a masked one, masked
        entries are missing), a text, `Names`, or None if all of its values are missing.
      shape: The shape.
    """
    arrays, count = [], int(np.prod(shape))
    for field in schema:
        value = columns[field.name]
        if value is None:
            arrays.append(pa.nulls(count, field.type))
            continue
        if isinstance(value, str):
            value = Names(np.zeros((), np.int16), [value])
        if isinstance(value, Names):
            index = np.broadcast_to(value.index, shape).ravel().astype(np.int16)
            arrays.append(pa.DictionaryArray.from_arrays(pa.array(index), value.texts))
            continue
        mask = np.ma.getmask(value)
        flat = np.broadcast_to(np.ma.getdata(value), shape).ravel()
        masked = None if mask is np.ma.nomask else np.broadcast_to(mask, shape).ravel()
        arrays.append(pa.array(flat.astype(field.type.to_pandas_dtype()), mask=masked))
    return pa.Table.from_arrays(arrays, schema=schema)


@contextlib.contextmanager
def writing(pa: ModuleType, path: Path, schema: Any) -> Iterator[Any]:
    """Writes a file as a whole or not at all."""
    with (
        files.atomically(path) as part,
        pa.parquet.ParquetWriter(part, schema, compression="zstd") as writer,
    ):
        yield writer
