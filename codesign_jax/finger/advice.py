"""Which further measurement would narrow the constants of a finger most.

A candidate is simulated at the most likely constants.  By its derivatives there, and the noise of
its column, the posterior's precision grows as a Gaussian's does; what is told is by how much the
sum of the variances of all logarithms falls.
"""

from typing import NamedTuple

import numpy as np

from codesign_jax.finger import swing
from codesign_jax.finger.posterior import OF_CHAMBERS, Posterior, gram, priors, scaled, slopes_of
from codesign_jax.finger.prediction import Table, predict
from codesign_jax.finger.rest import Constants, Finger, NoRest

USUAL = 0.03
"""Noise of a column that was not measured, of its size [chosen]."""
ROWS = 5
"""Values of a candidate."""
PICTURES = 40
"""Pictures of a release over its first periods."""
PERIODS = 5
CORRELATED = 0.25
"""Share of them that counts, where no release was measured [chosen]."""
UNKNOWN_MODULUS = 0.5
"""Standard deviation of a modulus of which nothing is known."""


class Advice(NamedTuple):
    """A further measurement."""

    words: str  # what to measure
    less: float  # share by which the sum of the variances falls
    sd: dict[str, float]  # standard deviations of the logarithms after it, by constant


def advice(finger: Finger, posterior: Posterior, table: Table) -> list[Advice]:
    """Further measurements, the best one first.

    Args:
      finger: The finger that was fitted.
      table: What was measured of it.

    Raises:
      ValueError: If the posterior has no variance.
    """
    if np.isnan(posterior.covariance).any():
        raise ValueError("the posterior has no variance: more values first")
    likely = scaled(finger, posterior.names, posterior.mean - _own(finger, posterior.names))
    names = tuple(n for n in Constants._fields if getattr(likely.constants, n) > 0)
    if finger.law is not None:
        names = tuple(n for n in names if n not in OF_CHAMBERS)
    before = _precision(posterior, names)
    start = np.trace(np.linalg.inv(before))
    suggestions = []
    for words, rows in candidates(likely, table).items():
        try:
            more = _more(likely, names, rows, posterior)
        except NoRest:
            continue
        after = np.linalg.inv(before + more)
        sd = dict(zip(names, np.sqrt(np.diag(after)).tolist(), strict=True))
        suggestions.append(Advice(words, float(1 - np.trace(after) / start), sd))
    return sorted(suggestions, key=lambda suggestion: -suggestion.less)


def _own(finger: Finger, names: tuple[str, ...]) -> np.ndarray:
    return np.log([getattr(finger.constants, n) for n in names])


def _precision(posterior: Posterior, names: tuple[str, ...]) -> np.ndarray:
    """The posterior's precision, and that of the priors of what it does not have."""
    precision = np.diag([min(priors()[n], UNKNOWN_MODULUS) ** -2 for n in names])
    indices = [names.index(n) for n in posterior.names]
    precision[np.ix_(indices, indices)] = np.linalg.inv(posterior.covariance)
    return precision


def _more(finger: Finger, names: tuple[str, ...], rows: Table, posterior: Posterior) -> np.ndarray:
    """The precision that a candidate adds."""
    [column] = [n for n in rows if np.isnan(rows[n]).all()]
    candidate = {**rows, column: np.zeros_like(rows["pressure"])}

    def values(logs: np.ndarray) -> np.ndarray:
        return _predicted(scaled(finger, names, logs), candidate, column)

    base = values(np.zeros(len(names)))
    if not np.isfinite(base).all():
        raise NoRest(column)
    slopes = slopes_of(values, np.zeros(len(names)), base)
    usual = USUAL * float(np.sqrt((base**2).mean()))
    noise = posterior.noise.get(column, usual)
    # A film's noise is known of all of its pictures, whose errors are alike.
    share = posterior.share.get(column, CORRELATED) if column == "drop" else 1.0
    return gram(slopes, np.full(len(base), share / max(noise, 0.1 * usual) ** 2))


def _predicted(finger: Finger, candidate: Table, column: str) -> np.ndarray:
    if column != "drop":
        return predict(finger, candidate)[column]
    until = candidate["time"][-1]
    step = until / (4 * swing.STEPS)
    load = float(candidate["load"][0])
    return np.interp(candidate["time"], *swing.released(finger, load, 0.0, until, step))


def candidates(finger: Finger, table: Table) -> dict[str, dict[str, np.ndarray]]:
    """Measurements in words, as tables whose column of NaN is measured."""
    stiffness = float(np.mean(finger.stiffness)) * finger.segment
    gain = float(np.mean(finger.gain))
    weight = 0.3 * stiffness / finger.length**2
    tables: dict[str, dict[str, np.ndarray]] = {}

    def add(words: str, column: str, **columns: float | np.ndarray) -> None:
        rows = np.size(columns.get("time", np.zeros(ROWS)))
        whole = {"pressure": 0.0, **columns, column: np.nan}
        tables[words] = {n: np.broadcast_to(np.asarray(v, float), rows) for n, v in whole.items()}

    grams = f"{1e3 * weight / swing.GRAVITY:.2g} g"
    if gain > 0:
        top = float(table["pressure"].max()) or stiffness / gain / finger.length
        steps = np.linspace(top / ROWS, top, ROWS)
        upto = f"at {ROWS} pressures up to {top / 1e3:.3g} kPa"
        add(f"the angle {upto}", "angle", pressure=steps)
        add(f"the tip force {upto}", "tip_force", pressure=steps)
        words = f"the sideways displacement of the tip by {grams} at {top / 1e3:.3g} kPa"
        add(f"{words}, {ROWS} times", "sideways", pressure=top, load=weight)
    add(f"the deflection by {grams}, empty, {ROWS} times", "deflection", load=weight)
    words = f"the sideways displacement of the tip by {grams}, empty"
    add(f"{words}, {ROWS} times", "sideways", load=weight)
    period = swing.first_period(finger, 0.0)
    times = np.linspace(0, PERIODS * period, PICTURES + 1)[1:]
    add("a release without a weight, filmed", "drop", time=times, load=0.0)
    return tables
