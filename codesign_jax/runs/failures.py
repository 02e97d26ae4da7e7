"""Failed worlds on disk: what they were and the last good state they were frozen at."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax import array_files, types
from codesign_jax.array_files import Array
from codesign_jax.codesign import EpisodeInfo
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Trial

FOLDER = "failures"
MOST = 10
"""Failed worlds saved of an episode; all are in trials.csv."""


class Failure(NamedTuple):
    """One failed world."""

    design: np.ndarray  # design as simulated [SI units], shape (parameter,)
    trial: Trial
    # State in which it was frozen, see `model.RolloutState`; empty if the engine does not tell
    state: np.ndarray
    status: int  # bits of `Status`
    bad_step: int  # first bad time step, or -1 (STUCK)
    place: tuple[int, int, int]  # number of the episode, from 1, and indices of particle and trial


_REAL = {"position": (2,), "arm_tilt": (2,), "tilt": (2,), "constants": ("constant",)}
"""Shapes of a trial's arrays of real numbers that are no single number."""
_LAYOUT = {
    "design": Array("f", ("parameter",)),
    "state": Array("f", ("coordinate",)),
    **dict.fromkeys(("status", "bad_step"), Array("iu", ())),
    "place": Array("iu", (3,)),
    "trial_shape": Array("iu", ()),
    **{
        f"trial_{name}": Array("f", _REAL.get(name, ()), name in Trial._field_defaults)
        for name in Trial._fields
        if name != "shape"
    },
}


def save(folder: Path, episode: int, info: EpisodeInfo) -> list[Path]:
    """Saves an episode's first failed worlds, a file each; returns the files."""
    # From the device as a whole: to index there would be a program for each number.
    info = jax.tree.map(np.asarray, info)
    status = info.outcomes.status
    trials = info.drawn
    files = []
    for p, t in np.argwhere(types.failed(status))[:MOST]:
        trial = jax.tree.map(lambda v, t=t: v[t], trials)
        state = np.zeros(0) if info.last is None else info.last[p, t]
        path = folder / FOLDER / f"episode-{episode}-particle-{p}-trial-{t}.npz"
        arrays = {
            "design": info.population[p],
            "state": state,
            "status": status[p, t],
            "bad_step": info.outcomes.bad_step[p, t],
            "place": np.array([episode, p, t]),
        }
        trial_arrays = {f"trial_{k}": v for k, v in trial._asdict().items() if v is not None}
        path.parent.mkdir(exist_ok=True)
        array_files.save(path, arrays | trial_arrays)
        files.append(path)
    return files


def load(path: Path) -> Failure:
    if not path.exists():
        raise InputError.of("missing", f"{path}: there is no such file or folder")
    try:
        values = array_files.load(path, _LAYOUT)
        # Earlier runs have no tilt, and most scenes no constants that are drawn.
        left_out = {n for n in ("tilt", "constants") if f"trial_{n}" not in values}
        drawn = [n for n in Trial._fields if n not in left_out]
        trial = Trial(**{name: values[f"trial_{name}"] for name in drawn})
        numbers = tuple(int(v) for v in values["place"])
        status = int(values["status"])
        bad_step = int(values["bad_step"])
        return Failure(values["design"], trial, values["state"], status, bad_step, numbers)  # type: ignore[arg-type]
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = f"{path} is not a failed world of a run, which are .npz files in its {FOLDER}/"
        raise InputError.of("damaged", problem) from error
