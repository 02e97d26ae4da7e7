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

import contextlib
import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from scipy import optimize

from codesign_jax.measurements import MEASURED
from codesign_jax.measurements import read as read
from codesign_jax.model import morphology
from codesign_jax.scene import Scene
from codesign_jax.types import Params


class Finger(NamedTuple):
    """A finger in the plane in which it bends."""

    segment: float  # length of a segment [m]
    links: int  # number of segments and of joints N
    # Its section at each joint, shape (N,), or one where they are the same
    section: morphology.Section
    shear_modulus: float  # G [Pa]
    stiffness: np.ndarray  # of each joint at small angles [N m/rad], likewise
    gain: np.ndarray  # moment per pressure of each joint [m^3], likewise
    neo_hookean: bool  # whether a joint softens as the effect `neo_hookean` says

    @property
    def length(self) -> float:
        """Length [m]."""
        return self.segment * self.links

    def of_material(self, shear_modulus: float, gain: float = 1.0) -> "Finger":
        """The finger of another G [Pa], whose moment per pressure is so many times its own."""
        scale = shear_modulus / self.shear_modulus
        return self._replace(
            shear_modulus=shear_modulus, stiffness=scale * self.stiffness, gain=gain * self.gain
        )

    def moment(self, angle: np.ndarray) -> np.ndarray:
        """Moment of a joint at an angle [rad], in N m; any shape."""
        linear = self.stiffness * angle
        if not self.neo_hookean:
            return linear
        height, wall, width = self.section
        lacking = morphology.softening(angle / self.segment, height, wall, width=width)
        return linear * (1 - np.asarray(lacking))


def of_design(scene: Scene, params: Params, index: int) -> Finger:
    """A hand's finger."""
    hand = scene.hand
    links = scene.discretization.links
    params = jax.tree.map(lambda v: np.asarray(v, float), params)
    beams = morphology.finger_beams(hand, params, links)
    springs, _ = morphology.joint_springs(hand, params, beams, links, ("bend",))
    sections = morphology.sections(hand, params, morphology.at_joints(links))
    return Finger(
        float(params.length[index]) / links,
        links,
        morphology.Section(*(v[min(index, len(v) - 1)] for v in sections)),
        float(hand.material.shear_modulus),
        np.asarray(springs[index, :, 0]),
        np.asarray(beams.moment_per_pressure[index]),
        bool(scene.effects.neo_hookean),
    )


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
        moment = pressure * finger.gain
        unit = float(finger.stiffness[0])
        reach = finger.segment * np.append(np.ones(n - 1), 0.5)  # of the bodies behind the joints

        def tip(angles: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
            """The tip's height, and its first and second derivatives by the joints' angles."""
            direction = np.cumsum(angles)
            lever, rise = (
                np.cumsum((reach * v)[::-1])[::-1] for v in (np.cos(direction), np.sin(direction))
            )
            return float(rise[0]), lever, -rise[np.maximum(*np.indices((n, n)))]

        def force(x: np.ndarray) -> float:
            return float(x[n]) * unit / finger.length if held else load

        def residual(x: np.ndarray) -> np.ndarray:
            height, lever, _ = tip(x[:n])
            out = (finger.moment(x[:n]) - moment + force(x) * lever) / unit
            return np.append(out, height / finger.length) if held else out

        def slopes(x: np.ndarray) -> np.ndarray:
            _, lever, second = tip(x[:n])
            small = 1e-5
            tangent = (finger.moment(x[:n] + small) - finger.moment(x[:n] - small)) / (2 * small)
            out = (np.diag(tangent) + force(x) * second) / unit
            if not held:
                return out
            border = lever[:, None] / finger.length
            return np.block([[out, border], [border.T, np.zeros((1, 1))]])

        first = np.zeros(n + held)
        if start is not None:
            first[:n] = start.angles
            first[n:] = start.force * finger.length / unit
        found = optimize.root(residual, first, jac=slopes, tol=1e-12)
        if np.abs(residual(found.x)).max() > 1e-8:
            raise NoRest(f"no rest found at {pressure / 1e3:g} kPa: {TOO_FAR}")
        return cls(found.x[:n], force(found.x), tip(found.x[:n])[0])


def predict(finger: Finger, table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What a finger does where something was measured.

    Args:
      table: Columns of `measurements.COLUMNS` [SI units], shape (row,); NaN where a row has none.

    Returns:
      Columns of `MEASURED` that the table has, shape (row,); NaN where the row has none, or the
      finger no rest.
    """
    rows = len(table["pressure"])
    found = {name: np.full(rows, np.nan) for name in MEASURED if name in table}
    free = held = Rest(np.zeros(finger.links), 0.0, 0.0)
    for row in np.argsort(table["pressure"], kind="stable"):  # each begins where the last one ended
        pressure = float(table["pressure"][row])
        asked = {n for n in found if np.isfinite(table[n][row])}
        if "blocked_force" in asked:
            found["blocked_force"][row] = pressure * finger.gain[0] / finger.length
        if "tip_force" in asked:
            with contextlib.suppress(NoRest):
                held = Rest.of(finger, pressure, held=True, start=held)
                found["tip_force"][row] = held.force
        if asked & {"angle", "deflection"}:
            with contextlib.suppress(NoRest):
                free = Rest.of(finger, pressure, start=free)
                if "angle" in asked:
                    found["angle"][row] = free.angles.sum()
                if "deflection" in asked:
                    bent = Rest.of(finger, pressure, float(table["load"][row]), start=free)
                    found["deflection"][row] = free.height - bent.height
    return found


def without_rest(
    table: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Pressures [Pa] at which a finger has no rest, in rising order, by the column that lacks it.

    Args:
      found: What `predict` makes of the table.
    """
    lacking = {n: np.isfinite(table[n]) & np.isnan(v) for n, v in found.items()}
    return {n: np.unique(table["pressure"][rows]) for n, rows in lacking.items() if rows.any()}


def opposed(table: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]) -> list[str]:
    """Columns that were measured with the other sign than that of `predict`, most of their rows."""
    return [n for n, v in found.items() if np.nansum(v * table[n]) < 0]


class Fit(NamedTuple):
    """What of a finger's material a measurement gives."""

    shear_modulus: float  # G [Pa]
    gain: float  # factor on the moment per pressure
    # Standard errors of their logarithms if all rows of a column err alike; 0 for what was not
    # fitted, NaN where there are no more different values than numbers
    spread: tuple[float, float]


def fitted(table: Mapping[str, np.ndarray]) -> tuple[bool, bool]:
    """Whether a measurement gives G, and whether it gives the gain.

    The angle of a free tip depends on their ratio alone, forces on a held tip (nearly) on the gain
    alone, and a deflection by a load (nearly) on G alone.
    """
    modulus = "angle" in table or "deflection" in table
    forces = "tip_force" in table or "blocked_force" in table
    return modulus, forces or {"angle", "deflection"} <= set(table)


def fit(finger: Finger, table: Mapping[str, np.ndarray]) -> Fit:
    """Fits G, and where the measurement gives it the gain, by least squares.

    Every column counts by its errors relative to its root mean square, each row once.

    Raises:
      ValueError: If the measurement does not give them, its signs are not the model's, or the
        finger has no rest where something was measured.
    """
    free = np.array(fitted(table))
    names = [n for n in MEASURED if n in table and np.isfinite(table[n]).any()]
    _refuse_values(finger, table, names)
    sizes = {n: math.sqrt(np.nanmean(table[n] ** 2)) for n in names}

    def material(logs: np.ndarray) -> tuple[float, float]:
        full = np.zeros(2)
        full[free] = logs
        return finger.shear_modulus * math.exp(full[0]), math.exp(full[1])

    def residual(logs: np.ndarray) -> np.ndarray:
        modulus, gain = material(logs)
        model = predict(finger.of_material(modulus, gain), table)
        if lacking := without_rest(table, model):
            lowest = min(v.min() for v in lacking.values())
            words = f"a finger of G = {modulus / 1e3:.4g} kPa has no rest at {lowest / 1e3:g} kPa"
            raise NoRest(f"{words}: {TOO_FAR}")
        errors = np.concatenate([(model[n] - table[n]) / sizes[n] for n in names])
        return errors[np.isfinite(errors)]

    numbers = int(free.sum())
    count = _different_values(table, names)
    if count < numbers:
        raise ValueError(f"{count} measured value does not give {numbers} numbers")
    found = optimize.least_squares(residual, np.zeros(numbers), x_scale=0.3, diff_step=1e-4)
    if np.linalg.matrix_rank(found.jac) < numbers:
        raise ValueError("the measured values do not depend on what is fitted to them")
    spread = np.zeros(2)
    spread[free] = math.nan
    if count > numbers:
        variance = 2 * found.cost / (len(found.fun) - numbers)
        spread[free] = np.sqrt(variance * np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    return Fit(*material(found.x), (float(spread[0]), float(spread[1])))


def _refuse_values(finger: Finger, table: Mapping[str, np.ndarray], names: list[str]) -> None:
    """Refuses columns that no material explains: of zeros, and of the other sign."""
    for name in names:
        if not np.nan_to_num(table[name]).any():
            raise ValueError(f"every measured {_words(name)} is 0: there is nothing to fit")
    if not table["pressure"].any() and "deflection" not in names:
        raise ValueError("every pressure is 0: there is nothing to fit")
    if wrong := opposed(table, predict(finger, table)):
        raise ValueError(
            f"{' and '.join(map(_words, wrong))} of the other sign than the model's: bending "
            "under pressure, and what resists it, count as positive; change the signs in the file"
        )


def _different_values(table: Mapping[str, np.ndarray], names: list[str]) -> int:
    """Number of measured values; a row that is repeated to the last digit counts once."""
    loads = table.get("load", np.zeros_like(table["pressure"]))
    count = 0
    for name in names:
        rows = np.stack([table["pressure"], np.nan_to_num(loads), table[name]], 1)
        count += len(np.unique(rows[np.isfinite(table[name])], axis=0))
    return count


def _words(name: str) -> str:
    return name.replace("_", " ")
