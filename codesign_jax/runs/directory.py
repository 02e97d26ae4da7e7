"""The run folder: one run, one process at a time, and nothing in it that is not the run's.

`columns` has its files and what is in them.
"""

import contextlib
import dataclasses
import datetime
import difflib
import fcntl
import os
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from codesign_jax import files, own
from codesign_jax import scene as scenes
from codesign_jax.provenance import environment
from codesign_jax.runs import belongings, manifest, reading, scene_files
from codesign_jax.runs.checkpoint import Checkpoints
from codesign_jax.runs.manifest import PROVENANCE
from codesign_jax.runs.settings import Settings, masks_of
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import InputError

EVENTS = "events.log"
"""Log of a run folder: what happened when, a line each."""
_MOST_LINES = 16
"""Lines of a file's differences that an error shows."""


class RunDirectory:
    """An open run folder; see `open_run`."""

    def __init__(self, path: Path, identity: str | None):
        """Refers to a folder that `open_run` has prepared, of the run with this identity."""
        self.path, self.identity = path, identity
        self.checkpoints = path / "checkpoints"
        self.figures = path / "figures"

    def store(self, *, tell: Callable[[str], None]) -> Checkpoints:
        """Opens the run's checkpoints, see there."""
        return Checkpoints(self.checkpoints, run=self.identity, tell=tell)

    def log(self, message: str) -> None:
        """Appends a line with the time to events.log."""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        path = self.path / EVENTS
        with files.naming(path), path.open("a", encoding="utf-8") as file:
            file.write(f"{now} {message}\n")


@contextlib.contextmanager
def open_run(
    path: Path,
    scene: Scene,
    settings: Settings,
    command: list[str],
    *,
    fresh: bool = False,
    sources: Iterable[Path] = (),
) -> Iterator[tuple[RunDirectory, list[str]]]:
    """Opens a run folder: makes it, or checks that it is this very run; locks it meanwhile.

    Nothing is deleted in it but what `belongings` tells to be a run's or an unfinished start's.
    """
    sources = tuple(sources)
    check_folder(path, scene, settings, fresh=fresh, sources=sources)
    made = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    with _locked(path):
        # Again: another process may have been here.
        check_folder(path, scene, settings, fresh=fresh, sources=sources)
        if fresh and (path / PROVENANCE).exists():
            contents = _contents(scene, settings)
            belongings.delete_run(path)
        else:
            contents = None
        notes = []
        if (path / PROVENANCE).exists():
            belongings.tidy(path)
            notes = _resume(path, settings, command)
        else:
            _create(path, scene, settings, command, contents)
        run = RunDirectory(path, manifest.read_provenance(path).get("id"))
        run.log("created" if made or fresh else "opened")
        for note in notes:
            run.log(note)
        yield run, notes


def check_folder(
    path: Path,
    scene: Scene,
    settings: Settings,
    *,
    fresh: bool = False,
    sources: Iterable[Path] = (),
) -> None:
    """Checks that a run could start or go on in a folder; changes nothing.

    Args:
      path: The folder.
      scene: The scene of the run.
      settings: Its settings.
      fresh: Whether an earlier run's files will be deleted.
      sources: Files that the scene was read from.

    Raises:
      InputError: See `open_run`.
    """
    belongings.refuse_foreign(path)
    belongings.refuse_unmarked(path)
    if not (path / PROVENANCE).exists():
        return
    stored = manifest.read_provenance(path)
    if fresh:
        meshes = (shape.mesh.path for shape in scene.objects.object if shape.mesh)
        belongings.refuse_to_delete(path, (*sources, *meshes))
    else:
        _refuse_other(path, scene, settings, stored)
        if reading.lost_all(path):
            raise InputError([reading.lost_all(path)])


def setting_of(paths: Iterable[Path], name: str) -> Any:
    """A setting of the runs in folders, such as their episodes; None if no folder has a run.

    Args:
      paths: The folders.
      name: Name of the setting.

    Raises:
      InputError: If the runs differ in it, or one cannot be read.
    """
    found = [path for path in paths if (path / PROVENANCE).exists()]
    values = {path: manifest.read_provenance(path)["settings"][name] for path in found}
    if len(set(values.values())) > 1:
        least, most = (f(values, key=lambda path: values[path]) for f in (min, max))
        one = values[least]
        told = f"{one} {name}" if isinstance(one, int) else f"{name} {one}"
        problem = f"{least} has {told} and {most} {values[most]}: say by --{name} what all "
        problem += "are to have"
        raise InputError([problem])
    return next(iter(values.values()), None)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Holds the folder's lock; the kernel releases it with the process, however it ends."""
    place = os.open(path / belongings.LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    with os.fdopen(place, "r+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = file.read(64).strip() or "?"
            raise InputError([f"--out {path} is in use by process {owner}"]) from error
        except OSError as error:
            problem = f"--out {path} cannot be locked: {error.strerror}; choose another folder"
            raise InputError([problem]) from error
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def _resume(path: Path, settings: Settings, command: list[str]) -> list[str]:
    """Notes a resumption or extension; returns what the user should know about it."""
    stored = manifest.read_provenance(path)
    notes = _differences(stored["environment"], environment())
    stored["resumed"] = [*stored.get("resumed", []), manifest.start_note(command)]
    before = stored["settings"]["episodes"]
    if before != settings.episodes:
        step = {"from": before, "to": settings.episodes}
        stored["extended"] = [*stored.get("extended", []), manifest.start_note(command) | step]
        stored["settings"]["episodes"] = settings.episodes
        notes.append(f"extended from {before} to {settings.episodes} episodes")
    manifest.write(path, stored)
    return notes


def _create(
    path: Path,
    scene: Scene,
    settings: Settings,
    command: list[str],
    contents: Mapping[str, bytes] | None,
) -> None:
    """Makes a run: its marker first and provenance.json last, which makes the folder a run."""
    contents = _contents(scene, settings) if contents is None else contents
    belongings.begin(path, contents)
    scene_files.write_scene(scene, path, contents)
    manifest.write(path, manifest.new(settings, contents, command))
    belongings.tidy(path)


def _contents(scene: Scene, settings: Settings) -> dict[str, bytes]:
    """Files that a run is made from: the scene's, and the user's own code."""
    return scene_files.contents(scene) | own.contents((settings.optimizer, settings.cost))


def _refuse_other(path: Path, scene: Scene, settings: Settings, stored: dict[str, Any]) -> None:
    """Refuses to resume another run, and says what differs."""
    problems, extension = [], []
    for name, value in dataclasses.asdict(settings).items():
        stood = stored["settings"].get(name)
        if name == "episodes":
            extension = _extension_problems(scene, settings, stood)
        elif stood != value:
            flag = name.replace("_", "-")
            problems.append(f"--{flag}: the run has {stood}, asked for is {value}")
    manifest.refuse_changed(path, stored)
    before = scenes.load(path / "scene.toml")
    if before != scene:
        other = {
            f"{word}.toml": f"--{word}: the run has {was}, asked for is {now}"
            for word, was, now in (
                ("scene", before.name, scene.name),
                ("hand", before.hand.name, scene.hand.name),
                ("objects", before.objects.name, scene.objects.name),
            )
            if was != now
        }
        problems += other.values()
        for name, text in scene_files.scene_texts(scene).items():
            if name in other:  # every line of it may differ
                continue
            old = (path / name).read_text(encoding="utf-8").splitlines()
            diff = difflib.unified_diff(old, text.splitlines(), f"run/{name}", f"asked/{name}", n=0)
            problems += _beginning([*diff])
    if not problems:
        problems = _other_code(path, settings, stored)
    if problems:
        head = f"--out {path} holds another run; choose another folder, or --fresh to delete it"
        shown = [head, *_own_command(stored), *(p.rstrip() for p in problems + extension)]
        raise InputError(shown)
    if extension:
        hint = "leave out --episodes to go on with it, or choose another folder"
        raise InputError([f"--out {path}: {problem}; {hint}" for problem in extension])


def _other_code(path: Path, settings: Settings, stored: dict[str, Any]) -> list[str]:
    """How the user's own optimiser and cost differ from those that the run was made with."""
    found = []
    for name, content in own.contents((settings.optimizer, settings.cost)).items():
        if manifest.digests({name: content})[name] != stored.get("files", {}).get(name):
            old, new = (path / name).read_text("utf-8"), content.decode()
            ends = f"run/{name}", f"now/{name}"
            diff = difflib.unified_diff(old.splitlines(), new.splitlines(), *ends, n=0)
            found += [f"{Path(name).stem} was changed since the run was made:", *diff]
    return _beginning(found)


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
