"""`codesign report`."""

from pathlib import Path
from typing import TYPE_CHECKING

import jax

from codesign_jax import runs
from codesign_jax.commands import common, grasp
from codesign_jax.commands.flags import Report, Subject, is_design
from codesign_jax.judge import fresh_trials, verdict
from codesign_jax.judge.cases import Case
from codesign_jax.judge.sentences import Judged
from codesign_jax.report import of_design as design_page
from codesign_jax.report import page
from codesign_jax.report.of_run import Run
from codesign_jax.runs import Settings, directory, reference, selection
from codesign_jax.runs.manifest import read_provenance
from codesign_jax.runs.progress import Busy, Meter
from codesign_jax.runs.record import Record
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import design_space
from codesign_jax.terminal import Console

if TYPE_CHECKING:
    from codesign_jax.report import animation


def main(options: Report) -> int:
    common.use_compilation_cache()
    console = Console()
    path = of_design(options, console) if is_design(options.folder) else of_run(options, console)
    size = path.stat().st_size / 1e6
    console.print(f"report: {path} ({size:.1f} MB, for any browser, offline)")
    return 0


def of_design(options: Report, console: Console) -> Path:
    """Judges a design file by fresh trials, and writes its report."""
    words = ((str(options.folder),),)
    case = common.find_case(Subject(design=words, engine=options.engine, policy=options.policy))
    common.refuse(common.engine_problems(case.engine))
    path = options.out or options.folder.with_suffix(".html")
    common.refuse(common.place_problems("--out", path))
    judged = judge(case, console)
    shown = None
    if not options.no_replay:
        with Busy(console, "compiling, then simulating the grasp"):
            shown = grasp.simulate(grasp.nominal(case), forces=True)
    return design_page.write(case, judged, shown, options.folder, path)


def judge(case: Case, console: Console) -> Judged:
    """The trials that `codesign evaluate` has for a design."""
    with Meter("trials", verdict.USUAL, console) as meter:
        outcomes = fresh_trials.decide(
            case,
            jax.random.key(0),
            verdict.MOST,
            keep=lambda o: reference.show(meter, o, verdict.MOST),
        )
    return Judged(case.scene, outcomes)


def of_run(options: Report, console: Console) -> Path:
    """Writes the report of a run folder."""
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
    shown = None if options.no_replay else best_grasp(scene, settings, record, name, console)
    with Busy(console, "writing the report"):
        page.write(run, shown, path)
    if whole:  # else the tables may be all that is left of what is damaged
        directory.write_tables(options.folder, scene, settings, record)
    return path


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
