"""Runs in one batch on several devices: each has the bits that it has alone on one."""

import subprocess
import sys
from pathlib import Path

import jax
import pytest
from toy import TINY

from codesign_jax import cli, runs
from codesign_jax.batch import take
from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.record import to_arrays

RUN = [
    *("optimize", "--scene", str(TINY), "--particles", "10", "--trials", "2", "--episodes", "2"),
    *("--test-trials", "2", "--reference-trials", "0"),
]

TWO_DEVICES = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", 2)
from codesign_jax import batch, cli

seen, call = [], batch.Batch._call

def spy(self, blocks, common, device):
    seen.append((device.id, jax.tree.leaves(blocks)[0].shape[0]))
    return call(self, blocks, common, device)

batch.Batch._call = spy
run, folder = sys.argv[2:], sys.argv[1]
assert cli.main([*run, "--seeds", "0-2", "--out", folder + "/many"]) == 0
assert {device for device, _ in seen} == {0, 1}, seen
print("shares", *[count for _, count in seen[:2]], "end")
seen.clear()
assert cli.main([*run, "--seed", "1", "--devices", "1", "--out", folder + "/one"]) == 0
assert {device for device, _ in seen} == {0}, seen
"""


def stored(folder):
    """Digest of the newest checkpoint: every array, bit for bit."""
    record = runs.load_record(folder)
    assert record is not None
    return digest(to_arrays(record))


def test_runs_on_two_devices_are_those_of_one_run_on_one(tmp_path):
    """By the kernel, whose blocks are cut without regard to the runs that they belong to."""
    command = [sys.executable, "-c", TWO_DEVICES, str(tmp_path), *RUN]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 devices" in done.stdout
    shares = [int(n) for n in done.stdout.split("shares")[1].split("end")[0].split()]
    # Of a run at least two blocks, and an odd number of all: the middle run is cut.
    assert shares[0] == shares[1] + 1 and sum(shares) % 3 == 0
    assert stored(tmp_path / "many" / "seed-1") == stored(tmp_path / "one")
    assert stored(tmp_path / "many" / "seed-2") != stored(tmp_path / "one")


def test_devices_that_there_are_not(tmp_path, capsys):
    assert cli.main([*RUN, "--devices", "99", "--out", str(tmp_path / "no")]) == 2
    assert "--devices = 99 is not valid; this process has" in capsys.readouterr().err
    with pytest.raises(ValueError, match="99 devices asked for, "):
        take(99)
    assert take(None) == jax.local_devices()
