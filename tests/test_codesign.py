"""Episodes, seeds and tests: what an optimisation does with an engine's outcomes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import codesign
from codesign_jax.optimize import schedule
from tests.helpers import episodes
from tests.helpers.toy_engine import tiny

PARTICLES = 8
TRIALS = 3


@pytest.fixture(scope="module")
def setup():
    """Scene, space, engine, filter and the episode function."""
    the_scene, space, engine = tiny()
    optimizer = codesign.make_filter(space)
    episode = partial(codesign.Task(the_scene, space, TRIALS, engine).episode, optimizer)
    return the_scene, space, engine, optimizer, episode


def start(optimizer, seed=0, particles=PARTICLES, design=(0.05, 0.0)):
    """State before the first episode."""
    return optimizer.init(jax.random.key(seed), np.array(design), particles)


def test_episode_is_move_evaluate_weigh_and_resample(setup):
    the_scene, space, engine, optimizer, episode = setup
    state = start(optimizer)
    mask = np.array([True, True])
    new, info = episode(state, mask)
    # The same arithmetic in another program, where the compiler fuses it: the last bit may differ.
    np.testing.assert_allclose(info.population, optimizer.ask(state, mask), rtol=1e-6, atol=1e-8)
    assert info.outcomes.cost.shape == info.outcomes.status.shape == (PARTICLES, TRIALS)
    np.testing.assert_allclose(info.selection.cost, info.outcomes.cost.mean(1), rtol=1e-6)
    np.testing.assert_array_equal(new.particles, info.population[info.selection.ancestors])
    assert int(new.episode) == 1


def test_noise_differs_between_episodes_seeds_and_the_test(setup):
    the_scene, space, engine, optimizer, episode = setup
    closed = np.zeros(2, bool)
    first, info = episode(start(optimizer), closed)
    seen = [info, episode(first, closed)[1], episode(start(optimizer, seed=1), closed)[1]]
    evaluate = episodes.evaluate_by(episode, optimizer)
    testing = codesign.testing(the_scene, first.particles, first.key, num_trials=2 * TRIALS)
    test = episodes.answered(testing, evaluate)
    rows = [i.outcomes.cost[0] for i in seen]
    rows += [test.outcomes.cost[0, :TRIALS], test.outcomes.cost[0, TRIALS:]]
    assert len(np.unique(np.asarray(rows), axis=0)) == 5


def test_a_run_vmaps_over_seeds_and_is_the_loop_of_its_episodes(setup):
    """Each seed of a batch with its own schedule, as a loop over single episodes."""
    the_scene, space, engine, optimizer, episode = setup
    run = partial(codesign.Task(the_scene, space, TRIALS, engine).run, optimizer)
    masks = np.stack(
        [schedule(n, np.array(space.is_morphology), 3) for n in ("concurrent", "control")]
    )
    starts = [start(optimizer, 0), start(optimizer, 7, design=(0.09, 0.03))]
    ends, infos = jax.jit(jax.vmap(run))(jax.tree.map(lambda *v: jnp.stack(v), *starts), masks)
    # Two programs round differently, which may move a loss by one time step.
    step = the_scene.discretization.timestep
    for k, state in enumerate(starts):
        for e in range(3):
            state, want = episode(state, masks[k, e])
            np.testing.assert_allclose(infos.outcomes.cost[k, e], want.outcomes.cost, atol=3 * step)
        np.testing.assert_allclose(ends.particles[k], state.particles, rtol=1e-5)
    assert np.ptp(infos.outcomes.cost) > 0.1


def test_seed_is_poor_and_reproducible(setup):
    the_scene, space, _, optimizer, episode = setup
    evaluate = episodes.evaluate_by(episode, optimizer)

    def find(seed):
        key = jax.random.key(seed)
        search = codesign.seed_search(the_scene, optimizer, key, batch=PARTICLES)
        return episodes.answered(search, evaluate)

    a, cost, drawn = find(0)
    b, *_ = find(0)
    c, *_ = find(1)
    assert cost > codesign.SEED_COST and drawn >= 1
    np.testing.assert_array_equal(a, b)
    assert (np.asarray(a) != np.asarray(c)).any()
    assert (np.asarray(a) >= space.low).all() and (np.asarray(a) <= space.high).all()


def test_final_test_counts_the_last_episode(setup):
    the_scene, _, _, optimizer, episode = setup
    state, info = episode(start(optimizer), np.ones(2, bool))
    kept = jax.tree.map(lambda v: v[info.selection.ancestors], info.outcomes)
    evaluate = episodes.evaluate_by(episode, optimizer)
    how = {"num_trials": 4, "previous": kept}
    testing = codesign.testing(the_scene, state.particles, state.key, **how)
    result = episodes.answered(testing, evaluate)
    # Four more trials take two rounds of three, and three were there.
    assert result.outcomes.cost.shape == (PARTICLES, 9)
    np.testing.assert_array_equal(result.outcomes.cost[:, :3], kept.cost)
    np.testing.assert_allclose(result.cost, result.outcomes.cost.mean(1), rtol=1e-6)


@pytest.mark.parametrize(
    ("means", "expected"),
    [
        ([3, 2, 0.5, 0.4], 2),
        ([0.5, 0.4], 0),
        ([3, 0.5, 1.0, 0.4], 3),  # at the threshold is not below it
        ([0.5, 3], None),
        ([3.0, np.nan, 0.5], 2),
        ([np.inf, np.nan], None),
    ],
)
def test_convergence_episode(means, expected):
    assert codesign.convergence_episode(means) == expected
