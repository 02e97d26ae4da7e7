"""What is decided about a finger's parts: dimensions from the design, the rest from `Process`."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from codesign_jax.scene.hand import Hand
from codesign_jax.scene.schema import InputError, Problem, quantity, range_problem
from codesign_jax.types import Params


@dataclasses.dataclass(frozen=True)
class Process:
    """What the design does not say about parts [chosen]."""

    # Thickness of the walls that close the chamber at base and tip [mm]; 0: that of the finger's
    # other walls
    end_wall: float = quantity("mm", 0, 100, default=0.0)
    # Solid end behind the base, which the palm's seat holds [mm]; all of the finger's length is
    # in front of the seat
    root: float = quantity("mm", 5, 50, default=10.0)
    # Diameter of the hole for the air tube through the base's end wall [mm]; 0: none, pierced after
    # casting
    inlet: float = quantity("mm", 0, 20, default=2.0)
    # Thickness of the moulds' walls, floors and bars [mm]
    mould_wall: float = quantity("mm", 0.5, 50, default=4.0)
    # Gap between parts that are set into one another [mm]
    clearance: float = quantity("mm", 0, 2, default=0.2)
    # Slope of the tray's and the core's side faces [deg].  Both widen towards the opening, by
    # nothing at half of the shell's height, so that the finger's walls keep their thickness
    draft: float = quantity("deg", 0, 10, default=0.0)


CHEEK = 3.0
BACK = 9.0
FLOOR = 4.0
BAR = 5.0
"""Walls of a seat beside, behind and below a root, and thickness of its clamp bar [mm] [chosen]."""
SQUEEZE = 0.05
"""Share of its height by which the bar presses a root [chosen]."""
FABRIC = 0.5
"""Room for the fabric behind a root [mm] [chosen]."""


class Section(NamedTuple):
    """A finger's section [mm]."""

    width: float  # outer width
    height: float  # outer height
    wall: float  # thickness of bottom, top and sides

    @property
    def chamber(self) -> tuple[float, float]:
        """Width and height of the chamber."""
        return self.width - 2 * self.wall, self.height - 2 * self.wall


class Size(NamedTuple):
    """Dimensions of a finger [mm]."""

    length: float
    base: Section  # its section at the base
    tip: Section  # its section at the tip, the same unless the finger is tapered
    end: float  # thickness of the walls at base and tip
    root: float = 0.0  # solid end behind the base, in the palm

    def at(self, place: float) -> Section:
        """The section at a place along the finger [mm]."""
        share = place / self.length
        return Section(*(a + (b - a) * share for a, b in zip(self.base, self.tip, strict=True)))

    @property
    def ends(self) -> tuple[float, float]:
        """Where the finger begins and ends with its root [mm]."""
        return -self.root, self.length

    @property
    def chamber_ends(self) -> tuple[float, float]:
        """Where the chamber begins and ends [mm]."""
        return self.end, self.length - self.end

    @property
    def pressed(self) -> float:
        """Height of the seat's rim above the fabric, to which the bar presses the root [mm]."""
        return (1 - SQUEEZE) * min(self.base.height, self.at(-self.root).height)

    @property
    def chamber_volume(self) -> float:
        """Volume of the chamber [mm^3]."""
        start, end = self.chamber_ends
        return _simpson(lambda x: math.prod(self.at(x).chamber), start, end)

    @property
    def volume(self) -> float:
        """Volume of the silicone with the root, with no inlet [mm^3]."""
        whole = _simpson(lambda x: self.at(x).width * self.at(x).height, -self.root, self.length)
        return whole - self.chamber_volume


class Printed(NamedTuple):
    """What was made of the parts; see `meshes` and `palm`."""

    names: Sequence[str]  # names of the parts' files without their ending
    palm_volume: float  # volume of the palm with its bars [mm^3]
    flange: tuple[float, str, float, bool] | None  # screws to the wrist, as `palm.Flange`
    below: float  # how far seats stand below the palm's underside [mm]
    problems: Sequence[str] = ()  # what of the palm cannot be built, a sentence each


def _simpson(area: Callable[[float], float], start: float, end: float) -> float:
    middle = (start + end) / 2
    return (end - start) * (area(start) + 4 * area(middle) + area(end)) / 6


def sizes(hand: Hand, params: Params, process: Process) -> list[Size]:
    """Dimensions of a hand's fingers."""
    fingers = []
    problems = []
    for i, length in enumerate(params.length):
        base = hand.section.width, params.height[i], params.wall[i]
        tip = base if params.tip is None else [params.tip[k][i] for k in (2, 0, 1)]
        # A design is in float32, which knows no more than a tenth of a micrometre.
        length, *both = (round(1e3 * float(v), 4) for v in (length, *base, *tip))
        ends = Section(*both[:3]), Section(*both[3:])
        size = Size(length, *ends, process.end_wall or ends[0].wall, process.root)
        fingers.append(size)
        if size.length - 2 * size.end < 1.0:
            sentence = (
                f"finger {i} of {length:g} mm has no room for a chamber of 1 mm between end walls "
                f"of {size.end:g} mm; give --end-wall (mm), or --no-parts and --no-sheet"
            )
            problems.append(Problem("geometry", sentence))
    if problems:
        raise InputError(problems)
    return fingers


def inlet(size: Size, process: Process) -> float:
    """Diameter of a finger's inlet [mm]: none if it would be wider than the chamber."""
    return process.inlet if process.inlet < min(size.base.chamber) else 0.0


def problems(process: Process) -> list[str]:
    """What is out of range in a process, by the names of the flags."""
    messages = []
    for field in dataclasses.fields(process):
        name = f"--{field.name.replace('_', '-')}"
        value = getattr(process, field.name)
        limits = (field.metadata[key] for key in ("unit", "low", "high"))
        problem = range_problem(name, value, *limits)
        messages += [problem] if problem else []
    return messages
