"""Runs the tests that need a GPU and writes how each ended, with what it ran on.

python -m scripts.gpu_suite --json runs/gpu_suite.json

A change of the kernel counts as done for GPUs when this passed on one.  Nearly all of the time is
compiling, on the host's cores, so several tests run at once.  The file is written again after each
test, so that what was found before an interruption is kept.  Rates: `scripts.benchmark`.
"""

import importlib.util
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scripts.shared import output, provenance


class Recorder:
    def __init__(self, write: Callable[[], None]) -> None:
        self.tests: dict[str, dict[str, Any]] = {}
        self._write = write

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Called by pytest for each phase of a test."""
        if report.when == "call" or report.outcome != "passed":
            self.tests[report.nodeid] = {
                "outcome": report.outcome,
                "seconds": round(report.duration, 2),
            }
            self._write()


def run_tests(recorder: Recorder, processes: int) -> int:
    """Runs the tests that need a GPU, several at once; pytest's exit status."""
    # Only files with such tests, so that the others' dependencies need not be there.
    paths = sorted(Path("tests").glob("test_*.py"))
    files = [str(p) for p in paths if "pytest.mark.gpu" in p.read_text(encoding="utf-8")]
    options = ["-m", "gpu", "-q", "-p", "no:cacheprovider", *files]
    # Other plugins that happen to be installed may not bear several processes.
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    if processes > 1 and importlib.util.find_spec("xdist"):
        options += ["-p", "xdist.plugin", "-n", str(processes), "--dist", "worksteal"]
    return int(pytest.main(options, plugins=[recorder]))


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, default=Path("runs/gpu_suite.json"))
    parser.add_argument("--processes", type=int, default=12, help="tests that run at once")
    arguments = parser.parse_args()
    # Many processes share the GPU's memory.
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    begin = time.monotonic()
    measurement = provenance.measurement(arguments.commit)

    def write() -> None:
        seconds = round(time.monotonic() - begin, 1)
        content = {"provenance": measurement, "seconds": seconds, "tests": recorder.tests}
        output.write_json(arguments.json, content)

    recorder = Recorder(write)
    return run_tests(recorder, arguments.processes)


if __name__ == "__main__":
    raise SystemExit(main())
