"""The command line: errors create nothing, runs resume bit for bit, whatever ended them."""

import contextlib
import dataclasses
import fcntl
import io
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from toy import TINY

from codesign_jax import cli, codesign, runs, scene
from codesign_jax.batch import Batch
from codesign_jax.commands import jobs, preflight, reference, status, verdicts
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.runs import choice, columns
from codesign_jax.runs.checkpoint import Checkpoints, digest
from codesign_jax.runs.record import to_arrays
from codesign_jax.scene import effects
from codesign_jax.types import Outcome, Status

EPISODES = 14  # enough that a signal after the third finds the run on its way
RUN = [
    *("optimize", "--scene", str(TINY), "--seed", "3", "--engine", "mujoco"),
    *("--particles", "4", "--trials", "2", "--episodes", str(EPISODES), "--test-trials", "4"),
]
RESULTS = ("episodes.csv", "particles.csv", "trials.csv", "tests.csv")


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    """An empty working directory, and a compilation cache that is not the user's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def command(*arguments):
    """Exit status of the command."""
    try:
        return cli.main([str(a) for a in arguments])
    except SystemExit as stop:  # how the parser refuses
        return stop.code


def launch(*arguments):
    """Starts the command in a process of its own."""
    program = [sys.executable, "-m", "codesign_jax.cli", *map(str, arguments)]
    return subprocess.Popen(
        program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=os.getcwd()
    )


def wait_for(path, text, process):
    """Waits until a file holds a text; fails if the process ends before."""
    while not (path.exists() and text in path.read_text()):
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.02)


def snapshot(folder):
    """Names and bytes of all files in a folder, but the lock's owner and times of day."""
    return {
        p.relative_to(folder): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != ".lock"
    }


def stored(folder):
    """Digest of the newest checkpoint: every array, bit for bit."""
    record = runs.load_record(folder)
    assert record is not None
    return digest(to_arrays(record))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that nothing interrupted; copy it to change it."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    assert command(*RUN, "--out", folder) == 0
    return folder


def assert_same_run(folder, finished):
    assert stored(folder) == stored(finished)
    for name in RESULTS:
        assert (folder / name).read_bytes() == (finished / name).read_bytes(), name


def test_help_imports_nothing_heavy():
    program = """
import sys, typing
from codesign_jax import cli
names = [command.__name__.lower() for command in typing.get_args(cli.COMMANDS)]
for arguments in (["--help"], *([name, "--help"] for name in names)):
    try:
        cli.main(arguments)
    except SystemExit as stop:
        assert stop.code == 0
heavy = {"jax", "numpy", "mujoco", "orbax", "matplotlib"} & set(sys.modules)
assert not heavy, heavy
"""
    subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.DEVNULL)


def test_run_folder_is_complete(finished):
    names = {p.name for p in finished.iterdir()}
    assert names >= {*RESULTS, "scene.toml", "hand.toml", "objects.toml", "provenance.json"}
    assert names >= {"checkpoints", "events.log", "figures"}
    assert names <= {*columns.FILES, *columns.TABLES, ".lock"}, "a file that docs/files.md lacks"
    assert not list(finished.rglob("*.tmp"))
    provenance = json.loads((finished / "provenance.json").read_text())
    assert provenance["settings"]["seed"] == 3
    assert set(provenance["environment"]["versions"]) >= {"jax", "mujoco", "codesign-jax"}
    assert len((finished / "episodes.csv").read_text().splitlines()) == EPISODES + 1


def test_another_hand_compiles_nothing(finished, tmp_path):
    """Neither a run nor an evaluation, once a hand of the same structure was simulated."""
    text = (TINY.parent / "pinch.toml").read_text()
    softer = text.replace("56e3", "53e3").replace("density = 1070.0", "density = 1100.0")
    (tmp_path / "softer.toml").write_text(softer)
    run = [*RUN, "--episodes", "2", "--out", tmp_path / "run"]
    evaluate = ["evaluate", "--scene", TINY, "--engine", "mujoco", "--trials", "1"]
    assert command(*evaluate) == 0
    compiled = []

    def listen(event, seconds, **details):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(details)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for arguments in (run, evaluate):
            assert command(*arguments, "--hand", tmp_path / "softer.toml") == 0
        assert not compiled
        # What the count would have seen of any other program.
        jax.jit(lambda x: x + len(compiled))(np.ones(3))
        assert compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert stored(tmp_path / "run") != stored(finished)


def test_same_command_again_changes_no_result(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "copy")
    left = folder / "trials.csv.4711.tmp"  # of a process that was killed while it wrote
    left.write_text("half")
    assert command(*RUN, "--out", folder) == 0
    assert not left.exists()
    assert f"all {EPISODES} episodes are done" in capsys.readouterr().out
    assert_same_run(folder, finished)


@pytest.mark.parametrize(
    ("number", "status"),
    [
        (signal.SIGKILL, -signal.SIGKILL),
        # Within this process: test_runs_of_a_batch_stop_fail_and_go_on_by_themselves.
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
    ],
)
def test_interrupted_run_resumes_bit_for_bit(number, status, finished, tmp_path, capsys):
    folder = tmp_path / "run"
    process = launch(*RUN, "--out", folder)
    wait_for(folder / "events.log", "episode  3/", process)
    process.send_signal(number)
    output, _ = process.communicate()
    assert process.returncode == status, output
    done = runs.load_record(folder)
    assert done is not None and 3 <= done.done < EPISODES, "it was to stop on the way"
    assert command(*RUN, "--out", folder) == 0
    assert f"resuming episode {done.done + 1}/{EPISODES}" in capsys.readouterr().out
    assert_same_run(folder, finished)


@pytest.mark.slow
def test_run_killed_again_and_again_resumes_bit_for_bit(tmp_path):
    run, folder, kills = [*RUN, "--episodes", "40"], tmp_path / "run", 0
    assert command(*run, "--out", tmp_path / "whole") == 0
    while True:
        process = launch(*run, "--out", folder)
        before = len(list((folder / "checkpoints").glob("*.sha256"))) if folder.exists() else 0
        try:
            # Any moment of start, compile, seed, episode or save, a little later each time.
            process.wait(timeout=2.0 + 0.37 * kills)
        except subprocess.TimeoutExpired:
            process.kill()
            kills += 1
        process.communicate()
        if process.returncode == 0:
            break
        assert process.returncode == -signal.SIGKILL, before
    assert kills > 5
    assert_same_run(folder, tmp_path / "whole")


@pytest.mark.parametrize("damage", ["flip", "truncate"])
def test_damaged_checkpoint_is_said_and_the_older_one_used(damage, finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")
    newest = EPISODES + 1  # the final test
    largest = max(
        (folder / "checkpoints" / str(newest)).rglob("d/*"), key=lambda p: p.stat().st_size
    )
    content = bytearray(largest.read_bytes())
    content[len(content) // 2] ^= 1
    largest.write_bytes(content if damage == "flip" else content[: len(content) // 2])
    assert command(*RUN, "--out", folder) == 0
    assert f"checkpoint {newest} is lost" in capsys.readouterr().out
    assert f"checkpoint {newest} is lost" in (folder / "events.log").read_text()
    assert_same_run(folder, finished)


def test_losing_every_checkpoint_starts_anew(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")
    for path in (folder / "checkpoints").glob("*.sha256"):
        path.unlink()
    assert command(*RUN, "--out", folder) == 0
    assert capsys.readouterr().out.count("is lost") == 3
    assert_same_run(folder, finished)


def test_resume_with_another_scene_is_refused_with_a_diff(finished, capsys):
    before = snapshot(finished)
    assert command(*RUN, "--out", finished, "--set", "gravity=9.7") == 2
    error = capsys.readouterr().err
    assert "-gravity = 9.81  # m/s^2" in error and "+gravity = 9.7  # m/s^2" in error
    assert snapshot(finished) == before


def test_resume_with_other_settings_is_refused(finished, capsys):
    before = snapshot(finished)
    assert command(*RUN, "--out", finished, "--particles", "5", "--schedule", "switch-2") == 2
    error = capsys.readouterr().err
    assert "particles: the run has 4, asked for is 5" in error
    assert "schedule: the run has 'concurrent', asked for is 'switch-2'" in error
    assert snapshot(finished) == before


def test_other_versions_resume_and_say_so(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")
    path = folder / "provenance.json"
    path.write_text(path.read_text().replace('"mujoco": "', '"mujoco": "0.'))
    assert command(*RUN, "--out", folder) == 0
    assert "not bitwise comparable" in capsys.readouterr().out


def test_second_process_on_a_folder_is_refused(finished, capsys):
    before = snapshot(finished)
    with (finished / ".lock").open("r+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert command(*RUN, "--out", finished) == 2
    assert f"is in use by process {os.getpid()}" in capsys.readouterr().err
    assert snapshot(finished) == before


def test_folder_with_other_files_is_refused(workplace, capsys):
    (workplace / "thesis.tex").write_text("years of work")
    assert command(*RUN, "--out", workplace, "--fresh") == 2
    assert "thesis.tex" in capsys.readouterr().err
    assert [p.name for p in workplace.iterdir()] == ["thesis.tex"]


def test_fresh_starts_anew(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")
    few = [*RUN, "--episodes", "2", "--test-trials", "0", "--out", folder]
    assert command(*few) == 2, "other settings need --fresh"
    assert command(*few, "--fresh") == 0
    assert "episode 1/2" in capsys.readouterr().out
    assert len((folder / "episodes.csv").read_text().splitlines()) == 3
    assert not (folder / "tests.csv").exists()


def test_the_best_particle_meets_fresh_trials_at_reference(finished, tmp_path, monkeypatch, capsys):
    """Here shortened to a few coarse steps, as everything else of the run is."""
    folder = shutil.copytree(finished, tmp_path / "run")
    assert command(*RUN, "--reference-trials", "2", "--out", folder) == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("on 2 fresh"))
    assert "accuracy reference (1 ms, 20 links): mean cost" in line and "95 % interval" in line

    def never(*arguments):
        raise AssertionError("simulated again")

    with monkeypatch.context() as patch:  # kept in the run folder
        patch.setattr(codesign, "make_evaluate", never)
        assert command(*RUN, "--reference-trials", "2", "--out", folder) == 0
        assert line in capsys.readouterr().out.splitlines()
        with pytest.raises(AssertionError, match="simulated again"):
            command(*RUN, "--reference-trials", "3", "--out", folder)
    settings = runs.read_run(folder)[1]
    assert reference.number_of_trials(None, settings) == 0  # MuJoCo C would take minutes
    quick = dataclasses.replace(settings, engine="structured")
    assert reference.number_of_trials(None, quick) == 24
    assert reference.number_of_trials(None, dataclasses.replace(quick, test_trials=0)) == 0


WRONG = {
    "wrong reference trials": (["--reference-trials", "-1"], ["--reference-trials = -1 is outs"]),
    "unknown hand": (["--hand", "pneuflex5"], ["did you mean 'pneuflex4'?"]),
    "no hand file": (["--hand", "no.toml"], ["no file 'no.toml'"]),
    "unknown scene": (["--scene", "papr"], ["did you mean 'paper'?"]),
    "unknown preset": (["--preset", "3d"], ["preset '3d' unknown", "did you mean '2"]),
    "unknown schedule": (["--schedule", "concurent"], ["did you mean 'concurrent'?"]),
    "too many switches": (["--schedule", "switch-64"], ["--schedule", "65 episodes"]),
    "unknown engine": (["--engine", "mujco"], ["--engine", "did you mean 'mujoco'?"]),
    "unknown optimizer": (["--optimizer", "cmaes"], ["--optimizer", "did you mean 'cma-es'?"]),
    "nothing to rank": (
        ["--optimizer", "cma-es", "--particles", "1"],
        ["--optimizer: cma-es ranks its particles: it needs at least 2, got 1"],
    ),
    "out of range": (["--particles", "0"], ["--particles = 0 is outside [1, 32768]"]),
    "wrong type of a flag": (["--particles", "ten"], ["ten"]),
    "unknown flag": (["--particle", "10"], ["--particle"]),
    "unknown key": (
        ["--set", "discretization.timestp=0.01"],
        ["discretization.timestp is not a known key", "did you mean 'discretization.timestep'?"],
    ),
    "unit slip": (
        ["--set", "discretization.timestep=18"],
        ["discretization.timestep = 18 is outside [1e-05, 0.05] s", "did you mean 0.018?"],
    ),
    "wrong type of a value": (
        ["--set", "discretization.links=3.5", "gravity='low'"],
        [
            "discretization.links = 3.5 must be a whole number in [1, 200]",
            "gravity = 'low' must be a number in [0, 100] m/s^2",
        ],
    ),
    "not a number": (["--set", "gravity=nan"], ["gravity = nan is outside [0, 100] m/s^2"]),
    "key of a value": (["--set", "name.x=1"], ["name = 'paper' is no table: it has no key 'x'"]),
    "key of another file": (
        ["--set", "hand.section.width=18", "--set", "objects.nois.position=0.01"],
        [
            "hand.section.width = 18 is outside [0.005, 0.1] m",
            "objects.nois is not a known key; did you mean 'objects.noise'?",
        ],
    ),
    "parameters of no jobs": (
        ["--job-set", "slurm_partition=gpu", "cpus_per_task"],
        ["--job-set needs --jobs", "--job-set 'cpus_per_task' must be KEY=VALUE"],
    ),
    "seeds that are none": (["--seeds", "0-"], ["--seeds '0-' must be seeds such as 0-9 or 1,3,5"]),
    "seeds backwards": (["--seeds", "9-0"], ["must be seeds such as"]),
    "too many seeds": (["--seeds", "0-99999"], ["names more than 1000 runs"]),
    "hosts without seeds": (
        ["--distributed", "auto"],
        ["--distributed needs --seeds"],
    ),
    "hosts and jobs": (
        ["--seeds", "0-1", "--distributed", "auto", "--jobs", "2"],
        ["error: --distributed and --jobs exclude each other"],
    ),
    "a preset of too many": (["--preset", "24d"], ["did you mean '23d'?"]),
    "hosts that are none": (
        ["--seeds", "0-1", "--distributed", "node0:1234,2,2"],
        ["'node0:1234,2,2' must be auto or ADDRESS:PORT,PROCESSES,INDEX, such as"],
    ),
    "seed and seeds": (["--seeds", "0-1", "--seed", "1"], ["--seed and --seeds exclude"]),
    "MuJoCo's solver": (
        ["--set", "solver.tolerance=1e-9", "--set", "gravity=1000"],
        ["engine structured: --set solver.tolerance=1e-09", "newton.decrement", "gravity = 1000"],
    ),
    "no value": (["--set", "gravity"], ["--set 'gravity' must be KEY=VALUE"]),
    "all at once": (
        [
            *("--hand", "pneuflex5", "--engine", "mujco", "--seed", "-1"),
            *("--set", "gravity=1000", "cost.failur=worst"),
        ],
        ["pneuflex4", "mujoco", "--seed = -1", "gravity = 1000", "did you mean 'cost.failure'?"],
    ),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("dry", [[], ["--dry-run"]], ids=["run", "dry"])
def test_wrong_input_exits_2_and_creates_nothing(case, dry, workplace, capsys):
    arguments, parts = WRONG[case]
    assert command("optimize", *arguments, *dry) == 2
    captured = capsys.readouterr()
    for part in parts:
        assert part in captured.err + captured.out
    assert list(workplace.iterdir()) == []


def test_wrong_hand_file_reports_every_problem(tmp_path, workplace, capsys):
    text = (TINY.parent / "pinch.toml").read_text()
    text = text.replace("width = 0.020", "width = 18").replace("density = 1070.0", "densty = 1070")
    bad = tmp_path / "bad.toml"
    bad.write_text(text.replace("azimuth = 180.0", 'azimuth = "back"'))
    assert command("optimize", "--hand", bad) == 2
    error = capsys.readouterr().err
    assert "bad.toml.section.width = 18 is outside [0.005, 0.1] m; did you mean 0.018?" in error
    assert "bad.toml.material.densty is not a known key; did you mean 'density'?" in error
    assert "bad.toml.material.density is missing (unit kg/m^3)" in error
    assert "bad.toml.finger[1].azimuth = 'back' must be a number in [-360, 360] deg" in error
    assert list(workplace.iterdir()) == []


def test_dry_run_writes_nothing(workplace, capsys):
    assert command(*RUN, "--out", "run", "--dry-run") == 0
    output = capsys.readouterr().out
    assert "timestep = 0.02  # s" in output and f"grasps: {EPISODES * 8 + 16}" in output
    assert "MB" in output and "time: about" in output
    assert "grasps/s (measured on another machine, docs/performance.md" in output
    assert list(workplace.iterdir()) == []


def test_dry_run_estimates_from_earlier_runs_and_simulates_nothing(workplace, monkeypatch, capsys):
    short = [*RUN, "--episodes", "2", "--test-trials", "0"]
    assert command(*short, "--out", "run") == 0

    def never(*arguments):
        raise AssertionError("something was simulated")

    monkeypatch.setattr(MujocoEngine, "rollout", never)
    capsys.readouterr()
    assert command(*RUN, "--out", "other", "--dry-run") == 0
    output = capsys.readouterr().out
    assert "grasps/s (measured on this machine on" in output and "scaled" not in output
    assert "60 steps, 6 links, 8 grasps at once" in output


def test_conflicts_are_told_before_the_preflight(finished, monkeypatch, capsys):
    def never(*arguments):
        raise AssertionError("the preflight ran")

    monkeypatch.setattr(preflight, "check", never)
    assert command(*RUN, "--out", finished, "--particles", "5", "--dry-run") == 2
    assert "particles: the run has 4, asked for is 5" in capsys.readouterr().err
    hull = ["--set", "effects.surface=hull"]
    for arguments in ([*RUN, *hull], ["evaluate", "--scene", TINY, "--engine", "mujoco", *hull]):
        assert command(*arguments) == 2
        assert "not supported by engine mujoco" in capsys.readouterr().err


def test_evaluate_prints_costs_of_each_object(capsys):
    design = ["length=100", "arm_z=-20"]  # by the default engine, the only such evaluation here
    assert command("evaluate", "--scene", TINY, "--design", *design, "--trials", "3") == 0
    output = capsys.readouterr().out
    assert "design: length=100 mm arm_z=-20 mm" in output
    assert "sphere: mean cost" in output and "over 3 trials" in output and "success" in output


def test_evaluate_takes_the_best_of_a_run(finished, capsys):
    rows = [line.split(",") for line in (finished / "tests.csv").read_text().splitlines()[1:]]
    best = min(rows, key=lambda row: float(row[1]))
    assert command("evaluate", "--run", finished, "--trials", "1") == 0
    output = capsys.readouterr().out
    assert f"length={float(best[-2]):.4g} mm" in output
    assert "over 1 trial" in output and "% of grasps (95 % interval)" in output


def test_evaluate_judges_a_run_on_other_objects_and_settings(finished, tmp_path, capsys):
    box = TINY.parent / "box.toml"
    changes = ["--objects", box, "--accuracy", "fast", "--set", "objects.object.box.mass=0.2"]
    again = tmp_path / "again.gif"
    assert command("evaluate", "--run", finished, *changes, "--trials", "3") == 0
    output = capsys.readouterr().out
    assert "best final design of" in output and "box: mean cost" in output
    assert "sphere" not in output and not again.exists()
    wrong = ["--accuracy", "fats", "--set", "hand.sectoin.width=1"]
    assert command("evaluate", "--run", finished, *wrong) == 2
    error = capsys.readouterr().err
    assert "did you mean 'fast'?" in error and "did you mean 'hand.section'?" in error


def test_a_verdict_comes_with_its_interval():
    """Wilson's interval of n out of n begins at n / (n + 1.96^2): three of three says little."""
    tiny = scene.load(TINY)
    kept = verdicts.verdict(tiny, trials_of([0.0] * 3, [0] * 3))
    assert "mean cost 0.0000 over 3 trials" in kept and "44 to 100 % of grasps" in kept
    some = verdicts.verdict(tiny, trials_of([0.0, 0.0, 1.5], [0, 0, Status.SOLVER_CAP]))
    assert "not below the limit" in some and "2 of 3 trials kept" in some
    broken = verdicts.verdict(tiny, trials_of([3.0] * 3, [Status.NONFINITE] * 3))
    assert "every trial failed (NONFINITE 3)" in broken and "%" not in broken


@pytest.mark.parametrize(
    ("rule", "mean", "over", "share"),
    [
        ("exclude", "0.500", "2 trials, 1 lost (1 more failed, left out: STUCK 1)", "1 of 2"),
        ("worst", "1.333", "3 trials, 1 lost (1 of them failed, counted as 3: STUCK 1)", "1 of 3"),
    ],
)
def test_rows_and_verdict_follow_the_rule_for_failed_trials(rule, mean, over, share):
    """Costs 0, 1 and a failed trial: 1/2 without it, (0 + 1 + 3) / 3 with it as the worst."""
    tiny = scene.load(TINY, overrides={"cost.failure": rule})
    found = trials_of([0.0, 1.0, 3.0], [0, Status.SOLVER_CAP, Status.STUCK], lost=[1])
    row, verdict = verdicts.of_object(tiny, found), verdicts.verdict(tiny, found)
    assert row == f"mean cost {mean} over {over}; warnings: SOLVER_CAP 1"
    assert f"mean cost {mean}" in verdict and f"{share} trials kept" in verdict
    alone = verdicts.of_object(tiny, trials_of([3.0], [Status.STUCK]))
    assert alone.startswith("no mean cost (1 more failed" if rule == "exclude" else "mean cost 3.0")


def trials_of(cost, status, lost=()):
    """Outcomes of trials; the indices in `lost` lost their objects at 1 s."""
    times = np.where(np.isin(np.arange(len(cost)), lost), 1.0, np.inf)
    return Outcome(np.array(cost), np.array(status, int), times, np.full(len(cost), -1))


def test_a_narrow_console_breaks_no_name(monkeypatch, capsys):
    """Names of effects are what a scene file says."""
    monkeypatch.setenv("COLUMNS", "80")
    assert command("scenes", "paper") == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines) <= 80
    assert {line.split()[0] for line in lines if line.split()} >= {*effects.EFFECTS}


def test_evaluate_says_which_objects_it_leaves_out(capsys):
    design = ["--scene", TINY, "--objects", "paper", "--dry-run"]
    assert command("evaluate", *design, "--trials", "1") == 0
    words = "--trials 1 tries 1 of 3 objects, and not cylinder, sphere; --trials 3 tries each once"
    assert words in capsys.readouterr().out
    assert command("evaluate", *design, "--trials", "3") == 0
    assert "tries" not in capsys.readouterr().out


def test_ctrl_c_is_one_line_and_ends_the_process(monkeypatch, capsys):
    """A simulation may hold the process for minutes: what waits for it must not."""
    going, left = threading.Event(), []

    def simulate(*arguments):
        going.set()
        threading.Event().wait(30)

    def press():
        going.wait(30)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(codesign, "make_evaluate", lambda *arguments: simulate)
    monkeypatch.setattr(status, "leave", left.append)
    arguments = ["evaluate", "--scene", str(TINY), "--engine", "mujoco", "--trials", "1"]
    monkeypatch.setattr(sys, "argv", ["codesign", *arguments])
    threading.Thread(target=press).start()
    start = time.monotonic()
    assert cli.main() == 130 and left == [130]
    assert time.monotonic() - start < 20  # of the 30 that the simulation goes on
    assert capsys.readouterr().err == "stopped\n"


@pytest.mark.parametrize(
    "optimizer", ["particle-filter", pytest.param("cma-es", marks=pytest.mark.slow)]
)
def test_more_episodes_extend_a_run_bit_for_bit(optimizer, tmp_path, capsys):
    run = [*RUN, "--optimizer", optimizer]
    long, grown = tmp_path / "long", tmp_path / "grown"
    assert command(*run, "--episodes", "5", "--out", long) == 0
    assert command(*run, "--episodes", "3", "--out", grown) == 0
    if optimizer == "particle-filter":  # as runs from before there were others
        provenance = json.loads((grown / "provenance.json").read_text())
        del provenance["settings"]["optimizer"]
        (grown / "provenance.json").write_text(json.dumps(provenance))
    assert command(*run, "--episodes", "5", "--out", grown) == 0
    assert "extended from 3 to 5 episodes" in capsys.readouterr().out
    assert_same_run(grown, long)
    provenance = json.loads((grown / "provenance.json").read_text())
    assert provenance["settings"]["episodes"] == 5
    ((step, command_line),) = [(e, e.pop("command")) for e in provenance["extended"]]
    assert (step["from"], step["to"]) == (3, 5) and command_line
    # The design that was found, wherever in the run, and one grasp of it.
    scene, record = runs.read_run(grown)[0], choice.read_record(grown)
    chosen, grasp = choice.choose(scene, record), choice.find_grasp(scene, record)
    np.testing.assert_array_equal(grasp.design, chosen.design)
    assert grasp.place[:2] == (chosen.episode + 1, chosen.row)
    # Four trials of the test; the last episode's two are the particle filter's only.
    assert chosen.trials.cost.shape == ((6,) if optimizer == "particle-filter" else (4,))
    before = snapshot(grown)
    assert command(*run, "--episodes", "4", "--out", grown) == 2
    error = capsys.readouterr().err
    assert "can be extended, but not shortened; leave out --episodes" in error
    assert "--fresh" not in error and snapshot(grown) == before
    # Without --episodes the command goes on with the run, whatever it was extended to.
    assert command(*without(run, "--episodes"), "--out", grown) == 0
    assert "all 5 episodes are done" in capsys.readouterr().out
    assert_same_run(grown, long)


def without(arguments, flag):
    """The arguments without a flag and its values."""
    given = [k for k, argument in enumerate(arguments) if argument == flag]
    return [a for k, a in enumerate(arguments) if k not in given and k - 1 not in given]


def test_runs_of_different_lengths_need_episodes(compared, tmp_path, capsys):
    both = shutil.copytree(compared[0], tmp_path / "both")
    path = both / "seed-3" / "provenance.json"
    content = json.loads(path.read_text())
    content["settings"]["episodes"] = 7
    path.write_text(json.dumps(content))
    before = snapshot(both)
    assert command(*without(TWO, "--episodes"), "--out", both) == 2
    error = capsys.readouterr().err
    assert "seed-2 has 2 episodes and" in error and "seed-3 7: say by --episodes" in error
    assert snapshot(both) == before


BASE = [a for a in RUN if a not in ("--seed", "3")]
TWO = [*BASE, "--episodes", "2", "--seeds", "2-3"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Folder of two seeds in one batch, and what was printed."""
    folder, text = tmp_path_factory.mktemp("compared") / "both", io.StringIO()
    with contextlib.redirect_stdout(text):
        assert command(*TWO, "--out", folder) == 0
    return folder, text.getvalue()


def test_seeds_are_compared(compared):
    both, output = compared
    assert output.count("compiled in") == 1 and "  2 runs  mean" in output
    assert stored(both / "seed-2") != stored(both / "seed-3")
    table = output.split("best test cost")[1]
    rows = [line.split() for line in table.splitlines()]
    assert [row[0] for row in rows if row[-1:] == ["particles"]] == ["2", "3"]
    assert "of 2 runs have a particle below the limit of success" in table
    assert "% of such runs (95 % interval)" in table
    _, *rows = (both / "seeds.csv").read_text().splitlines()
    assert rows[0].startswith("2,1,") and rows[1].startswith("3,1,")


class Here:
    """In the place of submitit's executor: runs each job in this process as it is submitted."""

    cluster, folder = "here", "none"

    def submit(self, function, *arguments):
        code = function(*arguments)
        there = SimpleNamespace(exists=lambda: True)
        return SimpleNamespace(
            done=lambda: True,
            exception=lambda: None,
            result=lambda: code,
            paths=SimpleNamespace(result_pickle=there, stderr=Path("none")),
        )


def assert_jobs_are_the_batch(compared, out, *more):
    both, _ = compared
    assert command(*TWO, "--jobs", "2", *more, "--out", out) == 0
    assert (out / "seeds.csv").read_bytes() == (both / "seeds.csv").read_bytes()
    for seed in ("seed-2", "seed-3"):
        assert stored(out / seed) == stored(both / seed)


def test_jobs_have_the_bits_of_a_batch(compared, tmp_path, monkeypatch, capsys):
    """Each a run by itself, here within this process; the next test has processes, other SLURM."""
    monkeypatch.setattr(jobs, "executor", lambda options, folder: Here())
    monkeypatch.setattr(sys, "argv", sys.argv)
    assert_jobs_are_the_batch(compared, tmp_path / "jobs")
    assert "2 runs, 2 at a time, on here" in capsys.readouterr().out


@pytest.mark.slow
def test_jobs_are_processes_where_there_is_no_slurm(compared, tmp_path):
    local = ("--job-set", "cluster=local", "timeout_min=5")
    assert_jobs_are_the_batch(compared, tmp_path / "jobs", *local)


def test_wrong_jobs_are_refused(tmp_path, capsys):
    assert command(*BASE, "--episodes", "2", "--jobs", "2") == 2
    assert "--jobs needs --seeds" in capsys.readouterr().err
    run = [*TWO, "--jobs", "2", "--job-set", "cluster=local"]
    for wrong, words in (("timeout_min", "must be KEY=VALUE"), ("memory=3", "memory")):
        assert command(*run, wrong, "--out", tmp_path / "no") == 2
        assert words in capsys.readouterr().err


def test_runs_of_a_batch_stop_fail_and_go_on_by_themselves(tmp_path, monkeypatch, capsys):
    """A signal, a disk that is full for one of them, and runs that are at other episodes."""
    run = [*BASE, "--episodes", "3", "--seeds", "3-5", "--out", tmp_path / "runs"]
    assert command(*RUN, "--episodes", "1", "--out", tmp_path / "runs" / "seed-3") == 0
    save, simulate = Checkpoints.save, Batch.begin

    def interrupted(batch, requests):
        os.kill(os.getpid(), signal.SIGTERM)
        return simulate(batch, requests)

    def full(store, step, arrays):
        if store.folder.parent.name == "seed-5" and step == 2:
            raise OSError("no space left")
        save(store, step, arrays)

    monkeypatch.setattr(Batch, "begin", interrupted)
    assert command(*run) == 128 + signal.SIGTERM
    monkeypatch.setattr(Batch, "begin", simulate)
    assert "seed 3: extended from 1 to 3 episodes" in capsys.readouterr().out
    first = runs.load_record(tmp_path / "runs" / "seed-3")
    assert first is not None and first.done == 2
    monkeypatch.setattr(Checkpoints, "save", full)
    assert command(*run) == 1
    output = capsys.readouterr()
    assert "error: seed 5: no space left" in output.err
    assert "resuming episode 3/3" in output.out and "of 2 runs have a particle" in output.out
    monkeypatch.setattr(Checkpoints, "save", save)
    assert command(*run) == 0
    assert "of 3 runs have a particle" in capsys.readouterr().out
    events, fetch, report = [], runs.loop.fetch, runs.loop.records.report

    def noted_fetch(tree):
        events.append("fetch")
        return fetch(tree)

    def noted_report(history, episode, info):
        events.append(f"report {episode + 1}")
        report(history, episode, info)

    def noted_save(store, step, arrays):
        events.append(f"save {step}")
        save(store, step, arrays)

    def noted_simulation(batch, requests):
        events.append("begin")
        return simulate(batch, requests)

    monkeypatch.setattr(runs.loop, "fetch", noted_fetch)
    monkeypatch.setattr(runs.loop.records, "report", noted_report)
    monkeypatch.setattr(Checkpoints, "save", noted_save)
    monkeypatch.setattr(Batch, "begin", noted_simulation)
    for seed in ("3", "5"):
        alone = [*BASE, "--seed", seed, "--episodes", "3", "--out", tmp_path / f"alone-{seed}"]
        assert command(*alone) == 0
        assert_same_run(tmp_path / "runs" / f"seed-{seed}", tmp_path / f"alone-{seed}")
    # An episode is read from the devices before the next one begins, and then reported and saved;
    # the last one before the test begins.
    start, after = events.index("save 0"), ["begin", "fetch", "begin", "report 1", "save 1"]
    after += ["fetch", "begin", "report 2", "save 2", "fetch", "report 3", "save 3", "begin"]
    assert events[start + 1 : start + 14] == after


@pytest.mark.slow
def test_hosts_share_the_seeds(tmp_path, capsys):
    """Two processes of JAX's distributed runtime on this host: the runs are those of one."""
    run = [*BASE, "--episodes", "2", "--seeds", "3-5"]
    assert command(*run, "--out", tmp_path / "one") == 0
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    hosts = [
        launch(*run, "--out", tmp_path / "two", "--distributed", f"{address},2,{k}") for k in (0, 1)
    ]
    outputs = [host.communicate()[0] for host in hosts]
    assert [host.returncode for host in hosts] == [0, 0], outputs
    for seed in ("seed-3", "seed-4", "seed-5"):
        assert stored(tmp_path / "two" / seed) == stored(tmp_path / "one" / seed)
    tables = [(tmp_path / name / "seeds.csv").read_bytes() for name in ("one", "two")]
    assert tables[0] == tables[1]
    assert "of 3 runs have a particle" in outputs[0]
    assert "seed 4: final test" not in outputs[0] and "of 3 runs" not in outputs[1]


def test_a_schedule_that_divides_its_episodes_cannot_be_extended(tmp_path, capsys):
    switching = [*RUN, "--schedule", "switch-1", "--out", tmp_path / "run", "--test-trials", "0"]
    assert command(*switching, "--episodes", "2") == 0
    assert command(*switching, "--episodes", "4") == 2
    assert "switch-1 divides its episodes" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--design", "lenght=100"], "'lenght' is not a parameter; did you mean 'length'?"),
        (["--design", "length=0.148"], "did you mean 148?"),
        (["--design", "length=1480"], "length = 1480.0 is outside [10, 180] mm"),
        (["--design", "length=long"], "length = 'long' must be a number in mm"),
        (["--design", "length=nan"], "must be a number in mm"),
        (["--design", "length"], "must be a number in mm"),
        (["--design", "length=90", "arm_z=5", "length=95"], "more than once: 90, 95"),
        (["--trials", "0"], "--trials = 0 is outside"),
        (["--engine", "c"], "--engine"),
        (["--set", "solver.iterations=50"], "set newton.iterations, which limits the solver"),
        (["--render", "grasp.mp4"], "must end in .gif"),
        (["--run", "nowhere"], "nowhere is not a run folder"),
        (["--run", "nowhere", "--design", "length=100"], "own; leave out --design"),
        (["--run", "nowhere", "--hand", "tripod3", "--preset", "23d"], "out --hand and --preset"),
    ],
)
def test_evaluate_refuses_wrong_input(arguments, part, workplace, capsys):
    assert command("evaluate", *arguments) == 2
    assert part in capsys.readouterr().err
    assert list(workplace.iterdir()) == []


def test_bounds_themselves_are_designs(capsys):
    space_low = ["length=10", "arm_z=-50"]
    engine = ["--engine", "mujoco", "--trials", "1"]
    assert command("evaluate", "--scene", TINY, "--design", *space_low, *engine) == 0


def test_checkpoints_are_written_every_episode(finished):
    with Checkpoints(Path(finished) / "checkpoints") as store:
        found = store.restore()
    assert found.step == EPISODES + 1 and "test" in found.arrays
    kept = sorted(int(p.stem) for p in (finished / "checkpoints").glob("*.sha256"))
    assert kept == [EPISODES - 1, EPISODES, EPISODES + 1]
