"""Particle filter, its bounds, resampling and seeding, on costs with known answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from codesign_jax.optimize import (
    MAX_PARTICLES,
    ParticleFilter,
    Space,
    candidates,
    reflect,
    rejection,
    stochastic_universal,
)

repeatable = settings(max_examples=30, deadline=None, derandomize=True)

LOW = np.array([0.01, -50.0, 0.0, 15.0, -1.0], np.float32)
HIGH = np.array([0.18, 150.0, 110.0, 25.0, 1.0], np.float32)
TARGET = LOW + np.array([0.2, 0.7, 0.5, 0.4, 0.9], np.float32) * (HIGH - LOW)
IS_MORPHOLOGY = np.array([True, True, False, True, False])
OPEN = np.ones(5, bool)

FILTER = ParticleFilter(Space(LOW, HIGH))
ask = jax.jit(FILTER.ask)
tell = jax.jit(FILTER.tell)
draw = jax.jit(candidates)
mirror = jax.jit(reflect)


def quadratic(population):
    """Squared distance to the target in units of the range, 3 in the corner farthest away."""
    return 3 * jnp.mean(((population - TARGET) / (HIGH - LOW)) ** 2, axis=-1)


# Processors may treat subnormal numbers as zero, so they are no test of a bound.
floats = st.floats(-1000, 1000, width=32, allow_subnormal=False)
far = st.floats(-1e6, 1e6, width=32, allow_subnormal=False)


boxes = st.tuples(floats, floats).map(sorted)


def rounding(*values):
    return 2.0**-20 * max(1e-30, *map(abs, values))


@repeatable
@given(x=far, box=boxes)
def test_reflection_stays_inside_and_keeps_what_is_inside(x, box):
    low, high = box
    y = float(mirror(x, low, high))
    assert low <= y <= high
    if low <= x <= high:
        assert y == x


@repeatable
@given(box=boxes, folds=st.integers(-20, 20), fraction=st.floats(0, 1, width=32))
def test_reflection_is_a_triangle_wave(box, folds, fraction):
    low, high = box
    inside = low + fraction * (high - low)
    width = high - low
    image = low + (folds + (fraction if folds % 2 == 0 else 1 - fraction)) * width
    np.testing.assert_allclose(mirror(image, low, high), inside, atol=rounding(image, low, high))


def test_closed_parameters_keep_their_bits_and_open_ones_move_inside_the_box():
    outside = np.array([1.0, 200.0, 20.0, 20.0, 0.5], np.float32)  # a default may lie outside
    population = ask(FILTER.init(jax.random.key(0), outside, 8), IS_MORPHOLOGY)
    np.testing.assert_array_equal(population[:, ~IS_MORPHOLOGY], np.tile(outside[[2, 4]], (8, 1)))
    values = np.asarray(population)[:, IS_MORPHOLOGY]
    assert np.all(values != outside[IS_MORPHOLOGY])
    assert np.all((values >= LOW[IS_MORPHOLOGY]) & (values <= HIGH[IS_MORPHOLOGY]))


def test_moves_have_the_stated_deviation():
    middle = (LOW + HIGH) / 2  # ten deviations from the bounds
    step = (ask(FILTER.init(jax.random.key(3), middle, 4096), OPEN) - middle) / (HIGH - LOW)
    # The standard error of a deviation from 4096 draws is 1.1 %, of a mean 0.05 / 64.
    np.testing.assert_allclose(step.std(axis=0), 0.05, rtol=0.05)
    np.testing.assert_allclose(step.mean(axis=0), 0, atol=4 * 0.05 / 64)
    correlation = np.corrcoef(np.asarray(step).T) - np.eye(5)
    assert np.abs(correlation).max() < 0.08


def update(cost):
    state = FILTER.init(jax.random.key(1), TARGET, 4)
    population = ask(state, OPEN)
    return population, *tell(state, population, jnp.asarray(cost, jnp.float32))


def test_weights_follow_the_paper():
    cost = np.array([0.0, 0.8, 1.8, 3.0])
    population, state, info = update(cost)
    expected = 1 / (0.2 + cost)
    expected /= expected.sum()
    np.testing.assert_allclose(info.weight, expected, rtol=1e-6)
    np.testing.assert_allclose(info.effective_sample_size, 1 / (expected**2).sum(), rtol=1e-6)
    np.testing.assert_allclose(info.mean_cost, cost.mean(), rtol=1e-6)
    assert info.best_index == 0 and info.best_cost == 0
    np.testing.assert_array_equal(state.particles, population[info.ancestors])
    assert state.episode == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_failed_particle_dies_out(bad):
    _, _, info = update([bad, 1.0, bad, 0.5])
    assert set(np.asarray(info.ancestors)) == {1, 3}
    assert info.best_index == 3 and info.best_cost == 0.5 and info.mean_cost == 0.75
    np.testing.assert_array_equal(info.weight[jnp.array([0, 2])], 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_where_every_particle_failed_all_survive(bad):
    population, state, info = update([bad] * 4)
    np.testing.assert_array_equal(state.particles, population)
    np.testing.assert_array_equal(info.weight, 0.25)
    assert info.best_cost == np.inf and info.mean_cost == np.inf


def test_seeds_do_not_depend_on_the_batch_size():
    key = jax.random.key(9)
    space = FILTER.space
    results = [
        rejection(key, space, 5, quadratic, threshold=0.6, batch=batch, max_batches=500)
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

    key = jax.random.key(0)
    space = FILTER.space
    with pytest.raises(RuntimeError, match=r"accepted 0 of 2 .* from 12 candidates; .* was 1\.5"):
        rejection(key, space, 2, costs, batch=4, max_batches=3)
    with pytest.raises(RuntimeError, match="was -inf"):
        rejection(key, space, 2, lambda x: jnp.inf * x[:, 1], max_batches=1)
    with pytest.raises(ValueError, match="shape"):
        rejection(key, space, 2, lambda x: x)
    with pytest.raises(ValueError, match="at least 1"):
        rejection(key, space, 0, quadratic)


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


def test_equal_weights_give_the_identity_at_both_ends_of_u():
    n = MAX_PARTICLES
    u = np.array([0.0, 1e-7, 0.3, 0.5, ALMOST_ONE, 1.0], np.float32)
    for weight in (0.1, 1 / 3.2, 5.0):
        ancestors = sample_over_u(u, np.full(n, weight, np.float32))
        np.testing.assert_array_equal(ancestors, np.tile(np.arange(n), (u.size, 1)))


def test_zero_weights_are_never_drawn_where_the_float32_sum_ends_off_one():
    n = MAX_PARTICLES
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
