"""`scripts.dataset`: files are described as they are, and a network finds what was planted."""

import hashlib

import numpy as np
import pytest

from codesign_jax import cli
from codesign_jax.scene.parameters import design_space
from scripts.dataset import __main__ as sheet
from scripts.dataset import surrogate
from scripts.dataset.surrogate import Grasps
from tests.helpers.toy_engine import TINY, tiny


def planted(count=4000, seed=0):
    """Grasps whose log odds follow one parameter, the object's height and the friction."""
    draws = np.random.default_rng(seed)
    unit = draws.uniform(size=(count // 4, 3)).astype(np.float32)
    design, which = np.repeat(np.arange(count // 4), 4), draws.integers(0, 3, count)
    noise = draws.normal(size=(count, 10)).astype(np.float32)
    told = np.array([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0]], np.float32)
    odds = 6 * (unit[design, 0] - 0.5) + told[which, 0] - 1 + noise[:, 7]
    share = 1 / (1 + np.exp(-odds))
    kept = (draws.uniform(size=count) < share).astype(np.float32)
    return Grasps(design, unit[design], which, noise, kept), told, share


def test_a_network_finds_what_was_planted_and_is_calibrated(monkeypatch):
    monkeypatch.setattr(surrogate, "STEPS", 300)
    grasps, told, share = planted()
    found, out = surrogate.study(grasps, told, each=False)
    own = found["designs"]
    best = surrogate.scores(share[out], grasps.kept[out], share[out])  # knows the truth
    assert own["grasps"] == out.sum() == 800
    # Bernoulli draws leave the truth itself a log loss, which 3,200 grasps are enough to approach.
    assert best["log_loss"] < own["log_loss"] < best["log_loss"] + 0.06
    assert own["log_loss"] < own["log_loss_of_shares"] - 0.05
    assert own["auc"] > best["auc"] - 0.04 and own["calibration_error"] < 0.1
    rows = surrogate.screened(grasps, told, out, [1600, 10**6])
    assert len(rows) == 1, "it has no so many grasps"
    assert rows[0]["kept"] > rows[0]["kept_of_all"] + 0.25


def test_scores_are_those_of_their_definitions():
    kept = np.array([0, 0, 1, 0, 1, 1, 0, 1, 1, 1], np.float32)
    share = np.linspace(0.05, 0.95, 10)
    found = surrogate.scores(share, kept, np.full(10, 0.6))
    pairs = [(a > b) for a in share[kept == 1] for b in share[kept == 0]]
    assert found["auc"] == pytest.approx(np.mean(pairs))
    assert found["brier"] == pytest.approx(np.mean((share - kept) ** 2))
    assert found["log_loss_of_shares"] == pytest.approx(-np.mean(
        [np.log(0.6) if k else np.log(0.4) for k in kept]
    ))  # fmt: skip
    assert found["calibration_error"] == pytest.approx(np.mean(np.abs(share - kept)))


def test_a_file_is_described_and_read_as_it_is(tmp_path, capsys):
    path = tmp_path / "grasps.parquet"
    sample = ["sample", "--scene", str(TINY), "--designs", "6", "--trials", "3", "--out", str(path)]
    assert cli.main([*sample, "--engine", "mujoco", "--preset", "2d"]) == 0
    page = tmp_path / "page.md"
    page.write_text("<!-- files:begin -->\n<!-- files:end -->\n")
    made = ["--page", str(page), "--json", str(tmp_path / "sheet.json")]
    assert sheet.main([str(path), *made]) == 0
    [found] = [sheet.described(path)]
    assert found["grasps"] == 18 and found["designs"] == 6 and found["trials"] == 3
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert f"{digest}  grasps.parquet" in page.read_text()
    assert "| `grasps.parquet` | 18 | 6 | 3 |" in page.read_text()
    the_scene, space, _ = tiny()
    assert space == design_space(the_scene.hand, "2d")
    names = [shape.name for shape in the_scene.objects.object]
    grasps = surrogate.read(path, space, names)
    kept = sum(own.get("kept", 0) for own in found["verdicts"].values())
    assert grasps.kept.sum() == kept and grasps.unit.shape == (18, 2)
    assert (grasps.unit >= -1e-5).all() and (grasps.unit <= 1 + 1e-5).all()
    assert len(surrogate.shapes(the_scene)) == len(names)
