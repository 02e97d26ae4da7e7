"""`codesign landscape`."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from codesign_jax import batch, codesign, files, preflight, runs
from codesign_jax.codesign import Task
from codesign_jax.commands import common
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Landscape as Options
from codesign_jax.cost import particle_cost
from codesign_jax.report import landscape
from codesign_jax.report.landscape import Landscape
from codesign_jax.runs.choice import Case
from codesign_jax.runs.progress import Meter
from codesign_jax.scene import schema
from codesign_jax.scene.schema import InputError
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome, failed


class Plane(NamedTuple):
    """Designs over a grid of two parameters."""

    columns: tuple[int, int]  # indices of the two parameters, shape (2,)
    axes: tuple[np.ndarray, np.ndarray]  # their values [SI units], shapes (n,) and (m,)
    # The designs [SI units], shape (n * m, parameter), the first parameter slowest
    designs: np.ndarray


def main(options: Options) -> int:
    common.use_compilation_cache()
    case = find_case(options)
    _check(options, case)
    folder = _folder(options, case)
    made = make_plane(case, _columns(case, options.parameters), options.points)
    console = Console()
    others = [k for k in range(case.space.num_parameters) if k not in made.columns]
    if others:
        console.print(*runs.describe(case.space, case.design, "around").split("\n"), sep="\n")
    for note in preflight.notes(case.scene, case.space, {"the design": case.design}):
        console.print(note)
    size = batch.size(len(made.designs), options.trials)
    count = common.counted(-(-len(made.designs) // size), "call")
    console.print(f"grasps: {len(made.designs) * options.trials} in {count}")
    if options.dry_run:
        return 0
    simulated = simulated_designs(case, made.designs, size, options, console)
    found = summarize(case, made, simulated, options.seed)
    print_summary(case, found, console)
    write_files(found, folder, console)
    return 0


def _folder(options: Options, case: Case) -> Path:
    own = options.run_folder
    folder = Path("landscape")
    if own is not None and case.scene == runs.read_run(own)[0]:
        folder = own
    if options.out is not None:
        folder = options.out
    common.refuse(common.place_problems("--out", folder, folder=True))
    return folder


def _check(options: Options, case: Case) -> None:
    problems = common.number_problems(
        ("--points", options.points, 2, 1000),
        ("--trials", options.trials, 1, 100_000),
        ("--seed", options.seed, 0, 2**31 - 1),
    )
    common.refuse(problems + common.engine_problems(case.engine, options.overrides))


def _columns(case: Case, names: tuple[str, ...]) -> tuple[int, int]:
    known = case.space.names
    chosen = names or (known if len(known) == 2 else ())
    unknown = [name for name in chosen if name not in known]
    common.refuse(
        [f"--parameters {name!r} is not a parameter; {_meant(name, known)}" for name in unknown]
    )
    if len(set(chosen)) != 2 or len(chosen) != 2:
        raise InputError([f"--parameters must name two of {', '.join(known)}"])
    return known.index(chosen[0]), known.index(chosen[1])


def _meant(name: str, known: tuple[str, ...]) -> str:
    fingers = [n for n in known if n.split("[")[0] == name]
    if fingers:
        return f"there is one for each finger: {fingers[0]} to {fingers[-1]}"
    return schema.nearest(name, known)


def make_plane(case: Case, columns: tuple[int, int], points: int) -> Plane:
    """A regular grid over the ranges of two parameters, ends included.

    Pressures are lowered under the limit that the walls set, as of every particle.
    """
    space = case.space
    axes = [np.linspace(space.low[k], space.high[k], points) for k in columns]
    first, second = np.meshgrid(*axes, indexing="ij")
    designs = np.tile(np.asarray(case.design, np.float32), (first.size, 1))
    designs[:, columns[0]], designs[:, columns[1]] = first.ravel(), second.ravel()
    projected = jax.jit(jax.vmap(space.project))(designs)
    return Plane(columns, (axes[0], axes[1]), np.asarray(projected))


def simulated_designs(
    case: Case, designs: np.ndarray, size: int, options: Options, console: Console
) -> Outcome:
    task = Task(case.scene, case.space, options.trials, case.make_engine())
    with Meter("landscape", len(designs) * options.trials, console) as meter:
        return batch.evaluate(task, jax.random.key(options.seed), designs, size, meter.advance)


def summarize(case: Case, made: Plane, found: Outcome, seed: int) -> Landscape:
    """The landscape of a grid's outcomes, arrays of shape (design, trial), in trials of a seed."""
    space, shape = case.space, tuple(len(axis) for axis in made.axes)
    counted = ~failed(found.status)
    kept = codesign.verdicts(found) == codesign.VERDICTS.index("kept")
    scale = np.asarray(space.scale)[[*made.columns]]
    return Landscape(
        names=np.array([space.names[k] for k in made.columns]),
        units=np.array([space.units[k] for k in made.columns]),
        first=made.axes[0] / scale[0],
        second=made.axes[1] / scale[1],
        cost=np.asarray(particle_cost(case.scene, found)).reshape(shape),
        kept=kept.sum(1).reshape(shape),
        counted=counted.sum(1).reshape(shape),
        trials=np.array(found.cost.shape[1]),
        seed=np.array(seed),
        design=np.asarray(case.design),
    )


def print_summary(case: Case, found: Landscape, console: Console) -> None:
    """Prints the number of good designs, the best one, and failed trials."""
    i, j = np.unravel_index(int(found.cost.argmin()), found.cost.shape)
    good = int((found.cost < codesign.SUCCESS_COST).sum())
    place = " ".join(
        f"{name}={value:.4g} {unit}"
        for name, value, unit in zip(
            found.names, (found.first[i], found.second[j]), found.units, strict=True
        )
    )
    console.print(
        f"{good} of {found.cost.size} points have a mean cost below {codesign.SUCCESS_COST}; "
        f"lowest: {found.cost[i, j]:.4f} at {place}"
    )
    bad = int((int(found.trials) - found.counted).sum())
    if bad:
        console.print(f"{bad} of {found.cost.size * int(found.trials)} trials failed")


def write_files(found: Landscape, folder: Path, console: Console) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for path in landscape.save(found, folder):
        console.print(f"landscape: {path}")
    from codesign_jax.report import figures

    path = folder / "figures" / "landscape.png"
    with files.naming(path):
        figures.save(figures.landscape(found), path)
    console.print(f"figure: {path}")
