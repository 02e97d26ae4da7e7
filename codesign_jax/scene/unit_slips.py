"""Numbers given from Python in other units than SI: refused, or hinted at."""

import warnings

import jax
import jax.core
import numpy as np

from codesign_jax.scene import schema
from codesign_jax.scene.hand_tables import PARAMETERS
from codesign_jax.types import Params

FAINT = 1000.0
"""Pressure below which no finger moves visibly [Pa]: 1 kPa bends one of 100 mm by half a degree."""
_LEAST = 1.0
"""What a thousand times as much is no faint pressure; smaller numbers may be bar or MPa."""


def refuse(params: Params) -> None:
    """Refuses parameters that were given in other units than SI and radians.

    As `DesignSpace.refuse_unit_slips`, for parameters with any leading axes.
    """
    if any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(params)):
        return
    arm = [f"arm_{axis}" for axis in ("x", "y", "z", "roll", "pitch", "yaw")]
    names = [name for name in Params._fields if name not in ("arm", "control", "tip")]
    values = {name: getattr(params, name) for name in names}
    if params.tip is not None:
        values |= {f"tip_{name}": v for name, v in params.tip._asdict().items()}
    values |= {name: np.asarray(params.arm)[..., i] for i, name in enumerate(arm)}
    mistakes = [slip for name, v in values.items() for slip in slips(name, name, np.asarray(v))]
    if mistakes:
        raise schema.InputError(mistakes)
    hint_at_kilopascals(np.asarray(params.pressure, float))


def hint_at_kilopascals(pressures: np.ndarray) -> None:
    """Warns of pressures that are all nearly zero, which their range has: kPa, most likely."""
    if words := kilopascals(pressures):
        warnings.warn(f"the largest pressure {words}; Python takes SI units", stacklevel=3)


def kilopascals(pressures: np.typing.ArrayLike) -> str | None:
    """That the largest of some pressures [Pa] "is" nearly zero and most likely kPa, or None."""
    largest = float(np.abs(np.asarray(pressures, float)).max(initial=0.0))
    if not 0 < largest < FAINT:
        return None
    words = f"is {largest:g} Pa, next to none"
    if largest < _LEAST:
        return f"{words}: pressures are in Pa"
    return f"{words}; did you mean {1e3 * largest:g}? (kPa given where Pa is expected)"


def outside(name: str, unit: str, low: float, high: float, values: np.ndarray) -> str | None:
    """The problem with the first value outside its bounds, or None.

    Args:
      values: The values, shape (n,).
    """
    slack = 1e-6 * max(abs(low), abs(high))  # bounds that went to SI and back, also as float32
    bad = values[~((values >= low - slack) & (values <= high + slack))]
    return schema.range_problem(name, _plain(bad[0]), unit, low, high) if bad.size else None


def slips(name: str, row: str, values: np.ndarray) -> list[str]:
    """The problem with the first value that seems to have another unit, or None."""
    if row not in PARAMETERS:  # of the control: only its bounds say what makes sense
        return []
    kind = PARAMETERS[row]
    slack = 1e-6 * abs(kind.high)  # a float32 of a bound
    outside = values[(values < kind.low - slack) | (values > kind.high + slack)]
    for value in outside.ravel()[:1]:
        if schema.unit_slip(float(value), kind.unit, kind.low, kind.high):
            problem = schema.range_problem(name, _plain(value), kind.unit, kind.low, kind.high)
            return [schema.Problem("range", f"{problem}; Python takes SI units and radians")]
    return []


def _plain(value: float) -> float:
    return float(f"{value:.7g}")  # as it was written: a float32 as a float has nine more digits
