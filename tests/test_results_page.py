"""The pages of the experiments say what docs/data holds; the default scene's is of one commit."""

import json
import re
from typing import Any

import numpy as np

from scripts.accuracy.budget_report import CHANGES, PRESETS, Budget
from scripts.calibration import files, itself, score
from scripts.calibration import report as calibration
from scripts.experiments import fresh, grasp_types, report, stated, study
from scripts.front_page import ROOT, words
from scripts.shared import sets

DATA = ROOT / "docs" / "data"
NOW = DATA / "experiments"
SHORT = {"single domain": "s.d.", "one switch": "1", "two switches": "2", "concurrent": "conc."}
"""Strategies of the page as the note's tables call them."""
SCENE = {
    "tilt": 70, "base_x": 36, "pair_gap": 35, "zero_height": 5, "shear_modulus": 35, "width": 24,
    "lateral": 0.75, "torsion": 2.6, "half_size": 30, "mass": 50, "friction": 0.86,
    "table_friction": 0.4, "wrist_linear": 180, "wrist_angular": 12, "shake_amplitude": 38,
    "shake_frequency": 1.5, "normal_stiffness": 4, "friction_ratio": 30, "cost_maximum": 3,
}  # fmt: skip
"""The default scene's constants, in the units of `sets.OPEN`, as docs/calibration.md has them."""
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
    report.make(NOW, tmp_path / "figures", page)
    assert page.read_text() == NOTE
    assert between(NOTE, "fresh") == fresh.report(NOW)


def test_the_page_states_what_the_data_have():
    text = words((ROOT / "docs" / "results.md").read_text(encoding="utf-8"))
    assert not [said for said in stated.sentences(NOW) if said not in text]
    form = r"(\d+) parameters, ([a-z ]+) ([\d.]+) % (\d+) (–|[\d.]+ %) (–|[\d.]+ %)"
    rows = re.findall(form, text)
    assert len(rows) == 7
    table = fresh.report(NOW)
    for parameters, strategy, standard, whole, finer, unseen in rows:
        part = table.split(f"{parameters}d:")[1].split("\n\n")[1].splitlines()
        [row] = [line for line in part if line.startswith(f"| {SHORT[strategy]} |")]
        assert f"| {standard} % | {whole} of 30" in row
        assert all(share == "–" or f"| {share} |" in row for share in (finer, unseen))


def test_the_presets_loss_is_that_of_the_winners():
    """The loss at `reference` that pages state."""
    row = fresh.report(NOW).split("23d:")[1].splitlines()[-1]
    loss, truth = re.findall(r"-(\d\.\d) \[-(\d\.\d), -(\d\.\d)\]", row)
    names = ("results", "accuracy", "stability")
    texts = [words((ROOT / "docs" / f"{n}.md").read_text("utf-8")) for n in names]
    assert f"lose {loss[0]} points [{loss[2]}, {loss[1]}]" in texts[0]
    assert f"lose {truth[0]} [{truth[2]}, {truth[1]}] in the first 12" in texts[0]
    assert f"keep {loss[0]} points less there than at `standard` [{loss[2]}, {loss[1]}]" in texts[1]
    assert f"concurrent runs with 23 parameters lose {loss[0]} points" in texts[2]


def test_the_landscape_s_grasp_types_are_those_of_the_data():
    loaded = [study.load(NOW, name) for name in ("landscape", "types")]
    grid, types = (found[0] for found in loaded if found)
    assert between(NOTE, "types") == grasp_types.describe(grid, types)
    tilt = np.degrees(types["tilt"][types["type"] == 1])  # of the wrap
    cuboid, cylinder = (100 * float((tilt[:, k] > 60).mean()) for k in (0, 1))
    text = words((ROOT / "docs" / "results.md").read_text(encoding="utf-8"))
    said = f"{cuboid:.0f} % of these designs turn the cuboid by more than 60°, {cylinder:.0f} %"
    assert said in text


def test_the_default_scene_s_budget_is_that_of_the_data():
    page = (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8")
    found = json.loads((DATA / "budget.json").read_text())
    for mark, table in Budget(found).tables().items():
        assert between(page, mark) == table
    made, text = Budget(found), words(page)

    def compared(of: str, to: str) -> dict[str, Any]:
        both = made.compared(of, to)
        assert both is not None
        return both

    flips = {c: made.compared(c.to, c.of) for c in CHANGES}
    points = {c.to: 100 * r["flipped"].value for c, r in flips.items() if r}
    numerics = [points[c.to] for c in CHANGES if c.kind == "numerics" and c.to in points]
    touch = [points[f"fingers pass {what}"] for what in ("each other", "the palm")]
    [palm] = files.read_scores([DATA / "calibration" / "palm_scores.npz"])
    assert f"of the {palm.plausible.sum()} that the first {len(palm.plausible)} of the" in text
    assert f"A truth refined once more flips {points['finer']:.0f} %" in text
    assert f"and this engine differ in {points['spheres, MuJoCo C']:.0f} %" in text
    assert f"Numerics flip {min(numerics):.0f} to {max(numerics):.0f} %" in text
    assert f"contacts of fingers {min(touch):.0f} to {max(touch):.0f} %" in text
    lost = -100 * compared("constants", "standard, on CPUs")["success_difference"].value
    said = f"flips {points['constants']:.0f} % of the verdicts and costs {lost:.0f} points"
    laws = f"the bending law {points['neo-Hookean']:.0f} %, pressure that resists sideways bending"
    assert f"{said} of success, {laws} {points['lateral threshold']:.0f} %" in text
    chance = [compared(f"{n}, moved", n)["flipped"].value for n in ("truth", "fast", "fine")]
    assert f"flips {chance[0]:.1%} of the truth's own".replace("%", " %") in text
    assert {f"{c:.1%}" for c in chance[1:]} == {"4.8%"} and "4.8 % of those of `fast`" in text
    against = {n: compared(n, "truth")["success_difference"] for n in PRESETS}
    worst = max(abs(100 * r.value) for r in against.values())
    mine = abs(100 * against["standard"].value)
    assert f"by {worst:.1f} points at most and by {mine:.1f} at `standard`" in text
    assert f"judges {100 * against['fast'].value:.1f} points too well" in text
    assert [n for n, r in against.items() if r.low > 0 or r.high < 0] == ["fast"]
    mine = commits(found) | commits(json.loads((NOW / "23d.json").read_text()))
    assert len({c[:7] for c in mine}) == 1, mine


def test_the_rates_that_the_accuracy_page_states_are_those_of_the_data():
    text = words((ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8"))
    found = json.loads((DATA / "budget.json").read_text())
    machines = [found["rates"][n]["rates"] for n in ("gpu", "cpu")]
    names = ("fast", "standard", "least, 1e-3")
    gpu, cpu = ({n: m[n]["grasps_per_s"] for n in names} for m in machines)
    assert {m["fast"]["grasps"] for m in machines} == {1200, 480}
    ratios = [m["fast"] / m["standard"] for m in (gpu, cpu)]
    assert f"{ratios[0]:.1f}" == f"{ratios[1]:.1f}", "on both machines"
    assert f"at {ratios[0]:.1f} times the rate, and judges" in text
    assert f"({gpu[names[2]]:.0f} grasps/s beside {gpu['fast']:.0f}, 1,200 a call)" in text
    assert f"({cpu[names[2]]:.0f} beside {cpu['fast']:.0f}, 480 a call)" in text
    both = [machines[1][n]["grasps_per_s"] for n in ("spheres", "spheres, MuJoCo C")]
    said = f"{both[0]:.0f} and {both[1]:.1f} grasps/s, {both[0] / both[1]:.0f} times as many"
    assert said in words((ROOT / "docs" / "performance.md").read_text(encoding="utf-8"))
    bias = Budget(found).compared("least, 1e-3", "truth")
    assert bias is not None and bias["success_difference"].low < 0 < bias["success_difference"].high


def test_the_calibration_page_states_what_its_waves_have():
    """The sets that are left in the default scene's contacts; the default scene lies among them."""
    folder = DATA / "calibration"
    paths = [folder / f"{n}_scores.npz" for n in ("palm", "palm_next", "repeats/palm_again")]
    palm, near, again = files.read_scores(paths)
    mine = commits([w.notes for w in (palm, near, again)]) | commits(
        json.loads((NOW / "2d.json").read_text())
    )
    assert len(mine) == 1, mine
    every = calibration.join([palm, near])
    text = words((ROOT / "docs" / "calibration.md").read_text(encoding="utf-8"))
    left, most = int(every.plausible.sum()), len(every.plausible)
    assert f"and {len(near.plausible)} near those" in text
    assert f"No target rules out {left} of these {most} sets" in text
    assert f"Share of the {most} sets" in text
    assert f"Of the {palm.plausible.sum()} sets that are left of the {len(palm.plausible)}" in text
    assert f"{again.plausible.sum()} are left again in new trials" in text
    assert f"Of the {len(near.plausible)} sets near them {near.plausible.sum()} are left" in text
    values = sets.values(every.data["units"][every.plausible])
    low, high = ({n: np.quantile(v, q) for n, v in values.items()} for q in (0.05, 0.95))
    assert all(low[n] <= value <= high[n] for n, value in SCENE.items())
    for name in SCENE:
        assert f"{_short(low[name])} to {_short(high[name])}" in text, name
    # The set that the default scene is near: alike in all constants but those of contact and cost.
    one, other = (_nearest(w).max() for w in (palm, again))
    assert (
        f"lies {one:.1f} standard deviations from the worst" in text and f"at {other:.1f}:" in text
    )
    assert (palm.data["distances"].max(1) < one).sum() == 1 and "one set lies nearer" in text
    own = {name: float(value[0]) for name, value in itself.measured(NOW).items()}
    assert not score.implausibility(itself.measured(NOW)).any() and "meets every target" in text
    speed = [own[f"simulations concurrent, {kind}, own"] for kind in ("first", "stays")]
    said = (
        f"{speed[0]:.0f} simulations until the mean cost is first below 1 and {speed[1]:.0f} until"
    )
    assert said in text and f"a cost of {own['saddle']:g} separates" in text
    alone, both = (100 * own[f"success {s}, own"] for s in ("single", "concurrent"))
    assert f"success in {alone:.0f} % of the runs with a single domain and {both:.0f} %" in text


def _short(value):
    """A number with two digits, as the page's table has it."""
    return f"{float(f'{value:.2g}'):,g}"


def _nearest(wave):
    """Distances of the set that the default scene is near, shape (target,)."""
    other = ("normal_stiffness", "friction_ratio", "cost_maximum")
    values = sets.values(wave.data["units"])
    away = [abs(values[n] / SCENE[n] - 1) for n in SCENE if n not in other]
    return wave.data["distances"][np.max(away, 0).argmin()]


def test_the_calibration_note_s_tables_are_those_of_the_data(tmp_path):
    note = (ROOT / "docs" / "notes" / "calibration.md").read_text(encoding="utf-8")
    made = calibration.make(DATA / "calibration", tmp_path, experiments=NOW)
    assert between(note, "calibration") == made
