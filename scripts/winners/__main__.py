"""Simulates the final particles of the concurrent strategy again: do the winners hold?

python -m scripts.winners --out runs/winners.npz                  # on a GPU; again to resume
python -m scripts.winners --out runs/small.npz --size tiny        # minutes on a CPU
python -m scripts.winners --merge A.npz B.npz --out C.npz         # joins results of two machines
python -m scripts.winners --report                                # figure and table from the data

Variants: new trials, friction and stiffness changed, the skinned hull, meshes never seen, a fine
discretization, and MuJoCo C in float64 at either discretization (the best particle of each run).
--extra "rough:contact.finger_table_friction=1.5" adds a variant by its overrides.  The .json beside
the results lists every run with its command, commit, versions, device and the calls it made.  Exit
status 3: stopped at the budget; the same command resumes.
"""

import argparse
import sys
from pathlib import Path

from codesign_jax import scene
from codesign_jax.batch import LIMIT
from codesign_jax.scene.schema import InputError
from scripts.shared import provenance
from scripts.winners import files as winners_files
from scripts.winners import variants as winners
from scripts.winners.variants import VARIANTS, Variant

# Runs, particles of a run, blocks of trials, trials of a block (all shapes of a set equally often).
SIZES = {"paper": (None, None, 3, 6), "cpu": (4, 3, 1, 6), "tiny": (2, 2, 1, 3)}
MESH_TRIALS = 8


def parse() -> argparse.Namespace:
    """Reads the command line."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/winners.npz"))
    parser.add_argument("--size", choices=list(SIZES), default="paper")
    parser.add_argument("--experiments", type=lambda s: s.split(","), default=["23d", "2d"])
    parser.add_argument("--variants", type=lambda s: s.split(","), help="names; by default all")
    parser.add_argument("--extra", action="append", default=[], metavar="NAME:KEY=VALUE,...")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--chunk", type=int, default=LIMIT, help="most worlds of a call")
    parser.add_argument("--budget", type=float, default=1e9, help="seconds to begin calls in")
    parser.add_argument("--merge", type=Path, nargs="+", metavar="FILE", help="joined into --out")
    parser.add_argument("--data", type=Path, default=Path("docs/data/reproduction"))
    parser.add_argument("--report", action="store_true", help="draw what --data holds and stop")
    parser.add_argument("--page", type=Path, default=Path("docs/notes/results_spheres.md"))
    parser.add_argument("--figures", type=Path, default=Path("docs/figures/spheres"))
    return parser.parse_args()


def variants(args: argparse.Namespace) -> list[Variant]:
    """The variants asked for.

    Raises:
      InputError: If a name is unknown.
    """
    known = {v.name: v for v in VARIANTS}
    for text in args.extra:
        name, _, overrides = text.partition(":")
        known[name] = Variant(name, overrides=tuple(overrides.split(",")))
    names = args.variants or list(known)
    unknown = [n for n in names if n not in known]
    if unknown:
        raise InputError([f"--variants {n!r} unknown; valid: {', '.join(known)}" for n in unknown])
    return [known[n] for n in names]


def simulate(args: argparse.Namespace) -> int:
    """Runs the calls that are left and returns the exit status."""
    from codesign_jax.commands import common

    common.use_compilation_cache()
    chosen = variants(args)
    runs, particles, blocks, trials = SIZES[args.size]
    every = [winners.finals(args.data, name, runs, particles) for name in args.experiments]
    todo = [
        task
        for variant in chosen
        for task in winners.tasks(
            every, [variant], blocks, MESH_TRIALS if variant.objects else trials
        )
    ]
    todo.sort(key=lambda task: task.block)
    settings = {
        "size": args.size,
        "particles": "the best of each run first",
        "scene_sha256": provenance.scene_hash(scene.load("paper_spheres")),
        "set": list(args.set),
    }
    made = winners_files.read(args.out)[2] if args.out.exists() else []
    made.append(this_run(args))

    def note(key: str) -> None:
        winners_files.note(made, key)
        winners_files.write_runs(args.out, settings, made)

    _, finished = winners.drive(
        todo, args.out, settings, more=args.set, budget=args.budget, limit=args.chunk, note=note
    )
    return 0 if finished else 3


def this_run(args: argparse.Namespace) -> winners_files.Run:
    """Provenance of this process, which has made no call yet."""
    return {**provenance.results(args.commit), "calls": []}


def main() -> int:
    """Runs the command and returns the exit status."""
    args = parse()
    if args.merge:
        print("\n".join(winners_files.merge(args.merge, args.out)))
        return 0
    if args.report:
        from scripts.winners import report as winners_report

        print(winners_report.make(args.data, args.figures, args.page))
        return 0
    return simulate(args)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ValueError as error:
        sys.exit(f"error: {error}")
