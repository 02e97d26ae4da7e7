"""What runs have on their way: particles and costs of some episodes, for scripts.search.judge.

python -m scripts.experiments.marks --runs runs/paper/23d/concurrent --out runs/paper/marks.npz

MARKS.npz has for each mark, after G grasps of a run, `particlesG` (run, particle, parameter) as
simulated in that episode [SI units] and `costG` (run, particle), their mean costs; and `seeds`.
"""

import sys
from pathlib import Path

import numpy as np

from codesign_jax import runs
from codesign_jax.runs.manifest import read_provenance
from codesign_jax.scene import InputError
from scripts.shared import output, provenance

AT = (2400, 11_520, 23_040, 46_080)
"""Grasps of a run, those by which it then chooses a design included."""
CANDIDATES, ROUNDS = 25, 12
"""Particles and trials of each by which scripts.search.judge chooses."""


def read(folders: list[Path], at: list[int]) -> dict[str, np.ndarray]:
    """Particles and costs at the marks that all runs have reached; see the module.

    Args:
      folders: Run folders.
      at: Grasps, of which those that find the seed, as many as an episode's, and those that choose
        a design are no episode's; the nearest number of episodes counts.

    Raises:
      InputError: If a run has not begun.
    """
    records = [runs.load_record(folder) for folder in folders]
    if not records or None in records:
        raise InputError(["not all of the folders hold a run that has begun"])
    known = [record for record in records if record is not None]
    _, particles, trials = known[0].history.outcomes.cost.shape
    worlds, tested = particles * trials, min(CANDIDATES, particles) * ROUNDS
    seeds = [read_provenance(folder)["settings"]["seed"] for folder in folders]
    found = {"seeds": np.array(seeds)}
    for grasps in at:
        episode = max(1, round((grasps - worlds - tested) / worlds))
        if episode <= min(record.done for record in known):
            name = worlds * (1 + episode)
            history = [record.history for record in known]
            found[f"particles{name}"] = np.array([h.population[episode - 1] for h in history])
            found[f"cost{name}"] = np.array([h.cost[episode - 1] for h in history])
    return found


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="folder of run folders")
    parser.add_argument("--out", type=Path, required=True, help="file of the results, .npz")
    parser.add_argument("--at", type=int, nargs="+", default=list(AT))
    args = parser.parse_args()
    folders = sorted(args.runs.glob("seed-*"), key=lambda p: int(p.name.split("-")[1]))
    print(output.write_arrays(args.out, read(folders, args.at)))
    notes = provenance.results(args.commit)
    print(output.write_json(args.out.with_suffix(".json"), notes, indent=2))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"error: {error}")
