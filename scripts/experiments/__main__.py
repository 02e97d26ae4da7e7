"""Repeats the paper's experiments and redraws its figures.

python -m scripts.experiments 2d --out runs/reproduction           # on a GPU; again to resume
python -m scripts.experiments 2d --out runs/small --size cpu       # minutes on a CPU
python -m scripts.experiments 2d --parquet runs/2d.parquet         # every grasp, also afterwards
python -m scripts.experiments types --videos docs/figures            # what the landscape's hands do
python -m scripts.experiments figures --data docs/data/reproduction
"""

import argparse
import json
import sys
from pathlib import Path

import jax

from codesign_jax import codesign, scene
from codesign_jax.batch import LIMIT
from codesign_jax.commands import common
from codesign_jax.engines import NAMES, make_engine
from codesign_jax.runs.parquet import library
from codesign_jax.scene import keypaths, parameters
from codesign_jax.scene.schema import SceneError
from scripts.experiments import Batch, Grid, Stop, Worlds, drive, parquet, plan, results
from scripts.experiments.worlds import chunking
from scripts.shared import output, provenance, record


def parse() -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("experiment", choices=[*plan.PAPER, "types", "figures"])
    parser.add_argument("--out", type=Path, default=Path("runs/reproduction"), help="folder")
    parser.add_argument(
        "--scene",
        default="paper",
        help="built-in scene or file; docs/data/reproduction has paper_spheres",
    )
    parser.add_argument("--size", choices=list(plan.OVERRIDES), default="paper")
    parser.add_argument("--preset", dest="size", choices=list(plan.OVERRIDES), help="as --size")
    parser.add_argument(
        "--strategies",
        type=lambda s: s.split(","),
        help="only these, for example single,concurrent",
    )
    parser.add_argument("--runs", type=int, help="runs of each strategy")
    parser.add_argument("--engine", choices=NAMES, default="structured")
    parser.add_argument("--seed", type=int, default=0, help="seed of run 0")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--chunk", type=int, default=LIMIT, help="most worlds of a call")
    parser.add_argument("--devices", type=int, help="by default all that are visible")
    parser.add_argument("--every", type=int, help="steps between saves; by default 20 s")
    parser.add_argument("--minutes", type=float, help="save and stop after this time")
    parser.add_argument("--partial", action="store_true", help="also write results when stopped")
    parser.add_argument("--fresh", action="store_true", help="delete an earlier state")
    provenance.add_commit(parser)
    parser.add_argument(
        "--trials",
        type=Path,
        help="write every trial to this .npz",
    )
    parser.add_argument("--parquet", type=Path, help="write every grasp as a row of this file")
    parser.add_argument("--data", type=Path, default=Path("docs/data/paper"))
    parser.add_argument(
        "--touching",
        type=Path,
        nargs="+",
        default=[],
        help="folders of the same with contact between fingers",
    )
    parser.add_argument("--figures", type=Path, default=Path("docs/figures"))
    parser.add_argument("--videos", type=Path, help="folder for a video of each grasp type")
    parser.add_argument("--page", type=Path, help="page whose table is filled in")
    return parser.parse_args()


def build(args: argparse.Namespace) -> tuple[Batch | Grid, dict[str, object], int]:
    """Returns the experiment, the settings its state must belong to, and its grasps."""
    the_plan = plan.experiment(args.experiment, args.size)
    try:
        the_plan = plan.narrowed(the_plan, args.strategies, args.runs)
    except ValueError as error:
        sys.exit(f"error: {error}")
    overrides = keypaths.parse([*plan.OVERRIDES[args.size], *args.set])
    the_scene = scene.load(args.scene, overrides=overrides)
    space = parameters.design_space(the_scene.hand, the_plan.preset)
    devices = args.devices or jax.device_count()
    chunk, calls = chunking(the_plan.worlds, args.chunk, devices)
    engine = make_engine(args.engine, the_scene)
    worlds = Worlds(the_scene, engine, space, chunk=chunk, devices=devices)
    print(f"{args.experiment}: {the_plan.grasps:,} grasps, {the_plan.worlds:,} a step in {calls}")
    print(f"call(s) of {chunk:,} worlds on {devices} device(s)", flush=True)
    settings = record.settings(the_plan, the_scene, args.engine, args.seed, chunk)
    if isinstance(the_plan, plan.Landscape):
        return Grid(the_plan, the_scene, worlds, seed=args.seed), settings, the_plan.grasps
    batch = Batch(the_plan, the_scene, worlds, codesign.make_filter(space), seed=args.seed)
    return batch, settings, the_plan.grasps


def simulate(args: argparse.Namespace) -> int:
    """Runs or resumes an experiment; 3 is the exit status of one that was stopped."""
    common.use_compilation_cache()
    if args.parquet:
        library(parquet.FLAG)  # refused before hours of simulation, not after
    experiment, settings, grasps = build(args)
    state = args.out / f"{args.experiment}.state.npz"
    if args.fresh:
        state.unlink(missing_ok=True)
    stop = Stop(every=args.every, minutes=args.minutes)
    done = drive(experiment, state, settings, stop=stop, say=lambda s: print(s, flush=True))
    if not done.finished and args.partial and done.record:
        made = results.describe(settings, done, done.grasps, commit=args.commit)
        made |= {"steps": int(done.record["step"]), "steps_of_all": experiment.steps}
        results.write(args.out, args.experiment, results.summarize(experiment, done.record), made)
    if not done.finished:
        print(f"stopped; the same command resumes from {state}")
        return 3
    notes = args.out / f"{args.experiment}.json"
    # A finished state from which a table is asked for: who made the results stays as it is.
    if done.grasps or not notes.exists():
        made = results.describe(settings, done, grasps, commit=args.commit)
        kept = results.summarize(experiment, done.record)
        for path in results.write(args.out, args.experiment, kept, made):
            print(path)
    if args.trials:
        print(output.write_arrays(args.trials, done.record))
    if args.parquet:
        print(parquet.write(args.parquet, experiment, done.record, json.loads(notes.read_text())))
    return 0


def find_types(args: argparse.Namespace) -> int:
    """Clusters what the hand does in the landscape's good designs, and shows it."""
    from scripts.experiments import grasp_types, study
    from scripts.experiments.figures import LANDSCAPE_THRESHOLD

    common.use_compilation_cache()
    grid = study.load(args.data, "landscape")
    if grid is None:
        sys.exit(f"error: {args.data} holds no landscape.npz")
    overrides = keypaths.parse([*plan.OVERRIDES[args.size], *args.set])
    the_scene = scene.load(args.scene, overrides=overrides)
    space = parameters.design_space(the_scene.hand, "2d")
    engine = make_engine(args.engine, the_scene)
    found = study.load(args.data, "types")
    if found is None or args.fresh:
        arrays = grasp_types.study(grid[0], the_scene, engine, space, LANDSCAPE_THRESHOLD)
        notes = {
            **provenance.results(args.commit),
            "settings": {
                "scene_sha256": record.scene_hash(the_scene),
                "engine": args.engine,
                "threshold": LANDSCAPE_THRESHOLD,
            },
        }
        results.write(args.data, "types", arrays, notes)
    else:
        arrays = found[0]
    print(grasp_types.describe(grid[0], arrays))
    if args.videos:
        for path in grasp_types.videos(grid[0], arrays, the_scene, engine, space, args.videos):
            print(path)
    return 0


def main() -> int:
    """Runs the command and returns the exit status."""
    args = parse()
    if args.experiment not in ("types", "figures"):
        return simulate(args)
    try:
        if args.experiment == "types":
            return find_types(args)
        from scripts.experiments import report
    except ModuleNotFoundError as error:
        sys.exit(f"error: {error.name} is missing: pip install 'codesign-jax[study]'")
    print(report.make(args.data, args.figures, args.page, args.touching))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (record.StateError, SceneError) as error:
        sys.exit(f"error: {error}")
