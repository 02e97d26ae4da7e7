"""Many runs of one command: in one batch, on several hosts, with the same bits."""

import contextlib
import csv
import io
import os
import signal
import socket

import pytest

from codesign_jax import runs
from codesign_jax.batch import Batch
from codesign_jax.runs.checkpoint import Checkpoints
from tests.helpers.command_runs import (
    assert_same_run,
    command,
    launch,
    own_workplace,  # noqa: F401
    stored,
    without,
)
from tests.helpers.tiny_run import RUN

BASE = without(RUN, "--seed")


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
    table = output[output.rindex("judged by") :]
    rows = [line for line in table.splitlines() if "final test" in line]
    assert [row.split()[0] for row in rows] == ["2", "3"]
    assert "of 2 runs found a good design" in table and "good: at least 95 % kept" in table
    assert "% of such runs (95 % interval)" in table
    with (both / "seeds.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    names = ("seed", "schedule", "first", "finished", "run")
    assert [tuple(row[name] for name in names) for row in rows] == [
        ("2", "concurrent", "morphology", "1", "seed-2"),
        ("3", "concurrent", "morphology", "1", "seed-3"),
    ]
    for row in rows:
        with (both / row["run"] / "tests.csv").open(newline="") as file:
            best = min(csv.DictReader(file), key=lambda r: float(r["test_cost"]))
        assert row["best_test_cost"] == best["test_cost"] and row["trials"] == best["trials"]
        assert int(row["paper_successes"]) <= int(row["particles"]) and row["verdict"]


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
    assert "resuming episode 3/3" in output.out and "of 2 runs found a good design" in output.out
    monkeypatch.setattr(Checkpoints, "save", save)
    assert command(*run) == 0
    assert "of 3 runs found a good design" in capsys.readouterr().out
    for seed in ("3", "5"):
        alone = [*BASE, "--seed", seed, "--episodes", "3", "--out", tmp_path / f"alone-{seed}"]
        assert command(*alone) == 0
        assert_same_run(tmp_path / "runs" / f"seed-{seed}", tmp_path / f"alone-{seed}")


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
    assert "of 3 runs found a good design" in outputs[0]
    assert "seed 4: final test" not in outputs[0] and "of 3 runs" not in outputs[1]
