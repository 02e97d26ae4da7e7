"""What the law of a finger's section needs of the section: dimensionless numbers, and constants.

`section_law` has the law itself and its units; docs/notes/section.md derives both.
"""

import functools
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codesign_jax.scene.hand_tables import THREAD_PITCH, Hand

FEATURES = 10
"""Terms of a fitted function of the section's proportions, see `_features`."""


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
BY_PRESSURE = (
    *("lever", "bulge", "bulge_bent", "thinning", "rounding", "axial", "axial_round"),
    "helix",
)
"""Entries of `Numbers` that the energy multiplies with the pressure."""
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
    """The constants of section_numbers.toml."""
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
    winding_angle: Any = 0.0,
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


def of_hand(
    hand: Hand, height: Any, wall: Any, width: Any, length: Any, *, thread_depth: Any = None
) -> Numbers:
    """`numbers` of a hand's sections, with its silicone, its thread and its factors.

    Args:
      thread_depth: Place of the thread; None for that of the hand.
    """
    section = hand.section
    crossed = section.winding == "crossed"
    pitch = THREAD_PITCH if crossed else THREAD_PITCH / 2
    nominal = numbers(
        height,
        wall,
        width,
        shear_modulus=hand.material.shear_modulus,
        length=length,
        thread_depth=section.thread_depth if thread_depth is None else thread_depth,
        winding_angle=height.__array_namespace__().atan(pitch / (2 * (width + height))),
        crossed=crossed,
    )
    return scaled(nominal, section.pressure_factor, section.sideways_factor, section.twist_factor)


def scaled(n: Numbers, pressure: Any, sideways: Any, twist: Any) -> Numbers:
    """The numbers of sections on which pressure does more, and of stiffer walls and twist.

    The energy stays one: its slopes are its moments, whatever the factors.

    Args:
      pressure: Factor on the pressure that acts on the section, not on the chamber at rest.
      sideways: Factor on the walls' stiffness sideways.
      twist: Factor on the stiffness of twist.
    """
    with_pressure = {name: pressure * getattr(n, name) for name in BY_PRESSURE}
    return n._replace(
        upright=sideways * n.upright,
        axial_stiffness=sideways * n.axial_stiffness,
        torsion=twist * n.torsion,
        crossing=twist * n.crossing,
        **with_pressure,
    )


def softened(n: Numbers, factor: Any) -> Numbers:
    """The numbers of sections of another silicone, whose modulus is `factor` times theirs."""
    return n._replace(
        modulus=factor * n.modulus,
        slackness=factor * n.slackness,
        crossing=n.crossing / factor,
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
