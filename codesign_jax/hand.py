"""A hand as data: fingers, material, palm, wrist and the parameter table (paper Table I)."""

import dataclasses
from pathlib import Path

from codesign_jax import files, schema
from codesign_jax.schema import choice, quantity

# Every parameter that the hand model understands, and whether it has one value a finger.
PARAMETERS = {
    "length": "finger",
    "height": "finger",
    "wall": "finger",
    "spread": "hand",
    "arm_roll": "hand",
    "arm_yaw": "hand",
    "arm_pitch": "hand",
    "arm_z": "hand",
    "arm_x": "hand",
    "arm_y": "hand",
    "pressure": "finger",
}


@dataclasses.dataclass(frozen=True)
class Finger:
    """Mount of a finger, which leaves the palm at azimuth + spread * gamma, tilted downwards."""

    azimuth: float = quantity("deg", -360, 360)
    spread: float = quantity("", -1, 1)
    radius: float = quantity("m", 0, 0.2)
    tilt: float = quantity("deg", -90, 90)


@dataclasses.dataclass(frozen=True)
class Section:
    """Rectangular hollow cross-section; height and wall are parameters of the table."""

    width: float = quantity("m", 0.005, 0.1)


@dataclasses.dataclass(frozen=True)
class Material:
    """Silicone of the fingers: shear modulus, density and Kelvin-Voigt damping time beta."""

    shear_modulus: float = quantity("Pa", 1e3, 1e7)
    density: float = quantity("kg/m^3", 100, 10000)
    damping_time: float = quantity("s", 0, 1)


@dataclasses.dataclass(frozen=True)
class Palm:
    """Rigid palm; spheres of `contact_radius`, tangent to its underside, carry its contacts."""

    mass: float = quantity("kg", 0.01, 10)
    radius: float = quantity("m", 0.005, 0.2)
    thickness: float = quantity("m", 0.002, 0.1)
    contact_radius: float = quantity("m", 0.001, 0.05)
    contact_ring: float = quantity("m", 0, 0.2)


@dataclasses.dataclass(frozen=True)
class Wrist:
    """Passively compliant joint between arm frame X_D and wrist frame X_A."""

    linear_stiffness: float = quantity("N/m", 1, 1e5)
    angular_stiffness: float = quantity("N m/rad", 0.01, 1e4)
    linear_damping: float = quantity("N s/m", 0, 1e4)
    angular_damping: float = quantity("N m s/rad", 0, 1e3)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter:
    """A row of the parameter table, in the row's own unit."""

    name: str = choice(*PARAMETERS)
    per: str = choice("finger", "hand")
    domain: str = choice("morphology", "control")
    unit: str = choice("mm", "m", "deg", "rad", "kPa", "Pa")
    low: float
    high: float
    default: float


@dataclasses.dataclass(frozen=True)
class PressureLimit:
    """Upper limit of the pressure, proportional to the hull thickness (Table I)."""

    per_wall: float = quantity("Pa/m", 1e5, 1e9)


@dataclasses.dataclass(frozen=True)
class Free:
    """A parameter that a preset leaves free, optionally tied over fingers, with other bounds."""

    name: str = choice(*PARAMETERS)
    tied: bool = False
    low: float | None = None
    high: float | None = None


@dataclasses.dataclass(frozen=True)
class Preset:
    """A design space: the free parameters; the rest is fixed at `fixed` or the table's default."""

    name: str
    free: tuple[Free, ...]
    fixed: dict = dataclasses.field(default_factory=dict)

    def __hash__(self) -> int:
        """Hashes the preset although TOML gives `fixed` as a dict."""
        return hash((self.name, self.free, tuple(sorted(self.fixed.items()))))


@dataclasses.dataclass(frozen=True)
class Hand:
    """A soft hand read from a file in hands/; see `load`."""

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


def load(name: str | Path) -> Hand:
    """Reads and checks a hand.

    Args:
      name: Name of a built-in hand, or a path ending in .toml.

    Raises:
      SceneError: with every problem in the file.
    """
    path = files.find("hands", name)
    problems: list[str] = []
    hand = schema.parse(Hand, files.read(path), path.name, problems)
    if hand is not None:
        _check_table(hand, path.name, problems)
        _check_presets(hand, path.name, problems)
        if not problems:
            _check_chamber(hand, path.name, problems)
    if problems or hand is None:
        raise schema.SceneError(problems)
    return hand


def _check_table(hand: Hand, where: str, problems: list[str]) -> None:
    names = [p.name for p in hand.parameter]
    if not hand.finger:
        problems.append(f"{where}.finger must name at least one finger")
    for name in PARAMETERS:
        if names.count(name) != 1:
            problems.append(
                f"{where}.parameter {name!r} must be given once, not {names.count(name)} times"
            )
    for p in hand.parameter:
        if p.per != PARAMETERS[p.name]:
            problems.append(f"{where}.parameter {p.name}.per must be {PARAMETERS[p.name]!r}")
        if not p.low < p.high:
            problems.append(
                f"{where}.parameter {p.name}: low {p.low:g} must be below high {p.high:g} {p.unit}"
            )
        problem = schema.range_problem(
            f"{where}.parameter {p.name}.default", p.default, p.unit, p.low, p.high
        )
        if problem:
            problems.append(problem)


def _check_presets(hand: Hand, where: str, problems: list[str]) -> None:
    table = {p.name: p for p in hand.parameter}
    for preset in hand.preset:
        path = f"{where}.preset {preset.name}"
        for key, value in preset.fixed.items():
            if key not in table:
                problems.append(
                    f"{path}.fixed.{key} is not a parameter; {schema.nearest(key, table)}"
                )
                continue
            p = table[key]
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                problems.append(f"{path}.fixed.{key} = {value!r} must be a number [{p.unit}]")
                continue
            problem = schema.range_problem(f"{path}.fixed.{key}", value, p.unit, p.low, p.high)
            if problem:
                problems.append(problem)
        for free in preset.free:
            if free.name in preset.fixed:
                problems.append(f"{path}: {free.name} is both free and fixed")
            low = table[free.name].low if free.low is None else free.low
            high = table[free.name].high if free.high is None else free.high
            if not low < high:
                problems.append(f"{path}.free {free.name}: low {low:g} must be below high {high:g}")


def _check_chamber(hand: Hand, where: str, problems: list[str]) -> None:
    """The section must keep an air chamber at the table's corners: h - 2d > 0, w - 2d > 0."""
    from codesign_jax.parameters import UNITS

    table = {p.name: p for p in hand.parameter}
    wall = table["wall"].high * UNITS[table["wall"].unit][1]
    height = table["height"].low * UNITS[table["height"].unit][1]
    for name, size in (("height.low", height), ("section.width", hand.section.width)):
        if size <= 2 * wall:
            problems.append(
                f"{where}: {name} = {size:g} m leaves no air chamber "
                f"between walls of up to {wall:g} m"
            )
