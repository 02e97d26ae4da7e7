"""Kills, failing disks, damage and hostile input: `make faults`, pytest's module of it.

A run that was killed, or met a failing disk, goes on by the same command and ends bit for bit as
one that nothing interrupted; a damaged run does so too, or is refused in words with its files as
they were; hostile input is refused with the project's own error.  FAULTS=N asks for about N cases
of each kind.  It needs Linux, and a C compiler for failing disks: faults_shim.c is a library that
is loaded before all others, counts operations on files below a folder, and lets one of them fail.

An import takes longer than the run, and changes no file of it: most processes are forks of one that
has imported everything and used nothing of JAX, and every twentieth is a new interpreter.

Hypothesis makes the input; tests/test_meshes.py tries a little of it.
"""

import contextlib
import ctypes
import io
import itertools
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import hypothesis
import numpy as np
import pytest
import trimesh
from hypothesis import strategies as st

from codesign_jax import cli, runs
from codesign_jax import scene as scenes
from codesign_jax.runs import manifest
from codesign_jax.runs.checkpoint import digest
from codesign_jax.runs.record import to_arrays
from codesign_jax.scene import InputError, keypaths, library, meshes, scene_files

CASES = int(os.environ.get("FAULTS", "10"))
COMMAND = (
    *("optimize", "--preset", "2d", "--particles", "4", "--trials", "3", "--test-trials", "3"),
    *("--scene", "paper_spheres", "--episodes", "6", "--reference-trials", "0", "--seed", "3"),
    *("--set", "discretization.links=3"),
)
WHOLE = ("episodes.csv", "particles.csv", "trials.csv", "tests.csv")
SOURCES = ("scene.toml", "hand.toml", "objects.toml", "control.toml")


def run(*arguments: str | Path) -> tuple[int, str]:
    """Exit status of a command in this process, and what it says."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = cli.main([str(a) for a in arguments])
        except SystemExit as stop:  # how the parser refuses, and how --help ends
            code = int(stop.code or 0)
    return code, said.getvalue()


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A run that nothing interrupted, alike in this process and in one of its own."""
    folder = tmp_path_factory.mktemp("finished")
    code, said = run(*COMMAND, "--out", folder / "first")
    assert code == 0, said
    command = [sys.executable, "-m", "codesign_jax.cli", *COMMAND, "--out", folder / "run"]
    subprocess.run(command, check=True, capture_output=True)
    assert differences(folder / "first", folder / "run") == []
    return folder / "run"


def differences(first: Path, other: Path) -> list[str]:
    """What of two runs' results is not the same bit for bit, and temporary files that were left."""
    content = lambda path: path.read_bytes() if path.is_file() else None  # noqa: E731
    names = [n for n in (*WHOLE, *SOURCES) if content(first / n) != content(other / n)]
    records = [runs.load_record(folder) for folder in (first, other)]
    digests = [record and digest(to_arrays(record)) for record in records]
    names += ["the record"] * (digests[0] is None or digests[0] != digests[1])
    left = [p.name for p in first.rglob("*") if p.name.endswith((".tmp", ".part"))]
    return names + left + [p.name for p in first.rglob("*.orbax-checkpoint-tmp*")]


# --- kills and failing disks ----------------------------------------------------------------------

SHIM = Path(__file__).with_name("faults_shim.c")
COMPILER = shutil.which(os.environ.get("CC", "cc"))
MODES = {"count": 0, "killed": 1, "full": 2, "broken": 3, "read-only": 4}


class Fault(NamedTuple):
    """What happens at a file operation below a folder.

    Killed within a write, a full disk from there on (ENOSPC), an error once (EIO), a disk that
    cannot be written from there on (EROFS); or nothing: the operations are counted.
    """

    folder: Path
    number: int
    mode: str

    def arm(self) -> None:
        """Has it happen in this process, in which the shim is loaded."""
        folder = os.fsencode(self.folder)
        ctypes.CDLL(None).shim_arm(folder, ctypes.c_long(self.number), MODES[self.mode])


def run_command(arguments: list[str], output: Path, fault: Fault | None) -> NoReturn:
    """The command, as a process of its own runs it; what it says goes to a file."""
    descriptor = os.open(output, os.O_WRONLY | os.O_CREAT)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    sys.argv = ["codesign", *arguments]
    if fault is not None:
        fault.arm()
    try:
        code = cli.main()
    except KeyboardInterrupt:  # before the command has its handlers: how the interpreter ends
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    if fault is not None and fault.mode == "count":
        print("operations:", ctypes.CDLL(None).shim_count())
    sys.exit(code)


class Processes:
    """Starts the command in processes of its own."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._count = itertools.count()

    def start(
        self, folder: Path, fault: Fault | None = None, *, interpreter: bool = False
    ) -> tuple[multiprocessing.Process, Path]:
        """Starts the run in a folder; returns the process and the file of what it says."""
        output = self._folder / f"{next(self._count)}.txt"
        context: Any = multiprocessing.get_context("spawn" if interpreter else "forkserver")
        arguments = [*COMMAND, "--out", str(folder)]
        process = context.Process(target=run_command, args=(arguments, output, fault))
        process.start()
        return process, output

    def run(self, folder: Path, fault: Fault | None = None, **options: bool) -> tuple[int, str]:
        """Exit status of a run, negative that of a signal, and what it says."""
        process, output = self.start(folder, fault, **options)
        process.join()
        return process.exitcode or 0, text_of(output)


def text_of(output: Path) -> str:
    """What a process has said; nothing if it ended before it could."""
    return output.read_text(encoding="utf-8", errors="replace") if output.exists() else ""


@pytest.fixture(scope="session")
def processes(finished, tmp_path_factory) -> Processes:
    """Processes with the shim, which does nothing until a fault is armed."""
    if COMPILER is None:
        pytest.skip("no C compiler: install one as `cc`, or name it in CC")
    folder = tmp_path_factory.mktemp("processes")
    flags = ["-O1", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror"]
    libraries = ["-ldl", "-lpthread"]
    subprocess.run([COMPILER, *flags, "-o", folder / "shim.so", SHIM, *libraries], check=True)
    os.environ["LD_PRELOAD"] = str(folder / "shim.so")  # until this process ends
    # What `finished` has imported in this process.
    names = [name for name in sys.modules if name.startswith("codesign_jax")]
    multiprocessing.set_forkserver_preload([__name__, "orbax.checkpoint", *names])
    return Processes(folder)


@pytest.fixture(scope="session")
def seconds(processes, tmp_path_factory) -> tuple[float, float]:
    """How long a run takes in a fork and in a new interpreter."""
    taken = []
    for name in ("warm", "fork", "interpreter"):
        begin = time.monotonic()
        folder = tmp_path_factory.mktemp("timed") / name
        code, said = processes.run(folder, interpreter=name == "interpreter")
        assert code == 0, said
        taken.append(time.monotonic() - begin)
    return taken[1], taken[2]


@pytest.fixture(scope="session")
def operations(processes, tmp_path_factory) -> int:
    """Number of a run's file operations."""
    folder = tmp_path_factory.mktemp("counted") / "run"
    code, said = processes.run(folder, Fault(folder, 0, "count"))
    assert code == 0, said
    return int(said.split("operations: ")[1])


@pytest.mark.parametrize("number", range(CASES))
def test_a_killed_run_goes_on_bit_for_bit(number, finished, processes, seconds, tmp_path):
    folder = tmp_path / "run"
    chance = random.Random(number)
    interpreter = number % 20 == 19
    for _ in range(1 + number % 3):
        process, output = processes.start(folder, interpreter=interpreter)
        process.join(chance.uniform(0.02, 1.0) * seconds[interpreter])
        chosen = chance.choice((signal.SIGKILL, signal.SIGINT, signal.SIGTERM))
        if process.is_alive():
            os.kill(process.pid, chosen)
        process.join()
        said = text_of(output)
        # Before the command has its handlers, a signal ends the process as it ends any other.
        assert process.exitcode in (0, -chosen, 128 + chosen), said
        assert "Traceback" not in said, said
    code, said = run(*COMMAND, "--out", folder)
    assert code == 0, said
    assert differences(folder, finished) == []


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "count"])
@pytest.mark.parametrize("number", range(CASES))
def test_a_run_whose_disk_fails_says_so_and_goes_on(
    mode, number, finished, processes, operations, tmp_path
):
    folder = tmp_path / "run"
    fault = Fault(folder, 1 + number * operations // CASES, mode)
    code, said = processes.run(folder, fault, interpreter=number % 20 == 19)
    if mode == "killed":
        assert code in (0, -signal.SIGKILL), said
    elif code != 0:  # 0: an operation that it can do without
        assert code in (1, 2) and "error:" in said and "Traceback" not in said, said
    code, said = run(*COMMAND, "--out", folder)
    assert code == 0, said
    assert differences(folder, finished) == []


# --- damage ---------------------------------------------------------------------------------------


WHOLE_FILE = ("deleted", "a folder", "emptied", "zeros", "other")
AT_A_PLACE = ("half", "flipped", "longer")
WAYS = (*WHOLE_FILE, *AT_A_PLACE)
READERS = (("evaluate", "--dry-run", "--run"), ("landscape", "--dry-run"), ("report",))


def damage(path: Path, way: str, place: float = 0.5) -> None:
    """Damages a file: as a whole, or at a place, which is a share of its bytes."""
    data = path.read_bytes()
    at = int(place * len(data))
    if way == "deleted":
        path.unlink()
    elif way == "a folder":
        path.unlink()
        path.mkdir()
    else:
        flipped = data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :] if data else b"x"
        ways = {"emptied": b"", "half": data[:at], "zeros": bytes(len(data))}
        ways |= {"flipped": flipped, "longer": data[:at] + b"\n\x00more" + data[at:]}
        ways |= {"other": bytes(range(256))}
        path.write_bytes(ways[way])


def damage_cases(folder: Path, way: str) -> list[tuple[Path, float]]:
    """Files of a run and places in them: those of the folder and the newest step come first."""
    checkpoints = folder / "checkpoints"
    newest = str(max(int(path.name) for path in checkpoints.iterdir() if path.is_dir()))
    names = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]
    random.Random(way).shuffle(names)
    names.sort(key=lambda n: n.parts[0] == checkpoints.name and n.parts[1].split(".")[0] != newest)
    chance = random.Random(f"{way} place")
    cases = [(name, 0.5) for name in names]
    while way in AT_A_PLACE and len(cases) < CASES:
        cases += [(name, chance.random()) for name in names]
    return cases[:CASES]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("number", range(CASES))
def test_damage_is_mended_or_refused(way, number, finished, tmp_path):
    """Each file of the run in turn; readers never fail without a word."""
    cases = damage_cases(finished, way)
    if number >= len(cases):
        pytest.skip("every file was damaged in this way")
    name, place = cases[number]
    folder = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True))
    damage(folder / name, way, place)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for reader, *flags in READERS:
        out = ["--out", tmp_path / "out.html"] if reader == "report" else []
        code, said = run(reader, *flags, folder, *out)
        assert code in (0, 1, 2) and (code == 0 or "error:" in said), (name, reader, said)
    code, said = run(*COMMAND, "--out", folder)
    if code:
        assert code in (1, 2) and "error:" in said, (name, said)
        # A reader that looks whether the run goes on leaves its number in the lock.
        after = {p: p.read_bytes() for p in before if p.is_file() and p.name != manifest.LOCK}
        assert after == {p: v for p, v in before.items() if p in after}, name
    else:
        assert differences(folder, finished) == [], name


# --- hostile input --------------------------------------------------------------------------------

NUMBERS = (
    *("0", "-1", "1", "1e308", "-1e308", "1e-320", "1e999", "inf", "-inf", "nan", "-0.0", "0x10"),
    *("9" * 400, "9" * 5000, "0x" + "f" * 5000, "1e", "1_000", "01", "true", "2147483648"),
    *("9223372036854775808", "0.1", "200", "3", "1979-05-27", "07:32:00", "1e-9", "25", "100"),
)
TEXTS = (
    *("", " ", ".", "..", "/etc/passwd", "../../x", "a/b", "nan", "-x", "~", "paper", "full", "2d"),
    *("a\u2028b", "a\u2029b", "a\u0085b", "a\x00b", "a\x1b[31mb", "a\rb", "a\nb", "\ufeffa"),
    *("\u202ea", "é" * 200, "x" * 5000, "<img src=x>", "a.toml", "none.toml", "%j", "$(id)"),
    *("日本", "😀", "a" * 300 + ".toml", "\\", '"', "a\\u0000b", "[0]", "\udcff", "\ud800"),
)
VALUES = (
    *("[]", "{}", "[[]]", "[{}]", "[1, 2]", "[1, 'a']", "{a = 1}", "''", "'''\na'''", "[nan]"),
    *("[15, 20, 25, 30]", "[1e308, 1, 2, 3]", "[nan, 1, 2, 3]", "[20]", "[20, 20, 20]", "[true]"),
    *("[" * 2000, "[" * 50 + "]" * 50, "{a=" * 100 + "1" + "}" * 100, "[" + "0," * 2000 + "]"),
)
KEYS = (
    *("gravity", "name", "hand", "hand.name", "objects.name", "objects.object.sphere.name"),
    *("objects.object.sphere.size", "objects.object[0].mass", "hand.finger[1].tilt", "effects"),
    *("hand.parameter.height.high", "hand.preset.2d.fixed.height", "hand.finger", "solver.x"),
    *("objects.noise.size", "discretization.links", "phases.lift", "effects.surface"),
    *("hand.finger[" + "9" * 5000 + "].tilt", "a." * 2000 + "b", "", ".", "..", "x[0][0]"),
    *("gravity.x", "objects.object", "hand.finger[-1].tilt", "objects.object.sphere.file"),
)
SECONDS = 20.0
"""Processor time within which input is refused."""
hostile_value = st.sampled_from((*NUMBERS, *VALUES, *(f'"{t}"' for t in TEXTS)))
pair = st.builds(
    "{}{}{}".format,
    st.sampled_from(KEYS),
    st.sampled_from(("=", "=", "=", "", " = ")),
    st.one_of(hostile_value, st.sampled_from((*TEXTS, "1\nx = 2"))),
)


@st.composite
def damaged_bytes(draw: Any, data: bytes) -> bytes:
    """Bytes of which some are other ones, gone, doubled or new."""
    at = draw(st.integers(0, max(len(data) - 1, 0)))
    end = at + draw(st.sampled_from((0, 1, 4, 50, len(data))))
    new = draw(st.one_of(st.binary(max_size=8), st.just(data[at : at + 100] * 10)))
    return data[:at] + new + data[end:]


KINDS = "scenes", "hands", "objects", "accuracy", "controls"


@st.composite
def toml_files(draw: Any, kinds: tuple[str, ...] = KINDS):
    """A kind of file and its bytes: a built-in one with one to three hostile changes."""
    kind = draw(st.sampled_from(kinds))
    # Sets with meshes take seconds to read.
    paths = [p for n, p in sorted(library.available(kind).items()) if n != "household"]
    text = draw(st.sampled_from(paths)).read_text(encoding="utf-8")
    places = re.compile(r'(?<== ).*|-?\d[\d_.]*(e-?\d+)?|"[^"\n]*"|^[\w.]+(?= =)', re.M)
    for _ in range(draw(st.integers(1, 3))):
        lines = text.split("\n")
        if draw(st.booleans()) and (spans := [*places.finditer(text)]):
            match = spans[draw(st.integers(0, len(spans) - 1))]
            text = text[: match.start()] + draw(hostile_value) + text[match.end() :]
        else:
            i, j = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
            line = st.builds("{} = {}".format, st.sampled_from(KEYS), hostile_value)
            lines[i : draw(st.sampled_from((i, i + 1, i + 5)))] = draw(
                st.one_of(st.just([lines[j]] * 20), st.lists(line, max_size=2))
            )
            text = "\n".join(lines)
    data = text.encode("utf-8", "surrogatepass")
    return kind, draw(st.one_of(st.just(data), damaged_bytes(data)))


FLAGS = (
    *("--scene", "--hand", "--objects", "--accuracy", "--preset", "--schedule", "--optimizer"),
    *("--engine", "--particles", "--trials", "--episodes", "--seed", "--seeds", "--devices"),
    *("--chunk", "--points", "--design", "--run", "--out", "--episode", "--object", "--set"),
)
NEVER = {
    # No case simulates: these are refused by their last argument, once all others were read.
    **dict.fromkeys(("optimize", "evaluate", "landscape"), ("--dry-run",)),
    **{"render": ("--times", "-1"), "export": ("--mould-wall", "-1"), "scenes": ()},
    **{"replay": ("--out", "no.txt"), "report": ("--engine", "none")},
}


@st.composite
def command_lines(draw: Any) -> list[str]:
    """Arguments with a few hostile ones, of a command that simulates nothing."""
    command = draw(st.sampled_from([*NEVER]))
    text = st.one_of(st.sampled_from((*TEXTS, *NUMBERS)), pair, st.text(max_size=5))
    flag = st.tuples(st.sampled_from(FLAGS), text)
    words = [word for words_of_flag in draw(st.lists(flag, max_size=3)) for word in words_of_flag]
    return [command, *words, *draw(st.lists(text, max_size=1)), *NEVER[command]]


@st.composite
def mesh_files(draw: Any) -> tuple[str, bytes]:
    """A format and the bytes of a mesh in it, damaged or of an odd size."""
    kind = draw(st.sampled_from(("stl", "obj", "ply", "off", "glb")))
    thin = tuple(draw(st.sampled_from((1e-6, 1e-4, 0.01, 0.05))) for _ in range(2))
    ball = trimesh.creation.icosphere(2, 0.03)
    ring = trimesh.creation.torus(0.03, 0.01, 12, 8)
    mesh = draw(st.sampled_from((trimesh.creation.box((0.3, *thin)), ball, ring))).copy()
    mesh.apply_scale(draw(st.sampled_from((1e-3, 1.0, 1.0, 1e3))))
    exported: Any = mesh.export(file_type=kind)
    data = exported.encode() if isinstance(exported, str) else exported
    if draw(st.booleans()):
        at = draw(st.integers(0, max(len(data) - 4, 0)))
        number = draw(st.sampled_from((np.nan, np.inf, 1e38, 1e-45, 0.0)))
        data = data[:at] + np.float32(number).tobytes() + data[at + 4 :]
    return kind, draw(st.one_of(st.just(data), damaged_bytes(data)))


def refused(trial: Callable[[], Any]) -> bool:
    """Whether the project's own error, with words, refuses a trial; another one is passed on."""
    begin = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trial()
    except InputError as error:
        assert str(error).strip(), "an error without a word"
        assert time.process_time() - begin < SECONDS
        return True
    return False


def try_toml(kind: str, data: bytes, folder: Path) -> bool:
    """Loads a file; a scene that is accepted reads back as it was written."""
    path = folder / "mutated.toml"
    path.write_bytes(data)
    names = {"scenes": "scene", "hands": "hand_name", "objects": "object_set"}
    arguments: dict[str, Any] = {names.get(kind, kind): str(path)}
    if kind == "controls":
        arguments = {"overrides": {"control": str(path)}}
    loaded: list[scenes.Scene] = []
    if refused(lambda: loaded.append(scenes.load(arguments.pop("scene", "paper"), **arguments))):
        return True
    reads_back(loaded[0], folder)
    return False


def reads_back(loaded: scenes.Scene, folder: Path) -> None:
    texts = scene_files.scene_texts(loaded)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    again = scenes.load(folder / "scene.toml")
    assert again == loaded or scene_files.scene_texts(again) == texts


def try_command(arguments: list[str], folder: Path) -> bool:
    """Runs a command line in a folder: exit status 0 or 2, and no files are left."""
    with contextlib.chdir(folder):
        code, said = run(*arguments)
    assert code in (0, 2) and not [*folder.iterdir()], (arguments, code, said[-500:])
    return code == 2


def try_mesh(kind: str, data: bytes, folder: Path) -> bool:
    """Reads a mesh; what is accepted is finite and has a volume."""
    path = folder / f"mutated.{kind}"
    path.write_bytes(data)
    solids: list[Any] = []
    options = {"unit": "m", "repaired": True, "voxel_error": 5e-3}
    if refused(lambda: solids.append(meshes.load(path, **options))):
        return True
    solid = solids[0]
    numbers = (solid.grid.values, solid.support, solid.vertices, solid.inertia, solid.upright)
    assert all(np.isfinite(v).all() for v in numbers) and solid.volume > 0
    return False


def often(count: int) -> Any:
    """Settings of Hypothesis for so many examples."""
    checks = hypothesis.HealthCheck
    calm = [checks.too_slow, checks.data_too_large, checks.function_scoped_fixture]
    calm += [checks.filter_too_much, checks.large_base_example]
    return hypothesis.settings(max_examples=count, deadline=None, suppress_health_check=calm)


@often(200 * CASES)
@hypothesis.given(toml_files())
def test_toml_files(tmp_path, case):
    kind, data = case
    try_toml(kind, data, tmp_path)


@often(200 * CASES)
@hypothesis.given(st.lists(pair, min_size=1, max_size=2))
def test_values(tmp_path, pairs):
    load = lambda: reads_back(scenes.load("paper", overrides=keypaths.parse(pairs)), tmp_path)  # noqa: E731
    refused(load)


@often(20 * CASES)
@hypothesis.given(command_lines())
def test_command_lines(tmp_path, arguments):
    (tmp_path / "work").mkdir(exist_ok=True)
    try_command(arguments, tmp_path / "work")


@often(20 * CASES)
@hypothesis.given(mesh_files())
def test_mesh_files(tmp_path, case):
    kind, data = case
    try_mesh(kind, data, tmp_path)
