"""The run folder: one run, one process at a time, and nothing in it that is not the run's.

`columns` has its files and what is in them.
"""

import contextlib
import dataclasses
import datetime
import difflib
import fcntl
import json
import os
import re
import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from codesign_jax import files
from codesign_jax import scene as scenes
from codesign_jax.provenance import environment, git_state
from codesign_jax.runs import scene_files
from codesign_jax.runs.columns import FILES, TABLES
from codesign_jax.runs.settings import Settings, masks_of
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import SceneError

_LOCK = ".lock"
_MOST_LINES = 16
"""Lines of a file's differences that an error shows."""
PROVENANCE = "provenance.json"
"""File that makes a folder a run."""
_OURS = {*FILES, *TABLES, _LOCK}


class RunDirectory:
    """An open run folder; see `open_run`."""

    def __init__(self, path: Path):
        """Refers to a folder that `open_run` has prepared."""
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.figures = path / "figures"

    def log(self, message: str) -> None:
        """Appends a line with the time to events.log."""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        with (self.path / "events.log").open("a", encoding="utf-8") as file:
            file.write(f"{now} {message}\n")


@contextlib.contextmanager
def open_run(
    path: Path, scene: Scene, settings: Settings, command: list[str], *, fresh: bool = False
) -> Iterator[tuple[RunDirectory, list[str]]]:
    """Opens a run folder: makes it, or checks that it is this very run; locks it meanwhile.

    Args:
      path: The folder.
      scene: The scene of the run.
      settings: Its settings.
      command: Command line to note in provenance.json.
      fresh: Deletes an earlier run's files first.

    Yields:
      The folder and what the user should know about resuming in it.

    Raises:
      SceneError: If the folder holds other files, belongs to another scene or other settings
        (with a diff; more episodes extend the run), or is in use; nothing is changed then.
    """
    _refuse_foreign(path)
    made = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    with _locked(path):
        for left in path.glob("*.tmp"):
            left.unlink()
        notes = []
        if fresh:
            _clear(path)
        if (path / PROVENANCE).exists():
            stored = read_provenance(path)
            _refuse_other(path, scene, settings, stored)
            notes = _differences(stored["environment"], environment())
            stored["resumed"] = [*stored.get("resumed", []), _start(command)]
            before = stored["settings"]["episodes"]
            if before != settings.episodes:
                step = {"from": before, "to": settings.episodes}
                stored["extended"] = [*stored.get("extended", []), _start(command) | step]
                stored["settings"]["episodes"] = settings.episodes
                notes.append(f"extended from {before} to {settings.episodes} episodes")
            _write_provenance(path, stored)
        else:
            _clear(path)  # remains of a start that was cut short
            _create(path, scene, settings, command)
        run = RunDirectory(path)
        run.log("created" if made or fresh else "opened")
        for note in notes:
            run.log(note)
        yield run, notes


def check_folder(path: Path, scene: Scene, settings: Settings, *, fresh: bool = False) -> None:
    """Checks that a run could start or go on in a folder; changes nothing.

    Args:
      path: The folder.
      scene: The scene of the run.
      settings: Its settings.
      fresh: Whether an earlier run's files will be deleted.

    Raises:
      SceneError: See `open_run`.
    """
    _refuse_foreign(path)
    if (path / PROVENANCE).exists() and not fresh:
        _refuse_other(path, scene, settings, read_provenance(path))


def read_run(
    path: Path,
    *,
    object_set: str | Path | None = None,
    accuracy: str | Path | None = None,
    overrides: Mapping[Any, Any] | None = None,
) -> tuple[Scene, Settings]:
    """Reads scene and settings of a run folder.

    Args:
      path: The folder.
      object_set: Object set instead of the run's.
      accuracy: Preset of discretization and solver instead of the run's.
      overrides: Values by key path that replace the run's; see `scene.load`.

    Raises:
      SceneError: If it is not a run folder.
    """
    stored = read_provenance(path)
    scene = scenes.load(
        path / "scene.toml", object_set=object_set, accuracy=accuracy, overrides=overrides
    )
    return scene, Settings(**stored["settings"])


def episodes_of(paths: Iterable[Path]) -> int | None:
    """Episodes that the runs in folders are to have; None if no folder has a run.

    Raises:
      SceneError: If they are to have different numbers, or a run cannot be read.
    """
    found = [path for path in paths if (path / PROVENANCE).exists()]
    numbers = {path: read_provenance(path)["settings"]["episodes"] for path in found}
    if len(set(numbers.values())) > 1:
        least, most = (f(numbers, key=lambda path: numbers[path]) for f in (min, max))
        problem = (
            f"{least} has {numbers[least]} episodes and {most} {numbers[most]}: say by --episodes "
            "how many all are to have"
        )
        raise SceneError([problem])
    return next(iter(numbers.values()), None)


def read_provenance(path: Path) -> dict[str, Any]:
    """Reads provenance.json of a run folder.

    Raises:
      SceneError: If it is not a run folder.
    """
    try:
        stored = json.loads((path / PROVENANCE).read_text(encoding="utf-8"))
        # Runs from before a setting was there have its default.
        stored["settings"] = dataclasses.asdict(Settings(**stored["settings"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        why = f"{PROVENANCE} cannot be read" if path.exists() else "there is no such folder"
        problem = f"{path} is not a run folder: {why}"
        raise SceneError([problem + _runs_inside(path)]) from error
    return stored


def _runs_inside(path: Path) -> str:
    """A hint at the runs in a folder of several, such as that of --seeds."""
    inside = sorted(file.parent for file in path.glob(f"*/{PROVENANCE}"))
    inside.sort(key=lambda folder: (len(folder.name), folder.name))  # seed-2 before seed-10
    if not inside:
        return ""
    some = f"{inside[0]} or {inside[1]}" if len(inside) > 1 else str(inside[0])
    return f"; it holds {len(inside)} run{'s' * (len(inside) > 1)}: give one, such as {some}"


def _refuse_foreign(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise SceneError([f"--out {path} is a file"])
    # A killed process leaves the temporary of a file that it was replacing.
    present = {p.name for p in path.iterdir()} if path.exists() else set()
    present = {re.sub(r"\.[0-9]+\.tmp$", "", name) for name in present}
    others = sorted(present - _OURS)
    if others:
        names = ", ".join(others[:3])
        raise SceneError([f"--out {path} holds other files ({names}); choose another folder"])


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Holds the folder's lock; the kernel releases it with the process, however it ends."""
    with (path / _LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            owner = file.read().strip() or "?"
            raise SceneError([f"--out {path} is in use by process {owner}"]) from error
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def _clear(path: Path) -> None:
    for target in path.iterdir():
        if target.name == _LOCK:
            continue
        if target.is_dir():
            shutil.rmtree(target)
        else:
            target.unlink()


def _create(path: Path, scene: Scene, settings: Settings, command: list[str]) -> None:
    scene_files.write_scene(scene, path)
    # Last: a folder with this file is a run.
    _write_provenance(
        path,
        {
            "settings": dataclasses.asdict(settings),
            "started": _start(command),
            "environment": environment(),
            "git": git_state(),
        },
    )


def _start(command: list[str]) -> dict[str, Any]:
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"time": now, "command": command}


def _write_provenance(path: Path, content: dict[str, Any]) -> None:
    with files.atomically(path / PROVENANCE) as part:
        part.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _refuse_other(path: Path, scene: Scene, settings: Settings, stored: dict[str, Any]) -> None:
    """Refuses to resume another run, and says what differs."""
    problems, extension = [], []
    for name, value in dataclasses.asdict(settings).items():
        before = stored["settings"].get(name)
        if name == "episodes":
            extension = _extension_problems(scene, settings, before)
        elif before != value:
            flag = name.replace("_", "-")
            problems.append(f"--{flag}: the run has {before}, asked for is {value}")
    if scenes.load(path / "scene.toml") != scene:
        for name, text in scene_files.scene_texts(scene).items():
            old = (path / name).read_text(encoding="utf-8").splitlines()
            diff = difflib.unified_diff(old, text.splitlines(), f"run/{name}", f"asked/{name}", n=0)
            problems += _beginning([*diff])
    if problems:
        head = f"--out {path} holds another run; choose another folder, or --fresh to delete it"
        shown = [head, *_own_command(stored), *(p.rstrip() for p in problems + extension)]
        raise SceneError(shown)
    if extension:
        hint = "leave out --episodes to go on with it, or choose another folder"
        raise SceneError([f"--out {path}: {problem}; {hint}" for problem in extension])


def _own_command(stored: dict[str, Any]) -> list[str]:
    """By which command a run goes on, in words; nothing if it was begun from Python."""
    last = [stored.get("started", {}), *stored.get("resumed", [])][-1]
    program, *arguments = last.get("command", [""])
    if Path(program).name not in ("codesign", "cli.py"):
        return []
    return [f"the run in it goes on by its own command: {shlex.join(['codesign', *arguments])}"]


def _beginning(lines: list[str]) -> list[str]:
    """The first lines of many, and how many more there are."""
    rest = len(lines) - _MOST_LINES
    return lines if rest <= 0 else [*lines[:_MOST_LINES], f"and {rest} lines more"]


def _extension_problems(scene: Scene, settings: Settings, before: int) -> list[str]:
    """Why a run cannot have another number of episodes than it had."""
    asked = settings.episodes
    both = f"the run has {before} episodes, asked for are {asked}"
    if asked < before:
        return [f"{both}, and a run can be extended, but not shortened"]
    masks = [masks_of(scene, dataclasses.replace(settings, episodes=n)) for n in (before, asked)]
    if (masks[0] != masks[1][:before]).any():
        return [
            f"{both}, and schedule {settings.schedule} divides its episodes: it would have "
            "switched at others"
        ]
    return []


def _differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Returns how the environment changed; resuming is allowed, bitwise equality is lost."""
    flat_before, flat_now = (v | v.get("versions", {}) for v in (before, now))
    changed = [
        f"{name} {flat_before.get(name)} -> {flat_now[name]}"
        for name in flat_now
        if name != "versions" and flat_before.get(name) != flat_now[name]
    ]
    if not changed:
        return []
    return [f"not bitwise comparable with an uninterrupted run: {', '.join(changed)}"]
