"""Runs by the command line for tests: the command, its run, and comparisons of run folders."""

import os
import subprocess
import sys
import time

import pytest

from codesign_jax import cli, runs
from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.record import to_arrays
from tests.helpers.tiny_run import copied

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
    given = [k for k, argument in enumerate(arguments) if argument == flag]
    return [a for k, a in enumerate(arguments) if k not in given and k - 1 not in given]
