"""Helpers of several commands: designs, notes and JAX's compilation cache."""

import dataclasses
import functools
import importlib.util
import re
import tempfile
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import tomli_w
from rich.table import Table

from codesign_jax import engines, policy, reuse, rollout, terminal, tolerances
from codesign_jax import scene as scenes
from codesign_jax.commands.flags import Evaluate, Export, SceneFlags, Subject, TrialFlags
from codesign_jax.engines import Engine
from codesign_jax.judge.cases import Case
from codesign_jax.runs import selection, tables
from codesign_jax.runs.progress import Meter
from codesign_jax.runs.reading import Tell
from codesign_jax.scene import Scene, design_files, draws, keypaths, objects, schema
from codesign_jax.scene.design_files import DesignFile
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.scene.schema import InputError
from codesign_jax.terminal import Console
from codesign_jax.types import Params
from codesign_jax.user_code import make_policy

MOST = 1000
"""Most runs of one command: a guard against a slip such as 0-99999."""
OFF = ("off",)
"""Value of --tolerances where it is not given."""


def use_compilation_cache() -> None:
    """Keeps compiled programs between commands, or says why none are kept."""
    reuse.use_compilation_cache()
    if why := reuse.why_nothing_is_kept():
        terminal.say(f"compiled programs are not kept for the next command: {why}", error=True)


def cast_hands(
    case: Case, options: Evaluate | Export, trials: int, console: Console
) -> tolerances.Yield:
    """Simulates hands as they are cast, with so many grasps each, and prints what they keep."""
    tolerance_widths = tolerances.read(options.tolerances)
    with Meter("cast hands", (options.hands + 1) * trials, console) as meter:
        key = jax.random.key(options.seed)
        hand_yield = tolerances.simulate(
            case, tolerance_widths, key, hands=options.hands, trials=trials, done=meter.advance
        )
    for line in hand_yield.lines():
        console.print(line)
    return hand_yield


def changes(options: TrialFlags) -> dict[keypaths.Path, Any]:
    """Values by key path that --constants, --rigid-mount, --robust and --set replace.

    What --set names holds.
    """
    values: dict[keypaths.Path, Any] = {}
    if options.constants is not None:
        table = draws.read(options.constants)
        values |= draws.nominal(table) | {("drawn",): draws.plain(table)}
    if options.rigid_mount:
        values[("effects", "wrist")] = False
    noise = dataclasses.asdict(objects.ROBUST) if options.robust else {}
    values |= {("objects", "noise", name): value for name, value in noise.items()}
    return values | keypaths.parse(chain.from_iterable(options.overrides))


def design_file(options: SceneFlags) -> DesignFile:
    """Names in the file of --design, if one is given; flags override them."""
    words = [*chain.from_iterable(getattr(options, "design", ()))]
    names = ("preset", "scene", "hand", "objects")
    flags = {name: value for name in names if (value := getattr(options, name, None))}
    return dataclasses.replace(open_designs(words)[1], **flags)


def load_scene(options: SceneFlags) -> Scene:
    """Reads the scene that a command's flags name, or the file of its design."""
    file = design_file(options)
    return scenes.load(
        file.scene,
        hand_name=file.hand or None,
        object_set=file.objects or None,
        accuracy=options.accuracy,
        overrides=({("control",): file.control} if file.control else {}) | changes(options),
    )


def warn(text: str) -> None:
    """Prints a warning that concerns the result, apart from the result."""
    terminal.say(f"warning: {text}", error=True)


@functools.cache
def _warn_of_mujoco(text: str) -> None:
    warn(f"MuJoCo: {text}")


# MuJoCo's own way appends to MUJOCO_LOG.TXT in the working directory.
mujoco.set_mju_user_warning(_warn_of_mujoco)


def find_case(options: Subject, *, tell: Tell = warn) -> Case:
    """The design that the flags name: the best of a run, or one given by its parameters."""
    if options.run_folder is None:
        scene = load_scene(options)
        words = [*chain.from_iterable(options.design)]
        if options.policy:
            scene = make_policy(options.policy, scene)[1]
        space = design_space(scene.hand, design_file(options).preset)
        design = find_design(space, words)
        engine_and_policy = options.engine or engines.DEFAULT, options.policy or ""
        return _with_fewer_fingers(Case(scene, space, design, *engine_and_policy), options)
    subject_flags = {"--hand": options.hand, "--scene": options.scene, "--preset": options.preset}
    foreign = ["--design"] * bool(options.design) + [
        f for f, v in subject_flags.items() if v is not None
    ]
    if foreign:
        raise InputError.of(
            "conflict",
            f"--run brings design, hand and scene of its own; leave out {' and '.join(foreign)}",
        )
    replacements = {
        "objects": options.objects,
        "accuracy": options.accuracy,
        "engine": options.engine,
    }
    case = selection.case_of_run(
        options.run_folder, overrides=changes(options), tell=tell, **replacements
    )
    selection.refuse_other_policy(case.policy, options.policy)
    return _with_fewer_fingers(case, options)


def _with_fewer_fingers(case: Case, options: Subject) -> Case:
    """The case without the fingers that --without names, of a command that has this flag."""
    fingers = getattr(options, "without", ())
    return case.without(fingers) if fingers else case


def shortest(space: DesignSpace, design: np.ndarray) -> list[float]:
    """A design [SI units] in the hand file's units, by the fewest digits that mean the same.

    Simulations take a design as float32: 114.125 mm and 114.124998 mm are one number there.
    """
    exact = space.in_units(design)
    single = np.asarray(design, np.float32)
    values = exact.copy()
    for digits in range(9, 0, -1):  # nine tell any two numbers of float32 apart
        fewer = np.array([float(f"{value:.{digits}g}") for value in exact])
        same = (fewer * np.asarray(space.scale)).astype(np.float32) == single
        values = np.where(same, fewer, values)
    return values.tolist()


def design_text(space: DesignSpace, file: DesignFile, design: np.ndarray) -> str:
    """A design [SI units] as the .toml text that --design opens again, in what the file names."""
    per_finger, others = tables.by_finger(space)
    columns = {space.names[k]: k for k in others} | per_finger
    values = [f"{value:.9g}" for value in shortest(space, design)]
    lines = ["# A design in the hand file's units, for --design."]
    names = {name: v for name, v in dataclasses.asdict(file).items() if v and name != "design"}
    lines += [tomli_w.dumps(names), "[design]"]
    for name, k in columns.items():
        several = isinstance(k, list)
        text = f"[{', '.join(values[i] for i in k)}]" if several else values[k]
        key = f'"{name}"' if "[" in name else name
        lines.append(f"{key} = {text}  # {space.units[k[0] if several else k]}")
    return "\n".join([*lines, ""])


def open_designs(words: Sequence[str]) -> tuple[dict[str, list[str]], DesignFile]:
    """Splits the words of --design into NAME=VALUE pairs, by the file that has them; the file."""
    pairs_by_file: dict[str, list[str]] = {}
    file = DesignFile(design_files.PRESET, {})
    direct = []
    for word in keypaths.joined(words):
        if "=" in word or not word.endswith(".toml"):
            direct.append(word)
            continue
        path = Path(word)
        file = design_files.read(path)
        pairs_by_file.setdefault(path.name, []).extend(file.pairs)
    return pairs_by_file | {"--design": direct}, file


def find_design(space: DesignSpace, words: Sequence[str]) -> np.ndarray:
    """The design that --design names: files and NAME=VALUE, later words hold; SI, (parameter,)."""
    design = space.default()
    for where, pairs in open_designs(words)[0].items():
        design = design_files.parse(space, pairs, design, where)
    return design


def by_default(space: DesignSpace, words: Sequence[str]) -> str:
    """Says which parameters of a design are the hand file's defaults; empty if none is."""
    pairs = chain.from_iterable(open_designs(words)[0].values())
    names = {each for pair in pairs for each in design_files.members(pair.partition("=")[0], space)}
    defaults = [name for name in space.names if name not in names]
    if not defaults:
        return ""
    if not names:
        return "the hand file's default design; --design NAME=VALUE changes it"
    groups = dict.fromkeys(name.split("[")[0] for name in defaults)
    return f"not given, so the hand file's defaults: {', '.join(groups)}"


def refuse(problems: Sequence[str]) -> None:
    """Ends the command if anything is wrong with its input."""
    if problems:
        raise InputError(problems)


def place_problems(flag: str, path: Path | None, *suffixes: str, folder: bool = False) -> list[str]:
    """Why nothing could be written to a path, before anything is simulated for it.

    A temporary file is made and removed in the path's folder, or in the nearest folder above it
    that exists; missing folders are not made.
    """
    if path is None:
        return []
    if suffixes and path.suffix not in suffixes:
        return [schema.Problem("file", f"{flag} {path} must end in {' or '.join(suffixes)}")]
    parent = path.absolute() if folder else path.absolute().parent
    try:
        if not folder and path.is_dir():
            words = f"{flag} {path} cannot be written: it is a folder"
            return [schema.Problem("file", words)]
        while not parent.exists():
            parent = parent.parent
        with tempfile.TemporaryFile(dir=parent):
            return []
    except OSError as error:
        words = f"{flag} {path} cannot be written: {error.strerror} ({parent})"
        return [schema.Problem("file", words)]


def number_problems(*numbers: tuple[str, float | None, float, float]) -> list[str]:
    """Problems with numbers of a command line."""
    ranges = [(flag, v, "", low, high) for flag, v, low, high in numbers if v is not None]
    return [problem for number in ranges if (problem := schema.range_problem(*number))]


def print_table(console: Console, table: Table) -> None:
    """Prints a table as wide as it is: a log takes long lines, and a terminal folds them."""
    Console(file=console.file, width=1000, highlight=True, soft_wrap=False).print(table)


def picture_problems(flag: str, path: Path | None) -> list[str]:
    """Problems with the path of a picture."""
    problems = place_problems(flag, path, ".gif", ".mp4", ".png")
    if path and path.suffix == ".mp4" and importlib.util.find_spec("av") is None:
        problems.append(
            schema.Problem(
                "unsupported",
                f"{flag} {path} needs PyAV: pip install -e '.[report]' in the checkout",
            )
        )
    return problems


def engine_problems(name: str, overrides: Sequence[Sequence[str]] = ()) -> list[str]:
    """An engine that there is not, or values of [solver] for one that does not read them."""
    if name not in engines.NAMES:
        hint = schema.nearest(name, engines.NAMES)
        return [schema.Problem("unknown", f"--engine = {name!r} is not valid; {hint}")]
    values = keypaths.parse(chain.from_iterable(overrides)) if name == "structured" else {}
    return [
        engines.solver_problem(f"--set {'.'.join(path)} = {value}", path[1] if path[1:] else "")
        for path, value in values.items()
        if path[0] == "solver"
    ]


def counted(number: int, noun: str, plural: str = "s") -> str:
    """A number of things in words, such as "1 call" and "2 calls"."""
    return f"{number} {noun}{'' if number == 1 else plural}"


def policy_notes(engine: Engine, params: Params) -> list[str]:
    """Warnings of what a policy commands, if the engine asks one; nothing is simulated."""
    if not isinstance(engine, policy.ControlLoop):
        return []
    doubts = policy.doubts(engine, params, rollout.nominal_trial(engine.scene))
    return [f"warning: {text}" for text in doubts]


def parse_seeds(text: str) -> list[int]:
    """Reads seeds such as "0-9" or "1,3,5-7", in ascending order."""
    seeds: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,10})(?:-([0-9]{1,10}))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if last < first or last >= 2**31:
            raise InputError.of("syntax", f"--seeds {text!r} must be seeds such as 0-9 or 1,3,5")
        if last - first >= MOST or len(seeds) > MOST:
            raise InputError.of("range", f"--seeds {text!r} names more than {MOST} runs")
        seeds |= set(range(first, last + 1))
    return sorted(seeds)
