"""The first pages of the build sheet's drawings: the hand and its palm to scale, with dimensions.

Views are in third-angle projection (ISO 5456-2), the one from above over the front and the one from
the right beside it, in one scale of ISO 5455.  The first page has the title block, the verdict and
the warnings.
"""

import itertools
import textwrap
from collections.abc import Sequence

import matplotlib.figure
import matplotlib.patches
import numpy as np
from matplotlib.axes import Axes
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from codesign_jax.export import fonts, paper
from codesign_jax.export.paper import BLOCK, EDGE, PAPER, About
from codesign_jax.export.process import BACK, CHEEK, FLOOR, Printed, Process, Size
from codesign_jax.export.sheet import NAME, corners
from codesign_jax.model.layout import mounts
from codesign_jax.scene import Scene
from codesign_jax.types import Params

_ROOM = 14.0  # around a view, for its dimensions [mm on paper]
_LINES = 14  # of verdict and warnings
_WIDE = 128  # letters in one of them
_FONT = 6.0


def hand_page(
    figure: matplotlib.figure.Figure,
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    about: About,
) -> None:
    """Three views of the hand with straight fingers, its verdict and warnings, and the title block.

    Args:
      figure: A page of A4 whose title stands already.
    """
    points = corners(scene, params, sizes)
    disc = 1e3 * scene.hand.palm.radius, 1e3 * scene.hand.palm.thickness
    low, high = _extent(points, disc)
    size = high - low
    bottom = paper.BOTTOM
    top = paper.TOP - _told(figure, about)
    wide, deep, tall = size
    room = PAPER[0] - 2 * EDGE - 3 * _ROOM, top - bottom - 4 * _ROOM
    scale = paper.scale_of(max((wide + deep) / room[0], (deep + tall) / room[1]))
    left = (PAPER[0] - (wide + deep) / scale - 2 * _ROOM) / 2
    front = (bottom + top - (deep + tall) / scale) / 2 - _ROOM
    beside = left + wide / scale + 2 * _ROOM
    above = front + tall / scale + 2 * _ROOM
    views = {"from above": (0, 1, left, above), "front": (0, 2, left, front)}
    views["side"] = (1, 2, beside, front)
    for name, (across, up, x, y) in views.items():
        shown = [across, up]
        axes = paper.view(figure, (x, y), (low[shown], high[shown]), scale, name)
        _view(axes, points, disc, across, up)
        paper.dimension(axes, (low[up], high[up]), high[across], 8.0, scale, vertical=True)
        if up == 1:
            paper.dimension(axes, (low[0], high[0]), low[1], -8.0, scale)
            _diameter(axes, disc[0], f"Ø{2 * disc[0]:.1f}", 90.0)
    paper.title_block(figure, about, scale)


def palm_page(
    figure: matplotlib.figure.Figure,
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    printed: Printed | None,
    process: Process | None,
    about: About,
) -> None:
    """The palm from above: seats, holes of their screws, and the circle of screws to the wrist."""
    radius = 1e3 * scene.hand.palm.radius
    position, turn = (np.asarray(v) for v in mounts(scene.hand, np.asarray(params.spread)))
    turns = Rotation.from_quat(turn, scalar_first=True)
    reach = max(radius, 1e3 * float(np.hypot(*position[:, :2].T).max()) + 34)
    scale = paper.scale_of(2 * reach / (PAPER[0] - 2 * EDGE - 20))
    side = 2 * reach / scale
    low = np.array([-reach, -reach])
    bottom = (PAPER[1] + BLOCK - side) / 2
    corner = (PAPER[0] - side) / 2, bottom
    axes = paper.view(figure, corner, (low, -low), scale, "palm from above")
    axes.add_patch(matplotlib.patches.Circle((0, 0), radius, facecolor="0.95", edgecolor="0.3"))
    screws = _screws(sizes, process) if printed and process else [[] for _ in sizes]
    for f, place in enumerate(1e3 * position):
        _seat(axes, f, sizes[f], (place, turns[f]), screws[f])
    _diameter(axes, radius, f"palm Ø{2 * radius:.1f}", 270.0)
    words = (
        "Grey: seats, seen from above; white: the fingers' roots in them; red: edge of the fabric "
    )
    words += "at the finger's base, with its middle and azimuth; small circles: places of the "
    words += "clamp bars' screws. "
    if printed and printed.flange:
        diameter, thread, start, sunk = printed.flange
        _circle_of_screws(axes, diameter, start)
        _diameter(axes, diameter / 2, f"4 x {thread} on Ø{diameter:g}", 90.0)
        words += f"Screws to the wrist at {start:g}° and every 90° from x"
        words += ", heads sunk. " if sunk else ". "
    axes.annotate("", (14, 0), (0, 0), arrowprops={"arrowstyle": "->", "lw": 0.7})
    axes.text(15, 0, "x", fontsize=_FONT, va="center")
    figure.text(0.06, 0.2, textwrap.fill(words, 120), fontsize=7, va="top")
    paper.title_block(figure, about, scale)


def _extent(points: np.ndarray, disc: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of fingers and palm [mm], shape (3,) each."""
    radius, thick = disc
    flat = points.reshape(-1, 3)
    palm = np.array([[-radius, -radius, 0.0], [radius, radius, thick]])
    every = np.concatenate([flat, palm])
    return every.min(0), every.max(0)


def _view(axes: Axes, fingers: np.ndarray, disc: tuple[float, float], across: int, up: int) -> None:
    """Outlines of palm and fingers by their coordinates to the right and upwards."""
    radius, thick = disc
    palm: matplotlib.patches.Patch = matplotlib.patches.Circle((0, 0), radius)
    if up == 2:
        palm = matplotlib.patches.Rectangle((-radius, 0), 2 * radius, thick)
    palm.set(facecolor="0.93", edgecolor="0.4", lw=0.7, clip_on=False)
    axes.add_patch(palm)
    depth = 3 - across - up
    toward = -1 if depth == 1 else 1  # the front is seen from -y
    for f in np.argsort(toward * fingers[..., depth].mean(1)):
        flat = fingers[f][:, [across, up]]
        outline = flat[ConvexHull(flat).vertices]
        axes.fill(*outline.T, facecolor="#cfdcec", edgecolor="black", lw=0.7, clip_on=False)
        axes.plot(*flat[[0, 1, 5, 4, 0]].T, color="tab:red", lw=0.9, clip_on=False)
        x, y = flat[4:].mean(0)
        axes.text(x, y, str(f), ha="center", va="center", fontsize=8)


def _diameter(axes: Axes, radius: float, words: str, angle: float) -> None:
    """A leader from a circle about the middle to its diameter in words."""
    way = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    arrow = {"arrowstyle": "-|>", "lw": 0.5, "shrinkB": 0, "mutation_scale": 6}
    axes.annotate(
        words,
        tuple(radius * way),
        tuple(0.55 * radius * way),
        arrowprops=arrow,
        fontsize=_FONT + 1,
        ha="center",
        va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8, "alpha": 0.8},
    )


def _screws(sizes: Sequence[Size], process: Process) -> list[list[tuple[float, float]]]:
    from codesign_jax.export import palm  # needs the extra

    return [palm.screws(size, process) for size in sizes]


def _seat(
    axes: Axes,
    finger: int,
    size: Size,
    base: tuple[np.ndarray, Rotation],
    screws: Sequence[tuple[float, float]],
) -> None:
    """A seat with the holes of its bar, seen from above, and where it stands.

    Args:
      base: Middle of the finger's base [mm], and the turn of its frame: x along the finger.
      screws: Along and across the finger from its base [mm].
    """
    place, turn = base

    def put(*points: tuple[float, float, float]) -> np.ndarray:
        return (place + turn.apply(points))[:, :2]

    def box(x: float, y: float, z: tuple[float, float]) -> np.ndarray:
        flat = put(*itertools.product((x, 0.0), (-y, y), z))
        return flat[ConvexHull(flat).vertices]

    half = size.base.width / 2
    outer = box(-size.root - BACK, half + CHEEK, (-FLOOR, size.pressed))
    inner = box(-size.root, half, (0.0, size.base.height))
    for outline, shade in ((outer, "0.85"), (inner, "white")):
        patch = matplotlib.patches.Polygon(outline, facecolor=shade, edgecolor="0.2", lw=0.7)
        axes.add_patch(patch)
    axes.plot(*put((0, -half, 0), (0, half, 0)).T, color="tab:red", lw=1.6)
    for x, y in screws:
        [middle] = put((x, y, size.pressed))
        hole = matplotlib.patches.Circle(middle, 1.25, facecolor="white", edgecolor="black")
        axes.add_patch(hole)
    away = place[:2] / max(float(np.hypot(*place[:2])), 1e-9)
    furthest = max(float(np.max(outer @ away)), float(np.max(inner @ away)))
    forward = turn.apply((1.0, 0.0, 0.0))
    azimuth = np.degrees(np.arctan2(forward[1], forward[0]))
    words = f"finger {finger}\n({place[0]:.1f}, {place[1]:.1f}), {azimuth:.1f}°"
    x, y = (furthest + 9) * away
    axes.text(x, y, words, fontsize=_FONT, ha="center", va="center")


def _circle_of_screws(axes: Axes, diameter: float, start: float) -> None:
    circle = matplotlib.patches.Circle(
        (0, 0), diameter / 2, facecolor="none", edgecolor="0.4", lw=0.6, ls="-."
    )
    axes.add_patch(circle)
    for k in range(4):
        at = np.radians(start + 90 * k)
        middle = diameter / 2 * np.array([np.cos(at), np.sin(at)])
        axes.add_patch(
            matplotlib.patches.Circle(middle, 2.2, facecolor="white", edgecolor="black", lw=0.8)
        )


def _told(figure: matplotlib.figure.Figure, about: About) -> float:
    """Writes verdict and warnings below the title; returns the height that they take [mm]."""
    verdict = about.verdict or "not judged at accuracy reference"
    paragraphs = [f"Verdict: {verdict}", *(f"Warning: {words}" for words in about.warnings)]
    font = fonts.of_text("\n".join(paragraphs))
    lines = [line for words in paragraphs for line in textwrap.wrap(words, _WIDE)]
    if len(lines) > _LINES:
        lines = [*lines[: _LINES - 1], f"… {len(lines) - _LINES + 1} more lines: {NAME}.md"]
    figure.text(
        0.06,
        1 - 22 / PAPER[1],
        "\n".join(lines),
        fontsize=7,
        va="top",
        family=font.family,
        parse_math=False,
    )
    return 3.4 * len(lines)
