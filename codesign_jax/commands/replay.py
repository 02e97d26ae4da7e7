"""`codesign replay`: a grasp in 3D, and how a failed world failed."""

import webbrowser
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout, runs
from codesign_jax.commands import common, grasp
from codesign_jax.commands.flags import Replay
from codesign_jax.judge import verdict
from codesign_jax.judge.cases import Case
from codesign_jax.runs import failures, manifest
from codesign_jax.runs.progress import Busy
from codesign_jax.runs.selection import refuse_other_policy
from codesign_jax.scene.parameters import design_space
from codesign_jax.terminal import Console, say
from codesign_jax.types import MEANINGS, Status, Trace

MOST = 10
"""Failed worlds that a list shows."""


def main(options: Replay) -> int:
    common.use_compilation_cache()
    if options.run_folder is not None and options.run_folder.suffix == ".npz":
        return explain(options.run_folder, options.engine, options.policy)
    path = options.out or (options.run_folder or Path()) / "replay.html"
    common.refuse(common.place_problems("--out", path, ".html"))
    planned = grasp.find(options)
    console = Console()
    choices = options.episode, options.particle, options.trial, options.object
    if options.run_folder is not None and choices == (None,) * 4:
        show_failures(options.run_folder)
    write_page(planned, path, console)
    console.print(f"replay: {path} (for any browser, offline)")
    if options.open:
        webbrowser.open(path.resolve().as_uri())
    return 0


def write_page(planned: grasp.PlannedGrasp, path: Path, console: Console) -> Path:
    with Busy(console, "compiling, then simulating the grasp"):
        shown = grasp.simulate(planned, forces=True)
    from codesign_jax.report import viewer

    lines = grasp.description(planned, shown)
    console.print(*"\n".join(lines).split("\n"), sep="\n")
    return viewer.write(planned.case.scene, shown, path, title="A grasp in 3D", text=lines)


def show_failures(folder: Path) -> None:
    """Prints the first failed worlds of a run folder."""
    scene = runs.read_search_scene(folder)
    paths = sorted((folder / failures.FOLDER).glob("*.npz"))
    for path in paths[:MOST]:
        failure = failures.load(path)
        verdict = _verdict(failure.status, failure.bad_step, scene.discretization.timestep)
        say(f"failed world {path}: {verdict}")
    if paths[MOST:]:
        say(f"and {len(paths) - MOST} more in {folder / failures.FOLDER}")


def explain(path: Path, engine: str | None, policy: str | None) -> int:
    """Says how a failed world failed, and what happens when it is simulated again."""
    folder = path.parent.resolve().parent
    manifest.refuse_links(folder)
    failure = failures.load(path)
    settings = runs.read_run(folder)[1]
    scene = runs.read_search_scene(folder)
    refuse_other_policy(settings.policy, policy)
    name = engine or settings.engine
    common.refuse(common.engine_problems(name))
    space = design_space(scene.hand, settings.preset)
    h = scene.discretization.timestep
    say(*runs.describe(space, failure.design).split("\n"))
    say(f"recorded by {settings.engine}: {_verdict(failure.status, failure.bad_step, h)}")
    for bit in Status(failure.status):
        say(f"  {bit.name}: {MEANINGS[bit]}")
    numbers = zip(("--episode", "--particle", "--trial"), failure.place, strict=True)
    flags = " ".join(f"{flag} {number}" for flag, number in numbers)
    say(f"in 3D: codesign replay {path.parent.parent} {flags}")
    world = space.params(jnp.asarray(failure.design)), failure.trial
    simulator = Case(scene, space, failure.design, name, settings.policy).make_engine()
    run = jax.jit(lambda p, t: rollout.simulate(scene, simulator, p, t))
    results = run(*jax.tree.map(lambda v: jnp.asarray(v)[None], world))
    outcome, trace = jax.tree.map(lambda v: np.asarray(v)[0], results)
    bad = int(outcome.bad_step)
    say(f"again in {name}: {_verdict(int(outcome.status), bad, h)}")
    if bad < 0:
        say(f"  cost {outcome.cost:.3f}; at the end: {_where(trace, -1)}")
    for k in range(max(bad - 3, 0), bad + 1):
        say(f"  step {k}: {_where(trace, k)}")
    return 0


def _verdict(status: int, bad_step: int, h: float) -> str:
    when = f", first bad step {bad_step} ({bad_step * h:.2f} s)" if bad_step >= 0 else ""
    return verdict.status_names(status) + when


def _where(trace: Trace, k: int) -> str:
    height = trace.height[k]
    distance = trace.distance[k]
    words = f"object {height:.4f} m above the table, {distance:.4f} m from the hand"
    return f"speed {trace.speed[k]:.4g}, {words}"
