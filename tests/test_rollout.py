"""Trials, commands and batches: the same numbers in any order and company; whole grasps."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import control, model, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from codesign_jax.types import Status
from tests.helpers.grasps import (
    GOOD,
    hand_world,
    hurried,
    nth,
    pinch,
    random_designs,
    repeat,
    stack,
    world_inputs,
)

PAPER = scene.load("paper_spheres")
KEY = jax.random.key(5)
draw = jax.jit(lambda key, n: rollout.sample_trials(PAPER, key, n), static_argnums=1)


def test_more_trials_do_not_change_the_first():
    few = draw(KEY, 4)
    many = draw(KEY, 40)
    for a, b in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(a, b[:4])


def test_a_number_of_trials_needs_no_program_of_its_own():
    """Fewer are cut from more, also where another program closes over the key."""
    seven = rollout.sample_trials(PAPER, KEY, 7, 3)
    many = rollout.sample_trials(PAPER, KEY, 2 * rollout.LEAST + 1)  # a larger program
    closed = jax.jit(lambda x: x + rollout.sample_trials(PAPER, KEY, 7, 3).position)(0.0)
    for a, b in zip(jax.tree.leaves(seven), jax.tree.leaves(many), strict=True):
        np.testing.assert_allclose(a, b[3:10], rtol=1e-6, atol=1e-9)  # the last bit, see XLA
        assert isinstance(a, jax.Array)
    np.testing.assert_array_equal(closed, seven.position)


def test_noise_has_the_declared_spread():
    """Means and standard deviations over 20,000 trials, to four standard errors."""
    count = 20_000
    noise = PAPER.objects.noise
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


def test_order_of_particles_and_trials_does_not_matter():
    """Also: every particle meets the same trials, whatever its place (common random numbers)."""
    the_scene = pinch("box", links=2, **hurried(0.4, 0.6, 0.8, 1.0, 1.6))
    engine = make_engine("mujoco", the_scene)
    space = parameters.design_space(the_scene.hand)

    @jax.jit
    def evaluate(designs, trials):
        return rollout.evaluate(the_scene, engine, jax.vmap(space.params)(designs), trials)

    designs = random_designs(space, seed=4, count=5)
    trials = rollout.sample_trials(the_scene, KEY, 4)
    whole = evaluate(designs, trials)
    particles = np.array([3, 0, 4, 1, 2])
    order = np.array([2, 3, 0, 1])
    shuffled = evaluate(designs[particles], nth(trials, order))
    twins = evaluate(jnp.stack([designs[0]] * 5), trials)
    for values, mixed, same in zip(whole, shuffled, twins, strict=True):
        np.testing.assert_array_equal(mixed, values[particles][:, order])
        np.testing.assert_array_equal(same, jnp.stack([values[0]] * 5))


@pytest.mark.parametrize("axis, sign, column", [(4, 1, 0), (3, 1, 1)])
def test_pitch_points_the_fingers_to_x_and_roll_to_y(axis, sign, column):
    """Table I's x = -20 mm with a pitch of 15 degrees aims at the object."""
    params, trial = hand_world(PAPER)
    arm = np.zeros(6)
    arm[axis] = sign * np.deg2rad(15)
    params = params._replace(arm=arm)
    compiled = model.compile_model(PAPER, params, trial)
    data = mujoco.MjData(compiled)
    u = jax.jit(partial(control.commands, PAPER))(params, trial)
    data.qpos[:6] = u[0, :6]
    mujoco.mj_kinematics(compiled, data)
    centre = model.layout(PAPER).centre_weights @ data.xipos - data.xpos[1]
    assert centre[column] > 0.01 and abs(centre[1 - column]) < 1e-6 and centre[2] < 0


def design(the_scene, **changes):
    """Full design with every finger alike; parameters that are not named are zero."""
    space = parameters.design_space(the_scene.hand)
    named = {**GOOD, **changes}
    values = [named.get(name.split("[")[0], 0.0) for name in space.names]
    return space.params(jnp.asarray(space.from_units(np.array(values)), jnp.float32))


@pytest.fixture(scope="module")
def pneuflex():
    """The paper's hand with a good design and four bad ones, on all three objects.

    Outcomes and traces have leading axes (design, shape).
    """
    the_scene = scene.load("paper_spheres")
    changes = {}, {"length": 25}, {"pressure": 0}, {"arm_z": 150}, {"arm_y": 60}
    params = stack(*(p for c in changes for p in [design(the_scene, **c)] * 3))
    trials = stack(*[rollout.nominal_trial(the_scene, s) for s in range(3)] * 5)
    simulate = partial(rollout.simulate, the_scene, make_engine("mujoco", the_scene))
    results = jax.jit(simulate)(params, trials)
    return the_scene, *jax.tree.map(lambda v: np.reshape(v, (5, 3, *v.shape[1:])), results)


@pytest.mark.parametrize("hand", ["pneuflex4", "tapered4", "tripod3"])
def test_tips_are_where_mujoco_has_the_ends_of_the_last_links(hand):
    """Of random postures, by its kinematics of the model that is compiled and exported."""
    the_scene = scene.load("paper", hand_name=hand, overrides={"discretization.links": 4})
    params, trial = hand_world(the_scene)
    params = jax.tree.map(np.asarray, params)
    compiled = model.compile_model(the_scene, params, trial)
    data = mujoco.MjData(compiled)
    rng = np.random.default_rng(3)
    postures = rng.normal(0.0, 0.3, (2, 3, compiled.nq))
    postures[..., -4:] /= np.linalg.norm(postures[..., -4:], axis=-1, keepdims=True)
    tips = rollout.tips(the_scene, params, trial, postures)
    assert tips.shape == (2, 3, the_scene.num_fingers, 3)
    for index in np.ndindex(2, 3):
        data.qpos = postures[index]
        mujoco.mj_kinematics(compiled, data)
        for k, length in enumerate(params.length):
            end = data.body(f"finger_{k}_link_4")
            there = end.xpos + end.xmat.reshape(3, 3) @ [length / 8, 0, 0]
            # Chains of a dozen rotations in float32, over up to a metre of a random wrist.
            np.testing.assert_allclose(tips[index][k], there, atol=2e-6)


def test_positions_of_another_kind_have_no_tips():
    params, trial = hand_world(PAPER)
    for shape, words in {(5, 0): "record_qpos=True records it", (5, 12): "of this scene"}.items():
        with pytest.raises(scene.InputError, match=words):
            rollout.tips(PAPER, params, trial, np.zeros(shape))
    with pytest.raises(scene.InputError, match="params have no axis|has shape"):
        rollout.tips(PAPER, jax.tree.map(lambda v: v[None], params), trial, np.zeros((5, 53)))


ACCELERATED = {"effects.wrist": False, "arm.shake_amplitude": 0.0, "arm.shake_acceleration": 2.0}
"""A rigid mount that moves by 2 m/s^2 in place of the turns."""


def transported(the_scene, axis):
    """Times of the third of the phase in which an axis moves [s]: begin, three quarters, end."""
    p = the_scene.phases
    third = (p.disturb - p.lift) / 3
    return p.lift + third * (axis + np.array([0.0, 0.25, 0.5, 0.75, 1.0]))


@pytest.mark.parametrize("axis", range(3))
def test_the_arm_accelerates_along_each_axis_of_the_world(axis):
    """By +a, -a for twice as long and +a again: from rest at its place to rest at its place."""
    the_scene = scene.load("paper", overrides=ACCELERATED)
    params, trial = hand_world(the_scene)
    turned = params._replace(arm=np.array([0.0, 0.0, 0.0, 0.3, 0.2, 0.1]))
    place = np.asarray(jax.jit(partial(control.commands, the_scene))(turned, trial), float)[:, axis]
    h = the_scene.discretization.timestep
    time = np.arange(len(place)) * h
    begin, first, middle, last, end = transported(the_scene, axis)
    place = place - place[int(begin / h)]
    size = 2.0 * (end - begin) ** 2 / 16
    peak = place[(time >= begin) & (time <= end)].max()
    assert peak == pytest.approx(size, rel=1e-3) and time[place.argmax()] == pytest.approx(
        middle, abs=h
    )
    # Second differences in float32 of a few tenths of a metre: 3e-8 m over h^2 is 3e-4 m/s^2.
    acceleration = np.diff(place, 2) / h**2
    centre = time[1:-1]
    for low, high, sign in ((begin, first, 1), (first, last, -1), (last, end, 1)):
        inside = (centre > low + h) & (centre < high - h)
        np.testing.assert_allclose(acceleration[inside], sign * 2.0, atol=5e-3)
    shaken = (time > the_scene.phases.lift) & (time <= the_scene.phases.disturb)
    at_rest = shaken & ((time < begin) | (time > end))
    np.testing.assert_allclose(place[at_rest], 0, atol=1e-6)


def test_what_a_rigid_hand_holds_is_accelerated_with_it():
    """In MuJoCo C: it goes and comes back with the arm, but for what soft fingers yield."""
    the_scene = scene.load("paper_spheres", overrides=ACCELERATED)
    with jax.enable_x64(True):  # a prescribed palm is a heavy body there
        engine = make_engine("mujoco", the_scene)
        hand, trial = design(the_scene), rollout.nominal_trial(the_scene, 2)
        inputs = world_inputs(the_scene, hand, trial)
        trace = engine.rollout(*(repeat(each, 1) for each in inputs), trajectory=True)
    ctrl = inputs[1]
    held = np.asarray(trace.qpos)[0, :, -7:-4]  # the free joint comes last
    h = the_scene.discretization.timestep
    for axis in range(3):
        begin, first, middle, last, end = (round(t / h) for t in transported(the_scene, axis))
        path = held[begin:end, axis] - held[begin - 1, axis]
        arm = np.asarray(ctrl)[begin:end, axis] - float(ctrl[begin - 1, axis])
        assert arm.max() == pytest.approx(2.0 * ((end - begin) * h) ** 2 / 16, rel=0.02)
        # Fingers of 60 to 90 mm yield by millimetres to 0.1 N, a tenth of the way of 0.17 m.
        np.testing.assert_allclose(path, arm, atol=0.1 * arm.max())
        # Over the half in which the arm decelerates the object's velocity changes by a T/2.
        speed = np.gradient(held[:, axis], h)
        change = speed[last] - speed[first]
        assert change == pytest.approx(-2.0 * (last - first) * h, rel=0.25)


def test_a_good_design_grasps_every_object(pneuflex):
    _, outcome, _ = pneuflex
    np.testing.assert_array_equal(outcome.status[0], Status.OK)
    np.testing.assert_array_equal(outcome.cost[0], 0.0)


def test_it_lifts_shakes_and_releases(pneuflex):
    """For the right reason: carried up with the hand, kept through the shaking, then dropped."""
    the_scene, _, trace = pneuflex
    start = the_scene.arm.start_height
    phases = the_scene.phases
    height = trace.height[0]
    distance = trace.distance[0]

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
    status = np.asarray(outcome.status[index])
    assert np.isin(status, [Status.OK, Status.UNMOVED]).all()
    if index == 3:  # too high to touch anything
        assert (status == Status.UNMOVED).all()
    assert (outcome.cost[index] > 2.0).all()
    assert (outcome.lost_time[index] < the_scene.phases.lift).all()
