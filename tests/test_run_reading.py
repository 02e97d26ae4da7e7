"""Runs as others read them: what is damaged, another's or changed is said; earlier runs."""

import csv
import errno
import json
import os
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from codesign_jax import runs
from codesign_jax.interrupts import Interrupts
from codesign_jax.runs import manifest, selection, tables
from codesign_jax.runs.checkpoint import Checkpoints
from scripts import faults
from tests.helpers.command_runs import (  # noqa: F401
    RUN,
    assert_same_run,
    command,
    copied,
    own_workplace,
    snapshot,
    stored,
)
from tests.helpers.refusals import refusal, refusal_of_command

NEWEST = 4  # the final test, after three episodes


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished run that no test changes."""
    return copied(tmp_path_factory.mktemp("whole") / "run")


@pytest.fixture
def run(whole, tmp_path):
    """A finished run of its own."""
    return shutil.copytree(whole, tmp_path / "run")


@pytest.mark.parametrize("way", faults.WAYS)
def test_damage_of_the_newest_checkpoint_is_said_and_nothing_is_changed(way, run):
    """Of another file in each way; `test_checkpoint` has every file."""
    step = run / "checkpoints" / str(NEWEST)
    paths = [p for p in sorted(step.rglob("*")) if p.stat().st_size and p.is_file()]
    faults.damage(paths[faults.WAYS.index(way) % len(paths)], way)
    before = sorted(os.walk(run))
    messages = []
    record = runs.load_record(run, tell=messages.append)
    assert record is not None and record.test is None and record.done == 3
    (words,) = messages
    assert f"{run} has damaged checkpoints ({NEWEST}: " in words
    assert sorted(os.walk(run)) == before
    with pytest.warns(UserWarning, match=re.escape(str(run))):  # in a notebook
        runs.load_record(run)


@pytest.mark.parametrize(("name", "way"), [("sha256", "a folder"), ("d", "flipped")])
def test_a_resumption_mends_damage_and_says_so(name, way, run, whole, capsys):
    """From the older checkpoint, to the same bits: of the file of digests, and of the data."""
    largest = max((run / "checkpoints" / str(NEWEST)).rglob("d/*"), key=lambda p: p.stat().st_size)
    faults.damage(largest if name == "d" else run / "checkpoints" / f"{NEWEST}.sha256", way)
    assert command(*RUN, "--out", run) == 0
    assert f"checkpoint {NEWEST} is lost" in capsys.readouterr().out
    assert f"checkpoint {NEWEST} is lost" in (run / "events.log").read_text()
    assert_same_run(run, whole)


def relabelled(run, identity):
    """Saves the newest step of a run as one of a run with this identity, or with none."""
    run_id = manifest.read_provenance(run)["id"]
    with Checkpoints(run / "checkpoints", run=run_id, read_only=True) as store:
        arrays = store.restore().arrays
    shutil.rmtree(run / "checkpoints")
    with Checkpoints(run / "checkpoints", run=identity) as store:
        store.save(NEWEST, arrays)


@pytest.mark.parametrize("identity", ["0" * 32, None])
def test_checkpoints_of_another_run_are_refused(identity, run):
    relabelled(run, identity)
    before = snapshot(run / "checkpoints")
    assert refusal(runs.load_record, run) == [("damaged", f"run {run}")]
    assert command(*RUN, "--out", run) == 1
    assert snapshot(run / "checkpoints") == before


def test_a_run_of_a_newer_version_is_refused(run):
    content = manifest.read_provenance(run)
    manifest.write(run, content | {"schema": manifest.SCHEMA + 1})
    assert refusal(runs.read_run, run) == [("unsupported", str(run))]


def test_changed_scene_files_are_refused_by_all_that_read_the_run(run):
    path = run / "objects.toml"
    text = path.read_text()
    path.write_text("# a comment of the user's\n" + text)
    runs.read_run(run)
    path.write_text(text.replace("    0.03,", "    0.031,"))
    assert path.read_text() != text
    resumption = ["optimize", "--scene", run / "scene.toml", *RUN[3:], "--out", run]
    for arguments in (["report", run, "--no-replay"], ["evaluate", run, "--dry-run"], resumption):
        assert refusal_of_command(*arguments) == [("damaged", str(path))]
    path.unlink()
    assert refusal(runs.read_run, run) == [("damaged", str(path))]
    path.write_text(text)
    runs.read_run(run)


HOSTILE = ["[" * 100_000, "{", b"\xff\xfe", {"episodes": 10**12}, {"../../etc/passwd": "0"}]


@pytest.mark.parametrize("case", HOSTILE, ids=["nested", "no JSON", "no text", "settings", "files"])
def test_a_hostile_provenance_is_refused(case, run):
    path = run / "provenance.json"
    if isinstance(case, dict):
        content = json.loads(path.read_text())
        content["settings" if "episodes" in case else "files"] |= case
        case = json.dumps(content)
    path.write_bytes(case if isinstance(case, bytes) else case.encode())
    assert refusal(runs.read_run, run) == [("damaged", str(path))]
    assert refusal(runs.setting_of, [run], "episodes") == [("damaged", str(path))]


@pytest.mark.parametrize("program", ["optimize", "report"])
def test_tables_are_written_again_from_the_checkpoints(program, run, whole):
    (run / "episodes.csv").unlink()
    text = (run / "particles.csv").read_text()
    (run / "particles.csv").write_text(text[:-20])  # as of a process that was killed
    text = (run / "trials.csv").read_text()
    (run / "trials.csv").write_text(text.replace("sphere", "sphare", 1))
    (run / "tests.csv").unlink()
    arguments = [*RUN, "--out", run] if program == "optimize" else ["report", run, "--no-replay"]
    assert command(*arguments) == 0
    for name in tables.TABLES:
        assert (run / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.parametrize("name", ["report.html", "provenance.json"])
def test_a_full_disk_names_the_file_that_could_not_be_written(name, run, monkeypatch, capsys):
    """The write fails, not the opening: such errors have no name of their own."""

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    report = ["report", run, "--no-replay"]
    assert command(*(report if name == "report.html" else [*RUN, "--out", run])) == 1
    error = capsys.readouterr().err
    last = error.splitlines()[-1]  # behind what a slow machine says of its waits
    assert last.startswith(f"error: {run / name}: No space left on device; make room, and give")
    assert error.count("\n") == 1


def test_an_unexpected_error_keeps_its_traceback(run, monkeypatch, capsys):
    """On the terminal and in events.log: it is a bug, or the device's."""

    def broken(*arguments):
        raise RuntimeError("a bug of somebody's")

    monkeypatch.setattr(Interrupts, "begin", broken)
    assert command(*RUN, "--out", run, "--episodes", "4") == 1
    error = capsys.readouterr().err
    log = (run / "events.log").read_text()
    for text in (error, log):
        assert "Traceback (most recent call last)" in text and "in broken" in text
    assert "error: RuntimeError: a bug of somebody's" in error


# --- runs that commit e99f8c5 made ----------------------------------------------------------------


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


@pytest.mark.parametrize(("archive", "name", "done", "episodes"), RUNS)
def test_an_earlier_run_is_read_and_reported(archive, name, done, episodes, tmp_path):
    """Its arrays are the numbers of the tables that were written beside them."""
    folder = unpacked(archive, tmp_path) / name
    scene, settings = runs.read_run(folder)
    record = selection.read_record(folder)
    assert (record.done, settings.episodes) == (done, episodes)
    assert (record.test is not None) == (done == episodes)
    trials = csv.DictReader((folder / "trials.csv").read_text().splitlines())
    costs = np.array([float(row["cost"]) for row in trials], np.float32)
    np.testing.assert_array_equal(np.ravel(record.history.outcomes.cost[:done]), costs)
    chosen = selection.choose(scene, record)
    assert chosen.design.dtype == np.float32
    simulated = record.history.population[chosen.episode, chosen.row]
    np.testing.assert_array_equal(simulated, chosen.design)
    if done != episodes:  # `test_report` has runs that ended
        assert command("report", folder, "--no-replay") == 0
        assert f"{done} of {episodes} episodes" in (folder / "report.html").read_text()


def test_an_earlier_run_goes_on(tmp_path, capsys):
    folder = unpacked("run_particle_filter", tmp_path) / "particle-filter"
    before = (folder / "trials.csv").read_text()
    # By the scene that the run keeps: the files of tests/data may change.
    arguments = ["--scene", folder / "scene.toml", "--engine", "mujoco", "--particles", "4"]
    arguments += ["--trials", "2", "--test-trials", "2", "--seed", "3", "--episodes", "4"]
    assert command("optimize", *arguments, "--out", folder) == 0
    assert "resuming episode 4/4" in capsys.readouterr().out
    assert (folder / "trials.csv").read_text().startswith(before)
