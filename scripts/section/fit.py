"""The constants of the section's law by least squares over the sections of a study.

All numbers are dimensionless, as in codesign_jax/scene/section_law.py.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from scipy import optimize

from codesign_jax.scene import section_law, section_numbers
from codesign_jax.scene.section_numbers import FITTED, Constants
from scripts.section import study
from scripts.section.study import SHEAR_MODULUS as G

QUANTITIES = ("moment", "bending", "volume", "tension", "twist", "sideways", "torque")
WANTED = np.array([0.02, 0.05, 0.04, 0.06, 0.2, 0.2, 0.2])
"""Errors of the quantities that count as one, relative to `States.scale`."""
PROPORTIONS = ((0.1, 0.4), (0.8, 1.7))
"""Walls and widths over the height within which all states count fully [chosen]."""
USUAL_PRESSURE = 0.69
"""Pressure over the modulus up to which they do [chosen]: 60 kPa at 88 kPa."""
OUTSIDE = 0.35
"""Weight of the errors beyond."""
STEP = 1e-3
"""Step of differences."""
RIDGE = 0.3
"""Weight of the fitted functions' coefficients but the first [chosen]."""


class States(NamedTuple):
    """States of sections, one a row."""

    name: np.ndarray  # of the section
    section: np.ndarray  # d, w, depth, angle, crossed, thread's and fabric's stiffness over G h
    strain: np.ndarray  # pressure, twist, bend, lateral
    value: np.ndarray  # of `QUANTITIES`
    scale: np.ndarray  # what their errors are relative to; infinite where one does not apply


def states(path: Path, highest: float) -> States:
    """The states under pressures up to the highest [Pa], and those sideways at rest."""
    names = []
    sections = []
    strains = []
    values = []
    scales = []
    for name, (section, column) in study.read(path).items():
        h = section.height
        count = len(column["pressure"])
        row = [
            section.wall / h,
            section.width / h,
            section.thread_depth,
            section.winding_angle,
            float(section.crossed),
            section.thread_stiffness / (G * h),
            section.fabric_stiffness / (G * h),
        ]
        d = row[0]
        w = row[1]
        pressure = column["pressure"] / G
        lateral = column["lateral"] * h
        bend = column["bend"] * h
        straight = np.abs(lateral) < 1e-6
        twisted = (np.abs(column["twist"]) > 1e-3) & straight & (bend > 0)
        value = [
            column["moment_bend"] / (G * h**3),
            column["bend_bend"] / (G * h**4),
            column["volume"] / h**2,
            column["tension"] / (G * h**2),
            column["twist_twist"] / (G * h**4),
            column["moment_lateral"] / (G * h**3),
            column["moment_twist"] / (G * h**3),
        ]
        # That of the pressure is the walls' moment less what is held from outside.
        walls = np.array([float(_walls(d, w, b)) for b in bend])
        torsion = 4 * ((w - d) * (1 - d)) ** 2 * d / (2 * (w + 1 - 2 * d))
        infinite = np.full(count, np.inf)
        scale = [
            np.where(straight, _size(walls, value[0], pressure, w), np.inf),
            np.where(straight & (pressure > 0), np.abs(value[1]), np.inf),
            np.where(straight, value[2], np.inf),
            np.where(straight & (pressure > 0), np.abs(value[3]) + 0.1 * pressure * w, np.inf),
            np.where(straight, np.maximum(torsion, np.abs(value[4])), np.inf),
            np.where(straight, infinite, np.abs(value[5])),
            # A single winding twists a free finger.
            np.where(twisted, np.abs(value[4] * column["twist"] * h), np.inf),
        ]
        usual = (pressure > 0) | (bend > 0)
        keep = usual & (pressure <= highest / G * 1.001) & (bend > -1e-9)
        names.append(np.full(keep.sum(), name))
        sections.append(np.tile(row, (keep.sum(), 1)))
        strains.append(np.stack([pressure, column["twist"] * h, bend, lateral], 1)[keep])
        values.append(np.stack(value, 1)[keep])
        scales.append(np.stack(scale, 1)[keep])
    parts = (names, sections, strains, values, scales)
    return States(*(np.concatenate(v) for v in parts))


def _size(walls: np.ndarray, held: np.ndarray, pressure: np.ndarray, width: float) -> np.ndarray:
    """Moment of the pressure, or of the walls where there is none."""
    return np.where(pressure > 0, np.abs(walls - held) + 0.02 * pressure * width, walls)


def _walls(d: float, w: float, bend: float) -> Any:
    return sum(
        b * bend * y**3 * (1 / 3 + (v + v * v) / 2)
        for b, y in ((w, 1.0), (2 * d - w, 1 - d), (w - 2 * d, d))
        for v in [1 / (1 + max(bend, 0.0) * y)]
    )


def predicted(fitted: Constants, data: States) -> np.ndarray:
    """`QUANTITIES` by the law, shape (state, quantity); slopes are central differences."""
    d, w, depth, angle, crossed, thread, fabric = data.section.T
    n = section_numbers.numbers(
        np.ones_like(d),
        d,
        w,
        shear_modulus=1.0,
        thread_depth=depth,
        winding_angle=angle,
        crossed=crossed,
        thread_stiffness=thread,
        fabric_stiffness=fabric,
        fitted=fitted,
    )
    pressure, twist, bend, lateral = data.strain.T

    def energy(p: Any = 0.0, t: Any = 0.0, x: Any = 0.0, y: Any = 0.0) -> np.ndarray:
        at = pressure + p, twist + t, bend + x, lateral + y
        return section_law.energy(n, *at, fitted)

    middle = energy()
    after = energy(x=STEP)
    before = energy(x=-STEP)
    volume = (energy(p=-STEP) - energy(p=STEP)) / (2 * STEP)
    torsion = section_law.response(n, pressure, 0.0, bend, lateral, fitted).torsion
    sideways = (energy(y=STEP) - energy(y=-STEP)) / (2 * STEP)
    return np.stack(
        [
            (after - before) / (2 * STEP),
            (after - 2 * middle + before) / STEP**2,
            volume,
            section_law.fabric_tension(n, pressure, bend),
            torsion,
            sideways,
            (energy(t=STEP) - energy(t=-STEP)) / (2 * STEP),
        ],
        1,
    )


def errors(fitted: Constants, data: States) -> np.ndarray:
    """Errors relative to the scales, shape (state, quantity)."""
    return (predicted(fitted, data) - data.value) / data.scale


def weights(data: States) -> np.ndarray:
    """Weight of each state."""
    inside = np.ones(len(data.name), bool)
    for column, (low, high) in enumerate(PROPORTIONS):
        inside &= (data.section[:, column] >= low) & (data.section[:, column] <= high)
    low = data.strain[:, 0] <= USUAL_PRESSURE
    return np.where(inside & low, 1.0, OUTSIDE)


def fit(start: Constants, data: States, rounds: int, every: int = 1) -> Constants:
    """The constants for the sections that are not held out, by every N-th of their states."""
    use = ~np.array([study.held_out(n) for n in data.name])
    data = States(*(v[use][::every] for v in data))
    weight = weights(data)[:, None] / WANTED
    shapes = [np.shape(v) for v in start]
    ends = np.cumsum([int(np.prod(v)) for v in shapes])

    def constants(vector: np.ndarray) -> Constants:
        parts = np.split(vector, ends[:-1])
        return Constants(*(v.reshape(s) for v, s in zip(parts, shapes, strict=True)))

    def residuals(vector: np.ndarray) -> np.ndarray:
        fitted = constants(vector)
        values = weight * errors(fitted, data)
        # Errors of more than six times what is wanted count linearly.
        values = np.sign(values) * np.minimum(np.abs(values), np.sqrt(6 * np.abs(values)))
        return np.concatenate([values.ravel(), RIDGE * fitted.functions[:, 1:].ravel()])

    vector = np.concatenate([np.ravel(v) for v in start])
    solution = optimize.least_squares(residuals, vector, x_scale="jac", max_nfev=rounds, verbose=2)
    print(f"cost {solution.cost:.1f} after {solution.nfev} rounds", flush=True)
    return constants(solution.x)


def write(path: Path, fitted: Constants) -> None:
    """Writes section_numbers.toml."""
    table: dict[str, Any] = {}
    for name, value in zip(Constants._fields[1:], fitted[1:], strict=True):
        number = np.round(np.asarray(value, float), 4).tolist()
        table[name] = number
    rows = np.round(np.asarray(fitted.functions, float), 4).tolist()
    table["functions"] = dict(zip(FITTED, rows, strict=True))
    head = (
        "# Dimensionless constants of a section's law [fitted]: python -m scripts.section --fit\n"
    )
    path.write_text(head + tomli_w.dumps(table), encoding="utf-8")


def report(fitted: Constants, data: States) -> list[list[str]]:
    """Root mean squares of the errors by family, of fitted and of held-out sections."""
    relative = errors(fitted, data)
    held = np.array([study.held_out(n) for n in data.name])
    family = np.array([n[:-2] for n in data.name])
    rows = [["sections", "", *QUANTITIES]]
    low = data.strain[:, 0] <= USUAL_PRESSURE
    for name in dict.fromkeys(family):
        for kind, chosen in (("fitted", ~held), ("held out", held)):
            mask = (family == name) & chosen & low
            if mask.any():
                rows.append([name, kind, *_percent(relative[mask], data.scale[mask])])
    inside = weights(data) == 1
    for kind, chosen in (("fitted", ~held), ("held out", held)):
        mask = chosen & inside
        rows.append(["all usual", kind, *_percent(relative[mask], data.scale[mask])])
    for kind, chosen in (("fitted", ~held), ("held out", held)):
        mask = chosen & ~low
        rows.append(["75, 100 kPa", kind, *_percent(relative[mask], data.scale[mask])])
    return rows


def _percent(relative: np.ndarray, scale: np.ndarray) -> list[str]:
    columns = zip(relative.T, np.isfinite(scale).T, strict=True)
    return [f"{100 * np.sqrt(np.mean(v[m] ** 2)):.1f}" if m.any() else "–" for v, m in columns]
