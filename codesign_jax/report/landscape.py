"""The mean cost of designs over a grid of two parameters: its files and its figure."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from codesign_jax import array_files
from codesign_jax.array_files import Array
from codesign_jax.runs import columns, tables
from codesign_jax.scene.parameters import DesignSpace
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
    # What the other parameters begin or stay at: a whole design [SI units], shape (parameter,)
    design: np.ndarray
    designs: np.ndarray  # the points' whole designs [SI units], shape (n, m, parameter)
    search: np.ndarray  # episodes of each point's search of the other parameters, shape ()
    air: np.ndarray  # air in all unloaded chambers [cm^3], shape (n, m)


_LAYOUT = {
    **dict.fromkeys(("names", "units"), Array("U", (2,))),
    "first": Array("f", ("first",)),
    "second": Array("f", ("second",)),
    "cost": Array("f", ("first", "second")),
    **dict.fromkeys(("kept", "counted"), Array("iu", ("first", "second"))),
    **dict.fromkeys(("trials", "seed", "search"), Array("iu", ())),
    "design": Array("f", ("parameter",)),
    "designs": Array("f", ("first", "second", "parameter")),
    "air": Array("f", ("first", "second")),
}


def save(landscape: Landscape, folder: Path, space: DesignSpace) -> list[Path]:
    """Writes a landscape as arrays and as a table of its points; returns the files."""
    npz = folder / FILE
    table = folder / TABLE
    array_files.save(npz, landscape._asdict())
    axes = [
        f"{n}_{u}".rstrip("_").replace("[", "_").replace("]", "")
        for n, u in zip(landscape.names, landscape.units, strict=True)
    ]

    names = tables.design_columns(space)
    values = space.in_units(landscape.designs)
    searched = [n for n in names if n not in axes] if landscape.search else []

    def row(i: int, j: int) -> tables.Row:
        point = dict(zip(axes, (landscape.first[i], landscape.second[j]), strict=True))
        point |= {"mean_cost": landscape.cost[i, j], "chamber_volume_cm3": landscape.air[i, j]}
        point |= {n: v for n, v in zip(names, values[i, j], strict=True) if n in searched}
        numbers = {n: f"{v:.9g}" for n, v in point.items()}
        counts = {"kept_trials": landscape.kept[i, j], "counted_trials": landscape.counted[i, j]}
        return numbers | {n: int(v) for n, v in (counts | {"trials": landscape.trials}).items()}

    head = [*axes, *columns.MORE[TABLE].columns, *searched]
    tables.write(table, head, (row(*point) for point in np.ndindex(*landscape.cost.shape)))
    return [npz, table]


def load(path: Path) -> Landscape:
    """Reads the arrays of a landscape."""
    try:
        return Landscape(**array_files.load(path, _LAYOUT))
    except (OSError, array_files.ArrayFileError) as error:
        words = f"{path} is not a landscape of this version ({error})"
        raise InputError.of("damaged", f"{words}; codesign landscape writes one") from error
