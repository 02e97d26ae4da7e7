"""Studies: sets of constants and waves, rates and their worlds, searches in lock step."""

import json
import re

import jax
import numpy as np
import pytest
import scipy.stats

from codesign_jax import scene
from codesign_jax.scene import parameters, schema
from scripts import benchmark, calibration, search
from scripts.calibration import OPEN
from scripts.shared import statistics


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


def test_numbers_of_a_set_are_those_of_the_files():
    """The numbers that a set changes, against the same values set by key path."""
    units = calibration.space_filling(3, seed=1)
    v = {name: values[2] for name, values in calibration.values(units).items()}
    x, y, size = 1e-3 * v["base_x"], 0.5e-3 * v["pair_gap"], 1e-3 * v["half_size"]
    bases = [[x, y], [x, -y], [-x, -y], [-x, y]]
    changes = {f"hand.finger.{i}.base": base for i, base in enumerate(bases)}
    changes |= {f"hand.finger.{i}.tilt": v["tilt"] for i in range(4)}
    sizes = {"cuboid": [size] * 3, "cylinder": [size, 1.2 * size], "sphere": [size]}
    for name, values in sizes.items():
        changes[f"objects.object.{name}.size"] = values
        changes[f"objects.object.{name}.mass"] = 1e-3 * v["mass"]
        changes[f"objects.object.{name}.friction"] = v["friction"]
    changes |= {
        "hand.material.shear_modulus": 1e3 * v["shear_modulus"],
        "hand.material.lateral_factor": v["lateral"],
        "hand.material.torsion_factor": v["torsion"],
        "hand.section.width": 1e-3 * v["width"],
        "hand.wrist.linear_stiffness": v["wrist_linear"],
        "hand.wrist.linear_damping": 17.0 * np.sqrt(v["wrist_linear"] / 180.0),
        "hand.wrist.angular_stiffness": v["wrist_angular"],
        "hand.wrist.angular_damping": 0.2 * np.sqrt(v["wrist_angular"] / 12.0),
        "objects.table.friction": v["table_friction"],
        "arm.zero_height": 1e-3 * v["zero_height"],
        "arm.shake_amplitude": v["shake_amplitude"],
        "arm.shake_frequency": v["shake_frequency"],
        "contact.normal_stiffness": 1e3 * v["normal_stiffness"],
        "contact.friction_ratio": v["friction_ratio"],
        "cost.maximum": v["cost_maximum"],
    }
    expected = scene.load("paper", overrides=changes).constants()
    found = calibration.numbers(scene.load("paper"), calibration.values(units))
    third = jax.tree.map(lambda n: float(n[2] if np.ndim(n) else n), found)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), third, expected)
    with pytest.raises(schema.InputError, match="give each finger a base"):
        calibration.numbers(scene.load("paper_spheres"), calibration.values(units))


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
    space = parameters.design_space(scene.load("paper").hand, "2d")
    flat = [np.full((12, 12), c) for c in (0.0, 2.5)]
    costs = np.repeat(np.array([*flat, wells()])[..., None], 6, -1)
    found = calibration.score(costs, np.full(3, 3.0), space)
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


# --- searches -------------------------------------------------------------------------------------


def test_the_page_gets_a_table_and_a_figure(tmp_path):
    row = {"optimizer": "ours", "preset": "2d", "grasps": [10, 20, 40]}
    row |= {"provenance": {"commit": "abc12345"}}
    row["kept"] = [[0.5, 0.96, 0.2, 0.96], [0.96, 0.97, 1.0, 0.99], [0.96, 0.97, 1.0, 0.5]]
    (tmp_path / "2d-ours.json").write_text(json.dumps(row))
    whole = row | {"optimizer": "screened-es", "preset": "23d"}
    part = whole | {"optimizer": "screened-es:tests=0"}
    (tmp_path / "23d-screened-es.json").write_text(json.dumps(whole))
    (tmp_path / "23d-tests0.json").write_text(json.dumps(part))
    page = tmp_path / "page.md"
    page.write_text("<!-- search:begin -->\n<!-- search:end -->\n")
    figure = tmp_path / "search.png"
    command = ["--report", str(tmp_path), "--page", str(page), "--figure", str(figure)]
    assert search.main(command) == 0
    lines = page.read_text().splitlines()
    assert lines[4].startswith("| `screened-es` | 23d |"), "23 parameters first"
    line = lines[5]
    assert "| `ours` | 2d | three | 4 | 40 | 0.965 |" in line and "0.75 (0.30 to 0.95)" in line
    assert not [text for text in lines if "tests=0" in text], "a part of it left out"
    assert line.endswith("| not reached | abc1234 |") and figure.exists()
    assert search.reached(row | {"kept": row["kept"][:2]}, 0.9) == "20"
