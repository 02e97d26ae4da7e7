"""The constants of a finger that measurements tell, and how sure they are.

The most likely constants, in their logarithms, are those of least squares over measured values and
priors.  Their posterior is Laplace's: the Gaussian whose precision is the Gauss-Newton matrix of
those squares.  The noise of a column is estimated from its own residuals, and is taken as larger by
as much as Student's 90 % interval is wider than the Gaussian's.  Residuals of one release follow
one another closely; by their correlation r between neighbours n of them count as
n (1 - r) / (1 + r), as those of a first-order process do.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import optimize

from codesign_jax.finger.prediction import (
    BENDING,
    Table,
    opposed,
    predict,
    releases,
    shifted,
    without_rest,
)
from codesign_jax.finger.rest import TOO_FAR, Finger, NoRest
from codesign_jax.measurements import BY_PRESSURE, MEASURED
from codesign_jax.scene import draws
from codesign_jax.scene.schema import InputError, Problem

TOLD_BY = {
    "shear_modulus": ("angle", "tip_x", "tip_y", "deflection", "sideways", "drop"),
    "moment_factor": BY_PRESSURE,
    "lateral_factor": ("sideways",),
    "torsion_factor": ("sideways",),
    "damping_time": ("drop",),
}
"""Columns that tell of a constant; the angle of a free tip depends on modulus and moment by their
ratio alone, forces on a held tip (nearly) on the moment, deflections on the modulus."""
OF_CHAMBERS = ("moment_factor", "lateral_factor", "torsion_factor")
"""Constants of the law "chamber" alone."""
HAND = "hand.material."
"""Where the keys of a finger's constants begin."""
ROUNDS = 3
"""Gauss-Newton steps, each with the noise that the last one left."""
STEP = 1e-4
"""Step of logarithms in differences."""
_FAR = 1.0
"""Largest step of a logarithm: least squares begin so near that a larger one tells of no valley."""
_OFFSET = 0.25
"""Share of a column's largest value that noise does not reach at rest [chosen]."""
_EXACT = 1e-7
"""Least noise relative to a column's size."""
_FEW = 1.0
"""Degrees of freedom below which a column's noise is joined with that of the other columns.

Of one degree Student's interval is 3.8 times as wide as the Gaussian's, so that it holds also where
relative noises differ by a factor of two or three.  More degrees of other columns would make the
interval of a noisier one too narrow.
"""
_HALF = 1.6448536
"""Half of the Gaussian's 90 % interval."""


class Posterior(NamedTuple):
    """What measurements say of a finger's constants; K of them."""

    names: tuple[str, ...]  # fields of `Constants`
    mean: np.ndarray  # logarithms of the most likely ones [SI], shape (K,)
    covariance: np.ndarray  # of the logarithms, shape (K, K); NaN without enough values
    noise: dict[str, float]  # noise of a value of each column [SI]
    share: dict[str, float]  # share of a column's values that count
    identified: dict[str, bool]  # whether the values narrow a constant to two thirds of its prior

    @property
    def value(self) -> dict[str, float]:
        """The most likely constants [SI]."""
        return dict(zip(self.names, np.exp(self.mean).tolist(), strict=True))

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations of the logarithms, by constant."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def ratio_sd(self) -> float:
        """Standard deviation of the logarithm of modulus over moment, on which angles depend."""
        way = np.array(
            [{"shear_modulus": 1.0, "moment_factor": -1.0}.get(n, 0) for n in self.names]
        )
        return math.sqrt(way @ self.covariance @ way)

    @property
    def interval(self) -> dict[str, tuple[float, float]]:
        """Interval in which a constant is with a probability of 90 % [SI], by constant."""
        half = _HALF * np.sqrt(np.diag(self.covariance))
        ends = np.exp([self.mean - half, self.mean + half])
        return {n: (float(a), float(b)) for n, a, b in zip(self.names, *ends, strict=True)}


@functools.cache
def priors() -> dict[str, float]:
    """Standard deviations of the logarithms about the hand's own before anything is measured.

    They are those of a hand that was not measured, but that nothing is assumed of the modulus.
    """
    table = draws.read("unmeasured").constant
    spreads = {e.key.removeprefix(HAND): e.spread for e in table if e.key.startswith(HAND)}
    return spreads | {"shear_modulus": math.inf}


def fit(finger: Finger, table: Table) -> Posterior:
    """Fits the constants that a table tells of, about those of the finger.

    Raises:
      ValueError: If the measurement does not give them, its signs are not the model's, or the
        finger has no rest where something was measured.
    """
    refuse_values(finger, table, _measured(table))
    table = telling(table)
    columns = _measured(table)
    problem = _Problem(finger, table, columns)
    logs = problem.solved(problem.start())
    scales = np.full(len(columns), 0.02)
    for _ in range(ROUNDS):
        step, scales = problem.improved(logs, scales)
        if np.abs(step).max() > _FAR:
            raise ValueError("the measured values hardly depend on what is fitted to them")
        logs = logs + step
    covariance = problem.covariance
    narrowed = np.sqrt(np.diag(covariance)) < [priors()[n] / 1.5 for n in problem.names]
    if len(problem.column) - problem.effective_constants < 0.5:
        covariance = np.full_like(covariance, math.nan)
    mean = logs + np.log([getattr(finger.constants, n) for n in problem.names])
    return Posterior(
        problem.names,
        mean,
        covariance,
        dict(zip(columns, (scales * problem.sizes).tolist(), strict=True)),
        dict(zip(columns, problem.share.tolist(), strict=True)),
        dict(zip(problem.names, narrowed.tolist(), strict=True)),
    )


class _Problem:
    """Least squares over the logarithms of factors on a finger's constants."""

    def __init__(self, finger: Finger, table: Table, columns: list[str]):
        self.finger = finger
        self.table = table
        self.columns = columns
        told = {n for n, by in TOLD_BY.items() if set(by) & set(columns)}
        if table["pressure"].any():  # a bent finger gives way otherwise than a straight one
            told.add("moment_factor")
        if finger.law is not None:  # its moments depend on the modulus, and have no factors
            told = (told - {*OF_CHAMBERS}) | {"shear_modulus"}
        self.names = tuple(n for n in TOLD_BY if n in told)
        self.sizes = np.array([math.sqrt(np.nanmean(table[n] ** 2)) for n in columns])
        self.rows = [np.isfinite(table[n]) for n in columns]
        self.column = np.repeat(np.arange(len(columns)), [r.sum() for r in self.rows])
        self.precision = np.array([priors()[n] ** -2 for n in self.names])
        self.share = np.ones(len(columns))  # of the values of a column that count
        self.effective_constants = 0.0  # number of constants that the values themselves tell
        self.covariance = np.zeros((0, 0))

    def material(self, logs: np.ndarray) -> Finger:
        return scaled(self.finger, self.names, logs)

    def start(self) -> np.ndarray:
        """Factors to begin with: a release swings about the drop that the modulus gives."""
        logs = np.zeros(len(self.names))
        if "drop" in self.columns and "shear_modulus" in self.names:
            for _ in range(2):
                model = predict(self.material(logs), self.table)["drop"]
                ratio = np.nanmean(model) / np.nanmean(self.table["drop"])
                logs[self.names.index("shear_modulus")] += math.log(ratio)
        return logs

    def errors(self, logs: np.ndarray) -> np.ndarray:
        """Errors of the values relative to their column's size."""
        model = predict(self.material(logs), self.table)
        if lacking := without_rest(self.table, model):
            lowest = min(v.min() for v in lacking.values())
            modulus = self.material(logs).constants.shear_modulus / 1e3
            words = f"a finger of G = {modulus:.4g} kPa has no rest at {lowest / 1e3:g} kPa"
            raise NoRest(f"{words}: {TOO_FAR}")
        parts = zip(self.columns, self.rows, self.sizes, strict=True)
        return np.concatenate([(model[n] - self.table[n])[r] / size for n, r, size in parts])

    def solved(self, logs: np.ndarray) -> np.ndarray:
        """The most likely factors if all columns err alike."""
        prior = 0.02 * np.sqrt(self.precision)

        def residual(x: np.ndarray) -> np.ndarray:
            return np.append(self.errors(x), prior * x)

        # Close enough for the steps that follow.
        solution = optimize.least_squares(residual, logs, x_scale=0.3, diff_step=STEP, ftol=1e-4)
        if np.linalg.matrix_rank(solution.jac) < len(logs):
            raise ValueError("the measured values do not depend on what is fitted to them")
        return solution.x

    def improved(self, logs: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A Gauss-Newton step under the noise of each column, and the noise that is left."""
        errors = self.errors(logs)
        slopes = slopes_of(self.errors, logs, errors)
        if "drop" in self.columns:
            column = self.columns.index("drop")
            self.share[column] = self._of_drops(errors[self.column == column])
        share = self.share[self.column]
        prior = np.diag(self.precision)
        weight = share / scales[self.column] ** 2
        precision = gram(slopes, weight) + prior
        step = -np.linalg.solve(precision, slopes.T @ (weight * errors) + prior @ logs)
        residuals = errors + slopes @ step
        # Constants that each column tells: the trace of its part of the hat matrix.
        hat = weight * (slopes * np.linalg.solve(precision, slopes.T).T).sum(1)
        leverage = np.bincount(self.column, hat)
        self.effective_constants = float(leverage.sum())
        new, wider = _noise(self.column, share, residuals, leverage)
        weight = share / (new * wider)[self.column] ** 2
        self.covariance = np.linalg.inv(gram(slopes, weight) + prior)
        return step, new

    def _of_drops(self, errors: np.ndarray) -> float:
        """Share of the drops that count, by the correlation of each with the next one."""
        indices = np.flatnonzero(self.rows[self.columns.index("drop")])
        value = dict(zip(indices, errors, strict=True))
        every = [np.array([value[r] for r in rows]) for rows in releases(self.table)]
        above = sum(float(v[1:] @ v[:-1]) for v in every)
        squares = sum(float(v @ v) for v in every)
        near = min(max(above / squares, 0.0), 0.99) if squares else 0.0
        return (1 - near) / (1 + near)


def scaled(finger: Finger, names: tuple[str, ...], logs: np.ndarray) -> Finger:
    """The finger with exp(logs) times the constants of these names."""
    factors = dict(zip(names, np.exp(logs), strict=True))
    return finger.of_material(
        **{n: float(f) * getattr(finger.constants, n) for n, f in factors.items()}
    )


def slopes_of(
    function: Callable[[np.ndarray], np.ndarray], logs: np.ndarray, base: np.ndarray
) -> np.ndarray:
    """Differences of a function of logarithms from its value at them, shape (value, K)."""
    values = [function(logs + STEP * unit) for unit in np.eye(len(logs))]
    return (np.stack(values, -1) - base[:, None]) / STEP


def gram(slopes: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Sum over values of weight times slope times slope, shape (K, K)."""
    return slopes.T @ (weight[:, None] * slopes)


def _noise(
    column: np.ndarray, share: np.ndarray, residuals: np.ndarray, leverage: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Noise of each column, and by how much Student's interval is wider than the Gaussian's.

    A column with few degrees of freedom joins those of the other columns.
    """
    from scipy import stats

    degrees = np.maximum(np.bincount(column, share) - leverage, 0.0)
    squares = np.bincount(column, share * residuals**2)
    if degrees.sum() < 0.5:  # as many constants as values: nothing tells the noise
        return np.full_like(degrees, _EXACT), np.ones_like(degrees)
    others = degrees.sum() - degrees
    theirs = (squares.sum() - squares) / np.maximum(others, 1e-9)
    joined = np.minimum(np.maximum(_FEW - degrees, 0.0), others)
    variance = (squares + joined * theirs) / (degrees + joined)
    wider = stats.t.ppf(0.95, np.maximum(degrees + joined, 0.5)) / _HALF
    return np.sqrt(np.maximum(variance, _EXACT**2)), wider


def refuse_values(finger: Finger, table: Table, columns: list[str]) -> None:
    """Refuses columns that no material explains: zeros, offsets, and the other sign."""
    for name in columns:
        if not np.nan_to_num(table[name]).any():
            raise InputError.of("missing", f"{name}: every measured value is 0: nothing to fit")
    if not table["pressure"].any() and set(columns) <= set(BY_PRESSURE):
        raise InputError.of("missing", "pressure: every one is 0: there is nothing to fit")
    load = np.nan_to_num(table.get("load", np.zeros(1)))
    if not load.any() and set(columns) <= {"deflection", "sideways"}:
        raise InputError.of("missing", "load: every one is 0: there is nothing to fit")
    for name in set(columns) & {*BENDING}:
        at_rest = np.abs(table[name][table["pressure"] == 0])
        if (at_rest > _OFFSET * np.nanmax(np.abs(table[name]))).any():
            raise InputError.of(
                "range", f"{name}: it is not 0 at zero pressure: subtract its value there"
            )
    predicted = predict(finger, table)
    for name, start in shifted(table, predicted).items():
        raise InputError.of("range", f"{name}: {shift_in_words(name, start)}")
    if wrong := opposed(table, predicted):
        remedy = (
            "bending under pressure, and what resists it, count as positive; change the signs in "
            "the file"
        )
        raise InputError(
            [
                Problem("conflict", f"{name}: the sign is not the model's: {remedy}")
                for name in wrong
            ]
        )


def _measured(table: Table) -> list[str]:
    """Columns that have a measured value."""
    return [n for n in MEASURED if n in table and np.isfinite(table[n]).any()]


def telling(table: Table) -> dict[str, np.ndarray]:
    """The table without values that tell nothing, which would make the noise too small.

    They are those of a finger at rest, which are zero for any constants, and those that are
    repeated to the last digit, as by an export.  Drops of a release are all kept.
    """
    blank = np.zeros_like(table["pressure"])
    load = np.nan_to_num(table.get("load", blank))
    kept = dict(table)
    for name in [n for n in _measured(table) if n != "drop"]:
        moved = table["pressure"] if name in BY_PRESSURE else load
        rows = np.flatnonzero(np.isfinite(table[name]) & (moved != 0))
        values = np.stack([table["pressure"], load, table[name]], 1)[rows]
        first = rows[np.unique(values, axis=0, return_index=True)[1]]
        kept[name] = np.full_like(blank, math.nan)
        kept[name][first] = table[name][first]
    return kept


def shift_in_words(name: str, start: float) -> str:
    """What is to be done about a column that begins at a pressure [Pa]; see `shifted`."""
    return (
        f"the measured {words(name)} begins at {start / 1e3:.4g} kPa by a line through it: gauge "
        "pressures are meant; subtract the atmosphere's from absolute ones, or the sensor's offset"
    )


def words(name: str) -> str:
    """A column's name in words."""
    return name.replace("_", " ")
