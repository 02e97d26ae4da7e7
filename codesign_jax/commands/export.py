"""`codesign export`."""

from collections.abc import Iterator
from itertools import chain
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from codesign_jax import rollout, runs, schema
from codesign_jax.commands import common
from codesign_jax.commands.case import Case, find_case
from codesign_jax.export import grasps, plain, tables
from codesign_jax.schema import SceneError
from codesign_jax.types import Params, Trial

if TYPE_CHECKING:
    from codesign_jax.cli import Export


def main(options: "Export") -> int:
    """Runs the command and returns the exit status.

    Raises:
      SceneError: If something is wrong with the input; nothing is written then.
    """
    common.use_compilation_cache()
    case = find_case(options)
    _check(options, case)
    notes = common.preflight_notes(case.scene, case.space, {"the design": case.design})
    console = Console(highlight=False, soft_wrap=True)
    if options.run_folder:
        console.print(f"best final design of {options.run_folder}", markup=False)
    console.print(f"design: {runs.describe(case.space, case.design)}", markup=False)
    for note in notes:
        console.print(note, markup=False)
    _write(case, options, console)
    return 0


def _check(options: "Export", case: Case) -> None:
    problems = []
    for name, value, high in (
        ("trials", options.trials, 10_000),
        ("seed", options.seed, 2**31 - 1),
    ):
        problem = schema.range_problem(f"--{name}", value, "", 0, high)
        problems += [problem] if problem else []
    out = options.out
    if out.exists() and (not out.is_dir() or any(out.iterdir())) and not options.overwrite:
        problems.append(f"--out {out} exists; choose another folder, or give --overwrite")
    elif out.exists() and not out.is_dir():
        problems.append(f"--out {out} is a file")
    problems += common.solver_problems([*chain.from_iterable(options.overrides)], case.engine)
    if problems:
        raise SceneError(problems)


def _write(case: Case, options: "Export", console: Console) -> None:
    """Writes all that is asked for."""
    with jax.enable_x64(True):
        exact = case.space.params(jnp.asarray(case.design, float))
    params = jax.tree.map(np.asarray, exact)
    options.out.mkdir(parents=True, exist_ok=True)
    _models(case, params, options, console)
    nominal = jax.tree.map(np.asarray, rollout.nominal_trial(case.scene))
    schedule = grasps.schedule(case.scene, params, nominal)
    path = tables.write_commands(options.out, case.scene, schedule)
    console.print(f"commands of arm and valves: {path}", markup=False)


def _models(case: Case, params: Params, options: "Export", console: Console) -> None:
    if found := plain.obstacles(case.scene):
        for text in found:
            console.print(f"no model: plain MuJoCo does not simulate {text}", markup=False)
        return
    folder = options.out / tables.MODELS
    folder.mkdir(exist_ok=True)
    trials = _trials(case, options)
    built = _built(case, params, trials)
    for line in tables.write_grasps(folder, case.scene, trials, built):
        console.print(f"in plain MuJoCo: {line}", markup=False)
    console.print(
        f"models: {folder}; there: python {grasps.PLAYER.name} {trials[0][0]}.mjb", markup=False
    )


def _built(case: Case, params: Params, trials: list[tuple[str, Trial]]) -> Iterator[grasps.Grasp]:
    for _, trial in trials:
        yield grasps.grasp(case.scene, params, trial)


def _trials(case: Case, options: "Export") -> list[tuple[str, Trial]]:
    """A trial without noise for each object, and as many with noise as asked for."""
    scene = case.scene
    names = tables.names_of([shape.name for shape in scene.objects.object])
    found = [(name, rollout.nominal_trial(scene, i)) for i, name in enumerate(names)]
    if options.trials:
        noisy = rollout.sample_trials(scene, jax.random.key(options.seed), options.trials)
        for t in range(options.trials):
            trial = jax.tree.map(lambda v, t=t: v[t], noisy)
            found.append((f"trial_{t:03d}_{names[int(trial.shape)]}", trial))
    return [(name, jax.tree.map(np.asarray, trial)) for name, trial in found]
