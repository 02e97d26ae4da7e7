"""A stranger's run folder: nothing is opened through a link, run, or printed as it stands.

SECURITY.md names these tests beside its promises.
"""

import copy
import csv
import gc
import io
import json
import os
import re
import signal
import socket
import sys
import time
import types
import unicodedata
import zipfile
from pathlib import Path

import hypothesis
import jax
import mujoco
import numpy as np
import pytest
import rich.table

from codesign_jax import array_files, files, measurements, runs, scene, terminal
from codesign_jax.commands import check, common, status
from codesign_jax.compiler.ffi import KernelUnavailable
from codesign_jax.export import process, sheet
from codesign_jax.judge import fresh_trials
from codesign_jax.judge.stress import Stress
from codesign_jax.report import landscape
from codesign_jax.runs import directory, failures, manifest, progress, reference, tables
from codesign_jax.runs import record as records
from codesign_jax.runs import run as run_of
from codesign_jax.runs.columns import FILES, TABLES
from codesign_jax.scene import InputError, draws, parameters, scene_files, texts
from codesign_jax.scene.meshes import reading
from codesign_jax.types import Outcome, Status
from tests.helpers.command_runs import command, own_workplace  # noqa: F401
from tests.helpers.refusals import refusal, refusal_of_command

DATA = Path(__file__).parent / "data"
HOSTILE = "\x1b]0;owned\x07\nsecond\r\u202e\u2028line"
SHOWN = r"\x1b]0;owned\x07\nsecond\r\u202e\u2028line"


@pytest.fixture
def run(tmp_path):
    """A run of a stranger's."""
    zipfile.ZipFile(DATA / "run_screened.zip").extractall(tmp_path)
    return tmp_path / "screened"


def noted(run, change):
    """Changes what the run's provenance notes."""
    path = run / "provenance.json"
    stored = json.loads(path.read_text())
    change(stored)
    path.write_text(json.dumps(stored))


# --- links and what is no file -------------------------------------------------------------------


def opened(run, scene, settings, **options):
    """Opens a run as a command does, and closes it."""
    with directory.open_run(run, scene, settings, ["codesign"], **options):
        pass


NAMES = {*FILES, *TABLES, manifest.LOCK, "checkpoints/5", "checkpoints/5.sha256"}
NAMES |= {"checkpoints/5/_CHECKPOINT_METADATA", "failures/x.npz", "figures/cost_evolution.png"}


@pytest.mark.parametrize("kind", ["link", "link to nothing", "FIFO"])
def test_no_file_of_a_run_is_opened_through_a_link_or_waited_for(kind, run, tmp_path):
    """Each of its names is refused by all that open it, and what lies outside stays."""
    scene, settings = runs.read_run(run)
    outside = tmp_path / "outside"
    for name in sorted(NAMES):
        place = run / name
        before = tmp_path / "before"
        place.parent.mkdir(exist_ok=True)
        if place.exists():
            place.rename(before)
        if kind == "FIFO":
            os.mkfifo(place)
        else:
            if kind == "link":
                outside.write_text("mine")
            place.symlink_to(outside)
        for fresh in (False, True):
            assert refusal(opened, run, scene, settings, fresh=fresh) == [("file", str(place))]
        assert refusal(runs.load_record, run) == [("file", str(place))]
        assert kind != "link" or outside.read_text() == "mine"
        assert kind != "link to nothing" or not outside.exists()
        place.unlink()
        outside.unlink(missing_ok=True)
        if before.exists():
            before.rename(place)
    assert runs.load_record(run) is not None  # the same folder without them


READERS = {
    "scene.toml": scene.load,
    "design.toml": lambda path: common.open_designs([str(path)]),
    "constants.toml": draws.read,
    "finger.csv": measurements.read,
    "body.stl": reading.read,
    "landscape.npz": landscape.load,
    "failure.npz": failures.load,
    "arrays.npz": array_files.load,
}
"""Files that a flag, or a file that a flag names, may name, and what reads them."""


@pytest.mark.parametrize("kind", ["FIFO", "link to a FIFO", "device", "socket", "folder"])
@pytest.mark.parametrize("name", READERS)
def test_no_file_that_a_flag_names_is_waited_for(name, kind, tmp_path):
    """Bash's <(...) is a FIFO; /dev/zero has no end."""
    path = tmp_path / name
    if kind == "FIFO":
        os.mkfifo(path)
    elif kind == "link to a FIFO":
        os.mkfifo(tmp_path / "fifo")
        path.symlink_to("fifo")
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))
    else:
        path.mkdir()
    with pytest.raises((InputError, OSError, array_files.ArrayFileError), match=re.escape(name)):
        READERS[name](path)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ('=HYPERLINK("http://a","x")', '\'=HYPERLINK("http://a","x")'),
        ("@SUM(1)", "'@SUM(1)"),
        ("+a", "'+a"),
        ("-2+3+cmd|' /C calc'!A0", "'-2+3+cmd|' /C calc'!A0"),
        ("\tx", "'\tx"),
        ("-2.5e-3", "-2.5e-3"),
        ("+inf", "+inf"),
        ("a=b", "a=b"),
        (-2, -2),
    ],
)
def test_no_cell_of_a_table_is_a_formula(text, shown):
    assert texts.cell(text) == shown
    expected = io.StringIO()
    csv.writer(expected, lineterminator="\n").writerow([shown])
    assert tables.written(["a"], [{"a": text}], named=False) == expected.getvalue()


def test_mujoco_leaves_no_file_where_it_warns(tmp_path, capsys):
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    mujoco.mj_saveModel(model, str(tmp_path / "none" / "a.mjb"))
    assert not Path("MUJOCO_LOG.TXT").exists()
    assert "warning: MuJoCo: " in capsys.readouterr().err


@pytest.mark.parametrize("number", [0, 3, 4, 4000])
def test_a_long_list_is_cut(number):
    text = texts.some([f"{k}: it is damaged" for k in range(number)], "; ")
    assert text.count("damaged") == min(number, 3) and len(text) < 100
    assert (f" and {number - 3:,} more" in text) == (number > 3)


def test_a_folder_in_the_place_of_a_run_s_file_is_refused_before_anything_changes(run):
    """Tables, figures' data and results of tests: what is written last would fail last."""
    scene, settings = runs.read_run(run)
    folders = {"checkpoints", "failures", "figures", "meshes", "code"}
    for name in sorted({*FILES, *TABLES} - folders - {"provenance.json", *scene_files.NAMES}):
        place = run / name
        before = place.read_bytes() if place.exists() else None
        place.unlink(missing_ok=True)
        place.mkdir()
        whole = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
        assert refusal(opened, run, scene, settings) == [("file", str(place))]
        after = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
        after.pop(run / manifest.LOCK, None)
        assert after == {p: v for p, v in whole.items() if p.name != manifest.LOCK}
        place.rmdir()
        if before is not None:
            place.write_bytes(before)


def test_a_scene_file_of_a_run_that_is_a_link_is_not_read(run, tmp_path):
    for name in ("provenance.json", "scene.toml", "objects.toml"):
        (run / name).rename(tmp_path / name)
        (run / name).symlink_to(tmp_path / name)
        assert refusal(runs.read_run, run) == [("file", str(run / name))]
        (run / name).unlink()
        (tmp_path / name).rename(run / name)


def test_text_is_appended_to_a_file_of_this_name_alone(tmp_path):
    path, other, link = (tmp_path / name for name in ("log", "copy", "link"))
    files.append(path, "one\n")
    os.link(path, other)
    files.append(path, "two\n")
    assert (path.read_text(), other.read_text()) == ("one\ntwo\n", "one\n")
    link.symlink_to(other)
    with pytest.raises(OSError):
        files.append(link, "three\n")
    assert other.read_text() == "one\n"


def test_a_batch_does_not_run_in_a_folder_that_is_a_link(tmp_path, workplace):
    (tmp_path / "elsewhere").mkdir()
    (workplace / "many").mkdir()
    (workplace / "many" / "seed-1").symlink_to(tmp_path / "elsewhere")
    line = ["optimize", "--scene", "paper_spheres", "--seeds", "0-1", "--out", "many", "--dry-run"]
    assert refusal_of_command(*line) == [("file", "many/seed-1")]


# --- texts ---------------------------------------------------------------------------------------


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(hypothesis.strategies.text(max_size=20))
def test_a_printed_text_is_one_line_without_commands(text):
    shown = terminal.line(text)
    assert not any(unicodedata.category(c) in terminal.CONTROL for c in shown)
    assert shown == text or not text.isprintable()


@pytest.mark.parametrize("errors", ["strict", "surrogateescape"])
@pytest.mark.parametrize("encoding", ["utf-8", "ascii", "latin-1"])
def test_every_way_to_print_shows_what_a_terminal_would_obey(encoding, errors, monkeypatch):
    """Also in encodings that lack a letter, and in the C locale."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors=errors)
    monkeypatch.setattr(sys, "stdout", stream)
    table = rich.table.Table("Größe")
    table.add_row(HOSTILE)
    for console in (terminal.Console(), terminal.Console(file=stream, width=100)):
        console.print(HOSTILE, "[red]日:smile:")
        console.print(table)
    terminal.say(HOSTILE, "日")
    stream.seek(0)
    output = stream.read()
    assert not {*output} & {"\x1b", "\x07", "\r", "\u2028"} and "\nsecond" not in output
    assert output.count(SHOWN) == 5
    assert ("日" if encoding == "utf-8" else r"\u65e5") in output


def test_texts_of_a_run_are_one_line_each_where_it_goes_on(run):
    noted(run, lambda stored: stored["environment"].update(python=HOSTILE))
    scene, settings = runs.read_run(run)
    before = (run / "events.log").read_text().count("\n")
    with directory.open_run(run, scene, settings, ["codesign"]) as (opened, notes):
        opened.log(HOSTILE)
    log = (run / "events.log").read_text()
    assert log.count("\n") == before + len(notes) + 2 and "\x1b" not in log
    assert any(SHOWN in note for note in notes) and not any("\n" in note for note in notes)


def build_sheet(folder, words):
    """A build sheet whose texts from outside are the words."""
    the_scene = scene.load("paper_spheres")
    space = parameters.design_space(the_scene.hand, "full")
    params = jax.tree.map(np.asarray, space.params(space.default()))
    sizes = process.sizes(the_scene.hand, params, process.Process())
    texts = {name: words[0] for name in ("design", "command", "version")}
    origin = {**texts, "objects": words, "notes": words}
    hand = sheet.Hand(the_scene, params, sizes, process.Process())
    tests = sheet.Tests(verdict=words[0], warnings=words)
    return sheet.write(folder, hand, tests, origin, (1.0, 1.0)).read_text()


def test_texts_of_results_are_one_line_each_and_no_html_on_a_sheet(tmp_path):
    kept = {"warnings": np.array([HOSTILE, "<script>"]), "empty": np.array([], str)}
    array_files.save(tmp_path / "x.npz", kept)
    texts = array_files.Array("U", ("n",))
    layout = {"warnings": texts, "empty": texts._replace(shape=("m",))}
    loaded = array_files.load(tmp_path / "x.npz", layout)
    assert loaded["warnings"].tolist() == [SHOWN, "<script>"] and loaded["empty"].shape == (0,)
    harmless = ("a", "b", "c", "d")
    hostile = (HOSTILE, "<img src=x>", "![a](http://b)", "a | b")
    sheets = [build_sheet(tmp_path, words) for words in (harmless, hostile)]
    assert not {*sheets[1]} & {"\x1b", "\r"} and "<" not in sheets[1] and "](" not in sheets[1]
    lines = [text.splitlines() for text in sheets]
    assert len(lines[0]) == len(lines[1])
    cells = [[line.replace("\\|", "").count("|") for line in text] for text in lines]
    assert cells[0] == cells[1]


def test_a_log_without_a_terminal_gets_few_lines_with_counts_and_the_time_left(monkeypatch, capsys):
    """In an hour of simulated time; the clock is a stand-in, as is the thread that ticks."""
    now = [0.0]
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    meter = progress.Meter("stress", 720, terminal.Console())
    for _ in range(720):
        now[0] += 5.0
        meter.advance(1)
        meter.tick()
    lines = capsys.readouterr().err.splitlines()
    assert 5 <= len(lines) <= 12
    assert "of 720 grasps, 0.2 grasps/s, about" in lines[-1] and lines[-1].endswith("so far)")


# --- code, results and checkpoints ---------------------------------------------------------------


@pytest.mark.parametrize("key", ["optimizer", "cost"])
def test_check_imports_nothing_that_a_run_names(key, run, workplace, monkeypatch, capsys):
    """Its simulations are stand-ins: what follows them counts the grasps of a search."""
    (workplace / "stranger.py").write_text("open('executed', 'w')\ndef X(*a): pass\n")
    noted(run, lambda stored: stored["settings"].update({key: "stranger:X"}))

    def simulate(case, settings, levels, options, console):
        size = (2, 3)
        outcomes = Outcome(*(np.zeros(size, int) for _ in range(4)))  # type: ignore[arg-type]
        measured = check.Measured(case.scene, outcomes, 1.0, 0.0)
        return "designs", [measured, measured]

    monkeypatch.setattr(check, "simulate", simulate)
    assert command("check", "--run", run) == 0
    assert not (workplace / "executed").exists() and "stranger" not in sys.modules
    assert "a search (" in capsys.readouterr().out


def stress(**changed):
    arrays = {"conditions": np.array(["as it is"]), "kept": np.array([3]), "trials": np.array(12)}
    return arrays | {"warnings": np.array(["a warning"])} | changed


def outcomes(**changed):
    arrays = dict.fromkeys(("cost", "lost_time"), np.zeros(4, np.float32))
    return arrays | dict.fromkeys(("status", "bad_step"), np.zeros(4, np.int32)) | changed


def test_results_that_are_not_shown_are_told(run, monkeypatch):
    """Damaged, gone, or with arrays that no run has under a right digest: each is a note."""
    monkeypatch.setattr(fresh_trials, "ACCURACY", "fast")
    scene, settings = runs.read_run(run)
    places = run / reference.FILE, run / reference.STRESS_FILE
    abouts = [
        reference.case_of_run(run, accuracy="fast", engine=settings.engine).digest(settings.seed),
        reference.case_of_run(run, engine=settings.engine).digest(
            reference.STRESS_TRIALS, settings.seed
        ),
    ]

    def write(fresh, conditions):
        for place, about, arrays in zip(places, abouts, (fresh, conditions), strict=True):
            array_files.save_results(place, about, arrays)

    write(outcomes(), stress())
    results = reference.kept(run, scene, settings)
    assert results.fresh is not None and isinstance(results.stress, Stress) and not results.notes
    wrong = [
        (outcomes(more=np.zeros(4)), stress()),
        (outcomes(cost=np.zeros((4, 2))), stress()),
        (outcomes(cost=np.array(["a"] * 4)), stress()),
        (outcomes(), stress(kept=np.array([13]))),
        (outcomes(), stress(kept=np.zeros((1, 2)))),
        (outcomes(), stress(trials=np.zeros(2))),
    ]
    for fresh, conditions in wrong:
        write(fresh, conditions)
        [note] = reference.kept(run, scene, settings).notes
        assert "left out" in note
    for place in places:
        write(outcomes(), stress())
        place.write_bytes(place.read_bytes()[:-100])
        [note] = reference.kept(run, scene, settings).notes
        assert note.startswith(f"{place} is damaged") and "left out" in note
        place.unlink()
        [note] = reference.kept(run, scene, settings).notes
        assert note.startswith(f"{place} is missing")


def test_digests_are_compared_before_orbax_opens_a_step(run, caplog):
    """What Orbax cannot parse it logs as a whole."""
    for path in run.glob("checkpoints/*/_CHECKPOINT_METADATA"):
        path.write_text("\x1b[2J{" + "A" * 20_000)
    assert refusal(runs.load_record, run) == [("damaged", f"run {run}")]
    assert not caplog.records


def leaves(arrays, place=()):
    for name, value in arrays.items():
        if isinstance(value, dict):
            yield from leaves(value, (*place, name))
        else:
            yield (*place, name), value


def described(arrays):
    return {"/".join(place): (value.dtype, value.shape) for place, value in leaves(arrays)}


def replaced(arrays, place, value):
    changed = copy.deepcopy(arrays)
    inside = changed
    for name in place[:-1]:
        inside = inside[name]
    inside[place[-1]] = value
    return changed


@pytest.mark.parametrize("archive", ["run_screened", "run_particle_filter"])
def test_arrays_that_no_run_has_are_refused(archive, tmp_path):
    """Each array of a checkpoint with another shape, of another kind, or a table in its place.

    One of the runs has ended with a test.
    """
    zipfile.ZipFile(DATA / f"{archive}.zip").extractall(tmp_path)
    [run] = manifest.runs_inside(tmp_path)
    record = runs.load_record(run)
    settings = runs.read_run(run)[1]
    assert record is not None and (record.test is not None) == (archive != "run_screened")
    arrays = records.to_arrays(record)
    records.refuse_other(records.from_arrays(arrays), settings)
    cases = []
    for place, value in leaves(arrays):
        if "memory" not in place:
            wrong = (value[..., None], value.astype(bool), {"a": value}, np.zeros((0, 0, 0)))
            cases += [(place, other) for other in wrong]
    records.refuse_other_arrays(described(arrays))
    for place, value in cases:  # and so they are before they are read
        with pytest.raises(runs.RunError, match="/".join(map(re.escape, place))):
            records.refuse_other_arrays(described(replaced(arrays, place, value)))
    size = arrays["history"]["ancestors"].shape
    cases += [(("history", "ancestors"), np.full(size, n, np.int32)) for n in (-2, 10**6)]
    cases += [(("state", "episode"), np.array(n, np.int32)) for n in (-1, 10**6)]
    for place, value in cases:
        with pytest.raises(runs.RunError):
            records.refuse_other(records.from_arrays(replaced(arrays, place, value)), settings)


# --- what is not there ---------------------------------------------------------------------------


def failing(error):
    def fail():
        raise error

    return fail


def test_ctrl_c_within_a_callback_of_garbage_collection_is_not_lost():
    """JAX has such a callback, whose exceptions Python ignores; the handler before comes back."""
    sent = []

    def callback(phase, info):
        if not sent:
            sent.append(phase)
            signal.raise_signal(signal.SIGINT)

    def work():
        gc.collect()
        for _ in range(300):  # the signal ends it, whichever thread takes it
            time.sleep(0.1)
        return 0

    gc.collect()  # a finalizer of earlier tests' garbage would take the signal
    gc.freeze()  # so that the next search is a short one
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.callbacks.append(callback)
    try:
        assert status.of(work) == status.INTERRUPTED and sent
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        gc.callbacks.remove(callback)
        signal.signal(signal.SIGINT, before)


def test_what_this_machine_lacks_is_one_line(monkeypatch, capsys):
    assert status.of(failing(KernelUnavailable("no kernels: why"))) == 1
    assert capsys.readouterr().err == "error: no kernels: why\n"
    before = jax.config.jax_platforms
    jax.config.update("jax_platforms", "cuda")
    try:
        for error in (RuntimeError("no cuda"), AssertionError()):
            with monkeypatch.context() as patch:
                patch.setattr(jax, "devices", failing(error))
                assert status.of(failing(error)) == 1
            assert capsys.readouterr().err.startswith("error: JAX_PLATFORMS=cuda asks for a device")
    finally:
        jax.config.update("jax_platforms", before)
    with pytest.raises(RuntimeError, match="a bug"):
        status.of(failing(RuntimeError("a bug")))


@pytest.mark.parametrize(("bad_step", "blamed"), [(-1, True), (7, False)])
def test_a_cost_that_is_no_number_is_blamed_itself(bad_step, blamed):
    status = np.full(4, int(Status.NONFINITE))
    step = np.full(4, bad_step)
    outcome = Outcome(np.zeros(4), status, np.zeros(4), step)  # type: ignore[arg-type]
    with pytest.raises(runs.AllFailed) as error:
        run_of.refuse_all_failed(outcome, Path("r"), "mine:c")
    assert ("--cost mine:c returned NaN" in str(error.value)) == blamed
    assert ("timestep" in str(error.value)) != blamed
