"""The wheel: installed elsewhere it finds its hands, objects and scenes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Folder into which a wheel of this checkout was installed, without its dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    # hatchling is in the test extra: no network, no isolated build environment.
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, *build], check=True)
    [wheel] = folder.glob("*.whl")
    target = folder / "site"
    # What a test imports is compiled then.
    install = ["install", "--no-deps", "--no-compile", "--target", str(target), str(wheel)]
    subprocess.run([*pip, *install], check=True)
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
    found, fingers, meshes, path, works = run_installed(installed, program, tmp_path)
    assert path.startswith(str(installed)) and works
    [entry] = (installed).glob("codesign_jax-*.dist-info/entry_points.txt")
    assert "codesign = codesign_jax.cli:main" in entry.read_text()
    for kind, folder in (("hands", ROOT), ("objects", ROOT), ("scenes", ROOT / "codesign_jax")):
        assert set(found[kind]) == {p.stem for p in (folder / kind).glob("*.toml")}
        assert all(path.startswith(str(installed)) for path in found[kind].values())
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
