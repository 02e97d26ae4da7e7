"""`codesign finger`."""

import math
from collections.abc import Iterator
from itertools import chain

import numpy as np
from rich import box
from rich.table import Table

from codesign_jax import finger as fingers
from codesign_jax.commands import common
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Finger as Options
from codesign_jax.finger import Finger, Fit
from codesign_jax.runs import tables
from codesign_jax.scene import schema
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
}
"""Units of what is printed, and how many SI units they are."""

POINTS = 11
"""Pressures of a curve without measurements."""


def main(options: Options) -> int:
    case = find_case(options)
    params = case.space.params(np.asarray(case.design))
    problems = common.number_problems(("--finger", options.finger, 0, case.scene.num_fingers - 1))
    if options.fit and options.measured is None:
        problems.append("--fit needs measurements: give a file, codesign finger FILE.csv --fit")
    common.refuse(problems + common.place_problems("--out", options.out, ".csv"))
    measured = options.measured and fingers.read(options.measured)
    mine = fingers.of_design(case.scene, params, options.finger)
    console = Console()
    console.print(_about(mine, options.finger, case.scene.hand.name))
    if not options.run_folder:
        given = [*chain.from_iterable(options.design)]
        if note := common.by_default(case.space, given):
            console.print(note)
    table = measured
    if table is None:
        top = float(np.asarray(params.pressure)[options.finger])
        table = {"pressure": np.linspace(0.0, top, POINTS)}
        table |= {n: np.zeros(POINTS) for n in ("angle", "tip_force", "blocked_force")}
    try:
        compare(mine, table, options, console)
    except ValueError as error:
        raise InputError([str(error)]) from error
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
        f"{1e-3 * mine.shear_modulus:.4g} kPa, {mine.links} links, without weight"
    )


def compare(mine: Finger, table: dict[str, np.ndarray], options: Options, console: Console) -> None:
    """Prints and writes what was measured, predicted and fitted."""
    models = {"model": mine}
    fit: Fit | None = None
    if options.fit:
        fit = fingers.fit(mine, table)
        models["fitted"] = mine.of_material(fit.shear_modulus, fit.gain)
    found = {which: fingers.predict(model, table) for which, model in models.items()}
    columns = _columns(table, found, measured=options.measured is not None)
    shown = Table(box=box.SIMPLE)
    for name in columns:
        shown.add_column(name.replace("_", " "), justify="right")
    for row in zip(*columns.values(), strict=True):
        shown.add_row(*("" if math.isnan(v) else f"{v:.4g}" for v in row))
    common.print_table(console, shown)
    for line in chain.from_iterable(_without_rest(table, *item) for item in found.items()):
        console.print(line)
    if options.measured:
        for which, values in found.items():
            console.print(f"{which}: {_errors(table, values)}")
        for name in fingers.opposed(table, found["model"]):
            console.print(f"warning: measured and predicted {_words(name)} differ in sign")
    if fit:
        for line in _of_fit(fit, table, mine.neo_hookean):
            console.print(line)
    if options.out:
        texts = {n: ["" if math.isnan(v) else f"{v:.9g}" for v in c] for n, c in columns.items()}
        rows = (dict(zip(texts, row, strict=True)) for row in zip(*texts.values(), strict=True))
        tables.write(options.out, [*texts], rows)
        console.print(f"table: {options.out}")


def _without_rest(
    table: dict[str, np.ndarray], which: str, found: dict[str, np.ndarray]
) -> Iterator[str]:
    """Says where a finger has no rest, after what it has."""
    for name, pressures in fingers.without_rest(table, found).items():
        places = ", ".join(f"{pressure / 1e3:.4g}" for pressure in pressures)
        yield (
            f"warning: {which}: no rest found for the {_words(name)} at {places} kPa: "
            f"{fingers.TOO_FAR}"
        )


def _columns(
    table: dict[str, np.ndarray], found: dict[str, dict[str, np.ndarray]], *, measured: bool
) -> dict[str, np.ndarray]:
    """Columns to print, by name and unit; measured and predicted ones beside each other."""
    columns = {}
    for name, (unit, size) in SHOWN.items():
        if name in ("pressure", "load"):
            if name in table:
                columns[f"{name}_{unit}"] = table[name] / size
        elif name in table:
            if measured:
                columns[f"{name}_{unit}"] = table[name] / size
            for which, values in found.items():
                columns[f"{which}_{name}_{unit}"] = values[name] / size
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


def _of_fit(fit: Fit, table: dict[str, np.ndarray], neo_hookean: bool) -> list[str]:
    modulus, gain = fingers.fitted(table)
    lines = []
    if modulus:
        value = f"{fit.shear_modulus:.4g}"
        if wrong := schema.field_problem("G", float(value), Material, "shear_modulus"):
            words = "the table's units, signs and the design's section do not fit one another"
            raise ValueError(f"fitted: {wrong}: {words}")
        lines.append(
            f"fitted: G = {1e-3 * fit.shear_modulus:.4g} kPa, {_error(fit.spread[0])}: "
            f"--set hand.material.law={LAWS[neo_hookean]} hand.material.shear_modulus={value}"
        )
    if gain:
        lines.append(
            f"fitted: moment {fit.gain:.4g} of the model's at the same pressure, "
            f"{_error(fit.spread[1])}"
        )
        given = ", with the fitted G in it," if modulus else ""
        lines.append(
            f"on the real hand divide a simulated design's pressures by {fit.gain:.4g} "
            f"(play_valves.py --divide {fit.gain:.4g}); to simulate the real finger{given} "
            f"multiply the simulated pressures by {fit.gain:.4g} instead"
        )
    elif modulus:
        lines.append(
            "the moment is the model's: angles alone give its ratio to G; a column tip_force or "
            "blocked_force tells them apart"
        )
    return lines


def _error(spread: float) -> str:
    if math.isnan(spread):
        return "no standard error (as many numbers as values)"
    return f"standard error {100 * spread:.2g} %"


def _words(name: str) -> str:
    return name.replace("_", " ")
