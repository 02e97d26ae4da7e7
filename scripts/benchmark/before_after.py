"""Rates on a GPU of another state of the code and of this one, in turn on the same machine.

git archive COMMIT | tar -x -C /tmp/before
python -m scripts.benchmark.before_after --before /tmp/before --json runs/before_after.json

All cases are compiled at once, each in a process, and run one after the other, those of the two
states in pairs. The file is written again after each of them.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from scripts.shared import output, provenance

CASES = (
    ("hull and fingers", 16384),
    ("hull and fingers, whole grasps", 1728),
    ("hull and fingers, whole grasps", 60),
    ("hull, the paper's constants", 16384),
    ("spheres", 16384),
)
"""Cases of `scripts.gpu_suite`, with their worlds."""


def main() -> None:
    """Command line."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--before", type=Path, required=True, help="folder of the other state")
    parser.add_argument("--json", type=Path, default=Path("runs/before_after.json"))
    arguments = parser.parse_args()
    started = []
    for name, worlds in CASES:
        command = [sys.executable, "-m", "scripts.gpu_suite", "--case", name]
        for state, folder in (("before", arguments.before), ("after", Path())):
            process = subprocess.Popen(
                [*command, "--worlds", str(worlds)],
                cwd=folder,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            started.append((state, name, worlds, process))
    records: list[dict[str, Any]] = []
    for state, name, worlds, process in started:
        text, _ = process.communicate("run\n")
        lines = text.splitlines()
        found = json.loads(lines[-1]) if lines else {"case": name, "failed": process.returncode}
        records.append({"state": state, **found, "worlds": worlds})
        print(records[-1], flush=True)
        made = provenance.measurement(arguments.commit)
        output.write_json(arguments.json, {"provenance": made, "records": records})


if __name__ == "__main__":
    main()
