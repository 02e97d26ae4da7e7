"""A co-design of all 23 parameters, from random designs to one that grasps, with pictures.

`make demo` runs it: two to three minutes on two cores.  It is `codesign optimize` and `codesign
evaluate` with the arguments below; further arguments go to the former, such as --fresh or --seed 1.
The scene has its skinned hull and contact between fingers.
"""

import sys
from pathlib import Path

from codesign_jax import cli

FOLDER = Path("runs") / "demo"


def main() -> int:
    """Runs the demo and returns the exit status: 0 if it ran to its end."""
    run = ["optimize", "--scene", "build", "--preset", "23d"]
    run += ["--reference-trials", "0", "--out", str(FOLDER)]
    status = cli.main([*run, *sys.argv[1:]])
    if status:
        return status
    pictures = [FOLDER / "figures" / name for name in ("best_grasp.png", "best_grasp.gif")]
    for path in pictures:
        print()
        cli.main(["evaluate", "--run", str(FOLDER), "--render", str(path)])
    print()
    cli.main(["report", str(FOLDER)])
    print("\nthe run, cost by cost:  ", FOLDER / "episodes.csv")
    print("the cost's evolution:   ", FOLDER / "figures" / "cost_evolution.png")
    print("the best grasp, moving: ", pictures[1])
    print("all of it, for a browser:", FOLDER / "report.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
