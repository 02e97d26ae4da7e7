"""Beam theory of a PneuFlex finger: section and pressure to stiffness, mass and moment.

Section frame: y = height above the inextensible bottom layer, z = width, x along the finger.  The
outer section is width x height with walls of equal thickness around one air chamber.  Formulas
follow from elementary beam theory (Euler-Bernoulli bending, Bredt torsion) for a neo-Hookean wall
of shear modulus G that the hoop threads hold in plane strain, hence the modulus 4 G in bending;
they model the actuator of Deimel and Brock (2016) that the paper refers to as [2].
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.model.layout import beyond_base
from codesign_jax.scene import section_growth, section_law, section_numbers, silicones
from codesign_jax.scene.beams import Beam, beam, softening
from codesign_jax.scene.hand import Hand, highest_pressure
from codesign_jax.scene.primitives import block_inertia
from codesign_jax.types import Params

__all__ = [
    "Beam",
    "Section",
    "Segments",
    "at_joints",
    "chamber_volumes",
    "beam",
    "finger_beams",
    "free_bends",
    "free_curvatures",
    "joint_springs",
    "growth_numbers",
    "law_numbers",
    "pressure_limits",
    "section_bends",
    "sections",
    "segments",
    "sphere_radii",
    "softening",
    "sphere_places",
    "threshold_energy",
    "threshold_moments",
    "thresholds",
    "twists_by_itself",
]


def chamber_volumes(hand: Hand, params: Params) -> Any:
    """Air in the unloaded chambers, from base to tip [m^3], shape (..., finger).

    Args:
      hand: The hand.
      params: Parameters, arrays of shape (..., finger).
    """
    base = params.height, params.wall, hand.section.width
    tip = base if params.tip is None else params.tip
    middle = tuple((a + b) / 2 for a, b in zip(base, tip, strict=True))

    def area(height: Any, wall: Any, width: Any) -> Any:
        return (height - 2 * wall) * (width - 2 * wall)

    # Simpson's rule is exact: along a tapered finger the area is quadratic in the place.
    return params.length * (area(*base) + 4 * area(*middle) + area(*tip)) / 6


def air(hand: Hand, params: Params) -> Any:
    """Air in all unloaded chambers of a hand [cm^3], shape (...); see `chamber_volumes`."""
    return 1e6 * chamber_volumes(hand, jax.tree.map(np.asarray, params)).sum(-1)


def pressure_limits(hand: Hand, params: Params) -> np.ndarray:
    """Highest pressures of a hand's fingers by Table I [Pa], shaped as their walls."""
    wall = np.asarray(params.wall, float)
    tip = None if params.tip is None else np.asarray(params.tip.wall, float)
    return np.asarray(highest_pressure(hand, wall, tip))


class Section(NamedTuple):
    """Outer height, wall and outer width of sections along fingers [m], shape (finger, place).

    There is one place where they are the same all along.
    """

    height: Any
    wall: Any
    width: Any


def sections(hand: Hand, params: Params, places: np.ndarray) -> Section:
    """The sections of fingers at places, shares of their length from 0 to 1, shape (place,)."""
    width = hand.section.width  # traced it is JAX's, also where the design is of NumPy
    if not isinstance(width, jax.Array):
        width = params.height.__array_namespace__().asarray(width)
    base = Section(params.height[:, None], params.wall[:, None], width[None, None])
    if params.tip is None:
        return base
    tip = Section(*(v[:, None] for v in params.tip))
    return Section(*(a + (b - a) * places for a, b in zip(base, tip, strict=True)))


def at_joints(links: int) -> np.ndarray:
    """Places of a finger's joints, the middles of its segments, shape (N,)."""
    return (np.arange(links) + 0.5) / links


def finger_beams(hand: Hand, params: Params, links: int) -> Beam:
    """Returns the beam properties of every finger at its joints, shape (finger, N).

    N is 1 where they are the same all along.
    """
    material = hand.material
    section = sections(hand, params, at_joints(links))
    beams = _beam(hand, section)
    return beams._replace(
        lateral=material.lateral_factor * beams.lateral,
        torsion=material.torsion_factor * beams.torsion,
        moment_per_pressure=material.moment_factor * beams.moment_per_pressure,
    )


def _beam(hand: Hand, section: Section) -> Beam:
    modulus = hand.material.shear_modulus
    density = hand.material.density
    return beam(
        section.height, section.wall, width=section.width, shear_modulus=modulus, density=density
    )


def free_bends(hand: Hand, params: Params, *, neo_hookean: bool | None = None) -> np.ndarray:
    """Angles by which free fingers bend at their pressures [rad], shape (finger,).

    Args:
      neo_hookean: As of `free_curvatures`.
    """
    curvatures = free_curvatures(hand, params, neo_hookean=neo_hookean)
    return curvatures.mean(1) * np.asarray(params.length, float)


def free_curvatures(hand: Hand, params: Params, *, neo_hookean: bool | None = None) -> np.ndarray:
    """Curvatures of free fingers at their pressures [1/m], shape (finger, place).

    Places are `at_joints`, one if a finger is the same all along.

    Args:
      neo_hookean: The bending law; None for that of the hand's material.  The section's law
        "elements" is neo-Hookean.
    """
    if hand.section.law == "elements":
        return section_law.free_bend(*_exact_numbers(hand, params))
    law = silicones.of_law(hand.material.law) if neo_hookean is None else neo_hookean
    exact = jax.tree.map(lambda v: np.asarray(v, float), params)
    links = 1 if params.tip is None else 100
    beams = finger_beams(hand, exact, links)
    curvature = np.asarray(exact.pressure)[:, None] * beams.moment_per_pressure / beams.bending
    if law:
        curvature = _softened(curvature, sections(hand, exact, at_joints(links)))
    return np.asarray(curvature)


def section_bends(hand: Hand, params: Params, *, thread_depth: float | None = None) -> np.ndarray:
    """Angles by which free fingers bend by the law of their sections [rad], shape (finger,).

    Other than beam theory it knows where the thread is, see `section_law`.

    Args:
      thread_depth: Place of the thread in the wall: 0 outside, 1 on the chamber; None for that of
        the hand.
    """
    numbers, pressure = _exact_numbers(hand, params, thread_depth)
    curvature = section_law.free_bend(numbers, pressure)
    return curvature.mean(1) * np.asarray(params.length, float)


def twists_by_itself(hand: Hand, params: Params) -> np.ndarray:
    """Whether fingers twist at their pressures, held straight or bent freely, shape (finger,).

    Their stiffness of twist is negative by the law of their sections, see `section_law`.
    """
    numbers, pressure = _exact_numbers(hand, params)
    free = section_law.free_bend(numbers, pressure)
    bends = (0.0 * free, free)
    stiffness = [section_law.twist_stiffness(numbers, pressure, bend) for bend in bends]
    return (np.minimum(*stiffness) < 0).any(1)


def _exact_numbers(
    hand: Hand, params: Params, thread_depth: float | None = None
) -> tuple[section_numbers.Numbers, np.ndarray]:
    """Numbers of the sections along fingers, and pressures, shapes (finger, place)."""
    exact = jax.tree.map(lambda v: np.asarray(v, float), params)
    numbers = law_numbers(hand, exact, 1 if params.tip is None else 20, thread_depth)
    return numbers, exact.pressure[:, None]


def law_numbers(
    hand: Hand, params: Params, links: int, thread_depth: float | None = None
) -> section_numbers.Numbers:
    """What `section_law` needs of the sections at fingers' joints, shape (finger, N).

    N is 1 where they are the same all along.

    Args:
      thread_depth: Place of the thread; None for that of the hand.
    """
    shapes = sections(hand, params, at_joints(links))
    length = params.length[:, None]
    return section_numbers.of_hand(hand, *shapes, length, thread_depth=thread_depth)


def growth_numbers(hand: Hand, params: Params, places: Any) -> section_growth.Growth:
    """How sections at places along fingers grow, see `sections`; shape (finger, place)."""
    return section_growth.of_hand(hand, *sections(hand, params, places))


def _softened(linear: np.ndarray, section: Section) -> np.ndarray:
    """Curvature of neo-Hookean walls that have a curvature by the linear law, of any shape.

    At large strain they carry a quarter of the linear moment, so that it is at most four times as
    large; halved 50 times the interval is as short as rounding.
    """

    def bends_further(curvature: np.ndarray) -> np.ndarray:
        lacking = softening(curvature, section.height, section.wall, width=section.width)
        return curvature * (1 - lacking) < linear

    return section_law.bisected(bends_further, linear, 4 * linear, 50)


class Segments(NamedTuple):
    """Numbers of the bodies of fingers: N equal segments, cut in their middles by the joints."""

    # Place of each link's joint along the body that carries it [m], shape (finger, N)
    offset: jax.Array
    extent: jax.Array  # length of each body, half a segment at both ends [m], shape (finger, N + 1)
    mass: jax.Array  # their masses [kg], shape (finger, N + 1)
    inertia: jax.Array  # of solid blocks as large, principal [kg m^2], shape (finger, N + 1, 3)
    along: jax.Array  # centres of mass from the start of the body [m], shape (finger, N + 1)
    # Their height over the bottom layer [m], shape (finger, N + 1), or (finger, 1) if alike
    up: jax.Array


def segments(hand: Hand, params: Params, links: int) -> Segments:
    """Returns the bodies of every finger, in NumPy if that is what the parameters are in.

    Those of tapered fingers have the mass and its centre by Simpson's rule, which is exact for
    them, and the inertia of the block with the section in their middle.
    """
    factor = np.ones(links + 1)
    factor[[0, -1]] = 0.5
    segment = params.length[:, None] / links
    extent = segment * factor
    offset = segment * factor[:-1]
    start = np.concatenate([[0.0], at_joints(links)])
    density, along, up = _contents(hand, params, start, factor / links)
    mass = density * extent
    middle = sections(hand, params, start + factor / links / 2)
    numpy = mass.__array_namespace__()  # traced if any number is
    inertia = numpy.stack(block_inertia(mass, extent, middle.width, middle.height), -1)
    return Segments(offset, extent, mass, inertia, along * extent, up)


def _contents(hand: Hand, params: Params, start: np.ndarray, span: np.ndarray) -> tuple:
    """Mean mass per length of bodies, and their centres along, as a share, and up [m]."""

    def at(places: np.ndarray) -> tuple[Any, Any]:
        section = sections(hand, params, places)
        return _beam(hand, section).line_density, section.height / 2

    if params.tip is None:
        density, up = at(start)
        return density, 0.5, up
    (a, low), (b, middle), (c, high) = (at(start + share * span) for share in (0.0, 0.5, 1.0))
    mean = (a + 4 * b + c) / 6
    up = (a * low + 4 * b * middle + c * high) / 6 / mean
    return mean, (2 * b + c) / 6 / mean, up


def sphere_places(extent: jax.Array, count: int) -> jax.Array:
    """Places along each moving link of spheres that are spread evenly [m], (finger, N, count)."""
    return extent[:, 1:, None] * (np.arange(count) + 0.5) / count


def sphere_radii(hand: Hand, params: Params, links: int, count: int) -> Any:
    """Their radii, half the height there [m], of that shape, or (finger, 1, 1) if all are alike."""
    span = np.append(np.ones(links - 1), 0.5)[:, None] / links
    places = at_joints(links)[:, None] + span * (np.arange(count) + 0.5) / count
    heights = sections(hand, params, places.ravel()).height
    shape = (1, 1) if params.tip is None else places.shape
    return heights.reshape(len(heights), *shape) / 2


def spheres_on_palm(hand: Hand, params: Params, links: int, count: int) -> Any:
    """Whether spheres may touch the palm, shape (finger, N, count), see `layout.beyond_base`."""
    extent = segments(hand, params, links).extent
    joints = at_joints(links) * params.length[:, None]
    along = joints[..., None] + sphere_places(extent, count)
    return beyond_base(along, 2.0 * sphere_radii(hand, params, links, count)[:, :1, :1])


def joint_springs(
    hand: Hand, params: Params, beams: Beam, links: int, axes: tuple[str, ...]
) -> tuple[jax.Array, jax.Array]:
    """Stiffness k = EI / l or GJ / l of a segment's length l, and damping beta k (Kelvin-Voigt).

    With the law "elements" the stiffness is that of a straight finger without pressure.

    Returns:
      Stiffness [N m/rad] and damping [N m s/rad] of each finger's joints, shape (finger, N, axis)
      with the beams' N.
    """
    numpy = beams.bending.__array_namespace__()
    by_axis = {"bend": beams.bending, "lateral": beams.lateral, "twist": beams.torsion}
    if hand.section.law == "elements":
        by_axis = section_law.rest(law_numbers(hand, params, links))._asdict()
    segment = (params.length / links)[:, None]
    stiffness = numpy.stack([by_axis[name] / segment for name in axes], -1)
    return stiffness, hand.material.damping_time * stiffness


SLACK = 0.01
"""Strain of the bottom layer over which one of its edges goes slack as a finger bends sideways
[ours]: a fabric that could not stretch at all would let go at once."""


def thresholds(hand: Hand, params: Params, beams: Beam, links: int) -> jax.Array:
    """Numbers of the moment with which a pressurised finger resists bending sideways.

    The bottom layer resists tension only.  Bent sideways by lambda it is taut at one edge, so that
    a fibre at height y and z from the middle has the strain kappa y - |lambda| (w/2 +- z), kappa
    the finger's bending, and the chamber of area A_c shrinks by A_c |lambda| w/2.  What pressure
    and walls store is then, beside the two springs of `beam`,
      |lambda| w/2 T,  T = p A_c - 4 G kappa S,
    with S = A h/2 the walls' moment of area about the bottom layer: T is the layer's tension, and
    nothing bends sideways below the moment T w/2.  See `threshold_moments`.

    Returns:
      Of each finger's joints the moment per pressure A_c w/2 [m^3], its loss by the bend angle
      4 G S w/2 / l [N m/rad], and the angle of `SLACK` [rad], shape (finger, N, 3) with the beams'
      N.
    """
    numpy = beams.bending.__array_namespace__()
    height, _, width = sections(hand, params, at_joints(links))
    segment = (params.length / links)[:, None]
    area = beams.line_density / hand.material.density
    loss = 4 * hand.material.shear_modulus * area * height / 2 * width / 2 / segment
    angle = SLACK / width * segment
    return numpy.stack([beams.moment_per_pressure * width / height, loss, angle], -1)


def threshold_moments(numbers: tuple, pressure: Any, bend: Any, lateral: Any) -> tuple[Any, Any]:
    """Moment that the tension of the bottom layer adds to a joint, see `thresholds`.

    The stored energy P (sqrt(q^2 + q_0^2) - q_0) has P = max(T w/2, 0), q the lateral angle and q_0
    that of `SLACK`.  Its moment on the lateral hinge is that of a spring P / sqrt(q^2 + q_0^2)
    through zero, the stiffest of the springs that never overshoot; what it loses by the bend angle
    bends the finger further.

    Args:
      pressure: Of the chamber [Pa].
      bend: Bend angle [rad].
      lateral: Lateral angle [rad].

    Returns:
      Stiffness of the lateral hinge [N m/rad] and moment on the bend hinge [N m].
    """
    per_pressure, loss, angle = numbers
    moment = per_pressure * pressure - loss * bend
    taut = moment > 0
    length = lateral.__array_namespace__().sqrt(lateral**2 + angle**2)
    return moment * taut / length, loss * (length - angle) * taut


def threshold_energy(numbers: tuple, pressure: Any, bend: Any, lateral: Any) -> Any:
    """The energy of `threshold_moments`, with its arguments [J]."""
    per_pressure, loss, angle = numbers
    moment = per_pressure * pressure - loss * bend
    length = lateral.__array_namespace__().sqrt(lateral**2 + angle**2)
    return moment * (moment > 0) * (length - angle)
