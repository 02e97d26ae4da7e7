"""Run folders: nothing is deleted that is not a run's."""

import os
import shutil

import pytest

from codesign_jax import runs, scene
from codesign_jax.runs import directory, scene_files
from codesign_jax.runs.directory import open_run
from codesign_jax.scene.schema import InputError
from tests.helpers.command_runs import command, own_workplace, snapshot, without  # noqa: F401
from tests.helpers.tiny_run import RUN, copied
from tests.helpers.toy_engine import tiny

SETTINGS = runs.make_settings("2d", "concurrent", "control", "mujoco", 0, particles=4, episodes=2)


@pytest.fixture
def run(tmp_path):
    """A finished run of its own."""
    return copied(tmp_path / "run")


def start(folder, **how):
    """Opens a run folder and closes it again; returns its notes."""
    with open_run(folder, tiny()[0], SETTINGS, ["codesign", "optimize"], **how) as (_, notes):
        return notes


@pytest.fixture
def mine(tmp_path):
    """A folder with a user's own scene, as a run would name its files."""
    folder = tmp_path / "mine"
    (folder / "meshes").mkdir(parents=True)
    scene_files.write_scene(tiny()[0], folder)
    (folder / "hand.toml").write_text("# years of work\n" + (folder / "hand.toml").read_text())
    (folder / "meshes" / "capsule.stl").write_text("solid")
    return folder


@pytest.mark.parametrize("more", [(), ("--fresh",)])
def test_a_users_own_scene_stays_where_it_is(more, mine, capsys):
    before = snapshot(mine)
    own = ["optimize", "--scene", mine / "scene.toml", "--engine", "mujoco", "--out", mine]
    assert command(*own, *more) == 2
    error = capsys.readouterr().err
    assert f"{mine} holds control.toml, hand.toml, meshes/capsule.stl and 2 more" in error
    assert "choose another folder" in error
    assert snapshot(mine) == before and not (mine / ".lock").exists()


@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize("left", [None, ["landscape.npz", "report.html"], ["scene.toml"]])
def test_what_is_no_run_is_not_cleared(left, fresh, run, capsys):
    """A run that lost provenance.json, results alone, and a scene."""
    for path in run.iterdir():
        if path.name == "provenance.json" or (left and path.name not in left):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name in left or ():
        (run / name).touch()
    before = snapshot(run)
    assert command(*RUN, "--out", run, *(["--fresh"] if fresh else [])) == 2
    error = capsys.readouterr().err
    assert "and no provenance.json" in error and "Nothing was changed" in error
    assert ("put that back from a copy" in error) == (left is None)
    assert snapshot(run) == before


@pytest.mark.parametrize("moment", range(5))
def test_a_start_that_was_cut_short_goes_on(moment, tmp_path, monkeypatch):
    """At any file that it writes: provenance.json and four of the scene."""
    folder, replace, count = tmp_path / "run", os.replace, [0]

    def killed(source, target):
        if count[0] == moment:
            shutil.copy(source, f"{target}.4711.tmp")  # which a kill leaves
            raise KeyboardInterrupt
        count[0] += 1
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            start(folder)
    assert (folder / "provenance.json").exists() == (moment > 0)
    if moment == 3:  # and what somebody has changed since then stays
        text = (folder / "hand.toml").read_text()
        (folder / "hand.toml").write_text("# my own\n")
        before = snapshot(folder)
        with pytest.raises(InputError, match=r"hand.toml.* since the run was made"):
            start(folder)
        assert snapshot(folder) == before
        (folder / "hand.toml").write_text(text)
    start(folder)
    names = [".lock", "control.toml", "events.log", "hand.toml", "objects.toml"]
    names += ["provenance.json", "scene.toml"]
    assert sorted(os.listdir(folder)) == names
    assert scene.load(folder / "scene.toml") == tiny()[0]


@pytest.mark.parametrize("kind", ["file", "folder", "link", "dangling"])
def test_fresh_deletes_no_file_that_is_not_the_runs(kind, run, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "picture.png").touch()
    if kind == "file":
        (run / "figures" / "my own.png").touch()
    elif kind == "folder":
        (run / "tests.csv").unlink()
        (run / "tests.csv").mkdir()
    else:
        (run / "failures").symlink_to(other if kind == "link" else tmp_path / "nowhere")
    before = snapshot(run)
    with pytest.raises(InputError) as refused:
        start(run, fresh=True)
    words = {"file": "figures/my own.png in", "folder": "tests.csv in"}
    assert words.get(kind, "failures in") in str(refused.value)
    assert snapshot(run) == before and (other / "picture.png").exists()


def test_a_run_has_no_files_but_its_own(run):
    """What `--fresh` deletes is all that a run makes."""
    assert command("report", run, "--no-replay") == 0
    directory._refuse_to_delete(run)
    directory._delete_run(run)
    assert os.listdir(run) == [".lock"]
