"""`codesign sample`: rows that follow from keys, what a kill leaves, and other questions."""

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

from codesign_jax import cli, objects, rollout, sampling, scene
from codesign_jax.commands import sample
from codesign_jax.export import process
from codesign_jax.judge import verdict
from codesign_jax.runs import dataset, directory
from codesign_jax.scene import parameters
from tests.helpers.grasps import nth
from tests.helpers.toy_engine import TINY, ToyEngine, tiny

KEY = jax.random.key(3)
THREE = scene.load(TINY, object_set="paper")  # three objects, of which toy engines know nothing
SPACE = tiny()[1]
COMMAND = ("sample", "--scene", str(TINY), "--objects", "paper", "--preset", "2d", "--seed", "3")


ENGINE = ToyEngine(THREE, failing=[1, 4])  # of the worlds of each call


class Killed(BaseException):
    """A process that ends."""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """An empty working directory, and a toy engine."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(sample, "make_engine", lambda name, the_scene: ENGINE)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def run(*more, designs=10, trials=2, out="a.parquet", chunk=8):
    """Exit status; 10 designs of 2 trials are three calls of 4 designs."""
    sizes = ["--designs", designs, "--trials", trials, "--out", out]
    sizes += [] if chunk is None else ["--chunk", chunk]
    return cli.main([*COMMAND, *map(str, sizes), *more])


@pytest.mark.slow  # 10 s
def test_robust_draws_what_the_paper_keeps():
    """Factors with the spread that `objects.ROBUST` names; without it those of the paper are 1."""
    sizes = {"designs": 200, "chunk": 400}
    assert run("--robust", **sizes) == run(out="b.parquet", **sizes) == 0
    tables = (pq.read_table(f"{n}.parquet").to_pydict() for n in "ab")
    wide, usual = ({n: np.array(v) for n, v in t.items() if n[:5] == "noise"} for t in tables)
    for name in ("friction", "stiffness", "hand_mass"):
        column = f"noise_{name}_factor"
        sigma = getattr(objects.ROBUST, name)
        assert (usual[column] == 1).all()
        # The standard deviation of 400 normal draws is within 11 % of theirs in 998 of 1000 cases.
        np.testing.assert_allclose(np.log(wide[column]).std(), sigma, rtol=0.11)
    for name in ("x_m", "size_factor", "mass_factor"):
        assert wide[f"noise_{name}"].std() > 1.7 * usual[f"noise_{name}"].std()


def killed_after(saves, monkeypatch, **sizes):
    """Runs the command until so many shards have been saved."""
    save = dataset.Shards.save
    done = []

    def counted(self, shard, outcomes):
        if len(done) == saves:
            raise Killed
        done.append(shard)
        save(self, shard, outcomes)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(dataset.Shards, "save", counted)
        run(**sizes)
    return done


def test_outcomes_are_those_of_each_grasp_by_itself():
    drawn = sampling.draw(THREE, SPACE, KEY, first=4, n=4, num_trials=2)
    engine = ToyEngine(THREE)
    outcomes = sampling.make_simulate(THREE, engine, SPACE)(drawn.designs, drawn.trials)
    assert outcomes.cost.shape == (4, 2) and len(np.unique(outcomes.cost)) > 3
    every = jax.jit(lambda p, t: rollout.evaluate(THREE, engine, p, t))
    hands = parameters.params_of(SPACE, drawn.designs)
    for i in (1, 3):  # all designs in the trials of one
        cost = every(hands, nth(drawn.trials, i)).cost
        np.testing.assert_allclose(outcomes.cost[i], cost[i], atol=1e-5)


def air_of(designs):
    """Air in the chambers of designs [cm^3], as the moulds' volumes have it but for end walls."""
    hands = parameters.params_of(SPACE, designs)
    volumes = []
    for k in range(len(designs)):
        hand = nth(hands, k)
        sizes = process.sizes(THREE.hand, jax.tree.map(np.asarray, hand), process.Process())
        volumes.append(sum(s._replace(end=0.0).chamber_volume for s in sizes) / 1e3)
    return np.array(volumes)


def test_a_row_has_design_noise_and_outcome(place, capsys):
    assert run() == 0
    assert [p.name for p in place.iterdir()] == ["a.parquet"]
    table = pq.read_table("a.parquet")
    rows = {name: np.array(table[name].to_pylist()) for name in table.column_names}
    np.testing.assert_array_equal(rows["design"], np.repeat(np.arange(10), 2))
    np.testing.assert_array_equal(rows["trial"], np.tile([0, 1], 10))
    # The same from the library: draws from the key, and outcomes of the engine's calls.
    drawn = sampling.draw(THREE, SPACE, KEY, first=0, n=12, num_trials=2)
    names = [shape.name for shape in THREE.objects.object]
    assert rows["object"].tolist() == [names[k] for k in np.ravel(drawn.trials.shape)[:20]]
    for name, values in {
        "noise_y_m": drawn.trials.position[..., 1],
        "noise_arm_pitch_rad": drawn.trials.arm_tilt[..., 1],
        "noise_mass_factor": drawn.trials.mass,
        "length_mm": 1e3 * np.repeat(drawn.designs[:, :1], 2, axis=1),
        "arm_z_mm": 1e3 * np.repeat(drawn.designs[:, 1:], 2, axis=1),
    }.items():
        np.testing.assert_allclose(rows[name], np.ravel(values)[:20], rtol=1e-6)
    air = np.repeat(air_of(drawn.designs), 2)[:20]
    # Lengths of moulds are rounded to 0.1 um, walls of millimetres.
    np.testing.assert_allclose(rows["chamber_volume_cm3"], air, rtol=1e-4)
    bad = np.isin(np.arange(20) % 8, [1, 4])
    np.testing.assert_array_equal(rows["status"] == "NONFINITE", bad)
    np.testing.assert_array_equal(rows["verdict"] == "fault", bad)
    np.testing.assert_array_equal(
        rows["verdict"] == "lost", ~bad & np.isfinite(rows["lost_time_s"])
    )
    assert [v is None for v in rows["first_bad_step"]] == (~bad).tolist()
    # The toy engine has no solver: nothing is told of it.
    assert {*rows["steps_at_limit"], *rows["residual"]} == {None}
    counts = {name: int((rows["verdict"] == name).sum()) for name in verdict.VERDICTS}
    shares = ", ".join(f"{name} {n} ({5 * n:.1f} %)" for name, n in counts.items())
    assert f"of 20 grasps: {shares}" in capsys.readouterr().out and counts["lost"] > 0


def test_a_killed_command_goes_on_to_the_same_bytes(place, monkeypatch, capsys):
    assert run(out="whole.parquet") == 0
    assert killed_after(1, monkeypatch) == [0]
    (place / "a.parquet.123.tmp").touch()
    # Without --chunk: as large as the calls that made what is there.
    assert killed_after(1, monkeypatch, chunk=None) == [1]
    capsys.readouterr()
    assert run(chunk=None) == 0
    assert "going on after 2 of 3 calls, from a.parquet.part" in capsys.readouterr().out
    assert (place / "a.parquet").read_bytes() == (place / "whole.parquet").read_bytes()
    assert sorted(p.name for p in place.iterdir()) == ["a.parquet", "whole.parquet"]


@pytest.mark.parametrize(
    ("more", "differ"),
    [
        (("--seed", "4"), "seed"),
        (("--preset", "full", "--trials", "3"), "preset, trials, chunk"),
        (("--set", "gravity=9"), "scene"),
        (("--chunk", "4"), "chunk"),
    ],
)
def test_another_question_is_refused(more, differ, place, monkeypatch, capsys):
    killed_after(1, monkeypatch)
    part = (place / "a.parquet.part" / "0.npz").read_bytes()
    assert run(*more) == 2
    words = f"a.parquet.part has a part of other grasps ({differ} differ); choose another --out"
    assert words in capsys.readouterr().err
    assert (place / "a.parquet.part" / "0.npz").read_bytes() == part


def test_a_file_that_is_there_is_never_replaced(place, monkeypatch, capsys):
    (place / "a.parquet").write_bytes(b"mine")
    assert run() == 2
    assert "--out a.parquet is there already" in capsys.readouterr().err
    assert (place / "a.parquet").read_bytes() == b"mine"


def test_two_processes_do_not_write_one_file(place, capsys):
    part = place / "a.parquet.part"
    part.mkdir()
    with directory.locked(part):
        assert run() == 2
    assert "--out a.parquet.part is in use by process" in capsys.readouterr().err


def test_a_dry_run_tells_the_grasps_and_writes_nothing(place, capsys):
    assert run("--dry-run", designs=1000, trials=6, chunk=None) == 0
    words = capsys.readouterr().out
    assert "1000 designs x 6 trials: 6000 grasps in 12 calls" in words
    assert not list(place.iterdir())
