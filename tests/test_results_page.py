"""The pages of the experiments say what docs/data holds; the default scene's is of one commit."""

import json
import re

from scripts.accuracy.budget_report import Budget
from scripts.experiments import fresh, report, stated
from scripts.front_page import ROOT, words

DATA = ROOT / "docs" / "data"
NOW = DATA / "experiments"
EARLIER = [
    DATA / name for name in ("paper_fingers", "paper_fingers_single", "paper_fingers_switch")
]
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
    found = {p.name: commits(json.loads(p.read_text())) for p in NOW.glob("*.json")}
    assert {"2d.json", "23d.json"} <= set(found) and all(found.values()), found
    assert len(set().union(*found.values())) == 1, found
    scenes = {p: json.loads(p.read_text()).get("settings", {}) for p in NOW.glob("*.json")}
    assert len({s["scene_sha256"] for s in scenes.values() if "scene_sha256" in s}) == 1


def test_the_note_s_tables_are_those_of_the_data(tmp_path):
    """As `python -m scripts.experiments figures` makes them."""
    page = tmp_path / "page.md"
    page.write_text(NOTE)
    report.make(NOW, tmp_path / "figures", page, earlier=EARLIER)
    assert page.read_text() == NOTE
    for mark, folder in zip(("fingers", "single", "switch"), EARLIER, strict=True):
        assert between(NOTE, f"fresh_{mark}") == fresh.report(folder)


def test_the_page_states_what_the_data_have():
    text = words((ROOT / "docs" / "results.md").read_text(encoding="utf-8"))
    assert not [said for said in stated.sentences(NOW, EARLIER) if said not in text]
    kept = re.findall(r"23 parameters, ([a-z ]+) ([\d.]+) % (\d+) ([\d.]+) % at", text)
    names = {"single domain": "_single", "one switch": "_switch", "concurrent": ""}
    assert len(kept) == 3
    for name, standard, whole, finer in kept:
        table = fresh.report(DATA / f"paper_fingers{names[name]}").split("23d:")[1].splitlines()[-1]
        assert f"| {standard} % | {whole} of 30" in table and f"| {finer} % |" in table


def test_the_default_scene_s_budget_is_that_of_the_data():
    page = (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8")
    found = json.loads((DATA / "budget.json").read_text())
    assert between(page, "budget") == Budget(found).tables()["budget"]
    mine = commits(found) | commits(json.loads((NOW / "23d.json").read_text()))
    assert len({c[:7] for c in mine}) == 1, mine
