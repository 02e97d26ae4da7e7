"""The study's report: statistics, fronts, labels, a tiny run, what the pages state."""

import dataclasses
import itertools
import json
import runpy
import shutil
import sys
from pathlib import Path

import matplotlib.figure
import matplotlib.text
import numpy as np
import pytest
import scipy.stats

from codesign_jax.scene import library
from scripts.accuracy import analysis, report, study
from scripts.accuracy.results import Study
from scripts.accuracy.settings import PRESETS, STANDARD, Setting
from scripts.shared import labels, statistics

ROOT = Path(__file__).parents[1]


def test_rank_correlation_and_its_interval_are_scipy_s():
    rng = np.random.default_rng(3)
    a = rng.integers(0, 6, 40) / 2.0  # with ties, as mean costs have
    b = a + rng.normal(size=40)
    expected = scipy.stats.spearmanr(a, b).statistic
    assert statistics.spearman(a, b) == pytest.approx(expected, rel=1e-12)
    found = statistics.bootstrap(lambda i: statistics.spearman(a[i], b[i]), 40, resamples=2000)
    interval = scipy.stats.bootstrap(
        (a, b),
        lambda x, y: scipy.stats.spearmanr(x, y).statistic,
        paired=True,
        vectorized=False,
        n_resamples=1000,
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    # Ends of an interval from a thousand resamples scatter by some hundredths.
    np.testing.assert_allclose([found.low, found.high], interval, atol=0.05)


def test_two_way_bootstrap_knows_of_shared_trials():
    """All particles lose in the same trials: rows alone would call the mean certain."""
    table = np.tile(np.random.default_rng(0).random(40) < 0.5, (30, 1)).astype(float)
    rows = statistics.bootstrap(lambda i: table[i].mean((-2, -1)), 30, resamples=300)
    (both,) = statistics.two_way(lambda t: [t.mean()], table, resamples=300)
    assert rows.high - rows.low < 1e-12
    # A mean of forty coins has a standard deviation of 0.08: an interval of four of them.
    assert both.high - both.low == pytest.approx(4 * 0.079, rel=0.15)


def test_comparing_a_setting_with_itself_and_with_its_opposite():
    cost = np.array([[0.0, 0.0], [0.0, 3.0], [3.0, 3.0], [1.0, 0.0], [2.0, 2.0], [0.5, 0.0]])
    same = analysis.compare(cost, cost)
    assert same["flipped"].value == 0.0 and same["rank"].value == pytest.approx(1.0)
    assert same["offspring_moved"] == 0.0 and same["failed"] == 0
    other = analysis.compare(3.0 - cost, cost)
    assert other["rank"].value == pytest.approx(-1.0)
    failed = cost.copy()
    failed[0, 0] = np.nan
    lost = analysis.compare(failed, cost)
    assert lost["failed"] == pytest.approx(1 / 12)
    assert lost["flipped"].value == pytest.approx(1 / 12)  # a failed trial is not kept
    assert analysis.differ(failed, cost) == pytest.approx(1 / 12)


def test_equal_particles_have_no_rank_correlation_and_no_interval_of_it():
    """Six particles of a tiny study may all lose alike; the other intervals are there."""
    found = analysis.compare(np.ones((6, 2)), np.zeros((6, 2)))
    assert np.isnan(found["rank"]).all()
    assert found["flipped"] == (1.0, 1.0, 1.0)


def test_fronts_and_orders():
    assert analysis.front([(1.0, 5.0), (2.0, 6.0), (3.0, 1.0), (0.5, 9.0)]) == [3, 0, 2]
    assert analysis.order([(h, 3.0 * h**2) for h in (1, 2, 4)]) == pytest.approx(2.0)
    assert analysis.order([(1.0, 1.0)]) is None


def test_every_record_finds_the_run_of_its_own_file(tmp_path):
    files = []
    for number in range(2):
        record = {"part": "time", "setting": dataclasses.asdict(STANDARD), "run": 0}
        file = tmp_path / f"{number}.json"
        file.write_text(json.dumps({"runs": [{"date": number}], "records": {str(number): record}}))
        files.append(file)
    every, runs = analysis.load(files)
    assert [runs[r["run"]]["date"] for r in every] == [0, 1]


def test_what_beats_a_setting_is_cheaper_and_better_in_every_error():
    """`fast` is beaten in one error each by the axes' and the iterations' setting, not in both."""
    values = {  # cost, finger tip, verdicts
        PRESETS["fast"]: (2.0, 2.0, 2.0),
        Setting(axes=1): (1.0, 1.0, 2.0),
        Setting(iterations=4): (1.0, 2.0, 1.0),
        Setting(axes=2): (1.0, None, 1.0),  # not measured: not better
        Setting(links=40): (3.0, 1.0, 1.0),
    }

    class Made(Study):
        def __init__(self):
            pass

        def cost(self, engine, setting):
            return values.get(setting, (None,))[0]

        def error(self, part, setting):
            return values.get(setting, (None,) * 3)[("tip", "decision").index(part) + 1]

    made = Made()
    assert made.beaten_by(PRESETS["fast"], "tip") == [Setting(axes=1)]
    assert set(made.beaten_by(PRESETS["fast"], "decision")) == {
        Setting(axes=2),
        Setting(iterations=4),
    }
    assert made.beaten_by(PRESETS["fast"], "tip", "decision") == []


def test_labels_cover_neither_each_other_nor_points():
    figure = matplotlib.figure.Figure(dpi=100)
    axes = figure.subplots()
    points = np.array([(1.0, 1.0), (1.05, 1.02), (1.1, 1.0), (1.02, 1.05)])
    axes.plot(*points.T, "o", ms=6)
    axes.set(xscale="log", yscale="log", xlim=(0.5, 2), ylim=(0.5, 2))
    figure.draw_without_rendering()
    labels.add(axes, [(*p, "10 ms, 10 x 1", "black") for p in points], points)
    figure.draw_without_rendering()
    boxes = [matplotlib.text.Text.get_window_extent(text) for text in axes.texts]
    assert len(boxes) == 4
    for box in boxes:
        assert not box.count_contains(axes.transData.transform(points))
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_the_presets_files_and_the_note_state_what_was_measured(tmp_path, monkeypatch):
    """As `python -m scripts.accuracy --report` writes them: new data without it would fail."""
    monkeypatch.setattr(analysis, "RESAMPLES", 2)  # neither states an interval
    found, note = report.studies(ROOT / "docs"), tmp_path / "note.md"
    stated = {n: library.find("accuracy", n).read_text() for n in PRESETS}
    for preset_name, text in stated.items():  # the values alone, and what an earlier study found
        values = [line for line in text.splitlines(True) if not line.startswith("# measured: ")]
        (tmp_path / f"{preset_name}.toml").write_text("# measured: old\n" + "".join(values))
    shutil.copy(ROOT / "docs" / "notes" / "accuracy.md", note)
    report.make_summary(note, tmp_path, found)
    assert note.read_text() == (ROOT / "docs" / "notes" / "accuracy.md").read_text()
    assert stated == {n: (tmp_path / f"{n}.toml").read_text() for n in PRESETS}
    assert all("# measured: finger tip" in text for text in stated.values())


@pytest.mark.parametrize(
    "parts", ["tip,time", pytest.param(",".join(study.PARTS), marks=pytest.mark.slow)]
)
def test_a_tiny_study_runs_resumes_and_is_drawn(parts, tmp_path, monkeypatch, capsys):
    """The script with MuJoCo C alone: parts, a refused setting, the budget, page and CSV."""
    data = tmp_path / "docs" / "data"
    data.mkdir(parents=True)
    page = tmp_path / "docs" / "notes" / "accuracy.md"
    page.parent.mkdir()
    page.write_text("<!-- results:begin -->\n<!-- results:end -->\n")
    monkeypatch.chdir(ROOT)

    def run(*more):
        arguments = ["--size", "tiny", "--json", str(data / "accuracy_cpu.json"), "--parts", parts]
        monkeypatch.setattr(sys, "argv", ["accuracy", *arguments, "--engines", "mujoco", *more])
        with pytest.raises(SystemExit) as end:
            runpy.run_module("scripts.accuracy", run_name="__main__", alter_sys=True)
        return end.value.code

    assert run("--budget", "0") == 3
    assert run("--commit", "abc") == 0
    records = json.loads((data / "accuracy_cpu.json").read_text())["records"]
    # 20 ms with the scene's own contact constant, in the part tip.
    assert sum("refused" in r for r in records.values()) == 1
    assert not [k for k, r in records.items() if "failed" in r]
    capsys.readouterr()
    assert run() == 0
    assert ", 0 to do" in capsys.readouterr().out
    text = report.make(tmp_path / "docs")
    assert "refused" in text and "abc" in text
    assert (tmp_path / "docs" / "figures" / "accuracy_cpu.png").stat().st_size > 10_000
    assert "tip_rms_mm" in (data / "accuracy_cpu.csv").read_text().splitlines()[0]
