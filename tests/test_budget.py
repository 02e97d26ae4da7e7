"""What moves a verdict: the tables from records whose flips are known, and the variants' scenes."""

import dataclasses
import json

import numpy as np
import pytest

from codesign_jax.scene import load
from scripts.accuracy import against_time, budget, budget_report, decision
from scripts.accuracy.settings import PRESETS, Setting
from scripts.shared import figures

WINDOW = load("paper").window


def record(kept):
    lost = np.where(kept, np.inf, WINDOW[0])
    text = decision.encode(lost, np.zeros(kept.shape, bool), WINDOW)
    return {"particles": kept.shape[0], "trials": kept.shape[1], "lost": text, "status": {}}


@pytest.fixture
def found():
    """20 designs in 12 trials: the truth loses 30 of 240, standard 18 of these alone."""
    truth = np.ones((20, 12), bool)
    truth[:15, :2] = False
    standard = truth.copy()
    standard[:6, :2] = True
    moved = standard.copy()
    moved[0, :6] = False
    variants = {"truth": truth, "standard": standard, "standard, moved": moved}
    every = {name: record(kept) for name, kept in variants.items()}
    return {"variants": every | {"spheres": {"refused": "no"}}, "rates": {}}


def test_biases_and_flips_are_those_that_were_planted(found, tmp_path):
    made = budget_report.Budget(found)
    row = made.row("standard", "`standard`")
    assert row[1].startswith("+5.0 [") and row[2].startswith("5.0% [")  # 12 of 240
    assert row[4] == "2.5%" and row[5:] == ["–"] * 3
    rows = {cells[0]: cells for cells in budget_report.budget_table(made)}
    assert rows["object moved by a micrometre, `standard`"][2].startswith("-2.5 [")
    assert rows["step, links and skin at once: the truth"][2].startswith("-5.0 [")
    assert "spheres in place of the skin" not in rows, "refused"
    page, figure = tmp_path / "page.md", tmp_path / "figure.png"
    marks = "".join(f"<!-- {m}:begin -->\n<!-- {m}:end -->\n" for m in ("budget", "against-truth"))
    page.write_text(marks)
    assert budget_report.make(made, page, figure) == 0
    assert "`standard`" in page.read_text() and figure.stat().st_size > 5000


def rate(value):
    return {"grasps": 240, "seconds": 240 / value, "grasps_per_s": value}


def test_rates_stand_in_the_table_beside_what_they_buy(found):
    assert len(budget_report.presets_table(budget_report.Budget(found))[0]) == 6
    found["rates"] = {"gpu": {"rates": {"standard": rate(1234.4)}}, "cpu": {"rates": {}}}
    head, *rows = budget_report.presets_table(budget_report.Budget(found))
    assert head[6:] == ["grasps/s, one H100", "grasps/s, 2 CPU cores"]
    assert {row[0]: row[6:] for row in rows}["`standard`"] == ["1,234", "–"]
    assert rows[0][6:] == ["–", "–"]


def test_the_figure_against_time_has_what_was_planted(found, tmp_path):
    """A setting without rate or without error is no mark; nothing stands for what is not there."""
    found["variants"]["spheres, MuJoCo C"] = found["variants"]["standard"]
    found["rates"] = {
        "gpu": {"rates": {"standard": rate(500), "fast": rate(600)}},  # fast has no verdicts
        "cpu": {"rates": {"standard": rate(50), "truth": rate(1), "spheres, MuJoCo C": rate(3)}},
    }
    found["tips"] = {"tip_rms_mm": {"standard": 5.0, "fast": 2.0, "least, 1e-3": 2.0}}
    made = budget_report.Budget(found)
    left, right = against_time.marks(made)
    ours, c = "this engine", ("MuJoCo C, 2 CPU cores", "spheres, no skin", 3)
    of_standard = {(f"{ours}, one H100", "standard", 500), (f"{ours}, 2 CPU cores", "standard", 50)}
    assert {m[:3] for m in left} == of_standard | {c}
    assert all(m.error.value == 0.05 and m.error.low < 0.05 < m.error.high for m in left)
    assert {m[:3] for m in right} == of_standard | {(f"{ours}, one H100", "fast", 600)}
    assert {m.error.value for m in right if m.setting == "fast"} == {2.0}
    assert against_time.make(made, tmp_path / "time.png").stat().st_size > 5000


def test_names_that_would_meet_are_moved_apart():
    axis = figures.new(4, 3).subplots()
    axis.set(xlim=(1, 10), ylim=(0, 1), xscale="log")
    heights = against_time._apart(axis, [(2, 0.5), (3, 0.51), (2, 0.9), (4, 0.5)], least=0.1)
    assert heights == pytest.approx([0.405, 0.605, 0.9, 0.505], abs=0.02)


def test_every_variant_is_a_scene_and_every_row_has_its_variants(tmp_path):
    scenes = {name: variant.scene() for name, variant in budget.VARIANTS.items()}
    air = {name: budget.VARIANTS[name].in_the_air() for name in ("standard", "fine", "truth")}
    assert air["standard"] == Setting() and air["truth"] == Setting(
        timestep=2.0, links=20, damping="least"
    )
    assert air["fine"] == dataclasses.replace(PRESETS["fine"], iterations=None)
    fine = scenes["truth"].discretization
    assert (fine.timestep, fine.links, fine.hull_rings, fine.hull_points) == (0.002, 20, 4, 16)
    assert scenes["1e-3"].newton.decrement == 1e-3 and scenes["4 iterations"].newton.iterations == 4
    named = {n for c in budget_report.CHANGES for n in (c.of, c.to)}
    named |= {*budget_report.PRESETS, *budget_report.CANDIDATES, *budget.TIMED}
    named |= {*against_time.WORDS}
    assert named <= set(budget.VARIANTS)
    paths = {budget.path_of(tmp_path, name) for name in budget.VARIANTS}
    assert len(paths) == len(budget.VARIANTS)
    json.dumps(budget.merged(tmp_path))


def test_constants_are_those_of_sets_that_no_target_ruled_out():
    scene = load("paper")
    drawn = budget.calibrated(scene, 5, 2)
    masses = np.asarray(drawn.objects.object[0].mass)
    assert masses.shape == (10,) and np.array_equal(masses[:5], masses[5:])
    assert len(np.unique(masses)) == 5 and masses.max() < 0.3
