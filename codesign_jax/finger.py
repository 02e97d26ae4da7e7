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

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from scipy import optimize

from codesign_jax.model import morphology
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import InputError, nearest
from codesign_jax.types import Params

UNITS = {
    "Pa": ("pressure", 1.0),
    "kPa": ("pressure", 1e3),
    "bar": ("pressure", 1e5),
    "psi": ("pressure", 6894.757293168),
    "deg": ("angle", math.pi / 180),
    "rad": ("angle", 1.0),
    "mN": ("force", 1e-3),
    "N": ("force", 1.0),
    "mm": ("length", 1e-3),
    "cm": ("length", 1e-2),
    "m": ("length", 1.0),
}
"""Units of a column: what they measure, and how many SI units they are."""

COLUMNS = {
    "pressure": ("pressure", "gauge pressure of the chamber"),
    "angle": ("angle", "angle between the finger's base and its free tip"),
    "tip_force": ("force", "force on a tip that is held where it was, the rest free to bow"),
    "blocked_force": ("force", "force on the tip of a finger that is kept straight"),
    "load": ("force", "force on the tip, across the unbent finger, against its bending"),
    "deflection": ("length", "how far the load moves the tip, in the load's direction"),
}
"""Columns of a file of measurements: what their unit measures, and what they are."""

_MOST_LETTERS = 1_000_000
"""Most characters of a measured table."""
MEASURED = ("angle", "tip_force", "blocked_force", "deflection")
"""Columns that are compared with the model."""


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
    hand, links = scene.hand, scene.discretization.links
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
        scene.effects.neo_hookean,
    )


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
        """
        n, moment, unit = finger.links, pressure * finger.gain, float(finger.stiffness[0])
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
            raise ValueError(
                f"no rest found at {pressure / 1e3:g} kPa: the finger bends too far for its law"
            )
        return cls(found.x[:n], force(found.x), tip(found.x[:n])[0])


def predict(finger: Finger, table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What a finger does where something was measured.

    Args:
      table: Columns of `COLUMNS` [SI units], shape (row,); NaN where a row has none.

    Returns:
      Columns of `MEASURED` that the table has, shape (row,); NaN where the row has none.
    """
    rows = len(table["pressure"])
    found = {name: np.full(rows, np.nan) for name in MEASURED if name in table}
    free = held = Rest(np.zeros(finger.links), 0.0, 0.0)
    for row in np.argsort(table["pressure"], kind="stable"):  # each begins where the last one ended
        pressure = float(table["pressure"][row])
        asked = {n for n in found if np.isfinite(table[n][row])}
        if asked & {"angle", "deflection"}:
            free = Rest.of(finger, pressure, start=free)
        if "angle" in asked:
            found["angle"][row] = free.angles.sum()
        if "deflection" in asked:
            bent = Rest.of(finger, pressure, float(table["load"][row]), start=free)
            found["deflection"][row] = free.height - bent.height
        if "tip_force" in asked:
            held = Rest.of(finger, pressure, held=True, start=held)
            found["tip_force"][row] = held.force
        if "blocked_force" in asked:
            found["blocked_force"][row] = pressure * finger.gain[0] / finger.length
    return found


class Fit(NamedTuple):
    """What of a finger's material a measurement gives."""

    shear_modulus: float  # G [Pa]
    gain: float  # factor on the moment per pressure
    # Standard errors of their logarithms if all rows of a column err alike; 0 for what was not
    # fitted
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
    """
    free = np.array(fitted(table))
    names = [n for n in MEASURED if n in table]
    sizes = {n: math.sqrt(np.nanmean(table[n] ** 2)) for n in names}

    def material(logs: np.ndarray) -> tuple[float, float]:
        full = np.zeros(2)
        full[free] = logs
        return finger.shear_modulus * math.exp(full[0]), math.exp(full[1])

    def residual(logs: np.ndarray) -> np.ndarray:
        model = predict(finger.of_material(*material(logs)), table)
        errors = np.concatenate([(model[n] - table[n]) / sizes[n] for n in names])
        return errors[np.isfinite(errors)]

    start = np.zeros(free.sum())
    count = len(residual(start))
    if count < len(start):
        raise ValueError(f"{count} measured value does not give {len(start)} numbers")
    found = optimize.least_squares(residual, start, x_scale=0.3, diff_step=1e-4)
    variance = 2 * found.cost / max(count - len(start), 1)
    spread = np.zeros(2)
    spread[free] = np.sqrt(variance * np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    return Fit(*material(found.x), (float(spread[0]), float(spread[1])))


def read(path: Path) -> dict[str, np.ndarray]:
    """Reads measurements: a CSV whose head names columns with their units, as in angle_deg.

    Lines that begin with # are comments. A cell without a value leaves that quantity out of its
    row.

    Returns:
      Columns of `COLUMNS` that the file has [SI units], shape (row,); NaN for an empty cell.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            text = file.read(_MOST_LETTERS + 1)
            lines = [(n, line) for n, line in enumerate(io.StringIO(text, newline=""), 1)]
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "no UTF-8 text"
        raise InputError([f"{path}: {why}"]) from error
    if len(text) > _MOST_LETTERS:
        raise InputError([f"{path} has more than {_MOST_LETTERS:,} characters"])
    lines = [(n, v) for n, v in lines if v.strip() and not v.lstrip().startswith("#")]
    if not lines:
        raise InputError(
            [f"{path} is empty; its head names columns, such as pressure_kPa,angle_deg"]
        )
    head, *rows = (_row(path, number, line) for number, line in lines)
    names, factors, problems = _columns([c.strip() for c in head])
    values = []
    for (number, _), row in zip(lines[1:], rows, strict=True):
        if len(row) != len(head):
            problems.append(f"line {number} has {len(row)} cells, the head {len(head)}")
            continue
        values.append(
            [
                _cell(cell, f"line {number}, {h}", problems)
                for cell, h in zip(row, head, strict=True)
            ]
        )
    if not problems:
        table = dict(
            zip(
                names,
                np.array(values).reshape(-1, len(names)).T * np.array(factors)[:, None],
                strict=True,
            )
        )
        problems = _missing(table)
    if problems:
        raise InputError([f"{path}: {p}" for p in problems])
    return table


def _row(path: Path, number: int, line: str) -> list[str]:
    """The cells of a line; quotes that leave it are refused."""
    try:
        [cells] = csv.reader([line], strict=True)
    except (csv.Error, ValueError) as error:
        raise InputError([f"{path}: line {number} is no row of cells: {error}"]) from error
    return cells


def _columns(head: list[str]) -> tuple[list[str], list[float], list[str]]:
    names, factors, problems = [], [], []
    for column in head:
        name, _, unit = column.rpartition("_")
        if name not in COLUMNS:
            known = [
                f"{n}_{u}"
                for n, (kind, _) in COLUMNS.items()
                for u, (k, _) in UNITS.items()
                if k == kind
            ]
            problems.append(f"column {column!r} is not valid; {nearest(column, known)}")
            continue
        kind = COLUMNS[name][0]
        units = [u for u, (k, _) in UNITS.items() if k == kind]
        if unit not in units:
            problems.append(f"column {column!r}: unit {unit!r} is not one of {', '.join(units)}")
            continue
        if name in names:
            problems.append(f"column {name!r} is given more than once")
        names.append(name)
        factors.append(UNITS[unit][1])
    return names, factors, problems


def _cell(text: str, where: str, problems: list[str]) -> float:
    if not text.strip():
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        problems.append(f"{where} = {text.strip()!r} must be a number")
    return value


def _missing(table: dict[str, np.ndarray]) -> list[str]:
    if "pressure" not in table:
        return ["no column of the pressure, such as pressure_kPa"]
    names = [n for n in MEASURED if n in table and np.isfinite(table[n]).any()]
    problems = []
    if not names:
        problems.append(f"no measured value; columns of them: {', '.join(MEASURED)}")
    if np.isnan(table["pressure"]).any():
        problems.append("a row has no pressure")
    elif (table["pressure"] < 0).any():
        problems.append("a pressure is below 0; gauge pressures are meant")
    if "deflection" in table:
        loads = table.get("load", np.full(len(table["pressure"]), np.nan))
        if np.isnan(loads[np.isfinite(table["deflection"])]).any():
            problems.append("a deflection has no load beside it, in a column such as load_N")
    return problems
