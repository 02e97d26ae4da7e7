"""Whole grasps in MuJoCo C: good hands lift and hold every object, bad ones do not."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import model, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from codesign_jax.types import Status
from tests.helpers.grasps import GOOD, stack

SHAPES = range(3)


def design(the_scene, **changes):
    """Full design with every finger alike; parameters that are not named are zero."""
    space = parameters.design_space(the_scene.hand)
    named = {**GOOD, **changes}
    values = [named.get(name.split("[")[0], 0.0) for name in space.names]
    return space.params(jnp.asarray(space.from_units(np.array(values)), jnp.float32))


def grasp(the_scene, *designs, trials=None):
    """Outcomes and traces, with leading axes (design, shape), of nominal trials."""
    engine = make_engine("mujoco", the_scene)
    trials = trials or [rollout.nominal_trial(the_scene, s) for s in SHAPES]
    params = stack(*(p for p in designs for _ in trials))
    worlds = stack(*(t for _ in designs for t in trials))
    result = jax.jit(lambda p, t: rollout.simulate(the_scene, engine, p, t, record_qpos=True))(
        params, worlds
    )
    return jax.tree.map(
        lambda v: np.asarray(v).reshape(len(designs), len(trials), *v.shape[1:]), result
    )


@pytest.fixture(scope="module")
def pneuflex():
    """The paper's hand with a good design and four bad ones, on all three objects."""
    the_scene = scene.load("paper_spheres")
    short, limp = design(the_scene, length=25), design(the_scene, pressure=0)
    high, beside = design(the_scene, arm_z=150), design(the_scene, arm_y=60)
    outcome, trace = grasp(the_scene, design(the_scene), short, limp, high, beside)
    return the_scene, outcome, trace


def test_a_good_design_grasps_every_object(pneuflex):
    _, outcome, _ = pneuflex
    np.testing.assert_array_equal(outcome.status[0], Status.OK)
    np.testing.assert_array_equal(outcome.cost[0], 0.0)


def test_it_lifts_shakes_and_releases(pneuflex):
    """For the right reason: carried up with the hand, kept through the shaking, then dropped."""
    the_scene, _, trace = pneuflex
    start, phases = the_scene.arm.start_height, the_scene.phases
    height, distance = trace.height[0], trace.distance[0]

    def at(time):
        return height[:, round(time / the_scene.discretization.timestep) - 1]

    assert (at(phases.approach) < 0.04).all()  # on the table
    assert (at(phases.lift) > 0.1).all() and (at(phases.lift) < start).all()
    assert (height[:, 450:800] > 0.1).all() and (distance[:, 350:800] < 0.08).all()
    assert (at(phases.ungrasp) < 0.07).all()  # released, on the table in whatever pose
    assert (distance[:, -1] > 0.08).all()


def test_nothing_is_thrown_or_torn(pneuflex):
    """Speeds stay those of a soft hand that carries something.

    The bound is the fingers' snap when they spring off the object at release.
    """
    _, _, trace = pneuflex
    assert trace.speed[0].max() < 60.0
    carried = np.diff(trace.height[0][:, 350:800], axis=1) / 0.01
    assert np.abs(carried).max() < 1.0  # the object never jumps in the hand


@pytest.mark.parametrize("index", range(1, 5))
def test_bad_designs_drop_every_object(pneuflex, index):
    """Too short, without pressure, too high, or beside the object: lost as the hand lifts."""
    the_scene, outcome, trace = pneuflex
    np.testing.assert_array_equal(outcome.status[index], Status.OK)
    assert (outcome.cost[index] > 2.0).all()
    assert (outcome.lost_time[index] < the_scene.phases.lift).all()


def test_without_friction_straight_sides_slip():
    """Cuboid and cylinder are held by friction alone; the sphere also by fingers underneath it."""
    the_scene = scene.load("paper_spheres")
    slippery = tuple(dataclasses.replace(o, friction=0.0) for o in the_scene.objects.object)
    the_scene = dataclasses.replace(
        the_scene, objects=dataclasses.replace(the_scene.objects, object=slippery)
    )
    outcome, _ = grasp(the_scene, design(the_scene))
    assert (outcome.cost[0, :2] > 2.0).all()


def test_another_hand_grasps_with_no_line_of_code():
    the_scene = scene.load("paper_spheres", hand_name="tripod3")
    outcome, _ = grasp(the_scene, design(the_scene))
    np.testing.assert_array_equal(outcome.status, Status.OK)
    np.testing.assert_array_equal(outcome.cost, 0.0)


def test_fingers_stay_outside_the_object(pneuflex):
    """Contact spheres sink into the object by F / k_n, millimetres at the most."""
    the_scene, _, trace = pneuflex
    params = jax.tree.map(np.asarray, design(the_scene))
    for shape in SHAPES:
        trial = jax.tree.map(np.asarray, rollout.nominal_trial(the_scene, shape))
        compiled = model.compile_model(the_scene, params, trial)
        data, deepest = mujoco.MjData(compiled), 0.0
        for qpos in trace.qpos[0, shape, 200:800:5]:
            data.qpos[:] = qpos
            mujoco.mj_fwdPosition(compiled, data)
            deepest = min(deepest, data.contact.dist.min())
        # 130 kPa hold a finger down with at most a few newtons, on contacts of 2 kN/m.
        assert -deepest < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("hand_name", ["pneuflex4", "tripod3"])
def test_the_good_design_is_robust(hand_name):
    """Of noisy trials three quarters succeed at least.

    Keys 8 to 15 gave 82 and 83 of 96, 0.86: the share of 48 then has a standard deviation of 0.05.
    """
    the_scene = scene.load("paper_spheres", hand_name=hand_name)
    drawn = rollout.sample_trials(the_scene, jax.random.key(12), 48)
    trials = [jax.tree.map(lambda v, i=i: v[i], drawn) for i in range(48)]
    outcome, _ = grasp(the_scene, design(the_scene), trials=trials)
    assert (outcome.cost == 0.0).sum() >= 36
