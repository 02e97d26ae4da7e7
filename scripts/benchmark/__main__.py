"""Measures the engines against each other on the scene `paper_spheres`, one case a process.

python -m scripts.benchmark --json docs/data/benchmark_cpu.json

Whole grasps, with verdicts against converged float64 MuJoCo C.  A second run with the same file
replaces the cases that it measures and keeps the others, so that engines can be measured in several
runs: --engines structured, then --engines mjx.
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
from scripts.benchmark.cases import Case
from scripts.shared import output, peers, provenance

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
REFERENCE = {"cpu": 360, "gpu": 1728}
"""Worlds whose verdicts are compared."""
QUICK = 12
"""Worlds of a case with --quick."""


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, default=Path("runs/benchmark.json"))
    parser.add_argument(
        "--engines",
        nargs="+",
        default=["structured", "mujoco", "mjx", "warp"],
        help="names, or name:setting for one setting",
    )
    parser.add_argument("--worlds", nargs="+", type=int, help="batch sizes instead of the usual")
    parser.add_argument("--reference", type=Path, help="file to take the reference costs from")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--budget", type=float, default=2400.0, help="seconds in all")
    parser.add_argument("--quick", action="store_true", help="a few worlds: does it run?")
    parser.add_argument("--case", nargs=2, type=Path, help="CASE.json RECORDS.jsonl: run one case")
    return parser.parse_args()


def run_case(case: dict[str, Any], grace: float = 120.0) -> list[dict[str, Any]]:
    """Runs a case in a process of its own; returns its records, or what went wrong as one."""
    named = {k: case[k] for k in ("engine", "setting")}
    # Warp allocates beside JAX, which otherwise takes most of the device's memory.
    extra = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} if case["engine"] == "warp" else {}
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("case.json", "records.jsonl")]
        files[0].write_text(json.dumps(case))
        command = [sys.executable, "-m", "scripts.benchmark", "--case", *map(str, files)]
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


def plan(args: argparse.Namespace, kind: str, available: set[str]) -> list[dict[str, Any]]:
    """The cases of a run; `weight` is their share of the budget."""
    count = QUICK if args.quick else REFERENCE[kind]
    every = {"repeats": 1 if args.quick else args.repeats, "reference": count}
    cases = []
    for name in args.engines:
        engine, _, setting = name.partition(":")
        if engine not in available or (args.quick and engine == "mjx"):  # a minute to compile
            continue
        worlds = args.worlds or ([QUICK] if args.quick else SIZES[kind][engine])
        for one in [setting] if setting else peers.settings(engine):
            head = {"engine": engine, "setting": one, "worlds": worlds, "commit": args.commit}
            cases.append({**every, **head, "weight": 2.0 if engine == "mjx" else 1.0})
    return cases


def reference(args: argparse.Namespace, results: dict, count: int) -> list[float]:
    """Costs of converged MuJoCo C: of this file, of --reference, or computed."""
    stored = results.get("reference", {})
    if args.reference and not stored:
        stored = json.loads(args.reference.read_text())["reference"]
    if stored.get("key") == report.reference_key() and len(stored["costs"]) >= count:
        return stored["costs"]
    case = {"engine": "reference", "setting": "converged", "worlds": [count]}
    limits = {"repeats": 0, "reference": count, "seconds": args.budget, "commit": args.commit}
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
    if args.case:
        Case(json.loads(args.case[0].read_text()), args.case[1]).run()
        return
    begin = time.monotonic()
    results = json.loads(args.json.read_text()) if args.json.exists() else {"records": []}
    probe = {"engine": "structured", "setting": "default", "seconds": 120.0, "probe": True}
    [found] = run_case(probe | {"commit": args.commit})
    if "problem" in found:
        raise SystemExit(found["problem"])
    machine = found["provenance"] | {"command": provenance.command()}
    results.setdefault("runs", []).append(machine)
    kind = "gpu" if machine["platform"] == "gpu" else "cpu"
    warp = {"warp"} if kind == "gpu" and machine["warp"] else set()
    cases = plan(args, kind, {"structured", "mujoco", "mjx"} | warp)
    costs = reference(args, results, max(c["reference"] for c in cases))
    total = sum(c["weight"] for c in cases)
    for number, case in enumerate(cases, 1):
        left = args.budget - (time.monotonic() - begin)
        weight = case.pop("weight")
        case["seconds"] = max(left, 0.0) * weight / total
        total -= weight
        late = {k: case[k] for k in ("engine", "setting")}
        records = run_case(case) if left > 0 else [{**late, "skipped": "no time left"}]
        for record in records:
            report.add(results, record, costs)
            print(f"[{number}/{len(cases)}]", report.line(record), flush=True)
        output.write_json(args.json, results)
    print(report.table(results))


if __name__ == "__main__":
    main()
