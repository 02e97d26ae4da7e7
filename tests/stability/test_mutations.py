"""Planted faults: for each, a quick test of `make test` fails on a copy of the package that has it.

The tests run in a subprocess on the copy, without the fault (they pass) and with it (they fail).
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ("codesign_jax", "scripts", "hands", "objects", "tests", "pyproject.toml")


class Fault(NamedTuple):
    """Replacements in a file of the package, and the quick tests that must notice."""

    file: str
    changes: tuple[tuple[str, str], ...]
    tests: str


FAULTS = {
    "spring sign": Fault(
        "model/spec.py",
        (('{"stiffness": stiffness', '{"stiffness": -stiffness'),),
        "tests/test_beam_oracles.py::test_small_load_cantilever",
    ),
    "friction": Fault(
        "model/pairs.py",
        (("[friction] * 2 + [0.0]", "[friction / 2] * 2 + [0.0]"),),
        "tests/test_contact.py::test_incline_below_the_friction_angle_holds",
    ),
    "time step x 10": Fault(
        "model/spec.py",
        (("o.timestep = scene.disc", "o.timestep = 10 * scene.disc"),),
        "tests/test_beam_oracles.py::test_free_fall",
    ),
    "NaN guard": Fault(
        "judge/verdict.py",
        (("as_bit(~numbers, Status", "as_bit(numbers & ~numbers, Status"),),
        "tests/test_cost.py::test_failures_are_flagged_with_their_step",
    ),
    "key reuse": Fault(
        "codesign/episode.py",
        (("fold_in(jax.random.fold_in(key, stream), index)", "fold_in(key, stream)"),),
        "tests/test_codesign.py::test_noise_differs_between_episodes_seeds_and_the_test",
    ),
    "weight normalisation": Fault(
        "optimize/protocol.py",
        (("weight = weight / weight.sum()", "weight = weight / 1.0"),),
        "tests/test_particle_filter.py::test_weights_follow_the_paper",
    ),
    "checksum": Fault(
        "runs/checkpoint.py",
        (
            ("if file_digest(file) != expected_file", "if not expected_file"),
            (
                'return (arrays, "") if digest(arrays) == expected else',
                'return (arrays, "") if expected else',
            ),
        ),
        "tests/test_checkpoint.py::test_damage_of_any_file_falls_back_to_the_step_before",
    ),
}


def run(copy: Path, tests: str) -> subprocess.CompletedProcess:
    """Runs tests on a copy; markers off, so that a name that is slow would not count as run."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", tests]
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    return subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mutations")
    for part in PARTS:
        source = ROOT / part
        skip = shutil.ignore_patterns("__pycache__")
        if source.is_dir():
            shutil.copytree(source, folder / part, ignore=skip)
        else:
            shutil.copy(source, folder / part)
    return folder


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_can_be_planted(name):
    """Its text is in the code, once."""
    text = (ROOT / "codesign_jax" / FAULTS[name].file).read_text()
    assert [text.count(old) for old, _ in FAULTS[name].changes] == [1] * len(FAULTS[name].changes)


@pytest.mark.slow
@pytest.mark.stability
@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_caught_by_a_quick_test(copy, name):
    fault = FAULTS[name]
    path = copy / "codesign_jax" / fault.file
    sound = path.read_text()
    broken = sound
    for old, new in fault.changes:
        broken = broken.replace(old, new)
    before = run(copy, fault.tests)
    assert before.returncode == 0, before.stdout + before.stderr
    try:
        path.write_text(broken)
        after = run(copy, fault.tests)
    finally:
        path.write_text(sound)
    # 1: tests ran and failed; other codes mean that they did not run.
    assert after.returncode == 1, after.stdout + after.stderr
    assert "failed" in after.stdout and " error" not in after.stdout.splitlines()[-1]
