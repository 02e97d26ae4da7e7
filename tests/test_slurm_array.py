"""The SLURM script of the documentation, under bash with stand-ins for SLURM and the command."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "docs" / "slurm_array.sh"
# Says what it was asked for and ends as the test wants it, or, as `codesign optimize` does, with
# 143 when it is stopped.
CODESIGN = """#!/usr/bin/env bash
trap 'exit 143' TERM
echo "$@" > asked
[ "$STATUS" = wait ] || exit "$STATUS"
while true; do sleep 0.05; done
"""


@pytest.mark.parametrize(
    ("status", "code", "requeued"),
    [("0", 0, None), ("1", 1, None), ("wait", 143, "requeue 7\n")],
)
def test_a_job_is_one_run_and_goes_on_after_its_time_limit(status, code, requeued, tmp_path):
    for name, text in (("codesign", CODESIGN), ("scontrol", '#!/bin/sh\necho "$@" > told\n')):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    slurm = {"SLURM_ARRAY_TASK_ID": "3", "SLURM_JOB_ID": "7", "STATUS": status}
    path = f"{tmp_path}:{os.environ['PATH']}"
    job = subprocess.Popen(
        ["bash", SCRIPT, "my runs", "--preset", "23d"],
        cwd=tmp_path,
        env={**os.environ, **slurm, "PATH": path},
    )
    if status == "wait":
        while not (tmp_path / "asked").exists():
            time.sleep(0.01)
        job.send_signal(signal.SIGTERM)  # as SLURM's --signal=B:TERM@120
    assert job.wait(30) == code
    asked = (tmp_path / "asked").read_text()
    assert asked == "optimize --seed 3 --out my runs/seed-3 --preset 23d\n"
    told = tmp_path / "told"
    assert (told.read_text() if told.exists() else None) == requeued
