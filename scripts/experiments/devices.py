"""Runs an experiment on one device and on several: the same numbers, and how much sooner.

python -m scripts.experiments.devices --json docs/data/devices.json      # machine with two GPUs
python -m scripts.experiments.devices --json runs/devices.json --size tiny  # on a CPU, minutes

Each number of devices is a process of `scripts.experiments` that sees so many.  All trials of all
are compared bit by bit.  Exit status 1: they differ.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from scripts.experiments import plan
from scripts.shared import output, provenance


def parse() -> argparse.Namespace:
    """Reads the command line."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, default=Path("runs/devices.json"))
    parser.add_argument("--experiment", choices=["2d", "23d"], default="23d")
    parser.add_argument("--size", choices=list(plan.OVERRIDES), default="short")
    parser.add_argument("--counts", type=lambda s: [int(n) for n in s.split(",")], default=[1, 2])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    return parser.parse_args()


def run(args: argparse.Namespace, count: int, folder: Path) -> tuple[dict[str, Any], Any]:
    """Runs the experiment on the first devices.

    Args:
      args: The command line.
      count: Number of devices.
      folder: Where the run is written.

    Returns:
      Provenance and arrays of all trials.

    Raises:
      CalledProcessError: If the run fails.
    """
    command = [sys.executable, "-m", "scripts.experiments", args.experiment]
    command += ["--size", args.size, "--devices", str(count), "--out", str(folder)]
    command += ["--trials", str(folder / "trials.npz")]
    command += [part for pair in args.set for part in ("--set", pair)]
    command += ["--commit", args.commit] if args.commit else []
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={count}"
    visible = {"CUDA_VISIBLE_DEVICES": ",".join(map(str, range(count))), "XLA_FLAGS": flags}
    subprocess.run(command, check=True, env=os.environ | visible)
    notes = json.loads((folder / f"{args.experiment}.json").read_text())
    with np.load(folder / "trials.npz", allow_pickle=False) as file:
        return notes, {name: file[name] for name in file.files}


def compare(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Runs on every number of devices, and compares each with the first."""
    runs = {n: run(args, n, folder / str(n)) for n in args.counts}
    (notes, first), rows = runs[args.counts[0]], {}
    for count, (other, record) in runs.items():
        differ = [k for k in first if first[k].tobytes() != record[k].tobytes()]
        last = other["processes"][-1]
        rows[str(count)] = {
            "different_arrays": differ,
            "grasps_per_s": last["rate"],
            "compile_seconds": last["compile_seconds"],
            "speedup": round(last["rate"] / notes["processes"][-1]["rate"], 3),
        }
    kept = ("commit", "modified", "python", "versions", "platform", "device", "settings", "grasps")
    arrays = {"arrays": len(first), "bytes": sum(v.nbytes for v in first.values())}
    return {
        "command": provenance.command(),
        **{k: notes[k] for k in kept if k in notes},
        "compared": arrays,
        "devices": rows,
    }


def main() -> int:
    """Runs the command and returns the exit status."""
    args = parse()
    with tempfile.TemporaryDirectory() as folder:
        found = compare(args, Path(folder))
    output.write_json(args.json, found, indent=2)
    for count, row in found["devices"].items():
        text = f"{len(row['different_arrays'])} of {found['compared']['arrays']} arrays differ"
        print(f"{count} device(s): {row['speedup']:.2f} times the first's grasps/s, {text}")
    return int(any(row["different_arrays"] for row in found["devices"].values()))


if __name__ == "__main__":
    sys.exit(main())
