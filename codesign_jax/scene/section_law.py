"""The energy of a finger's section under pressure: bending, sideways bending and twist.

An energy per length Pi(pressure, twist, bend, lateral) holds all that a section does: its slopes by
the curvatures are the moments that hold it, and minus its slope by the pressure is the volume of
its chamber.  docs/notes/section.md derives it; finite elements of sections (scripts.section) check
it, and give the dimensionless functions that the derivation leaves open.

Units of the formulas: lengths are over the height h, curvatures times h, pressures over the shear
modulus G, energies per length over G h^2.  y is the height over the fabric.  The slopes by the
curvatures are carried along as dual numbers, so that each formula stands here once and an engine
needs no other differentiation; arrays are NumPy's or JAX's.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.scene.duals import Dual
from codesign_jax.scene.section_numbers import Constants, Numbers, constants

SMOOTH = 3e-3
"""Tension of the fabric below which it counts as slack, over G h^2 [chosen]: 0.1 N."""
STRAIGHT = 1e-5
"""Curvature sideways times h up to which the moment is linear [chosen]: what is over there is a
thousandth of that at which a fabric with the tension `SMOOTH` begins to go slack."""
FURTHEST = 6.0
"""Strain of the top up to which a free bend is looked for."""
HIGHEST = 3.0
"""Pressure over the modulus up to which one is looked for."""
HALVINGS = 26
"""Halvings of that interval: to rounding of single precision."""


class _Walls(NamedTuple):
    """Of neo-Hookean walls in plane strain, with the fabric as the neutral line."""

    energy: Dual
    moment: Dual  # its slope by the bend
    force: Dual  # along the finger


def _walls(n: Numbers, bend: Any) -> _Walls:
    """Integrals over the wall of (l - 1/l)^2 / 2 and of l - l^-3, l = 1 + x y.

    A block of width one from 0 to y has, with v = 1 / (1 + x y), the energy
    x^2 y^3 (1/3 + v) / 2, the moment x y^3 (1/3 + (v + v^2)/2) with the slope y^3 (1/3 + v^3), and
    the force x y^2 (1 + v)^2 / 2 with the slope y^2 (1 + v^2 (1 + 2 v)) / 2.  Bent backwards the
    walls stay linear: v = 1.
    """
    tense = bend * (bend > 0)
    chamber = n.width - 2 * n.wall
    energy = 0.0
    moment = 0.0
    stiffness = 0.0
    force = 0.0
    stretching = 0.0
    for width, y in ((n.width, 1.0), (-chamber, 1 - n.wall), (chamber, n.wall)):
        v = 1 / (1 + tense * y)
        square = v * v
        area = width * y * y
        volume = area * y
        energy = energy + volume * (1 / 3 + v)
        moment = moment + volume * (1 / 3 + (v + square) / 2)
        stiffness = stiffness + volume * (1 / 3 + square * v)
        force = force + area * (1 + v) ** 2
        stretching = stretching + area * (1 + square * (1 + 2 * v))
    moment = bend * moment
    return _Walls(
        Dual(bend * bend / 2 * energy, moment),
        Dual(moment, stiffness),
        Dual(bend / 2 * force, stretching / 2),
    )


def _bending_at_rest(n: Numbers) -> Any:
    """Slope of the walls' moment without bend, 4 times the second moment about the fabric."""
    chamber = n.width - 2 * n.wall
    return (n.width - chamber * ((1 - n.wall) ** 3 - n.wall**3)) * (4 / 3)


def _positive(value: Dual) -> Dual:
    """max(value, 0), smooth."""
    return (value + (value * value + SMOOTH**2).sqrt()) / 2


def _strip(lateral: Dual, half: Dual) -> Dual:
    """How far the taut edge of a strip is bent, over w/2: its slope by the curvature is at most 1.

    A strip that resists tension only carries a tension T.  Up to the curvature `half` all of it is
    taut, k w^3 / 12 per curvature; beyond, a part of the width sqrt(2 T / (k |lateral|)).
    """
    taut = lateral.value < half.value
    most = half.where(taut, lateral)
    beyond = most - (half * most).sqrt() * (4 / 3) + half / 2
    return (lateral * lateral / (half * 6)).where(taut, beyond)


class _State(NamedTuple):
    walls: _Walls
    over: Any  # pressure, none under a vacuum
    bulge: Dual  # amplitude q
    stored: Dual  # energy of the bulge with the pressure's
    tension: Dual  # of the fabric; negative where it is slack


def _state(n: Numbers, p: Any, x: Any) -> _State:
    numpy = n.height.__array_namespace__()
    walls = _walls(n, x)
    # Under a vacuum, or bent without pressure, nothing bulges outwards.
    over = numpy.maximum(p, 0.0)
    bend = Dual(x, 1.0)
    work = (bend * n.bulge_bent + n.bulge) * over - walls.energy * n.flattening
    drive = _positive(work)
    stiffness = numpy.sqrt((1 - n.thinning * over) ** 2 + (n.rounding * over) ** 2)
    q = drive / (walls.energy * n.flattening**2 + stiffness)
    tension = (q * n.axial_round + n.axial) * p - walls.force * (q * n.axial_growth + 1)
    return _State(walls, over, q, drive * q / -2, tension)


def fabric_tension(n: Numbers, pressure: Any, bend: Any) -> Any:
    """Tension of the fabric [N], negative where it is slack; see `energy`."""
    state = _state(n, pressure / n.modulus, bend * n.height)
    return n.modulus * n.height**2 * state.tension.value


class _Fabric(NamedTuple):
    """The middle of the fabric, which bulges down and goes slack first as the finger bends."""

    taut: Dual  # Tension, none where it is slack
    energy: Dual
    moment: Dual  # Its slope by the bend at the same tension and bulge


def _fabric(n: Numbers, c: Constants, state: _State, x: Any) -> _Fabric:
    bend = Dual(x, 1.0)
    taut = _positive(state.tension)
    crown = state.bulge * n.crown
    turn = taut * (c.turn * n.slackness) / (crown + SMOOTH)
    root = (bend * bend + turn * turn + SMOOTH**4).sqrt()
    pull = taut * crown
    energy = pull * (bend / 3 + (root - turn) * (2 / 3))
    return _Fabric(taut, energy, pull * (bend / root * (2 / 3) + 1 / 3))


def _sideways(n: Numbers, c: Constants, tense: Dual, tension: Dual, taut: Dual, y: Any) -> Dual:
    """Energy of bending sideways, and of a slack fabric, which lets the walls go."""
    # The tangent modulus of a stretched wall falls from 4 G to G.
    soft = (tense * (c.stretch / 4) + 1) / (tense * c.stretch + 1)
    axial = soft * n.axial_stiffness
    lateral = Dual(y, 0.0, 1.0)
    reach = n.width / 2 * n.unsheared
    spanned = _positive(tension + axial * lateral * reach)
    # An edge of it goes slack as the finger bends sideways.
    half = spanned * (c.strip * 2 * n.slackness / n.width + n.width * n.shear / 6) + 1e-6
    pulled = _positive(tension + axial * _strip(lateral, half) * reach)
    slack = tension - taut
    released = (pulled * pulled - taut * taut - slack * slack) / (axial * 2)
    return released + soft * lateral * lateral * (n.upright / 2)


def _twisted(
    n: Numbers, c: Constants, p: Any, state: _State, fabric: _Fabric, tense: Dual, square: Dual
) -> Dual:
    """Energy of a twist over its `square`, which is the second variable."""
    walls, over, q, *_ = state
    grown = walls.moment * n.flattening
    held = q * (over * n.bulge_bent - grown - q * grown * (n.flattening / 2))
    held = held + p * n.lever - walls.moment - fabric.moment
    torsion = (q * n.torsion_round + 1) * n.torsion / (tense + 1) + n.crossing
    # Fibres away from the fabric lengthen as it twists, as they would by a bend of `longer` times
    # the square: the moment that is held does work, and walls that are at rest resist.
    longer = (q * c.wagner[1] + c.wagner[0]) / 4
    resisting = longer * longer * square * (_bending_at_rest(n) / 2)
    return torsion / 2 - held * longer + resisting


class Response(NamedTuple):
    """What a section answers to a pressure and its curvatures."""

    energy: Any  # Per length, with that of the pressure, -p V [N]
    twist: Any  # Moments that hold the curvatures: slopes of the energy [N m]
    bend: Any
    lateral: Any
    torsion: Any  # Moment of a twist over the twist, less that of a single winding [N m^2]
    sideways: Any  # Moment sideways over the curvature, never negative [N m^2]


def response(
    n: Numbers,
    pressure: Any,
    twist: Any,
    bend: Any,
    lateral: Any,
    fitted: Constants | None = None,
) -> Response:
    """Energy, moments and stiffness.

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
    size = numpy.abs(lateral * n.height)
    y = numpy.where(size < STRAIGHT, STRAIGHT, size)
    state = _state(n, p, x)
    fabric = _fabric(n, c, state, x)
    # Stretch of the walls: x beyond small strains, without a kink at zero.
    stretch = Dual(x * (x > 0), 1.0 * (x > 0))
    tense = stretch * stretch / (stretch + 0.05)
    chamber = (n.width - 2 * n.wall) * (1 - 2 * n.wall)
    total = state.walls.energy - Dual(p * (chamber + n.lever * x), p * n.lever)
    total = total + state.stored + fabric.energy
    total = total + _sideways(n, c, tense, state.tension, fabric.taut, y)
    square = t * t
    twisted = _twisted(n, c, p, state, fabric, tense, Dual(square, 0.0, 1.0))
    torsion = 2 * (twisted.value + square * twisted.second)
    spring = total.second / y
    scale = n.modulus * n.height**2
    return Response(
        energy=scale * (total.value + twisted.value * square - p * n.helix * t),
        twist=scale * n.height * (torsion * t - p * n.helix),
        bend=scale * n.height * (total.first + twisted.first * square),
        lateral=scale * n.height**2 * spring * lateral,
        torsion=scale * n.height**2 * torsion,
        sideways=scale * n.height**2 * spring,
    )


def energy(
    n: Numbers,
    pressure: Any,
    twist: Any,
    bend: Any,
    lateral: Any,
    fitted: Constants | None = None,
) -> Any:
    """Energy per length with that of the pressure, -p V [N]; arguments as `response` has them."""
    return response(n, pressure, twist, bend, lateral, fitted).energy


def free_bend(n: Numbers, pressure: Any) -> np.ndarray:
    """Curvature of a free finger [1/m], NumPy arrays; its strain kappa h is at most `FURTHEST`."""
    straight = 0.0 * n.height * pressure

    def bends_further(bend: np.ndarray) -> np.ndarray:
        return response(n, pressure, 0.0, bend, 0.0).bend < 0

    bend = bisected(bends_further, straight, straight + FURTHEST / n.height, 40)
    return np.where(np.asarray(pressure) > 0, bend, 0.0)


def bisected(
    lies_below: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, halvings: int
) -> np.ndarray:
    """Roots between two ends by bisection, NumPy arrays of any shape.

    Args:
      lies_below: Whether values lie below the roots.
      low: Lower ends.
      high: Upper ends.
      halvings: Number of halvings of the intervals.
    """
    for _ in range(halvings):
        middle = (low + high) / 2
        below = lies_below(middle)
        low = np.where(below, middle, low)
        high = np.where(below, high, middle)
    return (low + high) / 2


def strain_pressure(n: Numbers, strain: Any) -> Any:
    """Pressure at which the top wall of a free finger has a strain, kappa h [Pa].

    At most `HIGHEST` times the modulus.
    """

    def held(n: Numbers, strain: Any, pressure: Any) -> Any:
        return response(n, pressure, 0.0, strain / n.height, 0.0).bend

    return _root(held, n, strain + 0.0 * n.height)


def steady_pressure(n: Numbers) -> Any:
    """Pressure from which on a finger that is held straight twists by itself [Pa].

    At most `HIGHEST` times the modulus.
    """

    def stiffness(n: Numbers, straight: Any, pressure: Any) -> Any:
        return response(n, pressure, 0.0, straight, 0.0).torsion

    return _root(stiffness, n, 0.0 * n.height)


def _root(function: Callable[..., Any], n: Numbers, other: Any) -> Any:
    """Pressure at which a function falls below zero, differentiable by its other arguments."""
    fixed = n, other
    traced = n.height.__array_namespace__() is not np
    if traced:
        fixed = jax.lax.stop_gradient(fixed)

    def halve(_: Any, ends: tuple[Any, Any]) -> tuple[Any, Any]:
        low, high = ends
        middle = (low + high) / 2
        higher = function(*fixed, middle) > 0
        return low + (middle - low) * higher, middle + (high - middle) * higher

    ends = 0.0 * fixed[1], HIGHEST * fixed[0].modulus + 0.0 * fixed[1]
    if traced:
        ends = jax.lax.fori_loop(0, HALVINGS, halve, ends)
    else:
        for k in range(HALVINGS):
            ends = halve(k, ends)
    pressure = (ends[0] + ends[1]) / 2
    step = 1e-3 * fixed[0].modulus
    after, before = (function(*fixed, pressure + s) for s in (step, -step))
    slope = (after - before) / (2 * step)
    # One step of Newton's method has the derivative of the root; where there is none it is zero.
    reached = pressure < (1 - 1e-3) * HIGHEST * fixed[0].modulus
    value = function(n, other, pressure)
    return pressure - reached * value / (slope + (1 - reached))


def twist_stiffness(n: Numbers, pressure: Any, bend: Any) -> Any:
    """Stiffness of twist [N m^2]; negative where a finger held at this bend twists by itself."""
    return response(n, pressure, 0.0, bend, 0.0).torsion


def volume(n: Numbers, pressure: Any, twist: Any, bend: Any, lateral: Any) -> Any:
    """Volume of the chamber per length [m^2]: minus the energy's slope by the pressure."""
    unit = jax.numpy.ones_like(pressure)
    return -jax.jvp(lambda p: energy(n, p, twist, bend, lateral), (pressure,), (unit,))[1]


def at_joint(
    numbers: Numbers, segment: Any, rest: dict[str, Any], pressure: Any, angles: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Moments that hold a joint's angles, and what a step takes implicitly beside the rest's.

    A joint stands for a segment with the curvatures angle / segment.  A step takes the stiffness at
    rest implicitly, and more where pressure makes a section stiffer: sideways that of the spring
    through zero which has the moment, the stiffest one that never overshoots, and about the
    finger's axis that of twist.  Where a section is softer than at rest, or unstable, so are the
    moments; the implicit stiffness stays that of the rest, so that Newton's matrix is positive.
    Couplings of the axes need none: a positive matrix is at most three times its diagonal, and the
    step is stable up to four times the implicit stiffness ("euler": twice, where two axes couple).

    Args:
      numbers: Of the sections.
      segment: Length of the segments [m].
      rest: Stiffness at rest by the names of the hinges, "bend", "lateral" and "twist" [N m/rad].
      pressure: Gauge pressure of the chambers [Pa].
      angles: Angles by the names of the hinges that there are [rad].

    Returns:
      Both by the names of the hinges [N m] and [N m/rad]; what pressure does is in the moments.
    """
    none = 0.0 * angles["bend"]
    kappa = {name: angles.get(name, none) / segment for name in Rest._fields}
    held = response(numbers, pressure, kappa["twist"], kappa["bend"], kappa["lateral"])
    numpy = numbers.height.__array_namespace__()
    moments = {name: getattr(held, name) for name in angles}
    springs = {"lateral": held.sideways, "twist": held.torsion}
    more = dict.fromkeys(angles, none)
    # In a fixed order, which that of a set is not: so that each process writes the same kernel.
    for name, spring in springs.items():
        if name in angles:
            more[name] = numpy.maximum(spring / segment - rest[name], 0.0)
    return moments, more


class Rest(NamedTuple):
    """Stiffness of a section without pressure that is straight [N m^2]."""

    bend: Any
    lateral: Any
    twist: Any


def rest(n: Numbers) -> Rest:
    """Stiffness at rest.

    Away from the fabric, and with its taut edge as the neutral line of bending sideways: the
    energy's curvatures at rest but for the smoothing of the fabric's slack.
    """
    scale = n.modulus * n.height**4
    reach = n.width / 2 * n.unsheared
    return Rest(
        scale * _bending_at_rest(n),
        scale * (n.axial_stiffness * reach**2 + n.upright),
        scale * (n.torsion + n.crossing),
    )
