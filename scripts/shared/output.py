"""Writes what studies found: files, whole or not at all; tables in pages; figures.

Figures are drawn without pyplot: no state of a session and no display is touched.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np

from codesign_jax import files
from scripts.shared import evidence


def write_json(path: Path, content: Any, *, indent: int | None = 1) -> Path:
    """Writes a JSON file, its folder included."""
    separators = (",", ":") if indent is None else None
    files.make_folder_of(path)
    with files.atomically(path) as part:
        text = json.dumps(content, indent=indent, separators=separators)
        part.write_text(text + "\n", encoding="utf-8")
    return path


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Writes arrays by name as a compressed .npz file, its folder included."""
    files.make_folder_of(path)
    with files.atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return path


def markdown(rows: list[list[str]]) -> str:
    """A Markdown table; the first row is its head."""
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def fill(page: Path, text: str, mark: str) -> None:
    """Replaces what stands between the marks of a page, NAME:begin and NAME:end in comments.

    The page says which version its figures were measured with, if that is not the present one.
    """
    begin = f"<!-- {mark}:begin -->"
    end = f"<!-- {mark}:end -->"
    old = page.read_text(encoding="utf-8")
    if begin not in old or end not in old:
        raise ValueError(f"{page} holds no {begin} and {end}")
    head = old.split(begin)[0]
    tail = old.split(end)[1]
    with files.atomically(page) as part:
        part.write_text(f"{head}{begin}\n\n{text}\n\n{end}{tail}", encoding="utf-8")
    evidence.write(page)


def new_figure(width: float, height: float) -> matplotlib.figure.Figure:
    """An empty figure whose parts are laid out when it is drawn."""
    return matplotlib.figure.Figure(figsize=(width, height), dpi=120, layout="constrained")


def save_figure(figure: matplotlib.figure.Figure, path: Path) -> Path:
    """Writes a figure, its folder included."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path
