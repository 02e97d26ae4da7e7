"""The build sheet: what to build, how to drive it, and how far it may be off."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from codesign_jax import stress, terminal
from codesign_jax.export import pose, valves
from codesign_jax.export.process import Size
from codesign_jax.model import morphology
from codesign_jax.model.layout import mounts
from codesign_jax.scene import Scene
from codesign_jax.stress import Stress
from codesign_jax.tolerances import Yield
from codesign_jax.types import Params

NAME = "build_sheet"


class SheetSection(NamedTuple):
    """A part of the sheet: a title, a table (or none) and sentences below it."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
    notes: list[str]


Tested = tuple[str | None, Stress | None]


def sheet_sections(
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    cast: Yield | None,
    tested: Tested = (None, None),
) -> list[SheetSection]:
    """The sheet's content."""
    return [
        _tests(scene, params, sizes, *tested),
        _fingers(scene, params, sizes),
        _mounts(scene, params),
        _arm(scene, params, sizes),
        _valves(scene, params),
        tolerance_section(cast),
    ]


def _tests(
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    verdict: str | None,
    result: Stress | None,
) -> SheetSection:
    title = f"Verdict: {verdict or 'not judged at accuracy reference'}"
    warnings = stress.of_design(scene, params) + [*(result.warnings if result else ())]
    warnings += idle_fingers(scene, params, sizes)
    notes = [f"Warning: {words}." for words in warnings]
    if not result:
        return SheetSection(title, (), [], notes)
    return SheetSection(title, result.head, result.rows, notes)


IDLE = 10.0
"""Travel of a tip under the design's pressure below which a finger does next to nothing [mm]."""
_FURTHEST = 2.331
"""Bend at which the tip of a finger of constant curvature is furthest to the side [rad]."""


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


def _fingers(scene: Scene, params: Params, sizes: Sequence[Size]) -> SheetSection:
    density = scene.hand.material.density
    rows = []
    limits = morphology.pressure_limits(scene.hand, params)
    law = bool(scene.effects.neo_hookean)
    bends = morphology.free_bends(scene.hand, params, neo_hookean=law)
    for i, (size, angle) in enumerate(zip(sizes, bends, strict=True)):
        pressure = float(params.pressure[i])
        limit = limits[i]
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
                f"{pressure / 1e3:.1f} ({limit / 1e3:.0f})",
                f"{np.degrees(angle):.0f}",
            )
        )
    head = ("finger", "length mm", "width mm", "height mm", "wall mm", "chamber mm")
    head += ("silicone cm³", "mass g", "pressure kPa (limit)", "free bend °")
    ends = "as thick as the others"
    if any(size.end != size.base.wall for size in sizes):
        ends = f"{', '.join(dict.fromkeys(f'{size.end:.2f}' for size in sizes))} mm"
    notes = [
        f"Sizes as in the files; walls at base and tip: {ends}. Lengths are those in front of the "
        "palm; silicone and mass include the root behind it, which the palm holds. Free bend: "
        "predicted by beam theory for a straight finger at its pressure, without load; measure it "
        "first.",
        _limit_meaning(scene, params),
    ]
    return SheetSection("Fingers", head, rows, notes)


def limit_strains(scene: Scene, params: Params) -> np.ndarray:
    """Strain of a free finger's upper wall at its limit of pressure, shape (finger,).

    Curvature times height, kappa h, of fingers without taper.
    """
    limits = morphology.pressure_limits(scene.hand, params)
    law = bool(scene.effects.neo_hookean)
    full = params._replace(pressure=limits)
    bends = np.asarray(morphology.free_bends(scene.hand, full, neo_hookean=law))
    return np.abs(bends) * np.asarray(params.height) / np.asarray(params.length)


def _limit_meaning(scene: Scene, params: Params) -> str:
    """What the limits of pressures are, and are not."""
    text = (
        "Limit: the end of the design space, a pressure proportional to the wall (pressure_limit "
        "of the hand's file). It is no burst pressure: no burst test of such a finger exists, and "
        "a bubble or a thin place lowers it."
    )
    if params.tip is None:
        strains = limit_strains(scene, params)
        words = ", ".join(f"finger {i} {100 * v:.0f} %" for i, v in enumerate(strains))
        text += f" Strain of a free finger's upper wall at its limit by beam theory: {words}."
    if scene.limits.strain is not None:
        text += f" A search keeps that strain below {100 * scene.limits.strain:.0f} %."
    return text


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


def places(scene: Scene, params: Params) -> tuple[np.ndarray, np.ndarray]:
    """Base points [m] and azimuths [rad] of the fingers, shape (finger, 2) and (finger,)."""
    position, _ = mounts(scene.hand, np.asarray(params.spread))
    azimuth = [np.radians(f.azimuth) + f.spread * float(params.spread) for f in scene.hand.finger]
    return np.asarray(position)[:, :2], np.array(azimuth)


def _mounts(scene: Scene, params: Params) -> SheetSection:
    rows = []
    position, azimuth = places(scene, params)
    for i, (finger, (x, y), angle) in enumerate(
        zip(scene.hand.finger, 1e3 * position, azimuth, strict=True)
    ):
        numbers = (f"{x:.1f}", f"{y:.1f}", f"{np.degrees(angle):.1f}", f"{finger.tilt:.1f}")
        rows.append((str(i), *numbers))
    palm = scene.hand.palm
    notes = [
        "Base point: middle of the inextensible layer's edge on the palm's underside, from the "
        "palm's centre. A finger leaves in the direction of the azimuth (anticlockwise from x, "
        "seen from above), tilted below the horizontal; its inextensible layer faces inwards.",
        f"Palm: radius {1e3 * palm.radius:.0f} mm, thickness {1e3 * palm.thickness:.0f} mm, mass "
        f"{palm.mass:g} kg. Spread {np.degrees(float(params.spread)):.1f}°; the palm to print has "
        "these seats.",
    ]
    head = ("finger", "base x mm", "base y mm", "azimuth °", "tilt °")
    return SheetSection("Mounts", head, rows, notes)


def hand_mass(scene: Scene, sizes: Sequence[Size]) -> float:
    """Mass of the palm with what it bears, and of the fingers in front of it [kg]."""
    inside = sum(size.root * size.base.width * size.base.height for size in sizes)
    cast = sum(size.volume for size in sizes) - inside
    return scene.hand.palm.mass + 1e-9 * cast * scene.hand.material.density


def sag(scene: Scene, sizes: Sequence[Size]) -> float:
    """How far the hand's weight lowers the compliant wrist [mm]."""
    return 1e3 * hand_mass(scene, sizes) * scene.gravity_on / scene.hand.wrist.linear_stiffness


def _arm(scene: Scene, params: Params, sizes: Sequence[Size]) -> SheetSection:
    rows = []
    for time, x, y, z, roll, pitch, yaw in valves.key_poses(scene, params):
        angles = {"roll": roll, "yaw": yaw, "pitch": pitch}
        turn = pose.quaternion(**angles)
        cells = [f"{v + 0.0:.1f}" for v in (x, y, z, *(angles[a] for a in pose.ANGLES))]
        rows.append((f"{time:g}", *cells, " ".join(f"{v + 0.0:.4f}" for v in turn)))
    head = ("time s", "x mm", "y mm", "z mm", *(f"{name} °" for name in pose.ANGLES))
    holds = [i for i, f in enumerate(scene.control.frame) if f.interpolation == "held"]
    notes = [
        f"Key frames of the control {scene.control.name!r}: pose of the arm frame, which is the "
        "middle of the palm's underside while the wrist is not deflected; between them linear"
        + (f", but held after row {', '.join(str(i + 1) for i in holds)}" if holds else "")
        + ". commands_still.csv has every time step of this path, in the same angles, signs and "
        f"quaternion. commands.csv has in addition the shaking that tests the grasp{_shaken(scene)}"
        ": its rows differ from this table there.",
        _clearance(scene, sizes, rows),
        _pressed(scene, params, sizes),
        *_dropped(scene, params),
        f"{pose.CONVENTION} The drawing on the last page of {NAME}.pdf shows each angle.",
    ]
    return SheetSection("Arm", (*head, "quaternion w x y z"), rows, notes)


def _shaken(scene: Scene) -> str:
    """When the arm is shaken, in words."""
    ends = scene.phase_ends
    if "disturb" not in ends:
        return ""
    end = ends["disturb"] + scene.phases.deflate_time
    return f", between {ends['lift']:g} and {end:g} s"


def _clearance(scene: Scene, sizes: Sequence[Size], rows: Sequence[Sequence[str]]) -> str:
    """How near the table the palm's rim is commanded, of rows of `_arm`."""
    radius = 1e3 * scene.hand.palm.radius
    lowest = np.inf
    time = ""
    for row in rows:
        w, x, y, z = map(float, row[-1].split())
        upright = Rotation.from_quat([x, y, z, w]).as_matrix()[2, 2]
        height = float(row[3]) - radius * np.sqrt(max(0.0, 1.0 - upright**2))
        if height < lowest:
            lowest = height
            time = row[0]
    return (
        f"The palm's rim, {radius:.0f} mm from its middle, is commanded to {lowest:.0f} mm above "
        f"the table at the lowest ({time} s), before the wrist gives way"
        f"{_rests(scene, sizes, lowest)}. The printed palm, its "
        "bars and whatever is behind it reach further than the simulated disc: move the empty "
        "hand there slowly first."
    )


def tip_heights(scene: Scene, params: Params, sizes: Sequence[Size]) -> np.ndarray:
    """Lowest heights of the straight fingers' tips over the table, as commanded [mm], (finger,)."""
    tips = corners(scene, params, sizes)[:, 4:]
    heights = []
    for _, _, _, z, roll, pitch, yaw in valves.key_poses(scene, params):
        turn = pose.rotation(roll=roll, yaw=yaw, pitch=pitch).as_matrix()
        heights.append(z + (tips @ turn[2]).min(1))
    return np.min(heights, 0)


def _pressed(scene: Scene, params: Params, sizes: Sequence[Size]) -> str:
    """How far the straight fingers are commanded into the table, and what that means."""
    heights = tip_heights(scene, params, sizes)
    words = ", ".join(f"finger {i} {h + 0.0:.0f} mm" for i, h in enumerate(heights))
    text = f"Lowest tips of the straight fingers over the table, as commanded: {words}."
    depth = -float(heights.min())
    if depth <= 0:
        return f"{text} None is pressed on the table before the wrist sags."
    text += f" Below 0 the path drives the fingers into the table, by up to {depth:.0f} mm"
    if scene.effects.wrist:
        force = 1e-3 * depth * scene.hand.wrist.linear_stiffness
        text += (
            f": the fingers bend and the wrist gives way, with at most {force:.1f} N beside the "
            "hand's weight if the wrist yields upwards alone"
        )
    return (
        f"{text}. A rigid mount rams them by that much: raise z, or play the path without pressure "
        "and stop above the table first."
    )


def _dropped(scene: Scene, params: Params) -> list[str]:
    """From which height the object falls when the chambers are emptied, a sentence."""
    poses = valves.key_poses(scene, params)
    pressures = valves.key_pressures(scene, params)
    full = pressures[:, 1:].max(1) > 0
    if not full.any():
        return []
    # The player empties what the table leaves full.
    end = pressures[full, 0][-1]
    height = float(np.interp(end, poses[:, 0], poses[:, 3]) - poses[:, 3].min())
    if height < 5:
        return []
    return [
        f"The chambers are emptied from {end:g} s on with the hand {height:.0f} mm above its "
        "lowest pose: the object falls from there. Lay something soft below it, or lower the arm "
        "first."
    ]


def _rests(scene: Scene, sizes: Sequence[Size], height: float) -> str:
    """Whether the palm rests on the table as the wrist sags, in words."""
    if not scene.effects.wrist:
        return ""
    lower = sag(scene, sizes)
    if height >= lower:
        return f" by {lower:.0f} mm under the hand's weight"
    force = 1e-3 * (lower - height) * scene.hand.wrist.linear_stiffness
    return (
        f" by {lower:.0f} mm under the hand's weight: the palm's rim then rests on the table, with "
        f"{force:.1f} N if the wrist yields upwards alone"
    )


def _valves(scene: Scene, params: Params) -> SheetSection:
    rows = [
        (f"{time:g}", *(f"{p:.1f}" for p in pressures))
        for time, *pressures in valves.line_pressures(scene, params)
    ]
    names = [valves.name_of(*line) for line in enumerate(valves.lines(scene, params))]
    head = ("time s", *(f"{name} kPa" for name in names))
    notes = [
        f"Gauge pressures, linear between rows; the same table: {valves.VALVES}. "
        f"`python {valves.PLAYER.name} --port PORT` sends it to regulators over a serial line, a "
        "line for each 50 ms: the time in s and a pressure in kPa for each column, with commas "
        "between. Without --port it writes to standard output; --help has the rest. Where "
        "`codesign finger MEASURED.csv --fit` gave a moment of less than the model's, add "
        "`--divide` with that number: the real finger needs more pressure.",
        _margin(scene, params),
    ]
    if len(names) < scene.num_fingers:
        notes.append(
            "Fingers of one line hang on one regulator, by tubes of equal length from a branch. "
            "The players call a line by its number here, as `finger`."
        )
    return SheetSection("Valves", head, rows, notes)


def _margin(scene: Scene, params: Params) -> str:
    """How far the walls' limits let each line's pressure be raised."""
    limits = valves.line_limits(scene, params)
    highest = valves.line_pressures(scene, params)[:, 1:].max(0)
    names = [valves.name_of(*line) for line in enumerate(valves.lines(scene, params))]
    shares = [
        f"{p / limit:.2f} ({name})" for name, p, limit in zip(names, highest, limits, strict=True)
    ]
    return (
        f"Smallest `--divide` that the walls' limits allow: {', '.join(shares)}. A smaller one is "
        "refused; with `--cap` such a finger gets the pressure of its limit, and bends less than "
        "designed. All of the moment then needs a thicker wall: export again with wall and "
        "pressure raised."
    )


def tolerance_section(cast: Yield | None) -> SheetSection:
    """What share of cast hands is good, or how to have them simulated."""
    if cast is None:
        note = "Not simulated: codesign export --tolerances says what share of cast hands is good."
        return SheetSection("Tolerances", (), [], [note])
    notes = [
        f"{cast.summary}. All hands met the same trials. A tolerance is two standard deviations of "
        "a normal distribution, of each finger by itself and of the silicone of the whole hand. "
        "Gains are those of a regression over these grasps, with 95 % intervals.",
    ]
    return SheetSection("Tolerances: hands as they are cast", cast.head, cast.rows, notes)


def markdown(title: str, lines: Sequence[str], content: Sequence[SheetSection]) -> str:
    """The sheet as Markdown."""
    text = [f"# {' '.join(title.split())}", "", *(f"{line}  " for line in lines)]
    for section in content:
        text += ["", f"## {section.title}"]
        if section.rows:
            text += ["", _row(section.head), _row(["---"] * len(section.head))]
            text += [_row(row) for row in section.rows]
        for note in section.notes:
            text += ["", note]
    return "\n".join(map(_plain, text)) + "\n"


def _plain(text: str) -> str:
    """A line without HTML, links and pictures: texts of a run or a scene may be a stranger's."""
    return terminal.line(text).replace("<", "&lt;").replace("](", "]\\(")


def _row(cells: Sequence[str]) -> str:
    # Names are free text: a bar would begin a cell, a line feed a row.
    plain = [" ".join(cell.split()).replace("|", "\\|") for cell in cells]
    return "| " + " | ".join(plain) + " |"


def write(folder: Path, title: str, lines: Sequence[str], content: Sequence[SheetSection]) -> Path:
    """Writes the Markdown sheet; arguments as `markdown`."""
    path = folder / f"{NAME}.md"
    path.write_text(markdown(title, lines, content), encoding="utf-8")
    return path
