"""Runs everything that needs a GPU, tests and rates, and writes the result with its provenance.

python -m scripts.gpu_suite --json docs/data/gpu_suite_h200.json

A change of the kernel counts as done for GPUs when this ran with it on one.  Nearly all of the time
is compiling, on the host's cores: every rate and every test has a process that compiles by itself,
rates wait for their turn, and the GPU is given to one rate after the other once no test runs.  The
file is written again after each test and each rate, so that what was found before an interruption
is kept.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from codesign_jax import scene as scenes
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import Scene
from scripts.shared import output, provenance, work

RATES: dict[str, dict[str, Any]] = {
    "spheres": {},
    "spheres, float64": {"dtype": np.float64, "worlds": 4096},
    "spheres, 40 links": {"discretization": {"links": 40}},
    "hull": {"effects": {"surface": "hull"}},
    "spheres and fingers": {"effects": {"finger_finger": True}},
    # Hands whose fingers start apart; the other cases' designs put fingers into one another.
    "hull and fingers": {"scene": "paper"},
    # The same scene with less of it: its constants alone take more iterations than paper_spheres'.
    "hull, the paper's constants": {"scene": "paper", "effects": {"finger_finger": False}},
    "spheres, the paper's constants": {
        "scene": "paper",
        "effects": {"finger_finger": False, "surface": "spheres"},
    },
    "household meshes": {"objects": "household"},
}
RATES |= {
    f"{name}, whole grasps": {**RATES[name], "whole": True, "worlds": 1728}
    for name in ("spheres", "hull", "hull and fingers", "household meshes")
}
RATES |= {
    f"gradient, {name}, {worlds} worlds": {"scene": name, "gradient": worlds}
    for name in ("paper_spheres", "paper")
    for worlds in (60, 1728)
}
WORLDS, STEPS, DISTINCT = 16384, 50, 24
REPETITIONS, ENOUGH_SECONDS = 5, 2.0
"""Runs of a rate, fewer if they have taken long enough together: they differ by about 1 %."""
LIMIT_SECONDS = 240
"""Wait for one rate: the longest takes 20 s, but a first one may still be compiling."""


class Recorder:
    """Remembers how each test ended."""

    def __init__(self, write: Callable[[], None]) -> None:
        """Starts empty; `write` is called after each test."""
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


def rate(name: str, values: dict[str, Any], wait: Callable[[], Any]) -> dict[str, Any]:
    """World-steps a second in contact or of whole grasps; the times of gradients."""
    values = dict(values)
    if "gradient" in values:
        return {"case": name} | gradient(scenes.load(values["scene"]), values["gradient"], wait)
    dtype, worlds = values.pop("dtype", np.float32), values.pop("worlds", WORLDS)
    objects, whole = values.pop("objects", None), values.pop("whole", False)
    base, effects = values.pop("scene", "paper_spheres"), values.get("effects", {})
    scene = scenes.load(base, object_set=objects, overrides=values)
    if whole:
        fields, ctrl = work.inputs(scene, work.make_worlds(scene, worlds))
        index = np.arange(worlds)
    else:
        # Start states are those of MuJoCo C, which has neither hull nor meshes: spheres' serve.
        bare = effects | {"surface": "spheres"}
        plain = scenes.load(base, overrides={**values, "effects": bare})
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
    wait()
    jax.block_until_ready(compiled(fields, ctrl))
    times: list[float] = []
    while len(times) < REPETITIONS and sum(times) < ENOUGH_SECONDS:
        begin = time.perf_counter()
        jax.block_until_ready(compiled(fields, ctrl))
        times.append(time.perf_counter() - begin)
    median = float(np.median(times))
    steps = ctrl.shape[1]
    found = {"case": name, "worlds": worlds, "steps": steps, "median_s": median}
    found |= {"repetitions": len(times), "compile_s": round(built, 2)}
    return found | {"world_steps_per_s": worlds * steps / median}


def gradient(scene: Scene, worlds: int, wait: Callable[[], Any]) -> dict[str, Any]:
    """Seconds of whole grasps and of their value with its gradient, and how many are finite."""
    fields, ctrl = work.inputs(scene, work.make_worlds(scene, worlds))
    fields, ctrl = jax.tree.map(lambda x: jax.numpy.asarray(x, np.float32), (fields, ctrl))
    engine = StructuredEngine(scene)
    weights = np.random.default_rng(0).normal(size=ctrl.shape[1]).astype(np.float32)

    def value(fields: Any, ctrl: jax.Array) -> jax.Array:
        return (engine.rollout(fields, ctrl).distance @ weights).sum()

    programs = {"forward": value, "value_and_gradient": jax.value_and_grad(value, (0, 1))}
    compiled = {n: jax.jit(f).lower(fields, ctrl).compile() for n, f in programs.items()}
    wait()
    found: dict[str, Any] = {"worlds": worlds, "steps": ctrl.shape[1]}
    for name, program in compiled.items():
        seconds = []
        for _ in range(REPETITIONS):
            begin = time.perf_counter()
            result = jax.block_until_ready(program(fields, ctrl))
            seconds.append(time.perf_counter() - begin)
        found[name] = min(seconds)
    found["ratio"] = found["value_and_gradient"] / found["forward"]
    each = [np.isfinite(x).reshape(worlds, -1).all(1) for x in jax.tree.leaves(result[1])]
    return found | {"finite": float(np.all(each, 0).mean())}


class Rate:
    """A process that measures one case: it compiles at once, and runs when told to."""

    def __init__(self, name: str, worlds: int | None):
        """Starts the process."""
        double = RATES[name].get("dtype") == np.float64
        environment = {**os.environ, "JAX_ENABLE_X64": str(int(double))}
        command = [sys.executable, "-m", "scripts.gpu_suite", "--case", name]
        command += ["--worlds", str(worlds)] if worlds else []
        self.name = name
        self._process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def measure(self) -> dict[str, Any]:
        """Lets it run, and waits for the rate."""
        try:
            output, _ = self._process.communicate("run\n", timeout=LIMIT_SECONDS)
        except subprocess.TimeoutExpired:
            self.stop()
            return {"case": self.name, "failed": f"no rate in {LIMIT_SECONDS} s"}
        if status := self._process.returncode:
            return {"case": self.name, "failed": f"exit status {status}, see its messages"}
        return json.loads(output.splitlines()[-1])

    def stop(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()


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
    """Command line."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, default=Path("runs/gpu_suite.json"))
    parser.add_argument("--case", choices=RATES, help="measure one case when a line is entered")
    parser.add_argument("--rates", nargs="*", choices=RATES, default=[*RATES], metavar="CASE")
    parser.add_argument("--worlds", type=int, help="worlds of every rate, to try the suite itself")
    parser.add_argument("--processes", type=int, default=12, help="tests that run at once")
    parser.add_argument(
        "--parts", nargs="+", choices=("rates", "tests"), default=["rates", "tests"]
    )
    arguments = parser.parse_args()
    # Many processes share the GPU's memory.
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    if arguments.case:
        values = dict(RATES[arguments.case])
        key = "gradient" if "gradient" in values else "worlds"
        values |= {key: arguments.worlds} if arguments.worlds else {}
        print(json.dumps(rate(arguments.case, values, wait=sys.stdin.readline)))
        return 0
    return suite(arguments)


def suite(arguments: argparse.Namespace) -> int:
    """Runs the chosen parts and writes the file; the exit status."""
    begin, rates = time.monotonic(), []
    made = provenance.measurement(arguments.commit)

    def write() -> None:
        result = {"provenance": made, "seconds": round(time.monotonic() - begin, 1)}
        result |= {"rates": rates, "tests": recorder.tests}
        output.write_json(arguments.json, result)

    recorder, code = Recorder(write), 0
    chosen = arguments.rates if "rates" in arguments.parts else []
    waiting = [Rate(name, arguments.worlds) for name in chosen]
    try:
        if "tests" in arguments.parts:
            code = run_tests(recorder, arguments.processes)
            print(f"tests: {time.monotonic() - begin:.0f} s", flush=True)
        while waiting:
            rates.append(waiting.pop(0).measure())
            code |= int("failed" in rates[-1])
            print(rates[-1], flush=True)
            write()
    finally:
        for process in waiting:
            process.stop()
    write()
    return code


if __name__ == "__main__":
    raise SystemExit(main())
