"""The pages of the experiments and of accuracy say what docs/data holds, of one commit."""

import json
import re

import numpy as np
import pytest

from scripts.accuracy.budget_report import Budget
from scripts.accuracy.report import BUDGET
from scripts.experiments import fresh, grasp_types, report, study
from scripts.front_page import ROOT, words
from scripts.shared import statistics

DATA = ROOT / "docs" / "data"
NOW = DATA / "experiments"
EARLIER = [DATA / name for name in ("paper_fingers", "paper_fingers_single", "paper_fingers_switch")]
NOTE = (ROOT / "docs" / "notes" / "results.md").read_text(encoding="utf-8")


def between(text, mark):
    """What a page has between marks."""
    [found] = re.findall(f"<!-- {mark}:begin -->\n\n(.*?)\n\n<!-- {mark}:end -->", text, re.S)
    return found


def commits(value):
    """Commits in a file's provenance, wherever they stand; those of earlier processes included."""
    if isinstance(value, dict):
        found = {value["commit"]} if isinstance(value.get("commit"), str) else set()
        return found.union(*map(commits, value.values()))
    return set().union(*map(commits, value)) if isinstance(value, list) else set()


def test_the_default_scene_s_figures_are_of_one_commit():
    files = [*NOW.glob("*.json"), BUDGET, DATA / "calibration" / "palm_scores.json"]
    found = {p.name: commits(json.loads(p.read_text())) for p in files}
    assert len(files) > 5 and all(found.values()), found
    assert len(set().union(*found.values())) == 1, found
    scenes = {p: json.loads(p.read_text()).get("settings", {}) for p in NOW.glob("*.json")}
    assert len({s["scene_sha256"] for s in scenes.values() if "scene_sha256" in s}) == 1


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What `python -m scripts.experiments figures` prints."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "draw", lambda *_: None)
        return report.make(NOW, tmp_path_factory.mktemp("figures"), earlier=EARLIER)


def test_the_note_s_tables_are_those_of_the_data(made):
    assert made.startswith(between(NOTE, "results"))
    grid, types = study.load(NOW, "landscape"), study.load(NOW, "types")
    assert between(NOTE, "types") == grasp_types.describe(grid[0], types[0])
    for mark, folder in zip(("fresh", "fresh_fingers", "fresh_single", "fresh_switch"),
                            (NOW, *EARLIER), strict=True):
        assert between(NOTE, mark) == fresh.report(folder)
