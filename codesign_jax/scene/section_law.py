"""The energy of a finger's section under pressure: bending, sideways bending and twist.

An energy per length Pi(pressure, twist, bend, lateral) holds all that a section does: its slopes by
the curvatures are the moments that hold it, and minus its slope by the pressure is the volume of
its chamber.  docs/notes/section.md derives it; finite elements of sections (scripts.section) check
it, and give the dimensionless functions that the derivation leaves open.

Units of the formulas: lengths are over the height h, curvatures times h, pressures over the shear
modulus G, energies per length over G h^2.  y is the height over the fabric.
"""

import functools
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

FEATURES = 10
"""Terms of a fitted function of the section's proportions, see `_features`."""
SMOOTH = 3e-3
"""Tension of the fabric below which it counts as slack, over G h^2 [chosen]: 0.1 N."""

FURTHEST = 6.0
"""Strain of the top up to which a free bend is looked for."""


class Numbers(NamedTuple):
    """What the energy needs of sections; every entry has the shape of their heights.

    Attributes:
      height: Outer height h [m].
      modulus: Shear modulus G [Pa].
      width: Outer width over h.
      wall: Thickness of the walls over h.
      lever: First moment of the area on which pressure acts in the undeformed section.
      bulge: Pressure's work on the bulging walls per amplitude of their bulge, straight.
      bulge_bent: What bending adds to it.
      flattening: Share of the walls' bending energy that a bulge of amplitude one adds.
      thinning: What pressure takes from the stiffness against bulging.
      rounding: What the thread adds to it as the section becomes round.
      axial: Area on which pressure acts along the finger, without bulge.
      axial_round: What a bulge adds to it.
      axial_growth: What a bulge adds to the walls' axial force.
      crown: Height of the fabric's edges over its middle per amplitude of the bulge.
      slackness: Fabric's strain per force, 1 / (k_f w).
      upright: Stiffness of bending sideways about the section's middle, with shear in series.
      axial_stiffness: Of the walls.
      shear: Compliance of shear as one of bending sideways.
      unsheared: Share of a sideways curvature that is not shear.
      torsion: Stiffness of twist without pressure.
      torsion_round: What a bulge adds to it, relative.
      crossing: What a crossed winding adds to it.
      helix: Twisting moment per pressure of a thread that is wound one way.
    """

    height: Any
    modulus: Any
    width: Any
    wall: Any
    lever: Any
    bulge: Any
    bulge_bent: Any
    flattening: Any
    thinning: Any
    rounding: Any
    axial: Any
    axial_round: Any
    axial_growth: Any
    crown: Any
    slackness: Any
    upright: Any
    axial_stiffness: Any
    shear: Any
    unsheared: Any
    torsion: Any
    torsion_round: Any
    crossing: Any
    helix: Any


FITTED = (
    *("lever", "bulge", "bulge_bent", "flattening", "thinning", "rounding"),
    *("axial", "axial_round", "axial_growth", "crown"),
)
"""Entries of `Numbers` that are fitted functions of the section's proportions."""
POSITIVE = frozenset(("lever", "bulge", "bulge_bent", "rounding", "axial", "axial_round", "crown"))
"""Those whose logarithm is fitted."""


class Constants(NamedTuple):
    """Dimensionless constants of the law [fitted]; see docs/notes/section.md."""

    functions: Any  # of the proportions, shape (FITTED, FEATURES)
    upright: float  # sideways stiffness over 4 I_z
    axial: float  # axial stiffness of the walls over 4 A
    stretch: float  # what bending takes from both
    strip: float  # curvature at which half of the fabric is slack, over 2 T / (k_f w^2)
    turn: float  # strain at which the middle of a curved fabric is slack, over T / (k_f w f q)
    torsion: float  # twist over G (4 A_m^2 d / U + U d^3 / 3)
    torsion_round: tuple[float, float]  # what a bulge adds: a d^-b
    wagner: tuple[float, float]  # share of the held moment, and what a bulge adds
    crossing: float  # of a crossed winding over k_t sin^2 cos^2 4 A^2 / U
    helix: float  # of one winding over 2 A tan(angle) h / 2


@functools.cache
def constants() -> Constants:
    """The constants of section_law.toml."""
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    functions = table.pop("functions")
    rows = np.array([functions[name] for name in FITTED])
    others: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in table.items()}
    return Constants(rows, **others)


def numbers(
    height: Any,
    wall: Any,
    width: Any,
    *,
    shear_modulus: Any,
    length: Any = np.inf,
    thread_depth: Any = 0.0,
    winding_angle: float = 0.0,
    crossed: bool = True,
    thread_stiffness: float = 1e5,
    fabric_stiffness: float = 1e5,
    fitted: Constants | None = None,
) -> Numbers:
    """What the energy needs of sections.

    Args:
      height: Outer height h [m], any shape.
      wall: Thickness of the walls [m], broadcasting to it, as the others.
      width: Outer width [m].
      shear_modulus: G of the silicone [Pa].
      length: Length of the finger [m]: it shears sideways, as under a force on its tip, which
        counts as a compliance 3 / (L^2 G A_s) in series with bending; infinite without shear.
      thread_depth: Place of the thread in the wall: 0 outside, 1 on the chamber.
      winding_angle: Angle between thread and hoop direction [rad].
      crossed: Whether the thread is wound there and back.
      thread_stiffness: Force per strain of the thread and per length of the finger [N/m].
      fabric_stiffness: Force per strain and width of the fabric [N/m].
      fitted: Constants; None for those of the package.
    """
    c = constants() if fitted is None else fitted
    unit = height / height
    w = width / height * unit
    d = wall / height * unit
    depth = thread_depth * unit
    numpy = unit.__array_namespace__()
    features = _features(numpy, d, w, depth)
    values = {}
    for name, row in zip(FITTED, c.functions, strict=True):
        value = sum(a * f for a, f in zip(row, features, strict=True))
        values[name] = numpy.exp(value) if name in POSITIVE else value
    area = w - (w - 2 * d) * (1 - 2 * d)
    upright = (w**3 - (1 - 2 * d) * (w - 2 * d) ** 3) / 12
    axial = 4 * c.axial * area
    shear = 3 * (height / length) ** 2 / shear_area(1.0 * unit, d, w)
    unsheared = 1 / (1 + shear * (4 * c.upright * upright + axial * w**2 / 4))
    upright = unsheared * (4 * c.upright * upright + (1 - unsheared) * axial * w**2 / 4)
    middle = 2 * (w + 1 - 2 * d)
    torsion = 4 * ((w - d) * (1 - d)) ** 2 * d / middle + middle * d**3 / 3
    # The area that the thread encloses and the thread's length.
    thread_width = w - 2 * depth * d
    thread_height = 1 - 2 * depth * d
    enclosed = thread_width * thread_height
    around = 2 * (thread_width + thread_height)
    sine = numpy.sin(winding_angle * unit)
    cosine = numpy.cos(winding_angle * unit)
    membrane = thread_stiffness * (sine * cosine) ** 2 / (shear_modulus * height)
    return Numbers(
        height=height * unit,
        modulus=shear_modulus * unit,
        width=w,
        wall=d,
        slackness=shear_modulus * height / (fabric_stiffness * w),
        upright=upright,
        axial_stiffness=axial,
        shear=shear,
        unsheared=unsheared,
        torsion=c.torsion * torsion,
        torsion_round=c.torsion_round[0] / d ** c.torsion_round[1],
        crossing=c.crossing * membrane * 4 * enclosed**2 / around * crossed,
        helix=c.helix * enclosed * (sine / cosine) * thread_height * (1 - crossed),
        **values,
    )


def shear_area(height: Any, wall: Any, width: Any) -> Any:
    """Area A_s of a box under a force across it [m^2]: the force shears by 1 / (G A_s).

    Thin walls with the middle line b x a, b across: the shear flow V Q / I has the first moment
    Q = d a b/4 + d (b^2/4 - z^2)/2 in the walls along the force, from 0 to d a b/4 in the others,
    and A_s = I^2 / int Q^2 / d.
    """
    a = height - wall
    b = width - wall
    second_moment = b**3 / 6 + a * b**2 / 2
    most = a * b / 4 + b**2 / 8
    squares = 2 * (most**2 * b - most * b**3 / 12 + b**5 / 320) + b**2 * a**3 / 24
    return wall * second_moment**2 / squares


def _features(numpy: Any, d: Any, w: Any, depth: Any) -> list[Any]:
    """Terms of the fitted functions: 1 to second order in the logarithms of the proportions."""
    a = numpy.log(d / 0.2)
    b = numpy.log(w / 1.2)
    return [a * 0 + 1, a, b, a * a, a * b, b * b, depth, depth * depth, depth * a, depth * b]


class _Walls(NamedTuple):
    """Of neo-Hookean walls in plane strain, with the fabric as the neutral line."""

    energy: Any
    moment: Any  # its slope by the bend
    force: Any  # along the finger


def _walls(n: Numbers, bend: Any) -> _Walls:
    """Integrals over the wall of (l - 1/l)^2 / 2 and of l - l^-3, l = 1 + x y.

    A block of width one from 0 to y has, with v = 1 / (1 + x y), the energy
    x^2 y^3 (1/3 + v) / 2, the moment x y^3 (1/3 + (v + v^2)/2) and the force x y^2 (1 + v)^2 / 2.
    Bent backwards the walls stay linear: v = 1.
    """
    tense = bend * (bend > 0)
    chamber = n.width - 2 * n.wall
    energy = 0.0
    moment = 0.0
    force = 0.0
    for width, y in ((n.width, 1.0), (-chamber, 1 - n.wall), (chamber, n.wall)):
        v = 1 / (1 + tense * y)
        energy = energy + width * y**3 * (1 / 3 + v)
        moment = moment + width * y**3 * (1 / 3 + (v + v * v) / 2)
        force = force + width * y**2 * (1 + v) ** 2
    return _Walls(bend * bend / 2 * energy, bend * moment, bend / 2 * force)


def _positive(numpy: Any, value: Any) -> Any:
    """max(value, 0), smooth."""
    return (value + numpy.sqrt(value * value + SMOOTH**2)) / 2


def _strip(numpy: Any, lateral: Any, half: Any) -> Any:
    """How far the taut edge of a strip is bent, over w/2: its slope by the curvature is at most 1.

    A strip that resists tension only carries a tension T.  Up to the curvature `half` all of it is
    taut, k w^3 / 12 per curvature; beyond, a part of the width sqrt(2 T / (k |lateral|)).
    """
    size = numpy.abs(lateral)
    half = half + 1e-6
    most = numpy.maximum(size, half)
    beyond = most - 4 / 3 * numpy.sqrt(half * most) + half / 2
    return numpy.where(size < half, size * size / (6 * half), beyond)


class _State(NamedTuple):
    walls: _Walls
    bulge: Any  # amplitude q
    stored: Any  # energy of the bulge with the pressure's
    tension: Any  # of the fabric; negative where it is slack


def _state(n: Numbers, p: Any, x: Any) -> _State:
    numpy = n.height.__array_namespace__()
    walls = _walls(n, x)
    # Under a vacuum, or bent without pressure, nothing bulges outwards.
    over = numpy.maximum(p, 0.0)
    work = over * (n.bulge + n.bulge_bent * x) - n.flattening * walls.energy
    drive = _positive(numpy, work)
    stiffness = numpy.sqrt((1 - n.thinning * over) ** 2 + (n.rounding * over) ** 2)
    stiffness = stiffness + n.flattening**2 * walls.energy
    q = drive / stiffness
    tension = p * (n.axial + n.axial_round * q) - walls.force * (1 + n.axial_growth * q)
    return _State(walls, q, -drive * q / 2, tension)


def fabric_tension(n: Numbers, pressure: Any, bend: Any) -> Any:
    """Tension of the fabric [N], negative where it is slack; see `energy`."""
    state = _state(n, pressure / n.modulus, bend * n.height)
    return n.modulus * n.height**2 * state.tension


def energy(
    n: Numbers,
    pressure: Any,
    twist: Any,
    bend: Any,
    lateral: Any,
    fitted: Constants | None = None,
) -> Any:
    """Energy per length with that of the pressure, -p V [N].

    Args:
      n: Of the sections.
      pressure: Gauge pressure of the chamber [Pa], broadcasting to them, as the others.
      twist: Twist per length [rad/m].
      bend: Curvature towards the fabric [1/m].
      lateral: Curvature sideways [1/m].
      fitted: Constants; None for those of the package.
    """
    c = constants() if fitted is None else fitted
    numpy = n.height.__array_namespace__()
    p = pressure / n.modulus
    x = bend * n.height
    t = twist * n.height
    # Stretch of the walls: x beyond small strains, without a kink at zero.
    tense = numpy.maximum(x, 0.0)
    tense = tense * tense / (tense + 0.05)
    over = numpy.maximum(p, 0.0)
    walls, q, stored, tension = _state(n, p, x)
    chamber = (n.width - 2 * n.wall) * (1 - 2 * n.wall)
    total = walls.energy - p * (chamber + n.lever * x) + stored
    # The middle of the fabric, which bulges down, goes slack first as the finger bends.
    taut = _positive(numpy, tension)
    crown = n.crown * q
    turn = c.turn * n.slackness * taut / (crown + SMOOTH)
    root = numpy.sqrt(x * x + turn * turn + SMOOTH**2 * SMOOTH**2)
    total = total + taut * crown * (x / 3 + 2 / 3 * (root - turn))
    # An edge of it goes slack as the finger bends sideways.
    # The tangent modulus of a stretched wall falls from 4 G to G.
    soft = (1 + c.stretch * tense) / (1 + c.stretch * tense / 4)
    axial = n.axial_stiffness / soft
    y = lateral * n.height
    reach = n.width / 2 * n.unsheared
    spanned = _positive(numpy, tension + axial * reach * numpy.abs(y))
    half = (c.strip * 2 * n.slackness / n.width + n.width * n.shear / 6) * spanned
    pulled = _positive(numpy, tension + axial * reach * _strip(numpy, y, half))
    slack = tension - taut
    total = total + (pulled * pulled - taut * taut - slack * slack) / (2 * axial)
    total = total + n.upright / soft * y * y / 2
    grown = n.flattening * walls.moment
    held = p * n.lever + q * (over * n.bulge_bent - grown - q * n.flattening * grown / 2)
    held = held - walls.moment - taut * crown * (1 / 3 + 2 / 3 * x / root)
    torsion = n.torsion * (1 + n.torsion_round * q) / (1 + tense) + n.crossing
    # Fibres away from the fabric lengthen as it twists; the moment that is held acts along them.
    torsion = torsion - held * (c.wagner[0] + c.wagner[1] * q) / 2
    total = total + torsion * t * t / 2 - p * n.helix * t
    return n.modulus * n.height**2 * total


def moments(n: Numbers, pressure: Any, twist: Any, bend: Any, lateral: Any) -> tuple[Any, ...]:
    """External moments (twist, bend, lateral) that hold the curvatures [N m]; see `energy`."""
    _, pull = jax.vjp(lambda *kappa: energy(n, pressure, *kappa), twist, bend, lateral)
    return pull(jax.numpy.ones_like(twist * bend * lateral * n.height))


def free_bend(n: Numbers, pressure: Any) -> np.ndarray:
    """Curvature of a free finger [1/m], NumPy arrays; its strain kappa h is at most `FURTHEST`."""
    step = 1e-4 / n.height

    def held(bend: np.ndarray) -> np.ndarray:
        return energy(n, pressure, 0.0, bend + step, 0.0) - energy(
            n, pressure, 0.0, bend - step, 0.0
        )

    low = 0.0 * n.height * pressure
    high = low + FURTHEST / n.height
    for _ in range(40):
        middle = (low + high) / 2
        further = held(middle) < 0
        low = np.where(further, middle, low)
        high = np.where(further, high, middle)
    return np.where(np.asarray(pressure) > 0, (low + high) / 2, 0.0)


def twist_stiffness(n: Numbers, pressure: Any, bend: Any) -> Any:
    """Stiffness of twist [N m^2]; negative where a finger held at this bend twists by itself."""
    at = [energy(n, pressure, twist, bend, 0 * bend) for twist in (-1.0, 0.0, 1.0)]
    # The energy is quadratic in the twist.
    return at[0] - 2 * at[1] + at[2]


def volume(n: Numbers, pressure: Any, twist: Any, bend: Any, lateral: Any) -> Any:
    """Volume of the chamber per length [m^2]: minus the energy's slope by the pressure."""
    unit = jax.numpy.ones_like(pressure)
    return -jax.jvp(lambda p: energy(n, p, twist, bend, lateral), (pressure,), (unit,))[1]
