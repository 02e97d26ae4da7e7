"""A page of A4: views in one scale of ISO 5455, dimension lines, and the title block."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from codesign_jax.export import fonts

PAPER = (210.0, 297.0)
"""Width and height of a page [mm]."""
SCALES = (1, 2, 5, 10, 20, 50)
"""Reductions of ISO 5455."""
EDGE = 12.0
"""Margin of a page [mm]."""
BLOCK = 30.0
"""Height of the title block [mm]."""
BOTTOM = EDGE + BLOCK + 6.0
TOP = PAPER[1] - 24.0
"""Between these heights a page has its views [mm]."""
_SHORT = 9.0  # length on paper below which a dimension's number stands beside its line [mm]
_FONT = 7.0


class About(NamedTuple):
    """What the title block says."""

    design: str = ""  # where the design is from: its run, or its file
    date: str = ""
    version: str = ""  # of codesign-jax
    silicone: str = ""
    verdict: str = ""
    warnings: Sequence[str] = ()


def scale_of(least: float) -> int:
    """The least reduction that is not below a ratio of drawing and room."""
    return next((n for n in SCALES if n >= least), SCALES[-1])


def view(
    figure: Figure,
    place: tuple[float, float],
    span: tuple[Sequence[float] | np.ndarray, Sequence[float] | np.ndarray],
    scale: int,
    title: str = "",
    *,
    pad: float = 2.0,
    left: bool = False,
) -> Axes:
    """Axes whose units are millimetres of what is drawn, to scale.

    Args:
      place: Their lower left corner on the page [mm].
      span: Lowest and highest coordinates that they show [mm].
      title: Stands above them.
      pad: Distance of the title [points].
      left: Whether the title begins at their left edge; else it is in their middle.
    """
    low, high = map(np.asarray, span)
    width, height = (high - low) / scale
    rectangle = (place[0] / PAPER[0], place[1] / PAPER[1], width / PAPER[0], height / PAPER[1])
    axes = figure.add_axes(rectangle)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.axis("off")
    where = "left" if left else "center"
    axes.set_title(title, loc=where, fontsize=_FONT, pad=pad, parse_math=False)
    return axes


def dimension(
    axes: Axes,
    ends: tuple[float, float],
    at: float,
    away: float,
    scale: int,
    *,
    vertical: bool = False,
    words: str = "",
) -> None:
    """A dimension line with its number.

    Args:
      axes: Those of `view`.
      ends: Where the length begins and ends, along the line [mm].
      at: Where the outline is, across the line [mm].
      away: Distance of the line from there [mm on paper], negative to the left or downwards.
      words: What stands on the line in place of the length.
      vertical: Whether the line is vertical.
    """

    def put(along: float, across: float) -> tuple[float, float]:
        return (across, along) if vertical else (along, across)

    side = np.sign(away)
    level = at + away * scale
    for end in ends:
        first = put(end, at + 1.5 * side * scale)
        last = put(end, level + 2 * side * scale)
        axes.plot(*zip(first, last, strict=True), lw=0.5, color="black", clip_on=False)
    arrow = {"arrowstyle": "<|-|>", "lw": 0.5, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 6}
    starts = (put(end, level) for end in ends)
    axes.annotate("", *starts, arrowprops=arrow, annotation_clip=False)
    length = abs(ends[1] - ends[0])
    middle = sum(ends) / 2
    if length < _SHORT * scale:
        middle = max(ends) + 5 * scale
    axes.text(
        *put(middle, level),
        words or f"{length:.1f}",
        rotation=90 if vertical else 0,
        fontsize=_FONT,
        ha="center",
        va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
    )


def note(figure: Figure, height: float, words: str) -> None:
    """Lines of text on a page, from a height downwards [mm]."""
    figure.text(EDGE / PAPER[0], height / PAPER[1], words, fontsize=_FONT, va="top")


def title_block(figure: Figure, about: About, scale: int | None) -> None:
    """Cells at the foot of a page: what is drawn, from where, and how.

    Args:
      scale: None where each drawing says its own.
    """
    width = PAPER[0] - 2 * EDGE
    axes = figure.add_axes((EDGE / PAPER[0], EDGE / PAPER[1], width / PAPER[0], BLOCK / PAPER[1]))
    axes.set(xlim=(0, width), ylim=(0, BLOCK), xticks=[], yticks=[])
    rows = (
        (("design", about.design, 1.0),),
        (("codesign-jax", about.version, 0.7), ("date", about.date, 0.3)),
        (
            ("silicone", about.silicone, 0.4),
            ("scale", f"1:{scale}, on A4" if scale else "as marked, on A4", 0.2),
            ("projection", "third angle", 0.2),
            ("dimensions", "mm", 0.2),
        ),
    )
    height = BLOCK / len(rows)
    for r, row in enumerate(rows):
        top = BLOCK - r * height
        axes.axhline(top, color="black", lw=0.6)
        x = 0.0
        for name, words, share in row:
            _cell(axes, (x, top - height), (share * width, height), name, words)
            x += share * width


def _cell(
    axes: Axes, corner: tuple[float, float], size: tuple[float, float], name: str, words: str
) -> None:
    x, y = corner
    width, height = size
    axes.text(x + 1.5, y + height - 1.2, name, fontsize=4.8, color="0.4", va="top")
    font = fonts.of_text(words)
    most = int(width / 1.55)  # letters of this size
    short = font.text if len(font.text) <= most else f"{font.text[: most - 1]}…"
    axes.text(
        x + 1.5,
        y + 2.2,
        short,
        fontsize=7,
        va="bottom",
        family=font.family,
        parse_math=False,
    )
    axes.plot([x + width, x + width], [y, y + height], color="black", lw=0.6)
