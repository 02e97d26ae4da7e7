"""The harness of `make faults`: its comparison can fail, its damage and its disk errors happen."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from scripts import faults
from scripts.faults import shim  # noqa: F401  (a fixture)
from tests.helpers import tiny_run


@pytest.mark.parametrize("way", faults.WAYS)
def test_every_damage_changes_what_is_read(way, tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"some bytes of a file")
    faults.damaged(path, way)
    assert not path.is_file() or path.read_bytes() != b"some bytes of a file"


def test_the_comparison_of_runs_can_fail(tmp_path):
    run, other = (tiny_run.copied(tmp_path / name) for name in ("run", "other"))
    assert faults.differences(other, run) == []
    for name in ("trials.csv", "hand.toml"):
        text = (other / name).read_text()
        place = max(i for i, c in enumerate(text) if c.isdigit())
        (other / name).write_text(f"{text[:place]}{(int(text[place]) + 1) % 10}{text[place + 1 :]}")
    (other / "tests.csv").unlink()
    (other / "figures" / "a.tmp").touch()
    assert faults.differences(other, run) == ["trials.csv", "tests.csv", "hand.toml", "a.tmp"]


PROGRAM = """
import os, sys
for k in range(3):
    try:
        with open(os.path.join(sys.argv[1], f"file-{k}"), "wb", buffering=0) as file:
            file.write(b"0123456789")
        os.rename(file.name, file.name.replace("file", "named"))
        os.unlink(file.name.replace("file", "named"))
    except OSError as error:
        print(error.errno)
"""


@pytest.mark.parametrize(
    ("mode", "at", "status", "errors", "left"),
    [
        ("count", 0, 0, [], {}),
        ("killed", 6, -signal.SIGKILL, [], {"file-1": b"01234"}),
        ("full", 6, 0, [errno.ENOSPC] * 2, {"file-1": b""}),
        ("broken", 6, 0, [errno.EIO], {"file-1": b""}),
        ("read-only", 8, 0, [errno.EROFS] * 2, {"named-1": b"0123456789"}),
    ],
)
def test_the_chosen_operation_meets_the_fault(mode, at, status, errors, left, shim, tmp_path):  # noqa: F811
    command = [sys.executable, "-S", "-c", PROGRAM, tmp_path]
    more = shim(tmp_path, at, mode)
    done = subprocess.run(command, env=os.environ | more, capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    assert [int(line) for line in done.stdout.split()] == errors
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == left
