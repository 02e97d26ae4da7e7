"""Repeats the paper's experiments and redraws its figures.

python -m scripts.experiments 2d --out runs/reproduction           # on a GPU; again to resume
timeout -s INT 500 python -m scripts.experiments 2d --out runs/reproduction    # stop after a time
python -m scripts.experiments 2d --out runs/small --size small     # fewer runs, on a CPU
python -m scripts.experiments 2d --out runs/tiny --size tiny       # two links, to see that it works
python -m scripts.experiments figures                                # of docs/data/experiments
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

from rich.console import Console

from codesign_jax import runs, scene
from codesign_jax.batch import LIMIT
from codesign_jax.commands import common
from codesign_jax.engines import NAMES
from codesign_jax.scene import Scene, keypaths, parameters
from codesign_jax.scene.schema import InputError
from scripts.experiments import report, simulate
from scripts.shared import provenance


def parse() -> argparse.Namespace:
    parser = provenance.parser(__doc__)
    parser.add_argument("experiment", choices=[*simulate.PAPER, "figures"])
    parser.add_argument("--out", type=Path, default=Path("runs/reproduction"), help="folder")
    parser.add_argument("--scene", default="paper", help="built-in scene or file")
    parser.add_argument("--size", choices=list(simulate.SIZES), default="paper")
    parser.add_argument("--runs", type=int, help="runs of each strategy, by default the size's")
    parser.add_argument("--engine", choices=NAMES, default="structured")
    parser.add_argument("--seed", type=int, default=0, help="seed of run 0")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--chunk", type=int, default=LIMIT, help="most worlds of a call")
    parser.add_argument("--devices", type=int, help="by default all that are visible")
    parser.add_argument("--fresh", action="store_true", help="delete what is there of it")
    parser.add_argument("--data", type=Path, default=Path("docs/data/experiments"))
    parser.add_argument("--figures", type=Path, default=Path("docs/figures"))
    parser.add_argument("--page", type=Path, help="page whose table is filled in")
    return parser.parse_args()


def run(args: argparse.Namespace) -> int:
    """Runs or resumes an experiment, and writes what it has; returns the exit status."""
    common.use_compilation_cache()
    plans, changes = simulate.SIZES[args.size]
    the_plan = plans[args.experiment]
    if args.runs and isinstance(the_plan, simulate.Strategies):
        the_plan = dataclasses.replace(the_plan, runs=args.runs)
    overrides = keypaths.parse([*changes, *args.set])
    the_scene = scene.load(args.scene, overrides=overrides)
    path = args.out / f"{args.experiment}.json"
    settings = simulate.settings_of(the_plan, the_scene, args.engine, args.seed)
    settings = json.loads(json.dumps(settings))
    if path.exists() and not args.fresh:
        if json.loads(path.read_text())["settings"] != settings:
            sys.exit(f"error: {path} belongs to another experiment; choose another --out")
    print(f"{args.experiment}: {the_plan.grasps:,} grasps", flush=True)
    begin = _landscape if isinstance(the_plan, simulate.Landscape) else _strategies
    code, kept, grasps = begin(args, the_plan, the_scene)
    if kept is not None:
        notes = provenance.results(args.commit) | {"settings": settings, "grasps": grasps}
        simulate.write(args.out, args.experiment, kept, notes)
    return code


Found = tuple[int, simulate.Arrays | None, int]
"""Exit status, results if there are some, and their grasps."""


def _strategies(args: argparse.Namespace, the_plan: simulate.Strategies, the_scene: Scene) -> Found:
    folder = args.out / args.experiment
    plans = simulate.plans(the_plan, the_scene, args.engine, folder, args.seed)
    arguments = {"fresh": args.fresh, "devices": args.devices, "chunk": args.chunk}
    done = runs.optimize(plans, sys.argv, **arguments)
    problems = {run_folder: r for run_folder, r in done.runs.items() if isinstance(r, Exception)}
    for run_folder, error in problems.items():
        print(f"error: {run_folder}: {error}", file=sys.stderr)
    code = int(bool(problems)) or (128 + done.signum if done.signum else 0)
    gathered = simulate.gather(the_plan, folder, args.seed)
    if gathered is None or not gathered["cost"].shape[2]:
        return code, None, 0
    space = parameters.design_space(the_scene.hand, the_plan.preset)
    tested = the_plan.worlds * the_plan.rounds if "test_status" in gathered else 0
    kept = simulate.of_strategies(the_plan, the_scene, space, gathered)
    return code, kept, gathered["status"].size + tested


def _landscape(args: argparse.Namespace, the_plan: simulate.Landscape, the_scene: Scene) -> Found:
    arguments = {"seed": args.seed, "chunk": args.chunk, "devices": args.devices}
    arguments["console"] = Console(highlight=False, soft_wrap=True)
    simulated = simulate.landscape(the_plan, the_scene, args.engine, **arguments)
    space = parameters.design_space(the_scene.hand, the_plan.preset)
    return 0, simulate.of_landscape(the_scene, space, simulated), the_plan.grasps


def main() -> int:
    args = parse()
    if args.experiment != "figures":
        return run(args)
    print(report.make(args.data, args.figures, args.page))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"error: {error}")
