"""Accelerations of single steps on states sampled along grasps, against converged MuJoCo C."""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.laws.kinematics import Acc, State
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene
from scripts.accuracy import oracle, worlds
from scripts.accuracy.settings import Setting
from scripts.shared.peers import REFERENCE
from scripts.shared.statistics import quantiles

FLOOR = 100.0
"""Smallest scale of relative errors, ten g: an object at rest has accelerations of rounding."""


class Samples(NamedTuple):
    """States along converged grasps, every array with leading axis (state,), float64.

    Attributes:
      world: Index of the grasp.
      qpos: Positions.
      qvel: Velocities.
      warm: Accelerations of the step before, from which solvers start.
      ctrl: Controls.
      qacc: Converged accelerations.
    """

    world: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    warm: np.ndarray
    ctrl: np.ndarray
    qacc: np.ndarray


@lru_cache(maxsize=4)
def _samples(exact: Scene, hands: int, states: int) -> tuple[ModelFields, Samples]:
    """Fields and states of grasps; settings that differ in the solver alone share them."""
    with worlds.floats(True) as dtype:
        chosen = worlds.paired(worlds.designs(exact, hands), worlds.trials(exact, 6))
        fields, ctrl = worlds.inputs(exact, chosen, dtype)
    # From the end of the approach, when fingers touch, to the end of the shaking.
    ends = exact.phases.approach, exact.phases.disturb
    first, last = (round(t / exact.discretization.timestep) for t in ends)
    stride = max(2, (last - first) // states)
    return fields, sample(exact, fields, ctrl, range(first, first + states * stride, stride))


def sample(scene: Scene, fields: ModelFields, ctrl: np.ndarray, shown: range) -> Samples:
    """States of every world before the shown steps."""

    def run(world: int) -> list[tuple]:
        found: list[tuple] = []

        def visit(m: mujoco.MjModel, d: mujoco.MjData, _k: int) -> None:
            # mj_forward has put its solution where the step's own solver will start.
            found.append((world, d.qpos.copy(), d.qvel.copy(), d.ctrl.copy(), d.qacc.copy()))

        # Pairs of states: a step's and the next one's, whose solver starts from the first.
        steps = sorted({k + i for k in shown for i in (0, 1)})
        oracle.advance(
            oracle.model_of(scene, fields, world), fields.start[world], ctrl[world], steps, visit
        )
        pairs = zip(found[::2], found[1::2], strict=True)
        return [(w, q, v, before[-1], u, a) for before, (w, q, v, u, a) in pairs]

    every = [row for rows in oracle.each_world(run, len(ctrl)) for row in rows]
    return Samples(*(np.array(column) for column in zip(*every, strict=True)))


def measure(setting: Setting, hands: int, states: int) -> dict[str, Any]:
    """Relative errors of a setting's accelerations over states of grasps at its own equations.

    Args:
      setting: The setting.
      hands: Grasps, in turn of random and of good hands.
      states: States of each.
    """
    scene = setting.scene()
    fields, samples = _samples(setting.scene({"solver": dict(REFERENCE)}), hands, states)
    solve = {"mujoco": _mujoco, "structured": _structured, "mjx": _mjx}[setting.engine]
    with worlds.floats(setting.wide) as dtype:
        got, notes = solve(setting, scene, worlds.cast(fields, dtype), samples, dtype)
    scale = np.maximum(np.linalg.norm(samples.qacc, axis=1), FLOOR)
    errors = np.linalg.norm(got - samples.qacc, axis=1) / scale
    finite = np.isfinite(errors)
    return {
        "states": int(errors.size),
        "not_finite": int((~finite).sum()),
        **{f"step_{k}": v for k, v in quantiles(errors[finite]).items()},
        **notes,
    }


def _mujoco(setting: Setting, scene: Scene, fields: ModelFields, samples: Samples, dtype: type):
    del setting, dtype

    def run(world: int) -> list[tuple[np.ndarray, int]]:
        mine = np.flatnonzero(samples.world == world)
        m = oracle.model_of(scene, fields, world)
        data, found = mujoco.MjData(m), []
        for i in mine:
            data.qpos[:], data.qvel[:], data.ctrl[:] = (
                getattr(samples, n)[i] for n in ("qpos", "qvel", "ctrl")
            )
            data.qacc_warmstart[:] = samples.warm[i]
            mujoco.mj_forward(m, data)
            found.append((data.qacc.copy(), int(data.solver_niter[0])))
        return found

    rows = [r for part in oracle.each_world(run, len(fields.start)) for r in part]
    iterations = np.array([r[1] for r in rows])
    notes = {"iterations_mean": float(iterations.mean()), "iterations_max": int(iterations.max())}
    return np.array([r[0] for r in rows]), notes


def _mjx(setting: Setting, scene: Scene, fields: ModelFields, samples: Samples, dtype: type):
    engine: Any = setting.make(scene)

    def step(f: Any, q: Any, v: Any, a: Any, u: Any) -> jax.Array:
        data = engine.reset(f).replace(qpos=q, qvel=v, qacc_warmstart=a)
        return engine.step(f, data, u).qacc

    batch = jax.tree.map(lambda x: x[samples.world], fields)
    arrays = worlds.cast((samples.qpos, samples.qvel, samples.warm, samples.ctrl), dtype)
    with jax.default_matmul_precision("highest"):
        got = jax.jit(jax.vmap(step))(batch, *arrays)
    return np.asarray(got, np.float64), {}


def _structured(setting: Setting, scene: Scene, fields: ModelFields, samples: Samples, dtype: type):
    engine = setting.make(scene)
    assert isinstance(engine, StructuredEngine)
    batch = jax.tree.map(lambda x: jnp.asarray(x[samples.world]), fields)

    @jax.jit
    def step(batch: ModelFields, state: State, ctrl: jax.Array):
        info = engine.step(world_constants(scene, batch), state, ctrl)[1]
        return info.acc, info.residual[0], info.iterations.max()

    state = to_state(engine, scene, batch, worlds.cast(samples, dtype))
    with jax.default_matmul_precision("highest"):
        acc, residual, iterations = step(batch, state, jnp.asarray(samples.ctrl.T.astype(dtype)))
    notes = {"decrement": quantiles(np.asarray(residual)), "iterations_max": int(iterations)}
    return from_acc(scene, acc, samples.qpos), notes


def to_state(
    engine: StructuredEngine, scene: Scene, fields: ModelFields, samples: Samples
) -> State:
    """The engine's state of a batch, from MuJoCo's coordinates and accelerations."""
    q, v = jnp.asarray(samples.qpos), jnp.asarray(samples.qvel)
    state = engine.place(engine.reset(fields), q, v)
    return state._replace(acc=_to_acc(scene, samples.warm, samples.qpos))


def _by_finger(scene: Scene, flat: jax.Array) -> jax.Array:
    """Joint values (dof, world) to the engine's (link, axis, finger, world)."""
    return jnp.moveaxis(flat.reshape(*model.layout(scene).dofs.shape, -1), 0, 2)


def _to_acc(scene: Scene, qacc: np.ndarray, qpos: np.ndarray) -> Acc:
    """MuJoCo turns the object in its own frame, the engine in the world's."""
    end = 6 + model.layout(scene).dofs.size
    turned = np.einsum("sij,sj->si", _frames(qpos), qacc[:, end + 3 :])
    free = np.concatenate([turned, qacc[:, end : end + 3]], 1).astype(qacc.dtype)
    a = jnp.asarray(qacc.T)
    return Acc(a[:6, None], _by_finger(scene, a[6:end]), jnp.asarray(free.T)[:, None])


def from_acc(scene: Scene, acc: Acc, qpos: np.ndarray) -> np.ndarray:
    """MuJoCo's qacc, shape (state, nv), from the engine's accelerations."""
    wrist, finger, free = (np.asarray(a, np.float64) for a in acc)
    joints = np.moveaxis(finger, 2, 0).reshape(model.layout(scene).dofs.size, -1)
    local = np.einsum("sij,si->sj", _frames(qpos), free[:3, 0].T)
    return np.concatenate([wrist[:, 0].T, joints.T, free[3:, 0].T, local], 1)


def _frames(qpos: np.ndarray) -> np.ndarray:
    """Orientation of the object in each state, shape (state, 3, 3)."""
    frames = np.zeros((len(qpos), 9))
    for frame, q in zip(frames, qpos.astype(np.float64), strict=True):
        mujoco.mju_quat2Mat(frame, q[-4:] / np.linalg.norm(q[-4:]))
    return frames.reshape(-1, 3, 3)
