"""Particle filter, its bounds, resampling and seeding, on costs with known answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from codesign_jax.optimize import (
    MAX_PARTICLES,
    ParticleFilter,
    Space,
    answer,
    candidates,
    reflect,
    rejection,
    schedule,
    stochastic_universal,
    strictly_below,
)

repeatable = settings(max_examples=30, deadline=None, derandomize=True)

LOW = np.array([0.01, -50.0, 0.0, 15.0, -1.0], np.float32)
HIGH = np.array([0.18, 150.0, 110.0, 25.0, 1.0], np.float32)
TARGET = LOW + np.array([0.2, 0.7, 0.5, 0.4, 0.9], np.float32) * (HIGH - LOW)
CORNER = np.array(LOW)
IS_MORPHOLOGY = np.array([True, True, False, True, False])
OPEN = np.ones(5, bool)

FILTER = ParticleFilter(Space(LOW, HIGH))
ask, tell, draw = jax.jit(FILTER.ask), jax.jit(FILTER.tell), jax.jit(candidates)
mirror = jax.jit(reflect)


def quadratic(population):
    """Squared distance to the target in units of the range, 3 in the corner farthest away."""
    return 3 * jnp.mean(((population - TARGET) / (HIGH - LOW)) ** 2, axis=-1)


def episode(state, mask):
    population = FILTER.ask(state, mask)
    return FILTER.tell(state, population, quadratic(population))


run = jax.jit(lambda state, masks: jax.lax.scan(episode, state, masks))


def assert_same_bits(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


# --- reflection and limits -----------------------------------------------------------------------

# Processors may treat subnormal numbers as zero, so they are no test of a bound.
floats = st.floats(-1000, 1000, width=32, allow_subnormal=False)
far = st.floats(-1e6, 1e6, width=32, allow_subnormal=False)


@st.composite
def boxes(draw):
    low, high = sorted([draw(floats), draw(floats)])
    return low, high


def rounding(*values):
    return 2.0**-20 * max(1e-30, *map(abs, values))


@repeatable
@given(x=far, box=boxes())
def test_reflection_stays_inside_and_keeps_what_is_inside(x, box):
    low, high = box
    y = float(mirror(x, low, high))
    assert low <= y <= high
    if low <= x <= high:
        assert y == x


@repeatable
@given(box=boxes(), folds=st.integers(-20, 20), fraction=st.floats(0, 1, width=32))
def test_reflection_is_a_triangle_wave(box, folds, fraction):
    low, high = box
    inside, width = low + fraction * (high - low), high - low
    image = low + (folds + (fraction if folds % 2 == 0 else 1 - fraction)) * width
    np.testing.assert_allclose(mirror(image, low, high), inside, atol=rounding(image, low, high))


@repeatable
@given(x=floats, step=st.floats(-1, 1, width=32), box=boxes())
def test_reflection_is_continuous_and_symmetric(x, step, box):
    low, high = box
    assume(high - low > 1e-3)
    atol = rounding(x, low, high)
    moved = mirror(x + step, low, high) - mirror(x, low, high)
    assert abs(float(moved)) <= abs(step) + 2 * atol
    mirrored = low + high - mirror(low + high - x, low, high)
    np.testing.assert_allclose(mirrored, mirror(x, low, high), atol=2 * atol)


@repeatable
@given(thickness=st.floats(2e-3, 7e-3), pressure=st.floats(0, 150e3))
def test_strict_limit_holds_in_exact_arithmetic(thickness, pressure):
    thickness, pressure = float(np.float32(thickness)), float(np.float32(pressure))
    limited = strictly_below(np.float32(pressure), np.float32(thickness) * np.float32(4e7))
    assert float(limited) < thickness * 80e3 / 2e-3
    if pressure < thickness * 80e3 / 2e-3 * (1 - 1e-6):
        assert limited == pressure


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [([0, 1], [1, 0], "parameter 1"), ([0], [np.inf], "parameter 0"), ([0], [1, 1], "parameter,")],
)
def test_bad_boxes_are_errors(low, high, message):
    with pytest.raises(ValueError, match=message):
        Space(np.array(low, float), np.array(high, float))


# --- ask -----------------------------------------------------------------------------------------


def test_all_particles_start_at_the_seed():
    state = FILTER.init(jax.random.key(0), TARGET, 10)
    np.testing.assert_array_equal(state.particles, np.tile(TARGET, (10, 1)))
    assert state.episode.dtype == jnp.int32 and state.episode == 0


def test_closed_parameters_keep_their_bits_and_open_ones_move_inside_the_box():
    outside = np.array([1.0, 200.0, 20.0, 20.0, 0.5], np.float32)  # a default may lie outside
    population = ask(FILTER.init(jax.random.key(0), outside, 8), IS_MORPHOLOGY)
    np.testing.assert_array_equal(population[:, ~IS_MORPHOLOGY], np.tile(outside[[2, 4]], (8, 1)))
    moved = np.asarray(population)[:, IS_MORPHOLOGY]
    assert np.all(moved != outside[IS_MORPHOLOGY])
    assert np.all((moved >= LOW[IS_MORPHOLOGY]) & (moved <= HIGH[IS_MORPHOLOGY]))


def test_moves_have_the_stated_deviation():
    middle = (LOW + HIGH) / 2  # ten deviations from the bounds
    step = (ask(FILTER.init(jax.random.key(3), middle, 4096), OPEN) - middle) / (HIGH - LOW)
    # The standard error of a deviation from 4096 draws is 1.1 %, of a mean 0.05 / 64.
    np.testing.assert_allclose(step.std(axis=0), 0.05, rtol=0.05)
    np.testing.assert_allclose(step.mean(axis=0), 0, atol=4 * 0.05 / 64)
    correlation = np.corrcoef(np.asarray(step).T) - np.eye(5)
    assert np.abs(correlation).max() < 0.08


def test_draws_differ_between_episodes_and_particles_but_not_between_asks():
    state = FILTER.init(jax.random.key(0), TARGET, 8)
    population = ask(state, OPEN)
    assert_same_bits(ask(state, OPEN), population)
    assert len(np.unique(population[:, 0])) == 8
    later = ask(state._replace(episode=state.episode + 1), OPEN)
    assert not np.any(later == population)


def test_draws_of_a_particle_do_not_depend_on_the_number_of_particles():
    few, many = (ask(FILTER.init(jax.random.key(5), TARGET, n), OPEN) for n in (4, 8))
    np.testing.assert_array_equal(few, many[:4])


def pressure_under_wall(particle):
    """Two parameters: wall thickness [m] and pressure [Pa], limited as in Table I."""
    thickness, pressure = particle
    return jnp.stack([thickness, strictly_below(pressure, thickness * 4e7)])


PRESSURE = ParticleFilter(
    Space(np.array([2e-3, 0.0]), np.array([7e-3, 150e3]), project=pressure_under_wall)
)


def test_constraint_wins_over_a_closed_parameter_and_touches_nothing_feasible():
    seed = np.array([3e-3, 119e3], np.float32)  # the limit is 120 kPa
    population = jax.jit(PRESSURE.ask)(
        PRESSURE.init(jax.random.key(0), seed, 200), np.array([True, False])
    )
    thickness, pressure = np.asarray(population, np.float64).T
    assert np.all(pressure < thickness * 80e3 / 2e-3)
    sank = thickness * 4e7 <= seed[1]
    assert 50 < sank.sum() < 150
    assert np.all(pressure[~sank] == seed[1])


# --- tell ----------------------------------------------------------------------------------------


def told(cost):
    state = FILTER.init(jax.random.key(1), TARGET, 4)
    population = ask(state, OPEN)
    return population, *tell(state, population, jnp.asarray(cost, jnp.float32))


def test_weights_follow_the_paper():
    cost = np.array([0.0, 0.8, 1.8, 3.0])
    population, state, info = told(cost)
    expected = 1 / (0.2 + cost)
    expected /= expected.sum()
    np.testing.assert_allclose(info.weight, expected, rtol=1e-6)
    np.testing.assert_allclose(info.effective_sample_size, 1 / (expected**2).sum(), rtol=1e-6)
    np.testing.assert_allclose(info.mean_cost, cost.mean(), rtol=1e-6)
    assert info.best_index == 0 and info.best_cost == 0
    np.testing.assert_array_equal(state.particles, population[info.ancestors])
    assert state.episode == 1


def test_equal_costs_keep_the_population():
    population, state, info = told([0.7] * 4)
    np.testing.assert_array_equal(state.particles, population)
    np.testing.assert_allclose(info.effective_sample_size, 4, rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_failed_particle_dies_out(bad):
    _, _, info = told([bad, 1.0, bad, 0.5])
    assert set(np.asarray(info.ancestors)) == {1, 3}
    assert info.best_index == 3 and info.best_cost == 0.5 and info.mean_cost == 0.75
    np.testing.assert_array_equal(info.weight[jnp.array([0, 2])], 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_where_every_particle_failed_all_survive(bad):
    population, state, info = told([bad] * 4)
    np.testing.assert_array_equal(state.particles, population)
    np.testing.assert_array_equal(info.weight, 0.25)
    assert info.best_cost == np.inf and info.mean_cost == np.inf


def test_relabelled_candidates_get_relabelled_weights():
    """Which row is drawn depends on the order for one u; what tell reports of a row does not."""
    cost = np.random.default_rng(0).uniform(0, 3, 4).astype(np.float32)
    order = np.random.default_rng(1).permutation(4)
    (_, _, info), (_, _, other) = told(cost), told(cost[order])
    np.testing.assert_allclose(other.weight, info.weight[order], rtol=1e-6)
    assert other.best_cost == info.best_cost and order[other.best_index] == info.best_index
    np.testing.assert_allclose(other.mean_cost, info.mean_cost, rtol=1e-6)


def test_bad_arguments_are_errors():
    with pytest.raises(TypeError, match="typed key"):
        FILTER.init(jnp.zeros(2, jnp.uint32), TARGET, 4)
    with pytest.raises(ValueError, match="seed_particle"):
        FILTER.init(jax.random.key(0), TARGET[:3], 4)
    with pytest.raises(ValueError, match="num_particles"):
        FILTER.init(jax.random.key(0), TARGET, 0)
    with pytest.raises(ValueError, match="alpha"):
        ParticleFilter(FILTER.space, alpha=0)
    with pytest.raises(ValueError, match="match"):
        told([1.0, 2.0, 3.0])


# --- whole runs ----------------------------------------------------------------------------------


def test_concurrent_optimisation_converges():
    state = FILTER.init(jax.random.key(0), CORNER, 60)
    final, info = run(state, schedule("concurrent", IS_MORPHOLOGY, 128))
    assert quadratic(CORNER) > 1
    assert info.mean_cost[-20:].max() < 0.15
    assert info.best_cost.min() < 0.01
    assert np.all((final.particles >= LOW) & (final.particles <= HIGH))


def test_other_bounds_masks_and_seeds_do_not_recompile():
    traces = []

    @jax.jit
    def move(config, state, mask):
        traces.append(1)
        return config.ask(state, mask)

    for seed in range(3):
        config = ParticleFilter(Space(LOW - seed, HIGH + seed))
        move(config, config.init(jax.random.key(seed), TARGET, 4), IS_MORPHOLOGY ^ (seed == 1))
    assert len(traces) == 1


# --- seeding -------------------------------------------------------------------------------------


def test_candidates_fill_the_box_and_satisfy_the_constraint():
    particles = np.asarray(draw(jax.random.key(0), FILTER.space, np.arange(2000)))
    unit = (particles - LOW) / (HIGH - LOW)
    assert unit.min() >= 0 and unit.max() <= 1
    np.testing.assert_allclose(unit.mean(axis=0), 0.5, atol=0.03)
    thickness, pressure = np.asarray(
        draw(jax.random.key(0), PRESSURE.space, np.arange(500)), np.float64
    ).T
    # XLA may compute the thickness twice, once for its limit, and round it at other places.
    assert np.all(pressure < thickness * 80e3 / 2e-3 * (1 + np.finfo(np.float32).eps))


def test_seeds_do_not_depend_on_the_batch_size():
    key, space = jax.random.key(9), FILTER.space
    results = [
        answer(rejection(key, space, 5, threshold=0.6, batch=batch, max_batches=500), quadratic)
        for batch in (8, 64)
    ]
    seeds, costs, drawn = results[0]
    assert seeds.shape == (5, 5) and np.all(costs > 0.6) and drawn >= 5
    np.testing.assert_allclose(quadratic(seeds), costs, rtol=1e-6)
    everything = np.asarray(quadratic(draw(key, space, np.arange(2000))))[:drawn]
    assert (everything > 0.6).sum() == 5 and everything[-1] > 0.6
    for other in results[1:]:
        np.testing.assert_array_equal(other[0], seeds)
        np.testing.assert_allclose(other[1], costs, rtol=1e-6)
        assert other[2] == drawn


def test_too_few_seeds_are_an_error_with_the_counts():
    def costs(population):
        return jnp.where(jnp.arange(len(population)) == 0, jnp.nan, 1.5)

    key, space = jax.random.key(0), FILTER.space
    with pytest.raises(RuntimeError, match=r"accepted 0 of 2 .* from 12 candidates; .* was 1\.5"):
        answer(rejection(key, space, 2, batch=4, max_batches=3), costs)
    with pytest.raises(RuntimeError, match="was -inf"):
        answer(rejection(key, space, 2, max_batches=1), lambda x: jnp.inf * x[:, 1])
    with pytest.raises(ValueError, match="shape"):
        answer(rejection(key, space, 2), lambda x: x)
    with pytest.raises(ValueError, match="at least 1"):
        answer(rejection(key, space, 0), quadratic)


# --- resampling -----------------------------------------------------------------------------------


ALMOST_ONE = float(np.nextafter(np.float32(1), np.float32(0)))
SIZES = (1, 7, 60)  # few, since each compiles once

sample = jax.jit(stochastic_universal)
sample_over_u = jax.jit(jax.vmap(stochastic_universal, in_axes=(0, None)))


def counts_of(ancestors, n):
    return np.bincount(np.asarray(ancestors), minlength=n)


def expected_counts(weights):
    weights = np.asarray(weights, np.float64)
    return weights.size * weights / weights.sum()


def assert_floor_or_ceiling(counts, expected):
    """Allow the rounding of the weights to integers that sum to 2**30."""
    slack = 1e-9 * expected.size + expected * expected.size / 2**30 + 1e-6 * expected
    assert np.all(counts >= np.floor(expected - slack))
    assert np.all(counts <= np.ceil(expected + slack))


uniforms = st.floats(0, ALMOST_ONE, width=32)
positive = st.floats(2.0**-20, 2.0**20, width=32)
weight_vectors = st.sampled_from(SIZES).flatmap(
    lambda n: arrays(np.float32, n, elements=st.one_of(st.just(0.0), positive))
)


@repeatable
@given(u=uniforms, weights=weight_vectors)
def test_counts_are_floor_or_ceiling_and_sum_to_n(u, weights):
    ancestors = np.asarray(sample(u, weights))
    assert ancestors.dtype == np.int32 and ancestors.shape == weights.shape
    assert np.all(np.diff(ancestors) >= 0)
    counts = counts_of(ancestors, weights.size)
    assert counts.sum() == counts.size == weights.size
    if weights.any():
        assert_floor_or_ceiling(counts, expected_counts(weights))
        assert np.all(counts[weights == 0] == 0)


@repeatable
@given(u=uniforms, weight=st.floats(2.0**-125, 2.0**127, width=32), n=st.sampled_from(SIZES))
def test_equal_weights_give_the_identity(u, weight, n):
    np.testing.assert_array_equal(sample(u, np.full(n, weight, np.float32)), np.arange(n))


@pytest.mark.parametrize("n", [16384, MAX_PARTICLES])
def test_equal_weights_give_the_identity_at_both_ends_of_u(n):
    u = np.array([0.0, 1e-7, 0.3, 0.5, ALMOST_ONE, 1.0], np.float32)
    for weight in (0.1, 1 / 3.2, 5.0):
        ancestors = sample_over_u(u, np.full(n, weight, np.float32))
        np.testing.assert_array_equal(ancestors, np.tile(np.arange(n), (u.size, 1)))


def test_mean_count_over_a_grid_of_u_is_proportional_to_weight():
    weights = np.array([0.0, 5.0, 1.3, 0.31, 0.0, 2.0, 1e-3, 0.0], np.float32)
    grid = (np.arange(4000) + 0.5) / 4000
    mean = counts_of(sample_over_u(grid, weights).ravel(), weights.size) / grid.size
    # Each count is a step function of u with at most two steps, each off by half a cell.
    np.testing.assert_allclose(mean, expected_counts(weights), atol=1 / grid.size)


@pytest.mark.parametrize("n", [16384, MAX_PARTICLES])
def test_zero_weights_are_never_drawn_where_the_float32_sum_ends_off_one(n):
    rng = np.random.default_rng(n)
    weights = (1 / (0.2 + rng.uniform(0, 3, n))).astype(np.float32)
    weights[rng.permutation(n)[: n // 4]] = 0
    weights[-n // 5 :] = 0  # trailing zeros are what an overshooting pointer would hit
    weights /= weights.sum(dtype=np.float32)
    assert np.cumsum(weights, dtype=np.float32)[-1] != 1
    ancestors = sample_over_u(np.array([0, 0.4, ALMOST_ONE, 1], np.float32), weights)
    assert np.all(weights[np.asarray(ancestors)] > 0)
    for row in ancestors:
        assert_floor_or_ceiling(counts_of(row, n), expected_counts(weights))


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf, -np.inf, -1.0])
def test_without_a_usable_weight_the_result_is_the_identity(bad):
    np.testing.assert_array_equal(sample(0.7, np.full(5, bad, np.float32)), np.arange(5))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0])
def test_unusable_weights_count_as_zero(bad):
    weights = np.array([bad, 1, bad, 3, bad], np.float32)
    usable = np.where(np.arange(5) % 2, weights, 0)
    np.testing.assert_array_equal(sample(0.7, weights), sample(0.7, usable))


def test_huge_and_tiny_weights_need_no_normalisation():
    weights = np.array([1.0, 0.0, 3.0, 2.0], np.float32)
    for scale in (1e38, 1e-30):
        np.testing.assert_array_equal(sample(0.2, weights * scale), sample(0.2, weights))


@pytest.mark.parametrize("shape", [(), (0,), (2, 3), (MAX_PARTICLES + 1,)])
def test_wrong_shapes_are_errors(shape):
    with pytest.raises(ValueError, match="shape"):
        stochastic_universal(0.5, jnp.ones(shape))


@pytest.mark.parametrize("n", [7, 60])
def test_agrees_with_blackjax(n):
    reference = pytest.importorskip("blackjax.smc.resampling")
    systematic = jax.jit(lambda key, w: reference.systematic(key, w, n))
    rng = np.random.default_rng(n)
    for key in jax.random.split(jax.random.key(n), 100):
        weights = (1 / (0.2 + rng.uniform(0, 3, n))).astype(np.float32)
        weights /= weights.sum()
        ancestors = sample(jax.random.uniform(key, ()), weights)
        np.testing.assert_array_equal(ancestors, systematic(key, weights))
