"""The command line: wrong input is said in words and creates nothing; Ctrl-C."""

import signal
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path

import pytest

from codesign_jax import cli
from codesign_jax.commands import status
from codesign_jax.judge import cases
from codesign_jax.scene import library
from tests.helpers.command_runs import EPISODES, RUN, command, finished_run, own_workplace  # noqa: F401
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
from codesign_jax import cli
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


# Lines after the name of the program, and what is said of each.
WRONG = {
    "optimize --schedule switch-64": "65 episodes",
    "optimize --optimizer cma-es --particles 1": "cma-es ranks its particles: it needs at least 2",
    "optimize --particles 0": "--particles = 0 is outside [1, 32768]",
    "optimize --set discretization.links=3.5": "discretization.links = 3.5 must be a whole number",
    "optimize --seeds 0-": "--seeds '0-' must be seeds such as 0-9 or 1,3,5",
    "optimize --seeds 0-1 --seed 1": "--seeds exclude",
    "optimize --set solver.tolerance=1e-9": "engine structured: --set solver.tolerance=1e-09",
    "optimize --hand pneuflex5 --engine mujco --seed -1 --set gravity=1000 cost.failur=worst": (
        "pneuflex4|mujoco|--seed = -1|gravity = 1000|did you mean 'cost.failure'?"
    ),
    "optimize --dry-run --set hand.name=/elsewhere/x": "is no name of a folder",
    "optimize --dry-run --out a\udcffb": "error: ",
    "evaluate --design lenght=100": "'lenght' is not a parameter; did you mean 'length'?",
    "evaluate --design length=0.148": "did you mean 148?",
    "evaluate --design nowhere.toml": "nowhere.toml: No such file or directory",
    "evaluate --render grasp.avi": "must end in .gif",
    "evaluate --run nowhere": "nowhere is not a run folder: there is no such folder",
    "evaluate --run nowhere --hand tripod3 --preset 23d": "out --hand and --preset",
    f"evaluate --run {300 * 'a'}": "error: ",
    f"evaluate --hand {300 * 'a'}.toml": "error: ",
    "evaluate --pull 1,2": "--pull 1,2 must be down, x, y, z",
    "evaluate --pull 1,nan,0": "--pull 1,nan,0 must be down, x, y, z",
    "evaluate nowhere.toml": "nowhere.toml: No such file or directory",
    "studio nowhere.toml": "nowhere.toml: No such file or directory",
    "render --run nowhere.toml": "nowhere.toml: No such file or directory",
    "replay nowhere.npz": "nowhere",
    "landscape --search 3": "--search: no other parameter is free",
    "landscape --search -1": "--search = -1 is outside [0, 1000]",
    "compare a.toml": "compare takes two designs, or one with",
    "compare a.toml b.toml c.toml --set-b gravity=3": "compare takes two designs",
    "check --accuracy reference": "accuracy reference is what others are compared with",
    "check --seconds 0": "--seconds = 0.0 is outside",
    "export --design lenght=95 arm_z=900 --trials 1 --out out": (
        "--design 'lenght' is not a parameter; did you mean 'length'|arm_z"
    ),
    f"export --scene {TINY} --set effects.surface=hull --engine mujoco --tolerances --out out": (
        "not supported by engine mujoco: effects.surface"
    ),
    "export --trials -1 --out out": "--trials",
    "sample --designs 0 --out a.parquet": "--designs = 0 is outside [1, 1e+09]",
    "sample --out a.csv": "--out a.csv must end in .parquet",
    "sample --out /proc/a.parquet": "--out /proc/a.parquet cannot be written",
    "sample --objects papr --out a.parquet": "did you mean 'paper'?",
}


@pytest.mark.parametrize("line", WRONG)
def test_wrong_input_exits_2_and_creates_nothing(line, workplace, capsys):
    assert command(*line.split()) == 2
    captured = capsys.readouterr()
    for part in WRONG[line].split("|"):
        assert part in captured.err + captured.out
    assert list(workplace.iterdir()) == []


@pytest.mark.parametrize("name", cli.MODES)
def test_a_mode_of_jax_in_which_a_command_fails_is_refused_by_name(name, monkeypatch, capsys):
    for value in cli.MODES[name][0]:
        monkeypatch.setenv(name, value.upper())
        assert cli.main(["scenes", "hands"]) == 2
        assert f"error: {name}={value} asks for a mode of JAX" in capsys.readouterr().err
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
