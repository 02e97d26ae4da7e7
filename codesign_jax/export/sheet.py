"""The build sheet: the template `build_sheet.md.jinja` with the numbers of a hand."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from scipy.spatial.transform import Rotation

from codesign_jax import terminal
from codesign_jax.export import arm, pose, quantities, valves
from codesign_jax.export.process import FABRIC, Printed, Process, Size, inlet
from codesign_jax.judge import stress
from codesign_jax.judge.stress import Stress
from codesign_jax.judge.worth import Worth
from codesign_jax.model import morphology
from codesign_jax.model.layout import mounts
from codesign_jax.scene import Scene
from codesign_jax.tolerances import Yield
from codesign_jax.types import Params

NAME = "build_sheet"
IDLE = 10.0
"""Travel of a tip under the design's pressure below which a finger does next to nothing [mm]."""
_FURTHEST = 2.331
"""Bend at which the tip of a finger of constant curvature is furthest to the side [rad]."""


class Tests(NamedTuple):
    """What is known of the design beside its dimensions."""

    verdict: str | None = None
    stress: Stress | None = None
    worth: Worth | None = None
    cast: Yield | None = None
    warnings: Sequence[str] = ()


class Hand(NamedTuple):
    """A hand to build."""

    scene: Scene
    params: Params
    sizes: Sequence[Size]
    process: Process
    printed: Printed | None = None  # None: the parts were left out


def text(hand: Hand, tests: Tests, origin: dict[str, Any], speeds: tuple[float, float]) -> str:
    """The sheet as Markdown.

    Args:
      hand: What to build.
      tests: What is known of it.
      origin: Texts `design`, `command` and `version`, and lists of texts `objects` and `notes`.
      speeds: Largest speed [mm/s] and turning speed [deg/s] of the arm, as of `arm.speeds`.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        finalize=_plain,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"fixed": _fixed, "general": _general}
    template = environment.get_template(f"{NAME}.md.jinja")
    return template.render(
        scene=hand.scene,
        hand=hand.scene.hand,
        wrist=hand.scene.hand.wrist,
        sizes=hand.sizes,
        printed=hand.printed,
        origin=origin,
        **{key: origin[key] for key in ("version", "objects", "notes")},
        speeds=speeds,
        table=_table,
        **_tested(hand, tests),
        **_fingers(hand),
        **_arm(hand),
        **_air(hand),
        **_castings(hand),
        **_prints(hand),
        **_mount(hand),
    )


class _Safe(str):
    """Markdown of the sheet's own."""


def _plain(value: Any) -> Any:
    """A text as one line without HTML, links, pictures and cells: it may be a stranger's."""
    if not isinstance(value, str) or isinstance(value, _Safe):
        return value
    words = terminal.line(value.replace("\n", " "))
    return words.replace("|", "\\|").replace("<", "&lt;").replace("](", "]\\(")


def _fixed(value: float, digits: int = 0) -> str:
    return f"{round(float(value), digits) + 0.0:.{digits}f}"  # + 0.0 writes -0 as 0


def _general(value: float, digits: int = 6) -> str:
    return f"{value:.{digits}g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return _Safe("\n".join(f"| {' | '.join(map(_plain, line))} |" for line in lines))


def warnings(hand: Hand, tests: Tests) -> list[str]:
    """Warnings of the design and of its parts, a sentence each."""
    sentences = stress.of_design(hand.scene, hand.params)
    sentences += [*(tests.stress.warnings if tests.stress else ())]
    sentences += idle_fingers(hand.scene, hand.params, hand.sizes)
    sentences += twisting_fingers(hand.scene, hand.params)
    sentences += thread_inside(hand.scene)
    return [*sentences, *tests.warnings]


def _tested(hand: Hand, tests: Tests) -> dict[str, Any]:
    return {
        "verdict": tests.verdict,
        "stress": tests.stress,
        "worth": tests.worth,
        "cast": tests.cast,
        "warnings": warnings(hand, tests),
    }


def idle_fingers(scene: Scene, params: Params, sizes: Sequence[Size]) -> list[str]:
    """Fingers that do next to nothing, a sentence each."""
    sentences = []
    bends = morphology.free_bends(scene.hand, params)
    for i, (size, bend) in enumerate(zip(sizes, bends, strict=True)):
        angle = float(bend)
        reached = min(abs(angle), _FURTHEST)
        travel = size.length * (1 - np.cos(reached)) / reached if reached else 0.0
        if travel < IDLE:
            sentences.append(
                f"finger {i} does next to nothing: {size.length:.0f} mm long, it bends by "
                f"{np.degrees(angle):.0f}° and moves its tip by {travel:.1f} mm. It may be left "
                "out, with its seat empty and its tube plugged; the simulation "
                "has it"
            )
    return sentences


def twisting_fingers(scene: Scene, params: Params) -> list[str]:
    """Fingers that twist where an object holds them straight, a sentence each."""
    lacks = "; the simulation lacks it" if scene.hand.section.law == "chamber" else ""
    unstable = morphology.twists_by_itself(scene.hand, params)
    return [
        f"finger {i} twists by itself where it is held straight at "
        f"{float(params.pressure[i]) / 1e3:.0f} kPa: its walls are thin for that pressure" + lacks
        for i in np.flatnonzero(unstable)
    ]


def thread_inside(scene: Scene) -> list[str]:
    """A sentence where the thread's place is not the one that the sheet's steps give it."""
    depth = float(scene.hand.section.thread_depth)
    if not depth:
        return []
    return [
        f"hand.section.thread_depth = {depth:g}: the thread lies in the wall, but the steps "
        "of this sheet wind it around the outside, where fingers bend further; cast the wall in "
        "two layers with the thread between them"
    ]


def _fingers(hand: Hand) -> dict[str, Any]:
    scene, params, sizes, *_ = hand
    density = scene.hand.material.density
    limits = morphology.pressure_limits(scene.hand, params)
    law = bool(scene.effects.neo_hookean)
    bends = morphology.free_bends(scene.hand, params, neo_hookean=law)
    outside = morphology.section_bends(scene.hand, params, thread_depth=0.0)
    inside = morphology.section_bends(scene.hand, params, thread_depth=1.0)
    rows = []
    for i, (size, angle) in enumerate(zip(sizes, bends, strict=True)):
        ends = list(dict.fromkeys((size.base, size.tip)))  # one, unless it is tapered
        start, end = size.chamber_ends
        chambers = [" x ".join(f"{v:.2f}" for v in size.at(x).chamber) for x in (start, end)]
        rows.append(
            (
                str(i),
                f"{size.length:.2f}",
                *(" to ".join(f"{s[k]:.2f}" for s in ends) for k in range(2)),
                " to ".join(f"{s.wall:.2f}" for s in ends),
                f"{end - start:.2f} x {' to '.join(dict.fromkeys(chambers))}",
                f"{size.volume / 1e3:.1f}",
                f"{1e-6 * size.volume * density:.1f}",
                f"{float(params.pressure[i]) / 1e3:.1f} ({limits[i] / 1e3:.0f})",
                f"{np.degrees(angle):.0f}",
                f"{np.degrees(inside[i]):.0f} to {np.degrees(outside[i]):.0f}",
            )
        )
    end_walls = "as thick as the others"
    if any(size.end != size.base.wall for size in sizes):
        end_walls = f"{', '.join(dict.fromkeys(f'{size.end:.2f}' for size in sizes))} mm"
    position, azimuth = quantities.base_frames(scene, params)
    mount_rows = [
        (str(i), f"{x:.1f}", f"{y:.1f}", f"{np.degrees(angle):.1f}", f"{finger.tilt:.1f}")
        for i, (finger, (x, y), angle) in enumerate(
            zip(scene.hand.finger, 1e3 * position, azimuth, strict=True)
        )
    ]
    head = ("finger", "length mm", "width mm", "height mm", "wall mm", "chamber mm")
    head += ("silicone cm³", "mass g", "pressure kPa (limit)", "free bend °", "by elements °")
    strains = None if params.tip is not None else quantities.limit_strains(scene, params)
    return {
        "finger_head": head,
        "finger_rows": rows,
        "end_walls": end_walls,
        "limit_strains": strains,
        "law_of_bends": (
            "beam theory" if scene.hand.section.law == "chamber" else "the law of its section"
        ),
        "mount_rows": mount_rows,
        "spread": np.degrees(float(params.spread)),
    }


def _arm(hand: Hand) -> dict[str, Any]:
    scene, params, sizes, *_ = hand
    rows = []
    for time, x, y, z, roll, pitch, yaw in arm.key_poses(scene, params):
        angles = {"roll": roll, "yaw": yaw, "pitch": pitch}
        turn = pose.quaternion(**angles)
        cells = [f"{v + 0.0:.1f}" for v in (x, y, z, *(angles[a] for a in pose.ANGLES))]
        rows.append((f"{time:g}", *cells, " ".join(f"{v + 0.0:.4f}" for v in turn)))
    head = ("time s", "x mm", "y mm", "z mm", *(f"{name} °" for name in pose.ANGLES))
    holds = [i for i, f in enumerate(scene.control.frame) if f.interpolation == "held"]
    held = f", but held after row {', '.join(str(i + 1) for i in holds)}" if holds else ""
    heights = quantities.tip_heights(scene, params, corners(scene, params, sizes))
    spacer = arm.spacer(scene, params)
    return {
        "arm_head": (*head, "quaternion w x y z"),
        "arm_rows": rows,
        "held": held,
        "convention": pose.CONVENTION,
        "rim": quantities.rim_clearance(scene, params),
        "sag": quantities.sag(scene, sizes),
        "tips": heights,
        "pressed": -float(heights.min()),
        "drop": quantities.drop(scene, params),
        "spacer": None if spacer is None else 5 * math.ceil(spacer / 5),
        "last_link": arm.LAST_LINK,
    }


class Line(NamedTuple):
    """A pressure line."""

    name: str
    limit: float  # of the walls of its fingers [kPa]
    highest: float  # commanded pressure [kPa]
    flow: float  # air that fills its chambers [l/min, ANR]


def pressure_lines(hand: Hand) -> list[Line]:
    """The hand's pressure lines."""
    scene, params, sizes, *_ = hand
    groups = valves.lines(scene, params)
    names = [valves.name_of(*group) for group in enumerate(groups)]
    limits = valves.line_limits(scene, params)
    highest = valves.line_pressures(scene, params)[:, 1:].max(0)
    flow = quantities.flows(scene, params, sizes)
    flows = [float(flow[[*fingers]].sum()) for fingers in groups]
    return [Line(*line) for line in zip(names, limits, highest, flows, strict=True)]


def _air(hand: Hand) -> dict[str, Any]:
    scene, params, sizes, *_ = hand
    lines = pressure_lines(hand)
    highest = max(line.highest for line in lines)
    top = quantities.regulator_range(highest)
    rows = [
        (f"{time:g}", *(f"{p:.1f}" for p in pressures))
        for time, *pressures in valves.line_pressures(scene, params)
    ]
    groups = valves.lines(scene, params)
    tubes = [inlet(size, hand.process) or 2.0 for size in sizes]
    return {
        "lines": lines,
        "pressure_head": ("time s", *(f"{line.name} kPa" for line in lines)),
        "pressure_rows": rows,
        "highest": highest,
        "highest_by_finger": valves.key_pressures(scene, params)[:, 1:].max(0),
        "top": top,
        "regulator": quantities.REGULATORS.get(top),
        "flow": sum(line.flow for line in lines),
        "branches": [str(len(fingers)) for fingers in groups if len(fingers) > 1],
        "tubes": ", ".join(f"{d:g} mm" for d in dict.fromkeys(tubes)),
    }


def _castings(hand: Hand) -> dict[str, Any]:
    material = hand.scene.hand.material
    law = bool(hand.scene.effects.neo_hookean)
    named = quantities.silicone_of(material)
    silicone = named or quantities.nearest_silicone(material, neo_hookean=law)
    grams = 1e-6 * material.density * (1 + quantities.LOSS)
    bottoms = [quantities.bottom(size) for size in hand.sizes]
    crossed = hand.scene.hand.section.winding == "crossed"
    return {
        "source": "the makers' technical bulletins (Smooth-On, Dragon Skin and Ecoflex series)",
        "silicone": silicone,
        "silicone_named": named is not None,
        "law": "neo-Hookean" if law else "linear",
        "loss": quantities.LOSS,
        "volume": sum(size.volume for size in hand.sizes) / 1e3,
        "share_a": silicone.mix[0] / sum(silicone.mix),
        "castings": [
            (grams * (size.volume - part), grams * part)
            for size, part in zip(hand.sizes, bottoms, strict=True)
        ],
        "fabrics": [quantities.fabric(size) for size in hand.sizes],
        "fabric_room": FABRIC,
        "thread": quantities.thread(hand.sizes),
        "spare": quantities.SPARE,
        "crossed": crossed,
        "pitch": quantities.PITCH if crossed else quantities.PITCH / 2,
        "first_inflation": quantities.FIRST_INFLATION,
        "pins": sum(inlet(size, hand.process) > 0 for size in hand.sizes),
    }


def _prints(hand: Hand) -> dict[str, Any]:
    printed = hand.printed
    if printed is None:
        return {"parts": [], "plastic_mass": 0.0, "ballast": 0.0}
    parts = []
    for name in printed.names:
        words = name.split("_")
        kinds = [word for word in words if word in ("palm", "bar", "tray", "core", "base")]
        fingers = [word for word in words if word.isdigit()]
        parts.append({"name": name, "kind": "".join(kinds), "fingers": fingers})
    mass = quantities.PLASTIC * printed.palm_volume
    ballast = 1e3 * hand.scene.hand.palm.mass - mass
    return {"parts": parts, "plastic_mass": mass, "ballast": ballast}


def _mount(hand: Hand) -> dict[str, Any]:
    scene = hand.scene
    wrist = scene.hand.wrist
    mass = quantities.hand_mass(scene, hand.sizes)
    screws = quantities.flange_screws(1e3 * scene.hand.palm.thickness, hand.printed)
    buffers = None
    if screws:
        radius = 5e-4 * screws.diameter
        stiffness = 1e-3 * wrist.angular_stiffness / radius**2
        buffers = {"along": stiffness / 2, "across": stiffness / 4}
    return {
        "mass": mass,
        "screws": screws,
        "buffers": buffers,
        "travel": 10 * math.ceil((quantities.sag(scene, hand.sizes) + 30) / 10),
        "damping_ratio": wrist.linear_damping / (2 * math.sqrt(wrist.linear_stiffness * mass)),
        "gravity": quantities.GRAVITY,
        "degree": math.pi / 180,
    }


def corners(scene: Scene, params: Params, sizes: Sequence[Size]) -> np.ndarray:
    """Corners of the straight fingers in the palm's frame [mm], shape (finger, 8, 3).

    The first four are those of the base, around it, the first two on the fabric.
    """
    position, turn = (np.asarray(v) for v in mounts(scene.hand, np.asarray(params.spread)))
    fingers = []
    for size, place, (w, x, y, z) in zip(sizes, position, turn, strict=True):
        ends = [(0.0, size.base), (size.length, size.tip)]
        outline = [
            (along, side * section.width / 2, up * section.height)
            for along, section in ends
            for side, up in ((-1, 0), (1, 0), (1, 1), (-1, 1))
        ]
        fingers.append(1e3 * place + Rotation.from_quat([x, y, z, w]).apply(outline))
    return np.array(fingers)


def write(
    folder: Path, hand: Hand, tests: Tests, origin: dict[str, Any], speeds: tuple[float, float]
) -> Path:
    """Writes the sheet; arguments as of `text`."""
    path = folder / f"{NAME}.md"
    path.write_text(text(hand, tests, origin, speeds), encoding="utf-8")
    return path
