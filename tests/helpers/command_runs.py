"""Runs by the command line for tests: the command, its run, and comparisons of run folders."""

import fcntl
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from codesign_jax import cli, runs
from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.record import to_arrays
from tests.helpers.toy_engine import TINY

RUN = [
    *("optimize", "--scene", str(TINY), "--seed", "3", "--engine", "mujoco"),
    *("--optimizer", "particle-filter"),
    *("--particles", "4", "--trials", "3", "--episodes", "3", "--test-trials", "4"),
]
EPISODES = 3  # of RUN
RESULTS = ("episodes.csv", "particles.csv", "trials.csv", "tests.csv")


@pytest.fixture(autouse=True, name="workplace")
def own_workplace(tmp_path, monkeypatch):
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


@pytest.fixture(scope="module", name="finished")
def finished_run(tmp_path_factory):
    """The run RUN, which nothing interrupted; copy it to change it."""
    return copied(tmp_path_factory.mktemp("finished") / "run")


def assert_same_run(folder, finished):
    assert stored(folder) == stored(finished)
    for name in RESULTS:
        assert (folder / name).read_bytes() == (finished / name).read_bytes(), name


def without(arguments, flag):
    """The arguments without a flag and its values."""
    positions = [k for k, argument in enumerate(arguments) if argument == flag]
    return [a for k, a in enumerate(arguments) if k not in positions and k - 1 not in positions]


def copied(folder: Path) -> Path:
    """Copies the run to a folder; it is made once for all processes of the session."""
    kept = Path(os.environ["CODESIGN_TESTS_FOLDER"]) / "tiny-run"
    with kept.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (kept / "done").exists():
            shutil.rmtree(kept, ignore_errors=True)
            assert cli.main([*RUN, "--out", str(kept / "run")]) == 0
            (kept / "done").touch()
    return Path(shutil.copytree(kept / "run", folder))


@pytest.fixture(scope="module", name="run")
def small_run(tmp_path_factory):
    """A small run with its report."""
    folder = tmp_path_factory.mktemp("report") / "<run> & 1"
    copied(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder.parent / "cache"))
        assert cli.main(["report", str(folder)]) == 0
    return folder
