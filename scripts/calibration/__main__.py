"""Which of the constants that the paper leaves open give the paper's figures: history matching.

python -m scripts.calibration wave first --size gpu                   # again to resume
python -m scripts.calibration score first
python -m scripts.calibration wave second --seed 1 --after runs/calibration/first_scores.npz
python -m scripts.calibration wave check --like runs/calibration/first_scores.npz --best 60 \
    --others 60 --fingers                                           # sets of an earlier wave
python -m scripts.calibration compare first check                     # do they rank sets alike?
python -m scripts.calibration report --data docs/data/calibration --page docs/notes/calibration.md

A wave simulates a coarse landscape of the 2D experiment for each set of constants, all sets with
one compiled program; the skinned hull without contact between fingers unless --surface or --fingers
say otherwise.  `score` runs the particle filter on the landscapes and compares with the paper's
text.
Stopped by Ctrl-C or `timeout -s INT 400`, it writes what is done, and the same command resumes.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from codesign_jax import codesign, scene
from codesign_jax.archives import Store
from codesign_jax.batch import LIMIT
from codesign_jax.commands import common
from codesign_jax.engines import make_engine
from codesign_jax.scene import keypaths, parameters
from codesign_jax.scene.schema import InputError
from scripts.calibration import files, score
from scripts.calibration.surrogate import Plan
from scripts.calibration.wave import Size, Wave, keep
from scripts.experiments import results
from scripts.shared import provenance, sets

SCENE, PRESET = "paper", "2d"
# Sets, grid points along a side, trials, most worlds of a call, and what changes in the scene.
SIZES = {
    "gpu": (2048, 12, 6, LIMIT, {}),
    "cpu": (64, 10, 3, 600, {"discretization.links": 5}),
    "tiny": (4, 3, 3, 54, {"discretization.links": 2}),
}


def parse() -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    wave = commands.add_parser("wave", help="simulate landscapes of sets of constants")
    wave.add_argument("name")
    wave.add_argument("--size", choices=list(SIZES), default="cpu")
    wave.add_argument("--sets", type=int, help="number of sets; by default the size's")
    wave.add_argument("--points", type=int, help="grid points along a side")
    wave.add_argument("--trials", type=int, help="trials of a point")
    wave.add_argument("--chunk", type=int, help="most worlds of a call")
    wave.add_argument("--surface", choices=["hull", "spheres"], default="hull")
    wave.add_argument("--fingers", action="store_true", help="with contact between fingers")
    wave.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    wave.add_argument("--after", type=Path, nargs="+", metavar="SCORES", help="earlier waves")
    wave.add_argument("--keep", type=int, default=40, help="sets to go on from at the least")
    wave.add_argument(
        "--like", type=Path, metavar="SCORES", help="take the first --sets sets of this wave"
    )
    wave.add_argument(
        "--best", type=int, help="with --like: only the best of its first --sets sets"
    )
    wave.add_argument(
        "--others", type=int, help="with --best: as many of the rest, evenly over their ranks"
    )
    wave.add_argument("--seed", type=int, default=0)
    wave.add_argument("--fresh", action="store_true", help="delete an earlier state")
    scores = commands.add_parser("score", help="compare landscapes with the paper's text")
    scores.add_argument("name", nargs="+")
    scores.add_argument("--runs", type=int, default=30, help="surrogate runs of a strategy")
    compare = commands.add_parser("compare", help="rank the sets of two waves against each other")
    compare.add_argument("name", nargs=2)
    for sub in (wave, scores, compare):
        sub.add_argument("--out", type=Path, default=Path("runs/calibration"), help="folder")
        provenance.add_commit(sub)
    report = commands.add_parser("report", help="figures and page")
    report.add_argument("--data", type=Path, default=Path("docs/data/calibration"))
    report.add_argument("--figures", type=Path, default=Path("docs/figures"))
    report.add_argument("--page", type=Path)
    report.add_argument("--experiments", type=Path, help="those of the default scene, beside them")
    return parser.parse_args()


def chosen_sets(args: argparse.Namespace, count: int) -> tuple[np.ndarray, str]:
    """The sets of a wave in the unit cube, and where they come from."""
    if args.after and args.like:
        raise InputError(["--after and --like exclude each other"])
    if args.best and not args.like:
        raise InputError(["--best needs --like"])
    if args.others and not args.best:
        raise InputError(["--others needs --best"])
    if args.like:
        [earlier] = files.read_scores([args.like])
        units = earlier.data["units"][: args.sets]
        if args.best:
            distances = earlier.data["distances"][: args.sets]
            units = units[score.best_and_others(distances, args.best, args.others or 0)]
        return units, f"{len(units)} sets of {earlier.name}"
    if args.after:
        return files.next_sets(files.read_scores(args.after), count, args.seed, args.keep)
    return sets.space_filling(count, args.seed), "a space-filling design"


def build(args: argparse.Namespace) -> tuple[Wave, dict[str, object]]:
    """Returns a wave and the settings that its state must belong to."""
    count, points, trials, chunk, overrides = SIZES[args.size]
    size = Size(args.points or points, args.trials or trials, args.chunk or chunk)
    for name, value in (("--sets", args.sets), ("--points", args.points)):
        if value is not None and value < 2:
            raise InputError([f"{name} {value} must be at least 2"])
    effects = {"effects.surface": args.surface, "effects.finger_finger": args.fingers}
    changes = keypaths.flatten({**overrides, **effects}) | keypaths.parse(args.set)
    the_scene = scene.load(SCENE, overrides=changes)
    units, text = chosen_sets(args, args.sets or count)
    effects = the_scene.effects
    fidelity = f"{effects.surface}, {the_scene.discretization.links} links"
    fidelity += ", contact between fingers" if effects.finger_finger else ""
    fidelity += ", contact with the palm" if effects.finger_palm else ""
    print(f"{len(units)} sets: {text}; {fidelity}", flush=True)
    try:
        wave = Wave(
            the_scene,
            make_engine("structured", the_scene),
            parameters.design_space(the_scene.hand, PRESET),
            units,
            size,
            seed=args.seed,
        )
    except ValueError as error:
        raise InputError([str(error)]) from error
    print(f"{size.worlds:,} grasps a set, {size.sets} set(s) a call, {wave.steps} call(s)")
    return wave, files.settings(the_scene, size, units, args.seed, fidelity)


def simulate(args: argparse.Namespace) -> int:
    """Runs or resumes a wave and writes the sets that are done."""
    common.use_compilation_cache()
    wave, settings = build(args)
    state, path = (args.out / f"{args.name}.{suffix}" for suffix in ("part", "json"))
    if args.fresh:
        state.unlink(missing_ok=True)
        path.unlink(missing_ok=True)
    store, start, grasps, stopped = (
        Store(state, json.dumps(settings)),
        time.perf_counter(),
        0,
        False,
    )
    if store.refused:
        raise InputError([f"{state} {store.refused}: delete it by --fresh to start anew"])
    try:
        grasps = wave.run(store, lambda text: print(text, flush=True))
    except KeyboardInterrupt:
        stopped = True
    seconds = time.perf_counter() - start
    before = json.loads(path.read_text()) if path.exists() else {}
    if store.found:
        kept = keep(wave, store.found)
        notes = provenance.results(args.commit) | {
            "settings": settings,
            "sets_done": len(kept["units"]),
            "wall_seconds": round(before.get("wall_seconds", 0.0) + seconds, 1),
            "processes": before.get("processes", 0) + 1,
            "grasps_per_s": round(grasps / seconds, 1),
        }
        for written in results.write(args.out, args.name, kept, notes):
            print(written)
    if stopped:
        print(f"stopped; the same command resumes from {state}")
        return 130
    return 0


def score_waves(args: argparse.Namespace) -> int:
    """Writes NAME_scores.npz of each wave."""
    common.use_compilation_cache()
    the_scene = scene.load(SCENE)
    space = parameters.design_space(the_scene.hand, PRESET)
    plan = Plan(runs=args.runs, shapes=len(the_scene.objects.object))
    for name in args.name:
        kept, notes = files.read(args.out / f"{name}.npz")
        optimizer = codesign.make_filter(space)
        data = files.score_wave(kept, optimizer, space.is_morphology, plan)
        made = {"wave": notes, "scores": provenance.results(args.commit) | {"plan": plan._asdict()}}
        for path in results.write(args.out, name + files.SCORES, data, made):
            print(path)
        print(_left(data))
    return 0


def _left(data: dict[str, np.ndarray]) -> str:
    """How many sets each target rules out, and how many are left."""
    out = (data["distances"] > sets.CUTOFF).sum(0)
    lines = [f"{t.name}: rules out {n}" for t, n in zip(score.TARGETS, out, strict=True)]
    left = int(sets.plausible(data["distances"]).sum())
    return "\n".join([*lines, f"{left} of {len(data['units'])} sets are left"])


def compare(args: argparse.Namespace) -> int:
    """Prints rank correlations between two waves of the same sets."""
    from scripts.calibration import report

    paths = [args.out / f"{name}{files.SCORES}.npz" for name in args.name]
    print(report.comparison(*files.read_scores(paths)))
    return 0


def main() -> int:
    """Runs the command and returns the exit status."""
    args = parse()
    if args.command == "wave":
        return simulate(args)
    if args.command == "score":
        return score_waves(args)
    try:
        from scripts.calibration import report
    except ModuleNotFoundError as error:
        sys.exit(f"error: {error.name} is missing: pip install 'codesign-jax[study]'")
    if args.command == "compare":
        return compare(args)
    print(report.make(args.data, args.figures, args.page, args.experiments))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ValueError as error:
        sys.exit(f"error: {error}")
