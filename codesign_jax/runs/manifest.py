"""provenance.json of a run folder: whose folder it is, how it was made, and whether it is intact.

It may be a stranger's, or damaged: all that others read from it is checked here, and that the
folder has its files itself.
"""

import dataclasses
import datetime
import json
import re
import uuid
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from codesign_jax import files, terminal, user_code
from codesign_jax import scene as scenes
from codesign_jax.provenance import environment, git_state
from codesign_jax.runs.columns import FILES, TABLES
from codesign_jax.runs.settings import SCENE_ACCURACY, Settings, check
from codesign_jax.scene import scene_files
from codesign_jax.scene.schema import InputError, Problem

PROVENANCE = "provenance.json"
"""File that makes a folder a run."""
LOCK = ".lock"
"""File that a process holds while it writes to a run."""
SCHEMA = 2
"""Version of what a run folder holds: it grows when the code before can no longer read a folder."""
_FURTHER = (scene_files.SEARCH, scene_files.MESHES, user_code.FOLDER)
_MOST_BYTES = 20_000_000
_MOST_PROBLEMS = 3
"""Links of a folder that an error names."""
_START = {"time": str, "command": [str]}
_TYPES = {
    "schema": int,
    "id": str,
    "settings": {field.name: field.type for field in dataclasses.fields(Settings)},
    "started": _START,
    "resumed": [_START],
    "extended": [_START],
    "environment": dict.fromkeys(("python", "platform", "machine", "device"), str)
    | {"versions": {...: str | None}},
    "git": {"commit": str | None},
    "files": {...: str},
}
"""Types of the entries; [T] is a list of T, and {...: T} a table of them by any name."""


def new(settings: Settings, contents: Mapping[str, bytes], command: list[str]) -> dict[str, Any]:
    """What is noted of a run that begins now."""
    return {
        "schema": SCHEMA,
        "id": uuid.uuid4().hex,
        "settings": dataclasses.asdict(settings),
        "started": start_note(command),
        "environment": environment(),
        "git": git_state(),
        "files": digests(contents),
    }


def start_note(command: list[str]) -> dict[str, Any]:
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"time": now, "command": command}


def digests(contents: Mapping[str, bytes]) -> dict[str, str]:
    return {name: sha256(content).hexdigest() for name, content in contents.items()}


def write(path: Path, content: dict[str, Any]) -> None:
    with files.atomically(path / PROVENANCE) as part:
        part.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def refuse_links(path: Path, names: Iterable[str] = (*FILES, *TABLES, LOCK)) -> None:
    """Refuses a run folder one of whose files is a link, or nothing that can be read to its end.

    Whoever made the folder would choose which of its user's files are read, shown and written to.

    Args:
      names: Files and folders at its top that are about to be opened.
    """
    problems = [
        Problem(
            "file",
            f"{path / name} is a symbolic link, or no file: a run is read and written in its "
            "folder alone. Put the file or folder itself in its place",
        )
        for name in files.special(path, names)
    ]
    if problems:
        raise InputError(problems[:_MOST_PROBLEMS])


def read_provenance(path: Path) -> dict[str, Any]:
    """What is noted of a run; texts in it are one line each."""
    refuse_links(path, [PROVENANCE, *scene_files.NAMES, *_FURTHER])
    file = path / PROVENANCE
    try:
        with files.opened(file) as opened:
            content = opened.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise _damaged(file, f"it has more than {_MOST_BYTES:,} bytes")
        text = content.decode()
    except OSError as error:
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            why = f"it has no {PROVENANCE}" if path.exists() else "there is no such folder"
        else:
            why = f"{PROVENANCE} cannot be read: {error.strerror}"
        raise InputError.of("damaged", f"{path} is not a run folder: {why}{_hint(path)}") from error
    except UnicodeDecodeError as error:
        raise _damaged(file, "it is no text in UTF-8") from error
    try:
        stored = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _damaged(file, "it is no valid JSON") from error
    if isinstance(stored, dict) and isinstance(stored.get("settings"), dict):
        older = {"policy": "", "search_accuracy": SCENE_ACCURACY}  # runs that name neither
        stored["settings"] = older | stored["settings"]
    if problem := _problem(stored):
        raise _damaged(file, problem)
    if stored["schema"] > SCHEMA:
        raise InputError.of(
            "unsupported",
            f"{path} was made by a newer version of codesign-jax (its folders have schema "
            f"{stored['schema']}, this version reads up to {SCHEMA}): use that version",
        )
    settings = Settings(**stored["settings"])
    if problems := check(settings, None):
        raise _damaged(file, f"its settings are not valid: {problems[0]}")
    return _lines(stored)


def _lines(value: Any) -> Any:
    """JSON with texts that are one line each."""
    if isinstance(value, dict):
        return {terminal.line(name): _lines(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_lines(entry) for entry in value]
    return terminal.line(value) if isinstance(value, str) else value


def changed_files(path: Path, stored: Mapping[str, Any]) -> list[str]:
    """Names of the scene files that differ from those the run was made with.

    Other comments or another layout of a TOML file are no difference.
    """
    noted = stored["files"]
    changed = [name for name, digest in noted.items() if _digest(path / name) != digest]
    if not changed or not set(changed) <= set(scene_files.NAMES):
        return changed
    try:
        texts = scene_files.scene_texts(scenes.load(path / "scene.toml"))
    except InputError:
        return changed
    return [n for n in changed if sha256(texts[n].encode()).hexdigest() != noted[n]]


def refuse_changed(path: Path, stored: Mapping[str, Any]) -> None:
    """Refuses a run whose scene files are not those it was made with."""
    changed = changed_files(path, stored)
    if not changed:
        return
    missing = [name for name in changed if not (path / name).exists()]
    state = "is missing" if missing == changed else "was changed"
    raise InputError.of(
        "damaged",
        f"{', '.join(str(path / name) for name in changed)} {state} since the run was made, so "
        "that its results are not those of this scene. Put back the file as it was. To try "
        "other values on the run's design leave the file and give --set KEY=VALUE; a run of "
        f"the new scene needs a folder of its own. Or, to accept the files as they are, delete "
        f'their lines under "files" in {path / PROVENANCE}',
    )


def _damaged(file: Path, why: str) -> InputError:
    return InputError.of(
        "damaged", f"{file} is damaged: {why}. Put it back from a copy, or choose another folder"
    )


def _digest(path: Path) -> str:
    """A file's digest; nothing where there is no file that can be read."""
    try:
        return sha256(files.read(path)).hexdigest()
    except OSError:
        return ""


def runs_inside(path: Path, pattern: str = "*") -> list[Path]:
    """The run folders in a folder, seed-2 before seed-10."""
    folders = [file.parent for file in path.glob(f"{pattern}/{PROVENANCE}")]
    return sorted(folders, key=lambda folder: (folder.parent, len(folder.name), folder.name))


def _hint(path: Path) -> str:
    inside = runs_inside(path)
    some = " or ".join(map(str, inside[:2]))
    several = f"{len(inside)} run{'s' * (len(inside) > 1)}"
    return f"; it holds {several}: give one, such as {some}" if inside else ""


def _problem(stored: Any) -> str:
    if not isinstance(stored, dict):
        return "it is no table"
    stored = {"resumed": [], "extended": []} | stored
    wrong = [name for name, types in _TYPES.items() if not _fits(stored.get(name), types)]
    if not wrong:
        folders = ([scene_files.MESHES], [user_code.FOLDER])
        names = (*scene_files.NAMES, scene_files.SEARCH)
        ours = (n in names or n.split("/")[:-1] in folders for n in stored["files"])
        right = {
            "settings": stored["settings"].keys() == _TYPES["settings"].keys(),  # type: ignore[attr-defined]
            "id": re.fullmatch("[0-9a-f]{32}", stored["id"]) is not None,
            "files": all(ours),
        }
        wrong = [name for name, holds in right.items() if not holds]
    return f'"{wrong[0]}" is missing, or not valid' if wrong else ""


def _fits(value: Any, types: Any) -> bool:
    if isinstance(types, list):
        return isinstance(value, list) and all(_fits(v, types[0]) for v in value)
    if isinstance(types, dict):
        if not isinstance(value, dict):
            return False
        if ... in types:
            return all(_fits(v, types[...]) for v in value.values())
        return all(_fits(value.get(name), kind) for name, kind in types.items())
    return isinstance(value, types) and not isinstance(value, bool)
