"""Environments: a grasp's actions make the trace of its controls, and trainers' wrappers run."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import env, model, policy, rollout
from codesign_jax.engines import make_engine
from codesign_jax.scene.schema import InputError
from tests.helpers import grasps

gymnasium = pytest.importorskip("gymnasium")
vector = pytest.importorskip("codesign_jax.env.vector")

SCENE = grasps.short_grasp()


class Replay(env.GraspEnv):
    """Its action is what each finger has more than the key frames say [Pa]."""

    def act(self, seen, action):
        return seen.plan._replace(pressure=seen.plan.pressure + action)


@pytest.fixture(scope="module")
def episode():
    """A batch of grasps that actions of zero let the key frames command, and all of its states."""
    params = grasps.hand_world(SCENE)[0]
    params = jax.tree.map(lambda v: np.asarray(v, np.float32), params)
    worlds = vector.VectorEnv(grasp := Replay(SCENE, params, period=0.1), 4, seed=1)
    with pytest.raises(gymnasium.error.ResetNeeded):
        worlds.step(worlds.action_space.sample())
    first, _ = worlds.reset(seed=2)
    assert worlds.observation_space.contains(first)
    states = [worlds._state]
    for k in range(grasp.episode_length):
        obs, _, ended, cut, info = worlds.step(np.zeros((4, 2), np.float32))
        states.append(worlds._state)
        assert ended.all() == (k == grasp.episode_length - 1) and not cut.any()
    assert set(info) == {"held", "distance"} and obs.dtype == np.float32
    return grasp, states, worlds


def test_actions_that_change_nothing_make_the_grasp_of_the_key_frames(episode):
    """Its end and its cost; what is held adds up to what the cost leaves."""
    grasp, states, _ = episode
    trials = states[0].data.trial
    params = jax.tree.map(lambda v: jnp.repeat(v[None], 4, 0), grasp.params)
    simulate = jax.jit(partial(rollout.simulate, SCENE, make_engine("structured", SCENE)))
    outcome, trace = simulate(params, trials)
    ends = [model.split(SCENE, s).qpos for s in (states[-1].data.world.state, trace.last)]
    # Two programs round model fields differently, and contact lets that grow.
    np.testing.assert_allclose(*ends, atol=1e-5)
    rewards = sum(state.reward for state in states)
    np.testing.assert_allclose(rewards, 1 - outcome.cost / SCENE.cost.maximum, atol=1e-6)
    assert [float(state.done.min()) for state in states[-2:]] == [0, 1]
    assert np.unique(trials.yaw).size == 4  # each its own


def test_what_is_observed_is_what_a_hand_feels(episode):
    grasp, states, _ = episode
    seen = jax.jit(jax.vmap(grasp.seen))(states[-1].data)
    felt = states[-1].obs
    np.testing.assert_allclose(felt[:, 0], SCENE.end_time, rtol=1e-6)
    np.testing.assert_allclose(felt[:, 2:4] * grasp.limit, seen.pressure, rtol=1e-5)
    assert felt.shape == (4, grasp.observation_size)
    moved = seen._replace(object=None, object_velocity=None)
    np.testing.assert_array_equal(*map(jax.vmap(grasp.observe), (moved, seen)))


@pytest.mark.slow  # quick: the vector environment, which begins ended grasps anew as well
def test_brax_trains_on_it_as_on_its_own(episode):
    """Its wrappers begin a grasp anew where one ended."""
    training = pytest.importorskip("brax.envs.wrappers.training")
    grasp = episode[0]
    wrapped = training.wrap(grasp, episode_length=grasp.episode_length)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 4))
    first = np.asarray(state.obs)
    step = jax.jit(wrapped.step)
    for _ in range(grasp.episode_length):
        state = step(state, jnp.zeros((4, 2)))
    assert (state.done == 1).all() and (state.info["truncation"] == 0).all()
    np.testing.assert_array_equal(state.obs, first)


def test_a_vector_environment_begins_ended_grasps_with_new_noise(episode):
    _, states, worlds = episode
    _, reward, ended, *_ = worlds.step(np.zeros((4, 2), np.float32))
    assert not ended.any() and (reward == 0).all()
    before, after = states[0].data.trial.yaw, worlds._state.data.trial.yaw
    assert not (np.asarray(after) == np.asarray(before)).any()


def test_a_period_that_no_steps_make_is_refused():
    with pytest.raises(InputError, match="not a whole number of time steps"):
        env.GraspEnv(SCENE, period=0.033)
    assert policy.period_steps(SCENE, 0.03) == 3
