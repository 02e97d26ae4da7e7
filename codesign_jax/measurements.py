r"""Tables of what was measured on a finger: a CSV whose head names columns with their units.

>>> import pathlib, tempfile
>>> from codesign_jax import measurements
>>> folder = tempfile.TemporaryDirectory()
>>> path = pathlib.Path(folder.name, "finger.csv")
>>> _ = path.write_text("pressure_kPa;angle_deg\n20;18,9\n40;37,2\n")  # of a spreadsheet
>>> measurements.read(path)["pressure"]  # Pa
array([20000., 40000.])
>>> folder.cleanup()
"""

import csv
import io
import itertools
import math
import re
from pathlib import Path

import numpy as np

from codesign_jax import files
from codesign_jax.scene import texts
from codesign_jax.scene.schema import InputError, Problem, nearest

UNITS = {
    "Pa": ("pressure", 1.0),
    "kPa": ("pressure", 1e3),
    "MPa": ("pressure", 1e6),
    "mbar": ("pressure", 1e2),
    "bar": ("pressure", 1e5),
    "psi": ("pressure", 6894.757293168),
    "deg": ("angle", math.pi / 180),
    "rad": ("angle", 1.0),
    "mN": ("force", 1e-3),
    "N": ("force", 1.0),
    "g": ("force", 9.80665e-3),
    "kg": ("force", 9.80665),
    "mm": ("length", 1e-3),
    "cm": ("length", 1e-2),
    "m": ("length", 1.0),
    "s": ("time", 1.0),
    "ms": ("time", 1e-3),
}
"""Units of a column: what they measure, and how many SI units they are.

A mass stands for its weight under standard gravity, 9.80665 m/s^2.
"""

COLUMNS = {
    "pressure": ("pressure", "gauge pressure of the chamber; 0 where a file has no such column"),
    "angle": ("angle", "angle by which the free finger bends over its length"),
    "tip_x": ("length", "place of the free tip along the unbent finger, from its base"),
    "tip_y": ("length", "place of the free tip across it, towards the bending"),
    "tip_force": ("force", "force on a tip that is held where it was, the rest free to bow"),
    "blocked_force": ("force", "force on the tip of a finger that is kept straight"),
    "load": ("force", "force on the tip: a weight hung from it"),
    "deflection": (
        "length",
        "how far the load moves the tip, across the unbent finger and against its bending",
    ),
    "sideways": ("length", "how far the load moves the tip out of the plane of the bending"),
    "time": ("time", "time of a picture of a finger that was held straight and let go"),
    "drop": ("length", "drop of its tip at that time, by its weight and the load"),
}
"""Columns of a file of measurements: what their unit measures, and what they are."""

BY_PRESSURE = ("angle", "tip_x", "tip_y", "tip_force", "blocked_force")
"""Columns that need a pressure."""
MEASURED = (*BY_PRESSURE, "deflection", "sideways", "drop")
"""Columns that are compared with the model."""
NEEDED = {"deflection": "load", "sideways": "load", "drop": "time"}
"""Columns that stand beside another one."""
MOST_CHARACTERS = 1_000_000
"""Largest size of a file."""
MOST_PROBLEMS = 20
"""Most problems of a file that its error names: a log may have one in each of thousands of rows."""
_NUMBER = re.compile(r"[+-]?[0-9.,]+([eE][+-]?[0-9]+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2}(,[0-9]{3})+")
"""A number whose commas may separate thousands as well as decimals."""
_SEPARATORS = (";", "\t", ",")
"""What stands between cells; the first of them that the head has."""
_HEAD = re.compile(r"(?P<name>.*?)[\s_]*[\[(](?P<unit>[^\])]*)[\])]")
"""A name with its unit in brackets."""
_EXCEL = re.compile(r"sep=(.)\s*")
"""A first line that names the separator."""


def read(path: Path) -> dict[str, np.ndarray]:
    """Reads measurements.

    Cells are separated by commas, or by semicolons or tabs as spreadsheets write them, beside which
    a decimal sign may be a comma, the same in the whole file.  Numbers have no separators of
    thousands.  The unit of a column stands behind its name, after an underscore
    or in brackets.  Lines that begin with # are comments.  A cell without a value leaves that
    quantity out of its row.

    Returns:
      Columns of `COLUMNS` that the file has [SI units], shape (row,); NaN for an empty cell.

    Raises:
      InputError: With everything that is wrong with the file.
    """
    lines = _lines(path)
    separator, lines = _separator(lines)
    if not lines:
        raise InputError.of(
            "syntax", f"{path} is empty; its head names columns, such as pressure_kPa,angle_deg"
        )
    problems: list[str] = []
    head, rows = _rows(lines, separator, problems)
    names, factors = _columns(head, problems)
    table: dict[str, np.ndarray] = {}
    if not problems:
        comma = separator != "," and _has_decimal_commas(head, rows, problems)
    if not problems:
        values = [
            [_cell(c, comma, f"line {n}, {h}", problems) for h, c in zip(head, row, strict=True)]
            for n, row in rows
        ]
    if not problems:
        columns = np.array(values).reshape(-1, len(names)).T * np.array(factors)[:, None]
        table = dict(zip(names, columns, strict=True))
        problems = _missing(table)
    if problems:
        rest = len(problems) - MOST_PROBLEMS
        shown = problems[:MOST_PROBLEMS]
        if rest > 0:
            shown.append(Problem("range", f"and {rest:,} problems more"))
        raise InputError([Problem.of(p).told(f"{path}: {p}") for p in shown])
    return table


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines of a file that have something to read, with their numbers."""
    try:
        with files.opened(path) as file:
            content = file.read(4 * MOST_CHARACTERS + 1)
        if foreign := texts.foreign(content):
            raise InputError.of("syntax", f"{path}: {foreign}")
        text = content.decode("utf-8-sig")
    except OSError as error:
        raise InputError.of("file", f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError.of("syntax", f"{path}: no UTF-8 text; save it as CSV UTF-8") from error
    if len(text) > MOST_CHARACTERS:
        raise InputError.of("range", f"{path} has more than {MOST_CHARACTERS:,} characters")
    lines = [(n, v) for n, v in enumerate(io.StringIO(text, newline=""), 1) if v.strip()]
    return [(n, line) for n, line in lines if not line.lstrip().startswith("#")]


def _separator(lines: list[tuple[int, str]]) -> tuple[str, list[tuple[int, str]]]:
    """What stands between the cells, and the lines that have some."""
    first = lines[0][1] if lines else ""
    if named := _EXCEL.fullmatch(first):
        return named[1], lines[1:]
    return next((s for s in _SEPARATORS if s in first), ","), lines


def _rows(
    lines: list[tuple[int, str]], separator: str, problems: list[str]
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The head, and the rows with the numbers of their lines."""
    rows = []
    for number, line in lines:
        try:
            [cells] = csv.reader([line.rstrip("\r\n")], delimiter=separator, strict=True)
        except (csv.Error, ValueError) as error:
            problems.append(Problem("syntax", f"line {number} is no row of cells: {error}"))
            continue
        stripped = [cell.strip() for cell in cells]
        if any(stripped):  # a spreadsheet writes its empty rows as well
            rows.append((number, stripped))
    if problems or not rows:
        return [], []
    (_, head), *rows = rows
    # A spreadsheet writes its empty columns as well.
    while len(head) > 1 and not head[-1] and all(len(r) < len(head) or not r[-1] for _, r in rows):
        rows = [(n, row[: len(head) - 1]) for n, row in rows]
        head = head[:-1]
    hint = "; beside a decimal comma cells are separated by semicolons" if separator == "," else ""
    fitting = []
    for number, row in rows:
        if len(row) == len(head):
            fitting.append((number, row))
            continue
        words = f"line {number} has {len(row)} cells, the head {len(head)}"
        problems.append(Problem("size", words + hint * (len(row) > len(head))))
    return head, fitting


def _columns(head: list[str], problems: list[str]) -> tuple[list[str], list[float]]:
    """Names of the columns, and how many SI units theirs are."""
    names = []
    factors = []
    for column in head:
        name, unit = _name_and_unit(column)
        if name not in COLUMNS:
            problems.append(
                Problem("unknown", f"column {column!r} is not valid: {_valid(column, name)}")
            )
            continue
        kind = COLUMNS[name][0]
        units = [u for u, (k, _) in UNITS.items() if k == kind]
        if unit not in units:
            problems.append(
                Problem(
                    "unknown", f"column {column!r}: unit {unit!r} is not one of {', '.join(units)}"
                )
            )
            continue
        if name in names:
            problems.append(Problem("conflict", f"column {name!r} is given more than once"))
        names.append(name)
        factors.append(UNITS[unit][1])
    return names, factors


def _name_and_unit(column: str) -> tuple[str, str]:
    """Of `tip_force_N` as well as of `Tip force [N]`."""
    if parts := _HEAD.fullmatch(column):
        name = parts["name"]
        unit = parts["unit"].strip().replace("\N{DEGREE SIGN}", "deg")
    else:
        name, _, unit = column.rpartition("_")
    return "_".join(name.lower().split()), unit


def _valid(column: str, name: str) -> str:
    """What a column could be instead."""
    if any(known in column.lower() for known in COLUMNS):
        return (
            "a column is a quantity and its unit, such as pressure_kPa; columns are separated by "
            "commas, semicolons or tabs"
        )
    return f"no quantity {name!r}; {nearest(name, COLUMNS)}"


def _has_decimal_commas(
    head: list[str], rows: list[tuple[int, list[str]]], problems: list[str]
) -> bool:
    """Whether the file's decimal sign is a comma; a problem where its numbers leave it open."""
    columns: dict[str, list[str]] = {name: [] for name in head}
    with_sign: dict[str, str] = {}
    for line, row in rows:
        for name, cell in zip(head, row, strict=True):
            number = texts.typed(cell)
            if _NUMBER.fullmatch(number):
                columns[name].append(number)
                for sign in {*number} & {*",."}:
                    with_sign.setdefault(sign, f"{cell!r} (line {line}, {name})")
    remedy = "write numbers without separators of thousands"
    if len(with_sign) == 2:
        both = f"{with_sign[',']} has a comma and {with_sign['.']} a point"
        problems.append(Problem("syntax", f"{both}, and a file has one decimal sign: {remedy}"))
    commas = {name: [n for n in numbers if "," in n] for name, numbers in columns.items()}
    grouped = all(map(_THOUSANDS.fullmatch, itertools.chain.from_iterable(commas.values())))
    whole = any(numbers and not commas[name] for name, numbers in columns.items())
    if not problems and "," in with_sign and grouped and whole:
        either = "may be thousands or decimals, and no other number tells"
        problems.append(
            Problem("syntax", f"the comma in {with_sign[',']} {either}: {remedy}, or more decimals")
        )
    return "," in with_sign


def _cell(text: str, comma: bool, where: str, problems: list[str]) -> float:
    if not text:
        return math.nan
    plain = texts.typed(text)
    if comma:
        plain = plain.replace(",", ".")
    try:
        value = float(plain)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        problems.append(
            Problem("type", f"{where} = {texts.shown(text)} must be a number, or empty")
        )
    return value


def _missing(table: dict[str, np.ndarray]) -> list[str]:
    """What a table lacks; one without pressures gets those of an empty chamber."""
    names = [n for n in MEASURED if n in table and np.isfinite(table[n]).any()]
    rows = len(next(iter(table.values())))
    if "pressure" not in table:
        if not names or any(n in BY_PRESSURE for n in names):
            return [Problem("missing", "no column of the pressure, such as pressure_kPa")]
        table["pressure"] = np.zeros(rows)
    problems = []
    if not names:
        problems.append(
            Problem("missing", f"no measured value; columns of them: {', '.join(MEASURED)}")
        )
    loads_alone = np.all([np.isnan(table[n]) for n in BY_PRESSURE if n in table] or [True], axis=0)
    table["pressure"] = np.where(loads_alone, np.nan_to_num(table["pressure"]), table["pressure"])
    if np.isnan(table["pressure"]).any():
        problems.append(Problem("missing", "a row has no pressure"))
    elif (table["pressure"] < 0).any():
        problems.append(Problem("range", "a pressure is below 0; gauge pressures are meant"))
    for name, other in NEEDED.items():
        if name in table:
            beside = table.get(other, np.full(rows, np.nan))
            if np.isnan(beside[np.isfinite(table[name])]).any():
                unit = {"load": "N", "time": "s"}[other]
                problems.append(
                    Problem(
                        "missing",
                        f"a {name} has no {other} beside it, in a column such as {other}_{unit}",
                    )
                )
    return problems
