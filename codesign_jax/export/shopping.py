"""What to buy for a hand: silicone, textiles, air supply, valves and what drives them."""

import math
from collections.abc import Sequence

import numpy as np

from codesign_jax.export import silicone, valves
from codesign_jax.export.process import BACK, Printed, Process, Size, inlet
from codesign_jax.export.sheet import SheetSection
from codesign_jax.scene import Scene
from codesign_jax.scene.silicones import Silicone
from codesign_jax.types import Params

PITCH = 2.0
"""A turn of the thread along a finger [mm] [chosen]."""
SPARE = 0.2
"""Thread beyond what is wound, for ends and a second try, as a share [chosen]."""
LOSS = 0.15
"""Silicone that stays in cups and on moulds, as a share of what is cast [chosen]."""
TUBE = 1.0
"""Tube for each finger [m] [chosen]."""
BARS = "M3 x 16"
"""Screws of the clamp bars, which cut their thread into the palm."""
ATMOSPHERE = 101.325
"""Standard pressure, at which flows are given [kPa]."""
RANGES = (100.0, 500.0, 900.0)
"""Ends of the ranges in which small proportional regulators are sold [kPa]."""
SIGNAL = 10.0
"""Voltage at the end of a regulator's range [V] [chosen]: 0 to 10 V is usual, 0 to 5 V is sold."""
PLASTIC = 1.24e-3
"""Density of printed PLA [g/mm^3]."""
ENGAGED = 8.0
"""Length of thread in the flange that is aimed at [mm] [chosen], within half a step of 5 mm."""
LEFT_OUT = (
    "A finger that is left out: plug its tube at the regulator, whose channel stays at 0 V if no "
    "other finger is on its line, cover its seat, and add its mass (table 'Fingers') to the "
    "ballast: without it the wrist sags less than in the simulation."
)
"""How to build a hand without one of its fingers."""
BITS = 12
"""Resolution of the analog outputs [chosen]."""


def fabric(size: Size) -> tuple[float, float]:
    """Length and width of a finger's strip of fabric with the flap under the clamp bar [mm]."""
    behind = size.at(-size.root).height + BACK
    return size.length + size.root + behind, max(size.base.width, size.tip.width)


def section(
    scene: Scene,
    params: Params,
    sizes: Sequence[Size],
    process: Process,
    printed: Printed | None,
) -> SheetSection:
    """The list; arguments as of `workshop.assembly_sections`."""
    rows = [
        *_castings(scene, sizes, process),
        *_workshop(scene, params, sizes, printed),
        *_screws(scene, sizes, printed),
        *_air(scene, params, sizes, process),
        *_safety(scene, params),
        *_electric(scene, params),
    ]
    notes = [LEFT_OUT, _firmware(scene, params)]
    return SheetSection("What to buy", ("what", "how much", "which"), rows, notes)


def _castings(scene: Scene, sizes: Sequence[Size], process: Process) -> list[tuple[str, str, str]]:
    volume = sum(size.volume for size in sizes) / 1e3
    grams = f"{1e-3 * (1 + LOSS) * volume * scene.hand.material.density:.0f} g"
    middle = [(size, size.at(size.length / 2)) for size in sizes]
    wound = sum(z.length / PITCH * 2 * (m.width + m.height) for z, m in middle) / 1e3
    strips = ", ".join("{:.0f} x {:.0f}".format(*fabric(size)) for size in sizes)
    pins = sum(inlet(size, process) > 0 for size in sizes)
    return [
        ("silicone", grams, f"{volume:.0f} cm³ cast + {100 * LOSS:.0f} % loss; {_silicone(scene)}"),
        (
            "fabric",
            str(len(sizes)),
            f"{strips} mm; does not stretch, open weave (polyester mesh, glass)",
        ),
        (
            "thread",
            f"{(1 + SPARE) * wound:.1f} m",
            f"polyester sewing thread; {wound:.1f} m are wound, a turn every {PITCH:g} mm, "
            f"+ {100 * SPARE:.0f} % spare [chosen]",
        ),
        (
            "silicone adhesive",
            "1 tube",
            "seals tubes and closes leaks; the silicone itself does too",
        ),
        (
            "steel pins",
            str(pins),
            f"of {_widths(sizes, process)}, 60 mm long (drill shanks): keep the inlets free",
        ),
        (
            "filament",
            "–",
            "PLA or PETG. No resin print: its residues stop platinum silicones curing",
        ),
    ]


def _widths(sizes: Sequence[Size], process: Process) -> str:
    """Diameters of the tubes, each once."""
    tubes = [inlet(size, process) or 2.0 for size in sizes]
    return ", ".join(f"{d:g} mm" for d in dict.fromkeys(tubes))


def _screws(
    scene: Scene, sizes: Sequence[Size], printed: Printed | None
) -> list[tuple[str, str, str]]:
    bars = f"{BARS}, socket head; cut their thread in the palm"
    return [
        ("screws of the bars", str(2 * len(sizes)), bars),
        *_flange_screws(scene, printed),
    ]


def _workshop(
    scene: Scene, params: Params, sizes: Sequence[Size], printed: Printed | None
) -> list[tuple[str, str, str]]:
    """Tools and auxiliaries, and the ballast of the palm."""
    rows = [
        ("release agent", "1 can", "for silicone; printed trays release with it more easily"),
        ("grease", "1 tube", "silicone-free (petroleum jelly): on the pins"),
        (
            "vacuum pump and chamber",
            "1",
            "to -90 kPa or more, chamber of four times the mixed volume. Without: mix slowly, pour "
            "a thin stream from high above into one corner, tap the mould; some bubbles remain, so "
            "that the leak test decides",
        ),
        ("scale", "1", "to 0.1 g"),
        ("tap", "1", "M3, for the palm's holes of the bars' screws where the plastic splits"),
        (
            "pressure gauge",
            "1",
            f"0 to {_range(scene, params):g} kPa, class 1.6 or better, for leak and bend tests",
        ),
    ]
    if printed:
        lacking = 1e3 * scene.hand.palm.mass - PLASTIC * printed.palm_volume
        if lacking > 0:
            rows.append(("ballast", f"{lacking:.0f} g", "less screws, tubes, plate: nuts, washers"))
    return rows


def _safety(scene: Scene, params: Params) -> list[tuple[str, str, str]]:
    """What keeps a failed regulator from bursting a finger, and the air from staying in it."""
    limits = valves.line_limits(scene, params)
    count = str(len(limits))
    names = [valves.name_of(*line) for line in enumerate(valves.lines(scene, params))]
    pairs = zip(names, limits, strict=True)
    words = ", ".join(f"{name} {limit:.0f}" for name, limit in pairs)
    return [
        (
            "relief valves",
            count,
            "between regulator and fingers, open below the fingers' limit in kPa: "
            f"{words}; and above its highest pressure of the table 'Valves'. The supply is above "
            "the limits, and a failed regulator passes it on",
        ),
        (
            "dump valves",
            count,
            "2/2, 24 V, normally open, between regulator and fingers, to the open air: some "
            "regulators hold their outlet pressure without power (check with the maker)",
        ),
        ("goggles", "1 a person", "wherever a finger is under pressure, also in leak tests"),
    ]


def _highest(scene: Scene, params: Params) -> float:
    """The highest pressure that is commanded [kPa]."""
    return float(valves.key_pressures(scene, params)[:, 1:].max())


def flows(scene: Scene, params: Params, sizes: Sequence[Size]) -> np.ndarray:
    """Air that fills each chamber as fast as is commanded, as wide as at rest [l/min, ANR].

    The volume of a chamber times the rise of its pressure over the standard pressure; shape
    (finger,).
    """
    rows = valves.key_pressures(scene, params)
    spans = np.diff(rows[:, 0])
    rises = np.diff(rows[:, 1:], axis=0)[spans > 0] / spans[spans > 0, None]
    litres = np.array([size.chamber_volume for size in sizes]) * 1e-6
    return 60 * litres * np.maximum(0.0, rises.max(0)) / ATMOSPHERE


def _air(
    scene: Scene, params: Params, sizes: Sequence[Size], process: Process
) -> list[tuple[str, str, str]]:
    count = len(sizes)
    widths = _widths(sizes, process)
    highest = _highest(scene, params)
    flow = flows(scene, params, sizes)
    lines = valves.lines(scene, params)
    regulators = str(len(lines))
    largest = max(float(flow[[*fingers]].sum()) for fingers in lines)
    fittings = f"for tube of {widths}, with the regulators' thread, or reducers from their tube"
    return [
        ("tube", f"{TUBE * count:g} m", f"polyurethane, outer diameter {widths} (--inlet)"),
        ("push-in fittings", str(count), fittings),
        ("pressure regulators", regulators, _regulator(highest, largest)),
        (
            "manifold",
            "1",
            f"one inlet, {regulators} outlets to the regulators, tube of 6 mm between them "
            "[chosen]",
        ),
        *_branches(lines),
        (
            "air preparation",
            "1",
            "filter of 5 µm, pressure reducer, and a shut-off valve that vents what is behind it "
            "without power (3/2, 24 V, normally closed)",
        ),
        (
            "compressed air",
            "1",
            f"dry, oil-free, at least {highest + 100:.0f} kPa gauge [chosen] and "
            f"{flow.sum():.1f} l/min (ANR) while the chambers fill",
        ),
    ]


def _branches(lines: Sequence[Sequence[int]]) -> list[tuple[str, str, str]]:
    """Branches of the tubes to fingers that share a pressure line."""
    shared = [len(fingers) for fingers in lines if len(fingers) > 1]
    if not shared:
        return []
    outlets = ", ".join(map(str, shared))
    return [("branches", str(len(shared)), f"of a regulator's tube, with {outlets} outlets")]


def _range(scene: Scene, params: Params) -> float:
    """End of the regulators' range [kPa]."""
    highest = _highest(scene, params)
    return next((v for v in RANGES if v >= highest), highest)


def _electric(scene: Scene, params: Params) -> list[tuple[str, str, str]]:
    count = len(valves.lines(scene, params))
    step = _range(scene, params) / 2**BITS
    return [
        (
            "controller of the regulators",
            "1",
            "microcontroller board with a USB serial port, 115200 baud; runs the program below",
        ),
        (
            "analog outputs",
            str(count),
            f"0 to {SIGNAL:g} V, {BITS} bits or more (a step is {step:.2g} kPa), as a module on "
            "the board's bus (I²C, SPI)",
        ),
        (
            "power supply",
            "1",
            f"24 V DC, {0.5 + 0.5 * count:.1f} A or more [chosen: 0.25 A a regulator and a dump "
            "valve, 0.5 A for board and valve], fused; its 0 V joined to the board's and the "
            "outputs'",
        ),
        (
            "emergency stop",
            "1",
            "opens the 24 V of regulators, dump valves and shut-off valve, so that the chambers "
            "vent and the object falls, and the arm's stop circuit",
        ),
        (
            "computer",
            "1",
            "Python 3.11 or newer, a USB port for the board and the arm's network: play_hand.py",
        ),
    ]


def _firmware(scene: Scene, params: Params) -> str:
    top = _range(scene, params)
    return (
        "Program of the controller: read a line up to its line feed, split it at the commas; the "
        f"first cell is the time, cell k + 1 the pressure of {_columns(scene, params)}. Set output "
        f"k to {SIGNAL:g} V x pressure / {top:g} kPa (regulators of 0 to {top:g} kPa at 0 to "
        f"{SIGNAL:g} V), never above its limit at the head of valves.csv. Set all outputs to 0 V "
        "when no line has come for 0.5 s, and at the start."
    )


def _columns(scene: Scene, params: Params) -> str:
    """What column k of the table of pressures is, in words."""
    several = len(valves.lines(scene, params)) < scene.num_fingers
    return "line k" if several else "finger k"


def _silicone(scene: Scene) -> str:
    material = scene.hand.material
    law = "neo-Hookean" if scene.effects.neo_hookean else "linear"
    needed = f"G = {material.shear_modulus / 1e3:g} kPa under the {law} law of bending"
    named = silicone.of_material(material)
    if named:
        return f"{silicone.words(named)}; {needed}"
    return (
        f"platinum-cured, {needed}. The hand's file names none; nearest by docs/measurements.md "
        f"is {silicone.words(worked(scene))}. Measure the first finger (codesign "
        "finger FILE --fit)"
    )


def worked(scene: Scene) -> Silicone:
    """The silicone whose mix and times the sheet gives."""
    material = scene.hand.material
    law = scene.effects.neo_hookean
    return silicone.of_material(material) or silicone.nearest(material, neo_hookean=bool(law))


def _regulator(highest: float, flow: float) -> str:
    top = next((v for v in RANGES if v >= highest), None)
    model = {100: "SMC ITV0010", 500: "SMC ITV0030", 900: "SMC ITV0050"}.get(top or 0)
    text = (
        f"proportional, electronic, 24 V, input 0 to {SIGNAL:g} V, a channel each, up "
        f"to {highest:.0f} kPa, {flow:.1f} l/min (ANR) or more, vents as well"
    )
    return f"{text}; such as {model} (0 to {top:g} kPa)" if model else text


def _flange_screws(scene: Scene, printed: Printed | None) -> list[tuple[str, str, str]]:
    if not printed or not printed.flange:
        return []
    diameter, thread, angle, sunk = printed.flange
    # The counterbore is as deep as the head, of the thread's diameter, and half a millimetre.
    counterbore = float(thread.removeprefix("M")) + 0.5 if sunk else 0.0
    clamped = 1e3 * scene.hand.palm.thickness - counterbore
    length = 5 * math.floor((clamped + ENGAGED + 2.5) / 5)
    heads = f"heads in counterbores of {counterbore:g} mm" if sunk else "heads below the underside"
    circle = f"circle of {diameter:g} mm, the first {angle:g}° from x"
    if diameter == 31.5:
        circle += ": the flange 31.5-4-M5 of ISO 9409-1"
    return [
        (
            "screws to the wrist",
            "4",
            f"{thread} x {length}, socket head, from below, {heads}; {clamped:.1f} mm of palm, "
            f"{length - clamped:.1f} mm of thread in the flange: see that it is as deep; {circle}",
        ),
        (
            "adapter plate",
            "0 or 1",
            "where the arm's flange has another pattern: aluminium of 8 mm or more with both "
            "circles; its thickness belongs to the tool centre point",
        ),
    ]
