"""Studies: sets of constants and waves, rates and their worlds, searches in lock step."""

import json
import re

import jax
import numpy as np
import pytest
import scipy.stats

from codesign_jax import codesign, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from scripts import benchmark, calibration, search
from scripts.calibration import OPEN
from scripts.shared import statistics, work
from tests.helpers import toy_engine


def test_sets_fill_their_ranges_and_every_beginning_does():
    units = calibration.space_filling(64, seed=3)
    np.testing.assert_array_equal(units[:16], calibration.space_filling(16, seed=3))
    # A Sobol sequence has one of its first 16 points in each sixteenth of every axis.
    for column in units[:16].T:
        assert sorted(np.floor(16 * column)) == list(range(16))
    found = calibration.values(units)
    for name, o in OPEN.items():
        assert o.low <= found[name].min() and found[name].max() <= o.high
    middle = calibration.values(np.full((1, len(OPEN)), 0.5))
    assert middle["mass"] == pytest.approx(np.sqrt(20 * 300)) and middle["tilt"] == 60.0
    assert (found["pair_gap"] >= found["width"] + 2.0).all()


def wells(ridge=2.6, floor=2.6):
    """Two wells of 12 and 6 cells on a plain; the row between them has the ridge's cost."""
    cost = np.full((12, 12), floor)
    cost[1:4, 2:6], cost[7:9, 3:6], cost[4:7, 3] = 0.0, 0.2, ridge
    return cost


def test_a_saddle_is_where_two_wells_part():
    assert calibration.saddle(wells()) == 2.5
    # Apart at 0.875, the last rung of the ladder below the ridge.
    assert calibration.saddle(wells(0.9)) == 0.875 and calibration.saddle(wells(0.4)) == 0.0
    corner = np.full((12, 12), 3.0)
    corner[2:4, 2:4] = corner[4:6, 4:6] = 0.0  # they meet at a corner only
    assert calibration.saddle(corner) == 0.0


def test_statements_rule_out_what_they_should():
    """Flat landscapes on which nothing, or everything, succeeds; two wells are two regions."""
    paper = scene.load("paper")
    flat = [np.full((12, 12), c) for c in (0.0, 2.5)]
    costs = np.repeat(np.array([*flat, wells()])[..., None], 6, -1)
    own = calibration.values(np.stack([calibration.own_set(paper, g) for g in (35.0, 40.0, 70.0)]))
    np.testing.assert_allclose(own["cost_maximum"], paper.cost.maximum, rtol=1e-9)
    found = calibration.score(costs, own, paper)
    # p M_p h / EI is 1.707 at 25 mm of height, 2 mm of wall, 80 kPa and 35 kPa, and goes by 1/G.
    np.testing.assert_allclose(found["free strain"], [0.207 / 0.06, 0, 0], atol=0.01)
    good, bad, two = (({n: d[i] for n, d in found.items()}) for i in range(3))
    assert good["solutions"] == 0 and good["poor seeds"] > calibration.CUTOFF
    assert good["420 simulations"] > calibration.CUTOFF, "after the first episode"
    assert bad["solutions"] == pytest.approx(2.0) and bad["single is poor"] > calibration.CUTOFF
    assert two["two regions"] == two["solutions"] == two["poor seeds"] == 0
    assert good["two regions"] == bad["two regions"] == pytest.approx(1 / 0.3)


# --- rates ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("ties", (False, True))
def test_rank_correlation_equals_its_definition(ties):
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=300), rng.normal(0.3, 1.0, size=300)
    a, b = (np.round(a), np.round(b)) if ties else (a, b)
    x, y = (scipy.stats.rankdata(v) for v in (a, a + b))
    assert statistics.spearman(a, a + b) == pytest.approx(np.corrcoef(x, y)[0, 1], abs=1e-12)


@pytest.mark.parametrize("page", benchmark.PAGES)
def test_tables_of_the_pages_are_those_of_the_data(page):
    text, files = (benchmark.ROOT / page).read_text(encoding="utf-8"), benchmark.read()
    for mark in benchmark.PAGES[page]:
        [shown] = re.findall(f"<!-- {mark}:begin -->\n\n(.*?)\n\n<!-- {mark}:end -->", text, re.S)
        assert shown == benchmark.TABLES[mark](files)


# --- searches -------------------------------------------------------------------------------------


def test_winners_of_a_search_are_judged_at_other_masses(tmp_path):
    """What they keep at a mass is what MuJoCo C says of them in the same trials."""
    sizes = "--preset 2d --optimizers screened-es:particles=6,trials=2,tests=2 --seeds 3 --tests 5"
    how = [*sizes.split(), "--marks", "1", "--budget", "50", "--scene", str(toy_engine.TINY)]
    how += ["--out", str(tmp_path), "--commit", "abcdef0"]
    assert search.main([*how, "--set", "objects.noise.mass_range=10", "--masses", "0.05", "2"]) == 0
    [path] = tmp_path.glob("*.json")
    row, designs = json.loads(path.read_text()), work.winners(path.with_suffix(".npz"))
    assert row["changes"] == ["objects.noise.mass_range=10"] and len(row["kept"][-1]) == 3
    own = scene.load(toy_engine.TINY, overrides={"objects.object.0.mass": 2.0})
    space, engine = parameters.design_space(own.hand, "2d"), make_engine("mujoco", own)
    for seed, design in enumerate(designs):
        key = codesign.stream_key(jax.random.key(seed), search.STREAM_JUDGE, 0)
        hand = jax.tree.map(lambda v: v[None], space.params(design))
        found = rollout.evaluate(own, engine, hand, rollout.sample_trials(own, key, 5))
        assert row["masses"]["2"][seed] == np.mean(found.cost < codesign.SUCCESS_COST)
    light, heavy = (np.mean(row["masses"][m]) for m in ("0.05", "2"))
    assert heavy != light
    # The designs of a file are judged alike, without a search.
    assert search.main([*how, "--designs", str(path.with_suffix(".npz")), "--masses", "2"]) == 0
    [again] = tmp_path.glob("*-masses.json")
    assert json.loads(again.read_text())["masses"]["2"] == row["masses"]["2"]
    assert "2000 g: kept on average | seeds that keep 95 % | commit |\n" in (
        search.masses_table([json.loads(again.read_text())])
    )
