"""`codesign finger`."""

import math
from collections.abc import Iterator
from itertools import chain

import numpy as np
from rich import box
from rich.table import Table

from codesign_jax import files
from codesign_jax import finger as fingers
from codesign_jax.commands import common
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Finger as Options
from codesign_jax.finger import Finger, Posterior
from codesign_jax.finger.posterior import shift_in_words, words
from codesign_jax.measurements import MEASURED
from codesign_jax.runs import tables
from codesign_jax.scene import draws, schema
from codesign_jax.scene.hand import Material
from codesign_jax.scene.schema import InputError
from codesign_jax.scene.silicones import LAWS
from codesign_jax.terminal import Console

SHOWN = {
    "pressure": ("kPa", 1e3),
    "angle": ("deg", math.pi / 180),
    "tip_force": ("N", 1.0),
    "blocked_force": ("N", 1.0),
    "load": ("N", 1.0),
    "deflection": ("mm", 1e-3),
    "sideways": ("mm", 1e-3),
    "tip_x": ("mm", 1e-3),
    "tip_y": ("mm", 1e-3),
    "time": ("s", 1.0),
    "drop": ("mm", 1e-3),
}
"""Units of what is printed, and how many SI units they are."""

MOST_ROWS = 40
"""Rows that are printed; a film has hundreds."""
CONSTANTS = {
    "shear_modulus": ("G", "kPa", 1e3),
    "moment_factor": ("moment over the section's", "", 1.0),
    "lateral_factor": ("stiffness sideways over theory's", "", 1.0),
    "torsion_factor": ("stiffness of twist over theory's", "", 1.0),
    "damping_time": ("damping time", "ms", 1e-3),
}
"""Names of a finger's constants, the unit in which they are printed, and its size."""
SHOWN_ADVICE = 3
"""Further measurements that are named."""
POINTS = 11
"""Pressures of a curve without measurements."""


def main(options: Options) -> int:
    case = find_case(options)
    params = case.space.params(np.asarray(case.design))
    problems = common.number_problems(("--finger", options.finger, 0, case.scene.num_fingers - 1))
    if options.fit and options.measured is None:
        problems.append(
            schema.Problem(
                "syntax", "--fit needs measurements: give a file, codesign finger FILE.csv --fit"
            )
        )
    if options.posterior and not options.fit:
        problems.append(schema.Problem("missing", "--posterior is that of a fit: add --fit"))
    problems += common.place_problems("--posterior", options.posterior, ".toml")
    common.refuse(problems + common.place_problems("--out", options.out, ".csv"))
    measured = options.measured and fingers.read(options.measured)
    mine = fingers.of_design(case.scene, params, options.finger)
    console = Console()
    console.print(_about(mine, options.finger, case.scene.hand.name))
    if not options.run_folder:
        pairs = [*chain.from_iterable(options.design)]
        if note := common.by_default(case.space, pairs):
            console.print(note)
    table = measured
    if table is None:
        top = float(np.asarray(params.pressure)[options.finger])
        table = {"pressure": np.linspace(0.0, top, POINTS)}
        table |= {n: np.zeros(POINTS) for n in ("angle", "tip_force", "blocked_force")}
    try:
        compare(mine, table, options, console)
        if odds := fingers.odds(case.scene, params, options.finger, table) if measured else {}:
            shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in odds.items())
            console.print(f"odds by the angles: {shares}")
    except InputError:
        raise
    except ValueError as error:
        raise InputError.of("unsupported", str(error)) from error
    return 0


def _about(mine: Finger, number: int, hand: str) -> str:
    law = "neo-Hookean" if mine.neo_hookean else "linear"
    ends = [
        "section {2:.4g} x {0:.4g} mm, walls {1:.4g} mm".format(*(1e3 * v[k] for v in mine.section))
        for k in (0, -1)
    ]
    size = f"{1e3 * mine.length:.4g} mm long, {' to '.join(dict.fromkeys(ends))}"
    return (
        f"finger {number} of {hand}: {size}; bending law {law}, G = "
        f"{1e-3 * mine.constants.shear_modulus:.4g} kPa, {mine.links} links"
    )


def compare(mine: Finger, table: dict[str, np.ndarray], options: Options, console: Console) -> None:
    """Prints and writes what was measured, predicted and fitted."""
    models = {"model": mine}
    fit: Posterior | None = None
    if options.fit:
        fit = fingers.fit(mine, table)
        models["fitted"] = mine.of_material(**fit.value)
    predictions = {label: fingers.predict(model, table) for label, model in models.items()}
    columns = _columns(table, predictions, measured=options.measured is not None)
    shown = Table(box=box.SIMPLE)
    for name in columns:
        shown.add_column(name.replace("_", " "), justify="right")
    for row in [*zip(*columns.values(), strict=True)][:MOST_ROWS]:
        shown.add_row(*("" if math.isnan(v) else f"{v:.4g}" for v in row))
    common.print_table(console, shown)
    if (rows := len(table["pressure"])) > MOST_ROWS:
        console.print(f"{rows - MOST_ROWS} more rows: --out writes all of them")
    for line in chain.from_iterable(_without_rest(table, *item) for item in predictions.items()):
        console.print(line)
    if options.measured:
        for label, values in predictions.items():
            console.print(f"{label}: {_errors(table, values)}")
        for name in fingers.opposed(table, predictions["model"]):
            console.print(f"warning: measured and predicted {words(name)} differ in sign")
        for name, start in fingers.shifted(table, predictions["model"]).items():
            console.print(f"warning: {shift_in_words(name, start)}")
    if fit:
        for line in [*_of_fit(fit, mine), *_next(mine, fit, table)]:
            console.print(line)
        if options.posterior:
            _write(fit, mine, options)
            console.print(f"posterior: {options.posterior}")
    if options.out:
        texts = {n: ["" if math.isnan(v) else f"{v:.9g}" for v in c] for n, c in columns.items()}
        rows = (dict(zip(texts, row, strict=True)) for row in zip(*texts.values(), strict=True))
        files.make_folder_of(options.out)
        tables.write(options.out, [*texts], rows)
        console.print(f"table: {options.out}")


def _without_rest(
    table: dict[str, np.ndarray], label: str, prediction: dict[str, np.ndarray]
) -> Iterator[str]:
    """Says where a finger has no rest, after what it has."""
    for name, pressures in fingers.without_rest(table, prediction).items():
        text = ", ".join(f"{pressure / 1e3:.4g}" for pressure in pressures)
        yield (
            f"warning: {label}: no rest found for the {words(name)} at {text} kPa: "
            f"{fingers.TOO_FAR}"
        )


def _columns(
    table: dict[str, np.ndarray], predictions: dict[str, dict[str, np.ndarray]], *, measured: bool
) -> dict[str, np.ndarray]:
    """Columns to print, by name and unit; measured and predicted ones beside each other."""
    columns = {}
    for name, (unit, size) in SHOWN.items():
        if name not in MEASURED:
            if name in table:
                columns[f"{name}_{unit}"] = table[name] / size
        elif name in table:
            if measured:
                columns[f"{name}_{unit}"] = table[name] / size
            for label, values in predictions.items():
                columns[f"{label}_{name}_{unit}"] = values[name] / size
    return columns


def _errors(table: dict[str, np.ndarray], values: dict[str, np.ndarray]) -> str:
    parts = []
    for name, model in values.items():
        if not np.isfinite(model).any():
            continue
        unit, size = SHOWN[name]
        error, whole = (math.sqrt(np.nanmean(v**2)) for v in (model - table[name], table[name]))
        share = f" ({100 * error / whole:.3g} %)" if whole else ""
        parts.append(f"{name} errs by {error / size:.3g} {unit}{share}")
    return ", ".join(parts) + ", root mean square" if parts else "no rest where it was measured"


def _of_fit(fit: Posterior, mine: Finger) -> list[str]:
    """What was fitted, and how a hand takes it."""
    lines = []
    value = fit.value
    identified = fit.identified
    for name in fit.names:
        label, unit, size = CONSTANTS[name]
        if wrong := schema.field_problem(label, float(f"{value[name]:.4g}"), Material, name):
            reason = "the table's units, signs and the design's section do not fit one another"
            raise InputError.of("range", f"fitted: {wrong}: {reason}")
        number = f"{value[name] / size:.4g} {unit}".rstrip()
        doubt = "" if identified[name] else "; hardly told by these measurements"
        lines.append(f"fitted: {label} = {number}, {_error(fit, name)}{doubt}")
    bends = {"angle", "tip_x", "tip_y"} & set(fit.noise)
    if bends and not identified.get("moment_factor", True):
        error = fit.ratio_sd
        size = "" if math.isnan(error) else f", here with a standard error of {100 * error:.2g} %"
        lines.append(
            f"angles alone give the ratio of modulus and moment{size}; a column tip_force or "
            "blocked_force tells them apart"
        )
    taken = [f"hand.material.{n}={value[n]:.4g}" for n in fit.names if identified[n]]
    if "shear_modulus" in fit.names:
        law = f"hand.material.law={LAWS[mine.neo_hookean]}"
        taken = [law, f"hand.material.shear_modulus={value['shear_modulus']:.4g}"] + [
            word for word in taken if "shear_modulus" not in word
        ]
    lines.append(f"to simulate it: --set {' '.join(taken)}")
    factor = value.get("moment_factor", 1.0) / mine.constants.moment_factor
    if identified.get("moment_factor", False):
        lines.append(
            f"on the real hand divide the pressures of a design that was searched without it by "
            f"{factor:.4g}"
        )
    return lines


def _error(fit: Posterior, name: str) -> str:
    low, high = fit.interval[name]
    if math.isnan(low):
        return "no standard error (as many numbers as values)"
    _, unit, size = CONSTANTS[name]
    span = f"{low / size:.4g} to {high / size:.4g} {unit}".rstrip()
    return f"standard error {100 * fit.sd[name]:.2g} %, 90 % interval {span}"


def _next(mine: Finger, fit: Posterior, table: dict[str, np.ndarray]) -> list[str]:
    """Which measurements would narrow the constants most."""
    try:
        best = fingers.advice(mine, fit, table)[:SHOWN_ADVICE]
    except ValueError:
        return []
    return [
        f"to narrow them by {100 * measurement.less:.0f} %, measure {measurement.words}"
        for measurement in best
    ]


def _write(fit: Posterior, mine: Finger, options: Options) -> None:
    """Writes the posterior as a table of constants."""
    if np.isnan(fit.covariance).any():
        raise ValueError("--posterior: as many numbers as values, so that there is none")
    keys = [f"hand.material.{n}" for n in fit.names]
    source = f"codesign finger, {options.measured.name if options.measured else ''}"
    law = LAWS[mine.neo_hookean]
    table = draws.of_logs(keys, fit.mean, fit.covariance, law, source)
    assert options.posterior is not None
    files.make_folder_of(options.posterior)
    with files.atomically(options.posterior) as part:
        part.write_text(draws.text(table), encoding="utf-8")
