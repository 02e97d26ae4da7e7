"""Run folders that commit e99f8c5 made are still read: three of them, in tests/data."""

import csv
import zipfile
from pathlib import Path

import numpy as np
import pytest

from codesign_jax import runs
from codesign_jax.runs import choice
from tests.helpers.command_runs import command, own_workplace  # noqa: F401

pytestmark = pytest.mark.filterwarnings("ignore:.*contacts of today have no such numbers")
DATA = Path(__file__).parent / "data"
# Archive, run folder in it, episodes that are done and those that were asked for. The search in 23D
# was stopped; the seeds grasp a sphere and a mesh.
RUNS = [
    ("run_particle_filter", "particle-filter", 3, 3),
    ("run_screened", "screened", 5, 8),
    ("runs_seeds", "seeds/seed-1", 4, 4),
]


def unpacked(archive, folder):
    zipfile.ZipFile(DATA / f"{archive}.zip").extractall(folder)
    return folder


@pytest.mark.parametrize(("archive", "name", "done", "asked"), RUNS)
def test_an_earlier_run_is_read_and_reported(archive, name, done, asked, tmp_path):
    """Its arrays are the numbers of the tables that were written beside them."""
    folder = unpacked(archive, tmp_path) / name
    scene, settings = runs.read_run(folder)
    record = choice.read_record(folder)
    assert (record.done, settings.episodes) == (done, asked)
    assert (record.test is not None) == (done == asked)
    trials = csv.DictReader((folder / "trials.csv").read_text().splitlines())
    costs = np.array([float(row["cost"]) for row in trials], np.float32)
    np.testing.assert_array_equal(np.ravel(record.history.outcomes.cost[:done]), costs)
    assert choice.choose(scene, record).design.dtype == np.float32
    assert command("report", folder, "--no-replay") == 0
    assert f"{done} of {asked} episodes" in (folder / "report.html").read_text()


def test_an_earlier_run_is_evaluated_and_goes_on(tmp_path, capsys):
    folder = unpacked("run_particle_filter", tmp_path) / "particle-filter"
    before = (folder / "trials.csv").read_text()
    assert command("evaluate", "--run", folder, "--trials", "2") == 0
    # By the scene that the run keeps: the files of tests/data may change.
    asked = ["--scene", folder / "scene.toml", "--engine", "mujoco", "--particles", "4"]
    asked += ["--trials", "2", "--test-trials", "2", "--seed", "3", "--episodes", "4"]
    assert command("optimize", *asked, "--out", folder) == 0
    assert "resuming episode 4/4" in capsys.readouterr().out
    assert (folder / "trials.csv").read_text().startswith(before)
    assert command("evaluate", "--run", folder, "--trials", "2") == 0
