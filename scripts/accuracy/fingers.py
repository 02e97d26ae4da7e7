"""The presets with contact between fingers: what they decide of late designs.

python -m scripts.accuracy.fingers --json docs/data/fingers_cpu.json     # 12 minutes of two cores
python -m scripts.accuracy.fingers --json docs/data/fingers_cpu.json --report --page PAGE

The rest of the study has no contact between fingers, which makes a grasp several times as dear.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from codesign_jax.scene import load
from scripts.accuracy import analysis, decision
from scripts.accuracy.settings import FINE, FINGERS, PRESETS, Setting
from scripts.accuracy.tables import interval
from scripts.shared import addition, output, provenance, tables

PARTICLES, TRIALS = 60, 12


def settings() -> dict[str, Setting]:
    """The presets but the reference, and what they are compared with, the last one."""
    found = {f"`{n}`": s for n, s in PRESETS.items() if n != "reference"} | {FINE.label: FINE}
    return {n: dataclasses.replace(s, extra=(FINGERS,)) for n, s in found.items()}


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Simulates the settings that the file does not have yet."""
    late = decision.populations(args.data, PARTICLES)["late"]
    found: dict[str, Any] = {"settings": {}}
    if args.json.exists():
        found = json.loads(args.json.read_text())
    for name, setting in settings().items():
        if name in found["settings"]:
            continue
        request = decision.Request("late", late, TRIALS)
        made = decision.simulate(setting, [request], TRIALS)
        found["settings"][name] = made["populations"][0]
        found["made"] = provenance.results(args.commit)
        output.write_json(args.json, found)
        print(f"{name}: {made['seconds_with_compile']} s", flush=True)
    return found


def table(found: dict[str, Any]) -> str:
    """Success of each setting, and what it decides otherwise than the last one."""
    scene = load("paper")
    every = {name: decision.costs(scene, each) for name, each in found["settings"].items()}
    truth = list(every.values())[-1]
    rows = [["with contact between fingers", "success", "verdicts that flip"]]
    rows[0] += ["success, difference", "STUCK"]
    for name, cost in every.items():
        compared = analysis.compare(cost, truth)
        stuck = found["settings"][name]["status"].get("STUCK", 0) / cost.size
        cells = [f"{compared['success'].value:.1%}", *["–"] * 2]
        if cost is not truth:
            cells[1:] = [
                interval(compared["flipped"]),
                interval(compared["success_difference"], "+.1%"),
            ]
        rows.append([name, *cells, f"{stuck:.1%}"])
    return tables.markdown(rows)


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = addition.parser(__doc__, "fingers")
    parser.add_argument("--data", type=Path, default=Path("docs/data/paper"))
    return addition.main(parser.parse_args(), run, table, "fingers")


if __name__ == "__main__":
    sys.exit(main())
