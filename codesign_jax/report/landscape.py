"""The mean cost of designs over a grid of two parameters: its files and its figure."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from codesign_jax import array_files
from codesign_jax.array_files import Array
from codesign_jax.runs import columns, tables
from codesign_jax.scene.schema import InputError

FILE = "landscape.npz"
TABLE = columns.LANDSCAPE


class Landscape(NamedTuple):
    """The mean cost over a grid of two parameters."""

    names: np.ndarray  # names of the two parameters, shape (2,)
    units: np.ndarray  # their units, shape (2,)
    first: np.ndarray  # values of the first one in its unit, shape (n,)
    second: np.ndarray  # values of the second one, shape (m,)
    cost: np.ndarray  # mean cost by the scene's rule for failed trials, shape (n, m)
    kept: np.ndarray  # trials that kept the object, shape (n, m)
    counted: np.ndarray  # trials that did not fail, shape (n, m)
    trials: np.ndarray  # trials of a point, shape ()
    seed: np.ndarray  # root of their noise, shape ()
    # What the other parameters stay at: the whole design [SI units], shape (parameter,)
    design: np.ndarray


_LAYOUT = {
    **dict.fromkeys(("names", "units"), Array("U", (2,))),
    "first": Array("f", ("first",)),
    "second": Array("f", ("second",)),
    "cost": Array("f", ("first", "second")),
    **dict.fromkeys(("kept", "counted"), Array("iu", ("first", "second"))),
    **dict.fromkeys(("trials", "seed"), Array("iu", ())),
    "design": Array("f", ("parameter",)),
}


def save(landscape: Landscape, folder: Path) -> list[Path]:
    """Writes a landscape as arrays and as a table of its points; returns the files."""
    npz = folder / FILE
    table = folder / TABLE
    array_files.save(npz, landscape._asdict())
    axes = [
        f"{n}_{u}".rstrip("_").replace("[", "_").replace("]", "")
        for n, u in zip(landscape.names, landscape.units, strict=True)
    ]

    def row(i: int, j: int) -> tables.Row:
        point = dict(zip(axes, (landscape.first[i], landscape.second[j]), strict=True))
        numbers = {n: f"{v:.9g}" for n, v in (point | {"mean_cost": landscape.cost[i, j]}).items()}
        counts = {"kept_trials": landscape.kept[i, j], "counted_trials": landscape.counted[i, j]}
        return numbers | {n: int(v) for n, v in (counts | {"trials": landscape.trials}).items()}

    head = [*axes, *columns.MORE[TABLE].columns]
    tables.write(table, head, (row(*point) for point in np.ndindex(*landscape.cost.shape)))
    return [npz, table]


def load(path: Path) -> Landscape:
    """Reads the arrays of a landscape."""
    try:
        return Landscape(**array_files.load(path, _LAYOUT))
    except (OSError, array_files.ArrayFileError) as error:
        problem = (
            f"{path} is not a landscape of this version ({error}); codesign landscape writes one"
        )
        raise InputError([problem]) from error
