"""Late designs of the default scene at finer steps, links and meshes.

python -m scripts.accuracy.late_designs --json docs/data/late_designs.json

The designs are final particles of concurrent runs with 23 parameters.  The table of the hard cases
reads the file (24 and 37); its designs are docs/data/paper_fingers of commit c7f4a91, found before
fingers touched the palm.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from codesign_jax.codesign import Task
from codesign_jax.commands import calls
from codesign_jax.cost import particle_cost
from codesign_jax.scene import load, parameters
from codesign_jax.types import Outcome, Status, failed
from scripts.accuracy import decision
from scripts.shared import output, provenance

SETTINGS: dict[str, dict[str, Any]] = {
    "h": {},
    "h/2": {"timestep": 0.005},
    "h/4": {"timestep": 0.0025},
    "20 links": {"links": 20},
    "4 x 16 points": {"hull_rings": 4, "hull_points": 16},
}
SEED = 24


def letters(found: Outcome) -> np.ndarray:
    """How trials ended, shape (design, trial): kept, lost, STUCK or failed otherwise."""
    bad = np.where(found.status & Status.STUCK, "s", "f")
    return np.where(failed(found.status), bad, np.where(found.cost == 0, "k", "l"))


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("docs/data/experiments"))
    parser.add_argument("--designs", type=int, default=60)
    parser.add_argument("--trials", type=int, default=24)
    parser.add_argument("--trials-at-h", type=int, default=96, help="a multiple of --trials")
    parser.add_argument("--chunk", type=int, default=10, help="designs of a call")
    parser.add_argument("--settings", default=",".join(SETTINGS))
    provenance.add_commit(parser)
    args = parser.parse_args()
    designs = decision.populations(args.data, args.designs)["late"]
    found: dict[str, Any] = {"designs": args.designs, **provenance.results(args.commit)}
    found["settings"] = {}
    for name in args.settings.split(","):
        scene = load("paper", overrides={"discretization": SETTINGS[name]})
        trials = args.trials_at_h if name == "h" else args.trials
        task = Task(scene, parameters.design_space(scene.hand), trials)
        outcomes = calls.joined([*calls.in_turn(task, jax.random.key(SEED), designs, args.chunk)])
        found["settings"][name] = {
            "trials": ["".join(row) for row in letters(outcomes)],
            "cost": [round(float(c), 4) for c in particle_cost(scene, outcomes)],
        }
        output.write_json(args.json, found)
        print(name, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
