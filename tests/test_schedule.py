"""Schedules: the right domain is open in the right episode, and bad requests say what is wrong."""

import numpy as np
import pytest

from codesign_jax.optimize import schedule

IS_MORPHOLOGY = np.array([True] * 13 + [False] * 10)


def open_domain(mask):
    """Morphology (True) or control (False) per episode; also checks that only one is open."""
    morphology = np.all(mask[:, IS_MORPHOLOGY], axis=1)
    np.testing.assert_array_equal(mask, morphology[:, None] == IS_MORPHOLOGY)
    return morphology


def test_concurrent_opens_everything():
    mask = schedule("concurrent", IS_MORPHOLOGY, 64, first="control")
    assert mask.dtype == bool and mask.shape == (64, 23) and mask.all()


@pytest.mark.parametrize("first", ["morphology", "control"])
def test_single_domains_never_change(first):
    assert open_domain(schedule("morphology", IS_MORPHOLOGY, 8, first=first)).all()
    assert not open_domain(schedule("control", IS_MORPHOLOGY, 8, first=first)).any()
    single = schedule("single", IS_MORPHOLOGY, 8, first=first)
    np.testing.assert_array_equal(single, schedule(first, IS_MORPHOLOGY, 8))


@pytest.mark.parametrize("first", ["morphology", "control"])
@pytest.mark.parametrize("episodes", [33, 64, 100, 128])
@pytest.mark.parametrize("switches", [1, 2, 3, 4, 8, 16, 32])
def test_switches_are_exact_and_even(switches, episodes, first):
    domain = open_domain(schedule(f"switch-{switches}", IS_MORPHOLOGY, episodes, first=first))
    at = np.flatnonzero(domain[1:] != domain[:-1]) + 1
    assert at.size == switches
    assert domain[0] == (first == "morphology")
    lengths = np.diff(np.concatenate([[0], at, [episodes]]))
    assert lengths.max() - lengths.min() <= 1


def test_as_many_switches_as_possible_alternate():
    domain = open_domain(schedule("switch-7", IS_MORPHOLOGY, 8))
    np.testing.assert_array_equal(domain, [True, False] * 4)


def test_first_swaps_the_domains():
    one = schedule("switch-4", IS_MORPHOLOGY, 64, first="morphology")
    other = schedule("switch-4", IS_MORPHOLOGY, 64, first="control")
    np.testing.assert_array_equal(one, ~other)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("concurent", "did you mean 'concurrent'"),
        ("switch_8", "did you mean 'switch-8'"),
        ("switch-0", "unknown schedule"),
        ("switch-", "unknown schedule"),
        ("switch--1", "unknown schedule"),
        ("xyz", "Valid: concurrent, morphology"),
        ("switch-64", "at least 65 episodes, got 64"),
    ],
)
def test_bad_names_are_errors(name, message):
    with pytest.raises(ValueError, match=message):
        schedule(name, IS_MORPHOLOGY, 64)


def test_bad_arguments_are_errors():
    with pytest.raises(ValueError, match="bool"):
        schedule("concurrent", [0, 1, 1], 4)
    with pytest.raises(ValueError, match="bool"):
        schedule("concurrent", IS_MORPHOLOGY[None], 4)
    with pytest.raises(ValueError, match="episodes"):
        schedule("concurrent", IS_MORPHOLOGY, 0)
    with pytest.raises(ValueError, match="first"):
        schedule("single", IS_MORPHOLOGY, 4, first="both")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="no parameters"):
        schedule("switch-1", np.array([True, True]), 4)
