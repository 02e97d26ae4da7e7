"""The drawings of the build sheet as pages of PDF: hand, fingers, seat, wrist, turns of the arm."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.backends.backend_pdf
import matplotlib.figure
import matplotlib.patches
import numpy as np
from matplotlib.axes import Axes

from codesign_jax.export import arm, finger_drawing, fonts, hand_drawing, paper, posture
from codesign_jax.export.paper import EDGE, PAPER, About
from codesign_jax.export.process import BACK, BAR, FABRIC, FLOOR, Printed, Process, Size
from codesign_jax.export.sheet import NAME, corners
from codesign_jax.report.figures import default_style
from codesign_jax.scene import Scene
from codesign_jax.types import Params

_A4 = (8.27, 11.69)
_ROWS = 4  # sizes of fingers on a page, so that usual fingers are drawn at 1:2 at least
_SEAT_SCALE = 2
# letters in a line of the title, and its lines
_WIDE = 64
_LINES = 2
NOTHING = About()
"""A title block of nothing but the scale."""


@default_style
def write(
    folder: Path,
    title: str,
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    printed: Printed | None = None,
    process: Process | None = None,
    about: About = NOTHING,
) -> list[str]:
    """Writes the PDF; returns letters of the title that no font of this system has.

    Args:
      printed: The printed parts; None where they were left out.
      process: What is decided about them; None: no drawing of the moulds.
      about: What the title block and the first page say.
    """
    path = folder / f"{NAME}.pdf"
    with matplotlib.backends.backend_pdf.PdfPages(path) as file:
        for page in pages(title, scene, params, sizes, printed, process, about):
            file.savefig(page)
    return fonts.of_text(title).lacking


@default_style
def pages(
    title: str,
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    printed: Printed | None = None,
    process: Process | None = None,
    about: About = NOTHING,
) -> list[matplotlib.figure.Figure]:
    """The pages: hand, palm, fingers and how they bend, moulds, and how it is held and turned."""
    alike = {}
    for i, size in enumerate(sizes):
        alike.setdefault(size, []).append(i)
    rows = [*alike.items()]
    first, second = _page(title), _page(title)
    hand_drawing.hand_page(first, scene, params, sizes, about)
    hand_drawing.palm_page(second, scene, params, sizes, printed, process, about)
    figures = [first, second]
    for first in range(0, len(rows), _ROWS):
        figures.append(_page(title))
        finger_drawing.fingers_page(figures[-1], rows[first : first + _ROWS], about)
    figures.append(_page(title))
    finger_drawing.bends_page(figures[-1], scene, params, about)
    if printed and process:
        figures.append(_moulds_page(title, rows, process, about))
    figures.append(_mounting_page(title, scene, params, sizes, printed, about))
    for k, page in enumerate(figures, 1):
        page.text(0.94, 0.025, f"{k} of {len(figures)}", fontsize=7, ha="right")
    return figures


def _page(title: str) -> matplotlib.figure.Figure:
    # A figure of its own instead of pyplot's: no state and no display is touched.
    figure = matplotlib.figure.Figure(figsize=_A4)
    font = fonts.of_text(title)
    # Letters of other scripts are up to twice as wide.
    width = _WIDE if font.text.isascii() else _WIDE // 2
    text = textwrap.fill(font.text, width, max_lines=_LINES, placeholder=" …")
    figure.text(
        0.06,
        0.975,
        text,
        fontsize=12,
        weight="bold" if font.family == [fonts.DEFAULT] else "normal",
        va="top",
        family=font.family,
        parse_math=False,
    )
    return figure


def _moulds_page(
    title: str, rows: list[tuple[Size, list[int]]], process: Process, about: About
) -> matplotlib.figure.Figure:
    from codesign_jax.export import mould_drawing  # needs the extra

    figure = _page(title)
    size, fingers = max(rows, key=lambda row: row[0].length)
    label = f"finger {', '.join(map(str, fingers))}"
    scale = mould_drawing.page(figure, size, process, label)
    words = (
        "The longest finger's moulds, cut along the finger's middle and across it between two "
        "bars; those of the others differ in size alone. The fabric's end hangs out over the root "
        "as the flap that the clamp bar holds."
    )
    paper.note(figure, paper.BOTTOM + 10, textwrap.fill(words, 120))
    paper.title_block(figure, about, scale)
    return figure


def _mounting_page(
    title: str,
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    printed: Printed | None,
    about: About,
) -> matplotlib.figure.Figure:
    figure = _page(title)
    hand = corners(scene, params, sizes)
    palm = 1e3 * scene.hand.palm.radius, 1e3 * scene.hand.palm.thickness
    for k, (words, angles) in enumerate(posture.TURNS.items()):
        axes = figure.add_axes((0.05 + 0.225 * k, 0.72, 0.21, 0.19))
        posture.draw(axes, hand, palm, angles, words)
    keys = arm.key_poses(scene, params)
    lowest = keys[np.argmin(keys[:, 3])]
    angles = dict(zip(("roll", "pitch", "yaw"), lowest[4:], strict=True))
    words = ", ".join(f"{name} {angles[name]:.1f}°" for name in ("roll", "yaw", "pitch"))
    axes = figure.add_axes((0.05, 0.45, 0.36, 0.23))
    posture.draw(axes, hand, palm, angles, f"this hand at its lowest key frame: {words}")
    _seat(figure, 0.46 * PAPER[1], sizes[0], scene.hand.finger[0].tilt)
    if scene.effects.wrist:
        _wrist(figure.add_axes((0.08, 0.18, 0.84, 0.23)), scene, printed)
    paper.title_block(figure, about, None)
    return figure


def _rectangle(axes: Axes, low: tuple[float, float], size: Sequence[float], color: str) -> None:
    width, height = size
    patch = matplotlib.patches.Rectangle(
        low, width, height, facecolor=color, edgecolor="black", lw=0.7
    )
    axes.add_patch(patch)


def _seat(figure: matplotlib.figure.Figure, low: float, size: Size, tilt: float) -> None:
    """A cut through the middle of a seat, in the plane of the finger.

    Args:
      low: Its lower edge on the page [mm].
    """
    root = size.root
    height = size.base.height
    rim = size.pressed
    cosine = np.cos(np.radians(tilt))
    sine = np.sin(np.radians(tilt))
    right = (height + BAR) * sine + 40 * cosine + 12
    left = PAPER[0] - EDGE - (right + 105) / _SEAT_SCALE
    span = (-45.0, -50.0), (right + 40, 48.0)
    title = f"a seat, cut along finger 0 (tilt {tilt:g}°), 1:{_SEAT_SCALE}"
    axes = paper.view(figure, (left, low), span, _SEAT_SCALE, title)

    def put(points: Sequence[tuple[float, float]], **style: Any) -> None:
        flat = [(x * cosine + z * sine, -x * sine + z * cosine) for x, z in points]
        axes.add_patch(matplotlib.patches.Polygon(flat, **{"edgecolor": "0.2", "lw": 0.8} | style))

    def box(x: tuple[float, float], z: tuple[float, float], **style: Any) -> None:
        put([(x[0], z[0]), (x[1], z[0]), (x[1], z[1]), (x[0], z[1])], **style)

    def note(x: float, z: float, text: str, to: tuple[float, float]) -> None:
        at = (x * cosine + z * sine, -x * sine + z * cosine)
        arrow = {"arrowstyle": "-", "lw": 0.5}
        axes.annotate(text, at, to, fontsize=6, arrowprops=arrow, va="center")

    back = (-root - BACK, -root - FABRIC)
    box((-root - BACK, 0), (-FLOOR - 6, 0), facecolor="0.85")
    box(back, (0, rim), facecolor="0.85")
    box((-root, 45), (0, height), facecolor="#cfdcec")
    box((size.end, 46), (size.base.wall, height - size.base.wall), facecolor="white")
    box((-root - BACK, 0), (rim, rim + BAR), facecolor="#e8c48c")
    middle = sum(back) / 2
    box((middle - 1.5, middle + 1.5), (rim - 11, rim + BAR), facecolor="0.5")
    box((middle - 2.8, middle + 2.8), (rim + BAR, rim + BAR + 3), facecolor="0.5")
    tube = (height / 2 - 1, height / 2 + 1)
    box((-root - BACK - 12, size.end + 10), tube, facecolor="white", edgecolor="tab:blue")
    flap = [(45, 0), (-root - 0.25, 0), (-root - 0.25, rim), (-root - BACK, rim)]
    path = [(x * cosine + z * sine, -x * sine + z * cosine) for x, z in flap]
    axes.plot(*np.transpose(path), color="tab:red", lw=1.6)
    axes.axhline(0, color="0.4", lw=0.6, ls=":")
    note(middle, rim + BAR + 3, "screw M3", (right, 32))
    note(-3, rim + BAR, f"clamp bar, {BAR:g} thick", (right, 22))
    note(-root / 2, height * 0.75, f"root, {root:g} long", (right, 12))
    note(5, height, "finger", (right, 2))
    note(-root - 0.25, rim * 0.25, "flap of fabric", (-42, 30))
    note(-root - BACK - 10, height / 2, "tube", (-42, 20))
    note(-root - 4, -FLOOR - 3, "palm", (-42, 10))
    note(-root - BACK / 2, rim * 0.6, f"back wall {BACK:g}, rim {rim:.1f} high", (right, -8))
    axes.text(-42, 0, "underside, z = 0", fontsize=6, va="bottom")


def _wrist(axes: Axes, scene: Scene, printed: Printed | None) -> None:
    """The compliant wrist as stages above one another, seen from the side."""
    wrist = scene.hand.wrist
    k = wrist.linear_stiffness
    turn = wrist.angular_stiffness
    damping = wrist.linear_damping
    stages = [f"guide along {axis}" for axis in "zyx"]
    each = f"two springs {k / 2e3:.3g} N/mm against each other, dashpot {damping:g} N s/m"
    _rectangle(axes, (20, 70), (60, 10), "0.7")
    axes.text(50, 75, "flange of the arm", ha="center", va="center", fontsize=6)
    for i, stage in enumerate(stages):
        low = 54 - 16 * i
        _rectangle(axes, (28, low), (44, 9), "0.88")
        axes.text(50, low + 4.5, stage, ha="center", va="center", fontsize=6)
        for side in (-1, 1):
            x = 50 + side * np.linspace(22, 34, 40)
            axes.plot(x, low + 4.5 + 2 * np.sin(np.linspace(0, 10 * np.pi, 40)), "0.3", lw=0.7)
            axes.plot([50 + side * 34] * 2, [low, low + 9], color="black", lw=1.2)
        axes.plot([50, 50], [low + 9, low + 16], color="0.5", lw=3)
        axes.text(88, low + 4.5, each, va="center", fontsize=6)
    words = f"four rubber buffers, together {turn:g} N m/rad about each axis"
    if printed and printed.flange:
        words += f", on the circle of {printed.flange[0]:g} mm"
    for x in (36, 58):
        _rectangle(axes, (x, 12), (6, 10), "0.4")
    axes.text(88, 17, words, va="center", fontsize=6)
    _rectangle(axes, (15, 2), (70, 10), "0.93")
    axes.text(50, 7, "palm", ha="center", va="center", fontsize=6)
    _finish(
        axes, "the wrist of the simulation, built (not to scale; or an arm with impedance control)"
    )
    axes.set(xlim=(0, 175), ylim=(0, 84))


def _finish(axes: Axes, title: str) -> None:
    axes.set_aspect("equal")
    axes.axis("off")
    axes.set_title(title, fontsize=7, parse_math=False)
