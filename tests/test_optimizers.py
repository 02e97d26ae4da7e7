"""Every optimiser by one protocol: what it finds, evosax, masks, resume, errors; schedules."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import stats

from codesign_jax import optimize
from codesign_jax.optimize import (
    EVOSAX,
    NAMES,
    Evolution,
    Screened,
    Space,
    evolution,
    make_optimizer,
    schedule,
    screened,
    strictly_below,
)
from codesign_jax.runs import record as records
from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.record import Record
from codesign_jax.runs.settings import make_settings

# As many parameters as in the paper, of different ranges.  Each optimiser has two programs for all
# tests: its `ask` and `tell` at this size.
WIDTH = 23
PARTICLES = 30
LOW = np.linspace(-3, 1, WIDTH).astype(np.float32)
HIGH = np.linspace(2, 100, WIDTH).astype(np.float32)
SEED = LOW + np.float32(0.1) * (HIGH - LOW)
TARGET = np.linspace(0.2, 0.8, WIDTH)
OPEN = np.ones((100, WIDTH), bool)
IS_FIRST = np.arange(WIDTH) < 9
SWITCH = np.repeat([IS_FIRST, ~IS_FIRST], 4, axis=0)
"""Masks of four episodes of the first nine parameters and four of the others."""
LIMITED = 10


def highest(first):
    """Limit of one of the later parameters, which the first one sets."""
    return 23 * first + 68.5


def limit(particle):
    return particle.at[LIMITED].set(strictly_below(particle[LIMITED], highest(particle[0])))


SPACE = Space(LOW, HIGH, limit)
ask = jax.jit(lambda optimizer, *rest: optimizer.ask(*rest))
tell = jax.jit(lambda optimizer, *rest: optimizer.tell(*rest))
begin = jax.jit(lambda optimizer, key: optimizer.init(key, SEED, PARTICLES))


def sphere(population):
    """Squared distance to the target in units of the range: a random design costs 3, as a grasp."""
    unit = (population - LOW) / (HIGH - LOW)
    return (30 * ((unit - TARGET) ** 2).mean(-1)).astype(np.float32)


def run(optimizer, state, masks, cost=sphere):
    """State after episodes with these masks, and the populations and reports of each."""
    populations = []
    infos = []
    for mask in masks:
        population = ask(optimizer, state, mask)
        populations.append(np.asarray(population))
        state, info = tell(optimizer, state, population, cost(populations[-1]), mask)
        infos.append(info)
    return state, np.array(populations), infos


def start(optimizer, seed=0):
    return begin(optimizer, jax.random.key(seed))


@pytest.fixture(scope="module", params=NAMES)
def optimizer(request):
    return make_optimizer(request.param, SPACE)


@pytest.mark.slow  # 12 s; quick: populations are evosax's
def test_each_finds_the_minimum_better_than_random_search():
    lowest = {}
    for name in NAMES:
        made = make_optimizer(name, SPACE)
        lowest[name] = sphere(np.asarray(run(made, start(made), OPEN)[0].particles)).min()
    assert all(lowest[name] < lowest["random"] for name in set(NAMES) - {"random"}), lowest
    # Random search is better than a random design, and CMA-ES converges linearly on a sphere.
    assert lowest["random"] < 2 and lowest["cma-es"] < 0.02, lowest


def by_evosax(name, count, std):
    """A strategy of evosax and its parameters, with our deviation and step."""
    from evosax import algorithms

    zeros = jnp.zeros(WIDTH)
    if name == "cma-es":
        strategy = algorithms.CMA_ES(count, zeros)
        return strategy, strategy.default_params.replace(std_init=jnp.float32(std))
    if name == "open-es":
        descent = optax.sgd(np.sqrt(2 * np.pi * WIDTH) * 2 / 3 * std**2)
        schedule = optax.constant_schedule(std)
        strategy = algorithms.Open_ES(count, zeros, optimizer=descent, std_schedule=schedule)
    elif name == "pso":
        strategy = algorithms.PSO(count, zeros)
    else:
        strategy = algorithms.RandomSearch(
            count, zeros, partial(jax.random.uniform, shape=(WIDTH,))
        )
    return strategy, strategy.default_params


QUICK = "open-es", "random"
"""The others pass through the same functions, and compile longer."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in EVOSAX]
)
def test_populations_are_those_of_evosax_called_directly(name):
    made = make_optimizer(name, SPACE)
    count = 4
    _, ours, infos = run(made, start(made), OPEN[:count])

    def key(stream, episode):
        return jax.random.fold_in(jax.random.fold_in(jax.random.key(0), stream), episode)

    strategy, params = by_evosax(name, PARTICLES, 0.25 if name == "cma-es" else 0.15)
    begun = ((SEED - LOW) / (HIGH - LOW),)
    if name == "pso":
        swarm = jax.random.uniform(key(evolution.STREAM_START, 0), (PARTICLES, WIDTH))
        begun = swarm.at[0].set(begun[0]), jnp.full(PARTICLES, jnp.inf)
    state = strategy.init(key(0, 0), *begun, params)
    free = np.arange(WIDTH) != LIMITED
    for episode in range(count):
        points, state = strategy.ask(key(evolution.STREAM_ASK, episode), state, params)
        folded = 1 - np.abs(1 - np.asarray(points, np.float64) % 2)  # mirrors at 0 and 1
        evaluated = (ours[episode] - LOW) / (HIGH - LOW)
        # Two programs round differently, by 1e-7, which the eigenvectors of a covariance near
        # unity magnify by the inverse gap of its eigenvalues, some hundreds.
        np.testing.assert_allclose(evaluated[:, free], folded[:, free], rtol=0, atol=5e-4)
        # The costs themselves, of which CMA-ES makes its ranks.
        arguments = key(evolution.STREAM_TELL, episode), points, infos[episode].cost
        state, _ = strategy.tell(*arguments, state, params)


def test_the_default_averages_the_means_of_evosax():
    """Random designs, the best of them again, a strategy from there; particle 0 averages."""
    made = make_optimizer(optimize.DEFAULT, SPACE)
    assert isinstance(made, Screened)
    state, populations, infos = run(made, start(made), OPEN[:5])
    free = np.arange(WIDTH) != LIMITED
    drawn = ((populations[:3] - LOW) / (HIGH - LOW)).reshape(-1, WIDTH)
    assert stats.kstest(drawn[:, free].ravel(), "uniform").pvalue > 0.01
    costs = np.array([info.cost for info in infos])
    best = drawn[costs[:3].argmin()]
    kept = np.sort(costs[:3], axis=None)[:PARTICLES]
    np.testing.assert_allclose(costs[3:], [kept, kept], rtol=1e-6)  # sorted: no noise here
    count = PARTICLES - 2
    evosax_strategy, params = by_evosax("open-es", count, 0.15)
    keys = [
        jax.random.fold_in(jax.random.fold_in(jax.random.key(0), stream), 5)
        for stream in (screened.STREAM_MOVE, screened.STREAM_TELL)
    ]
    begun = evosax_strategy.init(jax.random.key(1), best, params)
    points, strategy = evosax_strategy.ask(keys[0], begun, params)
    near = partial(np.testing.assert_allclose, rtol=0, atol=1e-5)  # float32
    average = best
    for t in range(1, 4):
        state, [population], [info] = run(made, state, OPEN[:1])
        unit = (population - LOW) / (HIGH - LOW)
        near(unit[0, free], 1 - np.abs(1 - average[free] % 2))  # mirrors at 0 and 1
        mean = np.asarray(state.memory["strategy"]["mean"])
        if t == 1:  # later ones draw along eigenvectors, whose sign hangs on the last bit
            drawn = unit[1 : count + 1]
            costs = info.cost[1 : count + 1]
            near(drawn[:, free], 1 - np.abs(1 - np.asarray(points)[:, free] % 2))
            near(mean, evosax_strategy.tell(keys[1], points, costs, strategy, params)[0].mean)
            rest = np.broadcast_to(best, (PARTICLES - 1 - count, WIDTH))
            near(unit[count + 1 :, free], rest[:, free])
        average = average + 4 / (t + 3) * (mean - average)


def test_with_few_parameters_the_best_random_designs_are_simulated_again():
    """A design's cost is the mean of all its episodes, and a lucky one does not stand first."""
    space = optimize.Space(LOW[:3], HIGH[:3])
    noise = np.random.default_rng(0)
    made = make_optimizer(optimize.DEFAULT, space)
    assert not isinstance(make_optimizer(optimize.DEFAULT, SPACE), type(made))
    costs_by_design = {}

    def cost(population):
        """Noisy grasps: of the best design two thirds cost nothing, of others fewer."""
        unit = (population - LOW[:3]) / (HIGH[:3] - LOW[:3])
        lost = noise.random(len(unit)) < 1 / 3 + 2 / 3 * np.abs(unit - TARGET[:3]).max(-1)
        for row, value in zip(population, lost, strict=True):
            costs_by_design.setdefault(row.tobytes(), []).append(float(value))
        return lost.astype(np.float32)

    state = made.init(jax.random.key(0), SEED[:3], 12)
    state, populations, infos = run(made, state, OPEN[:40, :3], cost)
    drawn = ((populations[::2] - LOW[:3]) / (HIGH[:3] - LOW[:3])).ravel()
    assert stats.kstest(drawn, "uniform").pvalue > 0.01
    assert (np.unique(populations[1::2].reshape(-1, 3), axis=0).shape[0]) < 20 * 12 / 2
    # By the mean with one episode of cost 1 besides, of all that was ever simulated.
    ranked = sorted(
        costs_by_design,
        key=lambda row: (sum(costs_by_design[row]) + 1) / (len(costs_by_design[row]) + 1),
    )
    means = [np.mean(costs_by_design[row]) for row in ranked[:3]]
    designs = [row.tobytes() for row in np.asarray(state.memory["designs"])]
    np.testing.assert_allclose(state.memory["cost"][:3], means, rtol=1e-5)
    assert designs[:3] == ranked[:3] and len(costs_by_design[ranked[0]]) > 5
    rows = [row.tobytes() for row in np.asarray(state.particles)]
    assert rows == designs[:3] + designs[:1] * 9
    copied = np.asarray(infos[-1].ancestors)
    np.testing.assert_array_equal(populations[-1][copied], state.particles)
    # A closed parameter has the best design's value in what is drawn; all closed, nothing is drawn.
    drawn = np.asarray(made.ask(state, np.array([True, False, True])))
    assert (drawn[:, 1] == state.particles[0, 1]).all() and len(np.unique(drawn[:, 0])) == 12
    np.testing.assert_array_equal(made.ask(state, np.zeros(3, bool)), state.particles)


def test_bounds_and_constraint_hold(optimizer):
    _, populations, _ = run(optimizer, start(optimizer), OPEN[:8])
    assert (populations >= LOW).all() and (populations <= HIGH).all()
    limits = highest(populations[..., 0].astype(np.float64))
    # The limit is a sum of rounded float32.
    assert (populations[..., LIMITED] < limits + 1e-5).all()
    assert populations[..., LIMITED].std() > 1


def test_closed_parameters_keep_their_bits(optimizer):
    """One domain and then the other: what closes keeps a value that was found before.

    But one that must sink with its limit, which wins.
    """
    _, populations, _ = run(optimizer, start(optimizer), SWITCH)
    free = np.arange(WIDTH) != LIMITED
    sank = populations[:4, :, LIMITED] < SEED[LIMITED]
    np.testing.assert_array_equal(sank[0], highest(populations[0, :, 0]) <= SEED[LIMITED])
    assert sank.any() and not sank.all()
    assert (populations[:4][~sank][:, LIMITED] == SEED[LIMITED]).all()
    kept = populations[:4, :, ~IS_FIRST & free]
    np.testing.assert_array_equal(kept, np.broadcast_to(SEED[~IS_FIRST & free], kept.shape))
    first = populations[:4][..., IS_FIRST]
    second = populations[4:][..., IS_FIRST]
    rows = {row.tobytes() for row in first.reshape(-1, 9)}
    assert len(rows) > 4 and {row.tobytes() for row in second.reshape(-1, 9)} <= rows
    assert len(np.unique(populations[4:, :, -1])) > 4
    if isinstance(optimizer, Evolution):  # the closed values are the best design's
        best = sphere(populations[:4].reshape(-1, WIDTH)).argmin()
        np.testing.assert_array_equal(second - first.reshape(-1, 9)[best], 0)


def test_a_resumed_run_equals_the_uninterrupted_one_bitwise(optimizer):
    """Through the arrays of a checkpoint, within a block of the schedule and at its switch."""
    sizes = {"particles": PARTICLES, "trials": 1, "episodes": 8}
    history = records.empty_history(
        make_settings("2d", "concurrent", "control", "mujoco", 0, **sizes), WIDTH
    )

    def stored(state):
        return records.to_arrays(Record(state, history))

    whole = stored(run(optimizer, start(optimizer), SWITCH)[0])
    for cut in (2, 4):
        part = stored(run(optimizer, start(optimizer), SWITCH[:cut])[0])
        again = records.from_arrays(jax.tree.map(np.array, part)).state
        assert digest(stored(run(optimizer, again, SWITCH[cut:])[0])) == digest(whole)


@pytest.mark.parametrize("name", EVOSAX)
def test_the_particles_are_the_best_so_far_and_failed_ones_never(name):
    made = make_optimizer(name, SPACE)
    good = np.arange(PARTICLES) % 2 == 1

    def half_fail(population):
        return np.where(good, sphere(population), np.float32("nan"))

    state, populations, infos = run(made, start(made), OPEN[:5], half_fail)
    tried = populations[:, good].reshape(-1, WIDTH)
    particles = np.asarray(state.particles)
    np.testing.assert_array_equal(particles, tried[np.argsort(sphere(tried))[:PARTICLES]])
    assert np.isfinite([info.mean_cost for info in infos]).all()
    # What is from this episode names its row.
    ancestors = np.asarray(infos[-1].ancestors)
    new = ancestors >= 0
    assert new.any() and not new.all()
    np.testing.assert_array_equal(particles[new], populations[-1][ancestors[new]])
    assert not np.isin(particles[~new][:, 0], populations[-1][:, 0]).any()


def test_steps_of_cma_es_do_not_shrink_on_a_plateau():
    """Where every grasp is lost, all costs are equal: selection is a fair draw of the rows."""
    made = make_optimizer("cma-es", SPACE)
    lost = np.full(PARTICLES, 3.0, np.float32)
    state, *_ = run(made, start(made), OPEN[:40], lambda population: lost)
    # The logarithm of the step is a random walk; told equal costs, evosax has 2e-4 here.
    assert 0.2 < float(state.memory["strategy"]["std"]) / 0.25 < 5


def test_unknown_names_and_wrong_numbers_are_answered_in_words():
    with pytest.raises(ValueError, match=r"'cma_es'; did you mean 'cma-es'\? Valid: screened-es"):
        make_optimizer("cma_es", SPACE)
    with pytest.raises(ValueError, match="at least 2"):
        make_optimizer("cma-es", SPACE).init(jax.random.key(0), SEED, 1)
    with pytest.raises(ValueError, match="sigma > 0"):
        Evolution(SPACE, "cma-es", sigma=0.0)
    with pytest.raises(ValueError, match="do not match"):
        made = make_optimizer("pso", SPACE)
        made.tell(start(made), jnp.zeros((PARTICLES, WIDTH)), np.zeros(3))


IS_MORPHOLOGY = np.array([True] * 13 + [False] * 10)


def open_domain(mask):
    """Morphology (True) or control (False) per episode; also checks that only one is open."""
    morphology = np.all(mask[:, IS_MORPHOLOGY], axis=1)
    np.testing.assert_array_equal(mask, morphology[:, None] == IS_MORPHOLOGY)
    return morphology


@pytest.mark.parametrize("first", ["morphology", "control"])
@pytest.mark.parametrize("episodes", [33, 64, 100])
@pytest.mark.parametrize("switches", [1, 3, 8, 32])
def test_switches_are_exact_and_even(switches, episodes, first):
    domain = open_domain(schedule(f"switch-{switches}", IS_MORPHOLOGY, episodes, first=first))
    at = np.flatnonzero(domain[1:] != domain[:-1]) + 1
    assert at.size == switches
    assert domain[0] == (first == "morphology")
    lengths = np.diff(np.concatenate([[0], at, [episodes]]))
    assert lengths.max() - lengths.min() <= 1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("concurent", "did you mean 'concurrent'"),
        ("switch--1", "unknown schedule"),
        ("switch-64", "at least 65 episodes, got 64"),
    ],
)
def test_bad_names_are_errors(name, message):
    with pytest.raises(ValueError, match=message):
        schedule(name, IS_MORPHOLOGY, 64)
