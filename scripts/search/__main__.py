"""Searches by several optimisers over many seeds; the same command goes on where it stopped.

An H200 simulates about 1,900 grasps a second of the default scene.  100 seeds of the default
optimiser are 209,000 grasps and each mark 69,000, so that `--marks 3` takes four minutes there; the
filter to 23,040 grasps of a seed takes twenty and its marks.  With `--minutes 5` each call ends in
time, and the same command goes on.  evosax is needed for all but the particle filter.
`python -m scripts.search.report` makes the table and the figure of docs/notes/search.md.
"""

import argparse
import sys
import time
from pathlib import Path

import jax

from codesign_jax import optimize, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.engines import make_engine
from codesign_jax.runs.progress import duration
from codesign_jax.scene.parameters import design_space
from scripts.search.study import UNFINISHED, Study, make_case
from scripts.shared import provenance
from scripts.shared.output import write_json


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(prog="scripts.search", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of what is done")
    parser.add_argument("--preset", default="23d")
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--objects", help="object set instead of the scene's")
    parser.add_argument(
        "--optimizers",
        nargs="+",
        default=[optimize.DEFAULT],
        help="names, each with changes if wanted: screened-es:sigma=0.2,particles=13,trials=6",
    )
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--budget", type=int, default=2400, help="grasps of a seed, all counted")
    parser.add_argument("--tests", type=int, default=400, help="trials of a recommended design")
    parser.add_argument("--marks", type=int, default=9, help="times at which one is recommended")
    parser.add_argument("--at", type=int, nargs="+", default=[], help="grasps instead of --marks")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, help="time after which no step begins")
    parser.add_argument("--chunk", type=int, help="most grasps of a call")
    provenance.add_commit(parser)
    args = parser.parse_args(arguments)
    use_compilation_cache()
    begin = time.monotonic()
    scene = scenes.load(args.scene, object_set=args.objects)
    engine, space = make_engine("structured", scene), design_space(scene.hand, args.preset)
    chunk = args.chunk or (512 if jax.default_backend() == "cpu" else 16_384)
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.optimizers:
        case = make_case(name, space, args.preset, len(scene.objects.object))
        stem = f"{args.preset}-{name.replace(':', '-').replace('=', '')}"
        how = {"seeds": args.seeds, "budget": args.budget, "tests": args.tests, "chunk": chunk}
        how |= {"marks": args.marks, "at": args.at, "first_seed": args.first_seed}
        study = Study(case, scene, engine, space, **how, path=args.out / f"{stem}.npz")
        grasps, start = 0, time.monotonic()
        while not study.finished:
            if args.minutes is not None and time.monotonic() - begin > 60 * args.minutes:
                print(f"{name}: after {study.done} episodes; the same command goes on", flush=True)
                return UNFINISHED
            grasps += study.step()
            study.save()  # the next command goes on here, whatever ends this one
            rate = grasps / (time.monotonic() - start)
            print(
                f"{name}: episode {study.done}/{study.marks[-1]}, {rate:.0f} grasps/s", flush=True
            )
        row = study.row() | {"preset": args.preset, "scene": args.scene, "objects": args.objects}
        row["first_seed"] = args.first_seed
        made = {"provenance": provenance.results(args.commit), "tests": args.tests}
        write_json(args.out / f"{stem}.json", row | made)
        shares = [sum(k >= 0.95 for k in kept) / len(kept) for kept in row["kept"]]
        took = duration(time.monotonic() - start)
        print(f"{name}: {dict(zip(row['grasps'], shares, strict=True))} in {took}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
