"""`codesign export`."""

import dataclasses
import datetime
import importlib.util
import shlex
from itertools import chain
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import files, preflight, provenance, rollout, runs, tolerances
from codesign_jax.commands import common
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Export
from codesign_jax.export import arm, grasps, plain, process, quantities, sheet, tables, valves
from codesign_jax.export.process import Process, Size
from codesign_jax.judge.cases import Case
from codesign_jax.runs import reference
from codesign_jax.runs.progress import Busy
from codesign_jax.scene.objects import Shape
from codesign_jax.scene.schema import InputError, Problem
from codesign_jax.terminal import Console
from codesign_jax.types import Params, Trial


def main(options: Export) -> int:
    common.use_compilation_cache()
    doubts: list[str] = []
    case = find_case(options, tell=doubts.append)
    common.refuse([f"{doubt}. Nothing is exported" for doubt in doubts])
    _check(options, case)
    params = _params(case)
    sizes = [] if options.no_parts and options.no_sheet else _sizes(case, params, options)
    notes = preflight.notes(case.scene, case.space, {"the design": case.design})
    if sizes:
        notes += sheet.idle_fingers(case.scene, params, sizes)
    if case.policy:
        notes.append(f"commands are those of the key frames: policy {case.policy} is left out")
    if options.tolerances != common.OFF and not options.no_sheet:
        case.make_engine()  # refuses the scene before anything is written
    valves.lines(case.scene, params)  # refuses a design of more lines than the hand has
    console = Console()
    if options.run_folder:
        console.print(f"best final design of {options.run_folder}")
    console.print(*runs.describe(case.space, case.design).split("\n"), sep="\n")
    for note in notes:
        console.print(note)
    earlier = (options.out / files.MANIFEST).is_file()
    try:
        about = _origin(options)
        with files.whole_folder(options.out, replace=options.overwrite, facts=about) as folder:
            write_files(case, params, sizes, folder, options, console)
    except OSError as error:
        raise InputError.of("file", f"--out {options.out}: {error.strerror}") from error
    _tell(case, options, console)
    if earlier:
        console.print("  the files of the earlier export there are gone or replaced")
    if others := files.foreign(options.out):
        console.print(f"  left there, no part of this export: {_some(others)}")
    return 0


def _origin(options: Export) -> dict[str, str]:
    """Where the design is from, and the command, as manifest and sheet have them."""
    if options.run_folder:
        settings = runs.read_run(options.run_folder)[1]
        design = f"best final design of the run {options.run_folder}, seed {settings.seed}"
    else:
        design = " ".join(chain.from_iterable(options.design)) or "the default of the hand"
    return {"design": design, "command": shlex.join(["codesign", *options.words])}


def _some(names: list[str], most: int = 8) -> str:
    """Names in a line, the first ones if there are many."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f", and {rest} more" if rest > 0 else "")


def _params(case: Case) -> Params:
    with jax.enable_x64(True):
        exact = case.space.params(jnp.asarray(case.design, float))
    return jax.tree.map(np.asarray, exact)


def _process(options: Export) -> Process:
    return Process(**{f.name: getattr(options, f.name) for f in dataclasses.fields(Process)})


def _sizes(case: Case, params: Params, options: Export) -> list[Size]:
    return process.sizes(case.scene.hand, params, _process(options))


def _check(options: Export, case: Case) -> None:
    problems = common.number_problems(
        ("--trials", options.trials, 0, 10_000),
        ("--seed", options.seed, 0, 2**31 - 1),
        ("--hands", options.hands, 8, 100_000),
    )
    if options.tolerances != common.OFF:
        tolerances.read(options.tolerances)
    out = options.out
    if out.exists() and (not out.is_dir() or any(out.iterdir())) and not options.overwrite:
        problems.append(
            Problem("file", f"--out {out} exists; choose another folder, or give --overwrite")
        )
    elif out.exists() and not out.is_dir():
        problems.append(Problem("file", f"--out {out} is a file"))
    else:
        problems += common.place_problems("--out", out, folder=True)
    problems += process.problems(_process(options)) + _missing(options)
    common.refuse(problems + common.engine_problems(case.engine, options.overrides))


def _missing(options: Export) -> list[str]:
    names = () if options.no_parts else ("manifold3d", "lxml")
    absent = [name for name in names if importlib.util.find_spec(name) is None]
    if not absent:
        return []
    return [
        f"the parts need {' and '.join(absent)}: pip install -e '.[export]' in the checkout, "
        "or give --no-parts"
    ]


def write_files(
    case: Case,
    params: Params,
    sizes: list[Size],
    folder: Path,
    options: Export,
    console: Console,
) -> None:
    """Writes all that is asked for."""
    _models(case, params, folder, options, console)
    nominal = jax.tree.map(np.asarray, rollout.nominal_trial(case.scene))
    commands = arm.write(folder, case.scene, params, nominal)
    valves.write(folder, case.scene, params)
    printed = None if options.no_parts else _parts(case, params, sizes, folder, options, console)
    if not options.no_sheet:
        hand_yield = None
        if options.tolerances != common.OFF:
            hand_yield = common.cast_hands(case, options, tolerances.TRIALS, console)
        with Busy(console, "writing the build sheet"):
            known = hand_yield, printed, arm.speeds(commands)
            lacking = _sheet(case, params, sizes, known, folder, options)
        if lacking:
            console.print(
                f"the PDF writes ? for letters that no font here has: {' '.join(lacking)} "
                "(the text has them)"
            )


def _tell(case: Case, options: Export, console: Console) -> None:
    console.print(f"exported: {options.out}")
    models = sorted((options.out / tables.MODELS).glob("*.mjb"))
    if models:
        player = f"python {grasps.PLAYER.name} {models[0].name}"
        console.print(f"  {tables.MODELS}/: models for plain MuJoCo; there: {player}")
    console.print(
        f"  {arm.COMMANDS}: the path of the arm without the shaking, and pressures; turns: roll "
        "about x, then yaw, then pitch, positive towards +x, as above"
    )
    console.print(f"  {valves.VALVES}: pressures of the key frames for regulators")
    if not options.no_parts:
        console.print("  parts/: fingers, moulds, palm and clamp bars, in millimetres")
    if not options.no_sheet:
        console.print(f"  {sheet.NAME}.md, {sheet.NAME}.pdf: build sheet and its drawings")
        if options.tolerances == common.OFF:
            console.print(
                "  the sheet has no tolerances: --tolerances --overwrite simulates them, "
                f"{(options.hands + 1) * tolerances.TRIALS:,} grasps"
            )


def _parts(
    case: Case,
    params: Params,
    sizes: list[Size],
    folder: Path,
    options: Export,
    console: Console,
) -> process.Printed:
    from codesign_jax.export import meshes, palm  # needs the extra

    folder = folder / meshes.FOLDER
    settings = _process(options)
    folder.mkdir(exist_ok=True)
    with Busy(console, "making fingers, moulds and the palm"):
        built = palm.palm(case.scene, params, sizes, settings)
        parts = [*meshes.write(folder, sizes, settings), *meshes.write_palm(folder, built)]
    for part in parts:
        edges = " x ".join(f"{v:.1f}" for v in part.extents)
        console.print(f"part {part.name}: {edges} mm, {part.volume / 1e3:.1f} cm^3")
    problems = list(built.problems)
    if not any(part.name == "palm" for part in parts):
        problems.append(
            Problem("missing", "its surface does not close, so that no file of it was written")
        )
    for problem in problems:
        console.print(f"note: the palm cannot be built as it is: {problem}")
    if built.flange is None:
        console.print("note: the palm has no room for screws to the wrist")
    for i, size in enumerate(sizes):
        if settings.inlet and not process.inlet(size, settings):
            low = min(size.base.chamber)
            console.print(
                f"finger {i} has no inlet: its chamber of {low:g} mm is narrower than the tube"
            )
    volume = built.body.volume() + sum(bar.volume() for bar in built.bars)
    names = [part.name for part in parts]
    return process.Printed(names, volume, built.flange, built.below, problems)


def _models(case: Case, params: Params, folder: Path, options: Export, console: Console) -> None:
    for difference in plain.differences(case.scene):
        console.print(f"note: {difference} (docs/export.md)")
    folder = folder / tables.MODELS
    folder.mkdir(exist_ok=True)
    trials = _trials(case, options)
    built = (grasps.grasp(case.scene, params, trial) for _, trial in trials)
    with Busy(console, f"simulating {common.counted(len(trials), 'grasp')} in plain MuJoCo"):
        for line in tables.write_grasps(folder, case.scene, trials, built):
            console.print(f"in plain MuJoCo: {line}")


def _trials(case: Case, options: Export) -> list[tuple[str, Trial]]:
    scene = case.scene
    names = tables.names_of([shape.name for shape in scene.objects.object])
    trials = [(name, rollout.nominal_trial(scene, i)) for i, name in enumerate(names)]
    if options.trials:
        noisy = rollout.sample_trials(scene, jax.random.key(options.seed), options.trials)
        for t in range(options.trials):
            trial = jax.tree.map(lambda v, t=t: v[t], noisy)
            trials.append((f"trial_{t:03d}_{names[int(trial.shape)]}", trial))
    return [(name, jax.tree.map(np.asarray, trial)) for name, trial in trials]


def _described(shape: Shape) -> str:
    """An object with its full sizes, mass and friction."""
    sizes = " x ".join(f"{2e3 * half:.0f}" for half in shape.half_sizes if half)
    return f"{shape.name} ({sizes} mm, {1e3 * shape.mass:.0f} g, friction {shape.friction:g})"


def _sheet(
    case: Case,
    params: Params,
    sizes: list[Size],
    known: tuple[tolerances.Yield | None, process.Printed | None, tuple[float, float]],
    folder: Path,
    options: Export,
) -> list[str]:
    """Writes the sheet; returns letters that its drawings lack."""
    from codesign_jax.export import drawing, paper  # import Matplotlib

    kept = reference.Kept(None, None, [])
    if options.run_folder and not options.without:  # another hand than the run's was not judged
        kept = reference.kept(options.run_folder, *runs.read_run(options.run_folder))
    for note in kept.notes:
        common.warn(note)
    hand_yield, printed, speeds = known
    code = provenance.git_state()
    version = provenance.environment()["versions"]["codesign-jax"]  # type: ignore[index]
    commit = f"{code['commit'] or 'unknown'}{' with changes' if code.get('modified') else ''}"
    origin = {
        **_origin(options),
        "objects": [*map(_described, case.scene.objects.object)],
        "version": f"{version}, commit {commit}",
        "notes": kept.notes,
    }
    doubts = [f"the palm: {words}" for words in (printed.problems if printed else ())]
    if arm.spacer(case.scene, params) != 0:
        doubts.append(
            f"an arm's last link of {arm.LAST_LINK:.0f} mm radius right behind the palm would "
            "stand in the table at the lowest key frame, see 'Arm'"
        )
    verdict = None if kept.fresh is None else str(kept.fresh)
    hand = sheet.Hand(case.scene, params, sizes, _process(options), printed)
    tests = sheet.Tests(verdict, kept.stress, kept.worth, hand_yield, doubts)
    sheet.write(folder, hand, tests, origin, speeds)
    title = f"Build sheet: {case.scene.hand.name}"
    material = case.scene.hand.material
    silicone = quantities.silicone_of(material)
    about = paper.About(
        design=str(origin["design"]),
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        version=str(origin["version"]),
        silicone=silicone.name if silicone else f"G {material.shear_modulus / 1e3:.0f} kPa",
        verdict=verdict or "",
        warnings=sheet.warnings(hand, tests),
    )
    parts = case.scene, params, sizes, printed, _process(options)
    return drawing.write(folder, title, *parts, about)
