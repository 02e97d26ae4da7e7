"""Episodes, seeds and tests: what an optimisation does with an engine's outcomes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import batch, codesign
from codesign_jax.optimize import schedule
from tests.helpers.toy_engine import frozen, tiny

PARTICLES = 8
TRIALS = 3


@pytest.fixture(scope="module")
def setup():
    """Scene, task, filter and the episode function."""
    the_scene, space, engine = tiny()
    optimizer = codesign.make_filter(space)
    task = codesign.Task(the_scene, space, TRIALS, engine)
    return the_scene, task, optimizer, partial(task.episode, optimizer)


def test_batches_of_any_size_are_one_program():
    """Of worlds that are filled up to one size; a traced call is a program of its own."""
    the_scene, space, engine = tiny()
    engine.fills = True
    task = codesign.Task(the_scene, space, TRIALS, engine)
    low, high = np.array(space.low), np.array(space.high)
    key = jax.random.key(0)
    draws = np.random.default_rng(0).random((40, 2))  # which fill two calls on CPUs
    population = (low + (high - low) * draws).astype(np.float32)
    whole = jax.jit(task.evaluate)(population, key)
    engine.traced = 0
    for count in (1, 5, 40):  # in the same trials, whoever is beside them
        outcomes = task.evaluate(population[:count], key)
        assert engine.traced == 1
        np.testing.assert_allclose(outcomes.cost, whole.cost[:count], rtol=1e-6)
    sizes = {worlds: batch.call_size(worlds) for worlds in range(1, 2 * batch.LIMIT, 97)}
    assert len({*sizes.values()}) <= 8
    assert all(-(-worlds // size) * size >= worlds for worlds, size in sizes.items())


def start(optimizer, seed=0, particles=PARTICLES, design=(0.05, 0.0)):
    """State before the first episode."""
    return optimizer.init(jax.random.key(seed), np.array(design), particles)


def test_episode_is_move_evaluate_weigh_and_resample(setup):
    the_scene, task, optimizer, episode = setup
    state = start(optimizer)
    mask = np.array([True, True])
    new, info = episode(state, mask)
    # The same arithmetic in another program, where the compiler fuses it: the last bit may differ.
    np.testing.assert_allclose(
        info.population, jax.jit(optimizer.ask)(state, mask), rtol=1e-6, atol=1e-8
    )
    assert info.outcomes.cost.shape == info.outcomes.status.shape == (PARTICLES, TRIALS)
    np.testing.assert_allclose(info.selection.cost, info.outcomes.cost.mean(1), rtol=1e-6)
    np.testing.assert_array_equal(new.particles, info.population[info.selection.ancestors])
    assert int(new.episode) == 1


def test_noise_differs_between_episodes_seeds_and_the_test(setup):
    the_scene, task, optimizer, episode = setup
    mask = np.zeros(2, bool)
    first, info = episode(start(optimizer), mask)
    seen = [info, episode(first, mask)[1], episode(start(optimizer, seed=1), mask)[1]]
    rows = [i.outcomes.cost[0] for i in seen]
    keys = [codesign.test_key(first.key, k) for k in range(2)]
    tests = [frozen(optimizer, first.particles, key) for key in keys]
    rows += [episode(*test)[1].outcomes.cost[0] for test in tests]
    assert len(np.unique(np.asarray(rows), axis=0)) == 5


def test_a_run_vmaps_over_seeds_and_is_the_loop_of_its_episodes(setup):
    """Each seed of a batch with its own schedule, as a loop over single episodes."""
    the_scene, task, optimizer, episode = setup
    run = partial(task.run, optimizer)
    domains = np.array(task.space.is_morphology)
    masks = np.stack([schedule(n, domains, 3) for n in ("concurrent", "control")])
    starts = [start(optimizer, 0), start(optimizer, 7, design=(0.09, 0.03))]
    both = jax.tree.map(lambda *v: jnp.stack(v), *starts)
    ends, infos = jax.jit(jax.vmap(run))(both, masks)
    beside = task.side_by_side(optimizer)
    # Two programs round differently, which may move a loss by one time step.
    same = partial(np.testing.assert_allclose, atol=3 * the_scene.discretization.timestep)
    states, together = beside(both, masks[:, 0])
    same(together.outcomes.cost, infos.outcomes.cost[:, 0])
    same(together.drawn.position, infos.drawn.position[:, 0])
    np.testing.assert_allclose(states.particles[0], episode(starts[0], masks[0, 0])[0].particles)
    for k, state in enumerate(starts):
        for e in range(3):
            state, want = episode(state, masks[k, e])
            same(infos.outcomes.cost[k, e], want.outcomes.cost)
        np.testing.assert_allclose(ends.particles[k], state.particles, rtol=1e-5)
    assert np.ptp(infos.outcomes.cost) > 0.1


def test_seed_is_poor_and_reproducible(setup):
    the_scene, task, optimizer, episode = setup
    space = task.space

    def evaluate(population, key):
        _, info = episode(*frozen(optimizer, population, key))
        np.testing.assert_array_equal(info.population, population)
        return info.outcomes

    def find(seed):
        key = jax.random.key(seed)
        return codesign.seed_search(the_scene, optimizer, key, evaluate, batch=PARTICLES)

    a, cost, drawn = find(0)
    b, *_ = find(0)
    c, *_ = find(1)
    assert cost > codesign.SEED_COST and drawn >= 1
    np.testing.assert_array_equal(a, b)
    assert (np.asarray(a) != np.asarray(c)).any()
    assert (np.asarray(a) >= space.low).all() and (np.asarray(a) <= space.high).all()


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
