"""Pages of the build sheet's drawings: the fingers to scale, and how they bend without load."""

import textwrap
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import matplotlib.figure
import matplotlib.patches
import numpy as np
from matplotlib.axes import Axes

from codesign_jax.export import paper, valves
from codesign_jax.export.paper import BOTTOM, EDGE, PAPER, TOP, About
from codesign_jax.export.process import Section, Size
from codesign_jax.model import morphology
from codesign_jax.report.bodies import finger_color
from codesign_jax.scene import Scene, section_law
from codesign_jax.types import Params

_SIDE = 14.0  # left of a section, for its height [mm on paper]
_ABOVE = 16.0  # above a finger, for its chamber and its title
_BELOW = 14.0


def fingers_page(
    figure: matplotlib.figure.Figure, rows: Sequence[tuple[Size, list[int]]], about: About
) -> None:
    """Sections and sides of fingers, a row for each size, in one scale.

    Args:
      figure: A page whose title stands already.
      rows: Sizes with the fingers that have them.
    """
    tapered = any(size.base != size.tip for size, _ in rows)
    wide = max(size.base.width for size, _ in rows)
    long = max(size.length + size.root for size, _ in rows)
    tall = sum(max(size.base.height, size.tip.height) for size, _ in rows)
    sections = 2 if tapered else 1
    across = PAPER[0] - 2 * EDGE - (sections + 1) * _SIDE
    up = TOP - BOTTOM - len(rows) * (_ABOVE + _BELOW)
    scale = paper.scale_of(max((sections * wide + long) / across, tall / up))
    top = TOP
    for size, fingers in rows:
        label = f"finger {', '.join(map(str, fingers))}"
        top -= _ABOVE + max(size.base.height, size.tip.height) / scale
        profiles = (size.base, size.tip) if size.base != size.tip else (size.base,)
        for k, section in enumerate(profiles):
            end = (", base", ", tip")[k] if len(profiles) > 1 else ""
            left = EDGE + _SIDE + k * (wide / scale + _SIDE)
            _section(figure, (left, top), section, scale, f"{label}{end}")
        left = EDGE + sections * (wide / scale + _SIDE) + _SIDE
        _side_view(figure, (left, top), size, scale, f"{label}, along")
        top -= _BELOW
    words = "Red: fabric. Left of the dashed line: the root. Right of a section: its walls."
    paper.note(figure, BOTTOM + 2, words)
    paper.title_block(figure, about, scale)


def _box(axes: Axes, low: tuple[float, float], size: tuple[float, float], color: str) -> None:
    axes.add_patch(
        matplotlib.patches.Rectangle(
            low, *size, facecolor=color, edgecolor="black", lw=0.7, clip_on=False
        )
    )


def _section(
    figure: matplotlib.figure.Figure,
    place: tuple[float, float],
    section: Section,
    scale: int,
    title: str,
) -> None:
    width, height, wall = section
    span = (-width / 2, 0.0), (width / 2, height)
    axes = paper.view(figure, place, span, scale, title)
    _box(axes, (-width / 2, 0), (width, height), "0.8")
    _box(axes, (-section.chamber[0] / 2, wall), section.chamber, "white")
    axes.plot([-width / 2, width / 2], [0, 0], color="tab:red", lw=2, clip_on=False)
    ends = 0.0, wall
    paper.dimension(axes, ends, width / 2, 4.0, scale, vertical=True, words=f"{wall:.2f}")
    paper.dimension(axes, (-width / 2, width / 2), 0.0, -6.0, scale)
    paper.dimension(axes, (0.0, height), -width / 2, -6.0, scale, vertical=True)


def _side_view(
    figure: matplotlib.figure.Figure,
    place: tuple[float, float],
    size: Size,
    scale: int,
    title: str,
) -> None:
    start, end = size.chamber_ends
    first = size.at(start)
    last = size.at(end)
    root = size.at(-size.root).height
    high = max(size.base.height, size.tip.height)
    span = (-size.root, 0.0), (size.length, high)
    axes = paper.view(figure, place, span, scale, title, pad=26)
    outer = [(-size.root, 0), (size.length, 0), (size.length, size.tip.height), (-size.root, root)]
    inner = [(start, first.wall), (end, last.wall)]
    inner += [(end, last.height - last.wall), (start, first.height - first.wall)]
    for outline, color in ((outer, "0.8"), (inner, "white")):
        patch = matplotlib.patches.Polygon(outline, facecolor=color, edgecolor="0.3", lw=0.8)
        patch.set_clip_on(False)
        axes.add_patch(patch)
    axes.plot([-size.root, size.length], [0, 0], color="tab:red", lw=2, clip_on=False)
    axes.plot([0, 0], [0, size.base.height], color="black", lw=0.8, ls="--")
    chambers = dict.fromkeys("{:.2f} x {:.2f}".format(*s.chamber) for s in (first, last))
    words = f"chamber {end - start:.2f} x {' to '.join(chambers)}"
    paper.dimension(axes, (start, end), high, 4.0, scale, words=words)
    paper.dimension(axes, (0.0, size.length), 0.0, -6.0, scale)
    if size.root:
        words = f"root {size.root:g}"
        axes.text(-size.root / 2, -3 * scale, words, ha="center", va="center", fontsize=6)


class Bend:
    """A finger in free bend, without load and weight."""

    def __init__(self, scene: Scene, params: Params, finger: int) -> None:
        """Takes the hand, and of its fingers the one that bends at its highest command."""
        pressures = 1e3 * valves.key_pressures(scene, params)[:, 1:].max(0)
        commanded = params._replace(pressure=pressures)
        law = bool(scene.effects.neo_hookean)
        curvature = morphology.free_curvatures(scene.hand, commanded, neo_hookean=law)[finger]
        self.pressure = float(pressures[finger])
        self.length = 1e3 * float(params.length[finger])
        self.angle = float(curvature.mean()) * self.length / 1e3
        self.fabric = _line(1e-3 * curvature, self.length)
        self.air = _air(scene, commanded, finger, curvature)


def _line(curvature: np.ndarray, length: float) -> np.ndarray:
    """Places of a line that bends downwards from the x axis [mm], (place, 2).

    Args:
      curvature: At equal parts of the line [1/mm].
      length: Of the line, which the fabric keeps [mm].
    """
    steps = 400
    along = (np.arange(steps) + 0.5) * length / steps
    places = (np.arange(len(curvature)) + 0.5) * length / len(curvature)
    slope = np.cumsum(np.interp(along, places, curvature)) * length / steps
    slope -= slope[0] / 2  # at the middles of the steps
    parts = np.stack([np.cos(slope), -np.sin(slope)], 1) * length / steps
    return np.concatenate([np.zeros((1, 2)), np.cumsum(parts, 0)])


def _air(
    scene: Scene, params: Params, finger: int, curvature: np.ndarray
) -> tuple[float, float] | None:
    """Volume of the chamber over the fabric's length, bent and at rest, means [mm^2].

    None where the section's law is that of the undeformed chamber.
    """
    if scene.hand.section.law != "elements":
        return None
    numbers = morphology.law_numbers(scene.hand, params, curvature.shape[-1])
    of_finger = jax.tree.map(lambda v: jnp.asarray(v)[finger], numbers)
    bent = jnp.asarray(curvature)
    straight = 0.0 * bent
    pressures = straight + float(params.pressure[finger]), straight
    volumes = [
        section_law.volume(of_finger, p, straight, bend, straight)
        for p, bend in zip(pressures, (bent, straight), strict=True)
    ]
    filled, rest = (1e6 * float(np.mean(volume)) for volume in volumes)
    return filled, rest


def bends_page(
    figure: matplotlib.figure.Figure, scene: Scene, params: Params, about: About
) -> None:
    """The fabric of each finger in free bend at its commanded pressure, from one base."""
    bends = [Bend(scene, params, f) for f in range(scene.num_fingers)]
    every = np.concatenate([bend.fabric for bend in bends])
    low = every.min(0)
    high = np.maximum(every.max(0), [max(bend.length for bend in bends), 0.0])
    room = PAPER[0] - 2 * EDGE - 30, 130.0
    scale = paper.scale_of(float(np.max((high - low) / room)))
    size = (high - low) / scale
    corner = (PAPER[0] - size[0]) / 2, TOP - 24 - size[1]
    title = "free bend of the fabric, from the side"
    axes = paper.view(figure, corner, (low, high), scale, title, pad=34)
    axes.plot([0, high[0]], [0, 0], color="0.4", lw=0.6, ls="--", clip_on=False)
    longest = max(bend.length for bend in bends)
    paper.dimension(axes, (0.0, longest), 0.0, 8.0, scale)
    alike: dict[tuple[float, ...], list[int]] = {}
    for f, bend in enumerate(bends):
        axes.plot(*bend.fabric.T, color=finger_color(f), lw=1.4, clip_on=False)
        alike.setdefault(tuple(bend.fabric[-1].round(1)), []).append(f)
    for (x, y), fingers in alike.items():
        words = ", ".join(map(str, fingers))
        axes.text(x, y - 2 * scale, words, fontsize=8, ha="center", va="top")
    _table(figure, bends, corner[1] - 12)
    paper.note(figure, BOTTOM + 22, textwrap.fill(_limits(scene), 125))
    paper.title_block(figure, about, scale)


def _table(figure: matplotlib.figure.Figure, bends: Sequence[Bend], top: float) -> None:
    head = ["finger", "commanded kPa", "free bend °", "tip along mm", "tip down mm"]
    if any(bend.air for bend in bends):
        head += ["air mm³/mm", "at rest mm³/mm"]
    rows = [head]
    for f, bend in enumerate(bends):
        x, y = bend.fabric[-1]
        row = [str(f), f"{bend.pressure / 1e3:.1f}", f"{np.degrees(bend.angle):.0f}"]
        row += [f"{x:.1f}", f"{0.0 - y:.1f}", *(f"{air:.0f}" for air in bend.air or ())]
        rows.append(row)
    column = (PAPER[0] - 2 * EDGE) / 7
    for r, row in enumerate(rows):
        for k, words in enumerate(row):
            x = (EDGE + k * column) / PAPER[0]
            figure.text(x, (top - 5 * r) / PAPER[1], words, fontsize=7, va="top")


def _limits(scene: Scene) -> str:
    """What the drawing has by the section's law, and what it has not."""
    words = (
        "The fabric keeps its length and bends as a finger does without load and weight, at the "
        "highest pressure that is commanded. "
    )
    if scene.hand.section.law != "elements":
        return words + (
            "Beam theory has no deformed section: it knows how far a finger bends, not how its "
            "walls bulge (hand.section.law)."
        )
    return words + (
        "The law of the section has the bend and the chamber's volume (air, per length of the "
        "fabric), but no outline of the bulged section: its growth in height and width is not "
        "drawn. Finite elements of four sections: docs/notes/section.md."
    )
