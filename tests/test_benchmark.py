"""The benchmark's statistics against closed forms and SciPy, its worlds, and its book-keeping."""

import re

import jax
import numpy as np
import pytest
import scipy.stats

from codesign_jax import rollout, scene
from codesign_jax.engines import make_engine
from scripts import benchmark
from scripts.shared import statistics, work

LINKS = {"discretization": {"links": 2}}
LIFTED = LINKS | {"effects": {"disturb": False, "ungrasp": False}}  # half of a grasp's steps


@pytest.mark.parametrize("ties", (False, True))
def test_rank_correlation_equals_its_definition(ties):
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=300), rng.normal(0.3, 1.0, size=300)
    a, b = (np.round(a), np.round(b)) if ties else (a, b)
    x, y = (scipy.stats.rankdata(v) for v in (a, a + b))
    assert statistics.spearman(a, a + b) == pytest.approx(np.corrcoef(x, y)[0, 1], abs=1e-12)


def test_rank_correlation_of_constants_is_undefined():
    assert np.isnan(statistics.spearman([1, 1, 1], [1, 2, 3]))


def test_a_small_batch_is_the_start_of_a_large_one():
    """The same worlds whatever the batch, so that engines and sizes compare."""
    chosen = scene.load("paper_spheres")
    few, many = (work.make_worlds(chosen, n) for n in (7, 31))
    for a, b in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(a, b[:7])


@pytest.mark.parametrize("change", ({"overrides": LINKS}, {"hand_name": "tripod3"}))
def test_other_hands_have_good_designs(change):
    """Every second design is a good one of that hand, the first of them the middle itself."""
    chosen = scene.load("paper_spheres", **change)
    worlds = work.make_worlds(chosen, 12)
    assert worlds.params.length.shape == (12, chosen.num_fingers)
    np.testing.assert_allclose(worlds.params.length[6:], work.GOOD["length"][0] * 1e-3, rtol=1e-6)


def test_a_micrometre_moves_the_objects_and_nothing_else():
    worlds = work.make_worlds(scene.load("paper_spheres", overrides=LINKS), 60)
    moved = work.nudged(worlds.trials)
    difference = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - b).max(), moved, worlds.trials)
    assert float(difference.position) == pytest.approx(1e-6, rel=0.02)  # float32 of centimetres
    assert not any(np.any(d) for d in difference._replace(position=0.0))


def test_winners_are_the_best_final_particle_of_each_concurrent_run():
    """Each as often as any other, and in a second round with another object."""
    chosen = scene.load("paper")
    found, objects = benchmark.winners(chosen), len(chosen.objects.object)
    with np.load(benchmark.WINNERS) as file:
        particles, cost = file["final_particles"][2], file["test_worst"][2]
        assert file["strategies"][2] == "concurrent" and len(found) == 30
    for design, candidates, costs in zip(found, particles, cost, strict=True):
        [best] = {costs[k] for k, c in enumerate(candidates) if np.array_equal(c, design)}
        assert best == costs.min()
    worlds = benchmark.make_worlds(chosen, "winners", 60)
    np.testing.assert_array_equal(worlds.params.length[:30], worlds.params.length[30:])
    assert not np.any(worlds.trials.shape[:30] == worlds.trials.shape[30:])
    random = benchmark.make_worlds(chosen, "random", 60)
    assert len(np.unique(random.params.length, axis=0)) == 60 // objects
    assert np.bincount(random.trials.shape).tolist() == [60 // objects] * objects


@pytest.mark.slow  # quick: what is told of records
def test_a_batch_is_measured_and_judged(monkeypatch):
    """Its verdicts are those of the engine; the rate is that of the shortest call."""
    monkeypatch.setattr(benchmark, "SECONDS", 0.0)
    chosen = scene.load("paper_spheres", overrides=LIFTED)
    record = benchmark.measured(chosen, "mixed", "mujoco", 12, calls=3)
    worlds = work.make_worlds(chosen, 12)
    outcomes, _ = rollout.simulate(chosen, make_engine("mujoco", chosen), *worlds)
    assert record["verdicts"] == "".join("01"[int(c < 0.01)] for c in np.asarray(outcomes.cost))
    assert "0" in record["verdicts"] and "1" in record["verdicts"]
    assert record["grasps_per_s"] == pytest.approx(12 / min(record["seconds"]), abs=0.1)
    assert record["kept"] == pytest.approx(record["verdicts"].count("1") / 12, abs=1e-4)


RUN = {"platform": "cpu", "cpus": 2, "commit": "0123456789", "jax": "0.1", "date": "2026-01-02T03"}


def record(engine, rate, **more):
    base = {"scene": "paper", "designs": "winners", "engine": engine, "worlds": 60, "run": 0}
    return {**base, "grasps_per_s": rate, **more}


def test_tables_are_those_of_the_records_and_a_second_measurement_replaces_the_first():
    records = []
    for new in (record("structured", 1.0), record("structured", 44.4, verdicts="0011")):
        records = benchmark.replaced(records, new)
    records = benchmark.replaced(records, record("MuJoCo C 4.0.0", 8.0, verdicts="0111"))
    gpu = {**RUN, "platform": "gpu", "device": "NVIDIA H100 80GB HBM3"}
    larger = {"runs": [gpu], "records": [record("structured", 1234.0, worlds=16384)]}
    files = [{"runs": [RUN], "records": records}, larger]
    assert benchmark.rates(files).splitlines() == [
        "| grasps a second (time of a batch) | 2 CPU cores, winners | one H100, winners |",
        "| --- | --- | --- |",
        "| 60 grasps, an episode of the paper's 2D | 44 (1.4 s) | – |",
        "| 16,384 grasps | – | 1,200 (13 s) |",
    ]
    assert benchmark.machines(files) == (
        "Measured on 2 CPU cores, JAX 0.1, 2026-01-02; on one H100, JAX 0.1, 2026-01-02 "
        "(`docs/data/rates_*.json`)."
    )
    row = "| paper | 2 CPU cores, 60 grasps | MuJoCo C 4.0.0 | 8.0 | 44 | 6 | 3 of 4 |"
    assert benchmark.peers(files).splitlines()[2:] == [row]


@pytest.mark.parametrize("page", benchmark.PAGES)
def test_tables_of_the_pages_are_those_of_the_data(page):
    text, files = (benchmark.ROOT / page).read_text(encoding="utf-8"), benchmark.read()
    for mark in benchmark.PAGES[page]:
        [shown] = re.findall(f"<!-- {mark}:begin -->\n\n(.*?)\n\n<!-- {mark}:end -->", text, re.S)
        assert shown == benchmark.TABLES[mark](files)
