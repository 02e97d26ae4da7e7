"""Writes what studies found: as a whole or not at all, whenever a process ends."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax import files


def write_json(path: Path, content: Any, *, indent: int | None = 1) -> Path:
    """Writes a JSON file, its folder included."""
    separators = (",", ":") if indent is None else None
    with files.atomically(path) as part:
        text = json.dumps(content, indent=indent, separators=separators)
        part.write_text(text + "\n", encoding="utf-8")
    return path


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Writes arrays by name as a compressed .npz file, its folder included."""
    with files.atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return path
