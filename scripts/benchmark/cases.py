"""Runs a single case of the benchmark in a process of its own and writes its records."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import cost, rollout
from codesign_jax.engines.mujoco import world_model
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Trace, failed
from scripts.shared import measure, peers, provenance, work
from scripts.shared.statistics import quantiles

# Steps between states at which accelerations are compared.
_STRIDE = 3


class Case:
    """A case: what is run, for how long, and where its records go."""

    def __init__(self, values: dict[str, Any], output: Path):
        """Takes the case's values, see `plan` in scripts.benchmark."""
        self.values, self.output = values, output
        self.engine, self.setting = values["engine"], values["setting"]
        self.until = time.monotonic() + values["seconds"]
        solver = peers.solver_values(self.engine, self.setting)
        self.scene = work.variant(**values.get("variant", {}), solver=solver)
        # The arguments are temporary files: they say nothing later.
        made = provenance.measurement(values.get("commit"))
        self.provenance = made | {"command": "python -m scripts.benchmark.case"}

    def write(self, record: dict[str, Any]) -> None:
        """Appends a record; at once, so that a killed case keeps what it has."""
        names = ("engine", "setting", "kind", "variant", "growth")
        start = {k: self.values[k] for k in names if k in self.values}
        with self.output.open("a") as file:
            file.write(json.dumps({**start, **record}) + "\n")

    def run(self) -> None:
        """Runs the case."""
        kind = self.values["kind"]
        if kind == "probe":
            self.write({"provenance": self.provenance})
        elif kind == "residual":
            self.write({"provenance": self.provenance, **accelerations(self)})
        elif kind == "compile":
            measure.use_cache(self.values["cache"])
            window = self.values["part"] == "window"
            program = self._program(self.values["worlds"][0], self.values["steps"], window)
            self.write(program.times)
        else:
            self._sizes(window=kind == "window")

    def _sizes(self, *, window: bool) -> None:
        """Measures one batch size after the other, growing, until the time is over."""
        before = None
        for worlds in self.values["worlds"]:
            if (
                before
                and time.monotonic() + before["first_s"] * worlds / before["worlds"] > self.until
            ):
                self.write({"worlds": worlds, "skipped": "no time left"})
                continue
            if before is None:
                measure.use_cache()
            record = self._measure(worlds, window, first=before is None)
            self.write({"provenance": self.provenance, **record})
            before = record

    def _measure(self, worlds: int, window: bool, *, first: bool) -> dict[str, Any]:
        begin = time.perf_counter()
        steps = self.values["steps"] if window else self.scene.num_steps
        program = self._program(worlds, steps, window)
        built = time.perf_counter() - begin
        result, times = measure.repeat(program.run, self.values["repeats"], self.until)
        if isinstance(result, Trace):  # Warp's trace is judged outside of its timing
            result = summary(self.scene, jax.tree.map(jnp.asarray, result))
        outcome, last = result
        record = {
            "worlds": worlds,
            "steps": steps,
            "how": peers.how(self.engine, self.setting),
            "build_s": built,
            **program.times,
            **times,
            **rates(self.scene, worlds, steps, times["median_s"], np.asarray(last)),
            "extrapolated": window,
            "peak_memory_bytes": program.memory()
            if self.engine == "warp"
            else measure.peak_memory(),
        }
        if not window:
            record |= verdicts(outcome, np.asarray(last), self.values["reference"])
        if first and self.engine != "warp" and self.values.get("cached", True):
            record["cached_start_s"] = self._cached_start(worlds)
        return record

    def _cached_start(self, worlds: int) -> float | None:
        """Seconds that tracing and compiling take a new process which finds them in the cache."""
        cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
        again = {"kind": "compile", "part": self.values["kind"], "worlds": [worlds], "cache": cache}
        # The device's memory is this process's; the other one only compiles.
        env = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        with tempfile.TemporaryDirectory() as folder:
            case, found = Path(folder) / "case.json", Path(folder) / "records.jsonl"
            case.write_text(json.dumps({**self.values, **again}))
            command = [sys.executable, "-m", "scripts.benchmark.case", str(case), str(found)]
            if subprocess.run(command, env=env, capture_output=True, check=False).returncode:
                return None
            times = json.loads(found.read_text())
        return times["trace_s"] + times["compile_s"]

    def _program(self, worlds: int, steps: int, window: bool) -> Any:
        scene = self.scene
        if window:
            fields, ctrl = work.window(scene, worlds, steps, distinct=self.values["distinct"])
        if self.engine == "warp":
            from scripts.benchmark.warp import WarpProgram

            if not window:
                fields, ctrl = work.inputs(scene, work.make_worlds(scene, worlds))
            return WarpProgram(scene, fields, np.asarray(ctrl), trajectory=False)
        engine = peers.build(self.engine, self.setting, scene)
        if window:
            return measure.JaxProgram(
                lambda f, c: summary(scene, engine.rollout(f, c)), fields, ctrl
            )
        return measure.JaxProgram(
            lambda p, t: summary(scene, rollout.simulate(scene, engine, p, t)[1]),
            *work.make_worlds(scene, worlds),
        )


def summary(scene: Scene, trace: Trace) -> tuple[Outcome, jax.Array]:
    """Outcomes, and the number of steps in which a world's trace still changed, (world,)."""
    series = jnp.stack([trace.distance, trace.height, trace.speed])
    change = (series[:, :, 1:] != series[:, :, :-1]).any(0)
    steps = change.shape[1] + 1
    last = jnp.where(change, jnp.arange(1, steps), 0).max(1, initial=0)
    return jax.vmap(lambda t: cost.outcome(scene, t))(trace), last + 1


def rates(scene: Scene, worlds: int, steps: int, seconds: float, simulated: np.ndarray) -> dict:
    """Rates of a batch: nominal ones count every step, simulated ones those that were done.

    Args:
      scene: The scene.
      worlds: Number of worlds.
      steps: Steps asked for.
      seconds: Time of the batch [s].
      simulated: Steps in which each world's trace still changed, shape (world,).
    """
    share = float(simulated.sum()) / (worlds * steps)
    nominal = worlds * steps / seconds
    return {
        "nominal_world_steps_per_s": nominal,
        "simulated_world_steps_per_s": nominal * share,
        "simulated_share": share,
        "grasps_per_s": nominal / scene.num_steps,
        "simulated_s_per_s": nominal * scene.discretization.timestep,
    }


def verdicts(outcome: Outcome, simulated: np.ndarray, count: int) -> dict:
    """Costs of the first worlds, failures, and whether decided worlds were simulated on."""
    costs, status = np.asarray(outcome.cost), np.asarray(outcome.status)
    lost = np.isfinite(np.asarray(outcome.lost_time)) & ~failed(status)
    # A world that is lost long before the end and still changes in the last steps is simulated on.
    early = lost & (costs > 0.5)
    return {
        "failed": int(failed(status).sum()),
        "kept": float((costs == 0).mean()),
        "stops_early": bool(simulated[early].mean() < 0.95 * simulated.max())
        if early.any()
        else None,
        "costs": [round(float(c), 6) for c in costs[:count]],
    }


def accelerations(case: Case) -> dict:
    """Relative error of the accelerations that an engine's own trajectory implies.

    Its states are put into MuJoCo C, converged in float64.  Differences of float32 positions put a
    floor under the error, which MuJoCo C's own trajectory, rounded alike, shows.
    """
    worlds, steps = case.values["worlds"][0], case.values["steps"]
    fields, ctrl = work.window(case.scene, worlds, steps, distinct=worlds)
    if case.engine == "warp":
        from scripts.benchmark.warp import WarpProgram

        program = WarpProgram(case.scene, fields, np.asarray(ctrl), trajectory=True)
        qpos = program.run()[0].qpos
    else:
        engine = peers.build(case.engine, case.setting, case.scene)
        program = jax.jit(lambda f, c: engine.rollout(f, c, trajectory=True).qpos)
        qpos = np.asarray(program(fields, ctrl))
    exact = work.variant(**case.values.get("variant", {}), solver=peers.REFERENCE)
    errors = np.concatenate(
        [
            _errors(exact, jax.tree.map(lambda x, w=w: x[w], fields), qpos[w], np.asarray(ctrl[w]))
            for w in range(worlds)
        ]
    )
    return {"worlds": worlds, "steps": steps, "states": errors.size, **quantiles(errors)}


def _errors(scene: Scene, fields: Any, qpos: np.ndarray, ctrl: np.ndarray) -> np.ndarray:
    """Errors along one world's trajectory; the floor of the scale is ten g."""
    oracle = world_model(scene, fields)
    data, h = mujoco.MjData(oracle), oracle.opt.timestep
    states = qpos.astype(float)
    velocity = np.zeros((len(states), oracle.nv))
    for k in range(1, len(states)):
        mujoco.mj_differentiatePos(oracle, velocity[k], h, states[k - 1], states[k])
    errors = []
    for k in range(1, len(states) - 1, _STRIDE):
        data.qpos[:], data.qvel[:], data.ctrl[:] = states[k], velocity[k], ctrl[k]
        mujoco.mj_forward(oracle, data)
        got = (velocity[k + 1] - velocity[k]) / h
        errors.append(np.linalg.norm(got - data.qacc) / max(np.linalg.norm(data.qacc), 100.0))
    return np.array(errors)
