"""`codesign landscape`."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import batch, codesign, files, preflight, rollout, runs
from codesign_jax.codesign import Task
from codesign_jax.commands import common, grid
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Landscape as Options
from codesign_jax.commands.grid import Axis
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine
from codesign_jax.judge import verdict
from codesign_jax.judge.cases import Case
from codesign_jax.report import landscape
from codesign_jax.report.landscape import Landscape
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.runs.progress import Meter
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome, Trial, failed


class Plane(NamedTuple):
    """Designs and scenes over a grid."""

    axes: tuple[Axis, Axis]
    # The designs [SI units], shape (n * m, parameter), the first axis slowest
    designs: np.ndarray
    # Numbers of each one's scene, shape (n * m, leaf); None if all have the same
    numbers: np.ndarray | None


def main(options: Options) -> int:
    common.use_compilation_cache()
    case = find_case(options)
    _check(options, case)
    pair = grid.axes(case, options)
    folder = _folder(options, case, pair)
    plane = make_plane(case, pair)
    console = Console()
    if case.space.num_parameters > sum(axis.column is not None for axis in pair):
        console.print(*runs.describe(case.space, case.design, "around").split("\n"), sep="\n")
    for note in preflight.notes(case.scene, case.space, {"the design": case.design}):
        console.print(note)
    size = batch.size(len(plane.designs), options.trials)
    count = common.counted(-(-len(plane.designs) // size), "call")
    console.print(f"grasps: {len(plane.designs) * options.trials} in {count}")
    if options.dry_run:
        return 0
    simulated = simulate_designs(case, plane, size, options, console)
    result = summarize(case, plane, simulated, options.seed)
    print_summary(case, result, console)
    write_files(result, folder, console)
    return 0


def _folder(options: Options, case: Case, pair: tuple[Axis, Axis]) -> Path:
    run_folder = options.run_folder
    folder = Path("landscape")
    of_designs = all(axis.column is not None for axis in pair)
    if run_folder is not None and of_designs and case.scene == runs.read_run(run_folder)[0]:
        folder = run_folder
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


def make_plane(case: Case, pair: tuple[Axis, Axis]) -> Plane:
    """A regular grid over two axes, ends included.

    Pressures are lowered under the limit that the walls set (Table I); limits of the scene hold for
    searches alone.
    """
    space = case.space
    values = np.meshgrid(*(axis.values for axis in pair), indexing="ij")
    designs = np.tile(np.asarray(case.design, np.float32), (values[0].size, 1))
    for axis, coordinates in zip(pair, values, strict=True):
        if axis.column is not None:
            designs[:, axis.column] = coordinates.ravel() * space.scale[axis.column]
    projected = jax.jit(jax.vmap(space.of_table.project))(designs)
    return Plane(pair, np.asarray(projected), grid.numbers(case.scene, pair))


def simulate_designs(
    case: Case, plane: Plane, size: int, options: Options, console: Console
) -> Outcome:
    """Outcomes, arrays of shape (point, trial); all points meet trials of the same key."""
    key = jax.random.key(options.seed)
    count = options.trials
    with Meter("landscape", len(plane.designs) * count, console) as meter:
        if plane.numbers is None:
            task = Task(case.scene, case.space, count, case.make_engine())
            return batch.evaluate(task, key, plane.designs, size, meter.advance)
        return _in_scenes(case, plane.designs, plane.numbers, (key, count), size, meter.advance)


def _in_scenes(
    case: Case,
    designs: np.ndarray,
    numbers: np.ndarray,
    noise: tuple[jax.Array, int],
    size: int,
    advance: Callable[[int], None],
) -> Outcome:
    """Like `simulate_designs`, with a scene for each point; one program simulates all."""
    key, count = noise
    base, tree = jax.tree.flatten(case.scene)
    varied = (numbers != numbers[0]).any(0)
    run = SceneProgram(case.scene, _worlds(case.make_engine(), case.space, count))

    def scene_of(rows: np.ndarray | int) -> Scene:
        leaves = [numbers[rows, k] if varied[k] else value for k, value in enumerate(base)]
        return jax.tree.unflatten(tree, leaves)

    def call(rows: np.ndarray) -> Outcome:
        drawn = [rollout.sample_trials(scene_of(row), key, count) for row in rows]
        trials = jax.tree.map(lambda *v: jnp.concatenate(v), *drawn)
        every = np.repeat(rows, count)
        repeated_designs = jnp.asarray(designs[every], jnp.float32)
        return rollout.grid(run(repeated_designs, trials, scene_of(every)), (len(rows), count))

    outcomes = []
    for outcome in batch.in_chunks(call, len(designs), size):
        outcomes.append(outcome)
        advance(outcome.cost.size)
    return jax.tree.map(lambda *v: np.concatenate(v), *outcomes)


@shared
def _worlds(engine: Engine, space: DesignSpace, num_trials: int) -> Callable:
    def simulated(designs: jax.Array, trials: Trial, scene: Scene) -> Outcome:
        assert designs.shape[0] % num_trials == 0
        return rollout.simulate(scene, engine, jax.vmap(space.params)(designs), trials)[0]

    return simulated


def summarize(case: Case, plane: Plane, outcomes: Outcome, seed: int) -> Landscape:
    """The landscape of a grid's outcomes, arrays of shape (design, trial), in trials of a seed."""
    shape = tuple(len(axis.values) for axis in plane.axes)
    counted = ~failed(outcomes.status)
    kept = verdict.kept(outcomes)
    return Landscape(
        names=np.array([axis.name for axis in plane.axes]),
        units=np.array([axis.unit for axis in plane.axes]),
        first=plane.axes[0].values,
        second=plane.axes[1].values,
        cost=np.asarray(particle_cost(case.scene, outcomes)).reshape(shape),
        kept=kept.sum(1).reshape(shape),
        counted=counted.sum(1).reshape(shape),
        trials=np.array(outcomes.cost.shape[1]),
        seed=np.array(seed),
        design=np.asarray(case.design),
    )


def print_summary(case: Case, result: Landscape, console: Console) -> None:
    """Prints the number of good designs, the best one, and failed trials."""
    i, j = np.unravel_index(int(result.cost.argmin()), result.cost.shape)
    good = int((result.cost < codesign.SUCCESS_COST).sum())
    point = " ".join(
        f"{name}={value:.4g} {unit}".rstrip()
        for name, value, unit in zip(
            result.names, (result.first[i], result.second[j]), result.units, strict=True
        )
    )
    console.print(
        f"{good} of {result.cost.size} points have a mean cost below {codesign.SUCCESS_COST}; "
        f"lowest: {result.cost[i, j]:.4f} at {point}"
    )
    best = float((result.kept / result.trials).max())
    console.print(
        f"kept: {result.kept.sum()} of {result.kept.size * int(result.trials)}; most of a "
        f"point: {100 * best:.0f} %"
    )
    bad = int((int(result.trials) - result.counted).sum())
    if bad:
        console.print(f"{bad} of {result.cost.size * int(result.trials)} trials failed")


def write_files(result: Landscape, folder: Path, console: Console) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for path in landscape.save(result, folder):
        console.print(f"landscape: {path}")
    from codesign_jax.report import figures

    path = folder / "figures" / "landscape.png"
    with files.naming(path):
        figures.save(figures.landscape(result), path)
    console.print(f"figure: {path}")
