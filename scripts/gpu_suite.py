"""Runs everything that needs a GPU, tests and rates, and writes the result with its provenance.

python scripts/gpu_suite.py --json docs/data/gpu_suite_h200.json

A change of the kernel counts as done for GPUs when this ran with it on one.
"""

import argparse
import json
import os
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from codesign_jax import scene as scenes
from codesign_jax.benchmark import measure, work
from codesign_jax.engines.structured import StructuredEngine

RATES: dict[str, dict[str, Any]] = {
    "spheres": {},
    "spheres, float64": {"dtype": np.float64, "worlds": 4096},
    "spheres, 40 links": {"discretization": {"links": 40}},
    "hull": {"effects": {"surface": "hull"}},
    "spheres and fingers": {"effects": {"finger_finger": True}},
    "hull and fingers": {"effects": {"surface": "hull", "finger_finger": True}},
    "household meshes": {"objects": "household"},
}
RATES |= {
    f"{name}, whole grasps": {**RATES[name], "whole": True, "worlds": 1728}
    for name in ("spheres", "hull", "hull and fingers", "household meshes")
}
WORLDS, STEPS, DISTINCT = 16384, 50, 24


class Recorder:
    """Remembers how each test ended."""

    def __init__(self) -> None:
        """Starts empty."""
        self.tests: dict[str, dict[str, Any]] = {}

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Called by pytest for each phase of a test."""
        if report.when == "call" or report.outcome != "passed":
            self.tests[report.nodeid] = {
                "outcome": report.outcome,
                "seconds": round(report.duration, 2),
            }


def rate(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """World-steps a second of short rollouts in contact, or of whole grasps.

    Args:
      name: Name of the case.
      values: Its overrides of the scene, object set, dtype, number of worlds, whether grasps are
        whole.
    """
    values = dict(values)
    dtype, worlds = values.pop("dtype", np.float32), values.pop("worlds", WORLDS)
    objects, whole = values.pop("objects", None), values.pop("whole", False)
    scene = scenes.load("paper_spheres", object_set=objects, overrides=values)
    if whole:
        fields, ctrl = work.inputs(scene, work.make_worlds(scene, worlds))
        index = np.arange(worlds)
    else:
        # Start states are those of MuJoCo C, which has neither hull nor meshes: spheres' serve.
        apart = {"finger_finger": values.pop("effects", {}).get("finger_finger", False)}
        plain = scenes.load("paper_spheres", overrides={**values, "effects": apart})
        starts, ctrl = work.window(plain, DISTINCT, STEPS, distinct=DISTINCT)
        made, _ = work.inputs(scene, work.make_worlds(scene, DISTINCT))
        fields = made._replace(start=starts.start)
        index = np.arange(worlds) % DISTINCT
    fields, ctrl = jax.tree.map(lambda x: jax.numpy.asarray(x, dtype)[index], (fields, ctrl))
    engine = StructuredEngine(scene)
    run = jax.jit(lambda f, c: engine.rollout(f, c).distance[:, -1])
    begin = time.perf_counter()
    compiled = run.lower(fields, ctrl).compile()
    built = time.perf_counter() - begin
    jax.block_until_ready(compiled(fields, ctrl))
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(fields, ctrl))
        times.append(time.perf_counter() - begin)
    median = float(np.median(times))
    steps = ctrl.shape[1]
    found = {"case": name, "worlds": worlds, "steps": steps, "median_s": median}
    return {**found, "compile_s": round(built, 2), "world_steps_per_s": worlds * steps / median}


def in_a_process_of_its_own(name: str) -> dict[str, Any]:
    """The rate of a case in float64, which is a setting of the whole process."""
    environment = {"JAX_ENABLE_X64": "1", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    command = [sys.executable, __file__, "--case", name]
    done = subprocess.run(
        command, env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, default=Path("runs/gpu_suite.json"))
    parser.add_argument("--case", choices=RATES, help="print the rate of one case, nothing else")
    parser.add_argument("--commit", help="commit of the code, for a machine without its repository")
    parser.add_argument(
        "--parts", nargs="+", choices=("rates", "tests"), default=["rates", "tests"]
    )
    arguments = parser.parse_args()
    if arguments.case:
        print(json.dumps(rate(arguments.case, RATES[arguments.case])))
        return 0
    begin, recorder, rates, code = time.monotonic(), Recorder(), [], 0
    provenance = measure.provenance(commit=arguments.commit)

    def write() -> None:
        result = {"provenance": provenance, "seconds": round(time.monotonic() - begin, 1)}
        result |= {"rates": rates, "tests": recorder.tests}
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")

    for name, values in RATES.items() if "rates" in arguments.parts else ():
        try:
            double = values.get("dtype") == np.float64
            rates.append(in_a_process_of_its_own(name) if double else rate(name, values))
        except Exception as error:  # one case must not hide the others
            traceback.print_exc()
            rates.append({"case": name, "failed": f"{type(error).__name__}: {error}"[:500]})
            code = 1
        print(rates[-1], flush=True)
        write()
    if "tests" in arguments.parts:
        # Only files with such tests, so that the others' dependencies need not be there.
        paths = sorted(Path("tests").glob("test_*.py"))
        files = [str(p) for p in paths if "pytest.mark.gpu" in p.read_text(encoding="utf-8")]
        options = ["-m", "gpu", "-q", "-p", "no:cacheprovider", *files]
        code |= int(pytest.main(options, plugins=[recorder]))
    write()
    return code


if __name__ == "__main__":
    raise SystemExit(main())
