"""Places labels beside points so that they cover neither each other nor points."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.transforms import Bbox

Label = tuple[float, float, str, str]
"""Point (x, y) in data coordinates, text, color."""

_AWAY = (7, 13, 20, 28, 38, 50)  # distances of the text from its point [pt]
_ANGLES = np.deg2rad((35, -35, 145, -145, 90, -90, 0, 180, 65, -65, 115, -115))


def add(axes: Axes, labels: Sequence[Label], points: np.ndarray, size: float = 6.5) -> None:
    """Writes labels, each where it covers least, nearer places first.

    The figure must be laid out already.

    Args:
      axes: The axes.
      labels: The labels, the most important ones first.
      points: All points that are drawn, in data coordinates, shape (point, 2).
      size: Size of the letters [pt].
    """
    scale = axes.figure.dpi / 72  # type: ignore[union-attr]
    marks = [_box(p, (7 * scale, 7 * scale)) for p in axes.transData.transform(points)]
    taken, frame = [], axes.get_window_extent()
    for x, y, text, color in labels:
        # Letters of the figure's font are about 0.55 as wide as high.
        extent = np.array([0.57 * size * len(text), 1.25 * size]) * scale
        here = axes.transData.transform((x, y))
        best, cost = np.zeros(2), np.inf
        for away, angle in itertools.product(_AWAY, _ANGLES):
            side = np.array([np.cos(angle), np.sin(angle)])
            middle = here + side * (away * scale + extent / 2 * np.abs(side))
            box = _box(middle, extent)
            covered = sum(_shared(box, b) for b in marks) + 2 * sum(_shared(box, b) for b in taken)
            outside = box.width * box.height - _shared(box, frame)
            total = covered + 4 * outside + 0.3 * away * scale**2
            if total < cost:
                best, cost = middle, total
        taken.append(_box(best, extent))
        axes.annotate(
            text, (x, y), xytext=tuple((best - here) / scale), textcoords="offset points",
            color=color, fontsize=size, ha="center", va="center", annotation_clip=False,
            arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "0.5", "shrinkA": 0, "shrinkB": 2},
        )  # fmt: skip


def _box(middle: np.ndarray, extent) -> Bbox:
    (x, y), (w, h) = middle, extent
    return Bbox.from_bounds(x - w / 2, y - h / 2, w, h)


def _shared(a: Bbox, b: Bbox) -> float:
    """Common area."""
    width = min(a.x1, b.x1) - max(a.x0, b.x0)
    height = min(a.y1, b.y1) - max(a.y0, b.y0)
    return max(width, 0.0) * max(height, 0.0)
