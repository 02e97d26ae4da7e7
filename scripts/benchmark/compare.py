"""Compares the costs of the engines over many trials at equal settings.

python -m scripts.benchmark.compare --trials 2000 --json docs/data/compare_engines.json

Single grasps differ after contact, where trajectories are chaotic; what must agree are the shares
of successes, the costs' distributions and the designs' ranks.  Engines are compared in pairs over
the same worlds; "mujoco, perturbed" is MuJoCo C against itself with the objects moved by a
micrometre, which shows how much of a difference chaos alone makes.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np

from codesign_jax import rollout
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.scene import Scene
from scripts.shared import peers, provenance, statistics, work

NUDGE = 1e-6
"""Displacement of the objects of the perturbed runs [m]."""


def costs(scene: Scene, name: str, count: int, chunk: int) -> tuple[np.ndarray, float]:
    """Costs of the first worlds, shape (world,), and seconds with one compile."""
    engine = peers.build(
        "structured" if name == "structured" else name.split(",")[0],
        "default" if name == "structured" else "equal",
        scene,
    )
    run = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t)[0].cost)
    worlds = work.make_worlds(scene, -(-count // chunk) * chunk)
    if name.endswith("perturbed"):
        moved = worlds.trials._replace(position=worlds.trials.position + NUDGE)
        worlds = worlds._replace(trials=moved)
    begin, found = time.perf_counter(), []
    for first in range(0, count, chunk):
        part = jax.tree.map(lambda x, a=first: x[a : a + chunk], worlds)
        found.append(np.asarray(run(*part)))
    return np.concatenate(found)[:count], time.perf_counter() - begin


def compare(a: np.ndarray, b: np.ndarray) -> dict:
    """Statistics of two engines' costs over the same worlds, the shorter one's."""
    n = min(a.size, b.size)
    a, b = a[:n], b[:n]
    kept = [x < SUCCESS_COST for x in (a, b)]
    return {
        **statistics.agreement(a, b, work.TRIALS),
        "success_difference": statistics.paired_difference(*kept),
        "kolmogorov_smirnov": statistics.kolmogorov_smirnov(a, b),
    }


def show(name: str, c: dict) -> str:
    """One line about a pair."""
    low, high = c["success_difference"]["interval_95"]
    ks, rank = c["kolmogorov_smirnov"], c["spearman"]
    return (
        f"{name}: success {c['success']:.2%} and {c['success_reference']:.2%}, difference "
        f"[{low:+.2%}, {high:+.2%}], same verdict {c['same_verdict']:.2%}, "
        f"KS {ks['distance']:.4f} (p = {ks['p']:.2f}), "
        f"rank correlation {'–' if rank is None else format(rank, '.4f')}, {c['worlds']} worlds"
    )


def main() -> None:
    """Runs the engines, compares each with MuJoCo C and writes the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--mjx-trials", type=int, default=120, help="0 leaves stock MJX out")
    parser.add_argument("--chunk", type=int, default=500)
    provenance.add_commit(parser)
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    scene = work.variant()
    sizes = {n: args.trials for n in ("mujoco", "mujoco, perturbed", "structured")}
    sizes |= {"mjx": min(args.mjx_trials, args.trials)} if args.mjx_trials else {}
    found, seconds = {}, {}
    for name, count in sizes.items():
        found[name], seconds[name] = costs(scene, name, count, min(args.chunk, count))
        print(f"{name}: {count} grasps in {seconds[name]:.0f} s", flush=True)
    pairs = {n: compare(found[n], found["mujoco"]) for n in found if n != "mujoco"}
    result = {**provenance.measurement(args.commit), "seconds": seconds, "against_mujoco": pairs}
    args.json.parent.mkdir(parents=True, exist_ok=True)
    args.json.write_text(json.dumps(result, indent=1) + "\n")
    for name, pair in pairs.items():
        print(show(name, pair))


if __name__ == "__main__":
    main()
