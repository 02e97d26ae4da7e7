"""The open constants with their ranges, and designs of sets of them."""

import dataclasses
import warnings
from collections.abc import Mapping

import numpy as np
from scipy import stats
from scipy.stats import qmc

from codesign_jax.scene import Constants, Scene
from codesign_jax.scene import constants as checks
from codesign_jax.scene.schema import InputError

CLEARANCE = 0.002
"""Smallest gap between the sections of a pair of fingers at a spread of zero [m]."""


CUTOFF = 3.0
"""Implausibility above which a set is ruled out: three standard deviations, whatever the
distribution as long as it has one peak (Pukelsheim 1994)."""


@dataclasses.dataclass(frozen=True)
class Open:
    """A constant that the paper does not give.

    Attributes:
      name: Its name.
      unit: Unit of the values, for files and figures.
      low: Lower end of its range.
      high: Upper end.
      log: Whether it is drawn evenly in its logarithm.
      label: What figures call it.
    """

    name: str
    unit: str
    low: float
    high: float
    log: bool = False
    label: str = ""


OPEN = (
    Open("tilt", "deg", 30, 90, label="tilt of the fingers"),
    Open("base_x", "mm", 15, 45, label="base radius"),
    Open("pair_gap", "mm", 22, 40, label="gap of a pair"),
    Open("zero_height", "mm", 0, 80, label="height at X_D z = 0"),
    Open("shear_modulus", "kPa", 16, 90, log=True, label="shear modulus"),
    Open("width", "mm", 15, 30, label="width of a finger"),
    Open("lateral", "", 0.29, 1, label="lateral stiffness"),
    Open("torsion", "", 1, 3, label="torsional stiffness"),
    Open("half_size", "mm", 20, 40, label="half size of objects"),
    Open("mass", "g", 20, 300, log=True, label="mass of objects"),
    Open("friction", "", 0.5, 1.2, label="friction, hand"),
    Open("table_friction", "", 0.2, 0.6, label="friction, table"),
    Open("wrist_linear", "N/m", 100, 2000, log=True, label="wrist, linear"),
    Open("wrist_angular", "N m/rad", 1, 20, log=True, label="wrist, angular"),
    Open("shake_amplitude", "deg", 10, 45, label="amplitude of shaking"),
    Open("shake_frequency", "Hz", 0.5, 2, label="frequency of shaking"),
    Open("normal_stiffness", "kN/m", 1, 20, log=True, label="contact stiffness"),
    Open("friction_ratio", "", 3, 100, log=True, label="impratio"),
    Open("cost_maximum", "", 2.2, 4, label="scale of the cost"),
)
"""Ranges and their evidence: docs/notes/calibration.md.

`base_x` is the distance of the base points from the plane between the two pairs of fingers,
`pair_gap` that of the two base points of a pair, `half_size` that of the cuboid, with which all
objects grow.  Damping of the wrist follows its stiffness at the file's damping ratio.
"""
NAMES = tuple(o.name for o in OPEN)


def space_filling(count: int, seed: int) -> np.ndarray:
    """The first points of a scrambled Sobol sequence in the unit cube, shape (count, constant).

    Every beginning of the sequence fills the cube, so that a wave that is cut short is one as well.

    Args:
      count: Number of sets.
      seed: Seed of the scrambling.
    """
    with warnings.catch_warnings():
        # Balanced at powers of two only; other numbers are as even as the sequence allows.
        warnings.filterwarnings("ignore", "The balance properties", UserWarning)
        # SciPy 1.15 renamed the argument and takes the old name as well.
        sequence = qmc.Sobol(len(OPEN), seed=np.random.default_rng(seed))  # type: ignore
        return sequence.random(count)


def around(units: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Sets around others: a draw of their kernel density, reflected into the unit cube.

    Args:
      units: Sets that are not ruled out, in the unit cube, shape (set, constant).
      count: Number of sets to draw.
      seed: Seed of the draws.

    Raises:
      ValueError: If there are too few sets for a density.
    """
    if len(units) < 3:
        raise ValueError(f"{len(units)} sets are too few to draw others around them")
    rng = np.random.default_rng(seed)
    # Scott's bandwidth with each constant's own spread: few sets do not tell correlations.
    width = len(units) ** (-1.0 / (units.shape[1] + 4)) * units.std(0)
    drawn = units[rng.integers(0, len(units), count)]
    drawn = drawn + width * stats.norm.rvs(size=drawn.shape, random_state=rng)
    folded = np.abs(drawn) % 2.0
    return np.where(folded > 1.0, 2.0 - folded, folded)


def values(units: np.ndarray) -> dict[str, np.ndarray]:
    """Values of sets in the units of `OPEN`, shape (set,) by name.

    The gap of a pair begins where the sections leave `CLEARANCE`.

    Args:
      units: Points of the unit cube, shape (set, constant).
    """
    found = {}
    for o, u in zip(OPEN, np.asarray(units, float).T, strict=True):
        low, high = (np.log([o.low, o.high]) if o.log else np.array([o.low, o.high])) + 0.0
        scaled = low + u * (high - low)
        found[o.name] = np.exp(scaled) if o.log else scaled
    gap = OPEN[NAMES.index("pair_gap")]
    least = np.maximum(gap.low, found["width"] + 1e3 * CLEARANCE)
    u = np.asarray(units, float)[:, NAMES.index("pair_gap")]
    found["pair_gap"] = least + u * (gap.high - least)
    return found


def numbers(scene: Scene, chosen: Mapping[str, np.ndarray]) -> Constants:
    """The scene's numbers with those of sets in them.

    Args:
      scene: The scene; its fingers must have base points of their own.
      chosen: Values as `values` returns them, shape (set,).

    Returns:
      Constants, leaves of shape () or, where a set decides them, (set,).

    Raises:
      InputError: If a finger's base point lies on a circle, or a value is out of its range.
    """
    if any(f.base is None for f in scene.hand.finger):
        raise InputError(
            [f"hand {scene.hand.name!r}: calibration moves base points; give each finger a base"]
        )
    c = scene.constants()
    c = c._replace(
        hand=_hand(c.hand, chosen),
        objects=_objects(c.objects, chosen),
        arm=c.arm._replace(
            zero_height=1e-3 * chosen["zero_height"],
            shake_amplitude=chosen["shake_amplitude"],
            shake_frequency=chosen["shake_frequency"],
        ),
        contact=c.contact._replace(
            normal_stiffness=1e3 * chosen["normal_stiffness"],
            friction_ratio=chosen["friction_ratio"],
        ),
        cost=c.cost._replace(maximum=chosen["cost_maximum"]),
    )
    checks.check(scene, c)
    return c


def _hand(hand, chosen: Mapping[str, np.ndarray]):
    x, y = 1e-3 * chosen["base_x"], 0.5e-3 * chosen["pair_gap"]
    fingers = tuple(
        f._replace(tilt=chosen["tilt"], base=(np.sign(f.base[0]) * x, np.sign(f.base[1]) * y))
        for f in hand.finger
    )
    material = hand.material._replace(
        shear_modulus=1e3 * chosen["shear_modulus"],
        lateral_factor=chosen["lateral"],
        torsion_factor=chosen["torsion"],
    )
    linear, angular, wrist = chosen["wrist_linear"], chosen["wrist_angular"], hand.wrist
    wrist = wrist._replace(
        linear_stiffness=linear,
        angular_stiffness=angular,
        linear_damping=wrist.linear_damping * np.sqrt(linear / wrist.linear_stiffness),
        angular_damping=wrist.angular_damping * np.sqrt(angular / wrist.angular_stiffness),
    )
    section = hand.section._replace(width=1e-3 * chosen["width"])
    return hand._replace(finger=fingers, material=material, wrist=wrist, section=section)


def _objects(objects, chosen: Mapping[str, np.ndarray]):
    factor = 1e-3 * chosen["half_size"] / objects.object[0].size[0]
    shapes = tuple(
        shape._replace(
            size=tuple(factor * v for v in shape.size),
            mass=1e-3 * chosen["mass"],
            friction=chosen["friction"],
        )
        for shape in objects.object
    )
    table = objects.table._replace(friction=chosen["table_friction"])
    return objects._replace(object=shapes, table=table)


def plausible(distances: np.ndarray, cutoff: float = CUTOFF) -> np.ndarray:
    """Which sets no target rules out, bool, shape (set,)."""
    return np.asarray((distances <= cutoff).all(-1))
