"""Contact of spheres with the palm, in float64: MuJoCo C and planted faults.

That of rings stands in `test_planted_contacts`.
"""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.lanewise import lanes, lanewise
from tests.helpers import curled_hands, grasps
from tests.helpers.curled_hands import curled
from tests.helpers.planted_faults import Fault, cone_of, planted, simulate

BOUND = 1e-8
"""As in test_kernel_pairs.py."""
STATE = (3, 1.9, 0.045)
"""Arguments of `curled`: fingers on the palm, on one another and on the object."""
SETTINGS = {
    "effects__finger_finger": True,
    "effects__finger_palm": True,
    "contact__finger_finger_friction": 0.6,  # neither the object's nor the palm's
    "contact__finger_palm_friction": 0.4,
}


def flipped(right, *args):
    """Both sides of a contact with the palm are pushed the wrong way."""
    found = right(*args)
    return found._replace(normal=-found.normal)


def not_pushed(right, mine, self, item, field, more, *rest):
    """The palm does not feel the contact."""
    left = lanewise(lambda m, k: m * k, more, lanes([jnp.where(mine, 0.0, 1.0)], (), wide=True))
    right(self, item, field, left if field == "other" else more, *rest)


FAULTS = {
    "the palm pulls": Fault({"ball_on_field": flipped}),
    "the palm does not feel fingers": Fault({}, methods={(BoundPairs, "_add_wrench"): not_pushed}),
    "the palm rubs as fingers do": cone_of("finger_palm", "finger_finger"),
}


def scene_of():
    return grasps.pinch("sphere", links=2, discretization__spheres_per_link=2, **SETTINGS)


def accelerations(model, data):
    """By MuJoCo C; all kinds of contacts are there."""
    mujoco.mj_forward(model, data)
    assert on_palm(model, data) > 0
    return data.qacc.copy()


def on_palm(model, data):
    """Number of contacts with the palm's disc."""
    return int((data.contact.geom == model.geom("palm_disc").id).any(1).sum())


@functools.cache
def simulated():
    """Relative errors of a step's accelerations, of each fault's world and of a sound one."""
    with jax.enable_x64(True):
        scene = scene_of()
        state = curled(scene, *STATE)
        each = [state] * (len(FAULTS) + 1)
        fields, qpos, qvel, ctrl = curled_hands.batched(each)
        with planted(FAULTS):
            run = jax.jit(partial(simulate, scene, iterations=30))
            ctrl = jnp.asarray(np.repeat(ctrl[:, None], 2, 1))
            found = run(fields, (qpos, qvel), ctrl, np.arange(len(each)))
        expected = accelerations(*state[:2])
    acc = (np.asarray(found["qvel"])[:, 1] - qvel) / scene.discretization.timestep
    return np.linalg.norm(acc - expected, axis=1) / np.linalg.norm(expected)


def test_accelerations_equal_mujoco():
    assert simulated()[-1] < BOUND


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_noticed(name):
    """By a hundred times the bound."""
    assert not simulated()[[*FAULTS].index(name)] < 100 * BOUND


@pytest.mark.slow  # quick: one state of hulls and of spheres above
@pytest.mark.parametrize("friction", ["coulomb", "none", "full"])
@pytest.mark.parametrize("between", [True, False])
def test_spheres_equal_mujoco_on_curled_hands(friction, between):
    """Up to eight spheres on the palm, with and without contact between fingers."""
    settings = SETTINGS | {"effects__finger_finger": between, "effects__friction": friction}
    with jax.enable_x64(True):
        scene = grasps.pinch("sphere", discretization__spheres_per_link=2, **settings)
        bends = (1.3, 1.5, 1.6, 1.2, 1.8, 0.3)
        worlds = [curled(scene, s, bend, height=0.12) for s, bend in enumerate(bends)]
        inputs = curled_hands.batched(worlds)
        qvel, _ = curled_hands.one_step(scene)(*inputs)
        acc = (np.asarray(qvel) - inputs[2]) / scene.discretization.timestep
        for mine, (model, data, _), bend in zip(acc, worlds, bends, strict=True):
            mujoco.mj_forward(model, data)
            assert (on_palm(model, data) > 1) == (bend > 1)
            assert np.linalg.norm(mine - data.qacc) < BOUND * np.linalg.norm(data.qacc)
