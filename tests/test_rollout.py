"""Trials, commands and batches: the same numbers in any order and company; whole grasps."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import control, model, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from codesign_jax.types import Status
from tests.helpers.grasps import GOOD, hand_world, nth, pinch, random_designs, stack

PAPER = scene.load("paper_spheres")
KEY = jax.random.key(5)
draw = jax.jit(lambda key, n: rollout.sample_trials(PAPER, key, n), static_argnums=1)


# --- trials --------------------------------------------------------------------------------------


def test_more_trials_do_not_change_the_first():
    few, many = draw(KEY, 4), draw(KEY, 40)
    for a, b in zip(few, many, strict=True):
        np.testing.assert_array_equal(a, b[:4])


def test_noise_has_the_declared_spread():
    """Means and standard deviations over 20,000 trials, to four standard errors."""
    count, noise = 20_000, PAPER.objects.noise
    trials = draw(jax.random.key(0), count)
    angle = np.deg2rad(noise.orientation)
    for values, mean, sigma in (
        (trials.position, 0.0, noise.position),
        (trials.yaw[:, None], 0.0, angle),
        (trials.arm_tilt, 0.0, angle),
        (trials.mass[:, None], 1.0, noise.mass),
        (trials.size[:, None], 1.0, noise.size),
    ):
        np.testing.assert_allclose(values.mean(0), mean, atol=4 * sigma / np.sqrt(count))
        np.testing.assert_allclose(values.std(0), sigma, rtol=4 / np.sqrt(2 * count))
    columns = np.column_stack(
        [trials.position, trials.yaw, trials.arm_tilt, trials.mass, trials.size]
    )
    correlation = np.corrcoef(columns.T) - np.eye(7)
    assert np.abs(correlation).max() < 4.5 / np.sqrt(count)


# --- commands ------------------------------------------------------------------------------------


# One program for each scene; operation by operation they are eighty.
commanded = jax.jit(control.commands, static_argnums=0)


def commands(**changes):
    params, trial = hand_world(PAPER, pressure=100e3)
    arm = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.3])  # x y z roll pitch yaw
    trial = trial._replace(**changes)
    params, trial = jax.tree.map(jnp.asarray, (params._replace(arm=arm), trial))
    return np.asarray(commanded(PAPER, params, trial))


def test_the_arm_carries_the_trials_tilt():
    tilted = commands(arm_tilt=np.array([0.05, -0.07]))
    difference = tilted - commands()
    np.testing.assert_allclose(difference[:, 3], 0.05, atol=1e-6)
    np.testing.assert_allclose(difference[:, 5], -0.07, atol=1e-6)
    np.testing.assert_array_equal(difference[:, [0, 1, 2, 4, 6, 7, 8, 9]], 0.0)


# --- batches -------------------------------------------------------------------------------------

SHORT = {
    "phases__approach": 0.4,
    "phases__inflate": 0.6,
    "phases__lift": 0.8,
    "phases__disturb": 1.0,
    "phases__ungrasp": 1.6,
}


@pytest.fixture(scope="module")
def batch():
    """A short scene, its engine, and a jitted evaluation that counts its compiles."""
    the_scene = pinch("box", links=2, **SHORT)
    engine, compiles = make_engine("mujoco", the_scene), []
    space = parameters.design_space(the_scene.hand)

    def evaluate(designs, trials):
        compiles.append(designs.shape)
        return rollout.evaluate(the_scene, engine, jax.vmap(space.params)(designs), trials)

    designs = random_designs(space, seed=4, count=5)
    trials = rollout.sample_trials(the_scene, KEY, 4)
    return jax.jit(evaluate), compiles, designs, trials, (the_scene, engine, space)


def assert_same(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_order_of_particles_and_trials_does_not_matter(batch):
    """Also: every particle meets the same trials, whatever its place (common random numbers)."""
    evaluate, _, designs, trials, _ = batch
    whole = evaluate(designs, trials)
    particles, order = np.array([3, 0, 4, 1, 2]), np.array([2, 3, 0, 1])
    shuffled = evaluate(designs[particles], nth(trials, order))
    assert_same(shuffled, (v[particles][:, order] for v in whole))
    twins = evaluate(jnp.stack([designs[0]] * 5), trials)
    assert_same(twins, (jnp.stack([v[0]] * 5) for v in whole))


# --- arm and start -------------------------------------------------------------------------------


@pytest.mark.parametrize("axis, sign, column", [(4, 1, 0), (3, 1, 1)])
def test_pitch_points_the_fingers_to_x_and_roll_to_y(axis, sign, column):
    """Table I's x = -20 mm with a pitch of 15 degrees aims at the object."""
    params, trial = hand_world(PAPER)
    arm = np.zeros(6)
    arm[axis] = sign * np.deg2rad(15)
    params = params._replace(arm=arm)
    compiled = model.compile_model(PAPER, params, trial)
    data = mujoco.MjData(compiled)
    u = commanded(PAPER, *jax.tree.map(jnp.asarray, (params, trial)))
    data.qpos[:6] = u[0, :6]
    mujoco.mj_kinematics(compiled, data)
    centre = model.layout(PAPER).centre_weights @ data.xipos - data.xpos[1]
    assert centre[column] > 0.01 and abs(centre[1 - column]) < 1e-6 and centre[2] < 0


# --- whole grasps in MuJoCo C ---------------------------------------------------------------------


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


@pytest.mark.parametrize("index", range(1, 5))
def test_bad_designs_drop_every_object(pneuflex, index):
    """Too short, without pressure, too high, or beside the object: lost as the hand lifts."""
    the_scene, outcome, trace = pneuflex
    np.testing.assert_array_equal(outcome.status[index], Status.OK)
    assert (outcome.cost[index] > 2.0).all()
    assert (outcome.lost_time[index] < the_scene.phases.lift).all()
