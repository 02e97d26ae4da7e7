"""A run and its folder: it resumes and extends bit for bit, whatever ended it."""

import dataclasses
import fcntl
import json
import shutil
import signal

import numpy as np
import pytest

from codesign_jax import runs
from codesign_jax.commands import reference
from codesign_jax.runs import choice
from codesign_jax.runs.choice import Case
from tests.helpers.command_runs import (  # noqa: F401
    EPISODES,
    RESULTS,
    assert_same_run,
    command,
    finished_run,
    launch,
    own_workplace,
    snapshot,
    stored,
    wait_for,
    without,
)
from tests.helpers.tiny_run import RUN


def test_same_command_again_changes_no_result(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "copy")
    left = folder / "trials.csv.4711.tmp"  # of a process that was killed while it wrote
    left.write_text("half")
    assert command(*RUN, "--out", folder) == 0
    assert not left.exists()
    assert f"all {EPISODES} episodes are done" in capsys.readouterr().out
    assert_same_run(folder, finished)


def test_a_killed_run_resumes_bit_for_bit(tmp_path, capsys):
    """Signals within this process: test_runs_of_a_batch_stop_fail_and_go_on_by_themselves."""
    # Enough episodes that a signal after the second finds the run on its way.
    folder, run = tmp_path / "run", [*RUN, "--episodes", "10"]
    process = launch(*run, "--out", folder)
    wait_for(folder / "events.log", "episode  2/", process)
    process.kill()
    output, _ = process.communicate()
    assert process.returncode == -signal.SIGKILL, output
    done = runs.load_record(folder)
    assert done is not None and 2 <= done.done < 10, "it was to stop on the way"
    assert command(*run, "--out", folder) == 0
    assert f"resuming episode {done.done + 1}/10" in capsys.readouterr().out
    assert command(*run, "--out", tmp_path / "whole") == 0
    assert_same_run(folder, tmp_path / "whole")


@pytest.mark.parametrize("lost", ["*.sha256", "folder"])
def test_losing_every_checkpoint_is_refused_until_fresh(lost, finished, tmp_path, capsys):
    """The tables are the last that is left of the results, and a start would replace them."""
    folder = shutil.copytree(finished, tmp_path / "run")
    if lost == "folder":
        shutil.rmtree(folder / "checkpoints")
    for path in (folder / "checkpoints").glob(lost):
        path.unlink()
    before = {name: (folder / name).read_bytes() for name in RESULTS}
    assert command(*RUN, "--out", folder) == (2 if lost == "folder" else 1)
    error = capsys.readouterr().err
    assert f"while its tables have {EPISODES} episodes" in error and "--fresh" in error
    assert before == {name: (folder / name).read_bytes() for name in RESULTS}
    if lost == "*.sha256":
        assert error.count(".sha256 is missing") == 3 and (folder / "checkpoints" / "3").is_dir()
        assert command(*RUN, "--out", folder, "--fresh") == 0
        assert_same_run(folder, finished)


def test_resume_with_other_settings_is_refused(finished, capsys):
    path = finished / "provenance.json"  # as of a run that the command began
    content = json.loads(path.read_text())
    content["started"]["command"] = ["/usr/bin/codesign", *RUN, "--out", "my runs"]
    path.write_text(json.dumps(content))
    before = snapshot(finished)
    assert command(*RUN, "--out", finished, "--particles", "5", "--schedule", "switch-2") == 2
    error = capsys.readouterr().err
    assert "particles: the run has 4, asked for is 5" in error
    assert "--schedule: the run has concurrent, asked for is switch-2" in error
    assert "goes on by its own command: codesign optimize --scene" in error and "'my runs'" in error
    assert snapshot(finished) == before


def test_second_process_on_a_folder_is_refused(finished, capsys):
    holder = (finished / ".lock").read_text().strip()  # who made the run: maybe another worker
    before = snapshot(finished)
    with (finished / ".lock").open("r+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert command(*RUN, "--out", finished) == 2
    assert f"is in use by process {holder}" in capsys.readouterr().err
    assert snapshot(finished) == before


def test_the_best_particle_meets_fresh_trials_at_reference(finished, tmp_path, monkeypatch, capsys):
    """At five times the steps and three times the links: with 20 times MuJoCo C takes long."""
    monkeypatch.setattr(reference, "ACCURACY", "fine")
    folder = shutil.copytree(finished, tmp_path / "run")
    assert command(*RUN, "--reference-trials", "2", "--out", folder) == 0
    said = capsys.readouterr().out.splitlines()
    line = next(x for x in said if x.startswith("verdict: "))
    assert "of 2 fresh grasps" in line
    assert any("accuracy fine, steps of 5 ms, 10 links a finger" in x for x in said)

    def never(*arguments):
        raise AssertionError("simulated again")

    with monkeypatch.context() as patch:  # kept in the run folder
        patch.setattr(Case, "simulate", never)
        assert command(*RUN, "--reference-trials", "2", "--out", folder) == 0
        assert line in capsys.readouterr().out.splitlines()
    settings = runs.read_run(folder)[1]
    assert reference.number_of_trials(None, settings) == 0  # MuJoCo C would take minutes
    quick = dataclasses.replace(settings, engine="structured")
    assert reference.number_of_trials(None, quick) == 24
    assert reference.number_of_trials(None, dataclasses.replace(quick, test_trials=0)) == 0


def test_more_episodes_extend_a_run_bit_for_bit(finished, tmp_path, capsys):
    run, long, grown = RUN, tmp_path / "long", tmp_path / "grown"
    assert command(*run, "--episodes", "5", "--out", long) == 0
    shutil.copytree(finished, grown)
    assert command(*run, "--episodes", "5", "--out", grown) == 0
    assert "extended from 3 to 5 episodes" in capsys.readouterr().out
    assert_same_run(grown, long)
    provenance = json.loads((grown / "provenance.json").read_text())
    assert provenance["settings"]["episodes"] == 5
    ((step, command_line),) = [(e, e.pop("command")) for e in provenance["extended"]]
    assert (step["from"], step["to"]) == (3, 5) and command_line
    before = snapshot(grown)
    assert command(*run, "--episodes", "4", "--out", grown) == 2
    error = capsys.readouterr().err
    assert "can be extended, but not shortened; leave out --episodes" in error
    assert "--fresh" not in error and snapshot(grown) == before
    # Without --episodes the command goes on with the run, whatever it was extended to.
    assert command(*without(run, "--episodes"), "--out", grown) == 0
    assert "all 5 episodes are done" in capsys.readouterr().out
    assert_same_run(grown, long)


@pytest.mark.slow  # quick: every optimiser by the library (test_optimizers), a filter by commands
def test_the_default_search_goes_on_and_a_run_keeps_its_optimiser(finished, tmp_path, capsys):
    usual = without([*RUN], "--optimizer")
    run = [*usual, "--particles", "8"]
    long, grown = tmp_path / "long", tmp_path / "grown"
    assert command(*run, "--episodes", "7", "--out", long) == 0
    assert "seed" not in capsys.readouterr().out, "it looks for its start by itself"
    for episodes in ("2", "7"):  # within the random designs, and after them
        assert command(*run, "--episodes", episodes, "--out", grown) == 0
    assert_same_run(grown, long)
    assert runs.read_run(grown)[1].optimizer == "screened-es"
    # The design that was found was simulated in an episode, whose grasp can be shown.
    scene, record = runs.read_run(grown)[0], choice.read_record(grown)
    chosen, grasp = choice.choose(scene, record), choice.find_grasp(scene, record)
    np.testing.assert_array_equal(grasp.design, chosen.design)
    copy = shutil.copytree(finished, tmp_path / "filter")
    assert command(*usual, "--out", copy) == 0
    assert f"all {EPISODES} episodes are done" in capsys.readouterr().out
    assert runs.read_run(copy)[1].optimizer == "particle-filter"
