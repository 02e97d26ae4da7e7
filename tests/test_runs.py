"""Run folders: scene files, settings, tables, signals, and what is deleted of them."""

import csv
import dataclasses
import os
import re
import shutil
import threading
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import codesign, files, optimize, rollout, runs, scene
from codesign_jax.compiler import handlers
from codesign_jax.judge import fresh_trials, stress
from codesign_jax.judge.cases import Case
from codesign_jax.runs import columns, directory, reference, tables
from codesign_jax.runs import record as records
from codesign_jax.runs import settings as settings_module
from codesign_jax.runs.directory import open_run
from codesign_jax.runs.plan import finalists as finalists_of_plan
from codesign_jax.runs.programs import Programs
from codesign_jax.runs.record import Record
from codesign_jax.scene import library, parameters, scene_files
from codesign_jax.scene.scene_files import write_scene
from codesign_jax.scene.schema import InputError
from tests.helpers import grasps
from tests.helpers.command_runs import RUN, command, copied, own_workplace, snapshot, without  # noqa: F401
from tests.helpers.toy_engine import frozen, tiny

ROOT = Path(__file__).parent.parent


def settings(**changes):
    """The paper's 2D settings, changed."""
    base = {"preset": "2d", "schedule": "concurrent", "first": "control", "engine": "mujoco"}
    base |= {"seed": 0, "particles": 4, "trials": 2, "episodes": 3, "test_trials": 3}
    return settings_module.make_settings(**(base | changes))


@pytest.fixture(scope="module")
def toy_run():
    """A toy run of three episodes: scene, space, record and final test."""
    the_scene, space, engine = tiny()
    s = settings()
    optimizer = codesign.make_filter(space)
    episode = partial(codesign.Task(the_scene, space, s.trials, engine).episode, optimizer)
    state = optimizer.init(jax.random.key(0), np.array([0.05, 0.0]), s.particles)
    record = Record(state, records.empty_history(s, space.num_parameters))
    for e in range(s.episodes):
        record.state, info = episode(record.state, np.ones(2, bool))
        records.add_report(record.history, e, info)
    particles = record.state.particles
    key = record.state.key
    keys = [codesign.test_key(key, k) for k in range(s.test_rounds)]
    tests = [frozen(optimizer, particles, key) for key in keys]
    parts = [record.last_outcomes(), *(episode(*test)[1].outcomes for test in tests)]
    record.test = jax.tree.map(lambda *v: np.concatenate(v, axis=1), *parts)
    test = codesign.summarize_test(the_scene, record.test)
    return the_scene, space, record, test


@pytest.mark.parametrize("hand", sorted(library.available("hands")))
@pytest.mark.parametrize("name", sorted(library.available("scenes")))
def test_resolved_scene_reads_back_the_same(tmp_path, name, hand):
    original = scene.load(name, hand_name=hand, overrides={"discretization": {"links": 7}})
    write_scene(original, tmp_path)
    again = scene.load(tmp_path / "scene.toml")
    assert again == original and hash(again) == hash(original)
    assert parameters.design_space(again.hand) == parameters.design_space(original.hand)


def test_sizes_default_to_the_papers():
    def of(preset, optimizer="particle-filter", objects=3):
        s = settings_module.make_settings(
            preset, "concurrent", "control", "mujoco", 0, optimizer=optimizer, objects=objects
        )
        return s.particles, s.trials, s.episodes, s.test_trials

    assert of("2d") == (10, 6, 64, 36)
    assert of("23d") == (60, 6, 128, 72)
    # The default optimiser's: each of its trials is one with another object.
    assert of("23d", optimize.DEFAULT) == (25, 3, 30, 48)
    assert of("full", optimize.DEFAULT, objects=8) == (25, 8, 30, 48)
    assert of("full", optimize.DEFAULT, objects=1) == (25, 3, 30, 48)
    # Its final test simulates three averages, or designs of 2D, and no copies of them.
    for preset, expected in (("23d", 30 * 75 + 3 * 48), ("2d", 22 * 36 + 3 * 48)):
        made = settings_module.make_settings(
            preset, "concurrent", "control", "structured", 0, optimizer=optimize.DEFAULT
        )
        assert runs.prepare(scene.load(), made).grasps == expected


@pytest.mark.parametrize(
    ("preset", "episodes", "finalists"),
    [("2d", 1, 3), ("2d", 6, 3), ("full", 1, 8), ("full", 6, 3)],
)
def test_the_planned_test_is_the_one_that_is_simulated(preset, episodes, finalists):
    """A search for many parameters that ends among its random designs tests all of them."""
    run_settings = settings(
        preset=preset, particles=8, episodes=episodes, optimizer=optimize.DEFAULT
    )
    plan = runs.prepare(tiny()[0], run_settings)
    state = plan.optimizer.init(jax.random.key(0), plan.space.default(), run_settings.particles)

    @jax.jit
    def episode(state, mask):
        population = plan.optimizer.ask(state, mask)
        return plan.optimizer.tell(state, population, jnp.arange(8.0), mask)[0]

    for mask in plan.mask:
        state = episode(state, mask)
    tested, _ = finalists_of_plan(plan, np.asarray(state.particles))
    assert len(tested) * run_settings.trials * run_settings.test_rounds == plan.test_grasps
    assert len(tested) == finalists


def test_settings_report_every_problem():
    bad = settings(preset="3d", engine="mujco", particles=0, trials=-1, seed=-5, schedule="x")
    text = "\n".join(settings_module.check(bad, scene.load().hand))
    for part in ("--preset '3d'", "did you mean 'mujoco'", "--particles = 0", "[1, 32768]"):
        assert part in text
    for part in ("--trials = -1", "--seed = -5", "--schedule: unknown schedule 'x'"):
        assert part in text
    assert settings_module.check(settings(), scene.load().hand) == []


class Compiled:
    """Programs that end when they are told to, in place of a compiler."""

    def __init__(self, *names):
        self.begun = []
        self.ends = {name: threading.Event() for name in names}
        self.programs = Programs({name: partial(self._compile, name) for name in names})

    def _compile(self, name):
        self.begun.append(name)
        self.ends[name].wait()
        if name == "broken":
            raise RuntimeError("whoever needs the program meets this")


def test_programs_are_compiled_one_behind_another_while_others_run():
    compiled = Compiled("fine", "broken", "last")
    with compiled.programs as programs:
        assert programs.words() == "compiling 1 of 4" and not compiled.begun
        programs.begin()
        assert programs.words("last") == "compiling 4 of 4"
        said = []

        def tell(words):
            """The wait is told before it begins: only then may the program end."""
            said.append(words)
            for event in [*compiled.ends.values()][:2]:
                event.set()

        programs.wait("broken", tell)
        assert said == ["compiling 3 of 4", ""]
        assert programs.words("fine") == programs.words("broken") == ""
        programs.wait("another's", said.append)  # is compiled where it is used
        assert said[2:] == ["compiling"]
        compiled.ends["last"].set()
    assert compiled.begun == ["fine", "broken", "last"]
    assert Programs().words() == "compiling"


def test_a_command_that_ends_waits_for_one_program_and_begins_no_other():
    compiled = Compiled("first", "second")
    with compiled.programs as programs:
        programs.begin()
        while not compiled.begun:
            time.sleep(0.01)
        threading.Timer(0.3, compiled.ends["first"].set).start()
    assert compiled.ends["first"].is_set() and compiled.begun == ["first"]
    interrupted = Compiled("first")
    with pytest.raises(KeyboardInterrupt), interrupted.programs as programs:
        programs.begin()
        raise KeyboardInterrupt  # ends at once, though the program never does
    interrupted.ends["first"].set()


@pytest.mark.slow  # five kernels; the test above has the order in which they are compiled
def test_what_is_compiled_during_a_search_is_what_its_tests_run(monkeypatch):
    made = settings(preset="2d", engine="structured", optimizer=optimize.DEFAULT)
    plan = runs.prepare(grasps.short_grasp(), made)
    case = Case(plan.scene, plan.space, plan.space.default(), "structured")
    case.compile(reference.STRESS_TRIALS, rollout.Options())  # as a search does
    compiled = []
    register = handlers.register

    def counting(name, *arguments):
        compiled.append(name)
        register(name, *arguments)

    monkeypatch.setattr(handlers, "register", counting)
    said = []
    with reference.programs_of(plan, 20) as programs:
        names = [reference.FRESH, stress.RECORDED, stress.OTHER_LAW]
        assert [programs.words(n)[:11] for n in names] == [f"compiling {k}" for k in (2, 3, 4)]
        for name in names:
            programs.wait(name, said.append)
    assert len(compiled) == 3
    finer = case._replace(scene=scene.with_accuracy(plan.scene, fresh_trials.ACCURACY))
    finer.simulate(20, jax.random.key(0))
    stress.simulate(case, reference.STRESS_TRIALS, jax.random.key(0))
    assert len(compiled) == 3


def read(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def test_tables_hold_the_history_with_units(toy_run, tmp_path):
    the_scene, space, record, test = toy_run
    tables.write_run(tmp_path, the_scene, space, record)
    history = record.history
    trials = read(tmp_path / "trials.csv")
    assert [np.float32(r["cost"]) for r in trials] == history.outcomes.cost.ravel().tolist()
    assert {r["object"] for r in trials} == {"sphere"}
    assert {r["status"] for r in trials} == {"OK"}
    lengths = [float(r["length_mm"]) for r in read(tmp_path / "particles.csv")]
    np.testing.assert_allclose(lengths, 1e3 * history.population[..., 0].ravel(), rtol=1e-6)
    episodes = read(tmp_path / "episodes.csv")
    assert [int(r["episode"]) for r in episodes] == [1, 2, 3]  # as the console counts
    for row, cost in zip(episodes, history.cost, strict=True):
        assert np.float32(row["best_cost"]) == cost.min()
    rows = read(tmp_path / "tests.csv")
    assert [int(r["trials"]) for r in rows] == [6] * 4  # three in two rounds of two, and two before
    assert [np.float32(r["test_cost"]) for r in rows] == np.asarray(test.cost).tolist()


def test_every_file_and_column_is_described_on_the_page(toy_run, tmp_path):
    the_scene, space, record, test = toy_run
    tables.write_run(tmp_path, the_scene, space, record)
    assert {p.name for p in tmp_path.glob("*.csv")} == {*columns.TABLES}
    head, *sections = (ROOT / "docs" / "files.md").read_text(encoding="utf-8").split("\n## ")
    assert {*re.findall(r"^\| `(\S+)` \|", head, re.M)} == columns.FILES | {*columns.TABLES}
    named = {s.split("\n")[0]: re.findall(r"^\| `(\w+)` \|", s, re.M) for s in sections}
    sampled = named.pop("The Parquet file of `codesign sample`")
    assert sampled == ["design", *columns.OF_DESIGNS]
    assert named.pop("A table of forces") == []  # its columns are of the hand's fingers
    assert named == {n: [*t.columns] for n, t in (columns.TABLES | columns.MORE).items()}


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "file.txt"
    with pytest.raises(FileNotFoundError), files.atomically(path):
        pass
    files.make_folder_of(path)
    with files.atomically(path) as part:
        part.write_text("old")
        assert not path.exists()
    with pytest.raises(RuntimeError), files.atomically(path) as part:
        part.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(path.parent.iterdir()) == [path]


# --- run folders: nothing is deleted that is not a run's ------------------------------------------


SETTINGS = runs.make_settings("2d", "concurrent", "control", "mujoco", 0, particles=4, episodes=2)


@pytest.fixture
def run(tmp_path):
    """A finished run of its own."""
    return copied(tmp_path / "run")


def start(folder, **options):
    """Opens a run folder and closes it again; returns its notes."""
    with open_run(folder, tiny()[0], SETTINGS, ["codesign", "optimize"], **options) as (_, notes):
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
    arguments = ["optimize", "--scene", mine / "scene.toml", "--engine", "mujoco", "--out", mine]
    assert command(*arguments, *more) == 2
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
    folder = tmp_path / "run"
    replace = os.replace
    count = [0]

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
    assert words.get(kind, "failures is a symbolic link") in str(refused.value)
    assert snapshot(run) == before and (other / "picture.png").exists()


def test_a_run_has_no_files_but_its_own(run):
    """What `--fresh` deletes is all that a run makes."""
    assert command("report", run, "--no-replay") == 0
    directory._refuse_to_delete(run)
    directory._delete_run(run)
    assert os.listdir(run) == [".lock"]


@pytest.mark.parametrize("way", ["moved", "deleted", "replaced", "link"])
def test_a_run_writes_nothing_once_its_folder_is_another(way, tmp_path):
    """It says where its data are; the folder is not made again, and another's stays as it is."""
    path = tmp_path / "run"
    moved = tmp_path / "moved"
    scene = tiny()[0]
    with open_run(path, scene, SETTINGS, ["codesign", "optimize"]) as (folder, _):
        folder.log("before")
        path.rename(moved)
        if way == "deleted":
            shutil.rmtree(moved)
        elif way == "replaced":
            path.mkdir()
            (path / ".lock").touch()
        elif way == "link":  # the same folder by another way is not another one
            path.symlink_to(moved)
            folder.log("after")
            return
        before = [*path.rglob("*")]
        expected = "data are lost" if way == "deleted" else f"--out {moved}"
        for write in (folder.here, lambda: folder.log("after")):
            with pytest.raises(runs.RunError, match=re.escape(expected)):
                write()
        assert [*path.rglob("*")] == before


def test_results_are_added_to_the_run_that_has_ended_alone(run, tmp_path):
    """Its folder may be moved, or another's put in its place, while its design is tested again."""
    settings = runs.read_run(run)[1]
    with runs.reopened(run, settings) as folder:
        assert folder.here() == run
        run.rename(tmp_path / "moved")
        with pytest.raises(runs.RunError, match="data are in .*moved"):
            folder.here()
    shutil.copytree(tmp_path / "moved", run)
    other = dataclasses.replace(settings, seed=settings.seed + 1)
    with pytest.raises(InputError, match="of another run"), runs.reopened(run, other):
        pass
