"""The tables of a hand file: fingers, material, palm, wrist, parameters (paper Table I), presets.

The `Attributes` of each docstring are the meanings that `docs/reference.md` shows beside the units
and ranges of the fields, see `scripts/reference_page.py`.
"""

import dataclasses
import math
from typing import Any, NamedTuple

from codesign_jax.scene import silicones
from codesign_jax.scene.schema import choice, quantity, table

# Unit of a file -> (SI unit, factor).
UNITS = {
    "mm": ("m", 1e-3),
    "m": ("m", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "rad": ("rad", 1.0),
    "kPa": ("Pa", 1e3),
    "Pa": ("Pa", 1.0),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "1": ("1", 1.0),
}


class Kind(NamedTuple):
    """A parameter: per finger or hand, its SI unit, the range that makes sense, its meaning."""

    per: str
    unit: str
    low: float
    high: float
    meaning: str


PARAMETERS = {
    "length": Kind("finger", "m", 1e-3, 1.0, "length of a finger"),
    "height": Kind("finger", "m", 1e-3, 0.1, "outer height of a finger's section"),
    "wall": Kind("finger", "m", 1e-4, 0.05, "thickness of a finger's walls"),
    "spread": Kind("hand", "rad", -2 * math.pi, 2 * math.pi, "spread gamma of the fingers"),
    "arm_roll": Kind("hand", "rad", -math.pi, math.pi, "roll of the arm frame X_D"),
    "arm_yaw": Kind("hand", "rad", -math.pi, math.pi, "yaw of the arm frame X_D"),
    "arm_pitch": Kind(
        "hand", "rad", -math.pi, math.pi, "pitch of the arm frame X_D; positive: fingers towards +x"
    ),
    "arm_z": Kind("hand", "m", -1.0, 1.0, "height of the arm frame X_D over `arm.zero_height`"),
    "arm_x": Kind("hand", "m", -1.0, 1.0, "position x of the arm frame X_D"),
    "arm_y": Kind("hand", "m", -1.0, 1.0, "position y of the arm frame X_D"),
    "pressure": Kind("finger", "Pa", 0.0, 1e6, "gauge pressure of a chamber while grasping"),
    "tip_height": Kind("finger", "m", 1e-3, 0.1, "height at the tip, if `section.tapered`"),
    "tip_wall": Kind("finger", "m", 1e-4, 0.05, "wall at the tip, if `section.tapered`"),
    "tip_width": Kind("finger", "m", 1e-3, 0.1, "width at the tip, if `section.tapered`"),
}
"""Every parameter that the hand model understands."""
LEAST_REACH = 0.014
"""Reach of the grid of every mesh [m]: contact spheres of fingers up to 25 mm high, on objects that
the noise makes a tenth smaller."""
TIP = ("tip_height", "tip_wall", "tip_width")
"""Those of tapered fingers alone."""
THREAD_PITCH = 4e-3
"""A turn of a layer of the thread along a finger [m] [chosen]: wound there and back it has two
layers.  Wound one way, in one layer, a turn is half of it, so that the thread is as long."""


Numbers = float | tuple[float, ...]
"""A number for all fingers, or a number for each."""


def per_finger(value: Numbers, count: int) -> tuple[float, ...]:
    """The numbers of `count` fingers, each its own or all the same."""
    return value if isinstance(value, tuple) else (value,) * count


@table
@dataclasses.dataclass(frozen=True, kw_only=True)
class Finger:
    """Mount of a finger, which leaves the palm at azimuth + spread * gamma, tilted downwards.

    Its base point is the middle of the inextensible layer's edge, on the palm's underside. It is
    given either as `base`, (x, y) in the palm's frame, which stays where it is when the spread
    gamma turns the finger's direction; or as `radius` of a circle around the palm's centre, on
    which it moves with the direction. The other one is None.

    Attributes:
      azimuth: Direction in which the finger leaves the palm at no spread, about the vertical.
      spread: Share of the hand's spread gamma by which that direction turns.
      tilt: Angle between the finger and the palm's plane, downwards.
      radius: Distance of the base point from the palm's centre; instead of `base`.
      base: Base point (x, y) in the palm's frame; instead of `radius`.
    """

    azimuth: float = quantity("deg", -360, 360)
    spread: float = quantity("", -1, 1)
    tilt: float = quantity("deg", -90, 90)
    radius: float | None = quantity("m", 0, 0.2, default=None)
    base: tuple[float, ...] | None = quantity("m", -0.2, 0.2, default=None)

    def base_point(self, cosine: Any, sine: Any) -> tuple[Any, Any]:
        """Base point (x, y) in the palm's frame [m].

        Args:
          cosine: Cosine of azimuth + spread * gamma, of any shape; may be traced.
        """
        if self.base is not None:
            return self.base[0], self.base[1]
        return self.radius * cosine, self.radius * sine

    @property
    def base_distance(self) -> Any:
        """Distance of the base point from the palm's centre [m], at any spread."""
        if self.base is not None:
            return (self.base[0] ** 2 + self.base[1] ** 2) ** 0.5
        return self.radius


@table
@dataclasses.dataclass(frozen=True)
class Section:
    """Rectangular hollow cross-section; height and wall are parameters of the table.

    Attributes:
      width: Outer width of the section, of a tapered finger at its base.
      tapered: Whether height, wall and width change linearly along a finger, from those at its base
        to the parameters `tip_height`, `tip_wall` and `tip_width`.
      law: What holds a finger's joints: "chamber", beam theory with a pressure that acts on the
        chamber's area; or "elements", the energy that finite elements of the section support.
      thread_depth: Place of the thread in the wall: 0 outside, 1 on the chamber; for the law
        "elements" and the build sheet.
      winding: How the thread is wound, likewise: "crossed", there and back, or "single", one way.
      pressure_factor: Factor on what pressure does by the law "elements", as the next two: by how
        much a finger differs from the elements that the law was fitted to.
      sideways_factor: Factor on the walls' stiffness sideways.
      twist_factor: Factor on the stiffness of twist.
    """

    width: float = quantity("m", 0.005, 0.1)
    tapered: bool = False
    law: str = choice("chamber", "elements", default="chamber")
    thread_depth: float = quantity("", 0, 1, default=0.0)
    winding: str = choice("crossed", "single", default="crossed")
    pressure_factor: float = quantity("", 0.2, 5, default=1.0)
    sideways_factor: float = quantity("", 0.2, 5, default=1.0)
    twist_factor: float = quantity("", 0.2, 5, default=1.0)


@table
@dataclasses.dataclass(frozen=True)
class Material:
    """Silicone of the fingers: `material = NAME`, or a table with its name or with numbers.

    A shear modulus belongs to a bending law. A silicone's name determines law, modulus,
    density and damping; without a name, or for a batch that was measured, law and modulus are given
    together.
    The two factors scale the stiffness that `morphology` derives for bending sideways and for
    torsion. The derived sideways stiffness is an upper bound: its neutral line is at the fabric's
    side. The derived torsional stiffness is a lower bound: it assumes thin walls.

    Attributes:
      silicone: Name of the silicone, see docs/measurements.md. Not given: `law`,
        `shear_modulus`, `density` and `damping_time` apply.
      law: Bending law of the walls that the modulus belongs to. Not given, without a silicone:
        `effects.neo_hookean` of the scene says it.
      shear_modulus: Shear modulus G; required without a silicone, as the next two.
      density: Density.
      damping_time: Kelvin-Voigt damping time beta: a joint's damping is beta times its stiffness.
      lateral_factor: Factor on the stiffness of bending sideways; as the next two of the section's
        law "chamber".
      torsion_factor: Factor on the stiffness of twist.
      moment_factor: Factor on the bending moment per pressure, which follows from the section.
    """

    shear_modulus: float = quantity("Pa", 1e3, 1e7)
    density: float = quantity("kg/m^3", 100, 10000)
    damping_time: float = quantity("s", 0, 1)
    silicone: str | None = choice(*silicones.SILICONES, default=None)
    law: str | None = choice(*silicones.LAWS, default=None)
    lateral_factor: float = quantity("", 0.05, 20, default=1.0)
    torsion_factor: float = quantity("", 0.05, 20, default=1.0)
    moment_factor: float = quantity("", 0.1, 10, default=1.0)


@table
@dataclasses.dataclass(frozen=True)
class Palm:
    """Rigid palm; spheres of `contact_radius`, tangent to its underside, carry its contacts.

    Attributes:
      mass: Mass of the palm.
      radius: Radius of the palm, a disc.
      thickness: Thickness of the palm.
      contact_radius: Radius of the five contact spheres.
      contact_ring: Radius of the circle on which the centres of four of them lie; the fifth is in
        the middle.
    """

    mass: float = quantity("kg", 0.01, 10)
    radius: float = quantity("m", 0.005, 0.2)
    thickness: float = quantity("m", 0.002, 0.1)
    contact_radius: float = quantity("m", 0.001, 0.05)
    contact_ring: float = quantity("m", 0, 0.2)


@table
@dataclasses.dataclass(frozen=True)
class Wrist:
    """Passively compliant joint between arm frame X_D and wrist frame X_A.

    Attributes:
      linear_stiffness: Stiffness of the three slides.
      angular_stiffness: Stiffness of the three hinges.
      linear_damping: Damping of the three slides.
      angular_damping: Damping of the three hinges.
    """

    linear_stiffness: float = quantity("N/m", 1, 1e5)
    angular_stiffness: float = quantity("N m/rad", 0.01, 1e4)
    linear_damping: float = quantity("N s/m", 0, 1e4, typical=20.0)
    angular_damping: float = quantity("N m s/rad", 0, 1e3, typical=0.1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter:
    """A row of the parameter table, in the row's own unit.

    Where each finger has a value of its own, `low`, `high` and `default` are a number for all
    fingers or an array with a number for each, in the order of `[[finger]]`.

    Attributes:
      name: Which parameter; every one is given once.
      per: Whether each finger has a value of its own, or the hand has one.
      domain: The group of parameters to which a schedule assigns it.
      unit: Unit of the row's numbers, and of presets, commands and CSV columns.
      low: Lower bound.
      high: Upper bound.
      default: Value where a design or a preset gives none; within the bounds.
    """

    name: str = choice(*PARAMETERS)
    per: str = choice("finger", "hand")
    domain: str = choice("morphology", "control")
    unit: str = choice(*UNITS)
    low: Numbers
    high: Numbers
    default: Numbers


@dataclasses.dataclass(frozen=True)
class PressureLimit:
    """Upper limit of the pressure, proportional to the hull thickness (Table I).

    It bounds the design space, not the simulation.

    Attributes:
      per_wall: Limit of the pressure for a metre of wall.
    """

    per_wall: float = quantity("Pa/m", 1e5, 1e9, structure=True)

    def of(self, wall: Any) -> Any:
        """Highest pressure of sections of a wall [m], any shape [Pa]."""
        return self.per_wall * wall


def partition(groups: tuple[tuple[int, ...], ...], count: int) -> list[tuple[int, ...]]:
    """Groups among `count` values, and every other value as a group of its own.

    The groups are ordered by their first members.
    """
    others = {*range(count)} - {k for group in groups for k in group}
    return sorted([*groups, *((k,) for k in others)], key=min)


@dataclasses.dataclass(frozen=True)
class Valves:
    """Pressure lines, each with a regulator and a valve: fingers of one line have one pressure.

    With `lines`, a search finds which fingers share a line; with `groups`, the file says it.
    Without either key each finger has a line of its own.  The keys bound the design space, not the
    simulation.

    Attributes:
      lines: Number of lines, at most that of the fingers; instead of `groups`.
      groups: Fingers that share a line, such as [[0, 3], [1, 2]], counted from 0; a finger of no
        group has its own line.
    """

    lines: int | None = quantity("", 1, 100, structure=True, default=None)
    groups: tuple[tuple[int, ...], ...] | None = None

    def known(self, count: int) -> tuple[tuple[int, ...], ...]:
        """Groups among `count` fingers that share a line in every design."""
        if self.lines == 1 and count > 1:
            return (tuple(range(count)),)
        return self.groups or ()

    def searched(self, count: int) -> int:
        """Number of lines onto which a search puts `count` fingers; 0 if that is known."""
        if self.lines is None or not 1 < self.lines < count:
            return 0
        return self.lines


def highest_pressure(hand: "Hand", wall: Any, tip: Any = None) -> Any:
    """Highest pressure of fingers of a wall [m], any shape [Pa].

    Args:
      wall: Thickness of the walls, of tapered fingers at the base.
      tip: Thickness at the tip, the lower of whose limits counts; None without taper.
    """
    highest = hand.pressure_limit.of(wall)
    if tip is None:
        return highest
    there = hand.pressure_limit.of(tip)
    return highest + (there - highest) * (there < highest)


@dataclasses.dataclass(frozen=True)
class Free:
    """A parameter that a preset leaves free, optionally tied over fingers, with other bounds.

    Attributes:
      name: Which parameter.
      tied: Whether all fingers share one value, within the bounds of each; or groups of fingers
        that share one, such as [[0, 3], [1, 2]], where a finger of no group has its own.
      low: Lower bound in the table's unit, for all fingers or for each; that of the table if not
        given.
      high: Upper bound in the table's unit, for all fingers or for each; that of the table if not
        given.
    """

    name: str = choice(*PARAMETERS)
    tied: bool | tuple[tuple[int, ...], ...] = False
    low: Numbers | None = None
    high: Numbers | None = None

    def bounds(self, row: Parameter, count: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper bounds of `count` values [table's unit]; `row` has what is not given.

        Values that are tied have the narrowest bounds, all of them.
        """
        low = per_finger(row.low if self.low is None else self.low, count)
        high = per_finger(row.high if self.high is None else self.high, count)
        lows = [*low]
        highs = [*high]
        for group in self.groups(count):
            for k in group:
                lows[k] = max(low[i] for i in group)
                highs[k] = min(high[i] for i in group)
        return tuple(lows), tuple(highs)

    def groups(self, count: int) -> list[tuple[int, ...]]:
        """Groups of tied values among `count`, ordered by their first members."""
        if self.tied is True:
            return [tuple(range(count))]
        return partition(() if self.tied is False else self.tied, count)

    def joined(self, groups: tuple[tuple[int, ...], ...], count: int) -> "Free":
        """The parameter where further groups among `count` values are tied."""
        parts = [{*group} for group in self.groups(count)]
        for group in groups:
            touched = [part for part in parts if part & {*group}]
            parts = [part for part in parts if part not in touched]
            parts.append({*group}.union(*touched))
        tied = tuple(tuple(sorted(part)) for part in parts if len(part) > 1)
        return dataclasses.replace(self, tied=tied)


@dataclasses.dataclass(frozen=True)
class Preset:
    """A design space: the free parameters; the rest is fixed at `fixed` or the table's default.

    Attributes:
      name: Name of the preset, as for `--preset`; "full" is the whole table.
      limits: Whether designs stay within `[limits]` of the scene; false: within Table I alone.
      free: The free parameters; with none fixed either, those of the whole table.
      fixed: Values of other parameters by name, in the table's units: a number, or an array with
        one for each finger.
    """

    name: str
    free: tuple[Free, ...] = ()
    fixed: dict[str, Any] = dataclasses.field(default_factory=dict)
    limits: bool = True

    def __post_init__(self) -> None:
        """Makes tuples of TOML's arrays, as those of other tables are."""
        fixed = {k: tuple(v) if isinstance(v, list) else v for k, v in self.fixed.items()}
        object.__setattr__(self, "fixed", fixed)

    @property
    def whole(self) -> bool:
        """Whether all parameters of the table are free, within its bounds."""
        return not self.free and not self.fixed

    def __hash__(self) -> int:
        """Hashes the preset although TOML gives `fixed` as a dict."""
        return hash((self.name, self.free, tuple(sorted(self.fixed.items())), self.limits))


@table
@dataclasses.dataclass(frozen=True)
class Hand:
    """A hand file: fingers, palm, wrist and the table of what a search may change.

    Attributes:
      name: Name of the hand, as in results.
      description: What the hand is, in a line.
    """

    name: str
    description: str
    finger: tuple[Finger, ...]
    section: Section
    material: Material
    palm: Palm
    wrist: Wrist
    parameter: tuple[Parameter, ...]
    pressure_limit: PressureLimit
    preset: tuple[Preset, ...] = ()
    valves: Valves = Valves()
    # What `[limits]` of a scene makes of it; see `buildable.Buildable`.
    buildable: Any = dataclasses.field(default=None, metadata={"in_file": False})

    def width(self, row: Parameter) -> int:
        """Number of values of a row of the parameter table."""
        return len(self.finger) if row.per == "finger" else 1
