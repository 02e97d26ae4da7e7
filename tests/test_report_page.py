"""The report of a run: the numbers of its tables, in one file, and errors in words."""

import csv
import importlib
import json
import re
import shutil
import sys

import numpy as np
import pytest
from scipy import stats

from codesign_jax import cli, runs, store
from codesign_jax.commands import reference
from codesign_jax.runs import choice
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Outcome, Status, failed
from tests.helpers.tiny_run import small_run  # noqa: F401

pytest.importorskip("plotly", reason="the extra 'report' is not installed")


@pytest.fixture(scope="module")
def text(run):
    return (run / "report.html").read_text(encoding="utf-8")


def test_report_shows_the_best_tested_particle_with_its_interval(run, text):
    with (run / "tests.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    best = min(rows, key=lambda row: float(row["test_cost"]))  # the first of equal ones
    the_scene, _ = runs.read_run(run)
    chosen = choice.choose(the_scene, choice.read_record(run))
    kept = int(((chosen.outcomes.cost < 0.01) & ~failed(chosen.outcomes.status)).sum())
    low, high = stats.binomtest(kept, int(best["trials"])).proportion_ci(0.95, method="wilson")
    share = f"grasps of its final test ({100 * low:.0f} to {100 * high:.0f} %): not good"
    assert f"kept {kept} of {best['trials']}, " in text and share in text
    assert f"Particle {best['particle']}, chosen as the best by the final test" in text
    assert f"; mean cost {float(best['test_cost']):.4f}" in text
    for column, unit in (("length_mm", "mm"), ("arm_z_mm", "mm")):
        value = f"{float(best[column]):.4g}"
        assert f"<th class='number'>{column[: -len(unit) - 1]} {unit}</th>" in text
        assert f">{value}<div class='scale'>" in text


def test_report_is_one_small_file_that_names_its_origin(run, text):
    assert (run / "report.html").stat().st_size < 10e6
    provenance = json.loads((run / "provenance.json").read_text())
    assert provenance["environment"]["versions"]["mujoco"] in text
    assert "&lt;run&gt; &amp; 1" in text and "<run>" not in text, "names are text, not HTML"
    page = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert not re.search(r"(src|href)\s*=", page), "nothing is loaded from elsewhere"


def test_grasp_is_the_one_of_the_table(run):
    """Noise, design and verdict of a row of trials.csv come back from its three numbers."""
    the_scene, _ = runs.read_run(run)
    record = choice.read_record(run)
    with (run / "trials.csv").open(newline="") as file:
        rows = {
            (int(r["episode"]), int(r["particle"]), int(r["trial"])): r
            for r in csv.DictReader(file)
        }
    for place in ((1, 2, 0), (2, 0, 1)):
        episode, particle, trial = place
        found = choice.find_grasp(
            the_scene, record, episode=episode, particle=particle, trial=trial
        )
        assert found.place == place
        assert float(rows[place]["cost"]) == pytest.approx(float(found.outcome.cost), rel=1e-6)
    # The best one is the chosen particle's ancestor.
    best, chosen = choice.find_grasp(the_scene, record), choice.choose(the_scene, record)
    np.testing.assert_array_equal(best.design, chosen.design)
    with pytest.raises(InputError) as error:
        choice.find_grasp(the_scene, record, episode=4, trial=3)
    assert len(error.value.problems) == 2 and "--episode = 4 is outside [1, 3]" in str(error.value)


def test_unfinished_run_reports_its_finished_episodes(run, tmp_path, capsys):
    """Without a final test, and with room for an episode that was never simulated."""
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    last = max(
        (p for p in (copy / "checkpoints").iterdir() if p.is_dir()), key=lambda p: int(p.name)
    )
    for step in (int(last.name), int(last.name) - 1):  # the test's, and the last episode's
        shutil.rmtree(copy / "checkpoints" / str(step))
        (copy / "checkpoints" / f"{step}.sha256").unlink()
    assert cli.main(["report", str(copy), "--no-replay", "--out", str(tmp_path / "r.html")]) == 0
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "2 of 3 episodes" in page and "not tested" in page
    assert "startReplay(document" not in page
    assert f"report: {tmp_path / 'r.html'}" in capsys.readouterr().out


def test_fresh_trials_at_reference_are_in_the_report(run, tmp_path, capsys):
    """Those of the run's design; not those of the design before the run was extended."""
    copy = shutil.copytree(run, tmp_path / "run")
    settings, trials = runs.read_run(copy)[1], 5
    cost, status = np.array([0.0, 0.0, 0.0, 2.0, 3.0]), np.array([0, 0, 0, 0, int(Status.STUCK)])
    lost = np.where(cost == 2.0, 5.0, np.inf)
    found = Outcome(cost, status, lost, np.full(trials, -1))
    for design, words in (("own", True), ("other", False)):
        case = choice.case_of_run(copy, accuracy="reference")
        tested = case if design == "own" else case._replace(design=case.design + 1)
        store.keep(copy / reference.FILE, tested.digest(settings.seed), found._asdict())
        page = tmp_path / f"{design}.html"
        assert cli.main(["report", str(copy), "--no-replay", "--out", str(page)]) == 0
        low, high = stats.binomtest(3, 5).proportion_ci(0.95, method="wilson")
        text = page.read_text(encoding="utf-8")
        share = f"keeps 60 % of 5 fresh grasps ({100 * low:.0f} to {100 * high:.0f} %): not good"
        assert (share in text) == words
        assert ("; accuracy reference, steps of " in text) == words
        assert ("1 of 5 trials failed (STUCK 1)" in text) == words


def test_errors_are_words(run, tmp_path, capsys, monkeypatch):
    assert cli.main(["report", str(tmp_path)]) == 2
    assert "is not a run folder" in capsys.readouterr().err
    for seed in (0, 1):
        folder = tmp_path / "seeds" / f"seed-{seed}"
        folder.mkdir(parents=True)
        shutil.copy(run / "provenance.json", folder)
    assert cli.main(["report", str(tmp_path / "seeds")]) == 2
    hint = f"it holds 2 runs: give one, such as {tmp_path / 'seeds' / 'seed-0'}"
    assert hint in capsys.readouterr().err
    for name in ("codesign_jax.report.page", "codesign_jax.report.charts"):
        monkeypatch.delitem(sys.modules, name, raising=False)
        monkeypatch.delattr(
            importlib.import_module("codesign_jax.report"), name[20:], raising=False
        )
    monkeypatch.setitem(sys.modules, "plotly", None)
    assert cli.main(["report", str(run)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "plotly" in line and "pip install '.[report]' in the checkout" in line
