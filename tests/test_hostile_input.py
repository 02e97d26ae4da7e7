"""Input made to do harm is refused by the project's own error; the harness of `make faults`."""

import base64
import codecs
import errno
import functools
import json
import os
import signal
import subprocess
import sys
import zipfile

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from codesign_jax import engines, make_engine, rollout, scene
from codesign_jax.engines.structured.laws import meshes as lanes
from codesign_jax.runs import scene_files
from codesign_jax.scene import InputError, constants, library, meshes, objects, reach
from codesign_jax.scene.meshes import reading
from codesign_jax.scene.parameters import design_space
from scripts import faults
from scripts.faults import shim  # noqa: F401  (a fixture)
from tests.helpers import tiny_run
from tests.helpers.command_runs import command, own_workplace  # noqa: F401  (a fixture)
from tests.helpers.solids import box, object_file

PAPER = library.available("scenes")["paper_spheres"]


def refusals(call, *arguments, **options):
    with pytest.raises(InputError) as caught:
        call(*arguments, **options)
    return caught.value.problems


# --- files of another kind ------------------------------------------------------------------------

FOREIGN = {
    "a Git LFS pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 684084\n",
    "a web page": b"\n<!DOCTYPE html><html><head><title>404</title></head></html>\n",
    "text in UTF-16": "solid a".encode("utf-16"),
}


@pytest.mark.parametrize("said", FOREIGN)
@pytest.mark.parametrize("kind", ["toml", *reading.FORMATS])
def test_files_of_another_kind_are_named(tmp_path, kind, said):
    path = tmp_path / f"file.{kind}"
    path.write_bytes(FOREIGN[said])
    call = scene.load if kind == "toml" else reading.read
    [problem] = refusals(call, path)
    assert said in problem


@pytest.mark.parametrize("kind", ["toml", "obj", "off", "ply", "stl"])
def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path, kind):
    """Editors of Windows write one."""
    path = tmp_path / f"file.{kind}"
    if kind == "toml":
        path.write_bytes(PAPER.read_bytes())
        read = scene.load
    else:
        how = {"ply": {"encoding": "ascii"}, "stl": {"file_type": "stl_ascii"}}.get(kind, {})
        text = box().export(**({"file_type": kind} | how))
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        read = lambda p: reading.read(p).faces.shape  # noqa: E731
    plain = read(path)
    path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    assert read(path) == plain


# --- TOML ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("gravity = " + "9" * 400, "characters) is outside [0, 100] m/s^2"),
        ("gravity = " + "9" * 5000, "not valid TOML: a whole number has thousands of digits"),
        ("gravity = 0x" + "f" * 5000, "gravity = (int too long to show) is outside"),
        ("gravity = " + "[" * 2000, "not valid TOML: tables and arrays are nested more than"),
        ("gravity = " + "[" * 20 + "]" * 20, "not valid TOML: tables and arrays are nested"),
        ("a" + ".a" * 4000 + " = 1", "not valid TOML: tables and arrays are nested more than"),
        ("#" * 300_000, "has more than 262,144 bytes"),
        ("\n".join(f"x{i} = 1" for i in range(9000)), "has 8,980 more unknown keys"),
        ('x = "\x1b[2J"', "not valid TOML: Illegal character"),
    ],
)
def test_files_that_are_too_much(tmp_path, line, said):
    path = tmp_path / "scene.toml"
    text = PAPER.read_text()
    path.write_text(line + "\n" + text.replace("gravity = 9.81", "", line.startswith("gravity")))
    problems = refusals(scene.load, path)
    assert any(said in p for p in problems), problems
    assert len(problems) < 40 and all(len(p) < 1000 for p in problems)


@pytest.mark.parametrize("name", ["a\u2028b", "a\u0085b", "a\x00b", "\udcff", "a\nb", "x" * 2000])
def test_names_that_no_file_or_table_could_hold(name):
    (problem,) = refusals(scene.load, "paper_spheres", overrides={"hand.name": name})
    assert problem.startswith("hand.name") and problem.isprintable()


def test_an_error_never_speaks_to_the_terminal():
    error = InputError(["a \x1b[2J\x9b and \ud800\u2028"])
    assert str(error) == r"a \x1b[2J\x9b and \ud800\u2028"


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"gravity": 10**400}, "gravity = 1000"),
        ({"gravity": 10**6000}, "too long to show"),
        ({".".join("a" * 3000): 1}, "3,000 parts"),
        ({1: 2}, "1 is no key path"),
        ({(): 2}, "() is no key path"),
        ({"hand.finger." + "9" * 5000 + ".tilt": 1}, "hand.finger has no entry"),
        ({"hand.finger": [{}] * 1001}, "1,001 entries, more than 1,000"),
    ],
)
def test_values_that_are_too_much(overrides, said):
    problems = refusals(scene.load, "paper_spheres", overrides=overrides)
    assert any(said in p for p in problems), problems


def test_a_value_of_several_lines_is_one_text():
    (problem,) = refusals(
        scene.load, "paper_spheres", overrides=scene.keypaths.parse(["gravity=1\nx=2"])
    )
    assert "must be a number" in problem


# --- meshes --------------------------------------------------------------------------------------


def load_mesh(path, **options):
    return meshes.load(path, **{"unit": "m", "repaired": False, "voxel_error": 5e-3} | options)


def test_archives_and_formats_that_are_not_read(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.stl", b"\0" * 1_000_000)
    for name in ("bomb.zip", "bomb.3mf", "bomb.tar.gz", "bomb"):
        (tmp_path / name).write_bytes((tmp_path / "bomb.zip").read_bytes())
        (problem,) = refusals(load_mesh, tmp_path / name)
        assert "no mesh file that is read; valid: .glb" in problem


def test_sizes_of_mesh_files(tmp_path, monkeypatch):
    path = tmp_path / "large.stl"
    with path.open("wb") as file:
        file.truncate(6 << 30)  # sparse
    (problem,) = refusals(load_mesh, path)
    assert "more than 16 MiB" in problem
    box().export(path)
    monkeypatch.setattr(reading, "MOST_FACES", 11)
    (problem,) = refusals(load_mesh, path)
    assert "has 12 faces, more than 11" in problem
    monkeypatch.undo()
    monkeypatch.setattr(objects, "MOST_BYTES", path.stat().st_size)
    entry = 'type = "mesh"; file = "large.stl"; friction = 0.8; mass = 0.1; name = '
    assert len(objects.load(object_file(tmp_path, entry + '"a"')).object) == 1
    (problem,) = refusals(objects.load, object_file(tmp_path, entry + '"a"', entry + '"b"'))
    assert "the meshes have" in problem
    monkeypatch.setattr(meshes.grid, "MAX_WORK", 1e5)
    with pytest.raises(InputError, match="12 faces are too many for a grid of"):
        _ = load_mesh(path).grid


def gltf(tmp_path, change=lambda tree: None):
    """A box as glTF with its numbers inside, after a change of its tree."""
    parts = trimesh.Scene([box()]).export(file_type="gltf")
    tree = json.loads(parts["model.gltf"])
    for buffer in tree["buffers"]:
        data = base64.b64encode(parts[buffer["uri"]]).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{data}"
    change(tree)
    path = tmp_path / "box.gltf"
    path.write_text(json.dumps(tree))
    return path


def test_gltf_holds_all_of_itself_and_does_not_grow(tmp_path):
    whole = load_mesh(gltf(tmp_path))
    assert whole.volume == pytest.approx(0.04 * 0.05 * 0.06)
    assert whole.content == (tmp_path / "box.gltf").read_bytes()

    def elsewhere(tree):
        tree["buffers"][0]["uri"] = "box.bin"

    def doubled(tree):
        """Forty nodes, each twice in the one before: 2^40 boxes."""
        last = len(tree["nodes"])
        tree["nodes"] += [{"children": [last + k + 1] * 2} for k in range(40)] + [{"mesh": 0}]
        tree["scenes"][0]["nodes"] = [last]

    def huge(tree):
        tree["accessors"][0]["count"] = 10**12

    for change, said in (
        (elsewhere, "in another file, 'box.bin'; save it as .glb"),
        (doubled, "a node has two parents"),
        (huge, "more than 200,000 faces"),
    ):
        (problem,) = refusals(load_mesh, gltf(tmp_path, change))
        assert said in problem


def test_numbers_so_large_that_they_have_no_differences(tmp_path):
    far = box()
    far.vertices[0] = 1e300
    far.export(tmp_path / "far.off", digits=17)
    problems = refusals(load_mesh, tmp_path / "far.off", repaired=True)
    assert any("outside [5, 500] mm" in p for p in problems)


def test_a_run_has_the_bytes_that_were_read(tmp_path):
    """Not those of a file that somebody changed since."""
    box(40, 50, 60).export(tmp_path / "box.stl")
    entry = 'name = "a"; type = "mesh"; file = "box.stl"; unit = "mm"; friction = 0.8; mass = 0.1'
    loaded = scene.load("paper_spheres", object_set=object_file(tmp_path, entry))
    box(41, 51, 61).export(tmp_path / "box.stl")
    (tmp_path / "run").mkdir()
    scene_files.write_scene(loaded, tmp_path / "run")
    assert scene.load(tmp_path / "run" / "scene.toml") == loaded


# --- how far distances reach ---------------------------------------------------------------------


def ball(tmp_path, **overrides):
    """A scene of a ball as a mesh."""
    mesh = trimesh.creation.icosphere(3, 0.02)
    mesh.export(tmp_path / "ball.off", digits=17)
    entry = 'name = "a"; type = "mesh"; file = "ball.off"; friction = 0.8; mass = 0.1'
    path = object_file(tmp_path, entry + "; voxel_error = 0.002")
    return scene.load("paper_spheres", object_set=path, overrides=overrides)


@functools.partial(jax.jit, static_argnums=0)
def distances(the_scene, points):
    """Distances from the scene's mesh, as simulated, of points (3, point) in its frame [m]."""
    one = jnp.zeros((1, points.shape[-1]), int)
    half = jnp.asarray(the_scene.objects.object[0].half_sizes, points.dtype)
    size = jnp.broadcast_to(half[:, None, None], (3, 1, points.shape[-1]))
    return lanes.signed_distance(lanes.mesh_lanes(the_scene, one, size), points[:, None])[0][0]


def test_distances_are_known_where_the_contacts_of_tall_fingers_begin(tmp_path):
    """Fingers of 60 mm have spheres of 30 mm; the distance of a ball is known in closed form."""
    usual = ball(tmp_path)
    tall = ball(tmp_path, **{"hand.parameter.height.high": 60})
    assert usual.objects.object[0].mesh.reach == reach.LEAST
    assert reach.contact_radius(tall.hand) == pytest.approx(0.03)
    direction = np.random.default_rng(0).normal(size=(3, 400))
    direction /= np.linalg.norm(direction, axis=0)
    away = np.linspace(0.0, 0.03, 400)
    points = ((0.02 + away) * direction).astype(np.float32)
    # 1280 faces lie up to 0.5 % of the radius below the sphere; the grid has its own bound.
    assert np.abs(distances(tall, points) - away).max() < 1e-3
    late = distances(usual, points) - away
    assert late[away < reach.LEAST].max() < 1e-3 and late.max() > 1e-3  # what was said of it


def test_hands_that_reach_beyond_the_distances_are_refused(tmp_path):
    usual = ball(tmp_path)
    tall = scene.load("paper_spheres", overrides={"hand.parameter.height.high": 80})
    mixed = usual.__class__(**{**vars(usual), "hand": tall.hand})
    (problem,) = refusals(make_engine, "structured", mixed)
    assert "distances reach 14 mm" in problem and "radius 40 mm need" in problem
    wide = usual.constants()
    palm = wide.hand.palm._replace(contact_radius=0.05)
    (problem,) = refusals(constants.check, usual, wide._replace(hand=wide.hand._replace(palm=palm)))
    assert "radius 50 mm" in problem
    space = design_space(usual.hand, "full")
    params = space.params(space.default())
    params = params._replace(height=params.height * 0 + 0.09)
    trial = rollout.nominal_trial(usual)
    one = jax.tree.map(lambda v: np.asarray(v)[None], (params, trial))
    engine = engines.make_engine("structured", usual)
    (problem,) = refusals(rollout.simulate, usual, engine, *one)
    assert "radius 45 mm" in problem


@pytest.mark.parametrize(
    ("radius", "noise", "expected"),
    [(0.0125, 0.05, 0.014), (0.0125, 0.0, 0.014), (0.0125, 0.15, 0.02), (0.05, 0.05, 0.06)],
)
def test_reach(radius, noise, expected):
    assert reach.of(radius, noise) == pytest.approx(expected)


# --- command lines -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ["evaluate", "--run", "a" * 300],
        ["evaluate", "--hand", "a" * 300],
        ["evaluate", "--hand", "a" * 300 + ".toml"],
        ["optimize", "--dry-run", "--out", "a" * 300],
        ["optimize", "--dry-run", "--out", "a\udcffb"],
        ["optimize", "--dry-run", "--set", "hand.name=/elsewhere/x"],
        ["optimize", "--dry-run", "--set", "hand.name=.."],
        ["optimize", "--dry-run", "--chunk", "9" * 400],
        ["optimize", "--dry-run", "--set", "gravity=" + "9" * 5000],
    ],
)
def test_arguments_that_are_refused(arguments, workplace, capsys):
    assert command(*arguments) == 2
    assert capsys.readouterr().err.startswith("error: ") and not os.listdir(workplace)


# --- a few of what `make faults` tries in thousands ----------------------------------------------


@pytest.mark.parametrize(
    ("strategy", "count", "trial"),
    [
        (faults.toml_files(), 30, faults.try_toml),
        (faults.command_lines().map(lambda line: (line,)), 10, faults.try_command),
        (faults.mesh_files(), 10, faults.try_mesh),
    ],
    ids=["toml", "commands", "mesh"],
)
def test_some_mutated_input(strategy, count, trial, tmp_path):
    refused, place = [], tmp_path / "place"
    place.mkdir()

    @faults.often(count)
    @hypothesis.given(strategy)
    def tried(case):
        refused.append(trial(*case, place))

    tried()
    assert any(refused)


def test_objects_are_loaded_without_a_hand(tmp_path):
    box().export(tmp_path / "box.off")
    entry = 'name = "a"; type = "mesh"; file = "box.off"; friction = 0.8; mass = 0.1'
    shape = objects.load(object_file(tmp_path, entry)).object[0]
    assert shape.mesh is not None and shape.mesh.reach == reach.LEAST
    assert shape.mesh.reaching(0.02).reach == 0.02


# --- the harness of make faults -------------------------------------------------------------------


@pytest.mark.parametrize("way", faults.WAYS)
def test_every_damage_changes_what_is_read(way, tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"some bytes of a file")
    faults.damaged(path, way)
    assert not path.is_file() or path.read_bytes() != b"some bytes of a file"


def test_the_comparison_of_runs_can_fail(tmp_path):
    run, other = (tiny_run.copied(tmp_path / name) for name in ("run", "other"))
    assert faults.differences(other, run) == []
    for name in ("trials.csv", "hand.toml"):
        text = (other / name).read_text()
        place = max(i for i, c in enumerate(text) if c.isdigit())
        (other / name).write_text(f"{text[:place]}{(int(text[place]) + 1) % 10}{text[place + 1 :]}")
    (other / "tests.csv").unlink()
    (other / "figures" / "a.tmp").touch()
    assert faults.differences(other, run) == ["trials.csv", "tests.csv", "hand.toml", "a.tmp"]


PROGRAM = """
import os, sys
for k in range(3):
    try:
        with open(os.path.join(sys.argv[1], f"file-{k}"), "wb", buffering=0) as file:
            file.write(b"0123456789")
        os.rename(file.name, file.name.replace("file", "named"))
        os.unlink(file.name.replace("file", "named"))
    except OSError as error:
        print(error.errno)
"""


@pytest.mark.parametrize(
    ("mode", "at", "status", "errors", "left"),
    [
        ("count", 0, 0, [], {}),
        ("killed", 6, -signal.SIGKILL, [], {"file-1": b"01234"}),
        ("full", 6, 0, [errno.ENOSPC] * 2, {"file-1": b""}),
        ("broken", 6, 0, [errno.EIO], {"file-1": b""}),
        ("read-only", 8, 0, [errno.EROFS] * 2, {"named-1": b"0123456789"}),
    ],
)
def test_the_chosen_operation_meets_the_fault(mode, at, status, errors, left, shim, tmp_path):  # noqa: F811
    (place := tmp_path / "place").mkdir()
    command = [sys.executable, "-S", "-c", PROGRAM, place]
    more = shim(place, at, mode)
    done = subprocess.run(command, env=os.environ | more, capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    assert [int(line) for line in done.stdout.split()] == errors
    assert {p.name: p.read_bytes() for p in place.iterdir()} == left
