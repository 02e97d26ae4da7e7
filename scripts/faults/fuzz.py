"""Hostile input within one process, a case by its number: TOML files and values, commands, meshes.

`CASES` has a function for each kind: it makes case number n, the same at any time, tries it, and
says what came of it: "refused" with the project's own error, "accepted", or "escaped: ..." with
what should not have come: another error, a file that does not read back, or too much time.
"""

import contextlib
import dataclasses
import io
import random
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from codesign_jax import cli
from codesign_jax import scene as scenes
from codesign_jax.runs import scene_files
from codesign_jax.scene import InputError, keypaths, library, meshes
from scripts.faults.hostile import (
    NUMBER,
    NUMBERS,
    TEXTS,
    mutate_bytes,
    mutate_toml,
    replace,
    value,
)

SECONDS = 20.0
"""Processor time within which input is refused."""


def _category(trial: Callable[[], str], others: tuple[type[BaseException], ...] = ()) -> str:
    """What came of a trial; only the project's own error is a refusal."""
    start = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = trial()
    except InputError as error:
        result = "refused" if str(error).strip() else "escaped: InputError: without a word"
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        lines = str(error).splitlines() or [""]
        result = f"escaped: {type(error).__name__}: {lines[0][:200]}"
    took = time.process_time() - start
    if took > SECONDS and result == "refused":
        return f"escaped: slow: refused after {took:.0f} s of processor time"
    return result


def try_toml(number: int, folder: Path) -> str:
    """Tries a mutated file of a scene, hand, object set or accuracy, or values as of --set.

    Args:
      number: Which case.
      folder: An existing folder for its files, which later cases replace.
    """
    rng = random.Random(f"toml {number}")
    kind = rng.choice(("scenes", "hands", "objects", "accuracy", "values", "values"))
    return _category(lambda: _load(rng, kind, folder))


def _load(rng: random.Random, kind: str, folder: Path) -> str:
    names = {"scene": "paper", "hand": None, "objects": None, "accuracy": None}
    pairs: list[str] = []
    if kind == "values":
        pairs = [_pair(rng) for _ in range(rng.choice((1, 1, 2)))]
    else:
        # Sets with meshes are those of `try_mesh`: each takes seconds to read.
        built_in = [p for name, p in library.available(kind).items() if name != "household"]
        path = folder / "mutated.toml"
        source = rng.choice(built_in)
        path.write_bytes(mutate_toml(rng, source.read_text(encoding="utf-8")))
        names[{"scenes": "scene", "hands": "hand"}.get(kind, kind)] = str(path)
    loaded = scenes.load(
        names["scene"] or "paper",
        hand_name=names["hand"],
        object_set=names["objects"],
        accuracy=names["accuracy"],
        overrides=keypaths.parse(pairs),
    )
    return _reads_back(loaded, folder)


def _pair(rng: random.Random) -> str:
    """A pair of --set, of a key that there is or of none."""
    keys = (
        *("gravity", "name", "hand", "hand.name", "objects.name", "objects.object.sphere.name"),
        *("objects.object.sphere.size", "objects.object[0].mass", "hand.finger[1].tilt", "effects"),
        *("hand.parameter.height.high", "hand.preset.2d.fixed.height", "hand.finger", "solver.x"),
        *("objects.noise.size", "discretization.links", "phases.lift", "hand.palm.contact_radius"),
        *(
            "effects.surface",
            "hand.preset[0].name",
            "objects.object.sphere.type",
            "newton.decrement",
        ),
        *("hand.finger[" + "9" * 5000 + "].tilt", "a." * 2000 + "b", "", ".", "..", "x[0][0]"),
        *("gravity.x", "objects.object", "hand.finger[-1].tilt", "objects.object.sphere.file"),
        *("description", "objects.object.sphere.density", "hand.preset[0].free", "hand.material"),
    )
    text = rng.choice((value(rng), rng.choice(TEXTS), rng.choice(NUMBERS), "1\nx = 2"))
    return rng.choice(keys) + rng.choice(("=", "=", "=", "=", "", " = ")) + text


def _reads_back(loaded: scenes.Scene, folder: Path) -> str:
    """Writes a scene and reads it again."""
    texts = scene_files.scene_texts(loaded)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    try:
        again = scenes.load(folder / "scene.toml")
    except InputError as error:
        return f"escaped: what was written is refused: {error.problems[0][:200]}"
    if again != loaded and scene_files.scene_texts(again) != texts:
        return "escaped: what was written reads back as another scene"
    return "accepted"


_USUAL = ("1", "2", "3", "6")
_WORDS = (
    "--dry-run",
    "--fresh",
    "--no-replay",
    "--no-sheet",
    "--open",
    "--help",
    "--nonsense",
    "--",
)
_FLAGS = {
    "--scene": ("paper", "paper_spheres", *TEXTS),
    "--hand": ("tripod3", "pneuflex4", *TEXTS),
    "--objects": ("paper", "paper_spheres", *TEXTS),
    "--accuracy": ("fast", "fine", *TEXTS),
    "--preset": ("2d", "23d", "1d", *TEXTS),
    "--schedule": ("single", "switch-3", "switch-" + "9" * 5000, "switch--1", *TEXTS),
    "--optimizer": ("pso", "random", *TEXTS),
    "--engine": ("mujoco", "mjx", *TEXTS),
    "--first": ("control", *TEXTS),
    "--particles": NUMBERS,
    "--trials": NUMBERS,
    "--episodes": NUMBERS,
    "--test-trials": NUMBERS,
    "--reference-trials": NUMBERS,
    "--seed": NUMBERS,
    "--seeds": ("0-3", "3-1", "0-99999", ",", "1,2,x", *NUMBERS),
    "--devices": NUMBERS,
    "--chunk": NUMBERS,
    "--points": NUMBERS,
    "--size": NUMBERS,
    "--times": NUMBERS,
    "--end-wall": NUMBERS,
    "--inlet": NUMBERS,
    "--mould-wall": NUMBERS,
    "--clearance": NUMBERS,
    "--draft": NUMBERS,
    "--tolerance-steps": NUMBERS,
    "--tolerance": ("off", "all", *TEXTS),
    "--episode": NUMBERS,
    "--particle": NUMBERS,
    "--trial": NUMBERS,
    "--object": ("sphere", *TEXTS),
    "--design": ("length=100", "length=1e999", "arm_z=nan", "x=1", "length", "=", *TEXTS),
    "--run": TEXTS,
    "--out": TEXTS,
    "--render": ("a.gif", "a.png", *TEXTS),
    "--parameters": ("length", "arm_z", *TEXTS),
}
_NEVER = {
    # No case simulates: these are refused by their last argument, once all others were read.
    "render": ("--times", "-1"),
    "export": ("--mould-wall", "-1"),
    "replay": ("--out", "no.txt"),
    "report": ("--engine", "none"),
    "optimize": ("--dry-run",),
    "evaluate": ("--dry-run",),
    "landscape": ("--dry-run",),
    "scenes": (),
}


def command_line(rng: random.Random, folder: Path) -> list[str]:
    """A command line with a few hostile arguments, that simulates nothing.

    Args:
      rng: Says which.
      folder: Where the paths of its arguments are that have to be somewhere.
    """
    command = rng.choice((*_NEVER, "optimize", "evaluate"))
    arguments = [command] if rng.random() < 0.97 else [rng.choice(TEXTS)]
    if command in ("report", "replay") or rng.random() < 0.05:
        arguments.append(rng.choice((str(folder / "none"), str(folder), *TEXTS)))
    for _ in range(rng.choice((1, 1, 1, 1, 2, 3))):
        kind = rng.random()
        if kind < 0.7:
            flag = rng.choice(_own(arguments[0]) if rng.random() < 0.95 else [*_FLAGS])
            usual = _USUAL if _FLAGS[flag] is NUMBERS else _FLAGS[flag][:2]
            arguments += [flag, rng.choice(usual if rng.random() < 0.4 else _FLAGS[flag])]
        elif kind < 0.9:
            arguments += ["--set", _pair(rng)]
        else:
            arguments.append(rng.choice((*_WORDS, *TEXTS)))
    if command == "export":
        arguments += ["--out", str(folder / "export")]
    return [*arguments, *_NEVER[command]]


def _own(command: str) -> list[str]:
    """The flags that a command has, of those that have values here; all if there is no such one."""
    names = [
        field.name for field in dataclasses.fields(getattr(cli, command.title(), cli.Optimize))
    ]
    flags = {"--run" if n == "run_folder" else "--" + n.replace("_", "-") for n in names}
    return [flag for flag in _FLAGS if flag in flags]


def try_command_line(number: int, folder: Path) -> str:
    """Tries a hostile command line within this process, with a folder as the working directory.

    Exit status 0 is "accepted", 2 "refused"; another one, a traceback, and files that a refused
    command leaves are escapes.

    Args:
      number: Which case.
      folder: An existing folder.
    """
    rng = random.Random(f"command {number}")
    place = folder / "work"
    place.mkdir(exist_ok=True)
    arguments = command_line(rng, folder)
    return _category(lambda: _run(arguments, place))


def _run(arguments: list[str], place: Path) -> str:
    said = io.StringIO()
    with (
        contextlib.chdir(place),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
    ):
        try:
            code = cli.main(arguments)
        except SystemExit as stop:  # how the parser refuses, and how --help ends
            code = stop.code
    left = sorted(path.name for path in place.iterdir())
    if left:
        for path in place.iterdir():
            path.unlink() if path.is_file() else path.rmdir()
        return f"escaped: files: {arguments[0]} left {', '.join(left)[:100]}"
    if code not in (0, 2):
        last = [line for line in said.getvalue().splitlines() if line.strip()][-1:]
        return f"escaped: exit {code}: {''.join(last)[:200]}"
    return "refused" if code else "accepted"


_EXPORTS = ("stl", "stl_ascii", "obj", "ply", "ply_ascii", "off", "glb")
_MESH_NUMBERS = ("1e300", "-1e300", "nan", "inf", "1e-300", "0", "99999999999", "-1", "1e38", "x")


def _base_mesh(rng: random.Random) -> trimesh.Trimesh:
    make = rng.choice(
        (
            lambda: trimesh.creation.box((0.04, 0.05, 0.06)),
            lambda: trimesh.creation.icosphere(2, 0.03),
            lambda: trimesh.creation.torus(0.03, 0.01, 12, 8),
            lambda: trimesh.creation.cylinder(0.02, 0.06, sections=12),
            lambda: trimesh.creation.box(
                (0.3, 10 ** rng.uniform(-6, -2), 10 ** rng.uniform(-6, -2))
            ),
            lambda: trimesh.util.concatenate(
                [trimesh.creation.box((0.04, 0.04, 0.04)), trimesh.creation.icosphere(1, 0.025)]
            ),
        )
    )
    mesh: Any = make()
    if rng.random() < 0.2:
        mesh.apply_scale(10 ** rng.uniform(-3, 3))
    return mesh


def _exported(mesh: trimesh.Trimesh, kind: str) -> bytes:
    options = {"encoding": "ascii"} if kind == "ply_ascii" else {}
    data: Any = mesh.export(
        file_type=kind.removesuffix("_ascii") if "ply" in kind else kind, **options
    )
    return data.encode() if isinstance(data, str) else data


def mutate_mesh(rng: random.Random, data: bytes, kind: str) -> bytes:
    """The bytes of a mesh file with a few hostile changes.

    Args:
      rng: Says which.
      data: The file as it should be.
      kind: Its format, one of trimesh's, or ply_ascii.
    """
    for _ in range(rng.choice((0, 1, 1, 2, 3))):
        if kind in ("stl", "ply", "glb") and rng.random() < 0.5:
            at = rng.randrange(max(len(data) - 4, 1))
            number = rng.choice((np.nan, np.inf, 1e38, -1e38, 1e-45, 0.0))
            four = rng.choice((np.float32(number).tobytes(), b"\xff" * 4, b"\x00" * 4, b"\x7f" * 4))
            data = data[:at] + four + data[at + 4 :]
        elif kind in ("obj", "off", "ply_ascii", "stl_ascii", "glb") and rng.random() < 0.6:
            text = data.decode("latin-1")
            data = replace(rng, NUMBER, text, rng.choice(_MESH_NUMBERS)).encode("latin-1")
        else:
            data = mutate_bytes(rng, data)
    return data


def try_mesh(number: int, folder: Path) -> str:
    """Tries a mutated mesh: reads it, repairs it if asked, and builds its distances.

    Args:
      number: Which case.
      folder: An existing folder for its file, which later cases replace.
    """
    rng = random.Random(f"mesh {number}")
    kind = rng.choice(_EXPORTS)
    data = mutate_mesh(rng, _exported(_base_mesh(rng), kind), kind)
    suffix = kind.removesuffix("_ascii")
    if rng.random() < 0.03:
        suffix = rng.choice(("zip", "tar.gz", "3mf", "gltf", "STL", "", "xyz", "dae"))
    path = folder / f"mutated.{suffix}"
    path.write_bytes(data)
    options = rng.choice((False, True, True)), rng.choice((5e-3, 5e-3, 2e-3, 5e-4))
    return _category(lambda: _solid(path, *options))


def _solid(path: Path, repaired: bool, voxel_error: float) -> str:
    solid = meshes.load(path, unit="m", repaired=repaired, voxel_error=voxel_error)
    numbers = (solid.grid.values, solid.support, solid.vertices, solid.inertia, solid.upright)
    if not all(np.isfinite(v).all() for v in numbers) or not solid.volume > 0:
        return "escaped: numbers: a mesh was accepted that is not finite"
    return "accepted"


CASES: dict[str, Callable[[int, Path], str]] = {
    "toml": try_toml,
    "commands": try_command_line,
    "mesh": try_mesh,
}
"""Functions of a case's number and a folder that say what came of it."""
