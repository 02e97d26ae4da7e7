"""A finger's section by finite elements, beside the law of the simulation.

python -m scripts.section --out runs/section                    # the sections; again to go on
python -m scripts.section --out runs/section --share 1/8        # beside 7 other processes
python -m scripts.section --out runs/section --merge docs/data/section.npz

Half a minute of one core for each of the 130 sections.
"""

import argparse
from pathlib import Path

from scripts.section import study


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--out", type=Path, default=Path("runs/section"), help="folder of files")
    parser.add_argument("--share", default="1/1", metavar="I/N", help="every N-th section")
    parser.add_argument("--merge", type=Path, metavar="FILE", help="write the files into this one")
    args = parser.parse_args()
    if args.merge:
        study.merge(args.out, args.merge)
        return
    study.compute(args.out, args.share)


if __name__ == "__main__":
    main()
