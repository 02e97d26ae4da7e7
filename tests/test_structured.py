"""The structured engine against MuJoCo C: one step in contact, and free motion step by step."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import cost, rollout
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from tests import small


@functools.lru_cache(maxsize=4)
def _placing(engine):
    return jax.jit(lambda fields, qpos, qvel: engine.place(engine.reset(fields), qpos, qvel))


def lanes_state(engine, scene, fields, qpos, qvel):
    """The engine's state, one world, from MuJoCo's coordinates, with a cold start."""
    return _placing(engine)(fields, jnp.asarray(qpos)[None], jnp.asarray(qvel)[None])


def setting(shape, **params):
    """Scene, MuJoCo C's model and the engine's hand for a pinch grasp, in float64."""
    scene = small.pinch(shape)
    world, trial = small.hand_world(scene, **params)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, -0.002]))
    fields, ctrl = small.world_inputs(scene, world, trial)
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], fields)
    oracle = world_model(scene, fields)
    oracle.opt.tolerance, oracle.opt.iterations, oracle.opt.ls_iterations = 0.0, 200, 50
    return scene, oracle, np.asarray(fields.start), batch, np.asarray(ctrl)


@pytest.mark.parametrize("shape", small.SHAPES)
def test_accelerations_equal_mujoco_along_a_grasp(shape):
    """Converged accelerations on states of a grasp, contacts included."""
    with jax.enable_x64(True):
        scene, oracle, start, fields, ctrl = setting(shape)
        engine = StructuredEngine(scene, iterations=100, evaluations=16, tolerance=1e-24)
        hand, step = small.lanes(scene, fields), jax.jit(engine.step)
        data, touched = mujoco.MjData(oracle), 0
        data.qpos[:] = start
        for k in range(420):
            data.ctrl[:] = ctrl[k]
            if k % 35 == 20:
                qpos, qvel = data.qpos.copy(), data.qvel.copy()
                mujoco.mj_forward(oracle, data)
                state = lanes_state(engine, scene, fields, qpos, qvel)
                new, _ = step(hand, state, jnp.asarray(ctrl[k])[:, None])
                acc = (np.asarray(engine.qvel(new))[0] - qvel) / scene.discretization.timestep
                scale = max(np.linalg.norm(data.qacc), 100.0)
                error = np.linalg.norm(acc - data.qacc) / scale
                # A difference of velocities over 10 ms loses two of 16 digits, and MuJoCo's own
                # Newton stops at rounding of its cost; the floor is ten g: at rest qacc is noise.
                assert error < 1e-8, (k, data.ncon, error)
                touched = max(touched, data.ncon)
            mujoco.mj_step(oracle, data)
        assert touched > (4 if shape != "sphere" else 1)  # more than the object on the table


def test_free_motion_equals_mujoco_step_by_step():
    """The approach's first steps, before anything touches."""
    with jax.enable_x64(True):
        scene, oracle, start, fields, ctrl = setting("box")
        oracle.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        engine = StructuredEngine(scene, iterations=100, evaluations=16, tolerance=1e-24)
        hand, step = small.lanes(scene, fields), jax.jit(engine.step)
        data = mujoco.MjData(oracle)
        data.qpos[:] = start
        # Lift the object off the table: it falls for 20 steps without reaching it.
        data.qpos[-5] += 0.5
        state = lanes_state(engine, scene, fields, data.qpos, data.qvel)
        for k in range(20):
            data.ctrl[:] = ctrl[k]
            mujoco.mj_step(oracle, data)
            state, _ = step(hand, state, jnp.asarray(ctrl[k])[:, None])
            # Rounding of 1e-16 relative, grown over twenty steps of a stiff chain.
            np.testing.assert_allclose(engine.qpos(state)[0], data.qpos, rtol=0, atol=1e-12)
            np.testing.assert_allclose(engine.qvel(state)[0], data.qvel, rtol=0, atol=1e-10)


def test_float32_is_close_to_float64():
    """The frame at the palm keeps float32 accelerations within 1e-4 in free motion and contact."""
    results = []
    for wide in (True, False):
        with jax.enable_x64(wide):
            scene, _, start, fields, ctrl = setting("cylinder")
            dtype = jnp.float64 if wide else jnp.float32
            fields = jax.tree.map(lambda x, t=dtype: x.astype(t), fields)
            engine = StructuredEngine(scene, iterations=60, evaluations=12, tolerance=1e-10)
            hand = small.lanes(scene, fields)
            # The palm at 60 mm presses the straight fingers onto the table.
            qpos = np.array(start)
            qpos[2] = 0.06
            state = lanes_state(engine, scene, fields, qpos, np.zeros(len(qpos) - 1))
            state = jax.tree.map(lambda x, t=dtype: x.astype(t), state)
            u = jnp.asarray(ctrl[150], dtype)[:, None]
            new, info = jax.jit(engine.step)(hand, state, u)
            results.append(np.asarray(engine.qvel(new))[0].astype(float))
            assert float(info.residual.max()) < 1e-6
    error = np.linalg.norm(results[1] - results[0]) / np.linalg.norm(results[0])
    assert error < 1e-4


def test_worlds_that_end_early():
    """They change no verdict, the block's other worlds no bit, and the motion is the same."""
    with jax.enable_x64(True):
        scene = small.pinch("cylinder")
        # On the way to this distance nothing is ever decided: every world runs to the end.
        patient = dataclasses.replace(
            scene, cost=dataclasses.replace(scene.cost, lost_distance=1e3)
        )
        world, trial = small.hand_world(scene, pressure=190e3)
        lengths = np.linspace(0.07, 0.13, 10)
        arm = world.arm + 0.08 * (np.arange(6) == 2)
        params = small.stack(
            *[world._replace(length=0 * world.length + x, arm=arm) for x in lengths]
        )
        back = jax.tree.map(lambda v: v[::-1], params)
        trials = small.stack(*[trial] * len(lengths))

        def traces(scene, kernel, *batches):
            engine = StructuredEngine(scene, tolerance=1e-16, iterations=30, kernel=kernel)
            run = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t)[1])
            return [jax.tree.map(np.asarray, run(p, trials)) for p in batches]

        (unison,) = traces(scene, False, params)
        early, reverse = traces(scene, True, params, back)
        (full,) = traces(patient, True, params)
        read = jax.vmap(lambda t: cost.outcome(scene, t))
        short, long = (jax.tree.map(np.asarray, read(t)) for t in (early, full))
    assert np.ptp(short.cost) > 1.0  # they end at very different times
    for field, whole in zip(short, long, strict=True):
        np.testing.assert_array_equal(field, whole)
    np.testing.assert_array_equal(reverse.distance[::-1], early.distance)
    # Sums in another order differ by rounding. From the lift on slipping multiplies a difference by
    # ten every three steps, a change of 1e-14 in the length as well, so the comparison ends there.
    np.testing.assert_allclose(early.distance[:, :380], unison.distance[:, :380], atol=1e-10)
