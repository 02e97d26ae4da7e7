"""Which place of the thread, or which law, the angles of a free finger support.

Fingers bend by a factor of up to three further with the thread outside than by beam theory, and
the factor grows with pressure, which no other constant imitates (docs/notes/section.md).  The odds
are those of Bayes' rule over even ones: the modulus is unknown by `MODULUS`, and the spread of the
logarithms of measured over predicted angles by an inverse chi-square about `SPREAD`, so that their
likelihood is Student's.
"""

import dataclasses

import numpy as np

from codesign_jax.finger.prediction import Table
from codesign_jax.finger.rest import Finger, of_design
from codesign_jax.scene import Scene
from codesign_jax.scene.section_law import FURTHEST, bisected
from codesign_jax.types import Params

MODULUS = 0.15
"""Standard deviation of the logarithm of a batch's modulus [chosen]: silicones by name have
intervals of up to 14 %."""
SPREAD = 0.08
"""Spread of angles about a law that holds [chosen]: the law of sections errs by 6 % of the moment,
a protractor by 2 %."""
DEGREES = 4.0
"""Degrees of freedom that the spread's prior counts for [chosen]."""
FACTORS = np.linspace(-2.5, 2.5, 21)
"""Moduli that are averaged over, in standard deviations of their logarithm."""
HALVINGS = 30
"""Halvings of the interval in which an angle is found: 1e-9 of it."""

SECTIONS = {
    "thread outside": {"law": "elements", "thread_depth": 0.0},
    "thread on the chamber": {"law": "elements", "thread_depth": 1.0},
    "beam theory": {"law": "chamber"},
}
"""Hypotheses by name: keys of `hand.section`."""


def odds(scene: Scene, params: Params, index: int, table: Table) -> dict[str, float]:
    """Probabilities of `SECTIONS` by the angles of a free finger without load.

    Args:
      scene: The scene of the hand, whose walls are neo-Hookean.
      params: The hand's design.
      index: Number of the finger.
      table: Measurements, with columns "pressure" [Pa] and "angle" [rad].

    Returns:
      Probabilities by name, which add up to one; none where fewer than two angles are told, or
      walls are linear, for which the law of sections does not hold.
    """
    angle = np.asarray(table.get("angle", ()))
    rows = np.flatnonzero(np.isfinite(angle) & (angle > 0))
    rows = rows[table["pressure"][rows] > 0] if rows.size else rows
    if rows.size < 2 or not scene.effects.neo_hookean:
        return {}
    logs = []
    for keys in SECTIONS.values():
        section = dataclasses.replace(scene.hand.section, **keys)
        hand = dataclasses.replace(scene.hand, section=section)
        finger = of_design(dataclasses.replace(scene, hand=hand), params, index)
        logs.append(_evidence(finger, table["pressure"][rows], angle[rows]))
    weights = np.exp(np.array(logs) - max(logs))
    return dict(zip(SECTIONS, (weights / weights.sum()).tolist(), strict=True))


def _evidence(finger: Finger, pressure: np.ndarray, angle: np.ndarray) -> float:
    """Logarithm of the mean likelihood over moduli, but for a constant."""
    logs = []
    for deviation in FACTORS:
        modulus = finger.constants.shear_modulus * np.exp(MODULUS * deviation)
        predicted = free_angles(finger.of_material(shear_modulus=float(modulus)), pressure)
        squares = DEGREES * SPREAD**2 + (np.log(angle / predicted) ** 2).sum()
        logs.append(-(DEGREES + angle.size) / 2 * np.log(squares) - deviation**2 / 2)
    return float(np.logaddexp.reduce(logs))


def free_angles(finger: Finger, pressure: np.ndarray) -> np.ndarray:
    """Angles of a free finger without load [rad], shape as the pressures [Pa]."""
    straight = np.zeros((len(pressure), finger.links))
    most = straight + FURTHEST * finger.segment / finger.section.height

    def bends_further(angles: np.ndarray) -> np.ndarray:
        return finger.held(pressure[:, None], angles) < 0

    return bisected(bends_further, straight, most, HALVINGS).sum(-1)
