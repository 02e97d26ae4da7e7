"""Results as CSV, units in the column names (see `columns`); a resumed run writes the same bytes.

Numbers have nine significant digits, which name a float32 exactly.  Times of day are in
events.log.
"""

import contextlib
import csv
import io
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from codesign_jax import files, types
from codesign_jax.codesign import FinalTest, summarize_test
from codesign_jax.judge import verdict
from codesign_jax.judge.verdict import VERDICTS, status_names, verdicts
from codesign_jax.runs.columns import ENDS, MORE, REFERENCE, TABLES
from codesign_jax.runs.record import History, Record
from codesign_jax.scene import Scene, texts
from codesign_jax.scene.parameters import DesignSpace, fingers_of
from codesign_jax.types import Outcome, Trial

TESTS = "tests.csv"

Row = dict[str, Any]
"""Values by the columns' names, see `columns`."""


def design_columns(space: DesignSpace) -> list[str]:
    """Names of the parameters with their units, e.g. length_mm and pressure_0_kPa."""
    names = (re.sub(r"[\[+]", "_", name).replace("]", "") for name in space.names)
    return [f"{name}_{unit}" for name, unit in zip(names, space.units, strict=True)]


def write_run(
    folder: Path, scene: Scene, space: DesignSpace, record: Record, since: int = 0
) -> None:
    """Writes the tables of a run: all of them anew, or the rows from an episode on.

    Args:
      since: Index of the first episode whose rows are appended; 0 replaces the files.
    """
    span = range(since, record.done)
    for name, rows in _of_episodes(scene, space, record.history, span).items():
        text = _text(name, space, rows, named=since == 0)
        if since == 0:
            _replace(folder / name, text)
        else:
            files.append(folder / name, text)
    if record.test is None:
        (folder / TESTS).unlink(missing_ok=True)
    else:
        test = summarize_test(scene, record.test)
        particles = np.asarray(record.state.particles)
        rows = _of_test(scene, space, particles, test, record.searched)
        _replace(folder / TESTS, _text(TESTS, space, rows))


def episodes_in(folder: Path) -> int:
    """Number of episodes of which the tables in a run folder tell, whatever they hold."""
    content = _content(folder / "episodes.csv") or b""
    return max(content.count(b"\n") - 1, 0)


def noise_values(trials: Trial) -> dict[str, Any]:
    """The noise of trials by the names of its columns in `columns.GRASPS`; of any shape."""
    trials = jax.tree.map(np.asarray, trials)
    tilt = np.zeros_like(trials.position) if trials.tilt is None else trials.tilt
    return {
        "noise_x_m": trials.position[..., 0],
        "noise_y_m": trials.position[..., 1],
        "noise_yaw_rad": trials.yaw,
        "noise_roll_rad": tilt[..., 0],
        "noise_pitch_rad": tilt[..., 1],
        "noise_arm_roll_rad": trials.arm_tilt[..., 0],
        "noise_arm_pitch_rad": trials.arm_tilt[..., 1],
        "noise_mass_factor": trials.mass,
        "noise_size_factor": trials.size,
        "noise_friction_factor": trials.friction,
        "noise_stiffness_factor": trials.stiffness,
        "noise_hand_mass_factor": trials.hand_mass,
    }


def write_grasps(path: Path, scene: Scene, trials: Trial, outcomes: Outcome) -> None:
    """Writes a design's trials with their noise and how they ended, a row each."""
    names = [s.name for s in scene.objects.object]
    noise = noise_values(trials)

    def row(t: int) -> Row:
        outcome = jax.tree.map(lambda v: np.asarray(v)[t], outcomes)
        cells = {"trial": t, "object": names[int(trials.shape[t])]}
        drawn = {name: _number(v[t]) for name, v in noise.items()}
        return cells | drawn | {"verdict": VERDICTS[verdicts(outcome)]} | _ending(outcome)

    write(path, [*MORE[REFERENCE].columns], (row(t) for t in range(len(outcomes.cost))))


def by_finger(space: DesignSpace) -> tuple[dict[str, list[int]], list[int]]:
    """Indices of the parameters that each finger has of its own, by name, and of the others."""
    per_finger: dict[str, list[int]] = {}
    for k, name in enumerate(space.names):
        if len(fingers_of(name)) == 1:
            per_finger.setdefault(name.partition("[")[0], []).append(k)
    per_finger = {
        name: columns
        for name, columns in per_finger.items()
        if len(columns) == len(space.hand.finger)
    }
    fingers = {k for columns in per_finger.values() for k in columns}
    return per_finger, [k for k in range(space.num_parameters) if k not in fingers]


def describe(space: DesignSpace, design: np.ndarray, title: str = "design") -> str:
    """A design [SI units] in the hand file's units, such as "design: length=110 mm arm_z=20 mm".

    Where fingers have parameters of their own, a table with a row for each finger, and one of the
    other parameters.
    """
    per_finger, others = by_finger(space)
    values = [f"{value:.4g}" for value in space.in_units(design)]
    units = ["" if unit == "1" else unit for unit in space.units]
    if not per_finger:
        pairs = zip(space.names, values, units, strict=True)
        return f"{title}: " + " ".join(
            f"{name}={value} {unit}".rstrip() for name, value, unit in pairs
        )
    fingers = [[name, units[at[0]], *(values[k] for k in at)] for name, at in per_finger.items()]
    index = ["finger", "", *map(str, range(len(fingers[0]) - 2))]
    hand = [[space.names[k], units[k], values[k]] for k in others]
    return "\n".join([f"{title}:", *_aligned([index, *fingers]), *_aligned(hand)])


def _aligned(columns: list[list[str]]) -> list[str]:
    """Rows of a table whose columns are given, its numbers one below the other."""
    widths = [max(map(len, column)) for column in columns]
    rows = zip(*columns, strict=True)
    return ["  ".join(["", *map(str.rjust, row, widths)]) for row in rows]


def _episodes(history: History, space: DesignSpace, span: range) -> Iterator[Row]:
    for e in span:
        best = int(np.argmin(history.cost[e]))
        yield {
            "episode": e + 1,
            "mean_cost": _number(history.cost[e].mean()),
            "best_cost": _number(history.cost[e, best]),
            "failed_trials": int(types.failed(history.outcomes.status[e]).sum()),
            "effective_sample_size": _number(1 / (history.weight[e] ** 2).sum()),
            **_designs("episodes.csv", space, history.population[e, best : best + 1])[0],
        }


def _particles(history: History, space: DesignSpace, span: range) -> Iterator[Row]:
    for e in span:
        for i, design in enumerate(_designs("particles.csv", space, history.population[e])):
            yield {
                "episode": e + 1,
                "particle": i,
                "cost": _number(history.cost[e, i]),
                "weight": _number(history.weight[e, i]),
                "next_copies_particle": history.ancestors[e, i],
                **design,
            }


def _trials(history: History, scene: Scene, span: range) -> Iterator[Row]:
    names = [s.name for s in scene.objects.object]
    trials = history.outcomes
    for e in span:
        for i, t in np.ndindex(*trials.cost.shape[1:]):
            cells = {"episode": e + 1, "particle": i, "trial": t, "object": names[t % len(names)]}
            yield cells | _ending(jax.tree.map(lambda v, at=(e, i, t): v[at], trials))


def _number_or_empty(value: Any) -> str:
    """A number; empty if it is not one, or none was told."""
    return "" if value is None or np.isnan(value) else _number(value)


def _ending(outcome: Outcome) -> Row:
    """The columns of a trial that say how it ended; the outcome's entries are numbers."""
    bad_step = int(outcome.bad_step)
    return {
        "cost": _number(outcome.cost),
        "lost_time_s": _number(outcome.lost_time),
        "status": status_names(outcome.status),
        "first_bad_step": bad_step if bad_step >= 0 else "",
        "steps_at_limit": _number_or_empty(outcome.capped),
        "residual": _number_or_empty(outcome.residual),
    }


def _designs(table: str, space: DesignSpace, population: np.ndarray) -> list[Row]:
    names = TABLES[table].head(design_columns(space))[-len(space.names) :]
    values = space.in_units(population)
    return [dict(zip(names, map(_number, design), strict=True)) for design in values]


def _number(value: Any) -> str:
    return f"{float(value):.9g}"


def _of_episodes(
    scene: Scene, space: DesignSpace, history: History, span: range
) -> dict[str, Iterable[Row]]:
    return {
        "episodes.csv": _episodes(history, space, span),
        "particles.csv": _particles(history, space, span),
        "trials.csv": _trials(history, scene, span),
    }


def _of_test(
    scene: Scene,
    space: DesignSpace,
    particles: np.ndarray,
    test: FinalTest,
    searched: Outcome | None,
) -> Iterator[Row]:
    test = jax.tree.map(np.asarray, test)
    failed = types.failed(test.outcomes.status)
    at_search = [""] * len(particles) if searched is None else verdict.kept(searched).sum(1)
    for i, design in enumerate(_designs(TESTS, space, particles)):
        yield {
            "particle": i,
            "test_cost": _number(test.cost[i]),
            "trials": failed.shape[1],
            "failed_trials": failed[i].sum(),
            "paper_success": int(test.paper_success[i]),
            **_ends(scene, jax.tree.map(lambda v, i=i: v[i], test.outcomes)),
            "search_kept_trials": at_search[i],
            **design,
        }


def _ends(scene: Scene, outcomes: Outcome) -> Row:
    """Numbers of trials by how they ended, the columns `columns.ENDS`."""
    counts = verdict.tally(outcomes)
    causes = verdict.losses(scene, outcomes)
    numbers = (counts.kept, *causes, counts.not_released, counts.fault)
    return dict(zip(ENDS, numbers, strict=True))


def write(path: Path, head: list[str], rows: Iterable[Row]) -> None:
    """Writes a table as a whole or not at all."""
    _replace(path, written(head, rows))


def _text(table: str, space: DesignSpace, rows: Iterable[Row], *, named: bool = True) -> str:
    """Text of a table of `columns.TABLES`; without `named` that of further rows."""
    return written(TABLES[table].head(design_columns(space)), rows, named=named)


def written(head: list[str], rows: Iterable[Row], *, named: bool = True) -> str:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, head, lineterminator="\n")
    if named:
        writer.writeheader()
    for row in rows:
        if missing := [name for name in head if name not in row]:
            raise ValueError(f"a row of the table has no {', '.join(missing)}")
        writer.writerow({name: texts.cell(value) for name, value in row.items()})
    return text.getvalue()


def _replace(path: Path, text: str) -> None:
    with files.atomically(path) as part:
        part.write_bytes(text.encode())


def _content(path: Path) -> bytes | None:
    with contextlib.suppress(FileNotFoundError, IsADirectoryError):
        return files.read(path)
    return None
