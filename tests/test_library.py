"""The Python examples of README and docs/library.md run, in their order, on a short grasp."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from toy import TINY

import codesign_jax
from codesign_jax import engines, scene
from codesign_jax.engines.mujoco import MujocoEngine

ROOT = Path(__file__).parents[1]


def blocks(page):
    """Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.S | re.M)


@pytest.fixture
def short(monkeypatch):
    """`scene.load` of a built-in scene gives a grasp of few steps and links instead."""
    load = scene.load
    monkeypatch.setattr(scene, "load", lambda name: load(TINY))


def test_the_front_page_and_the_library_show_the_same_optimisation():
    [front] = blocks("README.md")
    assert front == blocks("docs/library.md")[0]


def test_an_optimisation_as_on_the_front_page(short, capsys, monkeypatch):
    """With MuJoCo C, which needs no kernel; the slow test below has the engine that is named."""
    monkeypatch.setattr(engines, "make_engine", lambda name, scene: MujocoEngine(scene))
    names = {}
    exec(blocks("README.md")[0], names)
    costs = np.array([line.split() for line in capsys.readouterr().out.splitlines()], float)
    assert costs.shape == (10, 2) and np.isfinite(costs).all()
    assert (costs[:, 1] <= costs[:, 0]).all()
    assert names["state"].particles.shape == (10, 2)


@pytest.mark.slow
def test_every_example_of_the_library(short):
    names = {}
    for block in blocks("docs/library.md"):
        exec(block, names)
    assert names["table"].shape == (2, 3)
    assert names["infos"].selection.mean_cost.shape == (5, 4)
    assert names["best"].shape == (2,) and np.isfinite(names["info"].selection.cost).all()
    assert names["by_design"].shape == (2,) and np.isfinite(names["by_design"]).all()
    assert names["outcome"].cost.shape == (2,)


def test_the_public_list_is_there():
    for name in codesign_jax.__all__:
        assert getattr(codesign_jax, name).__name__.rpartition(".")[2] == name
    assert set(codesign_jax.__all__) <= set(dir(codesign_jax))
    with pytest.raises(AttributeError, match="no attribute 'simulator'"):
        codesign_jax.simulator  # noqa: B018


def test_importing_the_package_imports_and_sets_nothing():
    program = """
import os, sys
before = dict(os.environ)
import codesign_jax
from codesign_jax import cli
heavy = {"jax", "mujoco", "numpy", "scipy", "trimesh"} & set(sys.modules)
print(sorted(heavy), dict(os.environ) == before)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[] True"


@pytest.fixture(scope="module")
def imported():
    """What a process prints that imports first the numerical modules and then everything."""
    program = """
import sys
import jax
before = dict(jax.config.values)
import codesign_jax
import codesign_jax.codesign, codesign_jax.runs, codesign_jax.engines.mujoco, codesign_jax.optimize
print([m for m in sys.modules if m.startswith(("matplotlib", "PIL", "codesign_jax.report"))])
for name in codesign_jax.__all__:
    getattr(codesign_jax, name)
import codesign_jax.engines.mjx  # MuJoCo's MJX prints that it lacks an optional package
print([k for k, v in jax.config.values.items() if before.get(k) != v])
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


def test_numerical_modules_need_no_report(imported):
    assert imported[0] == "[]"


def test_importing_everything_leaves_jax_as_it_was_and_says_nothing(imported):
    assert imported[1:] == ["[]"]
