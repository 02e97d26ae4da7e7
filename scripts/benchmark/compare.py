"""Compares the costs of the engines over many trials: how much of a difference is chaos?

python -m scripts.benchmark.compare --trials 2000 --json docs/data/compare_engines.json

Single grasps differ after contact, where trajectories are chaotic; what must agree are the shares
of successes, the costs' distributions and the designs' ranks.  Engines are compared with MuJoCo C
over the same worlds, at equal settings; "mujoco, perturbed" is MuJoCo C against itself with the
objects moved by a micrometre, which shows how much of a difference chaos alone makes.
"""

import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from codesign_jax import rollout
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.engines import Engine
from codesign_jax.scene import Scene
from scripts.shared import output, peers, provenance, statistics, work


def engines(scene: Scene, *, mjx: bool) -> dict[str, Callable[[], Engine]]:
    """What builds each engine, by the name in the file; MuJoCo C, which stands for all, first."""
    found: dict[str, Callable[[], Engine]] = {
        "mujoco": lambda: peers.build("mujoco", "equal", scene),
        "mujoco, perturbed": lambda: peers.build("mujoco", "equal", scene),
        "structured": lambda: peers.build("structured", "default", scene),
    }
    return found | ({"mjx": lambda: peers.build("mjx", "equal", scene)} if mjx else {})


def costs(
    scene: Scene, engine: Engine, worlds: work.Worlds, chunk: int
) -> tuple[np.ndarray, float]:
    """Costs of worlds, shape (world,), and seconds with one compile; chunks divide the worlds."""
    run = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t)[0].cost)
    begin, found = time.perf_counter(), []
    for first in range(0, worlds.trials.yaw.shape[0], chunk):
        part = jax.tree.map(lambda x, a=first: x[a : a + chunk], worlds)
        found.append(np.asarray(run(*part)))
    return np.concatenate(found), time.perf_counter() - begin


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
    parser = provenance.parser(__doc__)
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--mjx-trials", type=int, default=120, help="0 leaves stock MJX out")
    parser.add_argument("--chunk", type=int, default=500)
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    scene = work.variant()
    found, seconds = {}, {}
    for name, build in engines(scene, mjx=args.mjx_trials > 0).items():
        count = min(args.mjx_trials, args.trials) if name == "mjx" else args.trials
        chunk = min(args.chunk, count)
        worlds = work.make_worlds(scene, -(-count // chunk) * chunk)
        if name.endswith("perturbed"):
            worlds = worlds._replace(trials=work.nudged(worlds.trials))
        each, seconds[name] = costs(scene, build(), worlds, chunk)
        found[name] = each[:count]
        print(f"{name}: {count} grasps in {seconds[name]:.0f} s", flush=True)
    pairs = {n: compare(found[n], found["mujoco"]) for n in found if n != "mujoco"}
    made = provenance.measurement(args.commit)
    output.write_json(args.json, {**made, "seconds": seconds, "against_mujoco": pairs})
    for name, pair in pairs.items():
        print(show(name, pair))


if __name__ == "__main__":
    main()
