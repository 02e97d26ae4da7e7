"""A finger's section by finite elements, beside the law of the simulation.

python -m scripts.section --out runs/section                    # the sections; again to go on
python -m scripts.section --out runs/section --share 1/8        # beside 7 other processes
python -m scripts.section --out runs/section --merge docs/data/section.npz
python -m scripts.section --fit docs/data/section.npz           # constants of the law
python -m scripts.section --report docs/data/section.npz        # tables and figure of the note

Half a minute of one core for each of the 130 sections.
"""

import argparse
from pathlib import Path

from codesign_jax.scene import section_numbers
from scripts.section import fit, report, study
from scripts.shared import output

HIGHEST = 100e3
"""Pressure up to which the law is fitted, at G = 88 kPa [Pa]."""


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--out", type=Path, default=Path("runs/section"), help="folder of files")
    parser.add_argument("--share", default="1/1", metavar="I/N", help="every N-th section")
    parser.add_argument("--merge", type=Path, metavar="FILE", help="write the files into this one")
    parser.add_argument("--fit", type=Path, metavar="FILE", help="fit the law to this file")
    parser.add_argument("--rounds", type=int, default=30, help="of the fit")
    parser.add_argument("--report", type=Path, metavar="FILE", help="fill the note and draw")
    args = parser.parse_args()
    if args.merge:
        study.merge(args.out, args.merge)
        return
    if args.fit:
        data = fit.states(args.fit, HIGHEST)
        fitted = fit.fit(section_numbers.constants(), data, args.rounds)
        fit.write(Path(section_numbers.__file__).with_suffix(".toml"), fitted)
        print(output.markdown(fit.report(fitted, data)))
        return
    if args.report:
        report.fill(args.report, Path("docs"), HIGHEST)
        return
    study.compute(args.out, args.share)


if __name__ == "__main__":
    main()
