"""Runs and their folders: they resume and extend bit for bit; several go side by side."""

import contextlib
import csv
import dataclasses
import fcntl
import io
import json
import os
import shlex
import shutil
import signal

import jax
import numpy as np
import pytest

from codesign_jax import array_files, codesign, rollout, runs, scene
from codesign_jax.commands import grasp
from codesign_jax.commands.flags import GraspFlags
from codesign_jax.engines import make_engine
from codesign_jax.interrupts import Interrupts
from codesign_jax.judge import fresh_trials, verdict
from codesign_jax.judge.cases import Case
from codesign_jax.runs import reference
from codesign_jax.runs.checkpoint import Checkpoints
from codesign_jax.scene.parameters import design_space
from codesign_jax.types import Outcome
from tests.helpers.command_runs import (  # noqa: F401
    EPISODES,
    RESULTS,
    RUN,
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
from tests.helpers.refusals import refusal_of_command
from tests.helpers.toy_engine import TINY


def test_same_command_again_changes_no_result(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "copy")
    left = folder / "trials.csv.4711.tmp"  # of a process that was killed while it wrote
    left.write_text("half")
    assert command(*RUN, "--out", folder) == 0
    assert not left.exists()
    assert f"all {EPISODES} episodes are done" in capsys.readouterr().out
    assert_same_run(folder, finished)


def test_a_killed_run_resumes_bit_for_bit(long, tmp_path, capsys):
    """Signals within this process: test_runs_of_a_batch_stop_fail_and_go_on_by_themselves."""
    folder = tmp_path / "run"
    process = launch(*LONG, "--out", folder)
    wait_for(folder / "events.log", "episode  2/", process)
    process.kill()
    output, _ = process.communicate()
    assert process.returncode == -signal.SIGKILL, output
    done = runs.load_record(folder)
    assert done is not None and 2 <= done.done < 10, "it was to stop on the way"
    assert command(*LONG, "--out", folder) == 0
    assert f"resuming episode {done.done + 1}/10" in capsys.readouterr().out
    assert_same_run(folder, long)


LONG = [*RUN, "--episodes", "10"]
"""Enough episodes that a signal after the second finds the run on its way."""


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """A run of ten episodes, which nothing interrupted."""
    folder = tmp_path_factory.mktemp("long") / "run"
    assert command(*LONG, "--out", folder) == 0
    return folder


@pytest.mark.parametrize("lost", ["*.sha256", "folder"])
def test_losing_every_checkpoint_is_refused_until_fresh(lost, finished, tmp_path, capsys):
    """The tables are the last that is left of the results, and a start would replace them."""
    folder = shutil.copytree(finished, tmp_path / "run")
    if lost == "folder":
        shutil.rmtree(folder / "checkpoints")
    for path in (folder / "checkpoints").glob(lost):
        path.unlink()
    before = {name: (folder / name).read_bytes() for name in RESULTS}
    if lost == "folder":
        assert refusal_of_command(*RUN, "--out", folder) == [("damaged", f"run {folder}")]
    else:
        assert command(*RUN, "--out", folder) == 1
        assert capsys.readouterr().err.count("sha256") == 3
    assert before == {name: (folder / name).read_bytes() for name in RESULTS}
    if lost == "*.sha256":
        assert (folder / "checkpoints" / "3").is_dir()
        assert command(*RUN, "--out", folder, "--fresh") == 0
        assert_same_run(folder, finished)


def test_resume_with_other_settings_is_refused(finished, capsys):
    path = finished / "provenance.json"  # as of a run that the command began
    content = json.loads(path.read_text())
    content["started"]["command"] = ["/usr/bin/codesign", *RUN, "--out", "my runs"]
    path.write_text(json.dumps(content))
    before = snapshot(finished)
    other = ["--particles", "5", "--schedule", "switch-2"]
    problems = refusal_of_command(*RUN, "--out", finished, *other)
    keys = [f"--out {finished}", "", "--particles", "--schedule"]
    assert sorted(problems) == sorted(("conflict", key) for key in keys)
    assert shlex.join(["codesign", *RUN, "--out", "my runs"]) in capsys.readouterr().err
    assert snapshot(finished) == before


def test_second_process_on_a_folder_is_refused(finished, capsys):
    holder = (finished / ".lock").read_text().strip()  # who made the run: maybe another worker
    before = snapshot(finished)
    with (finished / ".lock").open("r+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert refusal_of_command(*RUN, "--out", finished) == [("file", f"--out {finished}")]
    assert holder in capsys.readouterr().err
    assert snapshot(finished) == before


@pytest.mark.slow  # 10 s; quick: kept results are read (test_attacks), shown (test_report), judged
def test_the_best_particle_meets_fresh_trials_at_reference(finished, tmp_path, monkeypatch, capsys):
    """And grasps of other conditions, which are told, kept and reported.

    At five times the steps and three times the links: with 20 times MuJoCo C takes long.
    """
    monkeypatch.setattr(fresh_trials, "ACCURACY", "fine")
    folder = shutil.copytree(finished, tmp_path / "run")
    assert command(*RUN, "--reference-trials", "2", "--out", folder) == 0
    settings = runs.read_run(folder)[1]
    text = capsys.readouterr().out
    stress, _ = reference.read_stress(folder, reference.tested(folder, settings)[1])
    assert stress is not None
    assert [*dict.fromkeys(stress.conditions)][-1] == "neo-Hookean bending law"
    assert f"; {stress.limits}" in text
    for words in ("under other conditions, 12 grasps each", *stress.lines()):
        assert " ".join(words.split()) in " ".join(text.split())
    other = dataclasses.replace(settings, seed=settings.seed + 1)
    assert reference.read_stress(folder, reference.tested(folder, other)[1])[0] is None
    assert command("report", folder, "--no-replay") == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "12 grasps each" in page and "neo-Hookean bending law" in page
    lines = text.splitlines()
    line = next(x for x in lines if x.startswith("verdict: "))
    assert "of 2 fresh grasps" in line
    assert any("accuracy fine, steps of 5 ms, 10 links a finger" in x for x in lines)

    def never(*arguments):
        raise AssertionError("simulated again")

    with monkeypatch.context() as patch:  # kept in the run folder
        patch.setattr(Case, "simulate", never)
        assert command(*RUN, "--reference-trials", "2", "--out", folder) == 0
        assert line in capsys.readouterr().out.splitlines()
    # A longer test goes on from what is there, and a shorter one takes it.
    two = reference.stored(folder, settings)[0]
    more = []

    def simulate(case, trials, key, first=0):
        more.append((first, trials))
        return jax.tree.map(lambda v: np.repeat(v[:1], trials), two)

    with monkeypatch.context() as patch:
        patch.setattr(Case, "simulate", simulate)
        assert command(*RUN, "--reference-trials", "5", "--out", folder) == 0
        assert command(*RUN, "--reference-trials", "3", "--out", folder) == 0
    assert more == [(2, 5)]
    five = reference.stored(folder, settings)[0]
    np.testing.assert_array_equal(five.cost, [*two.cost, *[two.cost[0]] * 3])
    assert len((folder / "reference.csv").read_text().splitlines()) == 6
    # Of another version of the code they are shown as such, and not gone on from.
    with monkeypatch.context() as patch:
        patch.setattr(array_files.reuse, "code_digest", lambda: "another")
        reloaded, why = reference.stored(folder, settings)
        assert reloaded.cost.size == 5 and why == "is of another version of the code"
        capsys.readouterr()
        assert command("report", folder, "--no-replay") == 0
        assert command("compare", folder) == 0
        output = capsys.readouterr()
        assert output.err.count("reference.npz is of another version of the code") == 2
        assert "fine" in output.out


def test_the_engine_decides_how_many_fresh_trials_there_are(finished):
    settings = runs.read_run(finished)[1]
    assert reference.most_trials(None, settings) == 0  # MuJoCo C would take minutes
    quick = dataclasses.replace(settings, engine="structured")
    assert reference.most_trials(None, quick) == 600
    assert reference.most_trials(None, dataclasses.replace(quick, test_trials=0)) == 0


def test_more_episodes_extend_a_run_bit_for_bit(long, finished, tmp_path, capsys):
    run = RUN
    grown = tmp_path / "grown"
    shutil.copytree(finished, grown)
    assert command(*LONG, "--out", grown) == 0
    assert "extended from 3 to 10 episodes" in capsys.readouterr().out
    assert_same_run(grown, long)
    provenance = json.loads((grown / "provenance.json").read_text())
    assert provenance["settings"]["episodes"] == 10
    ((step, command_line),) = [(e, e.pop("command")) for e in provenance["extended"]]
    assert (step["from"], step["to"]) == (3, 10) and command_line
    before = snapshot(grown)
    problems = refusal_of_command(*run, "--episodes", "4", "--out", grown)
    assert problems == [("conflict", f"--out {grown}")]
    assert "--fresh" not in capsys.readouterr().err and snapshot(grown) == before
    # Without --episodes the command goes on with the run, whatever it was extended to.
    assert command(*without(run, "--episodes"), "--out", grown) == 0
    assert "all 10 episodes are done" in capsys.readouterr().out
    assert_same_run(grown, long)


def test_a_run_keeps_its_optimiser(finished, tmp_path, capsys):
    copy = shutil.copytree(finished, tmp_path / "filter")
    assert command(*without([*RUN], "--optimizer"), "--out", copy) == 0
    assert f"all {EPISODES} episodes are done" in capsys.readouterr().out
    assert runs.read_run(copy)[1].optimizer == "particle-filter"


# --- many runs of one command: in one batch, and how they end ------------------------------------


BASE = without(RUN, "--seed")


THREE = [*BASE, "--episodes", "3", "--seeds", "3-5"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Folder of three seeds in one batch, and what was printed."""
    folder = tmp_path_factory.mktemp("compared") / "seeds"
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        assert command(*THREE, "--out", folder) == 0
    return folder, text.getvalue()


def test_seeds_are_compared(compared):
    folder, output = compared
    assert "  3 runs  mean" in output
    assert len({stored(folder / f"seed-{seed}") for seed in (3, 4, 5)}) == 3
    table = output[output.rindex("judged by") :]
    rows = [line for line in table.splitlines() if "final test" in line]
    assert [row.split()[0] for row in rows] == ["3", "4", "5"]
    assert "of 3 runs found a good design" in table and "Wald's sequential test" in table
    assert "; for objects of " in table
    assert "% of such runs (95 % interval)" in table
    rows = [*csv.DictReader((folder / "seeds.csv").read_text().splitlines())]
    names = ("seed", "schedule", "first", "finished", "run")
    assert [tuple(row[name] for name in names) for row in rows] == [
        ("3", "concurrent", "morphology", "1", "seed-3"),
        ("4", "concurrent", "morphology", "1", "seed-4"),
        ("5", "concurrent", "morphology", "1", "seed-5"),
    ]
    for row in rows:
        tests = csv.DictReader((folder / row["run"] / "tests.csv").read_text().splitlines())
        best = min(tests, key=lambda r: float(r["test_cost"]))
        assert row["best_test_cost"] == best["test_cost"] and row["trials"] == best["trials"]
        assert int(row["paper_successes"]) <= int(row["particles"]) and row["verdict"]


def test_runs_of_a_batch_stop_fail_and_go_on_by_themselves(compared, tmp_path, monkeypatch, capsys):
    """A signal, a disk that is full for one of them, and runs that are at other episodes."""
    runs_folder = tmp_path / "runs"
    run = THREE
    assert command(*RUN, "--episodes", "1", "--out", runs_folder / "seed-3") == 0
    save = Checkpoints.save
    begin = Interrupts.begin
    episodes = []

    def interrupted(interrupts, function, *arguments):
        if arguments and np.any(arguments[1]):  # an episode that moves something
            episodes.append(function)
            if len(episodes) == 2:  # the first was compiled
                os.kill(os.getpid(), signal.SIGTERM)
                interrupts.signum = 0  # it arrives when this one is under way
                waiting = begin(interrupts, function, *arguments)
                interrupts.signum = signal.SIGTERM
                return waiting
        return begin(interrupts, function, *arguments)

    def full(store, step, arrays):
        if store.folder.parent.name == "seed-5" and step == 2:
            raise OSError("no space left")
        save(store, step, arrays)

    monkeypatch.setattr(Interrupts, "begin", interrupted)
    assert command(*run, "--out", runs_folder) == 128 + signal.SIGTERM
    monkeypatch.setattr(Interrupts, "begin", begin)
    assert "seed 3: extended from 1 to 3 episodes" in capsys.readouterr().out
    records = [runs.load_record(runs_folder / f"seed-{seed}") for seed in (3, 4, 5)]
    assert [record.done for record in records] == [1, 1, 1]  # seed 3 has waited for the others
    monkeypatch.setattr(Checkpoints, "save", full)
    assert command(*run, "--out", runs_folder) == 1
    output = capsys.readouterr()
    assert "error: seed 5: no space left" in output.err
    assert "resuming episode 2/3" in output.out and "of 2 runs found a good design" in output.out
    monkeypatch.setattr(Checkpoints, "save", save)
    assert command(*run, "--out", runs_folder) == 0
    assert "of 3 runs found a good design" in capsys.readouterr().out
    assert_same_run(runs_folder / "seed-4", compared[0] / "seed-4")


COARSE = """description = "coarse"
[discretization]
timestep = 0.025
links = 2
[solver]
[newton]
"""


FASTEST = """def fastest(scene, trace, ctrl):
    return trace.speed.max()
"""


def simulates(the_scene):
    """A function from designs and a root key to costs `FASTEST` in its first trials, by MuJoCo C.

    The cost tells accuracies apart: objects of the tiny scene are lost at once at either.
    """
    names: dict = {}
    exec(FASTEST, names)
    engine = make_engine("mujoco", the_scene)
    space = design_space(the_scene.hand, "2d")

    @jax.jit
    def run(designs, key):
        trials = codesign.episode_trials(the_scene, key, 0, 3)
        worlds = rollout.crossed(the_scene, jax.vmap(space.params)(designs), trials)
        options = {"record_qpos": True, "cost": names["fastest"]}
        return rollout.simulate(worlds[0], engine, *worlds[1:], **options)[0].cost.reshape(-1, 3)

    return lambda designs, key: np.asarray(run(np.asarray(designs, np.float32), key))


def test_a_search_has_its_own_accuracy_and_its_test_that_of_the_scene(tmp_path, workplace, capsys):
    """Costs of episodes and test are those of grasps that are simulated apart, at each accuracy."""
    coarse = tmp_path / "coarse.toml"
    coarse.write_text(COARSE)
    (workplace / "own.py").write_text(FASTEST)
    folder = tmp_path / "run"
    run = [*RUN, "--search-accuracy", coarse, "--cost", "own:fastest", "--out", folder]
    assert command(*run) == 0
    output = capsys.readouterr().out
    settings = runs.read_run(folder)[1]
    assert settings.search_accuracy == str(coarse)
    searched = runs.read_search_scene(folder)
    usual = runs.read_run(folder)[0]
    assert searched == scene.load(TINY, accuracy=coarse) != usual
    record = runs.load_record(folder)
    history = record.history
    key = jax.random.key(settings.seed)
    at_search, at_test = simulates(searched), simulates(usual)
    # Batches of other sizes round differently; the accuracies differ by a third.
    close = {"rtol": 1e-2}
    np.testing.assert_allclose(
        history.outcomes.cost[0], at_search(history.population[0], key), **close
    )
    # Two rounds of three trials; no trial of the last episode, which had the other accuracy.
    assert record.test.cost.shape == record.searched.cost.shape == (4, 6)
    arguments = record.state.particles, codesign.test_key(key, 1)
    costs = at_search(*arguments), at_test(*arguments)
    assert not np.allclose(*costs, **close)
    np.testing.assert_allclose(record.searched.cost[:, 3:], costs[0], **close)
    np.testing.assert_allclose(record.test.cost[:, 3:], costs[1], **close)
    rows = csv.DictReader((folder / "tests.csv").read_text().splitlines())
    kept = [int(row["search_kept_trials"]) for row in rows]
    assert kept == verdict.kept(record.searched).sum(1).tolist()
    assert record.retest.sentence(str(coarse)) in output
    assert f"search at accuracy {coarse} (time step 25 ms, 2 links)" in report_of(folder)
    # A grasp that its numbers name is repeated at the accuracy that it had.
    options = GraspFlags(run_folder=folder, episode=2, particle=1, trial=2)
    assert grasp.find(options).case.scene == searched
    assert grasp.find(GraspFlags(run_folder=folder)).case.scene == usual
    before = snapshot(folder)
    coarse.write_text(COARSE.replace("0.025", "0.030"))
    one_accuracy = without(run, "--search-accuracy")
    conflict = ("conflict", "--search-accuracy")
    assert conflict in refusal_of_command(*one_accuracy)
    assert "-timestep = 0.03" not in capsys.readouterr().err
    assert refusal_of_command(*run)  # the file has another step
    assert "-timestep = 0.025" in capsys.readouterr().err
    assert conflict in refusal_of_command(*run, "--fresh", "--test-trials", "0")
    unknown = refusal_of_command(*run, "--search-accuracy", "quick")
    assert unknown == [("unknown", "--search-accuracy")]
    assert snapshot(folder) == before


def report_of(folder):
    assert command("report", folder, "--no-replay") == 0
    return (folder / "report.html").read_text()


def test_finalists_that_the_accuracy_of_the_search_alone_likes_are_counted():
    """Of 48 trials at both: 48 and 40 (p = 0.008), 46 and 45, 40 and 20; copies count once."""

    def outcomes(*kept):
        lost_time = np.where(np.arange(48) < np.array(kept)[:, None], np.inf, 5.0)
        zeros = np.zeros((len(kept), 48), int)
        return Outcome(zeros, zeros, lost_time, zeros - 1)

    particles = np.array([[1.0], [2.0], [3.0], [1.0]])
    counted = fresh_trials.retest(particles, outcomes(40, 45, 20, 40), outcomes(48, 46, 40, 48))
    assert counted == (1, 3)
