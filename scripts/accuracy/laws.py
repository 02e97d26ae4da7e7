"""What a law of contact or elasticity decides: late designs of the default scene, with and without.

python -m scripts.accuracy.laws effects.soft_touch=true --json docs/data/touch.json
python -m scripts.accuracy.laws effects.soft_touch=true --json docs/data/touch.json --report

Each variant of the scene is simulated as it is, with its objects moved by a micrometre, and with
a shorter step: a law that leaves fewer verdicts to chance lets fewer of them flip.  All variants
have the same designs, those in which runs with contact between fingers ended, and the same trials.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.scene import load
from scripts.accuracy import analysis, decision
from scripts.accuracy.settings import FINGERS, Setting
from scripts.accuracy.tables import interval
from scripts.shared import addition, output, provenance, tables

AS_IS = "as the scene is"


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Simulates the variants that the file does not have yet."""
    late = decision.populations(args.data, args.particles)["late"]
    found: dict[str, Any] = {"variants": {}}
    if args.json.exists():
        found = json.loads(args.json.read_text())
    for change in (None, *args.change):
        for step in (10.0, args.step):
            name = f"{change or AS_IS}, {step:g} ms"
            if name in found["variants"]:
                continue
            extra = (FINGERS, *(change.split(",") if change else ()))
            setting = Setting(timestep=step, damping=args.damping, extra=extra)
            moved = (False, True) if step == 10.0 else (False,)
            requests = [decision.Request("late", late, args.trials, m) for m in moved]
            made = decision.simulate(setting, requests, min(args.block, args.trials))
            found["variants"][name] = made["populations"]
            found["made"] = provenance.results(args.commit)
            output.write_json(args.json, found)
            print(f"{name}: {made['seconds_with_compile']} s", flush=True)
    return found


def table(found: dict[str, Any]) -> str:
    """Success of each variant, its flips, and what it decides otherwise than the scene as it is."""
    scene = load("paper")
    head = ["", "success", "STUCK", "flips by a micrometre", "flips by the step"]
    rows, first = [[*head, "success by the step", "changed verdicts", "changed success"]], None
    every = found["variants"]
    names = list(every)
    for name, short in zip(names[::2], names[1::2], strict=True):
        normal, moved, finer = (
            decision.costs(scene, r) for r in (every[name][0], every[name][1], every[short][0])
        )
        nudge, step = (analysis.compare(normal, other) for other in (moved, finer))
        stuck = np.mean([r["status"].get("STUCK", 0) / normal.size for r in every[name]])
        cells = [f"{nudge['success'].value:.1%}", f"{stuck:.2%}", interval(nudge["flipped"])]
        cells += [interval(step["flipped"]), interval(step["success_difference"], "+.1%")]
        if first is not None:
            other = analysis.compare(normal, first)
            cells += [interval(other["flipped"]), interval(other["success_difference"], "+.1%")]
        rows.append([name, *cells, *["–"] * (7 - len(cells))])
        first = normal if first is None else first
    return tables.markdown(rows)


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = addition.parser(__doc__, "laws")
    parser.add_argument("change", nargs="*", help="values of the scene's keys, with commas between")
    parser.add_argument("--data", type=Path, default=Path("docs/data/experiments"))
    parser.add_argument("--particles", type=int, default=60)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--block", type=int, default=100, help="trials of a call")
    parser.add_argument("--step", type=float, default=2.0, help="the shorter step [ms]")
    fields = {f.name: f for f in dataclasses.fields(Setting)}
    parser.add_argument("--damping", default=fields["damping"].default)
    return addition.main(parser.parse_args(), run, table, "laws")


if __name__ == "__main__":
    sys.exit(main())
