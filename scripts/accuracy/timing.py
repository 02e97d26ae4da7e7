"""Wall seconds of a simulated second of a world, engines in turn, compilation apart."""

import statistics
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene
from scripts.accuracy import oracle, worlds
from scripts.accuracy.impulse import CLOSING
from scripts.accuracy.settings import SPHERES, Setting
from scripts.shared.measure import JaxProgram, peak_memory

START = 1.0
"""Time at which the timed steps begin [s]: the fingers are inflated and touch the object."""


def measure(
    settings: list[Setting], batch: dict[str, int], steps: int, repeats: int
) -> dict[str, Any]:
    """Times settings that differ in the engine or the float type, in turn.

    Args:
      settings: The settings.
      batch: Worlds by engine.
      steps: Time steps of a timed call.
      repeats: Timed calls of each setting; one more before them warms up.

    Returns:
      By engine and float type: medians and all times, compile time, memory.
    """
    programs = {name(s): _program(s, batch[s.engine], steps) for s in settings}
    seconds: dict[str, list[float]] = {n: [] for n in programs}
    for turn in range(repeats + 1):
        for key, program in programs.items():
            taken = program.run()[1]
            if turn:
                seconds[key].append(taken)
    found = {}
    for setting in settings:
        key, each = name(setting), seconds[name(setting)]
        simulated = batch[setting.engine] * steps * setting.timestep * 1e-3
        found[key] = {
            "engine": setting.engine,
            "worlds": batch[setting.engine],
            "steps": steps,
            "s_per_simulated_s": statistics.median(each) / simulated,
            "range": [min(each) / simulated, max(each) / simulated],
            "seconds": each,
            "world_steps_per_s": batch[setting.engine] * steps / statistics.median(each),
            **programs[key].times,
        }
    return {"engines": found, "peak_memory_bytes": peak_memory()}


def name(setting: Setting) -> str:
    """Engine, and its float type if it has a choice."""
    return setting.engine if setting.engine == "mujoco" else f"{setting.engine} {setting.precision}"


class _Program(JaxProgram):
    """A compiled program that is called in its own float type."""

    def __init__(self, wide: bool, function: Any, *args: Any):
        self.wide = wide
        super().__init__(function, *args)

    def run(self) -> tuple[Any, float]:
        with worlds.floats(self.wide):
            return super().run()


def _program(setting: Setting, count: int, steps: int) -> _Program:
    # What JAX has traced in the other float type must not be met again.
    jax.clear_caches()
    with worlds.floats(setting.wide) as dtype:
        scene, fields, ctrl = contact(setting, count, steps, dtype)
        engine = setting.make(scene)
        args = jax.device_put((fields, ctrl))

        # The distance alone: what costs nothing to report.
        return _Program(setting.wide, lambda f, c: engine.rollout(f, c).distance[:, -1], *args)


def contact(
    setting: Setting, count: int, steps: int, dtype: type, distinct: int = 6
) -> tuple[Scene, ModelFields, np.ndarray]:
    """Scene, fields whose starts are states of MuJoCo C in contact, and controls from there.

    Args:
      setting: The setting.
      count: Worlds, which repeat the distinct ones in turn.
      steps: Time steps of the controls.
      dtype: Float type of the fields.
      distinct: Distinct worlds: pairs of a hand that holds objects and a trial.
    """
    with worlds.floats(True):
        scene, spheres = (s.scene(CLOSING) for s in (setting, replace(setting, surface=SPHERES)))
        hands = worlds.designs(scene, min(count, distinct), good=True)
        chosen = worlds.paired(hands, worlds.trials(scene, distinct))
        fields, ctrl = worlds.inputs(scene, chosen, np.float64)
        touching = worlds.inputs(spheres, chosen, np.float64)[0]
    first = round(START / scene.discretization.timestep)

    def closed(world: int) -> np.ndarray:
        found: list[np.ndarray] = []
        model = oracle.model_of(spheres, touching, world)
        visit = lambda _m, d, _k: found.append(d.qpos.copy())  # noqa: E731
        oracle.advance(model, touching.start[world], ctrl[world], [first], visit)
        return found[0]

    # MuJoCo C has no hull: its states are those of spheres, which the first steps settle.
    fields = fields._replace(start=np.array(oracle.each_world(closed, len(ctrl))))
    index = np.arange(count) % len(ctrl)
    window = np.minimum(np.arange(first, first + steps), ctrl.shape[1] - 1)
    part = worlds.cast((fields, ctrl[:, window]), dtype)
    return scene, *jax.tree.map(lambda x: x[index], part)
