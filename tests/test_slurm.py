"""Runs as jobs of a real SLURM of this machine: results, refusals, cancelled and queued again.

On Debian: apt-get install slurm-wlm munge.  The tests start and end daemons of their own.
"""

import os
import pickle
import stat
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from codesign_jax import cli, runs
from codesign_jax.commands import jobs, slurm
from codesign_jax.runs import checkpoint
from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.record import to_arrays
from codesign_jax.scene.schema import InputError
from tests.helpers.slurm_cluster import MISSING, PATH, cluster
from tests.helpers.toy_engine import TINY

RUN = [
    *("optimize", "--scene", str(TINY), "--engine", "mujoco", "--particles", "4", "--trials", "2"),
    *("--episodes", "40", "--test-trials", "4", "--seeds", "2-4"),
]
# Without SLURM's answers and result files at once, a test would wait for most of its time.
POLLING = "from codesign_jax.commands import slurm; slurm.QUEUE_SECONDS = slurm.RESULT_SECONDS = 1"
WITHOUT = pytest.mark.skipif(bool(MISSING), reason=f"no SLURM here: {', '.join(MISSING)} missing")


@pytest.fixture(scope="module")
def conf():
    with cluster() as found:
        yield found


@pytest.fixture
def on_cluster(conf, tmp_path, monkeypatch):
    monkeypatch.setenv("SLURM_CONF", str(conf))
    monkeypatch.setenv("PATH", PATH)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def launch(*arguments):
    """Starts the command in a process of its own."""
    # Python does not listen to Ctrl-C where the tests are a shell's job in the background.
    interruptible = "signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"import signal, sys; {interruptible}; {POLLING}; "
    program += "from codesign_jax import cli; sys.exit(cli.main())"
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def ask(*command):
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def wait_until(true, process):
    """Waits until something holds; fails if the process ends before."""
    while not true():
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.1)


def stored(folder):
    record = runs.load_record(folder)
    assert record is not None
    return digest(to_arrays(record))


def array():
    """Number of the array that is in the queue."""
    return ask("squeue", "--noheader", "--array", "--format=%F").split()[0]


def test_parameters_are_what_submitit_and_slurm_want():
    pairs = ["timeout_min=30", "mem_gb=1.5", "cpus_per_task=8", "slurm_account=007"]
    pairs += ["slurm_setup=module load cuda; nvidia-smi", "slurm_srun_args=--mpi=none --quiet"]
    pairs += ["slurm_additional_parameters=reservation=course,spread-job", "slurm_use_srun=false"]
    given = jobs.job_parameters(pairs)
    assert given["timeout_min"] == 30 and given["mem_gb"] == 1.5
    assert given["slurm_account"] == "007" and given["slurm_use_srun"] is False
    found = slurm.submitit_parameters(given)
    assert found["slurm_setup"] == ["module load cuda; nvidia-smi"]
    assert found["slurm_srun_args"] == ["--cpus-per-task=8", "--mpi=none", "--quiet"]
    further = {"requeue": True, "reservation": "course", "spread-job": True}
    assert found["slurm_additional_parameters"] == further
    with pytest.raises(InputError, match="tasks_per_node: a run is one process"):
        slurm.submitit_parameters({"tasks_per_node": 2})


def test_what_the_queue_says_is_counted_and_reasons_that_matter_are_named():
    queue = [slurm.JobState("RUNNING"), slurm.JobState("PENDING", "Priority")]
    assert slurm.summary(queue) == "1 pending, 1 running"
    queue += [slurm.JobState("PENDING", "PartitionTimeLimit"), slurm.JobState("CANCELLED")]
    assert slurm.summary(queue) == "2 pending, 1 running (PartitionTimeLimit)"
    assert slurm.summary([slurm.JobState("COMPLETED")]) == ""


def test_why_a_job_failed_is_said_in_words(tmp_path):
    log = tmp_path / "log.err"
    log.write_text("INFO: started\nerror: no space left\nINFO: ended\n")

    def job(code, error=None):
        paths = SimpleNamespace(stderr=log)
        return SimpleNamespace(paths=paths, exception=lambda: error, result=lambda: code)

    assert jobs.why(job(0), "") == ""
    assert jobs.why(job(1), "") == f"failed: no space left; log: {log}"
    assert jobs.why(job(0, ValueError()), "").startswith("failed: no space left")
    assert jobs.why(job(143), "") == "stopped by SIGTERM; the same command resumes"
    assert jobs.why(job(0), "CANCELLED") == f"failed: CANCELLED; log: {log}"
    log.unlink()
    assert "without a word" in jobs.why(job(2), "")


class Planted:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_results_that_lay_there_before_are_never_unpickled(tmp_path):
    """Whatever the number of the next process, by which submitit calls a result."""
    out, made_by = tmp_path / "runs", tmp_path / "planted"
    (out / "jobs").mkdir(parents=True)
    bomb = pickle.dumps(("success", Planted(made_by)))
    pickle.loads(bomb)
    assert made_by.exists()  # so it goes off
    made_by.unlink()
    for number in range(os.getpid(), os.getpid() + 2000):
        (out / "jobs" / f"{number}_0_result.pkl").write_bytes(bomb)
    asked = SimpleNamespace(job_set=(("cluster=local",),), jobs=1)
    with jobs.private_folder(out) as own:
        place = jobs.Processes(jobs.executor(asked, own), 1)
        place.start({5: (abs, -7)})
    assert own.parent == out / "jobs" and stat.S_IMODE(own.stat().st_mode) == 0o700
    while not (ended := [*place.ended()]):
        time.sleep(0.05)
    [(seed, job, state)] = ended
    assert (seed, job.result(), state) == (5, 7, "") and not made_by.exists()
    assert Path(job.paths.result_pickle).parent == own


def test_a_start_that_is_refused_leaves_no_folder(tmp_path):
    asked = SimpleNamespace(job_set=(("cluster=local", "memory=3"),), jobs=1)
    with pytest.raises(InputError, match="memory"), jobs.private_folder(tmp_path / "a/b") as own:
        jobs.executor(asked, own)
    assert not (tmp_path / "a").exists()


def test_a_dry_run_tells_where_jobs_start_and_what_is_not_used_there(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")  # no SLURM
    partition = SimpleNamespace(jobs=2, job_set=(("slurm_partition=gpu",),))
    words = "local; not used, as there is no SLURM here: slurm_partition"
    assert jobs.plan(partition) == words
    wrong = SimpleNamespace(jobs=2, job_set=(("gpu=8",),))
    with pytest.raises(InputError, match="--job-set: .*gpu"):
        jobs.plan(wrong)


@WITHOUT
@pytest.mark.slow
def test_runs_are_cancelled_queued_again_resumed_and_those_of_one_batch(on_cluster, capfd):
    """One job is cancelled as it runs, one as it waits; one comes near to its time limit."""
    run = [*RUN, "--out", "slurm", "--jobs", "2", "--fresh", "--job-set", "cpus_per_task=1"]
    run += ["mem_gb=0.5", "timeout_min=10", "slurm_partition=trial"]
    process, folder = launch(*run), Path("slurm")
    started = [folder / f"seed-{seed}" / "checkpoints" for seed in (2, 3)]
    wait_until(lambda: all(checkpoint.newest(path) > 0 for path in started), process)
    number = array()
    waits = ask("squeue", "--noheader", "--jobs", f"{number}_2", "--format=%T %r")
    assert waits.strip() == "PENDING JobArrayTaskLimit"
    ask("scancel", f"{number}_2", f"{number}_0")
    ask("scancel", "--signal=USR2", f"{number}_1")  # as SLURM does before the limit
    again = ("squeue", "--noheader", "--jobs", f"{number}_1", "--format=%T")
    wait_until(lambda: ask(*again).strip() == "PENDING", process)
    ask("scontrol", "update", f"JobId={number}_1", "StartTime=now")
    output = process.communicate()[0]
    assert process.returncode == 1
    said = output + "".join(p.read_text() for p in (folder / "jobs").glob("*/*_log.*"))
    assert "seed 2: stopped by SIGTERM; the same command resumes" in output, said
    assert "seed 4: failed: CANCELLED" in output, said
    assert "seed 3: done" in output, said
    log = next((folder / "jobs").glob("*/*_1_0_log.out")).read_text()
    assert "queued again, to resume" in log and "resuming episode" in log
    assert 0 < checkpoint.newest(started[0]) < 40 and not (folder / "seed-4").exists()

    process = launch(*[a for a in run if a != "--fresh"])
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert "of 3 runs have a particle" in output
    assert cli.main([*RUN, "--out", "batch"]) == 0
    assert Path("slurm/seeds.csv").read_bytes() == Path("batch/seeds.csv").read_bytes()
    for seed in (2, 3, 4):
        assert stored(Path(f"slurm/seed-{seed}")) == stored(Path(f"batch/seed-{seed}"))


@WITHOUT
def test_what_slurm_refuses_is_said_in_its_words(on_cluster, capfd):
    """And nothing is left behind, nor is anything in the queue."""
    wrong = {
        "slurm_partition=gpu": "Invalid partition name specified",
        "mem_gb=900": "Requested node configuration is not available",
        "slurm_time=soon": "Invalid --time specification",
    }
    for given, words in wrong.items():
        assert cli.main([*RUN, "--out", "no", "--jobs", "2", "--job-set", given]) == 2
        problem = next(e for e in capfd.readouterr().err.splitlines() if e.startswith("error: "))
        assert problem.startswith("error: SLURM does not take the jobs: ") and words in problem
        assert not Path("no").exists()
    assert ask("squeue", "--noheader") == ""


@WITHOUT
def test_why_jobs_wait_and_a_stop_that_cancels_them(on_cluster):
    run = [*RUN, "--out", "long", "--jobs", "2", "--job-set", "slurm_time=2-00:00:00"]
    process = launch(*run)
    assert process.stdout is not None
    lines = iter(process.stdout.readline, "")
    assert any("SLURM: 3 pending (PartitionTimeLimit)" in line for line in lines)
    process.send_signal(2)
    assert "the jobs are cancelled" in process.communicate(timeout=60)[0]
    assert process.returncode == 130
    assert ask("squeue", "--noheader") == ""
