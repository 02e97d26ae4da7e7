"""`--dry-run`: how many grasps, with nothing simulated and nothing written."""

import dataclasses
import re

import pytest

from codesign_jax import cli, objects, scene
from codesign_jax.engines.mujoco import MujocoEngine
from tests.helpers.toy_engine import TINY

SUBJECT = ("--scene", str(TINY), "--engine", "mujoco", "--dry-run")


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    """An empty working directory, and an engine that must not simulate."""

    def never(*arguments, **flags):
        raise AssertionError("something was simulated")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(MujocoEngine, "rollout", never)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def dry_run(capsys, command, *arguments):
    """What the command prints."""
    assert cli.main([command, *SUBJECT, *map(str, arguments)]) == 0
    return capsys.readouterr().out


def test_optimize_says_that_the_test_has_whole_rounds(workplace, capsys):
    sizes = ["--trials", 4, "--test-trials"]
    words = "final test: 48 of these grasps, 8 trials of 6 particles"
    assert f"{words}, in whole rounds of 4\n" in dry_run(capsys, "optimize", *sizes, 6)
    assert f"{words}\n" in dry_run(capsys, "optimize", *sizes, 8)


def test_optimize_counts_the_test_at_reference(workplace, capsys):
    output = dry_run(capsys, "optimize", "--reference-trials", 70)
    assert "reference test: 70 grasps at accuracy reference" in output
    output = dry_run(capsys, "optimize")  # this engine has no such test by default
    assert "reference" not in output.split("---- settings")[1]
    assert list(workplace.iterdir()) == []


def test_robust_widens_the_noise_of_the_scene_and_set_still_holds(workplace, capsys):
    noise = dataclasses.asdict(objects.ROBUST) | {"mass": 0.02}
    output = dry_run(capsys, "optimize", "--robust", "--set", "objects.noise.mass=0.02")
    table = output.split("[noise]")[1].split("[table]")[0]
    assert {n: float(v) for n, v in re.findall(r"(\w+) = ([\d.]+)", table)} == noise
    usual = dataclasses.asdict(scene.load(TINY).objects.noise)
    assert all(noise[name] > usual[name] for name in noise if name not in ("mass", "tilt"))


def test_evaluate_and_landscape(workplace, capsys):
    output = dry_run(capsys, "evaluate", "--trials", 50, "--render", "grasp.png")
    assert "grasps: 50\n" in output
    output = dry_run(capsys, "landscape", "--points", 30, "--trials", 6)
    # 85 points of 6 grasps are at most 512 worlds; 900 points are 11 calls of equal size.
    assert "grasps: 5400 in 11 calls" in output
    assert list(workplace.iterdir()) == []
    assert cli.main(["landscape", *SUBJECT, "--points", "1"]) == 2
