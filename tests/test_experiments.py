"""The paper's experiments: counts, masks, resuming, statistics, pages, winners on fresh trials."""

from pathlib import Path

import numpy as np
import pytest

from codesign_jax import codesign
from codesign_jax.types import Outcome
from scripts.experiments import report, simulate
from scripts.experiments.simulate import PAPER, TOTAL_GRASPS
from scripts.shared import statistics
from tests.helpers.toy_engine import tiny

ROOT = Path(__file__).parents[1]


def test_counts_are_the_papers():
    assert {name: p.grasps for name, p in PAPER.items()} == simulate.PAPER_GRASPS
    assert simulate.PAPER_GRASPS == {"2d": 1_008_000, "23d": 4_536_000, "landscape": 129_600}
    assert TOTAL_GRASPS == 5_673_600
    assert (PAPER["2d"].worlds, PAPER["23d"].worlds) == (14_400, 32_400)


def test_means_by_either_rule():
    scene, *_ = tiny()
    cost = np.array([[0.0, 1.0, 3.0], [3.0, 3.0, 3.0]], np.float32)
    status = np.array([[0, 0, 1], [1, 2, 64]], np.uint8)
    means = simulate.both_means(scene, cost, status)
    np.testing.assert_allclose(means["exclude"], [0.5, 3.0])
    np.testing.assert_allclose(means["worst"], [4 / 3, 3.0], rtol=1e-6)
    trials = Outcome(cost, status.astype(np.int32), cost, status)
    np.testing.assert_allclose(means["exclude"], codesign.particle_cost(scene, trials))
    bits = dict(zip(simulate.BITS, simulate.failures(status, (0, 1)), strict=True))
    assert [bits[b] for b in (1, 2, 64)] == [2, 1, 1] and sum(bits.values()) == 4


def test_quantiles_and_medians_with_runs_that_never_converged():
    values = np.array([1.0, np.inf, 3.0, 2.0, np.inf, np.inf])
    assert statistics.quantile(values, 0.25) == 2.0
    assert statistics.quantile(values, 0.5) == np.inf
    finite = np.random.default_rng(0).normal(size=(3, 31))
    for q in (0.025, 0.25, 0.5, 0.75):
        expected = np.quantile(finite, q, axis=-1, method="averaged_inverted_cdf")
        np.testing.assert_allclose(statistics.quantile(finite, q), expected)
    interval = statistics.median(finite[0])
    assert interval.low < interval.value == np.median(finite[0]) < interval.high


def test_paired_tests():
    a, b = np.arange(30) < 20, np.arange(30) < 10
    assert statistics.mcnemar(a, b) == pytest.approx(2 * 0.5**10)
    assert statistics.mcnemar(a, a) == 1.0
    slow, fast = np.full(30, np.inf), np.arange(30.0)
    assert statistics.wilcoxon(slow, fast, 64) < 1e-3 < statistics.wilcoxon(fast, fast, 64)
    assert statistics.trend(np.arange(4.0)[:, None] + np.zeros((4, 30))) < 1e-3
    assert statistics.trend(np.zeros((4, 30))) == 1.0


def test_both_readings_of_converged():
    """Below 1 in the second episode, above in the third, and below from the fourth on."""
    means = np.array([[[2.0, 0.5, 1.5, 0.9, 0.2], [2.0] * 5]])
    one = report.Study({}, {}, {"mean_exclude": means})
    np.testing.assert_array_equal(one.first_below(), [[2.0, np.inf]])
    np.testing.assert_array_equal(one.convergence(), [[4.0, np.inf]])


def test_the_page_has_the_tables_of_its_data():
    data = ROOT / "docs" / "data" / "experiments"
    studies = {name: report.load_study(data, name) for name in ("2d", "23d")}
    text = report.tables(studies, report.load(data, "landscape"))
    assert text in (ROOT / "docs" / "notes" / "results.md").read_text(encoding="utf-8")
