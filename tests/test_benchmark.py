"""The benchmark's statistics against closed forms and SciPy, its worlds, and its book-keeping."""

import jax
import numpy as np
import pytest
import scipy.stats

from codesign_jax.types import Trace
from scripts.benchmark import cases, grasps, report
from scripts.shared import statistics, work


@pytest.mark.parametrize("ties", (False, True))
def test_rank_correlation_equals_its_definition(ties):
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=300), rng.normal(0.3, 1.0, size=300)
    a, b = (np.round(a), np.round(b)) if ties else (a, b)
    x, y = (scipy.stats.rankdata(v) for v in (a, a + b))
    assert statistics.spearman(a, a + b) == pytest.approx(np.corrcoef(x, y)[0, 1], abs=1e-12)


def test_rank_correlation_of_constants_is_undefined():
    assert np.isnan(statistics.spearman([1, 1, 1], [1, 2, 3]))


def test_agreement_counts_verdicts_and_whole_designs():
    reference = np.array([0.0, 3.0, 0.0, 1.0, 1.0, 2.5, 0.5])
    cost = np.array([0.0, 3.0, 1.0, 1.0, 1.0, 2.5])
    found = statistics.agreement(cost, reference, trials=2)
    assert found["worlds"] == 6 and found["designs"] == 3
    assert found["same_verdict"] == pytest.approx(5 / 6)
    assert found["success"] == pytest.approx(1 / 6)
    assert found["success_reference"] == pytest.approx(2 / 6)
    assert found["mean_abs_cost_difference"] == pytest.approx(1 / 6)
    assert found["spearman"] == pytest.approx(1.0)  # means 1.5, 1, 1.75 against 1.5, 0.5, 1.75


def test_a_small_batch_is_the_start_of_a_large_one():
    """The same worlds whatever the batch, so that engines and sizes compare."""
    scene = work.variant()
    few, many = (work.make_worlds(scene, n) for n in (7, 31))
    for a, b in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(a, b[:7])
    again = work.make_worlds(scene, 20, repeat=5)
    np.testing.assert_array_equal(again.params.length[5:10], again.params.length[:5])


@pytest.mark.parametrize("change", ({"fingers": 3}, {"links": 5}, {"hand_name": "tripod3"}))
def test_variants_have_good_designs(change):
    """Every second design is a good one of that hand, the first of them the middle itself."""
    scene = work.variant(**change)
    worlds = work.make_worlds(scene, 12)
    assert worlds.params.length.shape == (12, scene.num_fingers)
    np.testing.assert_allclose(worlds.params.length[6:], work.GOOD["length"][0] * 1e-3, rtol=1e-6)


def test_simulated_steps_end_where_a_trace_stops_changing():
    """A world that is simulated on changes to the end, one that is stopped repeats its entry."""
    scene = work.variant()
    steps = scene.num_steps
    moving = np.linspace(0.01, 0.02, steps, dtype=np.float32)
    stopped = np.where(np.arange(steps) < 400, moving, moving[400])
    distance = np.stack([moving, stopped])
    trace = Trace(distance, 0 * distance + 0.03, 0 * distance, np.zeros((2, steps, 0)))
    _, count = cases.summary(scene, jax.tree.map(jax.numpy.asarray, trace))
    assert count.tolist() == [steps, 401]
    rates = cases.rates(scene, 2, steps, 1.0, np.asarray(count))
    assert rates["nominal_world_steps_per_s"] == 2 * steps
    assert rates["simulated_world_steps_per_s"] == pytest.approx(steps + 401)


def test_a_second_run_replaces_its_cases():
    results = {"records": []}
    record = {"engine": "mjx", "setting": "equal", "worlds": 3}
    for value in (1, 2):
        report.add(results, {**record, "value": value}, [])
    report.add(results, {**record, "worlds": 4, "value": 3}, [])
    assert [r["value"] for r in results["records"]] == [2, 3]


def test_a_micrometre_moves_the_objects_and_nothing_else():
    worlds = work.make_worlds(work.variant(links=2), 60)
    moved = work.nudged(worlds.trials)
    difference = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - b).max(), moved, worlds.trials)
    assert float(difference.position) == pytest.approx(1e-6, rel=0.02)  # float32 of centimetres
    assert not any(np.any(d) for d in difference._replace(position=0.0))


def test_a_case_that_is_measured_again_keeps_its_calls_and_counts_the_shortest():
    first = grasps.merged(None, {"worlds": 60, "seconds": [2.0, 1.0], "processor_s": [2.0, 1.5]})
    assert (first["best_s"], first["grasps_per_s"]) == (1.0, 60.0)
    slow = grasps.merged(first, {"worlds": 60, "seconds": [4.0], "processor_s": [1.4]})
    assert slow["seconds"] == [2.0, 1.0, 4.0] and slow["grasps_per_s"] == 60.0
    assert slow["processor_s"] == [2.0, 1.5, 1.4]
