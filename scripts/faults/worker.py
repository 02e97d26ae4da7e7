"""A process that runs cases: python -m scripts.faults.worker, started by `harness` alone.

Reads a line of JSON for each request on stdin, and writes a line for each finished case on stdout.
"""

import argparse
import json
import os
import signal
import sys
import time
import traceback
from pathlib import Path

from scripts.faults import forked
from scripts.faults.store import Result

MODULES = "modules.json"
"""File of the names of all modules that a finished run imported."""
_LATER = ("scripts.faults", "evosax", "__")
"""Not before the fork: evosax uses JAX when it is imported."""
_FIRST = ("codesign_jax.cli", "codesign_jax.commands.optimize", "codesign_jax.report.figures")


def main() -> None:
    """Serves requests until stdin is closed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--library", type=Path, required=True)
    options = parser.parse_args()
    forked.end_with_parent()
    forked.obey_permissions()
    # A shell that starts the harness in the background lets it ignore what cases send.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)
    os.dup2(2, 1)  # what a case writes by mistake is no answer
    server = forked.Server(_imported(options.folder / MODULES))
    # Only now: a fork imports this module again, and these take seconds.
    from scripts.faults import bench, cases, finished

    here = bench.Bench(options.folder, options.library, server)
    for line in requests:
        request = json.loads(line)
        if "prepare" in request:
            for kind in finished.RUNS:
                finished.place(here, kind)
            (options.folder / MODULES).write_text(json.dumps(sorted(sys.modules)))
            print(json.dumps({"prepared": True}), file=answers, flush=True)
            continue
        case = cases.CAMPAIGNS[request["campaign"]].case
        for number in range(request["first"], request["stop"]):
            begin = time.monotonic()
            try:
                result = case(here, number)
            except bench.Hung as hung:
                result = Result("hung", str(hung))
            except Exception:
                result = Result("traceback", "of the harness:\n" + traceback.format_exc())
            took = time.monotonic() - begin
            answer = {"number": number, "took": round(took, 3)} | result._asdict()
            print(json.dumps(answer), file=answers, flush=True)
    here.close()
    os._exit(0)  # threads of interrupted cases may go on


def _imported(path: Path) -> list[str]:
    """Names of what a command will need, so that its forks need not import it."""
    names = json.loads(path.read_text()) if path.exists() else []
    return [name for name in (*_FIRST, *names) if not name.startswith(_LATER)]


if __name__ == "__main__":
    main()
