"""Matplotlib figures without pyplot: no state of a session and no display is touched."""

from pathlib import Path
from typing import Any

import matplotlib.figure


def new(width: float, height: float) -> matplotlib.figure.Figure:
    """An empty figure whose parts are laid out when it is drawn."""
    return matplotlib.figure.Figure(figsize=(width, height), dpi=120, layout="constrained")


def save(figure: matplotlib.figure.Figure, path: Path, **options: Any) -> Path:
    """Writes a figure, its folder included, and returns its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, **options)
    return path
