"""Measures the engines against each other on the paper's scene, one case a process.

python -m scripts.benchmark --json docs/data/benchmark_cpu.json

A second run with the same file replaces the cases that it measures and keeps the others, so that
engines can be measured in several runs: --engines structured, then --engines mjx.  The parts of a
run (--parts) are: grasp (whole grasps, with verdicts against converged float64 MuJoCo C), window
(short rollouts in contact, in which every world is simulated in every step), residual (relative
error of accelerations) and growth (cost against links, fingers and contact spheres).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from scripts.benchmark import report
from scripts.shared import output, peers, provenance

PARTS = ("grasp", "window", "residual", "growth")
# Worlds of the sizes measured; stock MJX and Warp get what their speed and memory allow.
SIZES = {
    "cpu": {"structured": [60, 360], "mujoco": [60, 360], "mjx": [12, 60], "warp": []},
    "gpu": {
        "structured": [1728, 16384, 65536],
        "mujoco": [1728],
        "mjx": [1728, 16384],
        "warp": [1728, 16384, 65536],
    },
}
# Worlds of the smaller cases, and steps of a short rollout.
SMALL = {"cpu": {"reference": 360, "growth": 120}, "gpu": {"reference": 1728, "growth": 16384}}
DISTINCT, STEPS, MJX_STEPS = 24, 50, 20
QUICK = {"worlds": [12], "reference": 12, "growth": 6, "steps": 10}
GROWTH = (
    [{"links": n} for n in (5, 10, 20, 40)]
    + [{"fingers": n} for n in (2, 3, 4, 6, 8)]
    + [{"hand_name": "tripod3"}]
    + [{"spheres": n} for n in (1, 2, 4)]
)


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, required=True, help="results, kept and extended")
    parser.add_argument(
        "--engines",
        nargs="+",
        default=["structured", "mujoco", "mjx", "warp"],
        help="names, or name:setting for one setting",
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--worlds", nargs="+", type=int, help="batch sizes instead of the usual")
    parser.add_argument("--growth-engines", nargs="+", default=["structured", "mujoco"])
    parser.add_argument("--against", nargs="+", help="growth against these only, such as links")
    parser.add_argument("--reference", type=Path, help="file to take the reference costs from")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--budget", type=float, default=2400.0, help="seconds in all")
    parser.add_argument("--quick", action="store_true", help="a few worlds and steps: does it run?")
    return parser.parse_args()


def run_case(case: dict[str, Any], grace: float = 120.0) -> list[dict[str, Any]]:
    """Runs a case in a process of its own; returns its records, or what went wrong as one."""
    named = {k: case[k] for k in ("engine", "setting", "kind", "variant", "growth") if k in case}
    # Warp allocates beside JAX, which otherwise takes most of the device's memory.
    extra = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} if case["engine"] == "warp" else {}
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("case.json", "records.jsonl")]
        files[0].write_text(json.dumps(case))
        command = [sys.executable, "-m", "scripts.benchmark.case", *map(str, files)]
        problem = None
        try:
            done = subprocess.run(
                command,
                env={**os.environ, **extra},
                capture_output=True,
                text=True,
                timeout=case["seconds"] + grace,
                check=False,
            )
            if done.returncode:
                problem = (done.stderr.strip().splitlines() or ["no output"])[-1]
        except subprocess.TimeoutExpired:
            problem = f"stopped after {case['seconds'] + grace:.0f} s"
        lines = files[1].read_text().splitlines() if files[1].exists() else []
    records = [json.loads(line) for line in lines]
    complete = len(records) >= len(case.get("worlds", [0]))  # stopped on its way out
    return records + ([{**named, "problem": problem}] if problem and not complete else [])


def chosen(names: list[str], available: set[str]) -> list[tuple[str, str]]:
    """Pairs of engine and setting from the command line."""
    pairs = []
    for name in names:
        engine, _, setting = name.partition(":")
        if engine in available:
            pairs += [(engine, s) for s in ([setting] if setting else peers.settings(engine))]
    return pairs


def plan(args: argparse.Namespace, kind: str, available: set[str]) -> list[dict[str, Any]]:
    """The cases of a run; `weight` is their share of the budget."""
    small = {**SMALL[kind], "steps": STEPS} | (QUICK if args.quick else {})
    every = {
        "repeats": 1 if args.quick else args.repeats,
        "distinct": DISTINCT,
        "steps": small["steps"],
        "reference": small["reference"],
        "commit": args.commit,
    }
    cases = []

    def add(engine: str, setting: str, part: str, worlds: list[int], weight: float, **more: Any):
        head = {"engine": engine, "setting": setting, "kind": part, "worlds": worlds}
        cases.append({**every, **head, "weight": weight, **more})

    for engine, setting in chosen(args.engines, available):
        worlds = args.worlds or (QUICK["worlds"] if args.quick else SIZES[kind][engine])
        steps = min(MJX_STEPS if engine == "mjx" and kind == "cpu" else STEPS, small["steps"])
        weight = 4.0 if engine == "mjx" else 2.0  # MJX also takes a minute to compile
        if "grasp" in args.parts and not (args.quick and engine == "mjx"):
            add(engine, setting, "grasp", worlds, 2 * weight)
        if "window" in args.parts:
            add(engine, setting, "window", worlds, weight, steps=steps)
        if "residual" in args.parts:
            add(engine, setting, "residual", [min(12, worlds[0])], weight, steps=steps)
    if "growth" in args.parts:
        first = {name: peers.settings(name)[0] for name in available}
        for name in args.growth_engines:
            for changed in GROWTH if name in available else ():
                if args.against and not changed.keys() & set(args.against):
                    continue
                more = {"variant": changed, "growth": True, "cached": False}
                add(name, first[name], "window", [small["growth"]], 1.0, **more)
    return cases


def reference(args: argparse.Namespace, results: dict, count: int) -> list[float]:
    """Costs of converged MuJoCo C: of this file, of --reference, or computed."""
    stored = results.get("reference", {})
    if args.reference and not stored:
        stored = json.loads(args.reference.read_text())["reference"]
    if stored.get("key") == report.reference_key() and len(stored["costs"]) >= count:
        return stored["costs"]
    case = {"engine": "reference", "setting": "converged", "kind": "grasp", "worlds": [count]}
    limits = {"repeats": 0, "reference": count, "seconds": args.budget, "cached": False}
    limits["commit"] = args.commit
    [record] = run_case({**case, **limits})
    if "costs" not in record:
        raise SystemExit(f"The reference failed: {record.get('problem')}")
    results["reference"] = {
        "key": report.reference_key(),
        "solver": peers.REFERENCE,
        "seconds": record["first_s"],
        "provenance": record["provenance"],
        "costs": record["costs"],
    }
    return record["costs"]


def main() -> None:
    """Plans the cases, runs them in turn and writes the file after each."""
    args = arguments()
    begin = time.monotonic()
    results = json.loads(args.json.read_text()) if args.json.exists() else {"records": []}
    probe = {"engine": "structured", "setting": "default", "kind": "probe", "seconds": 120.0}
    probe["commit"] = args.commit
    [found] = run_case(probe)
    if "problem" in found:
        raise SystemExit(found["problem"])
    machine = found["provenance"]
    machine["command"] = provenance.command()
    results.setdefault("runs", []).append(machine)
    kind = "gpu" if machine["platform"] == "gpu" else "cpu"
    available = {"structured", "mujoco", "mjx"} | ({"warp"} if report.warp_runs(machine) else set())
    cases = plan(args, kind, available)
    costs: list[float] = []
    if any(c["kind"] == "grasp" for c in cases):
        costs = reference(args, results, max(c["reference"] for c in cases))
    total = sum(c["weight"] for c in cases)
    for number, case in enumerate(cases, 1):
        left = args.budget - (time.monotonic() - begin)
        case["seconds"] = max(left, 0.0) * case.pop("weight") / max(total, 1e-9)
        total -= case["seconds"] * total / max(left, 1e-9) if left > 0 else 0
        late = {k: v for k, v in case.items() if k in report.KEY and k != "worlds"}
        records = run_case(case) if left > 0 else [{**late, "skipped": "no time left"}]
        for record in records:
            report.add(results, record, costs)
            print(f"[{number}/{len(cases)}]", report.line(record), flush=True)
        output.write_json(args.json, results)
    print(report.tables(results))


if __name__ == "__main__":
    main()
