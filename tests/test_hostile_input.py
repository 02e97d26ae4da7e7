"""Input made to do harm is refused by the project's own error."""

import base64
import json
import zipfile

import hypothesis
import pytest
import trimesh

from codesign_jax import scene
from codesign_jax.runs import scene_files
from codesign_jax.scene import InputError, library, meshes
from codesign_jax.scene.meshes import reading
from scripts import faults
from scripts.faults import shim  # noqa: F401  (a fixture)
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


# --- TOML ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("gravity = " + "9" * 400, "characters) is outside [0, 100] m/s^2"),
        ("gravity = " + "9" * 5000, "not valid TOML: a whole number has thousands of digits"),
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


def test_an_error_never_speaks_to_the_terminal():
    error = InputError(["a \x1b[2J\x9b and \ud800\u2028"])
    assert str(error) == r"a \x1b[2J\x9b and \ud800\u2028"


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"gravity": 10**6000}, "too long to show"),
        ({".".join("a" * 3000): 1}, "3,000 parts"),
        ({(): 2}, "() is no key path"),
        ({"hand.finger." + "9" * 5000 + ".tilt": 1}, "hand.finger has no entry"),
        ({"hand.finger": [{}] * 1001}, "1,001 entries, more than 1,000"),
    ],
)
def test_values_that_are_too_much(overrides, said):
    problems = refusals(scene.load, "paper_spheres", overrides=overrides)
    assert any(said in p for p in problems), problems


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


def test_a_run_has_the_bytes_that_were_read(tmp_path):
    """Not those of a file that somebody changed since."""
    box(40, 50, 60).export(tmp_path / "box.stl")
    entry = 'name = "a"; type = "mesh"; file = "box.stl"; unit = "mm"; friction = 0.8; mass = 0.1'
    loaded = scene.load("paper_spheres", object_set=object_file(tmp_path, entry))
    box(41, 51, 61).export(tmp_path / "box.stl")
    (tmp_path / "run").mkdir()
    scene_files.write_scene(loaded, tmp_path / "run")
    assert scene.load(tmp_path / "run" / "scene.toml") == loaded


# --- a few of what `make faults` tries in thousands ----------------------------------------------


@pytest.mark.parametrize(
    ("strategy", "count", "trial"),
    [
        (faults.toml_files(), 30, faults.try_toml),
        (faults.mesh_files(), 10, faults.try_mesh),
    ],
    ids=["toml", "mesh"],
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
