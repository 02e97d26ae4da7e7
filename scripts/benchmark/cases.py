"""Runs a single case of the benchmark in a process of its own and writes its records."""

import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import cost, rollout
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Trace, failed
from scripts.shared import measure, peers, provenance, work


class Case:
    """A case: what is run, for how long, and where its records go."""

    def __init__(self, values: dict[str, Any], output: Path):
        """Takes the case's values, see `plan` in scripts.benchmark."""
        self.values, self.output = values, output
        self.engine, self.setting = values["engine"], values["setting"]
        self.until = time.monotonic() + values["seconds"]
        self.scene = work.variant(solver=peers.solver_values(self.engine, self.setting))
        # The arguments are temporary files: they say nothing later.
        made = provenance.measurement(values.get("commit"))
        self.provenance = made | {"command": "python -m scripts.benchmark"}

    def write(self, record: dict[str, Any]) -> None:
        """Appends a record; at once, so that a killed case keeps what it has."""
        start = {"engine": self.engine, "setting": self.setting, "kind": "grasp"}
        with self.output.open("a") as file:
            file.write(json.dumps({**start, **record}) + "\n")

    def run(self) -> None:
        """Measures one batch size after the other, growing, until the time is over."""
        if self.values.get("probe"):
            return self.write({"provenance": self.provenance})
        before = None
        measure.use_cache()
        for worlds in self.values["worlds"]:
            longer = before["first_s"] * worlds / before["worlds"] if before else 0.0
            if longer and time.monotonic() + longer > self.until:
                self.write({"worlds": worlds, "skipped": "no time left"})
                continue
            before = self._measure(worlds)
            self.write({"provenance": self.provenance, **before})

    def _measure(self, worlds: int) -> dict[str, Any]:
        program = self._program(worlds)
        result, times = measure.repeat(program.run, self.values["repeats"], self.until)
        if isinstance(result, Trace):  # Warp's trace is judged outside of its timing
            result = summary(self.scene, jax.tree.map(jnp.asarray, result))
        outcome, last = result
        steps, warp = self.scene.num_steps, self.engine == "warp"
        return {
            "worlds": worlds,
            "steps": steps,
            "how": peers.how(self.engine, self.setting),
            **program.times,
            **times,
            **rates(self.scene, worlds, steps, times["median_s"], np.asarray(last)),
            "peak_memory_bytes": program.memory() if warp else measure.peak_memory(),
            **verdicts(outcome, np.asarray(last), self.values["reference"]),
        }

    def _program(self, worlds: int) -> Any:
        scene, made = self.scene, work.make_worlds(self.scene, worlds)
        if self.engine == "warp":
            from scripts.benchmark.warp import WarpProgram

            fields, ctrl = work.inputs(scene, made)
            return WarpProgram(scene, fields, np.asarray(ctrl))
        engine = peers.build(self.engine, self.setting, scene)
        return measure.JaxProgram(
            lambda p, t: summary(scene, rollout.simulate(scene, engine, p, t)[1]), *made
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
    }


def verdicts(outcome: Outcome, simulated: np.ndarray, count: int) -> dict:
    """Costs of the first worlds, failures, and whether decided worlds were simulated on."""
    costs, status = np.asarray(outcome.cost), np.asarray(outcome.status)
    lost = np.isfinite(np.asarray(outcome.lost_time)) & ~failed(status)
    # A world that is lost long before the end and still changes in the last steps is simulated on.
    early = lost & (costs > 0.5)
    stops = bool(simulated[early].mean() < 0.95 * simulated.max()) if early.any() else None
    return {
        "failed": int(failed(status).sum()),
        "kept": float((costs == 0).mean()),
        "stops_early": stops,
        "costs": [round(float(c), 6) for c in costs[:count]],
    }
