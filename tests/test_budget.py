"""What moves a verdict: the tables from records whose flips are known, and the variants' scenes."""

import json

import numpy as np
import pytest

from codesign_jax.scene import load
from scripts.accuracy import budget, budget_report, decision

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
    assert row[4] == "2.5%" and row[5] == "–"
    rows = {cells[0]: cells for cells in budget_report.budget_table(made)}
    assert rows["object moved by a micrometre, `standard`"][2].startswith("-2.5 [")
    assert rows["step, links and skin at once: the truth"][2].startswith("-5.0 [")
    assert "spheres in place of the skin" not in rows, "refused"
    page, figure = tmp_path / "page.md", tmp_path / "figure.png"
    marks = "".join(f"<!-- {m}:begin -->\n<!-- {m}:end -->\n" for m in ("budget", "against-truth"))
    page.write_text(marks)
    assert budget_report.make(made, page, figure) == 0
    assert "`standard`" in page.read_text() and figure.stat().st_size > 5000


def test_every_variant_is_a_scene_and_every_row_has_its_variants(tmp_path):
    scenes = {name: variant.scene() for name, variant in budget.VARIANTS.items()}
    fine = scenes["truth"].discretization
    assert (fine.timestep, fine.links, fine.hull_rings, fine.hull_points) == (0.002, 20, 4, 16)
    assert scenes["1e-3"].newton.decrement == 1e-3 and scenes["4 iterations"].newton.iterations == 4
    named = {n for c in budget_report.CHANGES for n in (c.of, c.to)}
    named |= {*budget_report.PRESETS, *budget_report.CANDIDATES, *budget.TIMED}
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
