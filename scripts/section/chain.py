"""A finger as a chain of uniform sections: where its tip is, and how loads on it move the tip."""

from typing import Any, NamedTuple

import numpy as np

from codesign_jax.scene import section_law, section_numbers
from scripts.section.elements import Section

PARTS = 400
"""Straight parts of an arc."""


class Sections(NamedTuple):
    """What a uniform finger is made of; a beam's stiffness in SI units.

    Attributes:
      bend: Curvature towards the fabric [1/m].
      twist: Stiffness of twist [N m^2].
      lateral: Stiffness of bending sideways [N m^2].
      coupling: Twisting moment per curvature sideways [N m^2].
      shear: Force across per angle of shear [N]; infinite where sections do not shear.
    """

    bend: float
    twist: float
    lateral: float
    coupling: float = 0.0
    shear: float = np.inf

    def compliance(self) -> np.ndarray:
        """Twist and curvature sideways over their moments, shape (2, 2)."""
        stiffness = [[self.twist, self.coupling], [self.coupling, self.lateral]]
        return np.linalg.inv(stiffness)


class Arc(NamedTuple):
    """The line of the fabric in parts; X along the base, Z up from the fabric.

    Attributes:
      tip: End of the line [m], shape (3,).
      length: Length of the parts that bend; zero within the end walls.
      moments: Moments about the parts' own two axes by unit loads on the tip, as `solid.LOADS`
        has them, shape (part, axis, load).
    """

    tip: np.ndarray
    length: np.ndarray
    moments: np.ndarray


def arc(bend: float, length: float, *, height: float, end: float = 0.0, axis: float = 0.0) -> Arc:
    """A finger of this curvature.

    Args:
      bend: Curvature between the end walls [1/m].
      length: With the end walls [m].
      height: Of the section [m]: a force acts on the middle of the tip.
      end: Thickness of rigid end walls [m].
      axis: Height over the fabric of the line about which a force across twists the sections [m].
    """
    edges = np.linspace(0, length, PARTS + 1)
    places = np.clip(edges, end, length - end) - end
    angle = bend * (places[1:] + places[:-1]) / 2
    forward = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], 1)
    upright = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)
    line = np.concatenate([np.zeros((1, 3)), np.cumsum(forward * length / PARTS, 0)])
    middle = (line[1:] + line[:-1]) / 2
    turn = bend * places[-1]
    axes = np.array([[np.cos(turn), 0, -np.sin(turn)], [np.sin(turn), 0, np.cos(turn)]])
    lever = line[-1] + height / 2 * axes[1] - middle - axis * upright
    force = np.cross(lever, [0.0, 1.0, 0.0])
    loads = np.stack([force, *(np.broadcast_to(a, force.shape) for a in axes)], -1)
    return Arc(line[-1], np.diff(places), np.stack([forward, upright], 1) @ loads)


def tip_compliance(line: Arc, sections: Sections) -> np.ndarray:
    """Displacement across and rotations of the tip over the loads, shape (3, 3) [SI]."""
    answer = _tip(line, sections.compliance())
    answer[0, 0] += line.length.sum() / sections.shear
    return answer


def _tip(line: Arc, compliance: np.ndarray) -> np.ndarray:
    return np.einsum("k,kai,ab,kbj->ij", line.length, line.moments, compliance, line.moments)


def of_moments(line: Arc, tip: np.ndarray, bend: float) -> Sections:
    """The uniform sections with which moments on the tip rotate it as they rotate the finger's.

    Args:
      line: The finger's.
      tip: What its tip does over the loads, shape (3, 3).
      bend: The finger's curvature [1/m].
    """
    units = [np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])]
    parts = [_tip(line, unit) for unit in units]
    pairs = ((1, 1), (2, 2), (1, 2))
    matrix = [[(part[i, j] + part[j, i]) / 2 for part in parts] for i, j in pairs]
    turns = [(tip[i, j] + tip[j, i]) / 2 for i, j in pairs]
    twist, lateral, coupling = np.linalg.solve(matrix, turns)
    stiffness = np.linalg.inv([[twist, coupling], [coupling, lateral]])
    return Sections(bend, stiffness[0, 0], stiffness[1, 1], stiffness[0, 1])


def shear_stiffness(line: Arc, tip: np.ndarray, sections: Sections) -> float:
    """Force across per angle of shear that explains the tip's displacement [N].

    Shear explains the part of the displacement that the sections' bending and twist do not; without
    such a part the result is infinite or negative.
    """
    return float(line.length.sum() / (tip[0, 0] - _tip(line, sections.compliance())[0, 0]))


def by_law(section: Section, length: float, pressure: float, sideways: float = 0.0) -> Sections:
    """The law's sections of a free finger; its sideways stiffness has shear in series.

    Args:
      section: The section.
      length: Length of the finger [m]; infinite without shear.
      pressure: Of its chamber [Pa].
      sideways: Curvature at which its stiffness sideways is that of the moment [1/m].
    """
    n: Any = section_numbers.numbers(
        np.array(section.height),
        np.array(section.wall),
        section.width,
        shear_modulus=section.shear_modulus,
        length=length,
        thread_depth=section.thread_depth,
        thread_stiffness=section.thread_stiffness,
        fabric_stiffness=section.fabric_stiffness,
    )

    def bends_further(bend: np.ndarray) -> np.ndarray:
        return section_law.response(n, pressure, 0.0, bend, sideways).bend < 0

    most = np.array(section_law.FURTHEST / section.height)
    bend = section_law.bisected(bends_further, -most, most, 50)
    held = section_law.response(n, pressure, 0.0, bend, sideways)
    return Sections(float(bend), float(held.torsion), float(held.sideways))
