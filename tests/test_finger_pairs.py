"""Contacts between fingers: pairs of spheres and their slots, and stock MJX."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import model, scene
from codesign_jax.engines.mjx import MjxEngine
from codesign_jax.engines.structured.kernel.pairs import pair_slots
from codesign_jax.engines.structured.laws import finger_pairs
from tests.helpers import grasps
from tests.helpers.curled_hands import SETTINGS, curled, kinds


@jax.jit
def contacts(centre, radius):
    """The engine's contacts between spheres of fingers, without a friction cone."""
    return finger_pairs.contacts(None, centre, radius)


def test_candidates_are_all_pairs_of_different_fingers():
    """MuJoCo's explicit pairs and the engine's slots: 6 pairs of fingers, all their spheres."""
    the_scene = scene.load("paper_spheres", overrides={"effects": {"finger_finger": True}})
    off = scene.load("paper_spheres")
    pairs = [model.compile_template(s).npair for s in (the_scene, off)]
    assert pairs[0] - pairs[1] == 6 * 10 * 10 == len(finger_pairs.finger_pairs(4)) * 100


def test_concentric_spheres_have_a_normal():
    """Fingers that start inside one another push along MuJoCo's fallback axis, finitely."""
    centre = jnp.zeros((3, 1, 1, 2, 1))
    found = contacts(centre, jnp.full((1, 1, 2, 1), 0.01))
    np.testing.assert_allclose(found.distance[0], -0.02, rtol=1e-6)
    oracle = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><freejoint/><geom size=".01"/></body>
        <body><freejoint/><geom size=".01"/></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(oracle)
    mujoco.mj_forward(oracle, data)
    # MuJoCo's normal points from the first to the second, ours the other way.
    np.testing.assert_allclose(found.normal[:, 0].ravel(), -data.contact.frame[0, :3])
    np.testing.assert_allclose(data.contact.dist[0], -0.02)


def test_slots_hold_the_pairs_that_touch():
    """Random spheres: every touching pair of different fingers has one slot, in every world."""
    random = np.random.default_rng(0)
    links, k, fingers, worlds = 4, 2, 3, 50
    centre = 0.05 * random.normal(size=(3, links, k, fingers, worlds)).astype(np.float32)
    radius = np.full((links, k, fingers, worlds), 0.01, np.float32)
    c = contacts(centre, radius)
    flat = centre.reshape(3, -1, worlds)
    finger = np.arange(flat.shape[1]) % fingers
    for w in range(worlds):
        gap = np.linalg.norm(flat[:, :, None, w] - flat[:, None, :, w], axis=0) - 0.02
        expected = gap[(finger[:, None] < finger) & (gap < 0)]
        found = np.asarray(c.distance)[..., 0, w]
        np.testing.assert_allclose(np.sort(found[found < 0]), np.sort(expected), atol=1e-8)
        assert c.ends is not None and expected.size <= c.ends.touching[0, w] <= expected.size + 1
    assert np.asarray(c.active).sum(0).max() > 3


def test_the_derivative_has_a_slot_for_whatever_touches_in_the_kernel():
    """All spheres in one place fill the slots that the kernel has, whose overflow fails a world."""
    the_scene = scene.load("paper_spheres", overrides={"effects": {"finger_finger": True}})
    pairs, spheres = 6, the_scene.discretization.links
    count = finger_pairs.slots(spheres, the_scene.num_fingers)
    assert count == pairs * pair_slots(the_scene)
    centre, radius = jnp.zeros((3, spheres, 1, 4, 1)), jnp.full((spheres, 1, 4, 1), 0.01)
    c = contacts(centre, radius)
    assert c.ends is not None and c.ends.touching == pairs * spheres**2
    assert c.distance.shape[0] == count == c.active.sum()


@pytest.mark.slow  # a minute of compiling
def test_mjx_equals_mujoco():
    """The same pairs in stock MJX; its Newton stops at the scene's tolerance of 1e-8."""
    with jax.enable_x64(True):
        the_scene = grasps.pinch("sphere", **SETTINGS)
        oracle, data, fields = curled(the_scene, 0, bend=0.8, height=0.07)
        mujoco.mj_forward(oracle, data)
        engine = MjxEngine(the_scene)
        one = jax.tree.map(lambda x: x[0], fields)
        start = engine.reset(one).replace(qpos=jnp.asarray(data.qpos), qvel=jnp.asarray(data.qvel))
        new = jax.jit(engine.step)(one, start, jnp.asarray(data.ctrl))
        assert kinds(oracle, data)[0] > 5
        error = np.linalg.norm(new.qacc - data.qacc) / np.linalg.norm(data.qacc)
        assert error < 1e-4
