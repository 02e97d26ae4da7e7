"""Accuracy against time in the default scene, and what moves a verdict.

python -m scripts.accuracy --out runs/budget                    # verdicts; again to go on
python -m scripts.accuracy --out runs/budget --share 1/8        # beside 7 other processes
python -m scripts.accuracy --out runs/budget --time             # then: rates, alone on the machine
python -m scripts.accuracy --out runs/budget --tip              # errors of the finger tip
python -m scripts.accuracy --out runs/budget --merge docs/data/budget.json
python -m scripts.accuracy --of docs/data/search/hard.npz --designs 67 --trials 24 --out runs/hard
python -m scripts.accuracy --out runs/hard --merge docs/data/hard_designs.json
python -m scripts.accuracy --report                             # page and figures

All variants have the same designs and the same trials.  The designs are those that the default
search recommended in its first seeds, or those of a file (--of).  The truth has the finer step,
links and rings; `finer` refines all three again.  A variant has a file of its own, so that several
processes share the work; variants of CPUs alone need one with JAX_PLATFORMS=cpu.
"""

import sys
from pathlib import Path

from codesign_jax import use_compilation_cache
from scripts.accuracy import budget, decisions, report
from scripts.shared import output, provenance, work


def fill(docs: Path) -> None:
    """Fills the tables of the page and draws its figures from both studies of docs/data."""
    recommended, hard = (report.read(docs / "data", n) for n in (report.RECOMMENDED, report.HARD))
    tables = report.tables(recommended, hard)
    losses = decisions.losses_of(recommended, hard)
    tables["decisions"] = decisions.table(losses)
    for mark, text in tables.items():
        print(f"{text}\n")
        output.fill(docs / "accuracy.md", text, mark)
    print(report.draw_budget(recommended, hard, docs / "figures" / "budget.png"))
    print(decisions.draw(losses, recommended, docs / "figures" / "accuracy_time.png"))


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/budget"), help="folder of the files")
    text = "an .npz of a search or of scripts.accuracy.decisions"
    parser.add_argument("--of", type=Path, default=work.WINNERS, metavar="FILE", help=text)
    parser.add_argument("--designs", type=int, default=budget.DESIGNS, help="the first ones")
    parser.add_argument("--trials", type=int, default=budget.TRIALS)
    parser.add_argument("--share", default="1/1", metavar="I/N", help="every N-th variant")
    parser.add_argument("--only", default="", help="these variants, with ; between")
    parser.add_argument("--time", action="store_true", help="measure rates")
    parser.add_argument("--tip", action="store_true", help="measure errors of the finger tip")
    parser.add_argument("--merge", type=Path, help="write the files into this one and stop")
    parser.add_argument("--report", action="store_true", help="fill the page, draw, and stop")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder that is drawn into")
    args = parser.parse_args()
    use_compilation_cache()
    if args.report:
        fill(args.docs)
        return 0
    if args.merge:
        output.write_json(args.merge, budget.merge(args.out), indent=None)
        return 0
    args.out.mkdir(parents=True, exist_ok=True)
    if args.tip:
        budget.measure_tips(args.out, args.commit)
        return 0
    study = budget.Study(work.winners(args.of)[: args.designs], args.trials)
    first, count = (int(n) for n in args.share.split("/"))
    chosen = args.only.split(";") if args.only else budget.TIMED if args.time else budget.VARIANTS
    run = budget.measure if args.time else budget.simulate
    run(study, [*chosen][first - 1 :: count], args.out, args.commit)
    return 0


if __name__ == "__main__":
    sys.exit(main())
