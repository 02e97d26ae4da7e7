"""Examples of pages and docstrings run, in their order, on a short grasp; the wheel installs.

What examples measure of a grasp, and minimise, tells a held object from a lost one.
"""

import doctest
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest

import codesign_jax
from codesign_jax import engines, rollout, scene
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.types import Trace
from tests.helpers.toy_engine import TINY

ROOT = Path(__file__).parents[1]


def blocks(page):
    """Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.S | re.M)


@pytest.fixture
def short(monkeypatch):
    """`scene.load` of a built-in scene gives a grasp of few steps and links instead."""
    load = scene.load
    monkeypatch.setattr(scene, "load", lambda name: load(TINY))


def test_an_optimisation_as_on_the_front_page(short, capsys, monkeypatch):
    """With MuJoCo C, which needs no kernel; the slow test below has the engine that is named."""
    monkeypatch.setattr(engines, "make_engine", lambda name, scene: MujocoEngine(scene))
    names = {}
    exec(blocks("README.md")[0], names)
    costs = np.array([line.split() for line in capsys.readouterr().out.splitlines()], float)
    assert costs.shape == (10, 2) and np.isfinite(costs).all()
    assert (costs[:, 1] <= costs[:, 0]).all()
    assert names["state"].particles.shape == (10, 2)


class ArmEngine:
    """Its distance is the arm's height."""

    def rollout(self, fields, ctrl, *, trajectory=False):
        """See `Engine.rollout`."""
        height = ctrl[:, :, 2]
        return Trace(height, height, height, jnp.zeros((*height.shape, 0)))


def test_the_derivative_of_the_first_example_of_gradients(monkeypatch, only_heights):
    """Of an engine whose derivative is known."""
    monkeypatch.setattr(engines, "make_engine", lambda name, scene: ArmEngine())
    names = {}
    exec(blocks("docs/gradients.md")[0], names)
    np.testing.assert_allclose(names["value"], 0.03, rtol=1e-6)  # m, of the design there
    np.testing.assert_allclose(names["slope"], [0.0, 1.0], rtol=1e-6)


@pytest.mark.slow
def test_every_example_of_gradients():
    """In the whole scene; the later window is one of an object that is held in the air."""
    names = {}
    for block in blocks("docs/gradients.md"):
        exec(block, names)
    assert names["slope"].shape == (2,) and np.isfinite(names["slope"]).all()
    by_controls = np.asarray(names["by_controls"])
    assert by_controls.shape == (1, 20, 10) and np.isfinite(by_controls).all()
    assert (np.abs(by_controls).max(1) > 0).all()
    assert float(names["later"](names["ctrl"][:, 480:500])) < 0.05  # m


@pytest.mark.slow
def test_every_example_of_the_library(short, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the last example writes a table
    names = {}
    for block in blocks("docs/library.md"):
        exec(block, names)
    assert names["table"].shape == (2, 3)
    assert names["infos"].selection.mean_cost.shape == (5, 4)
    assert names["best"].shape == (2,) and np.isfinite(names["info"].selection.cost).all()
    assert names["outcome"].cost.shape == (2,)
    assert pyarrow.parquet.read_metadata("grasps.parquet").num_rows == 600


@pytest.fixture
def only_heights(monkeypatch):
    """Worlds are prepared without model fields, which would compile for seconds."""

    def prepare(the_scene, params, trials, engine):
        ctrl = jnp.tile(params.arm[:, None, 2:3], (1, the_scene.num_steps, 3))
        return None, ctrl

    monkeypatch.setattr(rollout, "prepare", prepare)
    monkeypatch.setattr(rollout, "invalid_start", lambda *_: jnp.zeros(1, jnp.int32))


def test_the_public_list_is_there():
    for name in codesign_jax.__all__:
        assert getattr(codesign_jax, name).__name__.rpartition(".")[2] == name
    assert set(codesign_jax.__all__) <= set(dir(codesign_jax))
    with pytest.raises(AttributeError, match="no attribute 'simulator'"):
        codesign_jax.simulator  # noqa: B018


def test_importing_imports_and_sets_nothing():
    """Not the package; and all of it leaves JAX as it was and says nothing."""
    program = """
import os, sys
before = dict(os.environ)
import codesign_jax
from codesign_jax import cli
heavy = {"jax", "mujoco", "numpy", "scipy", "trimesh"} & set(sys.modules)
print(sorted(heavy), dict(os.environ) == before)
import jax
before = dict(jax.config.values)
for name in codesign_jax.__all__:
    getattr(codesign_jax, name)
import codesign_jax.engines.mujoco, codesign_jax.runs
import codesign_jax.engines.mjx  # MuJoCo's MJX prints that it lacks an optional package
print([k for k, v in jax.config.values.items() if before.get(k) != v])
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["[] True", "[]"]


FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def examples(name):
    """Tests of a public name: its own docstring and, of a module, those of what it defines."""
    tests = doctest.DocTestFinder(exclude_empty=True).find(getattr(codesign_jax, name), name)
    return [test for test in tests if test.examples]


# They compile kernels of the default scene, 20 s; quick: test_policy, the same calls.
LONG = {"env", "policy"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in codesign_jax.__all__]
)
def test_examples_are_right(name, capsys):
    tests = examples(name)
    assert tests, f"codesign_jax.{name} has no example"
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    for test in tests:
        test.globs = {}  # an example imports what it takes
        runner.run(test)
    assert not runner.failures, capsys.readouterr().out


# --- the wheel: installed elsewhere it finds its files --------------------------------------------


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Folder into which a wheel of this checkout was unpacked, as an installer does.

    `make release` has pip install one, with its dependencies.
    """
    folder = tmp_path_factory.mktemp("wheel")
    # hatchling, the build backend, is in the test extra.
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    [wheel] = folder.glob("*.whl")
    target = folder / "site"
    zipfile.ZipFile(wheel).extractall(target)
    return target


def run_installed(installed, program, cwd):
    """Runs a program that sees the installed package before the checkout, from another folder."""
    environment = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=cwd,
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(done.stdout)


def test_installed_wheel_starts_and_finds_its_files(installed, tmp_path):
    program = """
import contextlib, io, json
from codesign_jax import cli, scene
from codesign_jax.scene import library, objects
found = {kind: {n: str(p) for n, p in library.available(kind).items()}
         for kind in ("hands", "objects", "scenes")}
loaded = {name: scene.load(hand_name=name).num_fingers for name in found["hands"]}
meshes = {s.name: str(s.mesh.path) for s in objects.load("household").object}
text = io.StringIO()
with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
    cli.main(["--help"])
print(json.dumps([found, loaded, meshes, cli.__file__, "optimize" in text.getvalue()]))
"""
    files, fingers, meshes, path, works = run_installed(installed, program, tmp_path)
    assert path.startswith(str(installed)) and works
    [entry] = (installed).glob("codesign_jax-*.dist-info/entry_points.txt")
    assert "codesign = codesign_jax.cli:main" in entry.read_text()
    for kind, folder in (("hands", ROOT), ("objects", ROOT), ("scenes", ROOT / "codesign_jax")):
        assert set(files[kind]) == {p.stem for p in (folder / kind).glob("*.toml")}
        assert all(path.startswith(str(installed)) for path in files[kind].values())
    assert len(meshes) == 8 and all(path.startswith(str(installed)) for path in meshes.values())
    assert fingers["pneuflex4"] == 4 and fingers["tripod3"] == 3


def test_wheel_carries_every_module(installed):
    def modules(folder):
        kinds = (".py", ".js", ".css")  # the report's viewer is no module
        return {p.relative_to(folder) for p in folder.rglob("*") if p.suffix in kinds}

    assert modules(installed / "codesign_jax") == modules(ROOT / "codesign_jax")


HIDDEN = """
import ctypes

class Hidden(ctypes.CDLL):
    def __init__(self, name, *rest, **more):
        if "EGL" in str(name):
            raise OSError(f"{name}: cannot open shared object file")
        super().__init__(name, *rest, **more)

ctypes.CDLL, ctypes.cdll = Hidden, ctypes.LibraryLoader(Hidden)
"""


def test_simulation_needs_no_opengl(tmp_path):
    """A way that is named and not there, of a machine without libEGL: MuJoCo is imported."""
    (tmp_path / "sitecustomize.py").write_text(HIDDEN)
    script = "import codesign_jax, mujoco, os; codesign_jax.model; print(os.environ['MUJOCO_GL'])"
    environment = os.environ | {"MUJOCO_GL": "egl", "PYTHONPATH": f"{tmp_path}:{ROOT}"}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "egl\n"), done.stderr
