"""Which optimiser finds a good hand in the fewest grasps: many seeds of each, in lock step.

python -m scripts.search --out runs/search                      # again to go on where it stopped
python -m scripts.search --robust --masses 0.05 0.2 0.5         # what its winners keep at 500 g
python -m scripts.search --report docs/data/search              # tables of the pages
python -m scripts.search --search-accuracy fast --judged reference --first 60000 --tests 100 \\
    --budget 4794 --at 4794    # as codesign optimize searches; 2394 at the scene's own accuracy

At every mark the optimiser's best particles meet fresh trials, and the one that costs least in
these is what it recommends there: 25 particles in 12 trials each, or the final test of an optimiser
that says how many finalists it has.  These trials count as the search's; those by which the
recommended design is judged do not.  100 seeds with two marks take five minutes of an H200.
--retest repeats a finished search's last test at both of its accuracies: which of the finalists
only the coarse one likes.
"""

import argparse
import json
import re
import sys
import time
import zlib
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax import optimize, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.commands.common import changes
from codesign_jax.engines import make_engine
from codesign_jax.judge.verdict import WANTED
from codesign_jax.runs.progress import duration
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import design_space
from scripts.search.tables import LIMITED, accuracies_table, lines_table, tables
from scripts.shared import output, provenance, work
from scripts.shared.lock_step import Study, make_case

LONGEST_STEM = 100
"""Longest name of a study's files that says all of its changes."""
PAGE = Path("docs/notes/search.md")
LINES_PAGE = Path("docs/optimisers.md")
ACCURACY_PAGE = Path("docs/accuracy.md")


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = provenance.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/search"), help="folder")
    parser.add_argument("--preset", default=LIMITED)
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--hand", help="hand instead of the scene's")
    parser.add_argument("--objects", help="object set instead of the scene's")
    parser.add_argument("--robust", action="store_true", help="as of codesign optimize")
    parser.add_argument("--constants", help="as of codesign optimize")
    parser.add_argument("--rigid-mount", action="store_true", help="as of codesign optimize")
    flag: dict[str, Any] = {"dest": "overrides", "nargs": "+", "action": "append", "default": []}
    parser.add_argument("--set", **flag, help="KEY=VALUE, as of codesign optimize")
    text = "judge the last designs once more with all objects at each of these masses [kg]"
    parser.add_argument("--masses", nargs="+", default=[], help=text)
    parser.add_argument("--designs", type=Path, help="judge those of an .npz at --masses alone")
    parser.add_argument("--retest", action="store_true", help="test finalists at both accuracies")
    parser.add_argument(
        "--optimizers",
        nargs="+",
        default=[optimize.DEFAULT],
        help="names, each with changes if wanted: screened-es:sigma=0.2,particles=13,trials=6",
    )
    parser.add_argument("--search-accuracy", help="of the episodes; default: the scene's")
    parser.add_argument(
        "--judged", metavar="ACCURACY", help="at which designs are judged; likewise"
    )
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first of the seeds")
    parser.add_argument("--budget", type=int, default=2400, help="grasps of a seed, all counted")
    parser.add_argument("--tests", type=int, default=400, help="trials of a recommended design")
    parser.add_argument("--marks", type=int, default=9, help="times at which one is recommended")
    parser.add_argument("--at", type=int, nargs="+", default=[], help="grasps instead of --marks")
    parser.add_argument("--report", type=Path, help="fill the page from a folder, and stop")
    parser.add_argument("--page", type=Path, default=PAGE)
    return parser.parse_args(arguments)


def search(args: argparse.Namespace, name: str) -> None:
    """Runs an optimiser's study to its end and writes what its designs keep."""
    files = {"hand_name": args.hand, "object_set": args.objects}
    scene = scenes.load(args.scene, **files, overrides=changes(args))
    engine = make_engine("structured", scene)
    space = design_space(scene.hand, args.preset)
    case = make_case(name, space, args.preset, len(scene.objects.object))
    changed = (
        ["--robust"] * args.robust
        + ["--rigid-mount"] * args.rigid_mount
        + [*chain.from_iterable(args.overrides)]
    )
    changed += [f"--constants={Path(args.constants).stem}"] if args.constants else []
    accuracies = {"searched": args.search_accuracy, "judged": args.judged}
    changed += [
        f"--{name}={Path(accuracy).stem}" for name, accuracy in accuracies.items() if accuracy
    ]
    changed += [f"--first={args.first}"] if args.first else []
    named = (args.scene if args.scene != "paper" else None, args.hand, args.objects)
    words = [Path(name).stem for name in named if name]
    words += [args.preset, name, *(re.sub(r"^--|^[a-z_.]+[.](?=.*=)", "", c) for c in changed)]
    stem = re.sub("[:,]", "-", "-".join(dict.fromkeys(words))).replace("=", "")
    if len(stem) > LONGEST_STEM:
        stem = f"{stem[:LONGEST_STEM]}-{zlib.crc32(stem.encode()):08x}"
    arguments = {n: getattr(args, n) for n in ("seeds", "budget", "tests", "marks", "at", "first")}
    arguments |= {n: scenes.with_accuracy(scene, a) for n, a in accuracies.items() if a}
    study = Study(case, scene, engine, space, **arguments, path=args.out / f"{stem}.npz")
    row = {"preset": args.preset, "scene": args.scene, "hand": args.hand, "objects": args.objects}
    row["changes"] = changed
    row |= {"tests": args.tests, "optimizer": name}
    grasps = 0
    start = time.monotonic()

    def progress(more: int) -> None:
        nonlocal grasps
        grasps += more
        rate = grasps / (time.monotonic() - start)
        print(f"{name}: episode {study.done}/{study.marks[-1]}, {rate:.0f} grasps/s", flush=True)

    if args.retest:
        row["retest"] = study.retest()
    elif args.designs is None:
        study.run(progress)
        row |= study.row()
    if args.masses:
        designs = work.winners(args.designs or study.path)[: args.seeds]
        row["masses"] = {m: study.judge(designs, at_mass(args, m)).tolist() for m in args.masses}
    row["seconds"] = round(time.monotonic() - start)
    row["provenance"] = provenance.results(args.commit)
    part = "-retest" if args.retest else "-masses" if args.designs else ""
    output.write_json(args.out / f"{stem}{part}.json", row)
    shares = [sum(k >= WANTED for k in kept) / len(kept) for kept in study.row()["kept"]]
    print(name, study.row()["grasps"], shares, duration(row["seconds"]), flush=True)
    print({m: float(np.mean(kept)) for m, kept in row.get("masses", {}).items()}, flush=True)


def at_mass(args: argparse.Namespace, mass: str) -> Scene:
    """The scene and hand as their files have them, with each of its objects at a mass [kg].

    Objects are the scene's own, also for designs that were found with others.
    """
    plain = scenes.load(args.scene, hand_name=args.hand)
    masses = {("objects", "object", s.name, "mass"): float(mass) for s in plain.objects.object}
    return scenes.load(args.scene, hand_name=args.hand, overrides=masses)


def main(arguments: list[str] | None = None) -> int:
    args = parse(arguments)
    if args.report:
        rows = [json.loads(path.read_text()) for path in sorted(args.report.glob("*.json"))]
        if not rows:
            sys.exit(f"error: {args.report} has no results of scripts.search")
        for mark, text in tables(rows).items():
            output.fill(args.page, text, mark)
        if text := lines_table(rows):
            output.fill(LINES_PAGE, text, "valves")
        if text := accuracies_table(rows):
            output.fill(ACCURACY_PAGE, text, "search")
        return 0
    use_compilation_cache()
    try:
        for name in args.optimizers:
            search(args, name)
    except KeyboardInterrupt:
        print("stopped; the same command goes on")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
