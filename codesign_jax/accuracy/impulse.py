"""Contact impulse: how hard and when the hand closes on the object, before chaos sets in."""

from typing import Any

import jax
import mujoco
import numpy as np

from codesign_jax.accuracy import oracle, worlds
from codesign_jax.accuracy.settings import Setting

# The arm comes down in 0.5 s, the fingers are inflated in the next 0.5 s, on an object at rest.
# The forces are summed up to 0.2 s later, before the lift; no world ends early.
CLOSING = {
    "effects": {"disturb": False, "ungrasp": False},
    "phases": {"approach": 0.5, "inflate": 1.0, "lift": 1.5},
    "cost": {"lost_distance": 1.0},
}
SECONDS = 1.2
_TAIL = 0.1  # time at the end over which the grip is averaged [s]
_TOUCH = 1e-3  # force that counts as touching [N]


def forces(setting: Setting, hands: int, seconds: float = SECONDS) -> tuple[np.ndarray, float]:
    """Normal force of the hand on the object [N] before every step, shape (hand, time).

    Args:
      setting: The setting.
      hands: Hands that hold their objects, in turn with every shape.
      seconds: Simulated time.

    Returns:
      The forces and the time step [s].  Those of engines other than MuJoCo C are MuJoCo's,
      converged, in the states that the engine went through.
    """
    with worlds.floats(setting.wide or setting.engine == "mujoco") as dtype:
        scene = setting.scene(CLOSING)
        chosen = worlds.paired(
            worlds.designs(scene, hands, good=True), worlds.trials(scene, max(hands, 3))
        )
        fields, ctrl = worlds.inputs(scene, chosen, dtype)
        step = scene.discretization.timestep
        ctrl = ctrl[:, : round(seconds / step)]
        if setting.engine != "mujoco":
            engine = setting.make(scene)
            run = jax.jit(lambda f, c: engine.rollout(f, c, trajectory=True).qpos)
            qpos = np.asarray(run(fields, ctrl), np.float64)

    def simulate(world: int) -> list[float]:
        found: list[float] = []
        model = oracle.model_of(scene, fields, world)
        visit = lambda m, d, _k: found.append(oracle.grip(scene, m, d))  # noqa: E731
        oracle.advance(model, fields.start[world], ctrl[world], range(ctrl.shape[1]), visit)
        return found

    def replay(world: int) -> list[float]:
        model, states = oracle.model_of(scene, fields, world), qpos[world]
        data, found = mujoco.MjData(model), []
        for k, state in enumerate(states):
            if k:  # semi-implicit Euler: the step's new velocities moved the positions
                mujoco.mj_differentiatePos(model, data.qvel, step, states[k - 1], state)
            data.qpos[:], data.ctrl[:] = state, ctrl[world, k]
            mujoco.mj_forward(model, data)
            found.append(oracle.grip(scene, model, data))
        return found

    run = simulate if setting.engine == "mujoco" else replay
    return np.array(oracle.each_world(run, hands)), step


def summary(force: np.ndarray, step: float) -> dict[str, list[float]]:
    """By hand: impulse [N s], mean grip at the end [N] and time of the first touch [s]."""
    tail = max(1, round(_TAIL / step))
    touched = force > _TOUCH
    first = np.where(touched.any(1), touched.argmax(1) * step, np.inf)
    return {
        "impulse": [float(v) for v in force.sum(1) * step],
        "grip": [float(v) for v in force[:, -tail:].mean(1)],
        "touch": [float(v) if np.isfinite(v) else -1.0 for v in first],
    }


def compare(found: dict[str, Any], reference: dict[str, Any]) -> dict[str, Any]:
    """Relative errors of impulse and grip, and of the first touch [ms]: median and largest."""
    result: dict[str, Any] = {}
    for name in ("impulse", "grip"):
        a, b = np.array(found[name]), np.array(reference[name])
        error = np.abs(a - b) / np.abs(b)
        result |= {f"{name}_error": float(np.median(error)), f"{name}_max": float(error.max())}
    late = 1e3 * (np.array(found["touch"]) - np.array(reference["touch"]))
    return result | {"touch_error_ms": float(np.median(np.abs(late)))}
