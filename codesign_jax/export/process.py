"""What is decided about a finger's parts: dimensions from the design, the rest from `Process`."""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

from codesign_jax.scene.schema import InputError, quantity, range_problem


@dataclasses.dataclass(frozen=True)
class Process:
    """What the design does not say about parts [ours].

    Attributes:
      end_wall: Thickness of the walls that close the chamber at base and tip [mm]; 0: that of the
        finger's other walls.
      inlet: Diameter of the hole for the air tube through the base's end wall [mm]; 0: none,
        pierced after casting.
      mould_wall: Thickness of the moulds' walls, floors and bars [mm].
      clearance: Gap between parts that are set into one another [mm].
      draft: Slope of the tray's and the core's side faces [deg].  Both widen towards the opening,
        by nothing at half of the shell's height, so that the finger's walls keep their thickness.
    """

    end_wall: float = quantity("mm", 0, 100, default=0.0)
    inlet: float = quantity("mm", 0, 20, default=2.0)
    mould_wall: float = quantity("mm", 0.5, 50, default=4.0)
    clearance: float = quantity("mm", 0, 2, default=0.2)
    draft: float = quantity("deg", 0, 10, default=0.0)


class Size(NamedTuple):
    """Dimensions of a finger [mm].

    Attributes:
      length: Length.
      width: Outer width.
      height: Outer height.
      wall: Thickness of bottom, top and sides.
      end: Thickness of the walls at base and tip.
    """

    length: float
    width: float
    height: float
    wall: float
    end: float

    @property
    def chamber(self) -> tuple[float, float, float]:
        """Length, width and height of the chamber."""
        wall = 2 * self.wall
        return self.length - 2 * self.end, self.width - wall, self.height - wall

    @property
    def chamber_volume(self) -> float:
        """Volume of the chamber [mm^3]."""
        return math.prod(self.chamber)

    @property
    def volume(self) -> float:
        """Volume of the silicone, with no inlet [mm^3]."""
        return self.length * self.width * self.height - self.chamber_volume


def sizes(
    lengths: Iterable[Any],
    width: float,
    heights: Iterable[Any],
    walls: Iterable[Any],
    process: Process,
) -> list[Size]:
    """Dimensions of a hand's fingers.

    Args:
      lengths: Their lengths [m].
      width: Outer width of all [m].
      heights: Outer heights [m].
      walls: Wall thicknesses [m].
      process: The process.

    Raises:
      InputError: With every finger that has no room for a chamber.
    """
    found, problems = [], []
    for i, given in enumerate(zip(lengths, heights, walls, strict=True)):
        # A design is in float32, which knows no more than a tenth of a micrometre.
        length, height, wall, across = (round(1e3 * float(v), 4) for v in (*given, width))
        size = Size(length, across, height, wall, process.end_wall or wall)
        found.append(size)
        if size.chamber[0] < 1.0:
            problems.append(
                f"finger {i} of {length:g} mm has no room for a chamber of 1 mm between end walls "
                f"of {size.end:g} mm; give --end-wall (mm), or --no-parts and --no-sheet"
            )
    if problems:
        raise InputError(problems)
    return found


def inlet(size: Size, process: Process) -> float:
    """Diameter of a finger's inlet [mm]: none if it would be wider than the chamber."""
    return process.inlet if process.inlet < min(size.chamber[1:]) else 0.0


def problems(process: Process) -> list[str]:
    """What is out of range in a process, by the names of the flags."""
    found = []
    for field in dataclasses.fields(process):
        name, value = f"--{field.name.replace('_', '-')}", getattr(process, field.name)
        limits = (field.metadata[key] for key in ("unit", "low", "high"))
        problem = range_problem(name, value, *limits)
        found += [problem] if problem else []
    return found
