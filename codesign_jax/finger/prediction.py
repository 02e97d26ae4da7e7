"""What a finger does where something was measured."""

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from codesign_jax.finger import swing
from codesign_jax.finger.rest import Finger, NoRest, Rest, sideways, tip_place
from codesign_jax.measurements import MEASURED

FREE = ("angle", "tip_x", "tip_y", "deflection", "sideways")
"""Columns that are told of the free finger."""
BENDING = ("angle", "tip_y", "tip_force", "blocked_force")
"""Columns that are 0 without pressure and grow with it."""
_SHIFT = 0.25
"""Share of the largest pressure by which a column may begin later than the model's [chosen]."""
_DEVIATIONS = 3.0
"""Standard errors of both starts that are granted beside it [chosen]."""
HELD_TIP = 0.25
"""Share of a period by which the first picture of a release may be off."""

Table = Mapping[str, np.ndarray]
"""Columns of `measurements.COLUMNS` [SI units], shape (row,); NaN where a row has none."""


def predict(finger: Finger, table: Table) -> dict[str, np.ndarray]:
    """What a finger does where something was measured.

    Returns:
      Columns of `MEASURED` that the table has, shape (row,); NaN where the row has none, or the
      finger no rest.  Drops are those of the time at which each release fits best: a film does not
      say when the finger was let go.
    """
    rows = len(table["pressure"])
    predicted = {name: np.full(rows, np.nan) for name in MEASURED if name in table}
    free = blocked = Rest(np.zeros(finger.links), 0.0, 0.0)
    for row in np.argsort(table["pressure"], kind="stable"):  # each begins where the last one ended
        pressure = float(table["pressure"][row])
        names = {n for n in predicted if np.isfinite(table[n][row])}
        if "blocked_force" in names:
            predicted["blocked_force"][row] = _blocked(finger, pressure)
        if "tip_force" in names:
            with contextlib.suppress(NoRest):
                blocked = Rest.of(finger, pressure, held=True, start=blocked)
                predicted["tip_force"][row] = blocked.force
        if names.intersection(FREE):
            with contextlib.suppress(NoRest):
                free = Rest.of(finger, pressure, start=free)
                load = float(table["load"][row]) if "load" in table else np.nan
                for name, value in _of_free(finger, free, pressure, load, names).items():
                    predicted[name][row] = value
    if "drop" in predicted:
        predicted["drop"] = _drops(finger, table)
    return predicted


def _blocked(finger: Finger, pressure: float) -> float:
    """Force with which the straight finger's tip presses, of the moment at its base [N]."""
    return -float(finger.held(pressure, np.zeros(finger.links))[0]) / finger.length


def _of_free(
    finger: Finger, free: Rest, pressure: float, load: float, names: set[str]
) -> dict[str, float]:
    """Those values of `FREE` that are asked for."""
    values: dict[str, float] = {}
    if "angle" in names:
        values["angle"] = free.angles.sum()
    if names & {"tip_x", "tip_y"}:
        coordinates = dict(zip(("tip_x", "tip_y"), tip_place(finger, free), strict=True))
        values |= {name: value for name, value in coordinates.items() if name in names}
    if "sideways" in names:
        values["sideways"] = sideways(finger, free, pressure, load)
    if "deflection" in names:
        values["deflection"] = free.height - Rest.of(finger, pressure, load, start=free).height
    return values


def releases(table: Table) -> list[np.ndarray]:
    """Rows of each release: times rise, and weight and pressure are the same."""
    rows = np.flatnonzero(np.isfinite(table["drop"]))
    loads = np.nan_to_num(table.get("load", np.zeros_like(table["pressure"])))
    state = np.stack([loads, table["pressure"]], 1)[rows]
    new = (np.diff(table["time"][rows]) <= 0) | (np.diff(state, axis=0) != 0).any(1)
    return np.split(rows, np.flatnonzero(new) + 1)


def _drops(finger: Finger, table: Table) -> np.ndarray:
    drops = np.full(len(table["drop"]), np.nan)
    loads = np.nan_to_num(table.get("load", np.zeros_like(table["pressure"])))
    every = releases(table)
    periods = [swing.first_period(finger, float(loads[rows[0]])) for rows in every]
    margin = HELD_TIP * max(periods)
    # One number of time steps for all of them is one program.
    spans = [np.ptp(table["time"][rows]) for rows in every]
    until = max(spans) + 2 * margin
    curves: dict[tuple[float, float], tuple[np.ndarray, np.ndarray]] = {}
    for rows in every:
        state = float(loads[rows[0]]), float(table["pressure"][rows[0]])
        if state not in curves:
            curves[state] = swing.released(finger, *state, until, min(periods) / swing.STEPS)
        time = table["time"][rows] - table["time"][rows[0]]
        drops[rows] = _aligned(curves[state], time, table["drop"][rows], margin)
    return drops


def _aligned(
    curve: tuple[np.ndarray, np.ndarray], time: np.ndarray, drop: np.ndarray, margin: float
) -> np.ndarray:
    """The curve at the times, moved by at most the margin to where it fits the drops best."""
    step = curve[0][1]
    shifts = np.arange(-margin, margin, max(step, margin / 50))
    every = np.interp(time + shifts[:, None], *curve, left=0.0)
    best = int(((every - drop) ** 2).sum(1).argmin())
    low = shifts[max(best - 1, 0)]
    high = shifts[min(best + 1, len(shifts) - 1)]
    for _ in range(3):  # Gauss-Newton for the shift; the grid has found its valley
        middle = (low + high) / 2
        value, after = (np.interp(time + s, *curve, left=0.0) for s in (middle, middle + step))
        slope = (after - value) / step
        size = (slope**2).sum()
        move = (slope * (drop - value)).sum() / size if size else 0.0
        low = high = float(np.clip(middle + move, -margin, margin))
    return np.interp(time + low, *curve, left=0.0)


def without_rest(table: Table, predicted: Table) -> dict[str, np.ndarray]:
    """Pressures [Pa] at which a finger has no rest, in rising order, by the column that lacks it.

    Args:
      predicted: What `predict` makes of the table.
    """
    lacking = {n: np.isfinite(table[n]) & np.isnan(v) for n, v in predicted.items()}
    return {n: np.unique(table["pressure"][rows]) for n, rows in lacking.items() if rows.any()}


def shifted(table: Table, predicted: Table) -> dict[str, float]:
    """Pressures [Pa] at which columns begin, by their name, where the model's begin far below.

    Of absolute pressures, or of a sensor with an offset, a line through the measured values begins
    at the atmosphere's pressure or the offset.  At least three different rows of a column tell.
    """
    load = np.nan_to_num(table.get("load", np.zeros_like(table["pressure"])))
    starts = {}
    for name in {*BENDING} & {*predicted}:
        rows = np.isfinite(table[name]) & np.isfinite(predicted[name]) & (load == 0)
        pressure = table["pressure"][rows]
        if len({*table[name][rows]}) < 3 or len({*predicted[name][rows]}) < 3:
            continue
        measured: Any = stats.linregress(table[name][rows], pressure)
        model: Any = stats.linregress(predicted[name][rows], pressure)
        doubt = _DEVIATIONS * np.hypot(measured.intercept_stderr, model.intercept_stderr)
        if measured.intercept - model.intercept > _SHIFT * pressure.max() + doubt:
            starts[name] = float(measured.intercept)
    return starts


def opposed(table: Table, predicted: Table) -> list[str]:
    """Columns that were measured with the other sign than that of `predict`, most of their rows."""
    return [n for n, v in predicted.items() if np.nansum(v * table[n]) < 0]
