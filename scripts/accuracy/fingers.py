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
from scripts.shared import provenance, tables

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
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(found, indent=1) + "\n")
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, default=Path("runs/fingers.json"))
    parser.add_argument("--data", type=Path, default=Path("docs/data/paper"))
    parser.add_argument("--report", action="store_true", help="print the table of the file")
    parser.add_argument("--page", type=Path, help="page whose table is filled in")
    provenance.add_commit(parser)
    args = parser.parse_args()
    text = table(json.loads(args.json.read_text()) if args.report else run(args))
    print(text)
    if args.page:
        tables.fill(args.page, text, "fingers")
    return 0


if __name__ == "__main__":
    sys.exit(main())
