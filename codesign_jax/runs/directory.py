"""The run folder: one run, one process at a time, and nothing in it that is not the run's.

A start writes provenance.json first, with digests of the files that it is about to make: the same
command writes what a start that was cut short has not.  `--fresh` deletes the files that a run has
by their names, provenance.json last.  Nothing else is ever deleted.
"""

import contextlib
import dataclasses
import datetime
import difflib
import fcntl
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from codesign_jax import files, terminal, user_code
from codesign_jax import scene as scenes
from codesign_jax.provenance import environment
from codesign_jax.runs import manifest, reading, tables
from codesign_jax.runs.checkpoint import Checkpoints
from codesign_jax.runs.columns import FILES, TABLES
from codesign_jax.runs.errors import RunError
from codesign_jax.runs.manifest import LOCK, PROVENANCE
from codesign_jax.runs.record import Record
from codesign_jax.runs.settings import SCENE_ACCURACY, Settings, masks_of, search_scene
from codesign_jax.scene import Scene, scene_files, texts
from codesign_jax.scene.parameters import design_space
from codesign_jax.scene.schema import InputError, Problem

EVENTS = "events.log"
"""Log of a run folder: what happened when, a line each."""
_MOST_LINES = 16
"""Lines of a file's differences that an error shows."""


_INSIDE = {
    user_code.FOLDER: re.compile(r"[A-Za-z_][\w.]*\.py"),
    "checkpoints": re.compile(r"[0-9]+(\.sha256|\.orbax-checkpoint-tmp.*)?"),
    "failures": re.compile(r"episode-[0-9]+-particle-[0-9]+-trial-[0-9]+\.npz"),
    "figures": re.compile(r"(cost_evolution|landscape)\.png"),
    scene_files.MESHES: re.compile(r"object_[0-9]+\.[a-z0-9.]+"),
}
"""Names in the folders of a run; folders of steps are the run's with all that is in them."""


class RunDirectory:
    """An open run folder; see `open_run`.

    Attributes:
      path: Where it was when it was opened.
    """

    def __init__(self, path: Path, lock: int):
        """Takes the descriptor of the folder's lock, which is held."""
        self.path = path
        self._lock = lock

    def here(self) -> Path:
        """The folder to write to: its path, where it still is.

        Raises:
          RunError: If it was moved, deleted or replaced, such as by a disk mounted over it.
        """
        locked_file = os.fstat(self._lock)
        with contextlib.suppress(OSError):
            there = os.stat(self.path / LOCK, follow_symlinks=False)
            if os.path.samestat(locked_file, there):
                return self.path
        problem = f"{self.path} was moved, deleted or replaced while its run was going on"
        if locked_file.st_nlink == 0:
            raise RunError(f"{problem}: the run's data are lost")
        try:
            place = Path(os.readlink(f"/proc/self/fd/{self._lock}")).parent
        except OSError:  # a system without /proc
            raise RunError(f"{problem}; it goes on from where its folder is now") from None
        raise RunError(
            f"{problem}. Its data are in {place}; it goes on by the same command where that is "
            f"put back, or with --out {place}"
        )

    def store(self, *, tell: Callable[[str], None]) -> Checkpoints:
        identity = manifest.read_provenance(self.path)["id"]
        return Checkpoints(self.path / "checkpoints", run=identity, tell=tell)

    def log(self, message: str) -> None:
        """Appends a line with the time to events.log."""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        files.append(self.here() / EVENTS, f"{now} {terminal.line(message)}\n")


@contextlib.contextmanager
def open_run(
    path: Path,
    scene: Scene,
    settings: Settings,
    command: list[str],
    *,
    fresh: bool = False,
) -> Iterator[tuple[RunDirectory, list[str]]]:
    """Opens a run folder: makes it, or checks that it is this very run; locks it meanwhile."""
    check_folder(path, scene, settings, fresh=fresh)
    path.mkdir(parents=True, exist_ok=True)
    with locked(path) as lock:
        # Again: another process may have been here.
        check_folder(path, scene, settings, fresh=fresh)
        contents = _contents(scene, settings)
        run = RunDirectory(path, lock)
        notes = []
        if fresh:
            _delete_run(path)
        created = not (path / PROVENANCE).exists()
        if created:
            manifest.write(path, manifest.new(settings, contents, command))
        else:
            notes = _resume(path, settings, command)
        # Files of an earlier version stay as they are: their digests are noted.
        if missing := {n: c for n, c in contents.items() if not (path / n).exists()}:
            scene_files.write_scene(scene, path, missing)
        for name in _all(path):  # temporaries that killed processes left
            if _named(name) != name and _is_of_a_run(path, name):
                (path / name).unlink()
        for message in ["created" if created else "opened", *notes]:
            run.log(message)
        yield run, notes


@contextlib.contextmanager
def reopened(path: Path, settings: Settings) -> Iterator[RunDirectory]:
    """The folder of a run that has ended, to add results to it; it is not locked.

    Raises:
      InputError: If it is no run any more, or of other settings.
    """
    stored = manifest.read_provenance(path)
    if stored["settings"] != dataclasses.asdict(settings):
        raise InputError.of(
            "damaged", f"{path} is of another run: it was replaced since this one ended"
        )
    descriptor = os.open(path / LOCK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        yield RunDirectory(path, descriptor)
    finally:
        os.close(descriptor)


def check_folder(path: Path, scene: Scene, settings: Settings, *, fresh: bool = False) -> None:
    """Checks that a run could start or go on in a folder; changes nothing."""
    manifest.refuse_links(path)
    _refuse_foreign(path)
    if not (path / PROVENANCE).exists():
        return
    stored = manifest.read_provenance(path)
    if fresh:
        _refuse_to_delete(path)
    else:
        _refuse_other(path, scene, settings, stored)
        _refuse_folders(path)
        if problem := reading.lost(path):
            raise InputError([problem])


def setting_of(paths: Iterable[Path], name: str) -> Any:
    """A setting of the runs in folders, such as their episodes; None if no folder has a run."""
    folders = [path for path in paths if (path / PROVENANCE).exists()]
    values = {path: manifest.read_provenance(path)["settings"][name] for path in folders}
    if len(set(values.values())) > 1:
        least, most = (f(values, key=lambda path: values[path]) for f in (min, max))
        value = values[least]
        words = f"{value} {name}" if isinstance(value, int) else f"{name} {value}"
        problem = f"{least} has {words} and {most} {values[most]}: say by --{name} what all "
        problem += "are to have"
        raise InputError.of("conflict", problem)
    return next(iter(values.values()), None)


@contextlib.contextmanager
def locked(path: Path) -> Iterator[int]:
    """Holds the folder's lock, and yields the descriptor of its file.

    The kernel releases it with the process, however that ends.
    """
    descriptor = os.open(path / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    with os.fdopen(descriptor, "r+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = file.read(64).strip() or "?"
            raise InputError.of("file", f"--out {path} is in use by process {owner}") from error
        except OSError as error:
            problem = f"--out {path} cannot be locked: {error.strerror}; choose another folder"
            raise InputError.of("file", problem) from error
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield descriptor


def write_tables(path: Path, scene: Scene, settings: Settings, record: Record) -> None:
    """Writes a run's tables from its checkpoint.

    Nothing changes where a process has the run open, where nobody may write, or where a folder is
    in the place of a file.
    """
    if os.access(path, os.W_OK):
        with contextlib.suppress(InputError):
            _refuse_folders(path)
            with locked(path):
                tables.write_run(path, scene, design_space(scene.hand, settings.preset), record)


def _resume(path: Path, settings: Settings, command: list[str]) -> list[str]:
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


def _contents(scene: Scene, settings: Settings) -> dict[str, bytes]:
    files_of_run = scene_files.contents(scene) | user_code.contents(settings.user_code)
    if settings.search_accuracy != SCENE_ACCURACY:
        files_of_run[scene_files.SEARCH] = _search_text(scene, settings).encode()
    return files_of_run


def _search_text(scene: Scene, settings: Settings) -> str:
    description = f"of the search: {settings.search_accuracy}"
    return scene_files.accuracy_text(search_scene(scene, settings), description)


def _refuse_other(path: Path, scene: Scene, settings: Settings, stored: dict[str, Any]) -> None:
    problems = []
    extension = []
    for name, value in dataclasses.asdict(settings).items():
        stood = stored["settings"].get(name, "")
        if name == "episodes":
            extension = _extension_problems(scene, settings, stood)
        elif stood != value:
            flag = name.replace("_", "-")
            problems.append(
                Problem("conflict", f"--{flag}: the run has {stood}, asked for is {value}")
            )
    if not problems and _is_cut_short(path, scene, settings, stored):
        return
    manifest.refuse_changed(path, stored)
    before = scenes.load(path / "scene.toml")
    if before != scene:
        names = {"scene": (before, scene), "hand": (before.hand, scene.hand)}
        names["objects"] = before.objects, scene.objects
        other = [word for word, (was, now) in names.items() if was.name != now.name]
        for word in other:
            was, now = (v.name for v in names[word])
            problems.append(Problem("conflict", f"--{word}: the run has {was}, asked for is {now}"))
        for name, text in scene_files.scene_texts(scene).items():
            if name.removesuffix(".toml") not in other:  # of those every line may differ
                problems += _diff(path, name, text)
    if not problems and settings.search_accuracy != SCENE_ACCURACY:
        problems = _diff(path, scene_files.SEARCH, _search_text(scene, settings))
    if not problems:
        problems = _other_code(path, settings, stored)
    if problems:
        head = f"--out {path} holds another run; choose another folder, or --fresh to delete it"
        shown = [head, *_own_command(stored), *(p.rstrip() for p in problems + extension)]
        raise InputError([Problem("conflict", sentence) for sentence in shown])
    if extension:
        hint = "leave out --episodes to go on with it, or choose another folder"
        raise InputError(
            [Problem("conflict", f"--out {path}: {problem}; {hint}") for problem in extension]
        )


def _is_cut_short(path: Path, scene: Scene, settings: Settings, stored: dict[str, Any]) -> bool:
    noted = manifest.digests(_contents(scene, settings))
    changed = manifest.changed_files(path, stored)
    missing = not any((path / name).exists() for name in changed)
    return bool(changed) and missing and not _top(path / "checkpoints") and noted == stored["files"]


def _other_code(path: Path, settings: Settings, stored: dict[str, Any]) -> list[str]:
    lines = []
    for name, content in user_code.contents(settings.user_code).items():
        if manifest.digests({name: content})[name] != stored["files"].get(name):
            diff = _diff(path, name, content.decode())
            lines += [f"{Path(name).stem} was changed since the run was made:", *diff]
    return lines


def _own_command(stored: dict[str, Any]) -> list[str]:
    """By which command a run goes on, in words; nothing if it was begun from Python."""
    program, *arguments = [stored["started"], *stored.get("resumed", [])][-1]["command"] or [""]
    if Path(program).name not in ("codesign", "cli.py", "__main__.py"):
        return []
    return [f"the run in it goes on by its own command: {shlex.join(['codesign', *arguments])}"]


def _diff(path: Path, name: str, text: str) -> list[str]:
    old = files.read(path / name).decode().splitlines()
    ends = f"run/{name}", f"asked/{name}"
    lines = [*difflib.unified_diff(old, text.splitlines(), *ends, n=0)]
    rest = len(lines) - _MOST_LINES
    return lines if rest <= 0 else [*lines[:_MOST_LINES], f"and {rest} lines more"]


def _extension_problems(scene: Scene, settings: Settings, before: int) -> list[str]:
    episodes = settings.episodes
    both = f"the run has {before} episodes, asked for are {episodes}"
    if episodes < before:
        return [f"{both}, and a run can be extended, but not shortened"]
    masks = [masks_of(scene, dataclasses.replace(settings, episodes=n)) for n in (before, episodes)]
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
    words = f"not bitwise comparable with an uninterrupted run: {', '.join(changed)}"
    return [words] if changed else []


def _refuse_foreign(path: Path) -> None:
    if path.is_symlink() and not path.exists():
        raise InputError.of("file", f"--out {path} is a symbolic link to nothing")
    if path.exists() and not path.is_dir():
        raise InputError.of("file", f"--out {path} is a file")
    others = [name for name in _all(path) if name != LOCK and _named(name) != PROVENANCE]
    if others and not (path / PROVENANCE).exists():
        hint = "choose another folder, or delete these files yourself, if nobody needs them"
        if (path / "checkpoints").exists():
            hint = f"if it is a run that lost {PROVENANCE}, put that back from a copy; or {hint}"
        problem = f"--out {path} holds {texts.some(others)} and no {PROVENANCE}: {hint}"
        raise InputError.of("file", f"{problem}. Nothing was changed")


def _refuse_folders(path: Path) -> None:
    """Refuses folders where a run has files, which it could not write when it gets there."""
    names = {*FILES, *TABLES, LOCK} - {*_INSIDE}
    problems = [
        Problem(
            "file",
            f"{path / name} is a folder, and a run has a file of this name: move it elsewhere. "
            "Nothing was changed",
        )
        for name in sorted(names)
        if (path / name).is_dir()
    ]
    if problems:
        raise InputError(problems)


def _refuse_to_delete(path: Path) -> None:
    others = [name for name in _all(path) if not _is_of_a_run(path, name)]
    if others:
        raise InputError.of(
            "file",
            f"--fresh would delete {texts.some(others)} in {path}, which are no files of a "
            "run: move them elsewhere first, or choose another folder",
        )


def _delete_run(path: Path) -> None:
    """Deletes a run's files, those that make it one last; see `_refuse_to_delete`."""
    for name in _all(path):
        if name not in (LOCK, PROVENANCE) and _is_of_a_run(path, name):
            files.remove(path / name)
    for name in _INSIDE:
        with contextlib.suppress(FileNotFoundError):
            (path / name).rmdir()
    (path / PROVENANCE).unlink(missing_ok=True)


def _top(path: Path) -> list[str]:
    return sorted(os.listdir(path)) if path.is_dir() else []


def _all(path: Path) -> list[str]:
    names = []
    for name in _top(path):
        inside = path / name
        if name in _INSIDE and inside.is_dir() and not inside.is_symlink():
            names += [f"{name}/{other}" for other in _top(inside)]
        else:
            names.append(name)
    return names


def _named(name: str) -> str:
    """The file that a temporary was to replace, as `files.atomically` names it; others as they are.

    A killed process leaves its temporaries.
    """
    match = re.fullmatch(r"(.*?\.(?:toml|json|csv|log|npz|html|sha256|png))\.[^/]*tmp", name)
    return match[1] if match else name


def _is_of_a_run(path: Path, name: str) -> bool:
    folder, _, inside = name.rpartition("/")
    if folder:
        return _INSIDE[folder].fullmatch(_named(inside)) is not None
    return _named(name) in {*FILES, *TABLES, LOCK} - {*_INSIDE} and not (path / name).is_dir()
