"""A small run with its report, for tests of what shows runs: `small_run`, the fixture `run`."""

import pytest
from toy import TINY

from codesign_jax import cli

RUN = [
    *("optimize", "--scene", str(TINY), "--seed", "3", "--engine", "mujoco"),
    *("--particles", "4", "--trials", "2", "--episodes", "3", "--test-trials", "4"),
]


@pytest.fixture(scope="module", name="run")
def small_run(tmp_path_factory):
    """A small run with its report."""
    folder = tmp_path_factory.mktemp("report") / "<run> & 1"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder.parent / "cache"))
        assert cli.main([*RUN, "--out", str(folder)]) == 0
        assert cli.main(["report", str(folder)]) == 0
    return folder
