"""Measures what accuracy costs in time, and draws it.

python -m scripts.accuracy --json docs/data/accuracy_cpu.json --quick    # an hour on two cores
python -m scripts.accuracy --json docs/data/accuracy_h200.json           # on a GPU
python -m scripts.accuracy --report                # figures, pages and presets from data
python -m scripts.accuracy --share 2/4 --json b.json                     # beside three others
python -m scripts.accuracy --json docs/data/accuracy_h200.json --merge a.json b.json c.json d.json

Every finished case is kept: the same command goes on where the last one stopped, and exits with 3
if cases are left.  --parts and --engines choose among the cases.
"""

import argparse
import sys
import time
from pathlib import Path

import jax

import codesign_jax
from codesign_jax.scene.effects import ENGINES
from scripts.accuracy import study
from scripts.accuracy.store import Store, merge
from scripts.shared import provenance

SCENES = Path(codesign_jax.__file__).parent / "scenes" / "accuracy"


def parse() -> argparse.Namespace:
    """Reads the command line."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, default=Path("runs/accuracy.json"))
    parser.add_argument("--parts", type=lambda s: s.split(","), default=list(study.PARTS))
    parser.add_argument("--engines", type=lambda s: s.split(","), default=["structured", "mujoco"])
    parser.add_argument("--size", choices=list(study.SIZES), default="full")
    parser.add_argument("--quick", dest="size", action="store_const", const="quick")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--without", help="cases whose name does not contain this")
    parser.add_argument(
        "--share", default="1/1", metavar="I/N", help="every N-th case from the I-th on, of several"
    )
    parser.add_argument("--budget", type=float, default=1e9, help="seconds to begin cases in")
    parser.add_argument("--data", type=Path, default=Path("docs/data/experiments"))
    parser.add_argument("--merge", type=Path, nargs="+", help="write these files into one and stop")
    parser.add_argument("--list", action="store_true", help="print the cases and stop")
    parser.add_argument("--report", action="store_true", help="draw what docs/data holds and stop")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    args = parser.parse_args()
    for name, known in (("parts", study.PARTS), ("engines", ENGINES)):
        unknown = set(getattr(args, name)) - set(known)
        if unknown:
            parser.error(f"--{name}: {', '.join(sorted(unknown))} unknown; valid: {known}")
    return args


def main() -> int:
    """Runs the cases that are left and returns the exit status."""
    args, begin = parse(), time.monotonic()
    if args.report:
        from scripts.accuracy import report

        found = report.studies(args.docs)
        print(report.make(args.docs, found))
        note = args.docs / "notes" / "accuracy.md"
        report.make_summary(note, SCENES, found)
        return 0
    if args.merge:
        merge(args.merge, args.json)
        return 0
    gpu = jax.default_backend() == "gpu"
    every = study.cases(study.SIZES[args.size], args.parts, args.engines, args.data, gpu=gpu)
    every = [case for case in every if args.only in case.key]
    every = [case for case in every if not args.without or args.without not in case.key]
    first, count = (int(n) for n in args.share.split("/"))
    every = every[first - 1 :: count]
    if args.list:
        print("\n".join(case.key for case in every))
        return 0
    store = Store(args.json, size=args.size, commit=args.commit)
    left = [case for case in every if not store.done(case)]
    print(f"{len(every)} cases, {len(left)} to do", flush=True)
    longest = 0.0
    for number, case in enumerate(left, 1):
        if time.monotonic() - begin + longest > args.budget:
            print(f"no time left for {len(left) - number + 1} cases; the same command goes on")
            return 3
        record = store.measure(case)
        longest = min(max(longest, record["took_s"]), 120.0)
        bad = record.get("failed") or record.get("refused")
        print(
            f"[{number}/{len(left)}] {case.key}: {bad or ''} {record['took_s']:.1f} s", flush=True
        )
        jax.clear_caches()
    return 0


if __name__ == "__main__":
    sys.exit(main())
