"""One finger at rest in the plane in which it bends: what it does under pressure and load.

The finger is the simulation's: a chain of equal segments with joints at their midpoints, the
springs and the moment of `model.morphology`, without weight. Its rest is solved for, not simulated,
so that a measurement is compared, and the material fitted, in a second.

>>> from codesign_jax import finger, parameters, scene
>>> grasping = scene.load("paper")
>>> space = parameters.design_space(grasping.hand, "2d")
>>> mine = finger.of_design(grasping, space.params(space.default()), 0)
>>> bent = finger.Rest.of(mine, pressure=30e3)
>>> float(bent.angles.sum()) > 0  # towards the inextensible layer
True
"""

from typing import NamedTuple

import jax
import numpy as np
from scipy import optimize

from codesign_jax.model import morphology
from codesign_jax.scene import Scene, section_law, section_numbers
from codesign_jax.scene.hand import Hand
from codesign_jax.scene.section_numbers import Numbers
from codesign_jax.types import Params


class Constants(NamedTuple):
    """Constants of a finger's material that a measurement may tell: keys of `hand.material`."""

    shear_modulus: float  # G [Pa]
    moment_factor: float  # factor on the moment per pressure of the section
    lateral_factor: float  # factor on the stiffness of bending sideways
    torsion_factor: float  # factor on the stiffness of twist
    damping_time: float  # beta of a Kelvin-Voigt solid [s]


class Bodies(NamedTuple):
    """The finger's segments as they swing; shape (N,) but `stub`."""

    mass: np.ndarray  # [kg]
    inertia: np.ndarray  # about their centres, of the rotation that bending is [kg m^2]
    along: np.ndarray  # centres from their joints along the segments [m]
    up: np.ndarray  # centres over the line of the joints, the inextensible layer [m]


class Finger(NamedTuple):
    """A finger as a chain; stiffness and gain of each joint, shape (N,), or (1,) where alike."""

    segment: float  # length of a segment [m]
    links: int  # number of segments and of joints N
    section: morphology.Section  # at each joint, shape (N,) or (1,)
    constants: Constants
    stiffness: np.ndarray  # of bending, at small angles [N m/rad]
    gain: np.ndarray  # moment per pressure [m^3]
    neo_hookean: bool  # whether a joint softens as the effect `neo_hookean` says
    lateral: np.ndarray  # stiffness of bending sideways [N m/rad]
    twist: np.ndarray  # stiffness of twist [N m/rad]
    bodies: Bodies
    # What the law of its sections needs of them; None with the law "chamber".  Stiffness is then
    # that of the straight finger without pressure, and the gain that at little pressure.
    law: Numbers | None = None

    @property
    def length(self) -> float:
        """Length [m]."""
        return self.segment * self.links

    def of_material(
        self,
        shear_modulus: float | None = None,
        moment_factor: float | None = None,
        lateral_factor: float | None = None,
        torsion_factor: float | None = None,
        damping_time: float | None = None,
    ) -> "Finger":
        """The finger of other constants of its material; None for its own."""
        values = (shear_modulus, moment_factor, lateral_factor, torsion_factor, damping_time)
        new = Constants(
            *(b if a is None else a for a, b in zip(values, self.constants, strict=True))
        )
        old = self.constants
        softer = new.shear_modulus / old.shear_modulus
        return self._replace(
            constants=new,
            law=None if self.law is None else section_numbers.softened(self.law, softer),
            stiffness=softer * self.stiffness,
            lateral=softer * new.lateral_factor / old.lateral_factor * self.lateral,
            twist=softer * new.torsion_factor / old.torsion_factor * self.twist,
            gain=new.moment_factor / old.moment_factor * self.gain,
        )

    def held(self, pressure: float | np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Moment that holds joints at angles [rad] under a pressure [Pa], in N m; (..., N)."""
        if self.law is not None:
            return section_law.response(self.law, pressure, 0.0, angle / self.segment, 0.0).bend
        moment = self.stiffness * angle
        if self.neo_hookean:
            height, wall, width = self.section
            lacking = morphology.softening(angle / self.segment, height, wall, width=width)
            moment = moment * (1 - np.asarray(lacking))
        return moment - pressure * self.gain

    def sideways(self, pressure: float, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stiffness of bending sideways and of twist at angles of bend [N m/rad], shape (N,)."""
        if self.law is None:
            return self.lateral, self.twist
        state = section_law.response(self.law, pressure, 0.0, angle / self.segment, 0.0)
        return state.sideways / self.segment, state.torsion / self.segment


def of_design(scene: Scene, params: Params, index: int) -> Finger:
    """A hand's finger."""
    hand = scene.hand
    links = scene.discretization.links
    params = jax.tree.map(lambda v: np.asarray(v, float), params)
    beams = morphology.finger_beams(hand, params, links)
    axes = ("bend", "lateral", "twist")
    springs, _ = morphology.joint_springs(hand, params, beams, links, axes)
    sections = morphology.sections(hand, params, morphology.at_joints(links))
    stiffness, lateral, twist = np.moveaxis(np.asarray(springs[index]), -1, 0)
    gain = np.asarray(beams.moment_per_pressure[index])
    law = None
    if hand.section.law == "elements":
        every = np.broadcast_arrays(*morphology.law_numbers(hand, params, links))
        law = Numbers(*(v[index] for v in every))
        gain = law.lever * law.height**3
    return Finger(
        segment=float(params.length[index]) / links,
        links=links,
        section=morphology.Section(*(v[min(index, len(v) - 1)] for v in sections)),
        constants=Constants(*(float(getattr(hand.material, n)) for n in Constants._fields)),
        stiffness=stiffness,
        gain=gain,
        neo_hookean=bool(scene.effects.neo_hookean),
        lateral=lateral,
        twist=twist,
        bodies=_bodies(hand, params, links, index),
        law=law,
    )


def _bodies(hand: Hand, params: Params, links: int, index: int) -> Bodies:
    """The segments behind a finger's joints; the first half of the first one does not move."""
    segments = morphology.segments(hand, params, links)
    up = np.broadcast_to(segments.up, segments.mass.shape)
    parts = (segments.mass, segments.inertia[..., 1], segments.along, up)
    return Bodies(*(np.asarray(v[index, 1:], float) for v in parts))


TOO_FAR = "the finger bends too far for its law"
"""Why a finger has no rest."""


class NoRest(ValueError):
    """A finger does not come to rest under a pressure and a load."""


class Rest(NamedTuple):
    """A finger at rest."""

    angles: np.ndarray  # of the joints [rad], shape (N,)
    force: float  # on the tip, against the bending [N]
    height: float  # of the tip, from the unbent finger towards its bending [m]

    @classmethod
    def of(
        cls,
        finger: Finger,
        pressure: float,
        load: float = 0.0,
        *,
        held: bool = False,
        start: "Rest | None" = None,
    ) -> "Rest":
        """Balances the joints.

        Args:
          pressure: Gauge pressure [Pa].
          load: Dead force on the tip, across the unbent finger and against its bending [N].

        Raises:
          NoRest: If the joints cannot be balanced.
        """
        n = finger.links
        unit = float(finger.stiffness[0])
        reach = finger.segment * np.append(np.ones(n - 1), 0.5)  # of the bodies behind the joints

        later = np.maximum(*np.indices((n, n)))

        def levers(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """From each joint to the tip, along the unbent finger and towards its bending."""
            direction = angles.cumsum()
            along = (reach * np.cos(direction))[::-1].cumsum()[::-1]
            return along, (reach * np.sin(direction))[::-1].cumsum()[::-1]

        def force(x: np.ndarray) -> float:
            return float(x[n]) * unit / finger.length if held else load

        def residual(x: np.ndarray) -> np.ndarray:
            lever, rise = levers(x[:n])
            out = (finger.held(pressure, x[:n]) + force(x) * lever) / unit
            return np.append(out, rise[0] / finger.length) if held else out

        def slopes(x: np.ndarray) -> np.ndarray:
            lever, rise = levers(x[:n])
            small = 1e-5
            after, before = (finger.held(pressure, x[:n] + s) for s in (small, -small))
            tangent = (after - before) / (2 * small)
            out = (np.diag(tangent) - force(x) * rise[later]) / unit
            if not held:
                return out
            border = lever[:, None] / finger.length
            return np.block([[out, border], [border.T, np.zeros((1, 1))]])

        first = np.zeros(n + held)
        if start is not None:
            first[:n] = start.angles
            first[n:] = start.force * finger.length / unit
        solution = optimize.root(residual, first, jac=slopes, tol=1e-12)
        if np.abs(residual(solution.x)).max() > 1e-8:
            raise NoRest(f"no rest found at {pressure / 1e3:g} kPa: {TOO_FAR}")
        return cls(solution.x[:n], force(solution.x), float(levers(solution.x[:n])[1][0]))


def sideways(finger: Finger, rest: Rest, pressure: float, load: float) -> float:
    """How far a small load on the tip moves it out of the plane in which a finger is bent [m].

    To first order in the load: a joint gives way about its axis across the bend by k_lat and about
    its axis along the finger by k_twist, each with the tip's lever about it, so that a straight
    finger tells the former alone.  The axes stand in the middle of a joint's bend, as hinges in
    alternating order do to first order.
    """
    before = np.cumsum(rest.angles)
    middle = before - rest.angles / 2
    reach = finger.segment * np.append(np.ones(finger.links - 1), 0.5)
    along = np.cumsum((reach * np.cos(before))[::-1])[::-1]
    up = np.cumsum((reach * np.sin(before))[::-1])[::-1]
    across = np.cos(middle) * along + np.sin(middle) * up
    aside = np.cos(middle) * up - np.sin(middle) * along
    lateral, twist = finger.sideways(pressure, rest.angles)
    return float(load * (across**2 / lateral + aside**2 / twist).sum())


def tip_place(finger: Finger, rest: Rest) -> tuple[float, float]:
    """Where the tip is, along the unbent finger from its base and towards the bending [m]."""
    reach = finger.segment * np.append(np.ones(finger.links - 1), 0.5)
    along = (reach * np.cos(np.cumsum(rest.angles))).sum()
    return float(finger.segment / 2 + along), rest.height
