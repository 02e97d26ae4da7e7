"""Grasps a second of the default scene, whole grasps of nine seconds, in batches of several sizes.

python -m scripts.benchmark.grasps --json docs/data/grasps_cpu.json
python -m scripts.benchmark.grasps --json docs/data/grasps_h200.json --worlds 60 360 1728 16384

60 grasps are an episode of one run with the paper's 2D sizes, 360 one of its 23D experiment.
MuJoCo C has no skinned hull: it is measured beside the structured engine on the scene with spheres.
Of several calls the shortest counts, as other programs make a call longer and never shorter: on a
busy machine its rate is a lower bound.  The file keeps all calls, with the processor time of each
(all threads together), and the load of the machine.  A file that exists is extended: a case that is
measured again keeps the calls that it has.
"""

import json
import os
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from codesign_jax import rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.types import failed
from scripts.shared import output, provenance, work

PLAIN = {"finger_finger": False}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "paper": ("structured", {}),
    "paper, without contact between fingers": ("structured", PLAIN),
    "paper, spheres, without contact between fingers": (
        "structured",
        PLAIN | {"surface": "spheres"},
    ),
    "paper, spheres, without contact between fingers, MuJoCo C": (
        "mujoco",
        PLAIN | {"surface": "spheres"},
    ),
}
SECONDS = 20.0
"""Time after which a case begins no further call."""


def measure(engine: str, effects: dict[str, Any], count: int, calls: int) -> dict[str, Any]:
    """Times calls of one batch of grasps, compiled and warmed up before.

    Args:
      engine: Name of the engine.
      effects: Overrides of the scene's effects.
      count: Number of grasps; half are of random designs, half of good ones.
      calls: Most calls that are timed.
    """
    chosen = scene.load("paper", overrides={"effects": effects})
    made = make_engine(engine, chosen)
    run = jax.jit(lambda p, t: rollout.simulate(chosen, made, p, t)[0])
    worlds = work.make_worlds(chosen, count)
    outcome = jax.block_until_ready(run(*worlds))
    seconds: list[float] = []
    processor: list[float] = []
    before = os.getloadavg()[0]
    while len(seconds) < calls and (not seconds or sum(seconds) < SECONDS):
        begin, used = time.perf_counter(), time.process_time()
        jax.block_until_ready(run(*worlds))
        seconds.append(round(time.perf_counter() - begin, 4))
        processor.append(round(time.process_time() - used, 4))
    bad = np.asarray(failed(outcome.status))
    kept = (np.asarray(outcome.cost) < 0.01) & ~bad
    return {
        "seconds": seconds,
        "processor_s": processor,
        "load": [round(before, 2), round(os.getloadavg()[0], 2)],
        "kept": round(float(kept.mean()), 4),
        "failed": int(bad.sum()),
    }


def merged(old: dict[str, Any] | None, new: dict[str, Any]) -> dict[str, Any]:
    """A record with the calls of both; the rate is that of the shortest."""
    calls = {n: [*(old or {}).get(n, []), *new[n]] for n in ("seconds", "processor_s")}
    best = min(calls["seconds"])
    rate = {"best_s": best, "grasps_per_s": round(new["worlds"] / best, 1)}
    return {**new, **calls, **rate}


def main() -> None:
    """Measures the cases and writes the file after each."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--worlds", type=int, nargs="+", default=[60, 360])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE")
    parser.add_argument("--calls", type=int, default=9)
    args = parser.parse_args()
    found: dict[str, Any] = json.loads(args.json.read_text()) if args.json.exists() else {}
    records = {(r["case"], r["worlds"]): r for r in found.get("records", [])}
    runs = [*found.get("runs", []), provenance.measurement(args.commit)]
    for name in args.cases:
        engine, effects = CASES[name]
        for count in args.worlds:
            if engine == "mujoco" and count > min(args.worlds):
                continue  # its rate does not depend on the number, and it takes minutes
            new = measure(engine, effects, count, args.calls)
            new = {"case": name, "engine": engine, "worlds": count, **new}
            records[name, count] = merged(records.get((name, count)), new)
            content = {"runs": runs, "records": list(records.values())}
            output.write_json(args.json, content)
            shown = records[name, count]
            print(
                f"{name}, {count}: {shown['grasps_per_s']} grasps/s, {shown['seconds']}", flush=True
            )


if __name__ == "__main__":
    main()
