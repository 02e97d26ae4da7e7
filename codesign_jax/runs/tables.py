"""Results as CSV, units in the column names (see `columns`); a resumed run writes the same bytes.

Numbers have nine significant digits, which name a float32 exactly.  Times of day and durations are
in events.log.
"""

import csv
import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from codesign_jax import files, types
from codesign_jax.codesign import VERDICTS, FinalTest, verdicts
from codesign_jax.runs.columns import MORE, REFERENCE, TABLES
from codesign_jax.runs.record import History, Record
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import WARNINGS, Outcome, Status, Trial

TESTS = "tests.csv"


def design_columns(space: DesignSpace) -> list[str]:
    """Names of the parameters with their units, e.g. length_mm and pressure_0_kPa."""
    names = (name.replace("[", "_").replace("]", "") for name in space.names)
    return [f"{name}_{unit}" for name, unit in zip(names, space.units, strict=True)]


def write_episodes(
    folder: Path, scene: Scene, space: DesignSpace, history: History, start: int, stop: int
) -> None:
    """Writes the rows of episodes start to stop: replaces the files if start is 0, else appends.

    Args:
      folder: The run folder.
      scene: The scene, for the objects' names.
      space: The design space.
      history: The run's history.
      start: First episode.
      stop: Episode after the last.
    """
    for name, (head, rows) in _of_episodes(scene, space, history, range(start, stop)).items():
        if start == 0:
            _replace(folder / name, _text([head, *rows]))
        else:
            path = folder / name
            with files.naming(path), path.open("a", newline="", encoding="utf-8") as file:
                file.write(_text(rows))


def write_tests(folder: Path, space: DesignSpace, particles: np.ndarray, test: FinalTest) -> None:
    """Writes the final particles and their test.

    Args:
      folder: The run folder.
      space: The design space.
      particles: Final particles [SI units], shape (particle, parameter).
      test: Their test.
    """
    head, rows = _of_test(space, particles, test)
    _replace(folder / TESTS, _text([head, *rows]))


def mend(
    folder: Path, scene: Scene, space: DesignSpace, record: Record, test: FinalTest | None
) -> list[str]:
    """Makes the files those of a run; returns the names of those that differed.

    A process that was killed between a checkpoint and its rows leaves files without these; others
    were damaged or changed by somebody.

    Args:
      folder: The run folder.
      scene: The scene.
      space: The design space.
      record: The run.
      test: Its final test, or None if it has none yet; its file is deleted then.
    """
    wanted = _of_episodes(scene, space, record.history, range(record.done))
    if test is not None:
        wanted[TESTS] = _of_test(space, np.asarray(record.state.particles), test)
    differing = []
    for name, (head, rows) in wanted.items():
        text = _text([head, *rows])
        if _content(folder / name) != text.encode():
            _replace(folder / name, text)
            differing.append(name)
    if TESTS not in wanted and (folder / TESTS).exists():
        (folder / TESTS).unlink()
        differing.append(TESTS)
    return differing


def episodes_in(folder: Path) -> int:
    """Number of episodes of which the tables in a run folder tell, whatever they hold."""
    content = _content(folder / "episodes.csv") or b""
    return max(content.count(b"\n") - 1, 0)


def noise_values(trials: Trial) -> dict[str, Any]:
    """The noise of trials by the names of its columns in `columns.GRASPS`; of any shape."""
    return {
        "noise_x_m": trials.position[..., 0],
        "noise_y_m": trials.position[..., 1],
        "noise_yaw_rad": trials.yaw,
        "noise_arm_roll_rad": trials.arm_tilt[..., 0],
        "noise_arm_pitch_rad": trials.arm_tilt[..., 1],
        "noise_mass_factor": trials.mass,
        "noise_size_factor": trials.size,
        "noise_friction_factor": trials.friction,
        "noise_stiffness_factor": trials.stiffness,
        "noise_hand_mass_factor": trials.hand_mass,
    }


def write_grasps(path: Path, scene: Scene, trials: Trial, outcomes: Outcome) -> None:
    """Writes a design's trials with their noise and how they ended, a row each.

    Args:
      path: The file; its folder is made.
      scene: The scene that was simulated.
      trials: The trials, arrays with leading axis (trial,).
      outcomes: Their outcomes, arrays of shape (trial,).
    """
    names, noise = [s.name for s in scene.objects.object], noise_values(trials)

    def row(t: int) -> list:
        one = jax.tree.map(lambda v: np.asarray(v)[t], outcomes)
        drawn = [_number(float(v[t])) for v in noise.values()]
        numbers = [_number(float(one.cost)), _number(float(one.lost_time))]
        bad_step = int(one.bad_step)
        ending = [VERDICTS[verdicts(one)], *numbers, status_names(one.status)]
        ending += [bad_step if bad_step >= 0 else "", _told(one.capped), _told(one.residual)]
        return [t, names[int(trials.shape[t])], *drawn, *ending]

    path.parent.mkdir(parents=True, exist_ok=True)
    rows = (row(t) for t in range(len(outcomes.cost)))
    _replace(path, _text([[*MORE[REFERENCE].columns], *rows]))


def describe(space: DesignSpace, design: np.ndarray) -> str:
    """Formats a design [SI units] in the hand file's units, e.g. "length=110 mm arm_z=20 mm"."""
    values = zip(space.names, space.in_units(design), space.units, strict=True)
    return " ".join(f"{name}={value:.4g} {unit}" for name, value, unit in values)


def status_names(status: int) -> str:
    """Names of the status bits that are set, joined by "+", or "OK"."""
    return "+".join(bit.name or "" for bit in Status(int(status))) or "OK"


def failure_counts(status: np.ndarray) -> str:
    """How often each cause of failure occurs, e.g. "SPEED 1, STUCK 3"; empty if none does."""
    return _counts(status, [bit for bit in Status if bit not in WARNINGS])


def warning_counts(status: np.ndarray) -> str:
    """How often each warning occurs, which does not fail a trial, e.g. "SOLVER_CAP 3"."""
    return _counts(status, [*WARNINGS])


def _counts(status: np.ndarray, bits: Iterable[Status]) -> str:
    counts = {bit.name: int(((status & bit) != 0).sum()) for bit in bits}
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count)


def _episodes(history: History, space: DesignSpace, span: range) -> Iterator[list]:
    for e in span:
        best = int(np.argmin(history.cost[e]))
        failed = int(types.failed(history.trials.status[e]).sum())
        size = 1 / (history.weight[e] ** 2).sum()
        costs = [_number(history.cost[e].mean()), _number(history.cost[e, best])]
        yield [e + 1, *costs, failed, _number(size), *_designs(space, history.population[e])[best]]


def _particles(history: History, space: DesignSpace, span: range) -> Iterator[list]:
    for e in span:
        for i, design in enumerate(_designs(space, history.population[e])):
            numbers = [_number(history.cost[e, i]), _number(history.weight[e, i])]
            yield [e + 1, i, *numbers, history.ancestors[e, i], *design]


def _trials(history: History, scene: Scene, span: range) -> Iterator[list]:
    names, trials = [s.name for s in scene.objects.object], history.trials
    for e in span:
        for i, t in np.ndindex(*history.trials.cost.shape[1:]):
            numbers = [_number(trials.cost[e, i, t]), _number(trials.lost_time[e, i, t])]
            status = status_names(trials.status[e, i, t])
            bad_step = int(trials.bad_step[e, i, t])
            row = [e + 1, i, t, names[t % len(names)], *numbers, status]
            solved = (
                _told(v if v is None else v[e, i, t]) for v in (trials.capped, trials.residual)
            )
            yield [*row, bad_step if bad_step >= 0 else "", *solved]


def _told(value: Any) -> str:
    """A number; empty if it is not one, or none was told."""
    return "" if value is None or np.isnan(value) else _number(float(value))


def _designs(space: DesignSpace, population: np.ndarray) -> list[list[str]]:
    return [[_number(v) for v in row] for row in space.in_units(population)]


def _number(value: float) -> str:
    return f"{value:.9g}"


def _of_episodes(
    scene: Scene, space: DesignSpace, history: History, span: range
) -> dict[str, tuple[list[str], Iterable[list]]]:
    """Head and rows of the tables of episodes, by the files' names."""
    designs = design_columns(space)
    rows = {
        "episodes.csv": _episodes(history, space, span),
        "particles.csv": _particles(history, space, span),
        "trials.csv": _trials(history, scene, span),
    }
    return {name: (TABLES[name].head(designs), values) for name, values in rows.items()}


def _of_test(
    space: DesignSpace, particles: np.ndarray, test: FinalTest
) -> tuple[list[str], Iterable[list]]:
    """Head and rows of the table of the final test."""
    failed = types.failed(np.asarray(test.trials.status))
    rows = (
        [i, _number(test.cost[i]), failed.shape[1], failed[i].sum(), int(test.success[i]), *design]
        for i, design in enumerate(_designs(space, particles))
    )
    return TABLES[TESTS].head(design_columns(space)), rows


def _text(rows: Iterable[list]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _replace(path: Path, text: str) -> None:
    with files.atomically(path) as part:
        part.write_bytes(text.encode())


def _content(path: Path) -> bytes | None:
    """A file's bytes; None if there is none."""
    return path.read_bytes() if path.is_file() else None
