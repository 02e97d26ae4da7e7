"""The command line: wrong input is said in words and creates nothing; Ctrl-C."""

import signal
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path

import pytest

from codesign_jax import cli, terminal
from codesign_jax.commands import status
from codesign_jax.judge import cases
from codesign_jax.scene import library
from tests.helpers.command_runs import EPISODES, RUN, command, finished_run, own_workplace  # noqa: F401
from tests.helpers.refusals import refusal_of_command
from tests.helpers.toy_engine import TINY


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("optimise --preset 2d", "available subcommands: optimize"),
        ("evaluate --trails 12", "--trials"),
        ("optimize --particles ten", "--particles"),
    ],
)
def test_a_mistyped_command_is_refused_by_the_parser(line, words, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(line.split())
    assert stop.value.code == 2
    assert words in capsys.readouterr().err.lower()


def test_help_imports_nothing_heavy():
    program = """
import sys, typing
from codesign_jax import cli, terminal
names = [command.__name__.lower() for command in typing.get_args(cli.COMMANDS)]
for arguments in (["--help"], *([name, "--help"] for name in names)):
    try:
        cli.main(arguments)
    except SystemExit as stop:
        assert stop.code == 0
heavy = {"jax", "numpy", "mujoco", "orbax", "matplotlib"} & set(sys.modules)
assert not heavy, heavy
"""
    subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.DEVNULL)


# Lines after the name of the program, and kind and key of each problem.
WRONG = {
    "optimize --schedule switch-64": [("conflict", "--schedule")],
    "optimize --optimizer cma-es --particles 1": [("unknown", "--optimizer")],
    "optimize --particles 0": [("range", "--particles")],
    "optimize --set discretization.links=3.5": [("type", "discretization.links")],
    "optimize --seeds 0-": [("syntax", "--seeds '0-'")],
    "optimize --seeds 0-1 --seed 1": [("conflict", "")],
    "optimize --set solver.tolerance=1e-9": [("unsupported", "--set solver.tolerance")],
    "optimize --hand pneuflex5 --engine mujco --seed -1 --set gravity=1000 cost.failur=worst": [
        ("unknown", "--engine"),
        ("unknown", "cost.failur"),
        ("range", "gravity"),
        ("unknown", "hands"),
        ("range", "--seed"),
    ],
    "optimize --dry-run --set hand.name=/elsewhere/x": [("file", "")],
    "optimize --dry-run --out a\udcffb": [("unsupported", "")],
    "evaluate --design lenght=100": [("unknown", "--design 'lenght'")],
    "evaluate --design length=0.148": [("range", "--design length")],
    "evaluate --design nowhere.toml": [("file", "nowhere.toml")],
    "evaluate --render grasp.avi": [("file", "--render grasp.avi")],
    "evaluate --run nowhere": [("damaged", "nowhere")],
    "evaluate --run nowhere --hand tripod3 --preset 23d": [("conflict", "")],
    f"evaluate --run {300 * 'a'}": [],  # the system's own error
    f"evaluate --hand {300 * 'a'}.toml": [("file", "")],
    "evaluate --pull 1,2": [("syntax", "")],
    "evaluate --pull 1,nan,0": [("syntax", "")],
    "evaluate nowhere.toml": [("file", "nowhere.toml")],
    "studio nowhere.toml": [("file", "nowhere.toml")],
    "render --run nowhere.toml": [("file", "nowhere.toml")],
    "replay nowhere.npz": [("missing", "nowhere.npz")],
    "landscape --search 3": [("missing", "--search")],
    "landscape --search -1": [("range", "--search")],
    "compare a.toml": [("conflict", "compare")],
    "compare a.toml b.toml c.toml --set-b gravity=3": [
        ("conflict", "compare"),
        ("conflict", "--set-a and --set-b"),
    ],
    "check --accuracy reference": [("unsupported", "accuracy reference")],
    "check --seconds 0": [("range", "--seconds")],
    "export --design lenght=95 arm_z=900 --trials 1 --out out": [
        ("unknown", "--design 'lenght'"),
        ("range", "--design arm_z"),
    ],
    f"export --scene {TINY} --set effects.surface=hull --engine mujoco --tolerances --out out": [
        ("unsupported", "")
    ],
    "export --trials -1 --out out": [("range", "--trials")],
    "sample --designs 0 --out a.parquet": [("range", "--designs")],
    "sample --out a.csv": [("file", "--out a.csv")],
    "sample --out /proc/a.parquet": [("file", "--out /proc/a.parquet")],
    "sample --objects papr --out a.parquet": [("unknown", "objects")],
}


@pytest.mark.parametrize("line", WRONG)
def test_wrong_input_exits_2_and_creates_nothing(line, workplace):
    assert refusal_of_command(*line.split()) == WRONG[line]
    assert list(workplace.iterdir()) == []


@pytest.mark.parametrize("name", cli.MODES)
def test_a_mode_of_jax_in_which_a_command_fails_is_refused_by_name(name, monkeypatch):
    for value in cli.MODES[name][0]:
        monkeypatch.setenv(name, value.upper())
        assert refusal_of_command("scenes", "hands") == [("unsupported", name)]
    for value in ("", "0", "false", "allow", "standard", "log"):
        monkeypatch.setenv(name, value)
        assert cli.main(["scenes"]) == 0


def test_dry_run_writes_nothing(workplace, capsys):
    assert command(*RUN, "--out", "run", "--dry-run") == 0
    output = capsys.readouterr().out
    assert "timestep = 0.02  # s" in output and f"grasps: {EPISODES * 12 + 24}" in output
    assert "MB" in output
    assert list(workplace.iterdir()) == []


def test_version(capsys):
    project = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())
    assert command("--version") == 0
    assert capsys.readouterr().out == f"codesign-jax {project['project']['version']}\n"


def test_ctrl_c_is_one_line_and_ends_the_process(monkeypatch, capsys, request):
    """A simulation may hold the process for minutes: what waits for it must not."""
    # A shell that starts the suite in its background has Ctrl-C ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    going = threading.Event()
    left = []

    def simulate(*arguments):
        going.set()
        # In short waits, as the program has them: a signal right before one is seen after it.
        for _ in range(300):
            time.sleep(0.1)

    def press():
        going.wait(30)
        # To the thread that waits: one of JAX's would take it without waking that.
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    monkeypatch.setattr(cases.Case, "simulate", simulate)
    monkeypatch.setattr(status, "leave", left.append)
    # The process of a command says its waits from then on, and this one goes on with other tests.
    monkeypatch.setattr(terminal, "waits", [])
    arguments = ["evaluate", "--scene", str(TINY), "--engine", "mujoco", "--trials", "1"]
    monkeypatch.setattr(sys, "argv", ["codesign", *arguments])
    threading.Thread(target=press).start()
    start = time.monotonic()
    assert cli.main() == 130 and left == [130]
    assert time.monotonic() - start < 20  # of the 30 that the simulation goes on
    waits, end = capsys.readouterr().err.rstrip().rsplit("\n", 1)
    assert end == "stopped" and waits.startswith("codesign evaluate: loading")


def test_scenes_names_what_is_built_in(capsys):
    assert cli.main(["scenes"]) == 0
    output = capsys.readouterr().out
    kinds = ("scenes", "hands", "objects", "controls")
    assert all(name in output for kind in kinds for name in library.available(kind))
    assert "lateral_bending" not in output
    assert cli.main(["scenes", "edge"]) == 0 and "lateral_bending" in capsys.readouterr().out
