"""What an effect of a scene costs, and what leaving it out does to the verdict on a grasp."""

import dataclasses
import hashlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import Program
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.report.statistics import wilson
from codesign_jax.scene import Scene, parameters
from codesign_jax.scene.effects import refusals
from codesign_jax.types import Params, failed
from scripts.shared.statistics import agreement
from scripts.shared.work import Worlds, inputs

CONTACTS = ("finger_object", "palm_object", "finger_table", "palm_table", "object_table")
STEPS = 20
"""Time steps that a timed program does."""


def variants(scene: Scene) -> dict[str, Scene]:
    """The scene with each effect turned over, and without contacts, by what changed."""
    changes: dict[str, dict[str, Any]] = {"all contacts off": dict.fromkeys(CONTACTS, False)}
    for field in dataclasses.fields(scene.effects):
        now = getattr(scene.effects, field.name)
        for value in field.metadata.get("options", (not now,)):
            if value != now:
                word = {True: "on", False: "off"}.get(value, value)
                changes[f"{field.name} {word}"] = {field.name: value}
    return {
        name: dataclasses.replace(scene, effects=dataclasses.replace(scene.effects, **change))
        for name, change in changes.items()
    }


def grasps(scene: Scene, designs: int, trials: int) -> Worlds:
    """Designs of the 2D space around those that hold, each in the same trials.

    The box, lengths of 45 to 150 mm and arm heights of -60 to 60 mm, is where about half of the
    grasps hold: leaving an effect out can change a verdict both ways.
    """
    space = parameters.design_space(scene.hand, "2d")
    low, high = np.array([0.045, -0.06]), np.array([0.150, 0.06])
    chosen = low + (high - low) * np.random.default_rng(0).random((designs, 2))
    params: Params = jax.vmap(space.params)(jnp.asarray(chosen, jnp.float32))
    drawn = rollout.sample_trials(scene, jax.random.key(0), trials)
    params = jax.tree.map(lambda v: jnp.repeat(v, trials, axis=0), params)
    return Worlds(
        params, jax.tree.map(lambda v: jnp.tile(v, (designs,) + (1,) * (v.ndim - 1)), drawn)
    )


class Decision(NamedTuple):
    """Outcomes of grasps.

    Attributes:
      cost: Costs, shape (world,).
      status: Status bits, shape (world,).
      seconds: Wall time of the grasps.
    """

    cost: np.ndarray
    status: np.ndarray
    seconds: float


def decide(scene: Scene, worlds: Worlds) -> Decision:
    """Simulates the grasps in MuJoCo C, or in the structured engine what C refuses."""
    engine = make_engine("structured" if refusals(scene.effects, "mujoco") else "mujoco", scene)
    begin = time.perf_counter()
    outcome, _ = rollout.simulate(scene, engine, *worlds)
    cost, status = np.asarray(outcome.cost), np.asarray(outcome.status)
    return Decision(cost, status, time.perf_counter() - begin)


class Moment(NamedTuple):
    """Positions (world, nq) and velocities (world, nv) of grasps at a time step."""

    qpos: np.ndarray
    qvel: np.ndarray
    step: int


def lifting(scene: Scene, worlds: Worlds) -> Moment:
    """The grasps in the middle of the lift, by MuJoCo C; of a hull those of its spheres."""
    scene = dataclasses.replace(
        scene, effects=dataclasses.replace(scene.effects, surface="spheres")
    )
    fields, ctrl = inputs(scene, worlds)
    step = round((scene.phases.inflate + scene.phases.lift) / 2 / scene.discretization.timestep)
    engine = make_engine("mujoco", scene)
    trace = engine.rollout(fields, ctrl[:, : step + 1], trajectory=True)
    before, qpos = (np.asarray(trace.qpos[:, k], float) for k in (step - 1, step))
    return Moment(qpos, _velocity(scene, before, qpos), step)


def _velocity(scene: Scene, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Velocity that took one position to the other in a step, shape (world, nv)."""
    import mujoco

    from codesign_jax.model import compile_template

    model, h = compile_template(scene), scene.discretization.timestep
    qvel = np.zeros((len(after), model.nv))
    for row, a, b in zip(qvel, before, after, strict=True):
        mujoco.mj_differentiatePos(model, row, h, a, b)
    return qvel


def compare(found: Decision, reference: Decision, trials: int) -> dict[str, Any]:
    """Success rate with its 95 % interval and agreement with the scene as it is."""
    success = (found.cost < SUCCESS_COST) & ~failed(found.status)
    rate = wilson(int(success.sum()), success.size)
    same = agreement(found.cost, reference.cost, trials)
    return {
        "worlds": int(success.size),
        "success": float(success.mean()),
        "success_low": float(rate.low),
        "success_high": float(rate.high),
        "same_verdict": same["same_verdict"],
        "rank_correlation": same["spearman"],
        "failed": int(failed(found.status).sum()),
        "grasp_seconds": found.seconds,
    }


class Steps(NamedTuple):
    """A compiled program of `STEPS` steps, what it does, and its arguments.

    Attributes:
      run: The program; None if it was not to be compiled.
      args: Its arguments: constants and states of the worlds, and controls (world, time, nu).
      record: A digest of the kernel's jaxpr.
    """

    run: Callable | None
    args: tuple
    record: dict[str, Any]


def compile_steps(
    scene: Scene, worlds: Worlds, at: Moment, compiled: dict[str, Any], *, new: bool = True
) -> Steps:
    """Compiles the kernel of some steps from a state of the grasps."""
    engine = StructuredEngine(scene)
    fields, ctrl = inputs(scene, worlds)
    q, v = (jnp.asarray(x, fields.start.dtype) for x in (at.qpos, at.qvel))
    state = engine.place(engine.reset(fields), q, v)
    args = world_constants(scene, fields), state, ctrl[:, at.step : at.step + STEPS]
    program = Program.here(scene, engine.limits, ctrl.dtype)
    digest = hashlib.sha256(str(program.jaxpr(*args)).encode()).hexdigest()[:16]
    if digest not in compiled and new:
        compiled[digest] = jax.jit(program.simulate).lower(*args).compile()
    return Steps(compiled.get(digest), args, {"program": digest})


def measure(programs: dict[str, Steps], repeats: int) -> dict[str, list[float]]:
    """Times programs in turn, so that a busy machine slows all alike.

    Returns:
      Seconds of a step of one world, a list for each program.
    """
    times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(repeats + 1):
        for name, program in programs.items():
            assert program.run is not None
            worlds = program.args[0].object_id.shape[1]
            begin = time.perf_counter()
            jax.block_until_ready(program.run(*program.args))
            times[name].append((time.perf_counter() - begin) / STEPS / worlds)
    return {name: seconds[1:] for name, seconds in times.items()}  # the first round warms up
