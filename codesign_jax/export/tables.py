"""The grasps of an export: models, their controls, and the list of what became of them."""

import csv
import itertools
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from codesign_jax.export import plain
from codesign_jax.export.grasps import PLAYER, Grasp
from codesign_jax.model.layout import WRIST
from codesign_jax.scene import Scene, texts
from codesign_jax.types import Status, Trial, failed

MODELS = "model"
GRASPS = "grasps.csv"
NOTES = "README.txt"

GRASP_COLUMNS = {
    "model": "name of the model's files",
    "object": "name of the object",
    "object_x_mm": "place of the object on the table",
    "object_y_mm": "likewise",
    "object_yaw_deg": "its turn about the vertical",
    "object_roll_deg": "its turn about x, applied before pitch and yaw",
    "object_pitch_deg": "its turn about y, applied after roll and before yaw",
    "arm_roll_tilt_deg": "noise of the arm's roll, part of the controls",
    "arm_pitch_tilt_deg": "noise of the arm's pitch, with the sign convention of commands.csv",
    "object_mass_factor": "factor on the object's mass",
    "object_size_factor": "factor on its size",
    "friction_factor": "factor on the friction of all contacts",
    "stiffness_factor": "factor on the fingers' shear modulus",
    "hand_mass_factor": "factor on the masses of fingers and palm",
    "lost_time_s": "when the object was lost in plain MuJoCo; inf if it was kept",
    "status": "OK or why the trial failed, as in a run's trials.csv; solver warnings are not seen",
}
"""Meaning of the columns of grasps.csv, a row for each model."""


def control_columns(scene: Scene) -> list[str]:
    """Names of the columns of a grasp's controls, in SI units and the order of the actuators.

    The hinge of the pitch turns against `arm_pitch`, which its name says.
    """
    signs = {"pitch": "minus_"}
    arm = [f"{signs.get(name, '')}arm_{name}_{'m' if len(name) == 1 else 'rad'}" for name in WRIST]
    return ["time_s", *arm, *(f"pressure_{i}_Pa" for i in range(scene.num_fingers))]


def write_grasps(
    folder: Path, scene: Scene, trials: Sequence[tuple[str, Trial]], grasps: Iterable[Grasp]
) -> Iterator[str]:
    """Writes notes, models, controls, player and grasps.csv, as far as its lines are asked for."""
    lines = ["Grasps of codesign-jax for plain MuJoCo: python play.py NAME.xml; docs/export.md"]
    lines.append(
        f"NAME.mjb: written by MuJoCo {mujoco.__version__}, and read by that version alone; "
        "NAME.xml is for any from 3.17 on"
    )
    lines += [f"Unlike the scene {scene.name}: {text}" for text in plain.differences(scene)]
    (folder / NOTES).write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = []
    for (name, trial), grasp in zip(trials, grasps, strict=True):
        if grasp.xml is not None:
            (folder / f"{name}.xml").write_text(grasp.xml, encoding="utf-8")
        # Not to a file: of one that it cannot write MuJoCo warns in another, MUJOCO_LOG.TXT.
        binary = np.zeros(mujoco.mj_sizeModel(grasp.binary), np.uint8)
        mujoco.mj_saveModel(grasp.binary, None, binary)
        (folder / f"{name}.mjb").write_bytes(binary.tobytes())
        # repr names a float64 exactly: the player's controls are these.
        exact = ([repr(float(v)) for v in row] for row in grasp.controls)
        write_table(folder / f"{name}_controls.csv", control_columns(scene), exact)
        rows.append(_row(name, scene, trial, grasp))
        yield f"{name}: {_verdict(grasp)}"
        if grasp.note:
            yield f"{name}: no MJCF: {grasp.note}"
    write_table(folder / GRASPS, [*GRASP_COLUMNS], rows)
    (folder / PLAYER.name).write_text(PLAYER.read_text(encoding="utf-8"), encoding="utf-8")


def _row(name: str, scene: Scene, trial: Trial, grasp: Grasp) -> list[str]:
    factors = [trial.mass, trial.size, trial.friction, trial.stiffness, trial.hand_mass]
    numbers = [*np.multiply(1e3, trial.position)]
    tilt = np.zeros(2) if trial.tilt is None else trial.tilt
    roll, hinge = trial.arm_tilt  # the model's hinge of the pitch turns against the design's
    numbers += [*np.degrees([trial.yaw, *tilt, roll, -hinge])]
    numbers += [1.0 if v is None else v for v in factors] + [grasp.outcome.lost_time]
    status = str(Status(int(grasp.outcome.status)).name)
    shape = scene.objects.object[int(trial.shape)].name
    return [name, shape, *(f"{float(v):.9g}" for v in numbers), status.replace("|", "+")]


def _verdict(grasp: Grasp) -> str:
    status = int(grasp.outcome.status)
    if failed(status):
        return f"failed ({Status(status).name})"
    lost = float(grasp.outcome.lost_time)
    return "kept" if np.isinf(lost) else f"lost at {lost:.2f} s"


LONGEST = 80
"""Most bytes of an object's name in the names of files, of which systems take 255."""


def names_of(objects: Sequence[str]) -> list[str]:
    """Names of files for names of objects, which are free text: no two that a disk takes for one.

    Long names are cut.  Where names meet, also on a disk that ignores case, all get their number.
    """
    plain = [_cut(re.sub(r"\W+", "_", unicodedata.normalize("NFKC", name))) for name in objects]
    # A name such as trial_007 belongs to the grasps with noise.
    plain = [re.sub(r"^(trial_\d)", r"object_\1", name) for name in plain]
    unique = len({name.casefold() for name in plain}) == len(plain)
    return plain if unique else [f"{name}_{i}" for i, name in enumerate(plain)]


def _cut(name: str) -> str:
    return name.encode()[:LONGEST].decode(errors="ignore").strip("_") or "object"


def write_table(path: Path, head: Sequence[str], rows: Iterable[Sequence[str]]) -> Path:
    with path.open("w", encoding="utf-8", newline="") as file:
        cells = ([*map(texts.cell, row)] for row in itertools.chain([head], rows))
        csv.writer(file, lineterminator="\n").writerows(cells)
    return path
