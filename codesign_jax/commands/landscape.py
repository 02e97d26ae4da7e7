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
from codesign_jax.model import morphology
from codesign_jax.report import landscape
from codesign_jax.report.landscape import Landscape
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.runs.progress import Meter
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, params_of
from codesign_jax.scene.schema import InputError
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome, Trial, failed

PARTICLES = 12
"""Designs of an episode of a point's search [chosen]: about what CMA-ES has for 15 parameters."""
STREAM_SEARCH = 0x70656172
"""Stream of the searches at points and of their trials ("pear")."""


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
    if options.search and case.space.num_parameters == sum(a.column is not None for a in pair):
        raise InputError.of(
            "missing", "--search: no other parameter is free; --preset names a space with more"
        )
    folder = _folder(options, case, pair)
    plane = make_plane(case, pair)
    console = Console()
    if case.space.num_parameters > sum(axis.column is not None for axis in pair):
        console.print(*runs.describe(case.space, case.design, "around").split("\n"), sep="\n")
    for note in preflight.notes(case.scene, case.space, {"the design": case.design}):
        console.print(note)
    points = len(plane.designs)
    # Searches and the points' own trials are calls of one size, so that there is one program.
    size = batch.size(points * (PARTICLES if options.search else 1), options.trials)
    calls = -(-points // size) + options.search * -(-points * PARTICLES // size)
    grasps = points * options.trials * (1 + options.search * PARTICLES)
    console.print(f"grasps: {grasps} in {common.counted(calls, 'call')}")
    if options.dry_run:
        return 0
    simulate = Simulation(case, options.trials, size)
    if options.search:
        plane = search(case, plane, simulate, options, console)
    simulated = simulate_points(plane, simulate, options, console)
    result = summarize(case, plane, simulated, options)
    print_summary(case, result, console)
    write_files(case, result, folder, console)
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
        ("--search", options.search, 0, 1000),
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


class Simulation(NamedTuple):
    """Simulates designs in calls of one size."""

    case: Case
    trials: int  # of each design
    size: int  # designs of a call

    def __call__(
        self,
        designs: np.ndarray,
        numbers: np.ndarray | None,
        key: jax.Array,
        advance: Callable[[int], None],
    ) -> Outcome:
        """Outcomes, arrays of shape (design, trial); all designs meet trials of the same key.

        Args:
          designs: The designs [SI units], shape (design, parameter).
          numbers: Numbers of each one's scene, shape (design, leaf); None for those of the case.
          advance: Is told the worlds of each call.
        """
        if numbers is None:
            case = self.case
            task = Task(case.scene, case.space, self.trials, case.make_engine())
            return batch.evaluate(task, key, designs, self.size, advance)
        return _in_scenes(self, designs, numbers, key, advance)


def simulate_points(
    plane: Plane, simulate: Simulation, options: Options, console: Console
) -> Outcome:
    """Outcomes of the points' designs, arrays of shape (point, trial)."""
    key = jax.random.key(options.seed)
    with Meter("landscape", len(plane.designs) * options.trials, console) as meter:
        return simulate(plane.designs, plane.numbers, key, meter.advance)


def search(
    case: Case, plane: Plane, simulate: Simulation, options: Options, console: Console
) -> Plane:
    """The plane with designs whose other parameters a search at each point chose.

    All searches run side by side in calls of the same program, in trials that do not judge.
    """
    space = case.space
    mask = np.ones(space.num_parameters, bool)
    mask[[axis.column for axis in plane.axes if axis.column is not None]] = False
    points = len(plane.designs)
    optimizer = codesign.make_optimizer("cma-es", space)
    root = codesign.stream_key(jax.random.key(options.seed), STREAM_SEARCH)
    keys = jax.random.split(root, points)
    state = jax.jit(jax.vmap(lambda key, design: optimizer.init(key, design, PARTICLES)))(
        keys, plane.designs
    )
    ask = jax.jit(jax.vmap(lambda state: optimizer.ask(state, mask)))
    tell = jax.jit(jax.vmap(lambda state, every, cost: optimizer.tell(state, every, cost, mask)[0]))
    numbers = None if plane.numbers is None else np.repeat(plane.numbers, PARTICLES, axis=0)
    grasps = options.search * points * PARTICLES * options.trials
    with Meter("searches", grasps, console, later=points * options.trials) as meter:
        for _ in range(options.search):
            population = ask(state)
            rows = np.asarray(population).reshape(-1, space.num_parameters)
            outcomes = simulate(rows, numbers, root, meter.advance)
            cost = particle_cost(case.scene, outcomes).reshape(points, PARTICLES)
            state = tell(state, population, cost)
    return plane._replace(designs=np.asarray(state.particles[:, 0]))


def _in_scenes(
    simulation: Simulation,
    designs: np.ndarray,
    numbers: np.ndarray,
    key: jax.Array,
    advance: Callable[[int], None],
) -> Outcome:
    """Like `Simulation`, with a scene for each design; one program simulates all."""
    case, count, size = simulation
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

    return jax.jit(simulated)  # thousands of grasps


def summarize(case: Case, plane: Plane, outcomes: Outcome, options: Options) -> Landscape:
    """The landscape of a grid's outcomes, arrays of shape (design, trial)."""
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
        seed=np.array(options.seed),
        design=np.asarray(case.design),
        air=_air(case, plane).reshape(shape),
        designs=plane.designs.reshape(*shape, -1),
        search=np.array(options.search),
    )


def _air(case: Case, plane: Plane) -> np.ndarray:
    """Air in all unloaded chambers [cm^3], shape (point,)."""
    hands = jax.tree.map(np.asarray, params_of(case.space, jnp.asarray(plane.designs)))
    if plane.numbers is None:
        return morphology.air(case.scene.hand, hands)
    tree = jax.tree.structure(case.scene)
    scenes = [jax.tree.unflatten(tree, row) for row in plane.numbers]
    each = [jax.tree.map(lambda v, k=k: v[k], hands) for k in range(len(scenes))]
    return np.array([morphology.air(s.hand, hand) for s, hand in zip(scenes, each, strict=True)])


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
    console.print(f"air in all unloaded chambers there: {result.air[i, j]:.1f} cm³")
    if result.search:
        words = runs.describe(case.space, result.designs[i, j], "found there")
        console.print(*words.split("\n"), sep="\n")
    best = float((result.kept / result.trials).max())
    console.print(
        f"kept: {result.kept.sum()} of {result.kept.size * int(result.trials)}; most of a "
        f"point: {100 * best:.0f} %"
    )
    bad = int((int(result.trials) - result.counted).sum())
    if bad:
        console.print(f"{bad} of {result.cost.size * int(result.trials)} trials failed")


def write_files(case: Case, result: Landscape, folder: Path, console: Console) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for path in landscape.save(result, folder, case.space):
        console.print(f"landscape: {path}")
    from codesign_jax.report import figures

    path = folder / "figures" / "landscape.png"
    with files.naming(path):
        figures.save(figures.landscape(result), path)
    console.print(f"figure: {path}")
