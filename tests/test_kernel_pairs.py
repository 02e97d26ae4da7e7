"""Contacts between fingers inside the rollout kernel, in float64: MuJoCo C and dense solves."""

import jax
import mujoco
import numpy as np
import pytest

from tests.helpers import grasps
from tests.helpers.curled_hands import SETTINGS, batched, curled, kinds, on_palm, one_step
from tests.helpers.dense_steps import DensePairs

# The quick tests have one state of spheres and one of hulls against the same oracles, among worlds
# with planted faults (test_planted_contacts).
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("friction", ["coulomb", "none", "full"])
def test_accelerations_equal_mujoco_on_curled_hands(friction):
    """Fingers touch one another and the object, sliding at up to a metre a second; or nothing."""
    with jax.enable_x64(True):
        scene = grasps.pinch("sphere", effects__friction=friction, **SETTINGS)
        worlds = [curled(scene, s, bend=0.75 + 0.05 * s, height=0.07) for s in range(6)]
        # Fingers apart: the accelerations of MuJoCo's model that has no such pairs.
        bare = grasps.pinch(
            "sphere", effects__friction=friction, discretization__spheres_per_link=2
        )
        without, data, _ = curled(bare, 0, bend=0.1, height=0.12)
        worlds.append((without, data, curled(scene, 0, bend=0.1, height=0.12)[2]))
        for model, data, _ in worlds:
            mujoco.mj_forward(model, data)
        inputs = batched(worlds)
        run = one_step(scene)
        qvel, trace = run(*inputs)
        acc = (np.asarray(qvel) - inputs[2]) / scene.discretization.timestep
        for k, (model, data, _) in enumerate(worlds):
            between, held = kinds(model, data)
            assert between == 0 if model is without else between > 5 and held > 5
            error = np.linalg.norm(acc[k] - data.qacc) / np.linalg.norm(data.qacc)
            # As without these contacts: a difference of velocities, and MuJoCo's own rounding.
            assert error < 1e-8, (k, between, held, error)
        order = np.array([3, 1, 5, 0, 6, 2, 4])
        again, _ = run(*jax.tree.map(lambda x: np.asarray(x)[order], inputs))
        np.testing.assert_array_equal(again, qvel[order])
        assert not trace["overflow"].any() and trace["residual"].max() < 1e-20


@pytest.mark.parametrize("friction", ["coulomb", "none", "full"])
@pytest.mark.parametrize("between", [True, False])
def test_accelerations_equal_mujoco_on_the_palm(friction, between):
    """Up to eight spheres on the palm, with and without contact between fingers."""
    settings = {"effects__finger_finger": between, "effects__friction": friction}
    settings |= {"effects__finger_palm": True, "contact__finger_palm_friction": 0.4}
    settings |= {"contact__finger_finger_friction": 0.6}  # neither the object's nor the palm's
    with jax.enable_x64(True):
        scene = grasps.pinch("sphere", **SETTINGS | settings)
        bends = (1.3, 1.5, 1.6, 1.2, 1.8, 0.3)
        worlds = [curled(scene, s, bend, height=0.12) for s, bend in enumerate(bends)]
        inputs = batched(worlds)
        qvel, _ = one_step(scene)(*inputs)
        acc = (np.asarray(qvel) - inputs[2]) / scene.discretization.timestep
        for mine, (model, data, _), bend in zip(acc, worlds, bends, strict=True):
            mujoco.mj_forward(model, data)
            assert (on_palm(model, data) > 1) == (bend > 1)
            assert np.linalg.norm(mine - data.qacc) < 1e-8 * np.linalg.norm(data.qacc)


def test_rings_equal_a_dense_solve():
    """Curled fingers of eight links that touch each other, themselves, the palm and the object."""
    settings = {"effects__finger_palm": True, "effects__finger_itself": True}
    settings |= {"effects__surface": "hull", "effects__finger_finger": True}
    settings |= {"effects__palm_object": False, "effects__palm_table": False}
    with jax.enable_x64(True):
        scene = grasps.pinch("sphere", links=8, **settings)
        hand, _ = grasps.hand_world(scene, length=0.1)
        states = [(1, 0.8, 0.07), (3, 0.8, 0.045), (5, 0.9, 0.06), (3, 0.7, 0.08)]
        worlds = [curled(scene, *state) for state in states]
        inputs, step, order = batched(worlds), one_step(scene), np.array([2, 0, 3, 1])
        qvel, trace = step(*inputs)
        # A world passes through its contacts as often in other company, which converges elsewhere.
        mixed, _ = step(*jax.tree.map(lambda v: v[order], inputs))
        np.testing.assert_array_equal(mixed, np.asarray(qvel)[order])
        acc = (np.asarray(qvel) - inputs[2]) / scene.discretization.timestep
        for k, (model, data, _) in enumerate(worlds):
            mujoco.mj_forward(model, data)
            dense = DensePairs(scene, model, data, hand)
            expected = dense.solve()
            error = np.linalg.norm(acc[k] - expected) / np.linalg.norm(expected)
            assert error < 1e-8, (k, dense.pairs, dense.itself, error)  # as against MuJoCo
            assert dense.pairs > 10 and (dense.itself > 3 or k == 3)
