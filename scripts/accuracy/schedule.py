"""Whether a search should end on a finer setting: the same runs carried on in several ways.

python -m scripts.accuracy.schedule --json docs/data/schedule.json        # an hour of two cores
python -m scripts.accuracy.schedule --json docs/data/schedule.json --report \
    --page docs/notes/accuracy.md

Each branch takes the final particles of the concurrent 23-parameter runs of docs/data/paper, which
were found at `standard`, and lets the particle filter go on: at `standard` for as many episodes as
the fine setting, at `standard` for as long a time, and at the fine setting.  All particles that a
branch ends with are then judged at a setting that is finer still, all on the same fresh trials.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign
from codesign_jax.batch import Batch, Request
from codesign_jax.scene import parameters
from codesign_jax.types import failed
from scripts.accuracy.settings import FINE, STANDARD, Setting
from scripts.shared import addition, output, provenance, statistics, tables

FINER = Setting(timestep=5.0, damping="least")
"""Where a search may end: it flips 4.2 % of the verdicts of late designs, `standard` 5.5 %."""
JUDGE = FINE
"""Where all are judged: its verdicts are unbiased, and it costs a third of `reference`."""
SEED, JUDGE_SEED = 1000, 2000
"""Root keys of the branches' first run and of the judge's: no run of docs/data/paper has them."""
TRIALS = 6


def branches(finer_episodes: int, equal_time: int) -> dict[str, tuple[Setting, int]]:
    """Setting and further episodes of each branch; none are the runs as they ended."""
    return {
        "as they ended": (STANDARD, 0),
        "standard, equal episodes": (STANDARD, finer_episodes),
        "standard, equal time": (STANDARD, equal_time),
        "finer": (FINER, finer_episodes),
    }


class Simulation:
    """One setting, compiled once for all branches that need it."""

    def __init__(self, setting: Setting, limit: int):
        """Takes a setting and the most worlds of a call."""
        scene = setting.scene()
        space = parameters.design_space(scene.hand)
        self.optimizer = codesign.make_filter(space)
        task = codesign.Task(scene, space, TRIALS, setting.make(scene))
        self.batch = Batch(task, self.optimizer, devices=1, limit=limit)


def keys(runs: int, seed: int) -> list[jax.Array]:
    """Root keys of runs, the first one with this seed."""
    return [jax.random.key(seed + r) for r in range(runs)]


def carry_on(simulation: Simulation, particles: np.ndarray, episodes: int) -> np.ndarray:
    """Particles of runs, shape (run, particle, 23), after further episodes."""
    optimizer, mask = simulation.optimizer, np.ones(particles.shape[-1], bool)
    states = [
        optimizer.init(key, own[0], len(own))._replace(particles=jnp.asarray(own))
        for key, own in zip(keys(len(particles), SEED), particles, strict=True)
    ]
    for e in range(episodes):
        ended = simulation.batch([Request(state, mask) for state in states])
        states = [state for state, _ in ended]
        cost = np.mean([info.selection.cost for _, info in ended])
        print(f"  episode {e + 1}: mean cost {cost:.3f}", flush=True)
    return np.array([state.particles for state in states])


def judge(simulation: Simulation, particles: np.ndarray) -> dict[str, Any]:
    """Kept grasps of every run on fresh trials that all branches share."""
    ended = simulation.batch(
        [
            Request(*codesign.closed(simulation.optimizer, jnp.asarray(own), key))
            for key, own in zip(keys(len(particles), JUDGE_SEED), particles, strict=True)
        ]
    )
    cost = np.array([info.trials.cost for _, info in ended])
    good = ~failed(np.array([info.trials.status for _, info in ended]))
    kept = ((cost < codesign.SUCCESS_COST) & good).sum(-1)
    return {
        "kept": [round(float(v), 5) for v in (kept / np.maximum(good.sum(-1), 1)).mean(-1)],
        "lossless": [round(float(v), 5) for v in ((kept == TRIALS) & good.all(-1)).mean(-1)],
        "failed": round(float((~good).mean()), 6),
    }


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Simulates all branches; writes the file after each, and leaves out what it has."""
    with np.load(args.data / "23d.npz", allow_pickle=False) as file:
        particles = file["final_particles"][-1, : args.runs, : args.particles]
    found: dict[str, Any] = {"branches": {}}
    if args.json.exists():
        found = json.loads(args.json.read_text())
    simulations = {s: Simulation(s, args.chunk) for s in (STANDARD, FINER, JUDGE)}
    for name, (setting, episodes) in branches(args.episodes, args.equal_time).items():
        if name in found["branches"]:
            continue
        start = time.perf_counter()
        new = carry_on(simulations[setting], particles, episodes) if episodes else particles
        seconds = time.perf_counter() - start
        found["branches"][name] = {
            "setting": setting.label,
            "episodes": episodes,
            "seconds_with_compile": round(seconds, 1),
            **judge(simulations[JUDGE], new),
        }
        found |= {"judge": JUDGE.label, "runs": len(particles), "trials": TRIALS}
        found |= {"particles": particles.shape[1], "made": provenance.results(args.commit)}
        output.write_json(args.json, found)
        print(name, found["branches"][name], flush=True)
    return found


def table(found: dict[str, Any]) -> str:
    """The branches, and what each changes of the first, run by run."""
    rows = [["runs carried on", "setting", "further episodes", "grasps kept", "change, points"]]
    rows[0] += ["particles that lose nothing", "change, points"]
    first = found["branches"]["as they ended"]
    for name, branch in found["branches"].items():
        row = [name, branch["setting"] if branch["episodes"] else "–", str(branch["episodes"])]
        for what in ("kept", "lossless"):
            row.append(f"{100 * np.mean(branch[what]):.1f} %")
            change = 100 * (np.array(branch[what]) - np.array(first[what]))
            middle = statistics.bootstrap(lambda k, c=change: c[k].mean(-1), change.size)
            text = f"{middle.value:+.1f} [{middle.low:+.1f}, {middle.high:+.1f}]"
            row.append(text if branch is not first else "–")
        rows.append(row)
    return tables.markdown(rows)


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = addition.parser(__doc__, "schedule")
    parser.add_argument("--data", type=Path, default=Path("docs/data/paper"))
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--particles", type=int, default=60)
    parser.add_argument("--episodes", type=int, default=8, help="further ones at the finer setting")
    parser.add_argument("--equal-time", type=int, default=19, help="episodes at standard instead")
    parser.add_argument("--chunk", type=int, default=10_800, help="most worlds of a call")
    return addition.main(parser.parse_args(), run, table, "schedule")


if __name__ == "__main__":
    sys.exit(main())
