"""Contact impulse: how hard and when the hand closes on the object, before chaos sets in."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured import StructuredEngine, assembly, coordinates
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.laws.contact import constraint_update
from codesign_jax.engines.structured.laws.kinematics import State
from codesign_jax.engines.structured.linear.tree import propagate, relative
from codesign_jax.engines.structured.world_model import WorldModel, world_constants
from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene
from scripts.accuracy import oracle, worlds
from scripts.accuracy.settings import Setting

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
      setting: The setting, of MuJoCo C or the structured engine.
      hands: Hands that hold their objects, in turn with every shape.
      seconds: Simulated time.

    Returns:
      The forces and the time step [s].
    """
    with worlds.floats(setting.wide or setting.engine == "mujoco") as dtype:
        scene = setting.scene(CLOSING)
        chosen = worlds.paired(
            worlds.designs(scene, hands, good=True), worlds.trials(scene, max(hands, 3))
        )
        fields, ctrl = worlds.inputs(scene, chosen, dtype)
        step = scene.discretization.timestep
        ctrl = ctrl[:, : round(seconds / step)]
        if setting.engine == "structured":
            engine = setting.make(scene)
            assert isinstance(engine, StructuredEngine)
            return _structured(engine, fields, ctrl), step

    def simulate(world: int) -> list[float]:
        found: list[float] = []
        model = oracle.model_of(scene, fields, world)
        visit = lambda m, d, _k: found.append(oracle.grip(scene, m, d))  # noqa: E731
        oracle.advance(model, fields.start[world], ctrl[world], range(ctrl.shape[1]), visit)
        return found

    return np.array(oracle.each_world(simulate, hands)), step


def _structured(engine: StructuredEngine, fields: ModelFields, ctrl: np.ndarray) -> np.ndarray:
    scene = engine.scene
    hand = world_constants(scene, jax.tree.map(jnp.asarray, fields))

    @jax.jit
    def run(hand: WorldModel, state: State, ctrl: jax.Array) -> jax.Array:
        found, _ = engine.advance(hand, state, ctrl)
        path = (found["qpos"], found["qvel"], found["acc"], ctrl)

        def force(at: tuple) -> jax.Array:
            qpos, qvel, acc, u = at
            return grip(scene, hand, coordinates.make(scene, qpos, qvel, acc), u.T)

        return jax.lax.map(force, jax.tree.map(lambda v: jnp.moveaxis(v, 1, 0), path))

    with jax.default_matmul_precision("highest"):
        found = run(hand, coordinates.reset(scene, fields), jnp.asarray(ctrl))
    return np.asarray(found, np.float64).T


def grip(scene: Scene, hand: WorldModel, state: State, ctrl: jax.Array) -> jax.Array:
    """Sum of the normal forces of fingers and palm on the object [N], shape (world,).

    The force of the cones (`contact.constraint_update`) at the accelerations that a step found,
    with which the engine itself pushes: of spheres, or of the hull, which MuJoCo C does not have.

    Args:
      scene: The scene.
      hand: The worlds' hands.
      state: Their states before the step, with the accelerations of the step.
      ctrl: Controls of the step, shape (nu, world).
    """
    problem, velocity = assembly.problem(scene, hand, state, ctrl)
    motion = propagate(problem.kin, state.acc)
    found = jnp.zeros(ctrl.shape[1], ctrl.dtype)
    for name, contacts in problem.contacts.items():
        if name.endswith("_object"):
            moved, moving = (contacts.relative(relative(name, m)) for m in (motion, velocity))
            force = constraint_update(contacts, moved - contacts.reference(moving)).force
            normal = dot(force[:3], contacts.normal)
            found = found + normal.sum(tuple(range(normal.ndim - 1)))
    return found


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
