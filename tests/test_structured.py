"""The structured engine against MuJoCo C: every step of a grasp, and free motion step by step.

The quick tests have the same of a cylinder, a box and a sphere: blocks of worlds in test_kernel,
and the sound ones among worlds with planted faults (test_planted_faults, test_planted_contacts).
"""

import dataclasses
import functools

import jax
import mujoco
import numpy as np
import pytest

from codesign_jax import rollout, scene
from codesign_jax.compiler import host
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from tests.helpers import grasps, oracles

pytestmark = pytest.mark.slow
EXACT = {"iterations": 100, "evaluations": 40, "tolerance": 1e-24}
"""Limits at which the kernel solves a step to rounding in float64."""


def setting(shape, **params):
    """Scene, MuJoCo C's model and the engine's hand for a pinch grasp, in float64."""
    scene = grasps.pinch(shape)
    world, trial = grasps.hand_world(scene, **params)
    trial = trial._replace(yaw=np.array(0.2), position=np.array([0.003, -0.002]))
    fields, ctrl = grasps.world_inputs(scene, world, trial)
    batch = grasps.repeat(fields, 1)
    oracle = world_model(scene, fields)
    oracle.opt.tolerance, oracle.opt.iterations, oracle.opt.ls_iterations = 0.0, 200, 50
    return scene, oracle, np.asarray(fields.start), batch, np.asarray(ctrl)


@pytest.mark.parametrize("shape", grasps.SHAPES)
def test_every_step_of_a_grasp_equals_mujocos(shape):
    """Converged accelerations along the kernel's own path, contacts included."""
    with jax.enable_x64(True):
        scene, _, _, fields, ctrl = setting(shape)
        engine, ctrl = StructuredEngine(scene, **EXACT), ctrl[None, :420]
        found = oracles.path(engine, fields, ctrl)
    errors, far, touching = oracles.against_mujoco(scene, fields, ctrl, found)
    # A difference of velocities over 10 ms loses two of 16 digits, and MuJoCo's own Newton stops
    # at rounding of its cost.
    assert errors.max() < 1e-8 and far.max() < 1e-12
    assert touching.max() > (4 if shape != "sphere" else 1)  # more than the object on the table


def test_free_motion_equals_mujoco_step_by_step():
    """The approach's first steps, before anything touches."""
    with jax.enable_x64(True):
        scene, oracle, start, fields, ctrl = setting("box")
        oracle.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data = mujoco.MjData(oracle)
        data.qpos[:] = start
        # Lift the object off the table: it falls for 20 steps without reaching it.
        data.qpos[-5] += 0.5
        lifted = fields._replace(start=fields.start.copy())
        lifted.start[0, -5] += 0.5
        found = oracles.path(StructuredEngine(scene, **EXACT), lifted, ctrl[None, :20])
    for k in range(20):
        # Rounding of 1e-16 relative, grown over twenty steps of a stiff chain.
        np.testing.assert_allclose(found.qpos[0, k], data.qpos, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.qvel[0, k], data.qvel, rtol=0, atol=1e-10)
        data.ctrl[:] = ctrl[k]
        mujoco.mj_step(oracle, data)


# Quick: test_a_decided_world_stays, test_a_trajectory_changes_no_outcome.
def test_worlds_that_end_early():
    """They change no verdict, and the block's other worlds no bit."""
    with jax.enable_x64(True):
        scene = grasps.pinch("cylinder")
        # On the way to this distance nothing is ever decided: every world runs to the end.
        patient = dataclasses.replace(
            scene, cost=dataclasses.replace(scene.cost, lost_distance=1e3)
        )
        world, trial = grasps.hand_world(scene, pressure=190e3)
        lengths = np.linspace(0.07, 0.13, 10)
        arm = world.arm + 0.08 * (np.arange(6) == 2)
        params = grasps.stack(
            *[world._replace(length=0 * world.length + x, arm=arm) for x in lengths]
        )
        back = jax.tree.map(lambda v: v[::-1], params)
        trials = grasps.stack(*[trial] * len(lengths))

        def traces(scene, *batches):
            engine = StructuredEngine(scene, tolerance=1e-16, iterations=30)
            run = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t)[1])
            return [jax.tree.map(np.asarray, run(p, trials)) for p in batches]

        early, reverse = traces(scene, params, back)
        (full,) = traces(patient, params)
        short, long = (jax.tree.map(np.asarray, grasps.outcomes(scene, t)) for t in (early, full))
    assert np.ptp(short.cost) > 1.0  # they end at very different times
    for field, whole in zip(short, long, strict=True):
        np.testing.assert_array_equal(field, whole)
    np.testing.assert_array_equal(reverse.distance[::-1], early.distance)


# Quick: test_lanes_of_one_world_store_in_one_place.
def test_a_world_fills_a_block(monkeypatch):
    """Five fingers do on CPUs with vectors of eight float32: here three on four lanes."""
    the_scene = scene.load("paper_spheres", hand_name="tripod3")
    params, trials = grasps.random_worlds(the_scene, 0, 3)

    def simulated():
        engine = StructuredEngine(the_scene)
        grasp = functools.partial(rollout.grasp, the_scene, engine, steps=30)
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(grasp))(params, trials))

    two = simulated()
    monkeypatch.setattr(host, "vector_bytes", lambda: 16)
    one = simulated()
    assert np.ptp(one.distance) > 0.01  # m: they move
    # Vectors of another length round otherwise, 1e-7 a step.
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), one, two)
