"""What a workshop needs beside the dimensions: what to buy, to print and to do, and the wrist."""

import math
from collections.abc import Sequence

from codesign_jax.export import shopping, silicone, valves
from codesign_jax.export.process import FABRIC, Printed, Process, Size, inlet
from codesign_jax.export.sheet import NAME, SheetSection, hand_mass, sag
from codesign_jax.scene import Scene
from codesign_jax.types import Params


def assembly_sections(
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    process: Process,
    printed: Printed | None = None,
) -> list[SheetSection]:
    """What the hand is made of, and in what order; arguments as of `sheet.sheet_sections`.

    Args:
      printed: The parts; None where they were left out.
    """
    return [
        shopping.section(scene, params, sizes, process, printed),
        _castings(scene, sizes),
        _prints(scene, sizes, printed),
        _wrist(scene, sizes, printed),
        _order(scene, params, sizes, process, printed),
    ]


def bottom(size: Size) -> float:
    """Volume of a finger's bottom wall, which is cast by itself [mm^3]."""
    start, end = size.ends
    middle = (start + end) / 2
    areas = [s.width * s.wall for s in map(size.at, (start, middle, end))]
    return (end - start) * (areas[0] + 4 * areas[1] + areas[2]) / 6


def _castings(scene: Scene, sizes: Sequence[Size]) -> SheetSection:
    grams = 1e-6 * scene.hand.material.density * (1 + shopping.LOSS)
    named = shopping.worked(scene)
    a, b = named.mix
    rows = []
    for i, size in enumerate(sizes):
        shell = grams * (size.volume - bottom(size))
        base = grams * bottom(size)
        cells = [f"{v:.0f} ({v * a / (a + b):.1f} + {v * b / (a + b):.1f})" for v in (shell, base)]
        rows.append((str(i), *cells))
    head = ("finger", "shell g (A + B)", "bottom wall g (A + B)")
    notes = [
        f"With {100 * shopping.LOSS:.0f} % loss, for {named.name}: mix only what is poured within "
        f"{named.pot_life:g} min. Mix, pot life and cure: {silicone.SOURCE}.",
    ]
    return SheetSection("Silicone by casting", head, rows, notes)


def _prints(scene: Scene, sizes: Sequence[Size], printed: Printed | None) -> SheetSection:
    if printed is None:
        note = "Left out (--no-parts): neither moulds nor palm."
        return SheetSection("What to print", (), [], [note])
    rows = []
    uses = {"tray": "mould of the shell", "core": "its core", "base": "mould of the bottom wall"}
    for name in printed.names:
        kind, _, label = name.partition("_")
        fingers = [part for part in label.split("_") if part.isdigit()]
        numbers = ", ".join(fingers)
        if kind == "palm":
            rows.append((name, "1", "the palm; underside down, no supports inside the seats"))
        elif kind == "bar":
            rows.append((name, str(len(fingers)), f"clamp bar of finger {numbers}; lies flat"))
        elif (part_kind := label.rpartition("_")[2]) in uses:
            rows.append((name, "1", f"{uses[part_kind]}, finger {numbers}: cast {len(fingers)}"))
        else:
            rows.append((name, "0", f"finger {numbers} as it is to be: to compare, not to print"))
    mass = shopping.PLASTIC * printed.palm_volume
    simulated_mass = 1e3 * scene.hand.palm.mass
    notes = [
        "Files in parts/, STL and 3MF, in mm, as they stand on the printer's bed: layers of 0.15 "
        "mm, 4 perimeters; palm and bars with 50 % infill or more, moulds with 15 %. Sand the "
        "trays' inside: layers show on the finger.",
        f"Palm and bars weigh {mass:.0f} g if printed solid; the simulated palm weighs "
        f"{simulated_mass:.0f} g with all that it bears but the fingers (screws, tubes, the "
        "wrist's upper plate). Add what is missing in the middle of its upper side.",
        "The groove in the palm's upper side points to x. Dimples in its underside count each "
        "finger from 1: finger 0 has one.",
    ]
    if printed.below > 0.05:
        notes.append(
            f"The seats stand {printed.below:.1f} mm below the palm's underside, which the "
            "simulation does not have."
        )
    return SheetSection("What to print", ("file", "number", "what"), rows, notes)


def _wrist(scene: Scene, sizes: Sequence[Size], printed: Printed | None) -> SheetSection:
    if not scene.effects.wrist:
        note = "The simulated wrist is rigid: screw the palm to the arm's flange."
        return SheetSection("Wrist", (), [], [note])
    wrist = scene.hand.wrist
    mass = hand_mass(scene, sizes)
    k = wrist.linear_stiffness
    turn = wrist.angular_stiffness
    lowered = sag(scene, sizes)
    rows = [
        (
            "along x, y and z, each",
            f"{k:g} N/m ({k / 1e3:.3g} N/mm)",
            f"100 g moves it by {1e3 * 0.1 * 9.81 / k:.1f} mm",
            f"{wrist.linear_damping:g} N s/m",
        ),
        (
            "about x, y and z, each",
            f"{turn:g} N m/rad ({turn * math.pi / 180:.3g} N m/°)",
            f"1 N at a lever of 100 mm turns it by {math.degrees(0.1 / turn):.2f}°",
            f"{wrist.angular_damping:g} N m s/rad",
        ),
    ]
    ratio = wrist.linear_damping / (2 * math.sqrt(k * mass))
    notes = [
        "The simulated hand hangs on springs in six directions, palm and fingers of "
        f"{1e3 * mass:.0f} g (without the fingers' roots, which the palm's mass has). Its weight "
        f"lowers it by {lowered:.0f} mm: the arm's z is that of the undeflected wrist, so leave "
        "commands.csv as it is.",
        "**A stock part:** an arm with Cartesian impedance control (Franka Research 3, KUKA LBR "
        f"iiwa) is such a wrist. Screw the palm to its flange, set {k:g} N/m in translation, "
        f"{turn:g} N m/rad in rotation and a damping ratio of {ratio:.2g}, and give the controller "
        "no weight of the hand to compensate.",
        _mechanical(scene, lowered, printed),
        "**A rigid mount:** another hand. See first what it keeps: codesign evaluate with --set "
        "effects.wrist=false, and how far the path drives its fingers into the table ('Arm').",
    ]
    return SheetSection("Wrist", ("direction", "stiffness", "to test", "damping"), rows, notes)


def _mechanical(scene: Scene, lowered: float, printed: Printed | None) -> str:
    wrist = scene.hand.wrist
    k = wrist.linear_stiffness
    turn = wrist.angular_stiffness
    text = (
        f"**To build** (drawing: last page of {NAME}.pdf): three miniature linear guides, crossed, "
        f"one above the other, each with {math.ceil((lowered + 30) / 10) * 10:.0f} mm of travel to "
        "either side, two tension springs that pull against each other, of "
        f"{k / 2e3:.3g} N/mm each, and a dashpot of {wrist.linear_damping:g} N s/m. Below them the "
        "palm on four rubber buffers"
    )
    if not printed or not printed.flange:
        return f"{text}, that give {turn:g} N m/rad about each axis."
    radius = 5e-4 * printed.flange[0]
    axial = turn / (2 * radius**2) / 1e3
    shear = turn / (4 * radius**2) / 1e3
    return (
        f"{text} with {printed.flange[1]} studs in the screw holes of the palm, each with "
        f"{axial:.0f} N/mm along and {shear:.0f} N/mm across (K/2r² and K/4r² at a distance r of "
        f"{1e3 * radius:.1f} mm from the middle). Most buffers are softer across than that: choose "
        "them by their stiffness along, and test the angles as in the table."
    )


# Steps that are the same for every hand.
_MOUNTING = (
    "Seats: thread the tube through the seat's hole and out at the top. Lay the root in the "
    "pocket, fabric towards the palm's middle, its base flush with the lower edge. Fold the "
    "flap up behind the root and over the back wall, lay the bar on it, and drive both screws "
    "through the fabric until the bar sits on the seat's rim. Cut the flap.",
    "Palm: ballast as in 'What to print'; screws from below into the wrist; groove towards "
    "the arm frame's x.",
    "Arm: set its tool centre point to the middle of the palm's underside. z = 0 is where that "
    "lies on the table with the wrist undeflected; x = y = 0 is the object's place. Turn by "
    "+20° of roll, yaw and pitch, each alone, and compare with the drawing before anything "
    "else moves.",
)
_PLAYING = (
    "Valves: {channels}. First play the pressures alone, with the hand in "
    "the air: python play_hand.py --no-arm --valves PORT. Then drive the arm by its own slow "
    "move to the first row of commands_still.csv, and play it without pressure and without an "
    "object: python play_hand.py --no-valves --arm HOST:PORT --slow 4. Then both without an "
    "object, at last with one, and only then at full speed: python play_hand.py --valves PORT "
    "--arm HOST:PORT. Nobody within the arm's reach, goggles on, a hand on the emergency stop."
)


def _casting_steps(scene: Scene, tests: str, *, pinned: bool) -> tuple[str, ...]:
    """Steps that make one finger; `tests`: the highest pressure of each."""
    named = shopping.worked(scene)
    pin = (
        " Grease the pin and push it through the tray's end wall into the core."
        if pinned
        else " There is no pin for the inlet: pierce the root after casting."
    )
    return (
        "Print the parts; fit each core on its tray dry, it must sit without force. Wipe the "
        "moulds with release agent for silicone (optional on PLA) and let it dry.",
        "Mix as in 'Silicone by casting', stir for 3 min, scraping the sides, draw air out for 3 "
        f"min at -90 kPa or more [chosen], and pour within {named.pot_life:g} min [maker].",
        f"Shell: core on the tray.{pin} Pour in a thin stream between the bars until the tray is "
        f"full to the rim, tap out bubbles, cure {named.cure_time:g} h at 23 °C [maker]. Pull the "
        "pin, lift the core out with the shell, peel the shell from the core.",
        "Bottom wall: lay the strip of fabric on the floor of the base mould, tip flush, the rest "
        "up along the end wall behind the root and out over it as the flap; the mould has "
        f"{FABRIC:g} mm of room for it there. Pour up to the step, set the shell in at "
        f"once, its back upwards, press it down lightly, cure {named.cure_time:g} h [maker].",
        "Thread: wind it around the finger from the base to the tip, a turn every "
        f"{shopping.PITCH:g} mm, snug and not pressing in; not around the root. Fix both ends with "
        "a drop of silicone and rub a film over all of it.",
        "Tube: push it through the root until 10 mm of it, or half of a shorter chamber, are "
        "inside, seal with silicone adhesive around it, cure.",
        f"Leak test, at the highest pressure that is commanded: {tests}. Wear goggles, with the "
        "relief valve in the line. Raise it slowly, under water, and hold it for a minute (python "
        "play_valves.py --port PORT --hold FINGER KPA): no bubbles; then close the tube: the "
        "pressure must fall by less than 5 % in a minute [chosen]. Paint leaks with silicone and "
        "test again.",
        "Bend test: lay the finger on its side, raise the pressure slowly to the design's, and "
        "compare the angle of the tip with 'free bend'. Write pressures and angles into a file and "
        "fit the silicone: codesign finger FILE.csv --fit (docs/measurements.md).",
    )


def _order(
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    process: Process,
    printed: Printed | None,
) -> SheetSection:
    highest = valves.key_pressures(scene, params)[:, 1:].max(0)
    tests = ", ".join(f"finger {i} {p:.0f} kPa" for i, p in enumerate(highest))
    pinned = any(inlet(size, process) for size in sizes)
    mounting = _MOUNTING
    if printed is None:
        mounting = ("Fix each finger to a palm of your own (--no-parts).", *mounting[1:])
    lines = enumerate(valves.lines(scene, params))
    channels = ", ".join(f"{valves.name_of(*line)} on channel {line[0]}" for line in lines)
    casting = _casting_steps(scene, tests, pinned=pinned)
    steps = (*casting, *mounting, _PLAYING.format(channels=channels))
    marks = f"[maker]: from {silicone.SOURCE}; [chosen]: ours. Moulds: the drawing of {NAME}.pdf."
    notes = [marks, *(f"{k}. {step}" for k, step in enumerate(steps, 1))]
    return SheetSection("Order of work", (), [], notes)
