"""Stochastic universal sampling: its defining facts, the edge cases of float32 and an oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from codesign_jax.optimize import MAX_PARTICLES, stochastic_universal

ALMOST_ONE = float(np.nextafter(np.float32(1), np.float32(0)))
SIZES = (1, 7, 60)  # few, since each compiles once
repeatable = settings(max_examples=100, deadline=None, derandomize=True)

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


def test_mean_counts_are_permutation_equivariant():
    """For one u the counts depend on the order of the particles; their mean over u does not."""
    rng = np.random.default_rng(0)
    weights, grid = rng.exponential(size=9).astype(np.float32), (np.arange(4000) + 0.5) / 4000
    order = rng.permutation(9)
    mean, permuted = (
        counts_of(sample_over_u(grid, w).ravel(), 9) / grid.size for w in (weights, weights[order])
    )
    np.testing.assert_allclose(permuted, mean[order], atol=2 / grid.size)


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


def test_one_dominating_weight_keeps_the_small_ones_in_proportion():
    weights = np.full(16384, 1e-4, np.float32)
    weights[7] = 1
    counts = counts_of(sample(0.5, weights), weights.size)
    assert_floor_or_ceiling(counts, expected_counts(weights))


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
