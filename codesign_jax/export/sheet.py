"""The build sheet: what to build, how to drive it, and how far it may be off."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from codesign_jax import terminal
from codesign_jax.export.process import Process, Size, inlet
from codesign_jax.export.tolerance import NEAREST, WANTED, Side, Tolerance
from codesign_jax.model import morphology
from codesign_jax.model.layout import mounts
from codesign_jax.report import stress
from codesign_jax.report.statistics import Interval
from codesign_jax.report.stress import Stress
from codesign_jax.scene import Scene, key_frames
from codesign_jax.types import Params

NAME = "build_sheet"


class SheetSection(NamedTuple):
    """A part of the sheet: a title, a table (or none) and sentences below it."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
    notes: list[str]


Tested = tuple[str | None, Stress | None]


class Drift(NamedTuple):
    """What simulated grasps say about tolerances."""

    nominal: Interval  # success of the design itself
    trials: int  # trials of each step
    steps: int  # steps on each side
    engine: str  # engine that simulated
    rows: list[Tolerance]  # tolerances; empty if the design itself has too few successes
    fixed: int = 0  # parameters of the hand's table that were not moved


def sheet_sections(
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    drift: Drift | None,
    tested: Tested = (None, None),
) -> list[SheetSection]:
    """The sheet's content."""
    found = [
        _tests(scene, params, *tested),
        _fingers(scene, params, sizes),
        _mounts(scene, params),
        _material(scene),
    ]
    found.append(_control(scene, params))
    return [*found, tolerance_section(drift)]


def _tests(scene: Scene, params: Params, verdict: str | None, found: Stress | None) -> SheetSection:
    title = f"Verdict: {verdict or 'not judged at accuracy reference'}"
    warnings = stress.of_design(scene, params) + [*(found.warnings if found else ())]
    notes = [f"Warning: {words}." for words in warnings]
    if not found:
        return SheetSection(title, (), [], notes)
    return SheetSection(title, found.head, found.rows, notes)


def _fingers(scene: Scene, params: Params, sizes: Sequence[Size]) -> SheetSection:
    density = scene.hand.material.density
    rows, limits = [], morphology.pressure_limits(scene.hand, params)
    law = bool(scene.effects.neo_hookean)
    bends = morphology.free_bends(scene.hand, params, neo_hookean=law)
    for i, (size, angle) in enumerate(zip(sizes, bends, strict=True)):
        pressure = float(params.pressure[i])
        limit = limits[i]
        ends = list(dict.fromkeys((size.base, size.tip)))  # one, unless it is tapered
        start, end = size.chamber_ends
        chambers = [" x ".join(f"{v:.1f}" for v in size.at(x).chamber) for x in (start, end)]
        rows.append(
            (
                str(i),
                f"{size.length:.1f}",
                *(" to ".join(f"{s[k]:.1f}" for s in ends) for k in range(2)),
                " to ".join(_castable(s.wall) for s in ends),
                f"{end - start:.1f} x {' to '.join(dict.fromkeys(chambers))}",
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
        ends = f"{', '.join(dict.fromkeys(_castable(size.end) for size in sizes))} mm"
    notes = [
        f"Walls to 0.05 mm; at base and tip: {ends}. Free bend: predicted by beam theory for a "
        "straight finger at its pressure, without load; measure it first."
    ]
    return SheetSection("Fingers", head, rows, notes)


FLAP, PITCH = 15.0, 2.0
"""Fabric that reaches over the base to hold the finger, and a turn of thread, in mm [ours]."""


def assembly_sections(
    scene: Scene, params: Params, sizes: Sequence[Size], process: Process
) -> list[SheetSection]:
    """What the hand is made of, and in what order; arguments as of `sheet_sections`."""
    palm, material, count = scene.hand.palm, scene.hand.material, len(sizes)
    volume = sum(size.volume for size in sizes) / 1e3
    strips = (f"{z.length + FLAP:.0f} x {max(z.base.width, z.tip.width):.0f}" for z in sizes)
    middle = [(size, size.at(size.length / 2)) for size in sizes]
    thread = sum(z.length / PITCH * 2 * (m.width + m.height) for z, m in middle) / 1e3
    tubes = [d for size in sizes if (d := inlet(size, process))]
    highest = float(np.max(np.asarray(params.pressure))) / 1e3
    tilts = dict.fromkeys(f"{90 - finger.tilt:g}°" for finger in scene.hand.finger)
    disc = f"disc of radius {1e3 * palm.radius:.0f} mm, {1e3 * palm.thickness:.0f} mm thick"
    shear = f"shear modulus {material.shear_modulus / 1e3:g} kPa"
    rows = [
        ("palm", "1", f"{disc}; {1e3 * palm.mass:.0f} g with all that it bears but the fingers"),
        ("seats", str(count), f"cut back into the palm's underside by {', '.join(tilts)}, see 6"),
        ("silicone", f"{1e-3 * volume * material.density:.0f} g", f"{volume:.0f} cm³, {shear}"),
        ("fabric", str(count), f"inextensible, {', '.join(strips)} mm"),
        ("thread", f"{thread:.1f} m", f"around the fingers, a turn every {PITCH:g} mm [ours]"),
        ("tubes", str(len(tubes)), ", ".join(dict.fromkeys(f"{d:g} mm" for d in tubes)) or "–"),
        ("valves", str(count), f"a channel for each finger, up to {highest:.0f} kPa"),
        ("moulds", str(3 * len(set(sizes))), "tray, core and base of each finger: parts/"),
    ]
    steps = (
        "Print the moulds.",
        "Cast each shell: core on the tray, pour between the bars up to the rim, cure.",
        "Close it: fabric on the floor of the base mould, its flap out over the base end, pour to "
        "the step, set the shell in before it cures.",
        "Wind the thread around the finger and hold its ends with a drop of silicone.",
        "Set the tube into the base and seal it. Raise the pressure slowly to the design's, and "
        "compare the bend with the table of fingers: a stiffer silicone bends less.",
        "Fix each finger: its base is square to its axis and would stand in the palm. So cut the "
        "palm's underside back, from the line at the base point outwards, until the base lies "
        "flat in this seat; glue it there, and clamp the flap of fabric, which runs inwards on "
        "the underside, under a bar. The simulation has rigid bases and no seats [ours].",
        "Fix the palm to the wrist's springs and these to the arm; find z = 0, where the palm's "
        "underside lies on the table.",
        "Play commands.csv, first without an object and without pressure.",
    )
    notes = [f"{k}. {step}" for k, step in enumerate(steps, 1)]
    return [
        SheetSection("Parts", ("part", "number", "what"), rows, []),
        SheetSection("Order of work", (), [], notes),
    ]


def corners(scene: Scene, params: Params, sizes: Sequence[Size]) -> np.ndarray:
    """Corners of the straight fingers in the palm's frame [mm], shape (finger, 8, 3).

    The first four are those of the base, around it, the first two on the fabric.
    """
    position, turn = (np.asarray(v) for v in mounts(scene.hand, np.asarray(params.spread)))
    found = []
    for size, place, (w, x, y, z) in zip(sizes, position, turn, strict=True):
        ends = [(0.0, size.base), (size.length, size.tip)]
        own = [
            (along, side * section.width / 2, up * section.height)
            for along, section in ends
            for side, up in ((-1, 0), (1, 0), (1, 1), (-1, 1))
        ]
        found.append(1e3 * place + Rotation.from_quat([x, y, z, w]).apply(own))
    return np.array(found)


def _castable(thickness: float) -> str:
    return f"{round(20 * thickness) / 20:.2f}"


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
        f"{palm.mass:g} kg. Spread {np.degrees(float(params.spread)):.1f}°.",
    ]
    head = ("finger", "base x mm", "base y mm", "azimuth °", "tilt °")
    return SheetSection("Mounts", head, rows, notes)


def _material(scene: Scene) -> SheetSection:
    material, wrist = scene.hand.material, scene.hand.wrist
    notes = [
        f"Silicone: shear modulus {material.shear_modulus / 1e3:g} kPa, density "
        f"{material.density:g} kg/m³, damping time {1e3 * material.damping_time:g} ms. Bottom "
        "layer: inextensible fabric. Around the finger: thread hoops, which keep the section.",
    ]
    if scene.effects.wrist:
        notes.append(
            f"Wrist: {wrist.linear_stiffness:g} N/m and {wrist.angular_stiffness:g} N m/rad, "
            f"damping {wrist.linear_damping:g} N s/m and {wrist.angular_damping:g} N m s/rad."
        )
    return SheetSection("Material and wrist", (), [], notes)


def _control(scene: Scene, params: Params) -> SheetSection:
    times, poses = (np.asarray(f(scene, params)) for f in (key_frames.times, key_frames.poses))
    terms = key_frames.pressures(scene, params)
    pressures = sum(np.asarray(v) * np.asarray(f) for v, f in terms) + np.zeros((len(times), 1))
    rows = []
    for time, pose, row in zip(times, poses, 1e-3 * pressures, strict=True):
        same = [f"{row[0]:.1f}"] if np.ptp(row) == 0 else [f"{p:.1f}" for p in row]
        place = [f"{v:.1f}" for v in (*(1e3 * pose[:3]), *np.degrees(pose[3:]))]
        rows.append((f"{time:g}", *place, " ".join(same)))
    head = ("time s", "x mm", "y mm", "z mm", "roll °", "pitch °", "yaw °", "pressure kPa")
    held = [i for i, f in enumerate(scene.control.frame) if f.interpolation == "held"]
    notes = [
        f"Key frames of the control {scene.control.name!r}: arm frame, z above the table, and "
        "pressures of the fingers; between them linear"
        + (f", but held after row {', '.join(str(i + 1) for i in held)}" if held else "")
        + ". Every time step, with the shaking: commands.csv."
    ]
    return SheetSection("Grasp", head, rows, notes)


def tolerance_section(drift: Drift | None) -> SheetSection:
    """Tolerances as a table, or how to have them simulated."""
    if drift is None:
        note = "Not simulated: codesign export --tolerance free says how far parameters may drift."
        return SheetSection("Tolerance", (), [], [note])
    nominal = f"Of {drift.trials} grasps of the design itself {_percent(drift.nominal)} succeed"
    limit = f"{100 * WANTED:.0f} %"
    if not drift.rows:
        note = f"{nominal}, fewer than {limit}: it has no tolerance to give."
        return SheetSection("Tolerance", (), [], [note])
    rows = []
    for row in drift.rows:
        sides = [part for side in (row.down, row.up) for part in _side(side)]
        rows.append((row.name, row.unit, f"{row.value:.4g}", *sides))
    factor = NEAREST ** (-1 / (drift.steps - 1)) if drift.steps > 1 else 1.0
    notes = [
        f"{nominal}. Each parameter alone; every value met the same {drift.trials} trials "
        f"(engine {drift.engine}); behind it the share of successes with its 95 % interval "
        "(Wilson). A success keeps the object and lets go of it. Down to and up to: the last value "
        f"before the share falls below {limit}; fails at: the next value tried.",
        f"Resolution: {drift.steps} values a side, the first at {NEAREST:.3g} of the way to the "
        f"limit, each {factor:.2g} times as far as the one before. The limits are Table I's, "
        "or the design space's where that is wider, and the pressure limit.",
    ]
    if drift.fixed:
        notes.append(
            f"{drift.fixed} further parameters of the hand's table were not moved; codesign export "
            "--tolerance all moves each of them."
        )
    head = ("parameter", "unit", "value", "down to", "fails at", "up to", "fails at")
    return SheetSection(f"Tolerance: drift until fewer than {limit} succeed", head, rows, notes)


def _side(side: Side) -> tuple[str, str]:
    if not side.room:
        return "at its limit", "–"
    good = "none" if side.good is None else f"{side.good.value:.4g}: {_percent(side.good.share)}"
    if side.bad is None:
        return good, "not within the limits"
    return good, f"{side.bad.value:.4g}: {_percent(side.bad.share)}"


def _percent(share: Interval) -> str:
    value, low, high = (100 * v for v in share)
    return f"{value:.0f} % [{low:.0f}, {high:.0f}]"


def markdown(title: str, lines: Sequence[str], content: Sequence[SheetSection]) -> str:
    """The sheet as Markdown."""
    text = [f"# {title}", "", *(f"{line}  " for line in lines)]
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
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def write(folder: Path, title: str, lines: Sequence[str], content: Sequence[SheetSection]) -> Path:
    """Writes the Markdown sheet; arguments as `markdown`."""
    path = folder / f"{NAME}.md"
    path.write_text(markdown(title, lines, content), encoding="utf-8")
    return path
