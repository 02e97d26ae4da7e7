"""`codesign report`."""

from typing import TYPE_CHECKING

from codesign_jax import runs
from codesign_jax.commands import common, grasp
from codesign_jax.commands.flags import Report
from codesign_jax.judge.cases import Case
from codesign_jax.report import page
from codesign_jax.report.of_run import Run
from codesign_jax.runs import Settings, directory, reference, selection
from codesign_jax.runs.manifest import read_provenance
from codesign_jax.runs.progress import Busy
from codesign_jax.runs.record import Record
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import design_space
from codesign_jax.terminal import Console

if TYPE_CHECKING:
    from codesign_jax.report import animation


def main(options: Report) -> int:
    common.use_compilation_cache()
    scene, settings = runs.read_run(options.folder)
    if not options.no_replay:
        selection.refuse_other_policy(settings.policy, options.policy)
    name = options.engine or settings.engine
    common.refuse(common.engine_problems(name))
    path = options.out or options.folder / "report.html"
    common.refuse(common.place_problems("--out", path))
    notes: list[str] = []
    record = selection.read_record(options.folder, tell=notes.append)
    whole = not notes
    chosen = selection.choose(scene, record)
    notes += [text for text in [selection.doubt(chosen)] if text]
    kept = reference.kept(options.folder, scene, settings)
    notes += kept.notes
    for note in notes:
        common.warn(note)
    provenance = read_provenance(options.folder)
    run = Run(
        options.folder,
        scene,
        settings,
        record,
        chosen,
        provenance,
        kept.fresh,
        tuple(notes),
        kept.stress,
        kept.worth,
    )
    console = Console()
    shown = None if options.no_replay else best_grasp(scene, settings, record, name, console)
    with Busy(console, "writing the report"):
        page.write(run, shown, path)
    if whole:  # else the tables may be all that is left of what is damaged
        directory.write_tables(options.folder, scene, settings, record)
    size = path.stat().st_size / 1e6
    console.print(f"report: {path} ({size:.1f} MB, for any browser, offline)")
    return 0


def best_grasp(
    scene: Scene, settings: Settings, record: Record, engine: str, console: Console
) -> "tuple[selection.Grasp, animation.Replay]":
    """The best grasp of the chosen design, simulated again to see how it moves."""
    planned = selection.find_grasp(scene, record)
    space = design_space(scene.hand, settings.preset)
    case = Case(scene, space, planned.design, engine, settings.policy)
    with Busy(console, "compiling, then simulating the best grasp again"):
        return planned, grasp.simulate(
            grasp.PlannedGrasp(case, planned.trial, "", None), forces=True
        )
