"""Every grasp as a row: counts, values, provenance, and what is said without pyarrow."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

from codesign_jax.scene.schema import InputError
from codesign_jax.types import Status, failed
from scripts.experiments import parquet
from scripts.experiments.plan import Strategies
from tests.helpers.toy_engine import tiny

ROOT = Path(__file__).parents[1]
PLAN = Strategies("2d", "2d", ("single", "switch-1", "concurrent"), 2, 4, 3, 3, 6)
NOTES = {"command": "python", "commit": "abc", "versions": {"jax": "0"}}


@pytest.fixture(scope="module")
def finished():
    """Made-up arrays of `strategies.gather`, some of whose trials failed."""
    random, sizes = np.random.default_rng(0), (3, 2, PLAN.episodes, 4, 3)
    found = {}
    for name, shape in (("trial_", sizes), ("test_", (3, 2, 4, 9))):
        status = (random.random(shape) < 0.1).astype(np.uint8)
        cost = np.where(status, 3.0, random.random(shape)).astype(np.float32)
        found |= {f"{name}cost": cost, f"{name}status": status}
    return found | {"status": found.pop("trial_status")}


def columns(path):
    """Columns of a file as NumPy arrays or lists of strings."""
    table = pyarrow.parquet.read_table(path)
    return {
        name: np.array(table[name].to_pylist(), object if name == "episode" else None)
        for name in table.column_names
    }


def test_one_row_a_grasp_with_the_stored_values(finished, tmp_path):
    record = finished
    path = tmp_path / "new" / "2d.parquet"
    assert parquet.write_strategies(path, PLAN, tiny()[1], record, NOTES) == path
    assert sorted(p.name for p in path.parent.iterdir()) == ["2d.parquet"]
    rows = columns(path)
    assert len(rows["cost"]) == PLAN.grasps == 3 * 2 * 4 * 3 * 5
    assert set(rows["experiment"]) == {"2d"}
    named = [rows[n] for n in parquet._STRATEGIES if n not in ("cost", "status")]
    keys = list(zip(*named, strict=True))
    assert len(set(keys)) == PLAN.grasps  # no grasp twice
    strategy = np.array([PLAN.strategies.index(s) for s in rows["strategy"]])
    index = [strategy, rows["run"], rows["particle"], rows["trial"]]
    test = rows["phase"] == parquet.TEST
    assert test.sum() == 3 * 2 * 4 * 6 and all(e is None for e in rows["episode"][test])
    at = tuple(i[test] for i in index[:-1]) + (PLAN.trials + rows["trial"][test],)
    for name in ("cost", "status"):
        np.testing.assert_array_equal(rows[name][test], record[f"test_{name}"][at])
    episode = rows["episode"][~test].astype(int)
    at = (strategy[~test], rows["run"][~test], episode, rows["particle"][~test])
    status = record["status"][(*at, rows["trial"][~test])]
    np.testing.assert_array_equal(rows["status"][~test], status)
    bad = failed(status)
    assert bad.any() and (rows["cost"][~test][bad] == 3.0).all()
    costs = record["trial_cost"][(*at, rows["trial"][~test])]
    np.testing.assert_array_equal(rows["cost"][~test], costs)


def test_types_and_provenance_are_in_the_schema(finished, tmp_path):
    path = tmp_path / "2d.parquet"
    parquet.write_strategies(path, PLAN, tiny()[1], finished, NOTES)
    schema = pyarrow.parquet.read_schema(path)
    assert json.loads(schema.metadata[b"provenance"]) == NOTES
    bits = json.loads(schema.metadata[b"status_bits"])
    assert bits == {str(int(s)): s.name for s in Status if s}
    types = {f.name: str(f.type) for f in schema}
    assert (types["cost"], types["status"], types["episode"]) == ("float", "uint8", "int16")
    assert types["strategy"] == "dictionary<values=string, indices=int16, ordered=0>"
    assert all(f.metadata[b"description"] for f in schema)


def test_what_was_not_simulated_yet_has_no_rows(finished, tmp_path):
    begun = {"trial_cost": finished["trial_cost"][:, :, :1], "status": finished["status"][:, :, :1]}
    path = tmp_path / "begun.parquet"
    parquet.write_strategies(path, PLAN, tiny()[1], begun, {})
    assert pyarrow.parquet.read_metadata(path).num_rows == PLAN.worlds


def test_a_landscape_s_rows_name_their_point(tmp_path):
    _, space, _ = tiny()
    random, path = np.random.default_rng(0), tmp_path / "grid.parquet"
    record = {
        "designs": random.random((3, 3, 2)).astype(np.float32),
        "trial_cost": random.random((3, 3, 4)).astype(np.float32),
        "status": np.zeros((3, 3, 4), np.uint8),
    }
    parquet.write_landscape(path, "landscape", space, record, NOTES)
    rows = columns(path)
    assert len(rows["cost"]) == 9 * 4
    field = pyarrow.parquet.read_schema(path).field("first")
    assert field.metadata[b"parameter"].decode() == space.names[0]
    designs = space.in_units(record["designs"]).astype(np.float32)
    for i, j, t in ((0, 0, 0), (2, 1, 3), (1, 2, 2)):
        row = (rows["first"] == designs[i, j, 0]) & (rows["second"] == designs[i, j, 1])
        row &= rows["trial"] == t
        assert row.sum() == 1
        assert rows["cost"][row] == record["trial_cost"][i, j, t]


def test_without_pyarrow_nothing_is_simulated(finished, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install '\.\[parquet\]' in the checkout"):
        parquet.write_strategies(tmp_path / "x.parquet", PLAN, tiny()[1], finished, NOTES)
    arguments = ["experiments", "2d", "--size", "tiny", "--engine", "mujoco"]
    arguments += ["--out", str(tmp_path / "out"), "--parquet", str(tmp_path / "x.parquet")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit, match="needs pyarrow: pip install"):
        runpy.run_module("scripts.experiments", run_name="__main__", alter_sys=True)
    assert not list(tmp_path.iterdir())


def test_the_script_writes_rows_and_again_from_a_finished_state(tmp_path, monkeypatch):
    def run(*more):
        arguments = ["experiments", "landscape", "--size", "tiny", "--engine", "mujoco"]
        arguments += ["--scene", "paper_spheres"]
        arguments += ["--out", str(tmp_path), *more]
        monkeypatch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit) as end:
            runpy.run_module("scripts.experiments", run_name="__main__", alter_sys=True)
        assert end.value.code == 0

    run("--commit", "abc")
    before = (tmp_path / "landscape.json").read_text()
    run("--commit", "def", "--parquet", str(tmp_path / "grasps.parquet"))
    assert (tmp_path / "landscape.json").read_text() == before
    rows = pyarrow.parquet.read_table(tmp_path / "grasps.parquet")
    assert rows.num_rows == 12
    assert json.loads(rows.schema.metadata[b"provenance"]) == json.loads(before)
