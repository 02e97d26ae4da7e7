"""Contact of fingers with the palm, in float64: MuJoCo C, a dense solve and planted faults."""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.lanewise import lanes, lanewise
from tests.helpers import curled_hands, dense_steps, grasps
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
    mine, other = right(*args)
    return (mine[0], -mine[1], *mine[2:]), (other[0], -other[1], *other[2:])


def not_pushed(right, mine, self, item, wrench):
    """The palm does not feel the contact."""
    left = jnp.where(mine, 0.0, 1.0)
    right(self, item, lanewise(lambda w, k: w * k, wrench, lanes([left], (), wide=True)))


def moving(right, mine, self, motion, palm):
    """Motions that contacts with the palm see are not relative to it."""
    found = right(self, motion, palm)
    return lanewise(lambda m, a, b: jnp.where(m, a, b), lanes([mine], (), wide=True), motion, found)


def seen_late(right, timestep, mine, vel):
    """A contact ahead of touch sees the gap that is there."""
    (point, normal, _, *rest), seen = right(timestep, mine, vel)
    return (point, normal, mine[2], *rest), seen


def not_closing(right, sums):
    """A contact ahead of touch stops a finger where it is."""
    one, other, (inside, closing) = right(sums)
    return one, other, (inside, 0.0 * closing)


ON_PALM = {"hull": "on_palm", "ahead": "on_palm", "spheres": "ball_on_palm"}
FAULTS = {
    surface: {
        "the palm pulls": Fault({stage: flipped}),
        "the palm does not feel fingers": Fault(
            {}, methods={(BoundPairs, "_push_palm"): not_pushed}
        ),
        "contacts move with the palm": Fault({}, methods={(BoundPairs, "beside_palm"): moving}),
        "the palm rubs as fingers do": cone_of("finger_palm", "finger_finger"),
    }
    for surface, stage in ON_PALM.items()
}
FAULTS["ahead"] |= {
    "contacts ahead see the gap that is there": Fault({"ahead": seen_late}),
    "contacts ahead stop a finger where it is": Fault({"pressure_ahead": not_closing}),
}


def scene_of(surface):
    """Spheres, the hull, or the hull that touches the palm ahead."""
    density = {"discretization__spheres_per_link": 2}
    if surface != "spheres":
        density = {"discretization__hull_rings": 2, "discretization__hull_points": 8}
        density |= {"effects__surface": "hull", "effects__speculative_palm": surface == "ahead"}
    return grasps.pinch("sphere", links=2, **SETTINGS, **density)


def accelerations(scene, model, data):
    """By MuJoCo C, with the hull by a dense solve; all kinds of contacts are there."""
    mujoco.mj_forward(model, data)
    if scene.effects.surface == "hull":
        with jax.enable_x64(True):
            hand, _ = grasps.hand_world(scene, length=0.1)
        dense = dense_steps.DensePairs(scene, model, data, hand)
        print(dense.on_palm, dense.ahead, dense.pairs, dense.num_hull)
        assert dense.on_palm > 2 and dense.pairs > 3 and dense.num_hull > 20
        return dense.solve()
    assert on_palm(model, data) > 0
    return data.qacc.copy()


def on_palm(model, data):
    """Number of contacts with the palm's disc."""
    return int((data.contact.geom == model.geom("palm_disc").id).any(1).sum())


@functools.cache
def simulated(surface):
    """Relative errors of a step's accelerations, of each fault's world and of a sound one."""
    with jax.enable_x64(True):
        scene, faults = scene_of(surface), FAULTS[surface]
        state = curled(scene, *STATE)
        each = [state] * (len(faults) + 1)
        fields, qpos, qvel, ctrl = curled_hands.batched(each)
        with planted(faults):
            run = jax.jit(partial(simulate, scene, iterations=30))
            ctrl = jnp.asarray(np.repeat(ctrl[:, None], 2, 1))
            found = run(fields, (qpos, qvel), ctrl, np.arange(len(each)))
        expected = accelerations(scene, *state[:2])
    acc = (np.asarray(found["qvel"])[:, 1] - qvel) / scene.discretization.timestep
    return np.linalg.norm(acc - expected, axis=1) / np.linalg.norm(expected)


# A kernel each. The hull that touches ahead has the hull's own contacts with the palm as well, and
# their faults are planted there too.
SLOW = pytest.mark.slow
SURFACES = [pytest.param("hull", marks=SLOW), "ahead", "spheres"]


@pytest.mark.parametrize("surface", SURFACES)
def test_accelerations_equal_the_oracle(surface):
    assert simulated(surface)[-1] < BOUND


@pytest.mark.parametrize(
    ("surface", "name"),
    [pytest.param(s, n, marks=SLOW if s == "hull" else ()) for s in FAULTS for n in FAULTS[s]],
)
def test_a_planted_fault_is_noticed(surface, name):
    """By a hundred times the bound."""
    error = simulated(surface)[[*FAULTS[surface]].index(name)]
    assert not error < 100 * BOUND


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
