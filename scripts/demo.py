"""A co-design of all 23 parameters, from random designs to one that grasps, with pictures.

`make demo` runs it: a minute or two on two cores.  It is `codesign optimize` and `codesign
evaluate` with the arguments below; further arguments go to the former, such as --fresh or --seed 1.
The scene has its skinned hull and contact between fingers.
"""

import csv
import sys
from pathlib import Path

from codesign_jax import cli

FOLDER = Path("runs") / "demo"


def main() -> int:
    """Runs the demo and returns the exit status: 0 only if a final particle passed its test."""
    run = ["optimize", "--scene", "paper", "--preset", "23d", "--seed", "3"]
    run += ["--reference-trials", "0", "--out", str(FOLDER)]
    status = cli.main([*run, *sys.argv[1:]])
    if status:
        return status
    pictures = [FOLDER / "figures" / name for name in ("best_grasp.png", "best_grasp.gif")]
    for path in pictures:
        print()
        cli.main(["evaluate", "--run", str(FOLDER), "--trials", "3", "--render", str(path)])
    print()
    cli.main(["report", str(FOLDER)])
    with (FOLDER / "tests.csv").open(newline="") as file:
        good = [row for row in csv.DictReader(file) if int(row.pop("paper_success"))]
    # Copies of a design have its trials, and count once.
    successes = len({(*row.values(),)[1:] for row in good})
    print(f"\n{successes} final designs passed the test (mean cost below 0.01)")
    print("the run, cost by cost:  ", FOLDER / "episodes.csv")
    print("the cost's evolution:   ", FOLDER / "figures" / "cost_evolution.png")
    print("the best grasp, moving: ", pictures[1])
    print("all of it, for a browser:", FOLDER / "report.html")
    return 0 if successes else 1


if __name__ == "__main__":
    sys.exit(main())
