"""A small run with its report, for tests of what shows runs: `small_run`, the fixture `run`."""

import fcntl
import os
import shutil
from pathlib import Path

import pytest

from codesign_jax import cli
from tests.helpers.toy_engine import TINY

RUN = [
    *("optimize", "--scene", str(TINY), "--seed", "3", "--engine", "mujoco"),
    *("--optimizer", "particle-filter"),
    *("--particles", "4", "--trials", "3", "--episodes", "3", "--test-trials", "4"),
]


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
