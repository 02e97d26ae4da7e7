"""The skinned hull inside the rollout kernel: a dense solve, neighbours, too few slots."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import Limits, Program, tables
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import layout
from codesign_jax.types import Status
from tests.helpers import dense_steps, grasps

# The quick tests have one state against the same dense solve, and states with too few slots, among
# worlds with planted faults (test_planted_contacts), and rigid rings against MuJoCo C.
pytestmark = pytest.mark.slow
STEPS = 420


class Runs(NamedTuple):
    """One compiled rollout of a scene, of as many worlds as `states` below, and its grasp."""

    scene: object
    engine: StructuredEngine
    fields: object
    ctrl: np.ndarray
    run: Callable

    def along(self, count, start=None, ctrl=None):
        """The trace and qpos of worlds that repeat the fields."""
        fields = grasps.repeat(self.fields, count)
        start = self.engine.reset(fields) if start is None else start(fields)
        ctrl = np.repeat(self.ctrl[None], count, 0) if ctrl is None else ctrl
        return jax.tree.map(np.asarray, self.run(fields, start, jnp.asarray(ctrl)))


def compiled(scene, fields, ctrl):
    limits = Limits(100, 40, 1e-24)
    with jax.enable_x64(True):
        kernel = Program.here(scene, limits, np.float64)

        def run(fields, start, ctrl):
            hand = world_constants(scene, fields)
            return kernel.simulate(hand, start, ctrl, trajectory=True)[0]

        return Runs(scene, StructuredEngine(scene), fields, ctrl[:STEPS], jax.jit(run))


def velocity(first, second, h):
    """qvel of the step between two qpos: semi-implicit Euler's, the object turning as MuJoCo's."""
    found = (second[:-4] - first[:-4]) / h
    turned, back = np.zeros(4), first[-4:] * [1, -1, -1, -1]
    mujoco.mju_mulQuat(turned, back, second[-4:])
    omega = np.zeros(3)
    mujoco.mju_quat2Vel(omega, turned, h)
    return np.concatenate([found, omega])


@pytest.mark.parametrize("shape", ["box", "sphere"])
def test_accelerations_equal_a_dense_solve(shape):
    """States of a grasp, one world each: one step of each against dense Jacobians and SciPy."""
    with jax.enable_x64(True):
        scene = dense_steps.hull_scene(shape, hull_rings=2, hull_points=8)
        hand, _, fields, model, ctrl = dense_steps.world(scene)
        runs, h = compiled(scene, fields, ctrl), scene.discretization.timestep
        when, data, most = np.arange(20, STEPS, 35), mujoco.MjData(model), 0
        trace = runs.along(len(when))
        path = trace["qpos"][0]
        assert not trace["overflow"].any()
        qpos = path[when]
        qvel = np.stack([velocity(path[k - 1], path[k], h) for k in when])
        start = partial(place, runs.engine, qpos, qvel)
        ctrl = np.stack([np.concatenate([ctrl[k:STEPS], ctrl[:k]]) for k in when])
        new = runs.along(len(when), start, ctrl)["qpos"]
        for w, k in enumerate(when):
            data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[w], qvel[w], ctrl[w, 0]
            mujoco.mj_forward(model, data)
            dense = dense_steps.Dense(scene, model, data, hand)
            expected = dense.solve()
            acc = (velocity(qpos[w], new[w, 1], h) - qvel[w]) / h
            error = np.linalg.norm(acc - expected) / max(np.linalg.norm(expected), 100.0)
            assert error < 1e-8, (k, dense.num_hull, error)  # as against MuJoCo
            most = max(most, dense.num_hull)
        assert most > 8
        neighbours_change_no_bit(runs, qpos, qvel, ctrl)


def place(engine, qpos, qvel, fields):
    return engine.place(engine.reset(fields), jnp.asarray(qpos), jnp.asarray(qvel))


def neighbours_change_no_bit(runs, qpos, qvel, ctrl):
    """The same worlds in other blocks of a vector, in the program that is compiled already."""
    order = np.random.default_rng(0).permutation(len(qpos))
    a = runs.along(len(qpos), partial(place, runs.engine, qpos, qvel), ctrl)
    b = runs.along(len(qpos), partial(place, runs.engine, qpos[order], qvel[order]), ctrl[order])
    for name in ("qpos", "distance", "height"):
        np.testing.assert_array_equal(a[name][order], b[name], err_msg=name)


def wound(scene, model, qpos, turn=0.05):
    """The finger's joints bent around a cylinder whose axis is their own, in the air.

    Args:
      scene: A scene with a cylinder.
      model: MuJoCo's model of a world.
      qpos: Its start, which is changed.
      turn: Joint velocities that follow [rad/s], so that the belt slides.
    """
    lay, data = layout(scene), mujoco.MjData(model)
    radius = scene.objects.object[0].half_sizes[0]
    segment = np.abs(model.body_pos[lay.bodies[0, 1], 0])
    qpos[2] = 0.5
    qpos[lay.dofs[0, :, 0]] = 2 * np.arctan(segment / 2 / radius)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    first = lay.stubs[0]
    frame = data.xmat[first].reshape(3, 3)
    middle = data.xpos[lay.bodies[0, 0]] - segment / 2 * frame[:, 0]
    # Links are chords that touch the cylinder in their middles, a millimetre too close.
    qpos[-7:-4] = middle - (radius - 1e-3) * frame[:, 2]
    qpos[-4:] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]  # its axis along y
    qvel = np.full(model.nv, turn)
    qvel[-6:] = 0
    return qpos, qvel


def test_a_belt_around_a_cylinder_equals_a_dense_solve():
    """A finger wound about a cylinder by most of a turn, rubbing on it: one step."""
    with jax.enable_x64(True):
        scene = dense_steps.hull_scene("cylinder", links=7, hull_rings=2, hull_points=8)
        hand, trial = grasps.hand_world(scene, length=0.15)
        fields, ctrl = grasps.world_inputs(scene, hand, trial)
        model = world_model(scene, fields)
        qpos, qvel = wound(scene, model, np.array(fields.start))
        engine = StructuredEngine(scene, iterations=100, evaluations=40, tolerance=1e-24)
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], fields)
        start = engine.place(engine.reset(batch), qpos[None], qvel[None])
        lanes = grasps.lanes(scene, batch)
        new, info = jax.jit(engine.step)(lanes, start, jnp.asarray(ctrl[0])[:, None])
        data, h = mujoco.MjData(model), scene.discretization.timestep
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl[0]
        mujoco.mj_forward(model, data)
        dense = dense_steps.Dense(scene, model, data, hand)
        expected = dense.solve()
        acc = (np.asarray(engine.qvel(new))[0] - qvel) / h
    # The object's columns of a contact's first row are the normal, here across the axis y.
    normals = np.array([jac[0, -6:-3] for jac, *_ in dense.rows if np.abs(jac[0, -6:-3]).any()])
    around = np.sort(np.arctan2(normals[:, 2], normals[:, 0]))
    gap = np.diff(np.r_[around, around[0] + 2 * np.pi]).max()
    assert len(normals) > 20 and 2 * np.pi - gap > 1.3 * np.pi and not info.overflow.any()
    error = np.linalg.norm(acc - expected) / max(np.linalg.norm(expected), 100.0)
    assert error < 1e-8  # as against MuJoCo


def test_too_few_slots_are_an_overflow(monkeypatch):
    """With one slot a row a grasp needs more as it touches, and its status tells from then on."""
    scene = dense_steps.hull_scene("box", links=2, hull_rings=1, hull_points=4)
    with jax.enable_x64(True):
        _, _, fields, _, ctrl = dense_steps.world(scene)
    fields = jax.tree.map(lambda x: np.asarray(x, np.float32)[None], fields)
    monkeypatch.setattr(tables, "hull_slots", lambda _: 1)
    # A tolerance of its own: a kernel is known by its scene and limits.
    rollout = jax.jit(StructuredEngine(scene, tolerance=1.1e-6).rollout)
    status = np.asarray(rollout(fields, jnp.asarray(ctrl, jnp.float32)[None, :STEPS]).status)
    overflow = (status & int(Status.CONTACT_OVERFLOW)) > 0
    assert overflow.any() and not overflow[0, 0]
